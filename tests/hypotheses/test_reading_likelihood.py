"""How likely readings are, against covariances written out."""

from __future__ import annotations

import numpy as np
import pytest

from orthocal.hypotheses.likelihood import (
    AMOUNTS,
    EXCESSES,
    NOISES,
    likelihood_of,
    log_of_sum,
)

N, ERRORS, SIGMA = 7, 3, 0.8


@pytest.fixture(scope="module")
def case():
    rng = np.random.default_rng(4)
    slopes = rng.normal(size=(N, ERRORS))
    likelihood, _, _ = likelihood_of(slopes, sigma=SIGMA, dof=N, stated=True)
    return slopes, likelihood, rng.normal(size=(5, N)), rng.normal(size=(5, N))


def log_normal(covariance, deviation):
    square = deviation @ np.linalg.solve(covariance, deviation)
    return -0.5 * (square + np.linalg.slogdet(2.0 * np.pi * covariance)[1])


def written_out(slopes, likelihood, deviation, wrong=None):
    """Σ w N(y; 0, e² A Aᵀ + s² σ² + τ² D Dᵀ), over all e, s, and over all τ."""
    logs = []
    pairs = [(e, s) for e in EXCESSES for s in NOISES]
    for (e, s), weight in zip(pairs, likelihood.weights, strict=True):
        covariance = e**2 * slopes @ slopes.T + (s * SIGMA) ** 2 * np.eye(N)
        for amount in AMOUNTS if wrong is not None else (0.0,):
            more = 0.0 if wrong is None else (amount * SIGMA) ** 2 * wrong.T @ wrong
            share = np.log(AMOUNTS.size) if wrong is not None else 0.0
            logs.append(weight - share + log_normal(covariance + more, deviation))
    return float(log_of_sum(np.array(logs))) + N / 2.0 * np.log(2.0 * np.pi)


def test_weights_of_what_is_not_known_add_up_to_one(case):
    assert np.exp(case[1].weights).sum() == pytest.approx(1.0)


def test_readings_are_weighed_as_by_their_covariance(case):
    slopes, likelihood, deviations, _ = case
    found = likelihood.weigh(deviations)
    assert found == pytest.approx([written_out(slopes, likelihood, d) for d in deviations])


def test_an_amount_that_is_not_known_is_a_variance(case):
    slopes, likelihood, deviations, wrong = case
    found = likelihood.weigh(deviations, wrong)
    told = [
        written_out(slopes, likelihood, d, w[None]) for d, w in zip(deviations, wrong, strict=True)
    ]
    assert found == pytest.approx(told)


def test_several_amounts_are_so_many_variances(case):
    slopes, likelihood, deviations, wrong = case
    found, amounts = likelihood.weigh_loose(deviations[0], wrong[:2])
    assert found == pytest.approx(written_out(slopes, likelihood, deviations[0], wrong[:2]))
    assert amounts.shape == (2,)


def test_readings_that_say_nothing_are_left_out(case):
    slopes, likelihood, deviations, _ = case
    kept, out = [0, 2, 3, 5, 6], [1, 4]
    found = likelihood.weigh_without(deviations[0], np.eye(N)[out])
    logs = []
    for k, (e, s) in enumerate((e, s) for e in EXCESSES for s in NOISES):
        own = slopes[kept]
        covariance = e**2 * own @ own.T + (s * SIGMA) ** 2 * np.eye(len(kept))
        logs.append(likelihood.weights[k] + log_normal(covariance, deviations[0][kept]))
    every = written_out(slopes, likelihood, deviations[0]) - N / 2.0 * np.log(2.0 * np.pi)
    assert found == pytest.approx(float(log_of_sum(np.array(logs))) - every)
