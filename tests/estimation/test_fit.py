"""Bounds, known values and robust fits of real problems against other ways to the same numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibrated import UNJUDGED, identified
from models import TRUTH
from scipy.optimize import lsq_linear
from tolerances import SAME_OPTIMUM

from orthocal import Choice, SolverOptions, calibrate, load_plan, simulate_session
from orthocal.estimation.fit import fit_problem
from orthocal.estimation.linear import linearise_problem
from orthocal.estimation.loss import Loss
from orthocal.estimation.problem import build_problem
from orthocal.estimation.solvers.batch import BatchSolver
from orthocal.estimation.solvers.ipopt import NonlinearProgram
from orthocal.session.session import Gauge
from orthocal.statistics.information import decompose
from orthocal.statistics.zeros import project_out_zeros

LINEAR = 0.02e-3
"""[m] Exact against linearised offsets, at offsets of a millimetre."""


@pytest.fixture(scope="module")
def session(exact_plan):
    return simulate_session(exact_plan, TRUTH, seed=11).session


def test_a_bound_holds_a_parameter_and_changes_the_others(session):
    """As the linear problem with the same bounds, to what linearising costs."""
    bounds = {"x_slide.offset": (-1e-3, 0.9e-3)}
    fit = fit_problem(build_problem(session, bounds=bounds, model="offsets"))
    assert list(fit.solution.at_bound) == [1, 0, 0]
    assert fit.solution.theta[0] == pytest.approx(0.9e-3, abs=1e-8)
    linear = linearise_problem(build_problem(session, model="offsets"))
    scaled = [[low / 5e-3, *[end] * 2] for low, end in ((-1e-3, -np.inf), (0.9e-3, np.inf))]
    expected = lsq_linear(linear.jacobian, linear.residual, bounds=scaled, tol=1e-15).x * 5e-3
    assert np.abs(fit.solution.theta - expected).max() < LINEAR
    assert fit.linearised_theta == pytest.approx(expected, abs=1e-9)


def test_a_parameter_at_its_bound_acts_like_a_known_value(session):
    bounded = identified(session, Choice(bounds={"x_slide.offset_m": (-1e-3, 0.9e-3)}))
    known = identified(session, Choice(known={"x_slide.offset_m": 0.9e-3}))
    p = bounded["x_slide.offset"]
    assert p.at_bound == "upper"
    assert p.std == 0.0
    assert bounded.noise.residual_dof == known.noise.residual_dof  # two parameters are fitted
    for name in ("y_slide.offset", "z_slide.offset"):
        assert bounded[name].value == pytest.approx(known[name].value, abs=1e-8)
        assert bounded[name].std == pytest.approx(known[name].std, rel=1e-3)


def test_a_parameter_beside_its_bound_is_not_held_by_it(experiment_2):
    """y is best at −0.0948 mm while x and z are held: 5 µm from a bound that does not hold it."""
    narrow = identified(experiment_2, Choice(bounds={"*.offset_m": (-1e-4, 1e-4)}))
    others = {f"{k}_slide.offset_m": (-1e-4, 1e-4) for k in "xz"}
    free = identified(experiment_2, Choice(bounds=others))
    assert [p.at_bound for p in narrow.free] == ["lower", None, "lower"]
    assert all(p.lower <= p.value <= p.upper for p in narrow.free)
    found, expected = narrow["y_slide.offset"], free["y_slide.offset"]
    assert found.value == pytest.approx(expected.value, abs=1e-8)
    assert found.std == pytest.approx(expected.std, rel=1e-4)
    assert 0.0 < found.value + 1e-4 < 1e-5


def test_a_known_value_with_its_tolerance_is_weighed_with_the_readings(session):
    """Precisions add: the hand-made mean of what the readings and the drawing say."""
    alone = fit_problem(build_problem(session, free=["*.offset"]))
    sigma = alone.sigma
    i, value, spread = 0, 1.0e-3, 3e-6
    own = alone.covariance()
    gain = own[:, i] / (own[i, i] + spread**2)
    expected = alone.solution.theta + gain * (value - alone.solution.theta[i])
    problem = build_problem(session, known={"x_slide.offset": (value, spread)}, model="offsets")
    found = NonlinearProgram(problem).solve(sigma=sigma)
    assert np.abs(found.theta - expected).max() < 0.05 * spread
    fit = fit_problem(problem)
    scale = (fit.sigma / sigma) ** 2
    precision = 1.0 / (own[i, i] * scale) + 1.0 / spread**2
    assert fit.covariance()[i, i] == pytest.approx(1.0 / precision, rel=1e-3)


def test_the_robust_covariance_is_that_of_many_simulated_calibrations(exact_plan):
    """Huber's loss on normal noise: whitened errors are standard normal."""
    sigma = 20e-6
    problem = build_problem(exact_plan, model="offsets")
    options = SolverOptions(loss=Loss("huber"))
    entries = problem.predict(np.array(list(TRUTH.values())))
    rng, white, loss = np.random.default_rng(0), [], Loss("huber")
    truth, o = np.array(list(TRUTH.values())), problem.observations
    _, jacobian = problem.predict_and_jacobian(truth)
    information = decompose(jacobian, o)
    measured = entries + sigma * rng.normal(size=(200, entries.size))
    solved = BatchSolver(problem, options=options).solve(measured, sigma=sigma)
    predicted, _, _ = problem.simulate(solved.theta)
    for left, theta in zip(measured - predicted, solved.theta, strict=True):
        residual = project_out_zeros(left, o) / sigma
        covariance = information.posterior(
            sigma=sigma,
            precision=problem.prior_precision,
            loss=(loss.gain(residual, used=3 + o.n_zeros), loss.normal_square),
        ).covariance
        error = (theta - truth) / problem.theta_scale
        white.append(np.linalg.solve(np.linalg.cholesky(covariance), error))
    # 99 % of means of 600 squares are within 15 %
    assert np.mean(np.square(white)) == pytest.approx(1.0, abs=0.15)


