"""One plan of readings on many machines to first order, without a Jacobian of any.

For forces f on the readings, the passive coordinates following the loops,

    Σ f dh = (f h_θ − λ g_θ) dθ,  g_qᵀ λ = h_qᵀ f

so that the slope of a cost takes one small solve a posture, however many parameters there are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.estimation.problem import CalibrationProblem
from orthocal.kinematics.error_map import right_jacobian
from orthocal.observation.sensor_groups import SensorGroup

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Readings of one expression on all machines, with their slopes; shape (n_sets, n, …)."""

    group: SensorGroup
    posture: Indices
    """Of each entry, shape (n,)."""
    reading: Array
    by_actuated: Array
    by_passive: Array
    by_twists: Array
    """Nonzeros."""
    by_zero: Array
    by_unknowns: Array


@dataclass(frozen=True, slots=True, eq=False)
class _TwistSlopes:
    """How twists open the loops: the nonzeros of twists that free errors make, row by row."""

    slopes: Array
    """∂g by twists, shape (n_sets, n_postures, n)."""
    rows: tuple[tuple[int, slice, Indices], ...]
    """Each row of g, where its slopes are, and by which twists; none comes twice in a row."""

    @staticmethod
    def of(problem: CalibrationProblem, slopes: Array) -> _TwistSlopes:
        """Of all nonzeros, shape (n_sets, n_postures, nnz), in the order of their pattern."""
        compiled = problem.compiled
        rows, columns = compiled.twist_pattern
        moved = compiled.errors.twists_of(problem.columns.T).any(axis=0).reshape(-1, 6).any(axis=1)
        chosen = np.flatnonzero(np.repeat(moved, 6)[columns])
        order = chosen[np.argsort(rows[chosen], kind="stable")]
        there, starts = np.unique(rows[order], return_index=True)
        ends = np.append(starts, order.size)[1:]
        parts = tuple(
            (int(row), slice(a, b), columns[order[a:b]])
            for row, a, b in zip(there, starts, ends, strict=True)
        )
        n_sets, n_postures, _ = slopes.shape
        own = np.empty((n_sets, n_postures, order.size))
        if own.size:  # clipped, as nothing is: checking each place would take as long as all else
            flat = slopes.reshape(n_sets * n_postures, rows.size)
            own = flat.take(order, axis=1, mode="clip").reshape(own.shape)
        return _TwistSlopes(own, parts)

    def take_pull(self, pull: Array, forces: Array) -> None:
        """Take forces on g, (n_sets, n_postures, n), off the pull at twists, (…, n_twists)."""
        for row, part, columns in self.rows:
            own = forces[:, None, :, row] @ self.slopes[..., part]
            pull[:, columns] -= own[:, 0]

    def add_opening(self, opening: Array, twists: Array) -> None:
        """Add to openings, (n_sets, n_postures, n), those by twists, (n_sets, n_twists)."""
        for row, part, columns in self.rows:
            opening[..., row] += (self.slopes[..., part] @ twists[:, columns, None])[..., 0]


