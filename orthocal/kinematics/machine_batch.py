"""Machines that differ in their errors, in the same postures: their loops, all at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthocal.kinematics.compiled import compiled_robot
from orthocal.robot.model import Robot

Array = NDArray[np.float64]

POSTURES_AT_ONCE = 2048
"""Of all machines together, for the memory of their derivatives."""

NEWTON_STEPS = 12
CLOSED = 1e-13
"""The next Newton step of loops that are closed, at most, [m, rad]."""


class Machines:
    """Machines of one robot.

    Args:
        robot: The nominal robot.
        errors: All elementary errors of each machine, shape (n_sets, n_errors), [SI].
        drives: Commanded drive coordinates, shape (n_postures, n_drives), [m, rad].
        passive: Passive coordinates near those of all machines, shape (n_postures, n_passive),
            [m, rad].

    Attributes:
        passive: Passive coordinates of each machine, shape (n_sets, n_postures, n_passive).
        placements: Of all that is moved by errors, shape (n_sets, n).
    """

    def __init__(self, robot: Robot, errors: Array, drives: Array, passive: Array) -> None:
        self._robot = robot
        self._compiled = compiled_robot(robot)
        own = self._compiled.errors
        self._drives, self._near, self._errors = drives, passive, errors
        self.passive = np.tile(passive, (len(errors), 1, 1))
        self.placements = own.placements(errors)
        self._offsets, self._gains = own.offsets(errors), own.gains(errors)

    @property
    def size(self) -> int:
        """Number of machines."""
        return len(self.passive)

    def close(self) -> NDArray[np.bool_]:
        """Close all loops by Newton's method; whether each machine's were, shape (n_sets,)."""
        near, self.passive = self.passive, self._first_order()
        every = np.arange(self.size)
        done = self._newton(every)
        if not done.all():  # others in the middle may have led them astray
            left = every[~done]
            self.passive[left] = near[left]
            done[left] = self._newton(left)
        return done

    def _newton(self, sets: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Newton's method from where some machines are; whether each was closed, (n,)."""
        closing, k = self._compiled.closing.unshared, len(self._drives)
        actuated = self.actuated(self._drives).reshape(self.size * k, -1)
        q = self.passive.reshape(self.size * k, -1)
        active = (sets[:, None] * k + np.arange(k)).reshape(-1)
        before = np.full(self.size * k, np.inf)
        for _ in range(NEWTON_STEPS):
            left = []
            for first in range(0, active.size, POSTURES_AT_ONCE):
                at = active[first : first + POSTURES_AT_ONCE]
                g, g_q = closing(actuated[at], q[at], self.placements[at // k])
                step = _solve(g_q, g[..., None])[..., 0]
                q[at] -= step
                size = np.abs(step).max(axis=1, initial=0.0)
                left.append(at[~_closed(size, before[at])])
                before[at] = size
            active = np.concatenate(left) if left else active
            if not active.size:
                break
        self.passive = q.reshape(self.size, k, -1)
        done = np.ones(self.size, dtype=np.bool_)
        done[active // k] = False
        return (done & np.isfinite(self.passive).all(axis=(1, 2)))[sets]

    def _first_order(self) -> Array:
        """Passive coordinates by the slopes of the machine in the middle, shape as `passive`."""
        own, k = self._compiled.errors, len(self._drives)
        if not self.size or not np.isfinite(self._errors).all():
            return np.array(self.passive)
        centre = np.median(self._errors, axis=0)
        change = self._errors - centre
        drives = own.drives(centre, self._drives)
        slopes = self._compiled.slopes
        g, g_a, g_q, nonzeros = slopes(drives, self._near, own.placements(centre))
        rows, columns = self._compiled.twist_pattern
        by_twists = np.zeros((k, g.shape[1], 6 * len(own.moved)))
        by_twists[:, rows, columns] = nonzeros
        twists = change @ own.slopes(centre, np.eye(len(centre))).twists.T
        moved = own.offsets(change)[:, None] + own.scales(change)[:, None] * self._drives
        opened = g[..., None] + by_twists @ twists.T + g_a @ moved.transpose(1, 2, 0)
        found = self._near - np.moveaxis(_solve(g_q, opened), -1, 0)
        return found if np.isfinite(found).all() else np.array(self.passive)

    def tool(self) -> Array:
        """Where the tool of each is in each posture, shape (n_sets, n_postures, 3), [m]."""
        tcp = self._robot.tcp
        k = len(self._drives)
        (found,) = self._compiled.position("" if tcp is None else tcp.frame).unshared(
            self.actuated(self._drives).reshape(self.size * k, -1),
            self.passive.reshape(self.size * k, -1),
            self.placements,
        )
        return np.asarray(found.reshape(self.size, k, 3))

    def actuated(self, commanded: Array) -> Array:
        """Where drives are: (n_sets, ..., n_drives) of (..., n_drives) commanded, [m, rad]."""
        shape = (self.size,) + (1,) * (commanded.ndim - 1) + (-1,)
        return np.asarray(self._gains.reshape(shape) * commanded + self._offsets.reshape(shape))


def _closed(size: Array, before: Array) -> NDArray[np.bool_]:
    """Whether a step after these would close nothing more: each is a smaller part of the last."""
    with np.errstate(invalid="ignore", divide="ignore"):
        following = np.where(np.isfinite(before), size * (size / before), np.inf)
    return np.asarray((size < CLOSED) | ((following < CLOSED) & (size < before)))


def _solve(matrices: Array, right: Array) -> Array:
    """Solutions of square systems, NaN where any is singular; least squares of others."""
    if matrices.shape[-1] == matrices.shape[-2]:
        try:
            return np.asarray(np.linalg.solve(matrices, right))
        except np.linalg.LinAlgError:
            return np.full_like(right, np.nan)
    return np.asarray(np.linalg.pinv(matrices, rcond=1e-10) @ right)
