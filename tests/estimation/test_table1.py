"""The paper's Table 1, row by row: printed residuals, and numbers computed independently."""

from __future__ import annotations

import math

import numpy as np
import pytest
from calibrated import identified, session_of
from tolerances import DESIGN_MM, FOUR_DECIMALS_MM, PAPER_MM, THREE_DECIMALS_MM

from orthocal.estimation.linear import invert_equation_8, leg_parallelism_matrix

# Independent computation of the reduced system (mm): offsets, r.m.s. before and after, sigma
LINEAR = {
    "experiment-1-printed": ((2.2717, 1.6565, -1.3962), 1.209, 0.760, 1.075),
    "experiment-1-corrected": ((2.1798, 1.6916, -1.4096), 1.188, 0.745, 1.054),
    "experiment-2": ((-0.5223, 0.5988, -1.7598), 0.622, 0.195, 0.276),
    "experiment-3": ((0.0668, 0.1411, 0.0026), 0.213, 0.205, 0.290),
}

# Independent nonlinear computation (mm)
EXACT = {
    "experiment-1-printed": (2.2665, 1.6492, -1.4146),
    "experiment-2": (-0.5268, 0.5921, -1.7606),
    "experiment-3": (0.0667, 0.1411, 0.0025),
}

# "Expected improvement" rows of the paper's Table 1 (mm), order xy, xz, yx, yz, zx, zy
PAPER_RESIDUALS = {
    "experiment-1-corrected": (-0.94, 0.63, 1.07, -0.84, -0.27, 0.35),
    "experiment-2": (-0.28, 0.25, 0.21, -0.14, -0.13, 0.09),
    "experiment-3": (-0.29, 0.23, 0.25, -0.17, -0.10, 0.08),
}


@pytest.fixture(scope="module")
def results():
    return {name: identified(session_of(f"table1/{name}")) for name in LINEAR}


@pytest.mark.parametrize("name", LINEAR)
def test_linear_offsets_residuals_and_sigma(results, name):
    session = session_of(f"table1/{name}")
    matrix = leg_parallelism_matrix(
        length=0.31025, displacement_max=0.06, displacement_min=-0.10, rows=6
    )
    found = invert_equation_8(matrix) @ session.values
    residuals = session.values - matrix @ found
    offsets, before, after, sigma = LINEAR[name]
    assert np.abs(found - 1e-3 * np.array(offsets)).max() < FOUR_DECIMALS_MM
    assert abs(np.sqrt(np.mean(session.values**2)) - before * 1e-3) < THREE_DECIMALS_MM
    assert abs(np.sqrt(np.mean(residuals**2)) - after * 1e-3) < THREE_DECIMALS_MM
    assert abs(np.sqrt(residuals @ residuals / 3) - sigma * 1e-3) < THREE_DECIMALS_MM
    recorded = np.array([p.linear for p in results[name].free])
    assert np.abs(recorded - 1e-3 * np.array(offsets)).max() < FOUR_DECIMALS_MM


@pytest.mark.parametrize("name", EXACT)
def test_exact_offsets(results, name):
    exact = np.array([p.value for p in results[name].free])
    assert np.abs(exact - 1e-3 * np.array(EXACT[name])).max() < DESIGN_MM


@pytest.mark.parametrize("name", PAPER_RESIDUALS)
def test_residuals_are_those_of_the_paper(results, name):
    """The paper's own linear residuals, to its rounding of readings and residuals."""
    rows = {r.setup: r.measured - r.linear for r in results[name].residuals}
    found = np.array([rows[s] for s in ("xy", "xz", "yx", "yz", "zx", "zy")])
    slack = PAPER_MM * (1.0 if name != "experiment-1-corrected" else 3.0)
    assert np.abs(found - 1e-3 * np.array(PAPER_RESIDUALS[name])).max() < slack + PAPER_MM


def test_the_printed_first_experiment_contradicts_itself(results):
    """Its own r.m.s., printed as 1.19, fits the corrected reading only."""
    assert abs(results["experiment-1-printed"].rms_before * 1e3 - 1.19) > 0.015
    assert abs(results["experiment-1-corrected"].rms_before * 1e3 - 1.19) < 0.005


def test_residuals_of_experiments_2_and_3_are_the_same(results):
    """The paper's rounded residuals correlate 0.992, unrounded ones no less."""
    printed = [PAPER_RESIDUALS[f"experiment-{n}"] for n in (2, 3)]
    assert abs(np.corrcoef(*printed)[0, 1] - 0.992) < 0.0005
    a, b = ([r.residual for r in results[f"experiment-{n}"].residuals] for n in (2, 3))
    assert abs(np.corrcoef(a, b)[0, 1] - 0.9937) < 0.0005


def test_sigma_is_that_of_a_difference_with_three_degrees_of_freedom(results):
    c = results["experiment-2"]
    assert c.rows_are_differences
    assert 2.998 < c.dof < 3.0  # of which the gauge's own unknowns take 0.0014
    assert abs(c.sigma * 1e3 - 0.276) < 0.0006
    assert c.noise.sigma == pytest.approx(c.sigma / math.sqrt(2.0))
    assert c.noise.source == "residuals"
