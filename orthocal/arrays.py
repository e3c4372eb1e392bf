"""Types of arrays, three numbers, and a cache of arrays."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
Indices: TypeAlias = NDArray[np.int64]
Mask: TypeAlias = NDArray[np.bool_]

Triple = tuple[float, float, float]


def triple(values: Sequence[float] | Array, unit: float = 1.0) -> Triple:
    """Three numbers in a unit, in SI."""
    x, y, z = (float(v) * unit + 0.0 for v in values)
    return x, y, z


class ArrayCache:
    """Cache of the most recently used arrays.

    Args:
        size: Largest number of arrays.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._cached: dict[Hashable, Array] = {}

    def find(self, key: Hashable, compute: Callable[[], Array]) -> Array:
        """Copy of the array of a key, computed if it is not cached."""
        array = self._cached.pop(key, None)
        if array is None:
            array = compute()
        self._cached[key] = array
        while len(self._cached) > self._size:
            self._cached.pop(next(iter(self._cached)), None)
        return np.array(array)
