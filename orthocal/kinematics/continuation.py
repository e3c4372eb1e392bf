"""Systems of equations of many postures, solved by Newton's method along a path.

A posture that a plain start does not reach is approached along a straight path from the mechanical
zero, so that the loops stay in the branch of assembly in which the machine was built.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.errors import ClosureError
from orthocal.robot.nominal_closure import describe_opening
from orthocal.units import DRIVE_UNITS

Array = NDArray[np.float64]
Failures = dict[int, ClosureError]
"""Index of a posture to why it cannot be reached."""

CLOSED = 1e-12
"""Largest scaled residual of closed loops, relative to max(1 m, characteristic length), [m]."""

SINGULAR_BELOW = 1e-5
"""Ratio of smallest to largest singular value below which a posture counts as singular. Near a
singular posture Newton stops where the residual, quadratic in the distance, is below CLOSED: a
smaller ratio would not be seen. The Orthoglide has 1/20 to 1/60."""

SURELY = 0.1
"""Part of the bound at which rounding errors of an inverse are of no account."""

TOO_FAR = 1e3
"""A Newton step that goes farther comes from rows that depend on each other, [m or rad]."""

LAST_STEP = 1e-6
"""A step from closed loops that goes farther is that of a nearly singular posture, [m or rad]."""

MAX_NEWTON_STEPS = 30
SMALLEST_CONTINUATION_STEP = 1.0 / 512.0
LARGEST_CONTINUATION_MOVE = 0.3
"""Change of a passive coordinate in one continuation step, [rad] or characteristic lengths."""

_LIMIT_SLACK = 1e-9


class MachineNumbers(NamedTuple):
    """What errors make of a machine: numbers that every posture shares."""

    placements: Array
    """Shape (12 n_moved,), [1, m]."""
    offset: Array
    """Shape (n_drives,), [m, rad]."""
    gain: Array
    """Shape (n_drives,)."""

    def drives(self, commanded: Array) -> Array:
        """Where drives really are, shape (..., n_drives) of commanded coordinates, [m, rad]."""
        return np.asarray(self.gain * commanded + self.offset)


@dataclass(frozen=True, slots=True, eq=False)
class System:
    """A square or redundant system r(x, p) = 0 of many postures, in metres."""

    evaluate: Callable[[Array, Array, MachineNumbers], tuple[Array, Array]]
    """(x, p, machine) -> residuals (K, n_rows), Jacobians by x (K, n_rows, n_x)."""
    n_rows: int
    n_x: int
    start: Array
    """x of the mechanical zero of the nominal machine, shape (n_x,)."""
    origin: Array
    """p of the mechanical zero of the nominal machine, shape (n_p,)."""
    units: Array
    """Metres that one unit of x amounts to, shape (n_x,)."""
    lower: Array
    upper: Array
    """Bounds of x, shape (n_x,)."""
    names: tuple[str, ...]
    """Joint of each x."""
    row_units: Array
    """Metres that one unit of each row amounts to, by which it was multiplied, shape (n_rows,)."""
    turns: NDArray[np.bool_]
    """Which rows are rotations, shape (n_rows,)."""
    length: float
    """What turns rotations into displacements, [m]."""
    shortest: bool = False
    """Whether steps are the shortest that close it: where motions may be free, what a solve makes
    of a matrix that is singular but for its rounding is no step."""

    def step(self, residuals: Array, jacobians: Array) -> Array:
        """Newton steps, shape (K, n_x); least squares where rows depend on each other."""
        if self.n_rows == self.n_x and not self.shortest:
            try:
                steps = np.asarray(np.linalg.solve(jacobians, -residuals[..., None])[..., 0])
            except np.linalg.LinAlgError:
                return self._shortest_step(residuals, jacobians)
            lost = ~(np.abs(steps).max(axis=1, initial=0.0) < TOO_FAR)
            if lost.any():
                steps[lost] = self._shortest_step(residuals[lost], jacobians[lost])
            return steps
        return self._shortest_step(residuals, jacobians)

    def _shortest_step(self, residuals: Array, jacobians: Array) -> Array:
        steps = np.full((len(residuals), self.n_x), np.nan)  # no step: dropped by who asks
        usable = np.isfinite(jacobians).all(axis=(1, 2))
        inverse = np.linalg.pinv(jacobians[usable], rcond=1e-10)
        with np.errstate(over="ignore"):  # likewise
            steps[usable] = -(inverse @ residuals[usable][..., None])[..., 0]
        return steps

    def describe(self, x: Array, p: Array, machine: MachineNumbers) -> str:
        """By how much the rows of one posture are open, in words."""
        residuals, _ = self.evaluate(x[None], p[None], machine)
        return describe_opening(residuals[0] / self.row_units, self.turns)

    def within_limits(self, x: Array) -> NDArray[np.bool_]:
        """Whether each posture keeps its joints within their limits, shape (K,)."""
        inside = (x >= self.lower - _LIMIT_SLACK) & (x <= self.upper + _LIMIT_SLACK)
        return np.asarray(inside.all(axis=1))


def follow(
    system: System,
    targets: Array,
    machine: MachineNumbers,
    start: ArrayLike | None,
    names: Sequence[str] | None,
    failures: Failures | None,
    *,
    allow_singular: bool = True,
) -> Array:
    """Newton along the straight path from the origin (or a given start) to each target.

    The first try is the whole way; a posture that does not converge, or moves so far that it may
    have changed its branch of assembly, is approached in halved steps.

    Args:
        system: What is to be zero.
        targets: p of each posture, shape (K, n_p).
        machine: The machine.
        start: x to start from, shape (n_x,) or (K, n_x); that of the system by default.
        names: Names of the postures, for messages.
        failures: Filled with the postures that cannot be reached, which are NaN then; by default
            the first of them raises.
        allow_singular: Whether targets may leave motions free.

    Returns:
        x, shape (K, n_x).

    Raises:
        ClosureError: If a posture cannot be reached, is outside the limits of a joint or, unless
            that is allowed, singular.
    """
    tolerance = CLOSED * max(1.0, system.length)
    count = len(targets)

    labels = names if names is not None else [f"posture {i + 1}" for i in range(count)]
    if len(labels) != count:
        raise ValueError(f"found {len(labels)} names for {count} rows")

    lost_for_good = np.zeros(count, dtype=bool)
    regular = np.full(count, allow_singular)

    def refuse(i: int, reason: str, residual: float | None) -> None:
        error = ClosureError(reason, posture=labels[i], residual=residual)
        if failures is None:
            raise error
        failures.setdefault(i, error)
        lost_for_good[i] = True

    for i in np.flatnonzero(~np.isfinite(targets).all(axis=1)).tolist():
        refuse(i, "has coordinates that are not numbers", None)
    first = system.start if start is None else as_rows(start, system.n_x, "start values")[0]
    x = np.array(np.broadcast_to(first, (count, system.n_x)))
    moves = np.where(system.units == 1.0, system.length, 1.0)
    done, step = np.zeros(count), np.ones(count)
    pending = np.flatnonzero(~lost_for_good)
    fresh = np.full(count, start is not None)
    while pending.size:
        reach = np.minimum(1.0, done[pending] + step[pending])
        way = system.origin + reach[:, None] * (targets[pending] - system.origin)
        trial, worst, jacobians = _newton(system, x[pending], way, machine, tolerance)
        moved = np.abs((trial - x[pending]) / moves).max(axis=1, initial=0.0)
        good = (worst < tolerance) & (moved < LARGEST_CONTINUATION_MOVE)
        x[pending[good]] = trial[good]
        done[pending[good]] = reach[good]
        if not allow_singular:
            regular[pending[good]] = _far_from_singular(jacobians[good] / system.units)
        lost = pending[~good & fresh[pending]]  # the given start was no help: begin at zero
        x[lost], step[lost] = system.start, 2.0
        fresh[pending] = False
        step[pending[~good]] *= 0.5
        for i in pending[~good & (step[pending] < SMALLEST_CONTINUATION_STEP)].tolist():
            last, final, _ = _newton(system, x[[i]], targets[[i]], machine, tolerance)
            reason = (
                "cannot be reached from the mechanical zero without changing the way in "
                f"which the loops are assembled, {done[i]:.0%} of the way"
                if final[0] < tolerance
                else "cannot be reached: the loops stay open by "
                f"{system.describe(last[0], targets[i], machine)}, {done[i]:.0%} of the way "
                "from the mechanical zero"
            )
            refuse(i, reason, float(final[0]))
        pending = pending[(done[pending] < 1.0) & ~lost_for_good[pending]]
    for i in np.flatnonzero(~system.within_limits(x) & ~lost_for_good).tolist():
        over = np.maximum(x[i] - system.upper, system.lower - x[i])
        j = int(over.argmax())
        unit, size = DRIVE_UNITS["m" if system.units[j] == 1.0 else "rad"]
        reason = (
            f"cannot be reached: joint '{system.names[j]}' would be at "
            f"{x[i][j] / size:.4g} {unit}, outside its limits "
            f"{system.lower[j] / size:g} ... {system.upper[j] / size:g} {unit}"
        )
        refuse(i, reason, 0.0)
    x[lost_for_good] = np.nan
    doubtful = np.flatnonzero(~regular & ~lost_for_good)
    if doubtful.size:
        _refuse_singular(system, targets, x, machine, labels, failures, doubtful)
    return x


def _refuse_singular(
    system: System,
    p: Array,
    x: Array,
    machine: MachineNumbers,
    names: Sequence[str],
    failures: Failures | None,
    doubtful: NDArray[np.intp],
) -> None:
    """Refuse those of some solutions that leave motions free; NaN where refused into `failures`.

    Raises:
        ClosureError: Naming the posture.
    """
    if system.n_x == 0:
        return
    _, jacobians = system.evaluate(x[doubtful], p[doubtful], machine)
    values = np.linalg.svd(jacobians / system.units, compute_uv=False)
    smallest = values[:, system.n_x - 1] if values.shape[1] >= system.n_x else 0.0
    largest = values.max(axis=1, initial=0.0)  # without closures there are no values
    ratio = np.broadcast_to(smallest / np.maximum(largest, 1e-300), doubtful.shape)
    for k in np.argsort(ratio)[: int((ratio < SINGULAR_BELOW).sum())].tolist():
        i = int(doubtful[k])
        free = int((values[k] > SINGULAR_BELOW * largest[k]).sum())
        error = ClosureError(
            f"is singular: the drives leave {system.n_x - free} of "
            f"{system.n_x} passive motions free",
            posture=names[i],
        )
        if failures is None:
            raise error
        failures[i] = error
        x[i] = np.nan


def _far_from_singular(matrices: Array) -> NDArray[np.bool_]:
    """Whether the ratio of singular values is above SINGULAR_BELOW for sure, shape (K,).

    By Frobenius' norm it is at least 1/(|A| |A⁻¹|), which takes half the time.
    """
    if matrices.shape[1] != matrices.shape[2] or not matrices.size:
        return np.zeros(len(matrices), dtype=np.bool_)
    try:
        inverses = np.linalg.inv(matrices)
    except np.linalg.LinAlgError:
        return np.zeros(len(matrices), dtype=np.bool_)
    sizes = np.linalg.norm(matrices, axis=(1, 2)) * np.linalg.norm(inverses, axis=(1, 2))
    return np.asarray(sizes < SURELY / SINGULAR_BELOW)


def _newton(
    system: System, x: Array, p: Array, machine: MachineNumbers, tolerance: float
) -> tuple[Array, Array, Array]:
    """Damped Newton of many postures at once.

    Returns:
        Solutions, shape (K, n_x), the largest residual of each, shape (K,), [m], and Jacobians at
        them, but for a last step.
    """
    x = np.array(x)
    residuals, jacobians = system.evaluate(x, p, machine)
    worst = np.abs(residuals).max(axis=1, initial=0.0)
    active = np.flatnonzero(worst >= tolerance)
    for _ in range(MAX_NEWTON_STEPS):
        if not active.size:
            break
        step = system.step(residuals[active], jacobians[active])
        usable = np.isfinite(step).all(axis=1)
        active, step = active[usable], step[usable]
        scale = np.ones(len(active))
        pending = np.arange(len(active))
        moved = np.zeros(len(active), dtype=bool)
        for _ in range(6):
            rows = active[pending]
            trial = x[rows] + scale[pending, None] * step[pending]
            r, j = system.evaluate(trial, p[rows], machine)
            size = np.abs(r).max(axis=1, initial=0.0)
            better = size < worst[rows]
            good = rows[better]
            x[good], residuals[good], jacobians[good] = trial[better], r[better], j[better]
            worst[good] = size[better]
            moved[pending[better]] = True
            pending = pending[~better]
            scale[pending] *= 0.25
            if not pending.size:
                break
        active = active[moved]
        active = active[worst[active] >= tolerance]
    closed = np.flatnonzero((worst < tolerance) & np.isfinite(jacobians).all(axis=(1, 2)))
    if closed.size and system.n_x:  # what is left goes too: residual and slope are at hand
        step = system.step(residuals[closed], jacobians[closed])
        small = np.abs(step).max(axis=1) < LAST_STEP
        x[closed[small]] += step[small]
    return x, worst, jacobians


def as_rows(values: ArrayLike, n: int, what: str) -> tuple[Array, bool]:
    """Numbers as an array of shape (K, n), and whether they were a single row.

    Raises:
        ValueError: If they are no numbers, or not so many a row.
    """
    try:
        given = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"found {type(values).__name__}; expected {n} {what} a row") from None
    if given.ndim not in (1, 2) or given.shape[-1] != n:
        raise ValueError(f"found the shape {given.shape}; expected {n} {what} a row, (K, {n})")
    return np.atleast_2d(given), given.ndim == 1
