"""Intervals of parameters that are bounded or never negative, by sampling."""

from __future__ import annotations

import math

import numpy as np
import pytest
from calibrated import calibrated, session_of
from effect_plans import effect_plan
from scipy.stats import norm

from orthocal import Choice, simulate_session
from orthocal.calibration.identify import identify
from orthocal.calibration.tables import parameter_table
from orthocal.estimation.problem import build_problem
from orthocal.statistics.chance import bounded_interval
from orthocal.statistics.zeros import project_out_zeros

COVERED = math.erf(math.sqrt(2.0))
"""Share of a normal distribution within two standard deviations, 0.954."""


@pytest.mark.parametrize(
    ("value", "lower", "upper"),
    [
        (0.0, 0.0, 9.0),
        (0.5, 0.0, np.inf),
        (1.9, 0.0, np.inf),
        (0.5, -0.7, 0.6),
        (0.5, -np.inf, 1.5),
    ],
)
def test_an_interval_covers_its_share_of_the_truncated_distribution(value, lower, upper):
    low, high = bounded_interval(value, 2.0, lower, upper)
    cdf = norm(value, 1.0).cdf
    assert lower <= low <= value <= high <= upper
    assert (cdf(high) - cdf(low)) / (cdf(upper) - cdf(lower)) == pytest.approx(COVERED, rel=1e-9)
    for inside, end in ((low > lower, low), (high < upper, high)):
        if inside:  # the shortest interval has equally distant ends, or one end is a bound
            other = low + high - end
            assert abs(end - value) >= abs(other - value) - 1e-9


def test_without_bounds_the_interval_is_the_value_and_its_uncertainty():
    assert bounded_interval(1.0, 0.3, -np.inf, np.inf) == pytest.approx((0.7, 1.3), rel=1e-9)
    assert bounded_interval(1.0, 0.3, -5.0, np.inf) == pytest.approx((0.7, 1.3), rel=1e-9)
    assert bounded_interval(1.0, 0.0, 1.0, 2.0) == (1.0, 1.0)  # held at a bound
    assert np.isnan(bounded_interval(1.0, np.nan, 0.0, np.inf)).all()


def test_a_bound_of_the_user_ends_an_interval():
    free = calibrated("raw-cycles", "offsets")
    value = free["x_slide.offset"].value
    low, high = free.intervals[0]
    bounds = {"x_slide.offset_m": (value - 0.5 * (value - low), 1.0)}
    choice = Choice("offsets", bounds=bounds)
    held, _ = identify(session_of("raw-cycles"), choice, solver="variable-projection")
    assert held["x_slide.offset"].at_bound is None
    assert held.intervals[0][0] == pytest.approx(bounds["x_slide.offset_m"][0])
    assert held.intervals[0][1] < high


@pytest.mark.parametrize("sizes", [(8e-6, 0.0, 30e-6), (0.0, 0.0, 0.0)])
def test_intervals_of_backlash_contain_its_posterior(sizes):
    """Draws from the posterior by the normal equations, without negative ones."""
    plan = effect_plan("backlash")
    errors = {f"{a}_slide.backlash": size for a, size in zip("xyz", sizes, strict=True)}
    session = simulate_session(plan, {**errors, "x_slide.offset": 0.1e-3}, seed=1).session
    found, _ = identify(session, "full", solver="variable-projection")

    problem = build_problem(session, model="full", prior=True)
    theta = np.array([p.value for p in (*found.free, *found.sensors)])
    prediction, jacobian = problem.predict_and_jacobian(theta)
    o, sigma, scaled = problem.observations, found.noise.sigma, theta / problem.theta_scale
    residual = project_out_zeros(problem.values - prediction, o) / sigma
    jacobian = project_out_zeros(jacobian, o) / sigma
    covariance = np.linalg.inv(jacobian.T @ jacobian + np.eye(theta.size))
    mean = scaled + covariance @ (jacobian.T @ residual - scaled)
    index = [i for i, p in enumerate(problem.parameters) if p.positive]
    assert len(index) == 3
    rng = np.random.default_rng(1)
    drawn = rng.multivariate_normal(mean[index], covariance[np.ix_(index, index)], size=200_000)
    drawn = drawn[(drawn >= 0.0).all(axis=1)] * problem.theta_scale[index]
    assert len(drawn) > 1000
    table = {row["name"]: row for row in parameter_table(found)}
    for name, values in zip((problem.free[i] for i in index), drawn.T, strict=True):
        low, high = table[name]["low"], table[name]["high"]
        assert 0.0 <= low <= found[name].value <= high
        assert ((values >= low) & (values <= high)).mean() > 0.94, name
