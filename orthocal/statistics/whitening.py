"""Numbers that vary together, turned into such that vary by one each and by themselves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def whiten(values: Array, spread: Array, *, sigma: float) -> Array:
    """V^(-1/2) times values, V = σ² I + S Sᵀ.

    Args:
        values: Shape (n,) or (n, k).
        spread: S, a root of what is common to several of them, shape (n, m).
        sigma: Standard deviation of each by itself, [as the values].
    """
    directions, sizes, _ = np.linalg.svd(spread, full_matrices=False)
    shrunk = 1.0 - 1.0 / np.sqrt(1.0 + (sizes / sigma) ** 2)
    common = (directions.T @ values).T * shrunk
    return np.asarray((values - directions @ common.T) / sigma)
