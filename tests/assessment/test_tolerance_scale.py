"""Uncertainty of machines whose errors exceed their tolerances."""

from __future__ import annotations

import numpy as np
import pytest
from calibrated import calibrated, session_of
from scaled_machines import calibrate_machines
from scipy.stats import binom

from orthocal import Choice, assess_tool, calibrate, compare_models
from orthocal.assessment.assess import expanded_uncertainty
from orthocal.assessment.calibrated_tool import find_tool
from orthocal.assessment.controller_entries import compute_entries
from orthocal.calibration.file import load_calibration, write_calibration
from orthocal.calibration.identify import identify
from orthocal.calibration.refit import repeat_calibration, restore_session
from orthocal.statistics.chance import coverage_factor

WITHIN = 1.15
"""Largest ratio of the RMS tool error of machines to the predicted one."""


EXAMPLE = "table1/experiment-2"


@pytest.fixture(scope="module")
def session():
    return session_of(EXAMPLE)


@pytest.fixture(scope="module")
def full():
    return calibrated(EXAMPLE, "full")


@pytest.fixture(scope="module")
def offsets():
    return calibrated(EXAMPLE, "offsets")


def test_priors_of_the_geometry_are_scaled_but_not_those_of_offsets(full):
    known = full.robot.parameters
    factor = full.tolerance_scale.factor
    assert factor == pytest.approx(2.83, abs=0.05)
    for p in full.free:
        expected = known[p.name].prior_std * (1.0 if known.are_offsets(p.name) else factor)
        assert p.prior_std == pytest.approx(expected)


def test_the_stated_uncertainty_of_a_known_value_is_not_scaled(session):
    choice = Choice("full", known={"x_fork.rx_mrad": (0.05, 0.01)})
    result = calibrate(session, choice, solver="linearised")
    assert result.tolerance_scale.factor > 2.0
    assert result["x_fork.rx"].prior_std == pytest.approx(0.005e-3)


def test_uncertainty_and_tool_error_are_those_of_scaled_tolerances(session, full):
    """Figures of independent calibrations with multiplied tolerances."""
    within, _ = identify(session, "full", solver="variable-projection")
    half = [expanded_uncertainty(full, e) * 1e3 for e in full.assessment.entries]
    assert half == pytest.approx([1.51] * 3, rel=0.02)
    half = [
        expanded_uncertainty(within, e) * 1e3 for e in compute_entries(within, find_tool(within))
    ]
    assert half == pytest.approx([0.355] * 3, rel=0.03)
    assert full.assessment.tool.compensated == pytest.approx(88e-6, rel=0.02)
    assert assess_tool(within).after.sizes.aligned.rms == pytest.approx(33e-6, rel=0.03)
    # the uncertainty before is at the tolerances as stated
    before = [assess_tool(c).before.sizes.aligned.rms for c in (full, within)]
    assert before[0] == pytest.approx(before[1], rel=1e-3)


def test_a_small_model_counts_unmodelled_errors_once(session, offsets):
    found, scale, gauge = offsets, offsets.tolerance_scale, session.gauge
    bias = np.sqrt(np.diag(found.unmodelled.bias_covariance))
    scatter = np.array([p.std_scatter for p in found.free])
    assert scatter == pytest.approx(np.full(3, 1.984 * np.hypot(gauge.sigma, 2.9e-6)), rel=0.03)
    assert found.standard_deviations == pytest.approx(np.hypot(bias, scatter), rel=1e-3)
    half = coverage_factor(scale.contrasts) * bias
    assert found.expanded_uncertainties == pytest.approx(half, rel=0.01)
    assert found.noise.source == "residuals"


def test_compare_refits_and_files_have_the_same_factor(session, full, offsets, tmp_path):
    compared = compare_models(session, models=["offsets"]).results[0].calibration
    again = repeat_calibration(offsets, restore_session(offsets))
    for other in (compared, again):
        assert other.expanded_uncertainties == pytest.approx(offsets.expanded_uncertainties)
    loaded = load_calibration(write_calibration(full, tmp_path / "calibration.json"))
    assert loaded.tolerance_scale == full.tolerance_scale
    assert loaded.expanded_uncertainties == pytest.approx(full.expanded_uncertainties)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.0, 2.83])
def test_intervals_contain_the_truth_at_any_factor(session, factor):
    """A sample; `tests/benchmarks/worse_machines.py` has more machines, and the full model."""
    count = 16
    outcome = calibrate_machines(session, "offsets", factor=factor, count=count)
    # three offsets of a machine are wrong together
    judged = outcome.covered if factor == 1.0 else outcome.covered[outcome.found]
    assert judged.all(axis=1).sum() >= binom.ppf(0.001, len(judged), 0.9)
    if factor == 1.0:
        assert not outcome.found.any()
        true, predicted = np.sqrt(np.mean(outcome.tool**2, axis=0))
        assert true < WITHIN * predicted
    else:
        low, high = binom.interval(0.997, count, 0.54)
        assert low <= outcome.found.sum() <= high
        assert outcome.ratio < WITHIN
