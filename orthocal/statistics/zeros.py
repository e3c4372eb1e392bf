"""Gauge zeros, eliminated exactly.

A zero that several readings share takes their mean, so what is left of readings and Jacobians is
their deviation from the mean of their zero.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthocal.observation.observations import Observations

Array = NDArray[np.float64]


def project_out_zeros(
    values: Array, observations: Observations, *, weights: Array | None = None
) -> Array:
    """Values minus the mean of those with the same free gauge zero, shape (n_entries, ...).

    Values with a known zero stay as they are.

    Args:
        values: Shape (n_entries, ...).
        observations: Which zero each entry has.
        weights: Of the entries in the means, shape (n_entries,); 1 by default.
    """
    flat = values.reshape(len(values), -1)
    own = np.ones(len(values)) if weights is None else weights
    totals = observations.sum_by_zero(flat, own)
    counts = np.bincount(observations.zero, own, minlength=observations.n_zeros)
    means = totals / np.where(counts > 0.0, counts, 1.0)[:, None]
    means[observations.zero_known] = 0.0
    return np.asarray((flat - means[observations.zero]).reshape(values.shape))
