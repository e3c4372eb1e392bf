"""Exact elimination of gauge zeros.

The optimal gauge zero of several readings is their mean. Therefore the mean over all entries with
the same zero is subtracted from readings and Jacobians. With correlated readings it is their
weighted mean.
"""

from __future__ import annotations

import numpy as np

from orthocal.arrays import Array
from orthocal.observation.observations import Observations


def project_out_zeros(
    values: Array, observations: Observations, *, weights: Array | None = None
) -> Array:
    """Subtract the mean over all entries with the same free gauge zero, shape (n_entries, ...).

    Entries with a known zero do not change.

    Args:
        values: Readings or derivatives of the entries, shape (n_entries, ...).
        observations: Entries with their gauge zeros.
        weights: Weights of the entries in the means, shape (n_entries,); 1 by default.
    """
    flat = values.reshape(len(values), -1)
    weight = np.ones(len(values)) if weights is None else weights
    totals = observations.sum_by_zero(flat, weight)
    counts = np.bincount(observations.zero, weight, minlength=observations.n_zeros)
    means = totals / np.where(counts > 0.0, counts, 1.0)[:, None]
    means[observations.zero_known] = 0.0
    return np.asarray((flat - means[observations.zero]).reshape(values.shape))


def zero_shares(observations: Observations) -> Array:
    """Share of one entry in each free gauge zero, 0 for known zeros, shape (n_zeros,).

    Residuals of independent entries of variance σ² have the variance (1 − share) σ².
    """
    counts = np.bincount(observations.zero, minlength=observations.n_zeros).astype(np.float64)
    free = (counts > 0.0) & ~observations.zero_known
    return np.divide(1.0, counts, out=np.zeros_like(counts), where=free)


def eliminate_zero(weights: Array) -> tuple[Array, Array, float]:
    """Weights of readings after the elimination of their common free zero.

        P = W − W 1 1ᵀ W / (1ᵀ W 1)

    A zero with a large prior variance gives the same, but with large rounding errors.

    Args:
        weights: Inverse covariance W of the readings, shape (k, k), [1/m²].

    Returns:
        P, shape (k, k), [1/m²]; the weights W 1 / (1ᵀ W 1) of the readings in the zero, shape (k,);
        and the variance of the zero, 1 / (1ᵀ W 1), [m²].
    """
    sums = weights.sum(axis=1)
    variance = 1.0 / float(sums.sum())
    return weights - np.outer(sums, sums) * variance, sums * variance, variance
