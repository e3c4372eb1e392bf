"""Levenberg and Marquardt's method for closing loops: damped least squares with a line search.

It finds a configuration near a start in which a residual vanishes, or the nearest to it that there
is. Rows may depend on each other, and coordinates may be left free: of all steps that do the same
the shortest is taken.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Evaluate = Callable[[Array], tuple[Array, Array]]
"""Coordinates to the residual, shape (m,), and its Jacobian, shape (m, n)."""

CLOSED = 1e-12
"""Largest closure residual of closed loops, [m or rad]."""

NOTHING = 1e-9
"""What is open by less is not worth a word, [m or rad]."""

MAX_STEPS = 150
LARGEST_STEP = 0.5
"""Change of a coordinate in one step, [m or rad]."""

_MAX_TRIALS = 10
"""Of a step, each more damped than the one before."""
_FIRST_DAMPING = 1e-3
"""Of the squared residual: the damping vanishes with it, so that the end is Newton's."""
_PATIENCE = 12
_LEAST_GAIN = 0.1
"""Share of the residual that these steps must remove while the loops are far from closed."""
_RANK = 1e-10
"""Singular values below this share of the largest are none."""


@dataclass(frozen=True, slots=True, eq=False)
class Closing:
    """Result of a search."""

    coordinates: Array
    """Shape (n,), [m, rad]."""
    residual: Array
    """Shape (m,), [m, rad]."""

    @property
    def closed(self) -> bool:
        """True if the loops are closed."""
        return largest(self.residual) < CLOSED


def close_loops(
    evaluate: Evaluate,
    start: ArrayLike,
    *,
    row_units: ArrayLike,
    units: ArrayLike,
    bounds: tuple[ArrayLike, ArrayLike] = (-np.inf, np.inf),
) -> Closing:
    """Coordinates near a start in which a residual vanishes.

        min ‖W r(x)‖²,  (Jᵀ W² J + μ U²) dx = −Jᵀ W² r,  x ← x + s dx

    Args:
        evaluate: The residual and its Jacobian.
        start: Shape (n,), [m, rad].
        row_units: Metres that one unit of each row amounts to, the diagonal of W, shape (m,).
        units: Metres that one unit of each coordinate amounts to, the diagonal of U, shape (n,).
        bounds: Least and largest coordinates; steps end there.

    Returns:
        Where it ended, closed or not.
    """
    lower, upper = (np.asarray(b, dtype=np.float64) for b in bounds)
    weights, scale = np.asarray(row_units), np.asarray(units)
    x = np.clip(np.asarray(start, dtype=np.float64), lower, upper)
    residual, jacobian = evaluate(x)
    damping, past = _FIRST_DAMPING, []
    for _ in range(MAX_STEPS):
        size = float(np.square(weights * residual).sum())
        past.append(size)
        if largest(residual) < CLOSED or not np.isfinite(size):
            break
        if not np.isfinite(jacobian).all():
            break
        if len(past) > _PATIENCE and size > (1.0 - _LEAST_GAIN) * past[-1 - _PATIENCE]:
            break
        slopes = weights[:, None] * jacobian / scale
        downhill = -(weights * residual) @ slopes
        slopes[:, ((x <= lower) & (downhill < 0.0)) | ((x >= upper) & (downhill > 0.0))] = 0.0
        direction = _Directions(weights * residual, slopes)
        for _ in range(_MAX_TRIALS):
            step = direction.step(damping * size) / scale
            step *= min(1.0, LARGEST_STEP / max(largest(step), 1e-300))
            trial = np.clip(x + step, lower, upper)
            r, j = evaluate(trial)
            if float(np.square(weights * r).sum()) < size:
                break
            damping *= 4.0
        else:
            break
        x, residual, jacobian = trial, r, j
        damping /= 3.0
    return Closing(x, residual)


class _Directions:
    """Steps of all dampings from one decomposition."""

    def __init__(self, residual: Array, jacobian: Array) -> None:
        left, self._values, self._right = np.linalg.svd(jacobian, full_matrices=False)
        self._projected = left.T @ residual
        first = self._values[0] if self._values.size else 0.0
        self._kept = self._values > _RANK * first

    def step(self, damping: float) -> Array:
        """The damped step, shape (n,)."""
        s = self._values[self._kept]
        share = s / (s * s + damping)
        return np.asarray(-(self._right[self._kept].T @ (share * self._projected[self._kept])))


def largest(values: Array) -> float:
    """Largest magnitude, 0 of nothing."""
    return float(np.abs(values).max(initial=0.0))


def describe_opening(residual: ArrayLike, rotations: ArrayLike) -> str:
    """By how much loops are open, in words, metres and radians told apart.

    Args:
        residual: Closure residual, shape (m,), [m, rad].
        rotations: Which rows are rotations, shape (m,).
    """
    r, turned = np.abs(np.asarray(residual)), np.asarray(rotations, dtype=bool)
    parts = [(largest(r[~turned]), "mm"), (largest(r[turned]), "mrad")]
    open_ones = [part for part in parts if part[0] > NOTHING] or parts[:1]
    return " and ".join(f"{_three_digits(size * 1e3)} {unit}" for size, unit in open_ones)


def _three_digits(value: float) -> str:
    return f"{value:.0f}" if value >= 1000.0 else f"{value:.3g}"