def test_readings_without_deviation_are_explained(exact_plan):
    still = calibrate(simulate_session(exact_plan, {}, exact=True).session, **UNJUDGED)
    (found,) = still.assessment.of_kind("no deviation")
    assert found.numbers["before_rms_mm"] == pytest.approx(0.0, abs=1e-9)


def test_parameters_without_sensitivity_are_explained(session):
    """The platform's own placement is seen by no reading of leg x alone."""
    result = calibrate(session, Choice(free=["frame.tcp.*"]), **UNJUDGED)
    (found,) = result.assessment.of_kind("no sensitivity")
    assert not result.assessment.of_kind("no deviation")
    assert {p.parameter for p in found.places} == {p.name for p in result.free}
    assert "effects of all free parameters on the readings are below the noise" in found.text
    assert set(result.identifiability.below_noise) == {p.name for p in result.free}


def test_noise_that_does_not_converge_is_reported(session, monkeypatch):
    """Without tolerance no two estimates agree, so that all rounds end without convergence."""
    assert identified(session, "lengths").solver.noise_converged
    monkeypatch.setattr("orthocal.estimation.fit.SIGMA_TOLERANCE", 0.0)
    result = calibrate(session, "lengths", **UNJUDGED)
    assert not result.solver.noise_converged
    (finding,) = result.assessment.of_kind("no convergence")
    assert finding.severity == "note"
    assert finding.numbers["sigma_mm"] == pytest.approx(result.noise.sigma * 1e3)


