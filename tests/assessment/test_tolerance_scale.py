"""Uncertainty of machines whose errors exceed their tolerances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibrated import session_of
from intervals import coverage_band
from linear_machines import LinearMachines
from scaled_machines import calibrate_machines
from scipy.stats import binom

from orthocal import Choice, SolverOptions, assess_tool, calibrate, compare_models, join_sessions
from orthocal.assessment.calibrated_tool import find_tool
from orthocal.assessment.controller_entries import compute_entries, expanded_uncertainty
from orthocal.assessment.judgement import find_tolerance_scale
from orthocal.calibration.file import load_calibration, write_calibration
from orthocal.calibration.identify import identify
from orthocal.calibration.refit import repeat_calibration, repeat_fit, restore_session
from orthocal.estimation.tolerance_scale import ToleranceScale
from orthocal.statistics.chance import coverage_factor

OFFSET = "x_slide.offset"
WITHIN = 1.15
"""Largest ratio of the RMS tool error of machines to the predicted one."""


EXAMPLE = "table1/experiment-2"


@pytest.fixture(scope="module")
def session():
    return session_of(EXAMPLE)


@pytest.fixture(scope="module")
def full(session):
    return calibrate(session, "full", solver="variable-projection", profile=[OFFSET])


@pytest.fixture(scope="module")
def offsets(session):
    return calibrate(session, "offsets", solver="variable-projection", profile=[OFFSET])


def test_priors_of_the_geometry_are_scaled_but_not_those_of_offsets(full):
    known = full.robot.parameters
    factor = full.tolerance_scale.factor
    assert factor == pytest.approx(2.83, abs=0.05)
    for p in full.free:
        expected = known[p.name].prior_std * (1.0 if known.are_offsets(p.name) else factor)
        assert p.prior_std == pytest.approx(expected)


def test_a_noise_that_is_not_stated_concerns_the_readings_of_its_gauge_alone(session):
    """Neither a gauge that read nothing nor one of another session changes the tolerance scale."""
    alone = find_tolerance_scale(session)
    spare = replace(session.gauge, sigma=None)
    with_spare = replace(session, gauges={**session.gauges, "spare": spare})
    assert find_tolerance_scale(with_spare) == alone
    other = session_of("table1/experiment-3")
    unstated = other.with_gauge(replace(other.gauge, sigma=None))
    assert find_tolerance_scale(unstated).factor == 1.0
    assert find_tolerance_scale(join_sessions([session, unstated])) == alone


def test_the_stated_uncertainty_of_a_known_value_is_not_scaled(session):
    known = {"x_fork.rx": (0.05, 0.01)}
    choice = Choice("full", known={f"{name}_mrad": value for name, value in known.items()})
    result = calibrate(session, choice, solver="linearised")
    assert result.tolerance_scale.factor > 2.0
    assert result["x_fork.rx"].prior_std == pytest.approx(0.005e-3)
    assert result.expand_estimate(result["x_fork.rx"]) <= 0.01e-3
    scale = ToleranceScale(2.0 * result.tolerance_scale.factor, 3.0)
    selection = repeat_fit(result, session, tolerance_scale=scale).problem.machine_selection
    for p, repeated in zip(result.free, selection.parameters, strict=True):
        expected = 2.0 if p.name not in known and not p.name.endswith(".offset") else 1.0
        assert repeated.prior_std == pytest.approx(expected * p.prior_std)


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


def test_a_profile_interval_counts_unmodelled_errors_once(full, offsets):
    """The readings of Experiment 2 are nearly linear in the offsets."""
    for found in (full, offsets):
        p, half = found[OFFSET], found.expand_estimate(found[OFFSET])
        assert p.interval == pytest.approx((p.value - half, p.value + half), abs=2e-3 * half)
    assert full.unmodelled.names == ()
    # the residuals of offsets contain unmodelled errors ten times larger than the stated noise
    assert offsets.noise.sigma > 5.0 * offsets.gauges[0].sigma


def test_uncertainties_of_mountings_are_within_their_tolerances(full, offsets):
    """The factor of few contrasts is that of the geometry: 3.2 instead of 2."""
    for found in (full, offsets):
        limits = [found.expand_estimate(p) / (2.0 * p.prior_std) for p in found.sensors]
        # the line model shows no mounting to first order
        assert limits == pytest.approx(np.ones(len(limits)), abs=1e-3)
        assert max(limits) <= 1.0
    factor = coverage_factor(full.tolerance_scale.contrasts)
    leg = full["x_coupler.x"]
    assert full.expand_estimate(leg) == pytest.approx(factor * leg.std, rel=0.01)
    assert full.expand_estimate(leg) <= factor * leg.prior_std


def test_a_narrow_prior_limits_the_uncertainty(full):
    """An offset with a narrow prior has a part from scaled errors, but no more than its prior."""
    p = replace(full[OFFSET], prior_std=0.5 * full[OFFSET].std)
    assert full.expand_estimate(p) == pytest.approx(2.0 * p.prior_std)
    assert full.expand_estimate(replace(p, prior=False)) == full.expand_estimate(full[OFFSET])


@pytest.mark.parametrize("name", [EXAMPLE, "workshop"])
def test_intervals_cover_scaled_errors_and_mountings(name):
    """Three and nine contrasts; `tests/benchmarks/few_contrasts.py` has more machines."""
    machines, count = LinearMachines(session_of(name)), 1000
    covered, (low, high) = machines.cover(2.83, count), coverage_band(count)
    for kind in (machines.is_scaled, machines.is_offset, machines.is_mounting):
        assert low <= count * covered[kind].mean() <= high


def test_compare_refits_and_files_have_the_same_factor(session, full, offsets, tmp_path):
    options = SolverOptions("variable-projection")
    compared = compare_models(session, models=["offsets"], options=options).results[0].calibration
    again = repeat_calibration(offsets, restore_session(offsets))
    for other in (compared, again):
        assert other.expanded_uncertainties == pytest.approx(offsets.expanded_uncertainties)
    loaded = load_calibration(write_calibration(full, tmp_path / "calibration.json"))
    assert loaded.tolerance_scale == full.tolerance_scale
    assert loaded.expanded_uncertainties == pytest.approx(full.expanded_uncertainties)


@pytest.mark.slow
def test_intervals_contain_the_truth_of_worse_machines(session):
    """A sample; `tests/benchmarks/worse_machines.py` has more machines, and the full model."""
    count = 8
    outcome = calibrate_machines(session, "offsets", factor=2.83, count=count, profile=[OFFSET])
    # three offsets of a machine are wrong together
    judged = outcome.covered[outcome.found]
    assert judged.all(axis=1).sum() >= binom.ppf(0.001, len(judged), 0.9)
    assert (outcome.profiled[:, 0] == outcome.covered[:, 0]).all()
    low, high = coverage_band(outcome.mounted.size)
    assert low <= outcome.mounted.sum() <= high
    low, high = binom.interval(0.997, count, 0.54)
    assert low <= outcome.found.sum() <= high
    assert outcome.ratio < WITHIN
