"""One plan of readings on many machines at once: their loops, readings and the pull of residuals.

The pull of residuals w on the parameters, Jᵀ w, is found without J: readings pull on the loops of
their posture, λ = g_qᵀ⁻¹ Σ w h_q, and these on the errors, Σ w h_θ − λᵀ g_θ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.identification.problem import CalibrationProblem
from orthocal.kinematics.error_map import right_jacobian

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

POSTURES_AT_ONCE = 2048
"""Of all machines together, for the memory of their derivatives."""

NEWTON_STEPS = 12
CLOSED = 1e-13
"""Last Newton step of loops that are closed, [m, rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Readings of one kind of sensor by all machines, and what moves them."""

    entries: Indices
    by_actuated: Array
    by_passive: Array
    by_twists: Array
    """Nonzeros, shape (n_sets, n, nnz)."""
    by_zero: Array
    columns: Indices
    """Of these nonzeros."""
    postures: Array
    """1 where a reading (column) is of a posture (row), shape (n_postures, n)."""


@dataclass(frozen=True, slots=True, eq=False)
class FleetExpansion:
    """Machines at their parameters to first order."""

    reading: Array
    """h with loops closed to first order, shape (n_sets, n_entries), [m]."""
    correction: Array
    """dq that closes the loops, shape (n_sets, n_postures, n_passive), [m, rad]."""
    by_actuated: Array
    by_passive: Array
    by_twists: Array
    """∂g in each posture, of that by twists the nonzeros."""
    seen: tuple[_Seen, ...]


class Fleet:
    """Machines that differ in the free parameters of a problem, in its postures.

    Args:
        problem: The problem.
        theta: θ̂ of each, shape (n_sets, n_free).
    """

    def __init__(self, problem: CalibrationProblem, theta: Array) -> None:
        self._problem = problem
        compiled = problem.compiled
        self._slopes = compiled.sparse_slopes.unshared
        self._closing = compiled.closing.unshared
        self._pattern = compiled.sparse_slopes.pattern("y3")
        self.theta = np.array(theta)
        self.passive = np.tile(problem.reference_passive, (len(theta), 1, 1))
        self._set_machines()

    @property
    def size(self) -> int:
        """Number of machines."""
        return len(self.theta)

    def _set_machines(self) -> None:
        problem, errors = self._problem, self._problem.compiled.errors
        at = problem.assembly.errors() + self.theta @ problem.columns.T
        self._errors = at
        self._placements = errors.placements(at)
        self._offsets, self._gains = errors.offsets(at), errors.gains(at)

    def move(self, change: Array) -> None:
        """Change θ̂ of all, shape (n_sets, n_free); their loops are left as they are."""
        self.theta = self.theta + change
        self._set_machines()

    def close(self) -> NDArray[np.bool_]:
        """Close all loops by Newton's method; whether each machine's were, shape (n_sets,)."""
        problem = self._problem
        k = problem.n_postures
        actuated = self._actuated(problem.drives).reshape(self.size * k, -1)
        q = self.passive.reshape(self.size * k, -1)
        active = np.arange(self.size * k)
        for _ in range(NEWTON_STEPS):
            for first in range(0, active.size, POSTURES_AT_ONCE):
                at = active[first : first + POSTURES_AT_ONCE]
                g, g_q = self._closing(actuated[at], q[at], self._placements[at // k])
                step = _solve(g_q, g[..., None])[..., 0]
                q[at] -= step
                size = np.abs(step).max(axis=1, initial=0.0)
                active[first : first + POSTURES_AT_ONCE] = np.where(size < CLOSED, -1, at)
            active = active[active >= 0]
            if not active.size:
                break
        self.passive = q.reshape(self.size, k, -1)
        done = np.ones(self.size, dtype=np.bool_)
        done[active // k] = False
        return done & np.isfinite(self.passive).all(axis=(1, 2))

    def predict(self) -> Array:
        """Readings of all, gauge zeros at 0, shape (n_sets, n_entries), [m]."""
        problem, o = self._problem, self._problem.observations
        result = np.empty((self.size, o.size))
        zero = self._actuated(problem.session.zero_drives)
        actuated = self._actuated(problem.drives)
        for group in problem.sensor_groups:
            at = o.posture[group.entries]
            n = at.size
            (h,) = group.reading.value.unshared(
                actuated[:, at].reshape(self.size * n, -1),
                self.passive[:, at].reshape(self.size * n, -1),
                np.repeat(self._placements, n, axis=0),
                np.repeat(zero, n, axis=0),
                np.tile(group.constants, (self.size, 1)),
                np.zeros((self.size * n, 0)),
            )
            result[:, group.entries] = h[:, 0].reshape(self.size, n)
        return result

    def expand(self) -> FleetExpansion:
        """Readings and loops of all to first order."""
        problem, o = self._problem, self._problem.observations
        n, k = self.size, problem.n_postures
        actuated, zero = (
            self._actuated(d) for d in (problem.drives, problem.session.zero_drives)
        )
        q = self.passive
        found = self._slopes(
            actuated.reshape(n * k, -1), q.reshape(n * k, -1), np.repeat(self._placements, k, axis=0)
        )
        g, g_a, g_q, g_t = (y.reshape(n, k, *y.shape[1:]) for y in found)
        correction = -_solve(g_q, g[..., None])[..., 0]
        reading, seen = np.empty((n, o.size)), []
        for group in problem.sensor_groups:
            at, m = o.posture[group.entries], group.entries.size
            found = group.reading.slopes.unshared(
                actuated[:, at].reshape(n * m, -1),
                q[:, at].reshape(n * m, -1),
                np.repeat(self._placements, m, axis=0),
                np.repeat(zero, m, axis=0),
                np.tile(group.constants, (n, 1)),
                np.zeros((n * m, 0)),
            )
            h, h_a, h_q, h_t, h_z = (y.reshape(n, m, -1) for y in found[:5])
            reading[:, group.entries] = h[..., 0] + (h_q * correction[:, at]).sum(axis=2)
            _, columns = group.reading.slopes.pattern("by_twists")
            postures = (at == np.arange(k)[:, None]).astype(np.float64)
            seen.append(_Seen(group.entries, h_a, h_q, h_t, h_z, columns, postures))
        return FleetExpansion(reading, correction, g_a, g_q, g_t, tuple(seen))

    def pull(self, at: FleetExpansion, weights: Array) -> Array:
        """Jᵀ w of all machines, shape (n_sets, n_free) of (n_sets, n_entries)."""
        problem, errors = self._problem, self._problem.compiled.errors
        n, k = self.size, problem.n_postures
        by_passive = np.zeros((n, k, at.by_passive.shape[3]))
        by_actuated = np.zeros((n, k, at.by_actuated.shape[3]))
        twists = np.zeros((n, problem.compiled.n_twists))
        by_zero = np.zeros((n, by_actuated.shape[2]))
        for seen in at.seen:
            w = weights[:, seen.entries, None]
            by_passive += seen.postures @ (w * seen.by_passive)
            by_actuated += seen.postures @ (w * seen.by_actuated)
            by_zero += (w * seen.by_zero).sum(axis=1)
            _add_columns(twists, seen.columns, (w * seen.by_twists).sum(axis=1))
        loops = _solve(np.swapaxes(at.by_passive, 2, 3), by_passive[..., None])[..., 0]
        by_actuated -= (loops[:, :, None, :] @ at.by_actuated)[:, :, 0]
        rows, columns = self._pattern
        _add_columns(twists, columns, -(loops[:, :, rows] * at.by_twists).sum(axis=1))
        own = (twists.reshape(n, -1, 1, 6) @ self._turns).reshape(n, -1)
        commanded = (by_actuated * problem.drives).sum(axis=1)
        commanded += by_zero * problem.session.zero_drives
        spread = problem.columns
        return np.asarray(
            own @ errors.twists_of(spread.T).T
            + (by_actuated.sum(axis=1) + by_zero) @ errors.offsets(spread.T).T
            + commanded @ errors.scales(spread.T).T
        )

    def follow(self, at: FleetExpansion, change: Array) -> None:
        """Change θ̂ of all, shape (n_sets, n_free); passive joints follow to first order."""
        problem, errors = self._problem, self._problem.compiled.errors
        moved = change @ problem.columns.T
        twists = self._turns @ errors.twists_of(moved).reshape(self.size, -1, 6, 1)
        drives = errors.offsets(moved)[:, None] + errors.scales(moved)[:, None] * problem.drives
        rows, columns = self._pattern
        by_row = np.zeros((rows.size, at.by_passive.shape[2]))
        by_row[np.arange(rows.size), rows] = 1.0
        opened = (at.by_twists * twists.reshape(self.size, 1, -1)[..., columns]) @ by_row
        opened += (at.by_actuated @ drives[..., None])[..., 0]
        step = _solve(at.by_passive, opened[..., None])[..., 0]
        self.passive = self.passive + at.correction - step
        self.move(change)

    @property
    def _turns(self) -> Array:
        """T of each moved placement, shape (n_sets, n_moved, 6, 6)."""
        errors = self._problem.compiled.errors
        return right_jacobian(errors.twists_of(self._errors).reshape(self.size, -1, 6))

    def _actuated(self, commanded: Array) -> Array:
        """Where drives are: (n_sets, ..., n_drives) of (..., n_drives) commanded, [m, rad]."""
        shape = (self.size,) + (1,) * (commanded.ndim - 1) + (-1,)
        return np.asarray(self._gains.reshape(shape) * commanded + self._offsets.reshape(shape))


def _add_columns(total: Array, columns: Indices, values: Array) -> None:
    """Add values to columns of a matrix, which may come more than once."""
    np.add.at(total.T, columns, values.T)


def _solve(matrices: Array, right: Array) -> Array:
    """Solutions of square systems, NaN where any is singular; least squares of others."""
    if matrices.shape[-1] == matrices.shape[-2]:
        try:
            return np.asarray(np.linalg.solve(matrices, right))
        except np.linalg.LinAlgError:
            return np.full_like(right, np.nan)
    return np.asarray(np.linalg.pinv(matrices, rcond=1e-10) @ right)
