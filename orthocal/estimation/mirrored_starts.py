"""Mirrored start values of nuisance parameters that change readings only to second order.

An example is the height of a fixed ball over the plane in which the tool moves. Along a direction v
of θ̂ readings are

    h(θ̂ + t v) ≈ h(θ̂) + a t + ½ c t²

They are stationary at t = −a·c/c·c. If a vanishes there, both sides have almost the same readings,
and each may contain a local optimum. A solver that has found one of them starts again from its
mirror image.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array, Indices

Predict = Callable[[Array], Array]
"""Function from changes of θ̂, shape (k, n_free), to the readings of S machines after each change,
shape (S, k, n_entries), [noise-scaled m]."""

MAX_DISTANCE = 4.0
"""Largest distance of the stationary point from the nominal value, [prior std]."""

MAX_SLOPE = 0.5
"""Largest slope at the stationary point, as a fraction of the change of slope per prior std."""

MIN_CURVATURE = 1e-7
"""Norm of the curvature of all readings below which no sensor resolves it, [m per prior std²]."""

MIN_CURVATURE_RATIO = 2.0
"""Norm of the curvature, in standard deviations of a reading, below which both sides are not
compared. They then have one optimum, or optima that differ by less than the noise."""

NEAR = 0.5
"""Distance from the stationary point below which a solution counts as between both sides,
[prior std]."""

MAX_COMBINED = 4
"""Largest number of directions of which all combinations of sides are tried. Of more directions, at
most two change sides at once."""


@dataclass(frozen=True, slots=True, eq=False)
class MirroredDirections:
    """Directions of θ̂ that change readings only to second order."""

    directions: Array
    """Unit vectors v, shape (n_directions, n_free)."""
    curvatures: Array
    """Norms of c, shape (n_directions,), [noise-scaled m per prior std²]."""

    def __len__(self) -> int:
        """Number of directions."""
        return len(self.directions)

    def of_task(self, sigma: float, prescribed: Iterable[int]) -> Array:
        """Directions along which both sides may have an optimum, shape (n, n_free).

        Args:
            sigma: Standard deviation of one reading, [m].
            prescribed: Indices of parameters with prescribed values.
        """
        fixed = self.directions[:, list(prescribed)].any(axis=1)
        return self.directions[~fixed & (self.curvatures > MIN_CURVATURE_RATIO * sigma)]


def find_mirrored_directions(
    predict: Predict, vectors: Sequence[Indices], n_free: int
) -> MirroredDirections:
    """Directions of θ̂ that change readings of the nominal machine only to second order.

    Args:
        predict: Readings of the nominal machine.
        vectors: Indices of the free parameters that form a vector, such as the position of a ball.
        n_free: Number of free parameters.
    """
    directions, norms = [np.zeros((0, n_free))], [np.zeros(0)]
    coordinates = np.eye(n_free)[np.concatenate(vectors)]
    slopes, curvatures = (v[0] for v in _slopes_and_curvatures(predict, coordinates))
    parts = np.cumsum([len(index) for index in vectors])[:-1]
    for axes, slope, curvature in zip(
        *(np.split(v, parts) for v in (coordinates, slopes, curvatures)), strict=True
    ):
        # estimate of the largest curvature along any unit vector, mixed derivatives included
        largest = len(axes) * np.linalg.norm(curvature, axis=1).max()
        rotation, singular = _principal_axes(slope)
        rotated = rotation[singular <= (MAX_DISTANCE + MAX_SLOPE) * largest] @ axes
        if not len(rotated):  # a vector that readings determine to first order
            continue
        slope, curvature = (v[0] for v in _slopes_and_curvatures(predict, rotated))
        distance, norm = _stationary(slope, curvature), np.linalg.norm(curvature, axis=1)
        slope_there = np.linalg.norm(slope + distance[:, None] * curvature, axis=1)
        mirrored = (norm > MIN_CURVATURE) & (np.abs(distance) <= MAX_DISTANCE)
        mirrored &= slope_there <= MAX_SLOPE * norm
        directions.append(rotated[mirrored])
        norms.append(norm[mirrored])
    return MirroredDirections(np.concatenate(directions), np.concatenate(norms))


def mirrored_starts(predict: Predict, theta: Array, directions: Array) -> Array:
    """Start values θ̂ with some directions mirrored, shape (n_starts, S, n_free).

    They are at least one prior standard deviation from the stationary point. If a solution is near
    this point, both sides are starts.

    Args:
        predict: Readings of the S machines.
        theta: Solutions θ̂, shape (S, n_free).
        directions: Mirrored directions, at least one, shape (n_directions, n_free).
    """
    distance = _stationary(*_slopes_and_curvatures(predict, directions))
    side = np.where(distance >= 0.0, 1.0, -1.0)
    near = np.abs(distance) < NEAR
    this_side = np.where(near, distance - side, 0.0)
    other_side = distance + side * np.maximum(np.abs(distance), 1.0)
    n = len(directions)
    fewest, most = 0 if near.any() else 1, n if n <= MAX_COMBINED else 2
    sets = (s for k in range(fewest, most + 1) for s in itertools.combinations(range(n), k))
    changed = np.array(sorted([i in s for i in range(n)] for s in sets), dtype=np.bool_)
    steps = np.where(changed[:, None], other_side, this_side)
    return np.asarray(theta + steps @ directions)


def _slopes_and_curvatures(predict: Predict, directions: Array) -> tuple[Array, Array]:
    """Slopes a and curvatures c of S machines, shape (S, n_directions, n_entries) each."""
    n = len(directions)
    readings = predict(np.vstack([np.zeros_like(directions[:1]), directions, -directions]))
    here, forward, backward = readings[:, :1], readings[:, 1 : n + 1], readings[:, n + 1 :]
    return 0.5 * (forward - backward), forward - 2.0 * here + backward


def _principal_axes(slopes: Array) -> tuple[Array, Array]:
    """Axes of a vector, shape (n, n), and the norms of their slopes, shape (n,).

    Args:
        slopes: Slopes of the coordinates, shape (n, n_entries).
    """
    axes, singular, _ = np.linalg.svd(slopes)
    return axes.T, np.pad(singular, (0, len(slopes) - len(singular)))


def _stationary(slopes: Array, curvatures: Array) -> Array:
    """Distance −a·c/c·c to the stationary point along each direction, shape (..., n_directions)."""
    square = np.maximum((curvatures**2).sum(axis=-1), np.finfo(np.float64).tiny)
    distance: Array = -(slopes * curvatures).sum(axis=-1) / square
    return np.nan_to_num(distance)  # 0 if a sensor has no reading after a change
