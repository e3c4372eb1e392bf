"""A covariance without a decomposition is the one with it, and the inverse of what is known."""

from __future__ import annotations

import numpy as np
import pytest

from orthocal.statistics.information import Information, posterior_covariance


@pytest.mark.parametrize("rows", [4, 9, 40])
def test_a_posterior_is_the_inverse_of_what_readings_and_prior_say(rows):
    rng = np.random.default_rng(rows)
    factor, sigma = rng.normal(size=(rows, 6)), 0.3
    precision = np.array([1.0, 1.0, 1.0, 1e-3, 1.0, 1.0])
    found = posterior_covariance(factor, sigma=sigma, precision=precision)
    expected = np.linalg.inv(factor.T @ factor / sigma**2 + np.diag(precision))
    assert np.allclose(found, expected, rtol=1e-9, atol=1e-12)
    _, values, directions = np.linalg.svd(factor, full_matrices=True)
    padded = np.zeros(6)
    padded[: len(values)] = values
    whole = Information(factor, padded, directions)
    assert np.allclose(found, whole.covariance(sigma=sigma, precision=precision), rtol=1e-12)
