"""Readings of a problem to first order, the passive coordinates eliminated.

Near closed loops, g(q, θ) ≈ 0, by the implicit function theorem

    dq = −g_q⁻¹ (g + g_θ dθ),  h = h + h_q dq,  J = h_θ − h_q g_q⁻¹ g_θ

Postures with as many readings are taken together: all of theirs are one product of matrices. Of
the twists that errors make only those of placements with a free error are looked at.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthocal.kinematics.compiled import CompiledRobot
from orthocal.kinematics.continuation import MachineNumbers
from orthocal.kinematics.error_map import Slopes
from orthocal.observation.observations import Observations
from orthocal.observation.sensor_groups import SensorGroup

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

POSTURES_AT_ONCE, READINGS_AT_ONCE = 64, 640
"""Whose derivatives are held at a time: what they are held in stays in the processor's cache."""

MANY_ROWS = 400
"""From which on a product with a sparse matrix takes less than making it."""


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Postures with the same number of readings."""

    postures: Indices
    """Shape (k,)."""
    entries: Indices
    """Those of each posture, shape (k, m)."""
    members: tuple[tuple[int, Indices, Indices], ...]
    """Sensor groups: index; where in `entries`, flat; and where in the group, shape (n,) each."""


@dataclass(frozen=True, slots=True, eq=False)
class Expansion:
    """Readings to first order about some θ̂ and passive coordinates."""

    reading: Array
    """h there, shape (n_entries,), [m]."""
    opening: Array
    """What closing the loops adds to it, shape (n_entries,), [m]."""
    jacobian: Array
    """dh/dθ̂, shape (n_entries, n_free), [m per tolerance]."""
    correction: Array
    """dq that closes the loops, shape (n_postures, n_passive), [m, rad]."""
    closings: tuple[tuple[Indices, Array, Array, Array], ...]
    """Of each part: postures, −g_q⁻¹, ∂g by actuated coordinates and the nonzeros by twists."""
    pattern: tuple[Indices, Indices]
    """Row and column of those nonzeros."""
    slopes: Slopes
    drives: Array
    """Commanded coordinates, shape (n_postures, n_drives), [m, rad]."""

    def scaled(self, tolerances: Array, noise: Array) -> Expansion:
        """With what is not known of sensors by their tolerances, and readings by their noise.

        Args:
            tolerances: Of the unknowns, the last columns of the Jacobian, [SI].
            noise: Of each entry's readings, as a multiple of the first gauge's, shape (n_entries,).
        """
        jacobian = self.jacobian
        jacobian[:, jacobian.shape[1] - tolerances.size :] *= tolerances
        if (noise == 1.0).all():
            return self
        return replace(
            self,
            reading=self.reading / noise,
            opening=self.opening / noise,
            jacobian=jacobian / noise[:, None],
        )

    def follow(self, change: Array) -> Array:
        """Change of the passive coordinates that closes the loops, with θ̂ changed.

        Args:
            change: dθ̂, shape (n_free,); what is of sensors moves nothing.

        Returns:
            Shape (n_postures, n_passive), [m, rad].
        """
        result = np.array(self.correction)
        change = change[: self.slopes.twists.shape[1]]
        twists = self.slopes.twists @ change
        offsets, gains = self.slopes.offsets @ change, self.slopes.gains @ change
        rows, columns = self.pattern
        for postures, inverse, by_actuated, nonzeros in self.closings:
            by_row = np.zeros((rows.size, inverse.shape[2]))
            by_row[np.arange(rows.size), rows] = twists[columns]
            moved = offsets + gains * self.drives[postures]
            opened = nonzeros @ by_row + (by_actuated @ moved[..., None])[..., 0]
            result[postures] += (inverse @ opened[..., None])[..., 0]
        return result


def partition(observations: Observations, groups: Sequence[SensorGroup]) -> tuple[Part, ...]:
    """Postures that are read, in parts with as many readings each."""
    group = np.zeros(observations.size, dtype=np.int64)
    place = np.zeros(observations.size, dtype=np.int64)
    for i, g in enumerate(groups):
        group[g.entries], place[g.entries] = i, np.arange(g.entries.size)
    order = np.argsort(observations.posture, kind="stable")
    postures, starts, counts = np.unique(
        observations.posture[order], return_index=True, return_counts=True
    )
    parts = []
    for m in np.unique(counts).tolist():
        chosen = np.flatnonzero(counts == m)
        size = max(1, min(POSTURES_AT_ONCE, READINGS_AT_ONCE // m))
        for first in range(0, chosen.size, size):
            at = chosen[first : first + size]
            entries = order[starts[at][:, None] + np.arange(m)]
            flat = entries.reshape(-1)
            members = [(int(i), np.flatnonzero(group[flat] == i)) for i in np.unique(group[flat])]
            parts.append(
                Part(postures[at], entries, tuple((i, w, place[flat[w]]) for i, w in members))
            )
    return tuple(parts)


class Expander:
    """Expands the readings of a problem, whatever its errors.

    Args:
        compiled: Functions of the robot.
        observations: What is read where.
        groups: The same by their sensors' expressions.
        drives: Commanded coordinates of all postures, shape (n_postures, n_drives), [m, rad].
        zero_drives: Those of the mechanical zero while each setup stood, shape (n_setups,
            n_drives), [m, rad].
        used: Which components of twists any free error moves, shape (n_twists,).
    """

    def __init__(
        self,
        compiled: CompiledRobot,
        observations: Observations,
        groups: Sequence[SensorGroup],
        *,
        drives: Array,
        zero_drives: Array,
        used: NDArray[np.bool_],
    ) -> None:
        self._compiled = compiled
        self._observations = observations
        self._groups = tuple(groups)
        self._drives, self._zero_drives = drives, zero_drives
        self._used = np.flatnonzero(used)
        place = np.full(used.size, -1)
        place[self._used] = np.arange(self._used.size)
        self._parts = partition(observations, groups)
        self._closing = _Scatter.of(compiled.twist_pattern, place)
        self._reading = [_Scatter.of(g.reading.slopes.pattern("by_twists"), place) for g in groups]

    def __call__(
        self,
        machine: MachineNumbers,
        slopes: Slopes,
        passive: Array,
        unknowns: Array,
        set_by: Array | None = None,
    ) -> Expansion:
        """Expand about a machine, with what errors do to it, and passive coordinates.

        Args:
            machine: The machine.
            slopes: What tolerances of the free errors do to it.
            passive: Shape (n_postures, n_passive), [m, rad].
            unknowns: Those of the sensors, shape (n_unknowns,), [SI].
            set_by: What tolerances of free errors do to these, shape (n_unknowns, n_free), [SI].

        Raises:
            LinAlgError: If a posture is singular.
        """
        n, n_free = self._observations.size, slopes.offsets.shape[1]
        reading, opening, correction = np.empty(n), np.empty(n), np.zeros_like(passive)
        whole = np.empty((n, n_free + unknowns.size))
        jacobian, by_unknowns = whole[:, :n_free], whole[:, n_free:]
        by_twists = _Chain.of(slopes.twists[self._used], n)
        zero = machine.drives(self._zero_drives)
        closings = []
        for part in self._parts:
            k, m = part.entries.shape
            drives, q = self._drives[part.postures], passive[part.postures]
            actuated = machine.drives(drives)
            g, g_a, g_q, nonzeros = self._compiled.slopes(actuated, q, machine.placements)
            inverse = -_inverse(g_q)
            correction[part.postures] = (inverse @ g[..., None])[..., 0]
            nonzeros = nonzeros[:, self._closing.chosen]
            closings.append((part.postures, inverse, g_a, nonzeros))
            rows = self._read(part, actuated, q, machine.placements, zero, unknowns)
            by_unknowns[part.entries.reshape(-1)] = rows.by_unknowns
            pull = rows.by_passive.reshape(k, m, -1) @ inverse
            twists = rows.by_twists.reshape(k, m, -1)
            if self._used.size:
                twists += pull @ self._closing.dense(nonzeros, g.shape[1])
            by_drives = rows.by_actuated.reshape(k, m, -1) + pull @ g_a
            at_zero = rows.by_zero.reshape(k, m, -1)
            stood = self._zero_drives[self._observations.setup[part.entries]]
            commanded = by_drives * drives[:, None, :] + at_zero * stood
            found = (by_drives + at_zero) @ slopes.offsets + commanded @ slopes.gains
            found = found.reshape(k * m, -1)
            if self._used.size:
                found += by_twists(twists.reshape(k * m, -1))
            jacobian[part.entries.reshape(-1)] = found
            reading[part.entries] = rows.reading.reshape(k, m)
            opening[part.entries] = (pull @ g[..., None])[..., 0]
        if set_by is not None:
            moved = np.flatnonzero(set_by.any(axis=1))
            jacobian += by_unknowns[:, moved] @ set_by[moved]
        pattern = self._closing.rows, self._used[self._closing.columns]
        return Expansion(
            reading,
            opening,
            whole,
            correction,
            tuple(closings),
            pattern,
            slopes,
            self._drives,
        )

    def _read(
        self,
        part: Part,
        actuated: Array,
        passive: Array,
        placements: Array,
        zero: Array,
        unknowns: Array,
    ) -> _Rows:
        """Readings of a part and their slopes by all that moves them."""
        k, m = part.entries.shape
        n_d, n_p = actuated.shape[1], passive.shape[1]
        sizes = (n_d, n_p, self._used.size, n_d, unknowns.size)
        result = _Rows(np.empty(k * m), *(np.zeros((k * m, size)) for size in sizes))
        for index, where, own in part.members:
            group, at = self._groups[index], where // m
            h, h_a, h_q, nonzeros, h_z, h_u = group.reading.slopes(
                actuated[at],
                passive[at],
                placements,
                zero[group.setups[own]],
                group.constants[own],
                unknowns[group.unknowns[own]],
            )
            result.reading[where] = h[:, 0]
            result.by_actuated[where] = h_a[:, 0]
            result.by_passive[where] = h_q[:, 0]
            result.by_zero[where] = h_z[:, 0]
            result.by_unknowns[where[:, None], group.unknowns[own]] = h_u[:, 0]
            scatter = self._reading[index]
            if scatter.chosen.size:
                result.by_twists[where[:, None], scatter.columns] = nonzeros[:, scatter.chosen]
        return result


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Readings and their slopes, one a row."""

    reading: Array
    by_actuated: Array
    by_passive: Array
    by_twists: Array
    by_zero: Array
    by_unknowns: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Scatter:
    """Where nonzeros by twists go among the columns that are used."""

    chosen: Indices
    rows: Indices
    columns: Indices
    n_columns: int

    @staticmethod
    def of(pattern: tuple[Indices, Indices], place: Indices) -> _Scatter:
        """The nonzeros of columns that have a place."""
        rows, columns = pattern
        chosen = np.flatnonzero(place[columns] >= 0)
        return _Scatter(
            chosen, rows[chosen], place[columns[chosen]], int(place.max(initial=-1)) + 1
        )

    def dense(self, nonzeros: Array, n_rows: int) -> Array:
        """Matrices of the chosen nonzeros, shape (k, n_rows, n_columns) of (k, n_chosen)."""
        result = np.zeros((len(nonzeros), n_rows * self.n_columns))
        result[:, self.rows * self.n_columns + self.columns] = nonzeros
        return result.reshape(len(nonzeros), n_rows, self.n_columns)


@dataclass(frozen=True, slots=True, eq=False)
class _Chain:
    """Rows by twists to rows by θ̂: each error moves a placement or a few."""

    matrix: Any
    """∂ξ/∂θ̂ᵀ, sparse where there are many rows."""

    @staticmethod
    def of(slopes: Array, n_rows: int) -> _Chain:
        """Of ∂ξ/∂θ̂, shape (n_used, n_free), for so many rows."""
        if not slopes.size or n_rows < MANY_ROWS:
            return _Chain(slopes.T)
        from scipy.sparse import csr_array

        return _Chain(csr_array(slopes.T))

    def __call__(self, rows: Array) -> Array:
        """Shape (n, n_free) of (n, n_used)."""
        return np.asarray((self.matrix @ np.ascontiguousarray(rows.T)).T)


def _inverse(matrices: Array) -> Array:
    """Inverses of square matrices, shape (K, n, n); least squares of others."""
    if matrices.shape[1] == matrices.shape[2]:
        return np.asarray(np.linalg.inv(matrices))
    return np.asarray(np.linalg.pinv(matrices, rcond=1e-10))