class FleetSlopes:
    """Machines near closed loops, to first order.

    Args:
        problem: The problem.
        theta: θ̂ of each machine, shape (n_sets, n_free).
        passive: Passive coordinates that nearly close the loops, shape (n_sets, n_postures,
            n_passive), [m, rad].

    Attributes:
        correction: What closes the loops, shape as `passive`.
        reading: With the loops closed, gauge zeros at 0, shape (n_sets, n_entries), [m of the
            first gauge].

    Raises:
        LinAlgError: If a posture of a machine is singular.
    """

    def __init__(self, problem: CalibrationProblem, theta: Array, passive: Array) -> None:
        self._problem, self._size = problem, len(theta)
        compiled, errors = problem.compiled, problem.compiled.errors
        self._columns, k = problem.columns, problem.n_postures
        at = problem.assembly.errors() + theta[:, : problem.n_machine] @ self._columns.T
        twists = errors.twists_of(at).reshape(self._size, len(errors.moved), 6)
        self._turned = right_jacobian(twists)
        self._offsets, self._gains = errors.offsets(at), errors.gains(at)
        placements = errors.placements(at)
        actuated = self._actuated(problem.drives)
        found = compiled.slopes.unshared(
            actuated.reshape(self._size * k, -1),
            passive.reshape(self._size * k, -1),
            placements,
        )
        opening, self._by_actuated, by_passive, by_twists = (
            v.reshape(self._size, k, *v.shape[1:]) for v in found
        )
        self._twists = _TwistSlopes.of(problem, by_twists)
        self._inverse = _inverse(by_passive)
        self.correction = -(self._inverse @ opening[..., None])[..., 0]
        own = theta[:, problem.n_machine :] * problem.theta_scale[problem.n_machine :]
        unknowns = problem.setting(at) + own
        self._rows = [
            self._read(group, unknowns, actuated, passive, placements)
            for group in problem.sensor_groups
        ]
        self.reading = np.empty((self._size, problem.observations.size))
        for rows in self._rows:
            closing = (rows.by_passive * self.correction[:, rows.posture]).sum(axis=-1)
            self.reading[:, rows.group.entries] = rows.reading + closing
        self.reading /= problem.noise

    def pull(self, forces: Array) -> Array:
        """Σ f dh/dθ̂ of forces on the readings, shape (n_sets, n_free) of (n_sets, n_entries)."""
        problem, errors = self._problem, self._problem.compiled.errors
        shape = (self._size, problem.n_postures)
        on_passive = np.zeros((*shape, self.correction.shape[2]))
        on_drives = np.zeros((*shape, self._offsets.shape[1]))
        twists = np.zeros((self._size, 6 * len(errors.moved)))
        offsets, gains = np.zeros((2, self._size, self._offsets.shape[1]))
        unknowns = np.zeros((self._size, problem.n_free - problem.n_machine))
        for rows in self._rows:
            f = (forces / problem.noise)[:, rows.group.entries, None]
            at_posture = np.zeros((problem.n_postures, rows.posture.size))
            at_posture[rows.posture, np.arange(rows.posture.size)] = 1.0
            on_passive += at_posture @ (f * rows.by_passive)
            on_drives += at_posture @ (f * rows.by_actuated)
            _, columns = rows.group.reading.slopes.pattern("by_twists")
            twists[:, columns] += (np.swapaxes(f, 1, 2) @ rows.by_twists)[:, 0]
            at_zero = f * rows.by_zero
            offsets += at_zero.sum(axis=1)
            gains += (at_zero * problem.session.zero_drives[rows.group.setups]).sum(axis=1)
            for j, own in enumerate(np.moveaxis(f * rows.by_unknowns, 2, 0)):
                np.add.at(unknowns.T, rows.group.unknowns[:, j], own.T)
        held = (on_passive[:, :, None] @ self._inverse)[:, :, 0]
        on_drives -= (held[:, :, None] @ self._by_actuated)[:, :, 0]
        offsets += on_drives.sum(axis=1)
        gains += (on_drives * problem.drives).sum(axis=1)
        self._twists.take_pull(twists, held)
        turned = twists.reshape(self._size, -1, 1, 6) @ self._turned
        machine = turned.reshape(self._size, -1) @ errors.twists_of(self._columns.T).T
        machine += offsets @ errors.offsets(self._columns.T).T
        machine += gains @ errors.scales(self._columns.T).T
        machine += unknowns @ problem.set_by
        return np.hstack([machine, unknowns * problem.theta_scale[problem.n_machine :]])

    def follow(self, change: Array) -> Array:
        """Change of the passive coordinates that closes the loops, with θ̂ changed.

        Args:
            change: dθ̂, shape (n_sets, n_free); what is of sensors moves nothing.

        Returns:
            Shape (n_sets, n_postures, n_passive), [m, rad].
        """
        problem, errors = self._problem, self._problem.compiled.errors
        moved = change[:, : problem.n_machine] @ self._columns.T
        inner = errors.twists_of(moved).reshape(len(change), -1, 6, 1)
        twists = (self._turned @ inner).reshape(len(change), -1)
        drives = errors.offsets(moved)[:, None] + errors.scales(moved)[:, None] * problem.drives
        opened = (self._by_actuated @ drives[..., None])[..., 0]
        if twists.any():
            self._twists.add_opening(opened, twists)
        return np.asarray(self.correction - (self._inverse @ opened[..., None])[..., 0])

    def along(self, change: Array) -> Array:
        """Change of the readings with θ̂ changed, loops closed, to first order.

        Args:
            change: dθ̂, shape (n_sets, n_free).

        Returns:
            Shape (n_sets, n_entries), [m of the first gauge].
        """
        problem, errors = self._problem, self._problem.compiled.errors
        n = problem.n_machine
        moved = change[:, :n] @ self._columns.T
        inner = errors.twists_of(moved).reshape(len(change), -1, 6, 1)
        twists = (self._turned @ inner).reshape(len(change), -1)
        offsets, gains = errors.offsets(moved)[:, None], errors.scales(moved)[:, None]
        drives = offsets + gains * problem.drives
        passive = self.follow(change) - self.correction
        of_sensors = change[:, n:] * problem.theta_scale[n:] + change[:, :n] @ problem.set_by.T
        result = np.empty_like(self.reading)
        for rows in self._rows:
            _, columns = rows.group.reading.slopes.pattern("by_twists")
            zero = offsets + gains * problem.session.zero_drives[rows.group.setups]
            own = (rows.by_passive * passive[:, rows.posture]).sum(axis=-1)
            own += (rows.by_actuated * drives[:, rows.posture]).sum(axis=-1)
            if twists.any():
                own += (rows.by_twists * twists[:, None, columns]).sum(axis=-1)
            own += (rows.by_zero * zero).sum(axis=-1)
            own += (rows.by_unknowns * of_sensors[:, rows.group.unknowns]).sum(axis=-1)
            result[:, rows.group.entries] = own
        return np.asarray(result / problem.noise)

    def jacobian(self) -> Array:
        """dh/dθ̂ of each machine, a parameter at a time, shape (n_sets, n_entries, n_free)."""
        change = np.eye(self._problem.n_free)
        return np.stack([self.along(np.tile(c, (self._size, 1))) for c in change], axis=-1)

    def _actuated(self, commanded: Array) -> Array:
        """Where drives are: (n_sets, ..., n_drives) of (..., n_drives) commanded, [m, rad]."""
        shape = (self._size,) + (1,) * (commanded.ndim - 1) + (-1,)
        return np.asarray(self._gains.reshape(shape) * commanded + self._offsets.reshape(shape))

    def _read(
        self,
        group: SensorGroup,
        unknowns: Array,
        actuated: Array,
        passive: Array,
        placements: Array,
    ) -> _Rows:
        problem, s = self._problem, self._size
        posture = problem.observations.posture[group.entries]
        zero, n = self._actuated(problem.session.zero_drives), posture.size
        h, h_a, h_q, h_t, h_z, h_u = group.reading.slopes.unshared(
            actuated[:, posture].reshape(s * n, -1),
            passive[:, posture].reshape(s * n, -1),
            placements,
            zero[:, group.setups].reshape(s * n, -1),
            np.tile(group.constants, (s, 1)),
            unknowns[:, group.unknowns].reshape(s * n, -1),
        )
        slopes = (v.reshape(s, n, -1) for v in (h_a, h_q, h_t, h_z, h_u))
        return _Rows(group, posture, h.reshape(s, n), *slopes)


def _inverse(matrices: Array) -> Array:
    """Inverses of square matrices, shape (..., n, n); least squares of others."""
    if matrices.shape[-1] == matrices.shape[-2]:
        return np.asarray(np.linalg.inv(matrices))
    return np.asarray(np.linalg.pinv(matrices, rcond=1e-10))
