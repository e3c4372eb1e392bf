"""The order of measuring: from where the gauge is set through all postures with little movement."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def order_postures(points: Array) -> list[int]:
    """A short way through points that begins and ends at the first one.

    The nearest one first, then turned about wherever that shortens it (2-opt).

    Args:
        points: Tool positions, shape (n, n_coordinates), [m].
    """
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    way, rest = [0], set(range(1, len(points)))
    while rest:
        nearest = min(rest, key=lambda i: (distance[way[-1], i], i))
        way.append(nearest)
        rest.remove(nearest)
    shorter = True
    while shorter:
        shorter = False
        for i in range(1, len(way) - 1):
            for j in range(i + 1, len(way)):
                other = way[:i] + way[i : j + 1][::-1] + way[j + 1 :]
                if _length(other, distance) < _length(way, distance) - 1e-12:
                    way, shorter = other, True
    return way


def _length(way: list[int], distance: Array) -> float:
    return float(sum(distance[a, b] for a, b in pairwise([*way, way[0]])))
