"""Profile-likelihood intervals: linear problems have Student's, others their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibrated import identified
from gauges import exact
from scipy.optimize import least_squares

from orthocal import Choice
from orthocal.errors import NotIdentifiableError, ParameterError
from orthocal.estimation.diagnostics.profile_likelihood import END_TOLERANCE, profile_interval
from orthocal.estimation.fit import fit_problem
from orthocal.estimation.problem import build_problem
from orthocal.statistics.chance import confidence_factor
from orthocal.statistics.zeros import project_out_zeros


def test_nearly_linear_problems_have_students_interval(raw_cycles):
    result = identified(raw_cycles, profile=["x_slide.offset"])
    p = result["x_slide.offset"]
    # that of the readings' scatter, and beside it what errors that were not free may have done
    bias, known = result.unmodelled.bias_covariance[0, 0], result.model_covariance[0, 0]
    assert bias > 100.0 * known
    half = 2.0 * np.hypot(np.sqrt(known), np.sqrt(bias))
    assert p.interval == pytest.approx((p.value - half, p.value + half), abs=0.01 * half)
    half = result.expanded_uncertainties[0]
    assert p.interval == pytest.approx((p.value - half, p.value + half), abs=1e-3 * half)
    assert result["y_slide.offset"].interval is None


def test_ends_of_an_interval_have_the_expected_cost_by_another_solver(experiment_2):
    """SciPy on the reduced problem, the offset held at the ends of its interval."""
    fit = fit_problem(build_problem(experiment_2, model="offsets"))
    problem, sigma = fit.problem, fit.noise.sigma
    factor = confidence_factor(fit.noise.dof)

    def cost(held=None):
        def residuals(x):
            theta = x * 1e-3 if held is None else np.r_[x[:1] * 1e-3, held, x[1:] * 1e-3]
            left = problem.values - problem.predict(theta)
            return project_out_zeros(left, problem.observations) / sigma

        start = np.zeros(3 if held is None else 2)
        return least_squares(residuals, start, x_scale=0.1, xtol=1e-12).cost

    best = cost()
    half = factor * np.sqrt(fit.covariance()[1, 1])
    for end in profile_interval(fit, "y_slide.offset", uncertainty=half):
        assert 2.0 * (cost(end) - best) == pytest.approx(factor**2, rel=5e-3)


def test_the_interval_of_a_nonlinear_problem_is_not_symmetric(experiment_2):
    """At 99.9 % and three degrees of freedom the interval is 10 mm wide."""
    fit = fit_problem(build_problem(exact(experiment_2), model="offsets"))
    p = fit.solution.theta[0]
    half = confidence_factor(fit.noise.dof, 0.999) * np.sqrt(fit.covariance()[0, 0])
    low, high = profile_interval(fit, "x_slide.offset", uncertainty=half)
    skew = (high + low - 2 * p) / (high - low)
    assert abs(skew) > 10.0 * END_TOLERANCE / confidence_factor(fit.noise.dof, 0.999)
    assert (high - low) / 2 == pytest.approx(half, rel=1e-3)


def test_a_bound_ends_an_interval(experiment_2):
    result = identified(
        experiment_2,
        Choice(bounds={"x_slide.offset_m": (-1e-3, 0.5e-3)}),
        profile=["x_slide.offset"],
    )
    assert result["x_slide.offset"].interval == pytest.approx((-1e-3, 0.5e-3))


def test_the_interval_with_a_prior_is_that_of_the_posterior(raw_cycles):
    result = identified(raw_cycles, "lengths", profile=["x_leg.length"])
    p = result["x_leg.length"]
    i = [q.name for q in result.free].index(p.name)
    bias = np.sqrt(result.unmodelled.bias_covariance[i, i])
    std = np.sqrt(result.model_covariance[i, i])
    half = 2.0 * np.hypot(std, bias)
    assert p.interval == pytest.approx((p.value - half, p.value + half), abs=0.02 * half)


def test_without_noise_or_a_free_parameter_there_is_no_interval(experiment_2):
    rows = tuple(experiment_2.readings[i] for i in (2, 0, 4))
    session = replace(experiment_2, readings=rows).with_gauge(
        replace(experiment_2.gauge, sigma=None)
    )
    with pytest.raises(NotIdentifiableError, match="the noise is unknown"):
        identified(session, profile=["x_slide.offset"])
    with pytest.raises(ParameterError, match="no free parameter to find the interval of"):
        identified(experiment_2, profile=["x_leg.length"])


def test_a_profiled_parameter_is_checked_before_the_fit(experiment_2):
    with pytest.raises(ParameterError, match="no free parameter to find the interval of"):
        # the readings do not determine these lengths without tolerances
        identified(experiment_2, Choice("lengths", prior=False), profile=["x_slide.scale"])
