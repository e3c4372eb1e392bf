"""Levenberg-Marquardt method with step control, for closing loops from a distant start.

It finds a configuration near a start in which a residual vanishes, or else a local minimum of the
residual. Rows may be linearly dependent and coordinates undetermined: steps have minimum norm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array

Evaluate = Callable[[Array], tuple[Array, Array]]
"""Function of the coordinates: residual, shape (m,), and its Jacobian, shape (m, n)."""

CLOSURE_TOLERANCE = 1e-12
"""Largest closure residual of closed loops, [m or rad]."""

SMALLEST_SHOWN = 1e-9
"""Openings below this are omitted from messages, [m or rad]."""

MAX_STEPS = 150
"""Largest number of steps of a search."""

LARGEST_STEP = 0.5
"""Largest change of a coordinate in one step, [m or rad]."""

_MAX_TRIALS = 10
"""Trials of a step with increasing damping."""

_FIRST_DAMPING = 1e-3
"""First ratio of damping to squared residual. The damping vanishes with the residual, so that
convergence is quadratic."""

_MORE_DAMPING, _LESS_DAMPING = 4.0, 3.0
"""Factor of this ratio after a failed trial, and its divisor after a step."""

_WINDOW = 12
"""Steps after which a search with too little progress ends."""

_MIN_REDUCTION = 0.1
"""Smallest relative reduction of the squared residual within _WINDOW steps."""

RANK_TOLERANCE = 1e-10
"""Singular values of closures below this fraction of the largest one count as zero."""


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
        return largest(self.residual) < CLOSURE_TOLERANCE


def close_loops(
    evaluate: Evaluate,
    start: ArrayLike,
    *,
    row_units: ArrayLike,
    units: ArrayLike,
    bounds: tuple[ArrayLike, ArrayLike] = (-np.inf, np.inf),
) -> Closing:
    """Find coordinates near a start in which a residual vanishes.

        min ‖W r(x)‖²,  (Jᵀ W² J + μ U²) dx = −Jᵀ W² r,  x ← x + s dx

    r is the residual with the Jacobian J, μ the damping times the cost, and s ≤ 1 shortens a step.

    Args:
        evaluate: Residual and Jacobian as a function of the coordinates.
        start: Start values of the coordinates, shape (n,), [m, rad].
        row_units: Metres per unit of each row, the diagonal of W, shape (m,).
        units: Metres per unit of each coordinate, the diagonal of U, shape (n,).
        bounds: Lower and upper bounds of the coordinates, shape (n,) or scalar, [m, rad]; steps are
            clipped to them.

    Returns:
        Coordinates and residual after the last step, even if the loops are still open.
    """
    lower, upper = (np.asarray(b, dtype=np.float64) for b in bounds)
    weights, scale = np.asarray(row_units), np.asarray(units)
    x = np.clip(np.asarray(start, dtype=np.float64), lower, upper)
    residual, jacobian = evaluate(x)
    damping, costs = _FIRST_DAMPING, []
    for _ in range(MAX_STEPS):
        cost = float(np.square(weights * residual).sum())
        costs.append(cost)
        if largest(residual) < CLOSURE_TOLERANCE or not np.isfinite(cost):
            break
        if not np.isfinite(jacobian).all():
            break
        if len(costs) > _WINDOW and cost > (1.0 - _MIN_REDUCTION) * costs[-1 - _WINDOW]:
            break
        scaled = weights[:, None] * jacobian / scale
        descent = -(weights * residual) @ scaled
        # coordinates at a bound, which the step would cross, stay there
        scaled[:, ((x <= lower) & (descent < 0.0)) | ((x >= upper) & (descent > 0.0))] = 0.0
        damped_step = _decompose(weights * residual, scaled)
        for _ in range(_MAX_TRIALS):
            step = damped_step(damping * cost) / scale
            step *= min(1.0, LARGEST_STEP / max(largest(step), 1e-300))
            trial = np.clip(x + step, lower, upper)
            r, j = evaluate(trial)
            if float(np.square(weights * r).sum()) < cost:
                break
            damping *= _MORE_DAMPING
        else:
            break
        x, residual, jacobian = trial, r, j
        damping /= _LESS_DAMPING
    return Closing(x, residual)


def _decompose(residual: Array, jacobian: Array) -> Callable[[float], Array]:
    """Function of the damping that returns damped steps from one singular value decomposition."""
    u, values, vt = np.linalg.svd(jacobian, full_matrices=False)
    nonzero = values > RANK_TOLERANCE * values.max(initial=0.0)
    s, vt, projected = values[nonzero], vt[nonzero], (u.T @ residual)[nonzero]

    def damped_step(damping: float) -> Array:
        """Scaled step −(JᵀJ + μ)⁻¹ Jᵀ r of minimum norm."""
        return np.asarray(-(vt.T @ (s / (s * s + damping) * projected)))

    return damped_step


def invert_closures(jacobians: ArrayLike) -> Array:
    """Inverses of closure Jacobians ∂g/∂q, shape (..., n_passive, n_rows).

    Implicit differentiation of g(q, θ) = 0 gives dq/dθ = −(∂g/∂q)⁻¹ ∂g/∂θ. A Jacobian of dependent
    or too few rows is not square; its pseudo-inverse gives the change of minimum norm.

    Args:
        jacobians: Shape (..., n_rows, n_passive), [m, rad per m, rad]; regular if square.
    """
    g_q: Array = np.asarray(jacobians, dtype=np.float64)
    if g_q.shape[-2] == g_q.shape[-1]:
        return np.asarray(np.linalg.inv(g_q))
    return np.asarray(np.linalg.pinv(g_q, rcond=RANK_TOLERANCE))


def largest(values: Array) -> float:
    """Largest magnitude, 0 for an empty array."""
    return float(np.abs(values).max(initial=0.0))


def describe_opening(residual: ArrayLike, rotations: ArrayLike) -> str:
    """Description of the opening of loops: largest distance in mm and rotation in mrad.

    Args:
        residual: Closure residual, shape (m,), [m, rad].
        rotations: Mask of the rows that are rotations, shape (m,).
    """
    r, mask = np.abs(np.asarray(residual)), np.asarray(rotations, dtype=bool)
    openings = [(largest(r[~mask]), "mm"), (largest(r[mask]), "mrad")]
    shown = [opening for opening in openings if opening[0] > SMALLEST_SHOWN] or openings[:1]
    return " and ".join(f"{_three_digits(size * 1e3)} {unit}" for size, unit in shown)


def _three_digits(value: float) -> str:
    """Number with three significant digits; from 1000 on an integer, without exponent."""
    return f"{value:.0f}" if value >= 1000.0 else f"{value:.3g}"
