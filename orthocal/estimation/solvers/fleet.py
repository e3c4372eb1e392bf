"""One plan of readings on many machines at once: their loops closed, and what they show."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthocal.estimation.problem import CalibrationProblem

Array = NDArray[np.float64]

POSTURES_AT_ONCE = 2048
"""Of all machines together, for the memory of their derivatives."""

NEWTON_STEPS = 12
CLOSED = 1e-13
"""Last Newton step of loops that are closed, [m, rad]."""


class Fleet:
    """Machines that differ in the free parameters of a problem, in its postures.

    Args:
        problem: The problem.
        theta: θ̂ of each, shape (n_sets, n_free).
    """

    def __init__(self, problem: CalibrationProblem, theta: Array) -> None:
        self._problem = problem
        compiled = problem.compiled
        self._closing = compiled.closing.unshared
        self.theta = np.array(theta)
        self.passive = np.tile(problem.reference_passive, (len(theta), 1, 1))
        errors = compiled.errors
        n = problem.n_machine
        at = problem.assembly.errors() + self.theta[:, :n] @ problem.columns.T
        self._unknowns = self.theta[:, n:] * problem.theta_scale[n:]
        self._placements = errors.placements(at)
        self._offsets, self._gains = errors.offsets(at), errors.gains(at)

    @property
    def size(self) -> int:
        """Number of machines."""
        return len(self.theta)

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
        """Readings of all, gauge zeros at 0, shape (n_sets, n_entries), [m of the first gauge]."""
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
                zero[:, group.setups].reshape(self.size * n, -1),
                np.tile(group.constants, (self.size, 1)),
                self._unknowns[:, group.unknowns].reshape(self.size * n, -1),
            )
            result[:, group.entries] = h[:, 0].reshape(self.size, n)
        return np.asarray(result / problem.noise)

    def _actuated(self, commanded: Array) -> Array:
        """Where drives are: (n_sets, ..., n_drives) of (..., n_drives) commanded, [m, rad]."""
        shape = (self.size,) + (1,) * (commanded.ndim - 1) + (-1,)
        return np.asarray(self._gains.reshape(shape) * commanded + self._offsets.reshape(shape))


def _solve(matrices: Array, right: Array) -> Array:
    """Solutions of square systems, NaN where any is singular; least squares of others."""
    if matrices.shape[-1] == matrices.shape[-2]:
        try:
            return np.asarray(np.linalg.solve(matrices, right))
        except np.linalg.LinAlgError:
            return np.full_like(right, np.nan)
    return np.asarray(np.linalg.pinv(matrices, rcond=1e-10) @ right)
