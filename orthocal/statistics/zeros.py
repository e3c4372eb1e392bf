"""Exact elimination of gauge zeros.

The optimal gauge zero of several readings is their mean. Therefore the mean over all entries with
the same zero is subtracted from readings and Jacobians.
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
