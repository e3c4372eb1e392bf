"""Marginal likelihoods against dense normal densities and numerical integration."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import Covariance, multivariate_normal

from orthocal.hypotheses.likelihood import (
    AMOUNT_STDS,
    NOISE_SCALES,
    SCALE_NODES,
    build_likelihood,
    log_of_sum,
)

N, ERRORS, SIGMA = 7, 3, 0.8
CONSTANT = N / 2.0 * np.log(2.0 * np.pi)
"""Omitted in all densities."""


@pytest.fixture(scope="module")
def case():
    rng = np.random.default_rng(4)
    jacobian = rng.normal(size=(N, ERRORS))
    likelihood = build_likelihood(jacobian, sigma=SIGMA, dof=N, stated=True)
    return jacobian, likelihood, rng.normal(size=(5, N)), rng.normal(size=(5, N))


def covariances(jacobian, n=N):
    return [
        e**2 * jacobian @ jacobian.T + (s * SIGMA) ** 2 * np.eye(n)
        for e in SCALE_NODES
        for s in NOISE_SCALES
    ]


def log_normal(deviation, covariance):
    factor = Covariance.from_cholesky(np.linalg.cholesky(covariance))
    return multivariate_normal(np.zeros(len(covariance)), factor).logpdf(deviation)


def dense(jacobian, likelihood, deviation, effects=None):
    """Σ w N(y; 0, e² J Jᵀ + s² σ² + τ² W Wᵀ) over all e, s and τ, by SciPy."""
    logs = []
    for weight, covariance in zip(likelihood.weights, covariances(jacobian), strict=True):
        for tau in AMOUNT_STDS if effects is not None else (0.0,):
            more = 0.0 if effects is None else (tau * SIGMA) ** 2 * effects.T @ effects
            share = 0.0 if effects is None else np.log(AMOUNT_STDS.size)
            density = log_normal(deviation, covariance + more)
            logs.append(weight - share + density)
    return float(log_of_sum(np.array(logs))) + CONSTANT


def test_prior_weights_add_up_to_one(case):
    assert np.exp(case[1].weights).sum() == pytest.approx(1.0)


@pytest.mark.parametrize("rows", [N, 3 * N])
def test_principal_directions_reproduce_the_covariance(rows):
    """Wide and tall Jacobians are decomposed differently."""
    jacobian = np.random.default_rng(1).normal(size=(rows, ERRORS))
    likelihood = build_likelihood(jacobian, sigma=SIGMA, dof=rows, stated=True)
    r = likelihood.directions
    assert r @ r.T == pytest.approx(np.eye(ERRORS), abs=1e-12)
    assert (r.T * likelihood.singular_values) @ likelihood.errors.T == pytest.approx(jacobian)
    assert (r.T * likelihood.variances) @ r == pytest.approx(jacobian @ jacobian.T)


def test_deviations_have_dense_normal_densities(case):
    jacobian, likelihood, deviations, _ = case
    found = likelihood.score(likelihood.products(deviations))
    assert found == pytest.approx([dense(jacobian, likelihood, d) for d in deviations])


def test_an_effect_of_unknown_amount_is_a_variance(case):
    jacobian, likelihood, deviations, effects = case
    deviations, effects = deviations[:2], effects[:2]
    cross = (deviations * effects).sum(axis=1)
    found = likelihood.score(likelihood.products(deviations), likelihood.products(effects), cross)
    expected = [
        dense(jacobian, likelihood, d, w[None]) for d, w in zip(deviations, effects, strict=True)
    ]
    assert found == pytest.approx(expected)
    one = likelihood.score_set(deviations[0], [effects[:1]])
    assert one.log_likelihood == pytest.approx(expected[0])


def test_a_group_of_effects_shares_one_prior(case):
    jacobian, likelihood, deviations, effects = case
    found = likelihood.score_set(deviations[0], [effects[:2]])
    assert found.log_likelihood == pytest.approx(
        dense(jacobian, likelihood, deviations[0], effects[:2])
    )
    assert found.amounts.shape == (2,)


def test_an_invisible_effect_has_no_amount(case):
    """Such as a displacement of the gauge before its first reading."""
    _, likelihood, deviations, effects = case
    nothing = np.zeros((1, N))
    alone = likelihood.score_set(deviations[0], [nothing])
    assert alone.log_likelihood == pytest.approx(likelihood.score_set(deviations[0]).log_likelihood)
    assert alone.amounts == pytest.approx([0.0], abs=1e-12)
    assert alone.stds[0] > 1e6 * SIGMA
    beside = likelihood.score_set(deviations[0], [nothing, effects[:1]])
    one = likelihood.score_set(deviations[0], [effects[:1]])
    assert beside.amounts[1] == pytest.approx(one.amounts[0], rel=1e-9)


def test_separate_effects_have_separate_priors(case):
    jacobian, likelihood, deviations, effects = case
    logs = []
    for weight, covariance in zip(likelihood.weights, covariances(jacobian), strict=True):
        for one in AMOUNT_STDS:
            for other in AMOUNT_STDS:
                scaled = SIGMA * np.array([[one], [other]]) * effects[:2]
                full = covariance + scaled.T @ scaled
                density = log_normal(deviations[0], full)
                logs.append(weight - 2.0 * np.log(AMOUNT_STDS.size) + density)
    found = likelihood.score_set(deviations[0], [effects[:1], effects[1:2]])
    assert found.log_likelihood == pytest.approx(float(log_of_sum(np.array(logs))) + CONSTANT)


def test_silent_rows_have_the_marginal_density_of_the_others(case):
    jacobian, likelihood, deviations, _ = case
    kept, silent = [0, 2, 3, 5, 6], [1, 4]
    informative = np.isin(np.arange(N), kept)
    restricted = likelihood.restricted(lambda v: v * informative, len(silent))
    found = restricted.score_set(deviations[0] * informative)
    logs = [
        weight + log_normal(deviations[0][kept], c[np.ix_(kept, kept)])
        for weight, c in zip(likelihood.weights, covariances(jacobian), strict=True)
    ]
    constant = len(kept) / N * CONSTANT
    assert found.log_likelihood == pytest.approx(float(log_of_sum(np.array(logs))) + constant)


def test_an_amount_without_prior_is_that_of_weighted_least_squares(case):
    jacobian, likelihood, deviations, effects = case
    inverse = np.linalg.inv(jacobian @ jacobian.T + SIGMA**2 * np.eye(N))
    information = effects[0] @ inverse @ effects[0]
    (amount, none), (std, unknown) = likelihood.estimate_amounts(
        deviations[0], np.array([effects[0], np.zeros(N)])
    )
    assert amount == pytest.approx(effects[0] @ inverse @ deviations[0] / information)
    assert std == pytest.approx(information**-0.5)
    assert (none, unknown) == (0.0, np.inf)
