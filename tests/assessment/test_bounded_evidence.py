"""Evidence of a model with errors that are never negative, by integration and by sampling."""

from __future__ import annotations

import math

import numpy as np
import pytest
from effect_plans import effect_plan
from scipy.integrate import quad
from scipy.stats import multivariate_normal, norm

from orthocal import simulate_session
from orthocal.assessment.recommendation import TRIAL_SCALES, compute_log_evidence
from orthocal.estimation.selection import complete_model
from orthocal.hypotheses.likelihood import build_likelihood
from orthocal.hypotheses.linear_model import linear_model
from orthocal.hypotheses.linearisation import ModelLinearisation
from orthocal.statistics.distributions import log_positive_share, log_positive_share_of_independent

DRAWS = 200_000


def test_the_share_of_one_variable_is_that_of_its_distribution():
    for mean in (-30.0, -3.0, 0.0, 0.5, 9.0):
        assert log_positive_share(np.array([mean]), np.array([[4.0]])) == pytest.approx(
            norm.logcdf(mean / 2.0), rel=1e-12
        )


@pytest.mark.parametrize("size", [2, 3, 6])
def test_the_share_of_several_variables_is_that_of_draws(size):
    rng = np.random.default_rng(size)
    root = rng.normal(size=(size, size + 1))
    covariance, mean = root @ root.T, rng.normal(size=size) + 0.5
    drawn = rng.multivariate_normal(mean, covariance, size=DRAWS)
    share = (drawn > 0.0).all(axis=1).mean()
    error = 4.0 * math.sqrt(share / DRAWS) + share * 0.01
    assert math.exp(log_positive_share(mean, covariance)) == pytest.approx(share, abs=error)
    alone = norm.logcdf(mean / np.sqrt(np.diag(covariance))).sum()
    assert log_positive_share_of_independent(mean, 2.0) == pytest.approx(
        norm.logcdf(mean / 2.0).sum()
    )
    apart = np.diag(np.diag(covariance))
    assert log_positive_share(mean, apart) == pytest.approx(alone, abs=1e-3)


@pytest.mark.parametrize("correlation", [-0.4, 0.5, 0.96])
@pytest.mark.parametrize("mean", [(2.0, -2.0), (1.5, 0.0, -1.5), (3.0, -2.0, 1.0)])
def test_the_share_of_correlated_variables_is_that_of_scipy(mean, correlation):
    covariance = np.full((len(mean), len(mean)), correlation)
    np.fill_diagonal(covariance, 1.0)
    expected = multivariate_normal.logcdf(mean, cov=covariance)
    assert log_positive_share(np.array(mean), covariance) == pytest.approx(expected, abs=5e-3)


@pytest.mark.parametrize("true", [-0.7, 0.1, 2.0])
@pytest.mark.parametrize(("scale", "reference"), [(1.0, 0.0), (2.5, 0.0), (2.5, 1.3)])
def test_the_evidence_of_one_parameter_is_its_integral(true, scale, reference):
    """y = J b + n with b ≥ 0 normal about a reference, in one dimension by quadrature."""
    rng = np.random.default_rng(3)
    jacobian, sigma = rng.normal(size=(7, 1)), 0.8
    readings = true * jacobian[:, 0] + sigma * rng.normal(size=7)
    likelihood = build_likelihood(jacobian, sigma=sigma, dof=7, stated=True)
    zero = np.zeros(7)
    about = ModelLinearisation(zero, jacobian, jacobian, likelihood, np.zeros(1), zero)
    deviation, mean = readings - reference * jacobian[:, 0], np.array([reference])
    gain = about.log_positive_share(
        deviation, np.array([True]), mean, tolerance_scale=scale, noise_scale=1.0
    )
    covariance = scale**2 * jacobian @ jacobian.T + sigma**2 * np.eye(7)
    found = multivariate_normal(zero, covariance).logpdf(deviation) + gain

    noise, prior = norm(0.0, sigma), norm(reference, scale)
    share = prior.sf(0.0)

    def density(b):
        return noise.pdf(readings - jacobian[:, 0] * b).prod() * prior.pdf(b) / share

    expected, _ = quad(density, 0.0, 12.0 * scale, epsabs=0.0, epsrel=1e-10, limit=200)
    assert found == pytest.approx(math.log(expected), abs=1e-8)


@pytest.fixture(scope="module")
def backlash():
    errors = {"y_slide.backlash": 30e-6, "x_slide.backlash": 10e-6, "x_slide.offset": 0.1e-3}
    return simulate_session(effect_plan("backlash"), errors, seed=4).session


def test_the_evidence_of_a_session_is_that_of_drawn_backlash(backlash):
    """Mean over half-normal draws of the density with all other errors integrated out."""
    scale = float(TRIAL_SCALES[28])
    model = linear_model(backlash, complete_model(backlash.robot.parameters))
    near = model.most_likely(backlash.values)
    about = model.linearise(near.theta, (), near.passive, keep_jacobian=True)
    deviation = model.entries(backlash.values[None])[0] - about.expected
    positive = np.array([p.positive for p in model.problem.parameters])
    assert positive.sum() == 3
    _, by_scale = compute_log_evidence(backlash, complete_model(backlash.robot.parameters))
    found = float(by_scale[28])

    # coordinates in the space without gauge zeros
    values, vectors = np.linalg.eigh(np.eye(deviation.size) - _zero_means(model))
    within = vectors[:, values > 0.5]
    others = scale * within.T @ about.jacobian[:, ~positive]
    covariance = others @ others.T + model.sigma**2 * np.eye(within.shape[1])
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, within.T @ deviation)
    slopes = np.linalg.solve(root, within.T @ about.jacobian[:, positive])
    # draws of the prior over those of a normal distribution about the estimate
    normal = slopes.T @ slopes + np.eye(3) / scale**2
    estimate = np.linalg.solve(normal, slopes.T @ white)
    proposal = multivariate_normal(estimate, 2.0 * np.linalg.inv(normal))
    drawn = proposal.rvs(size=DRAWS, random_state=1)
    prior = math.log(8.0) + norm(0.0, scale).logpdf(drawn).sum(axis=1)
    prior[(drawn < 0.0).any(axis=1)] = -np.inf
    logs = -0.5 * ((white - drawn @ slopes.T) ** 2).sum(axis=1) + prior - proposal.logpdf(drawn)
    expected = np.logaddexp.reduce(logs) - math.log(DRAWS)
    expected -= np.log(np.diag(root)).sum()  # the likelihood omits the constant of 2π as well
    assert found == pytest.approx(expected, abs=0.03)


def _zero_means(model):
    incidence = model.problem.zero_incidence
    dense = incidence.toarray() if hasattr(incidence, "toarray") else np.asarray(incidence)
    return dense / dense.sum(axis=0) @ dense.T