@pytest.mark.parametrize(("resolution", "sigma"), [(None, 10e-6), (1e-6, 10.004e-6)])
def test_an_unknown_noise_is_assumed(raw_cycles, resolution, sigma):
    """The last sigma of the iteration, here 3 µm, is that of residuals without freedom."""
    rows = tuple(r for r in raw_cycles.readings if r.cycle == 1)
    once = replace(raw_cycles, readings=rows).with_gauge(Gauge(None, resolution))
    problem = build_problem(once, model="full")
    options = SolverOptions(solver="variable-projection")
    fit = fit_problem(problem, options=options)
    assert fit.noise.source == "unknown"
    assert fit.sigma == pytest.approx(sigma, rel=1e-4)
    again = fit.program.solve(sigma=fit.sigma)
    assert np.abs((again.theta - fit.solution.theta) / problem.theta_scale).max() < SAME_OPTIMUM


def test_readings_are_weighted_by_the_scatter_of_their_gauge(root):
    """One gauge scatters ten times as much as stated, which only the residuals show."""
    plan = load_plan(root / "examples/sweep/plan.yaml")
    setups = {
        name: replace(s, gauge="noisy" if i % 2 else "good")
        for i, (name, s) in enumerate(plan.setups.items())
    }

    def with_gauges(session, noisy):
        gauges = {"good": Gauge(5e-6), "noisy": Gauge(noisy)}
        return build_problem(replace(session, setups=setups, gauges=gauges), model="offsets")

    exact = simulate_session(plan, TRUTH, sigma=1e-12).session
    sigmas = [50e-6 if setups[r.setup].gauge == "noisy" else 5e-6 for r in plan.readings]
    noise = np.random.default_rng(1).normal(size=len(sigmas)) * sigmas
    session = exact.with_values(exact.values + noise)
    found = fit_problem(with_gauges(session, 5e-6))
    good, noisy = (noises.sigma for noises in found.noises.gauges)
    assert good == pytest.approx(5e-6)
    assert noisy == pytest.approx(50e-6, rel=0.2)  # of 81 readings
    known = fit_problem(with_gauges(session, noisy))
    assert found.solution.theta == pytest.approx(known.solution.theta, abs=1e-8)
    unweighted = NonlinearProgram(with_gauges(session, 5e-6)).solve(sigma=5e-6)
    assert np.abs(unweighted.theta - known.solution.theta).max() > 1e-6


def test_the_rounding_of_one_gauge_is_not_the_noise_of_another(raw_cycles):
    """Few readings of a gauge that states nothing, and of a dial that is read to 0.1 mm."""
    setups = {
        name: replace(s, gauge="coarse" if i % 2 else "silent")
        for i, (name, s) in enumerate(raw_cycles.setups.items())
    }
    rows = tuple(r for r in raw_cycles.readings if r.cycle == 1)
    gauges = {"silent": Gauge(), "coarse": Gauge(resolution=1e-4)}
    session = replace(raw_cycles, setups=setups, gauges=gauges, readings=rows)
    options = SolverOptions(solver="variable-projection")
    silent, _ = fit_problem(build_problem(session, model="full"), options=options).noises.gauges
    assert silent.source != "gauge"
    assert silent.dof < np.inf


def test_correlations_are_those_of_the_covariance(session):
    result = identified(session)
    covariance = result.model_covariance
    expected = covariance / np.outer(np.sqrt(np.diag(covariance)), np.sqrt(np.diag(covariance)))
    assert result.correlation == pytest.approx(expected)
    assert result.correlated(above=0.2)[0][2] == pytest.approx(-0.25, abs=0.02)
    assert result.correlated(above=0.5) == ()


def test_the_data_share_of_each_parameter(session):
    """It is 0 for a length whose uncertainty exceeds its prior because of other errors."""
    p = identified(session, "full")["x_slide.offset"]
    assert p.data_share == pytest.approx(1.0 - (p.std / p.prior_std) ** 2)
    assert 0.0 < p.data_share < 1.0
    worse = identified(session, "lengths")["x_leg.length"]
    assert worse.std > worse.prior_std
    assert worse.data_share == 0.0
    assert np.isnan(identified(session)["x_slide.offset"].data_share)
