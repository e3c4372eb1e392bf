"""The observation model: predicted readings h(q, θ, ν) and their derivatives.

A reading depends on the geometry of the machine (errors θ), on the passive coordinates q that close
the loops, and on nuisance parameters ν of its sensor. Gauge zeros are not part of the model. Near
closed loops, g(q, θ) ≈ 0, the implicit function theorem gives

    dq = −g_q⁻¹ (g + g_θ dθ),  J = h_θ − h_q g_q⁻¹ g_θ

Everything takes batches: S machines that differ in their errors, in K postures with any number of
readings each. One machine is a batch of one. Simulation, solvers, predictive distributions, plans
and studies all use this module.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array, Indices
from orthocal.effects.adjustment import find_adjustments
from orthocal.kinematics.error_map import ErrorMap, VaryingDerivatives
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.robot_functions import RobotFunctions, robot_functions
from orthocal.observation.manual_alignment import ManualAlignment, list_alignments, virtual_session
from orthocal.observation.observations import (
    Observations,
    States,
    adjustment_table,
    build_observations,
)
from orthocal.observation.sensor_groups import (
    NuisanceParameters,
    SensorGroup,
    group_sensors,
    nuisance_parameters,
)
from orthocal.robot.closing import RANK_TOLERANCE
from orthocal.session.session import Session

MAX_POSTURES, MAX_READINGS = 64, 640
"""Postures and readings of one block: its Jacobians stay in the processor's cache."""

MAX_PREDICTED = 4096
"""Readings of all machines that are predicted together, for the memory of their inputs."""

MIN_SPARSE_ROWS = 400
"""Rows from which a product with a sparse matrix is faster than with a dense one."""


@dataclass(frozen=True, slots=True, eq=False)
class FreeParameters:
    """Scaled free parameters θ̂: machine errors first, then nuisance parameters."""

    columns: Array
    """Elementary errors of one unit of each machine parameter, (n_errors, n_machine), [SI]."""
    nuisance_scale: Array
    """One unit of each nuisance parameter, shape (n_nuisance,), [SI]."""
    pattern: _ClosurePattern
    """Nonzeros of ∂g by the twists that the machine parameters move."""


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """Loop closures with the same number of readings."""

    states: Indices
    """Shape (k,)."""
    entries: Indices
    """Entries of each state, shape (k, m). The second postures of pairs follow all entries."""
    members: tuple[tuple[int, bool, Indices, Indices], ...]
    """Sensor groups: index; True for second postures of pairs; positions in `entries`, flat; and
    positions in the group, (n,) each."""


@dataclass(frozen=True, slots=True, eq=False)
class _Closures:
    """Derivatives of the loop closures of a block, for S machines."""

    residual: Array
    """g, shape (S, k, n_rows), [m]."""
    inverse: Array
    """g_q⁻¹, shape (S, k, n_passive, n_rows)."""
    by_drive_errors: Array
    """Shape (S, k, n_rows, n_drive_errors)."""
    by_twists: Array
    """Nonzeros in the order of the model's pattern, shape (S, k, nnz)."""


@dataclass(frozen=True, slots=True, eq=False)
class _Readings:
    """Readings of a block and their derivatives, for S machines; shape (S, k m, ...)."""

    value: Array
    by_drive_errors: Array
    """By the errors of the drives, in the posture and in the reference posture."""
    by_passive: Array
    by_nuisance: Array
    by_twists: Sequence[tuple[Indices, Indices, Array]]
    """Of each sensor group: positions, (n,), columns, (nnz,), and nonzeros, (S, n, nnz)."""


@dataclass(frozen=True, slots=True, eq=False)
class _ClosurePattern:
    """Nonzeros of ∂g by the twists that free parameters move, sorted by rows of g."""

    used: Indices
    """Columns of the twists that free parameters move."""
    place: Indices
    """Position of each twist column among the used ones, -1 for others, shape (n_twists,)."""
    chosen: Indices
    """Their positions among all nonzeros."""
    rows: Indices
    columns: Indices
    """Row and column of each, shape (nnz,)."""

    @staticmethod
    def of(functions: RobotFunctions, columns: Array) -> _ClosurePattern:
        moved = functions.errors.twists_moved_by(columns).reshape(-1, 6).any(axis=1)
        used = np.flatnonzero(np.repeat(moved, 6))
        place = np.full(functions.n_twists, -1)
        place[used] = np.arange(used.size)
        rows, twists = functions.twist_pattern
        chosen = np.flatnonzero(place[twists] >= 0)
        chosen = chosen[np.argsort(rows[chosen], kind="stable")]
        return _ClosurePattern(used, place, chosen, rows[chosen], twists[chosen])

    def dense(self, nonzeros: Array, n_rows: int) -> Array:
        """Matrices of nonzeros, shape (S, k, n_rows, n_used) of (S, k, nnz)."""
        result: Array = np.zeros((*nonzeros.shape[:2], n_rows * self.used.size))
        result[:, :, self.rows * self.used.size + self.place[self.columns]] = nonzeros
        return result.reshape(*nonzeros.shape[:2], n_rows, self.used.size)

    def times(self, nonzeros: Array, twists: Array, n_rows: int) -> Array:
        """∂g · ξ of nonzeros, (S, k, nnz), and twists, (S, k, n_twists), or (S, 1, n_twists).

        Returns:
            Shape (S, k, n_rows).
        """
        n_sets = max(len(twists), len(nonzeros))
        result = np.zeros((n_sets, nonzeros.shape[1], n_rows))
        for row, part in self._row_parts(n_rows):
            moved = twists[:, :, self.columns[part]]
            if twists.shape[1] == 1:
                result[..., row] = (nonzeros[..., part] @ np.swapaxes(moved, 1, 2))[..., 0]
            else:
                result[..., row] = (nonzeros[..., part] * moved).sum(axis=-1)
        return result

    def _row_parts(self, n_rows: int) -> Iterator[tuple[int, slice]]:
        """Rows that have nonzeros, and the slice of each."""
        starts = np.searchsorted(self.rows, np.arange(n_rows + 1)).tolist()
        for row, (first, end) in enumerate(itertools.pairwise(starts)):
            if end > first:
                yield row, slice(first, end)


class ObservationModel:
    """Readings of a session's entries as functions of errors and nuisance parameters.

    Args:
        session: Setups, postures and robot; the values of its readings do not matter.
        observations: The entries to predict; those of the session's readings by default.

    Attributes:
        states: Loop closures; one for each posture, unless effects on the kinematics need
            conditions of its readings (`States`).
        nuisance: Nuisance parameters of the session's sensors.
    """

    def __init__(self, session: Session, observations: Observations | None = None) -> None:
        self.session = session
        self.observations = build_observations(session) if observations is None else observations
        self.functions: RobotFunctions = robot_functions(session.robot)
        self.nuisance: NuisanceParameters = nuisance_parameters(session)
        self.states = self.observations.states

    @cached_property
    def groups(self) -> tuple[SensorGroup, ...]:
        """Entries by the expression of their sensors."""
        return group_sensors(self.session, self.observations)

    @cached_property
    def alignment(self) -> ManualAlignment:
        """Nuisance parameters at which the operator aligned the gauges, as functions of errors.

        Raises:
            ClosureError: If the nominal machine cannot reach a posture of alignment.
        """
        errors = self.functions.errors
        sensitivity = np.zeros((len(self.nuisance.parameters), len(errors.names)))
        start = np.zeros(len(self.nuisance.parameters))
        alignments = list_alignments(self.session, self.nuisance)
        if alignments:
            index = [a.parameter for a in alignments]
            virtual = virtual_session(self.session, alignments)
            by_errors = nominal_sensitivity(virtual)
            offsets = errors.columns([f"{d.name}.offset" for d in self.session.robot.drives])
            active = np.array([a.active for a in alignments])
            sensitivity[index] = by_errors
            start[index] = -((by_errors @ offsets) * active).sum(axis=1)
            amounts = [a.parameter for a in find_adjustments(self.session.robot)]
            changes = (by_errors @ errors.columns(amounts)) * adjustment_table(virtual)
            start[index] += changes.sum(axis=1)
        return ManualAlignment(sensitivity, start)

    def parametrise(self, columns: Array, nuisance_scale: Array) -> FreeParameters:
        """Free parameters for `linearise`; arguments as the fields of `FreeParameters`."""
        pattern = _ClosurePattern.of(self.functions, columns)
        return FreeParameters(columns, nuisance_scale, pattern)

    def predict(
        self,
        errors: Array,
        passive: Array,
        nuisance: Array | None = None,
    ) -> Array:
        """Readings with gauge zeros at 0.

        Args:
            errors: Elementary errors, shape (n_errors,), or (S, n_errors) for a batch, [SI].
            passive: Passive coordinates with closed loops, shape (n_states, n_passive), with S in
                front for a batch, [m, rad].
            nuisance: Nuisance parameters as deviations from the manual alignment, shape
                (n_nuisance,), with S in front for a batch, [SI]; 0 by default.

        Returns:
            Shape (n_entries,), with S in front for a batch, [m].
        """
        at, q, nu = self._batch(errors, passive, nuisance)
        machines, n_sets = _Machines(self, at), len(at)
        result = np.empty((n_sets, self.observations.size))
        for group in self.groups:
            size = max(1, MAX_PREDICTED // n_sets)
            for first in range(0, group.entries.size, size):
                part = np.arange(first, min(first + size, group.entries.size))
                (h,) = group.reading.value(*self._inputs(group, part, machines, q, nu))
                result[:, group.entries[part]] = h.reshape(n_sets, part.size)
        return result if errors.ndim > 1 else result[0]

    def linearise(
        self,
        errors: Array,
        passive: Array,
        nuisance: Array | None = None,
        *,
        free: FreeParameters,
        noise_ratio: Array | None = None,
        aligned: bool = True,
    ) -> ReadingLinearisation:
        """Readings to first order about machines and passive coordinates near closed loops.

        Args:
            errors: As for `predict`.
            passive: As for `predict`; the loops need not be closed exactly.
            nuisance: As for `predict`.
            free: The free parameters.
            noise_ratio: Divisor of each entry's reading, shape (n_entries,); 1 by default.
            aligned: Add the manual alignment to the nuisance parameters.

        Raises:
            LinAlgError: If a posture is singular.
        """
        at, q, nu = self._batch(errors, passive, nuisance, aligned=aligned)
        alignment = self.alignment.sensitivity if aligned else np.zeros((nu.shape[1], at.shape[1]))
        divisor = np.ones(self.observations.size) if noise_ratio is None else noise_ratio
        return ReadingLinearisation(
            self,
            at,
            q,
            nu,
            free=free,
            alignment=alignment,
            noise_ratio=divisor,
            batch=errors.ndim > 1,
        )

    def _batch(
        self, errors: Array, passive: Array, nuisance: Array | None, *, aligned: bool = True
    ) -> tuple[Array, Array, Array]:
        """Errors, passive coordinates and nuisance parameters with a leading dimension."""
        at, n = np.atleast_2d(errors), len(self.nuisance.parameters)
        q = passive if passive.ndim == 3 else np.broadcast_to(passive, (len(at), *passive.shape))
        nu = self.alignment(at) if aligned else np.zeros((len(at), n))
        return at, q, nu if nuisance is None else nu + np.atleast_2d(nuisance)

    def _inputs(
        self,
        group: SensorGroup,
        part: Indices,
        machines: _Machines,
        passive: Array,
        nuisance: Array,
    ) -> tuple[Array, ...]:
        """Inputs of a sensor's functions for part of its group on all machines.

        Args:
            group: The group.
            part: Positions in the group, shape (n,).
            machines: The machines.
            passive: Passive coordinates, shape (S, n_states, n_passive), [m, rad].
            nuisance: Shape (S, n_nuisance), [SI].
        """
        n_sets, n = len(passive), part.size
        entries = group.entries[part]
        states = self.observations.state[entries]

        def coordinates(states: Indices) -> tuple[Array, Array]:
            actuated = machines.actuated[:, states].reshape(n_sets * n, -1)
            return actuated, passive[:, states].reshape(n_sets * n, -1)

        of_second = coordinates(self.observations.second[entries]) if group.reading.pairs else ()
        return (
            *coordinates(states),
            machines.placements(states),
            machines.reference[:, group.setups[part]].reshape(n_sets * n, -1),
            np.tile(group.constants[part], (n_sets, 1)),
            nuisance[:, group.nuisance[part]].reshape(n_sets * n, -1),
            *of_second,
        )

    @cached_property
    def reference_commands(self) -> Array:
        """Commands of the reference posture, shape (n_setups, n_command).

        The drives are at the mechanical zero as each setup knew it, under neutral conditions: a
        gauge on the base stays where it is when the machine gets warmer.
        """
        return self.functions.errors.command(self.session.zero_drives)

    def blocks(self, n_sets: int) -> tuple[_Block, ...]:
        """All states with readings, by their number, for a batch of machines."""
        o, paired = self.observations, self.paired
        group, place = np.zeros((2, o.size), dtype=np.int64)
        for i, g in enumerate(self.groups):
            group[g.entries], place[g.entries] = i, np.arange(g.entries.size)
        # of each sensor group the first postures, then the second ones
        member = np.concatenate([2 * group, 2 * group[paired] + 1])
        place = np.concatenate([place, place[paired]])
        state = np.concatenate([o.state, o.second[paired]])
        order = np.argsort(state, kind="stable")
        states, starts, counts = np.unique(state[order], return_index=True, return_counts=True)
        blocks = []
        for m in np.unique(counts).tolist():
            chosen = np.flatnonzero(counts == m)
            size = max(1, min(MAX_POSTURES, MAX_READINGS // m) // n_sets)
            for first in range(0, chosen.size, size):
                at = chosen[first : first + size]
                entries = order[starts[at][:, None] + np.arange(m)]
                flat = entries.reshape(-1)
                parts = [
                    (int(i), np.flatnonzero(member[flat] == i)) for i in np.unique(member[flat])
                ]
                members = tuple((i // 2, i % 2 == 1, w, place[flat[w]]) for i, w in parts)
                blocks.append(_Block(states[at], entries, members))
        return tuple(blocks)

    @cached_property
    def paired(self) -> Indices:
        """Entries of pairs of postures, shape (n_pairs,)."""
        return np.flatnonzero(self.observations.second >= 0)

    def gather(self, values: Array) -> Array:
        """Values of entries, shape (S, n, ...), of those with the second postures of pairs after.

        The parts of a pair add up.
        """
        if not self.paired.size:
            return values
        n = self.observations.size
        result = values[:, :n].copy()
        result[:, self.paired] += values[:, n:]
        return result

    @cached_property
    def _single_blocks(self) -> tuple[_Block, ...]:
        return self.blocks(1)


class _Machines:
    """Drives and placements of S machines in the states of a model.

    Args:
        model: The observation model.
        errors: Elementary errors, shape (S, n_errors), [SI].

    Attributes:
        actuated: Actual drive coordinates, shape (S, n_states, n_drives), [m, rad].
        reference: The same in the reference posture of each setup, shape (S, n_setups, n_drives).
    """

    def __init__(self, model: ObservationModel, errors: Array) -> None:
        map_, self._states = model.functions.errors, model.states
        self.geometry = map_.geometry(errors, self._states.variant_commands[0])
        self.actuated = self.geometry.drives(self._states.commands)
        self.reference = self.geometry.drives(model.reference_commands)
        self._placements = map_.placements_under(errors, self._states.variant_commands)

    def placements(self, states: Indices) -> Array:
        """Moved placements, shape (S, 12 n_moved), or (S n, 12 n_moved) if n states differ."""
        under = self._placements
        if under.shape[1] > 1:
            under = under[:, self._states.variant[states]]
        return under.reshape(-1, under.shape[-1])


class ReadingLinearisation:
    """Readings of a batch of machines to first order.

    Shapes are those of a batch of S machines; S is absent where one machine was linearised.

    Args:
        model: The observation model.
        errors: Elementary errors, shape (S, n_errors), [SI].
        passive: Passive coordinates, shape (S, n_states, n_passive), [m, rad].
        nuisance: Nuisance parameters, shape (S, n_nuisance), [SI].
        free: The free parameters.
        alignment: Derivative of the nuisance parameters by errors, shape (n_nuisance, n_errors).
        noise_ratio: Divisor of each entry's reading, shape (n_entries,).
        batch: Keep the leading dimension of results.

    Attributes:
        reading: h at the given passive coordinates, shape (S, n_entries), [m].
        opening: Change of h when the loops are closed, to first order, shape (S, n_entries), [m].
        correction: Change of the passive coordinates that closes the loops, shape (S, n_states,
            n_passive), [m, rad].
        jacobian: dh/dθ̂ with the loops closed, shape (S, n_entries, n_free), [m per unit of θ̂].
    """

    def __init__(
        self,
        model: ObservationModel,
        errors: Array,
        passive: Array,
        nuisance: Array,
        *,
        free: FreeParameters,
        alignment: Array,
        noise_ratio: Array,
        batch: bool,
    ) -> None:
        self._model, self._free, self._batch = model, free, batch
        by_errors = alignment @ free.columns
        self._machines = _Machines(model, errors)
        geometry = self._machines.geometry
        _, self._by_drive_errors = geometry.drive_derivatives(model.states.commands)
        _, self._by_reference = geometry.drive_derivatives(model.reference_commands)
        self._pattern = free.pattern
        map_, n_sets = model.functions.errors, len(errors)
        n = model.observations.size + model.paired.size
        sparse = n_sets == 1 and n >= MIN_SPARSE_ROWS
        self._twists = _TwistChain(map_, errors, model.states, free, sparse=sparse)
        self._by_machine = free.columns[map_.drive_errors]
        n_machine, n_nuisance = free.columns.shape[1], free.nuisance_scale.size
        reading, opening = np.empty((n_sets, n)), np.empty((n_sets, n))
        correction = np.zeros_like(passive, dtype=np.float64)
        jacobian = np.empty((n_sets, n, n_machine + n_nuisance))
        self._blocks: list[tuple[_Block, _Closures]] = []
        for block in model._single_blocks if n_sets == 1 else model.blocks(n_sets):
            closures = self._evaluate_closures(block, passive)
            readings = self._evaluate_readings(block, passive, nuisance)
            dq = -(closures.inverse @ closures.residual[..., None])[..., 0]
            correction[:, block.states] = dq
            k, m = block.entries.shape
            entries = block.entries.reshape(-1)
            by_passive = readings.by_passive.reshape(n_sets, k, m, -1)
            reading[:, entries] = readings.value
            opening[:, entries] = (by_passive @ dq[..., None]).reshape(n_sets, k * m)
            jacobian[:, entries, :n_machine] = self._machine_rows(block, closures, readings)
            jacobian[:, entries, n_machine:] = readings.by_nuisance
            self._blocks.append((block, closures))
        reading, opening, jacobian = (model.gather(v) for v in (reading, opening, jacobian))
        aligned = np.flatnonzero(by_errors.any(axis=1))
        by_nuisance = jacobian[:, :, n_machine:]
        if aligned.size:
            jacobian[:, :, :n_machine] += by_nuisance[:, :, aligned] @ by_errors[aligned]
        by_nuisance *= free.nuisance_scale
        if (noise_ratio != 1.0).any():
            reading, opening = reading / noise_ratio, opening / noise_ratio
            jacobian /= noise_ratio[:, None]
        self.reading, self.opening = self._squeeze(reading), self._squeeze(opening)
        self.correction, self.jacobian = self._squeeze(correction), self._squeeze(jacobian)

    def follow(self, change: Array) -> Array:
        """Change of the passive coordinates that closes the loops after a change of θ̂.

        Args:
            change: dθ̂, shape (S, n_free); many changes of one machine are possible, too.

        Returns:
            Shape (S, n_states, n_passive), [m, rad]; it includes `correction`.
        """
        d = np.atleast_2d(change)
        machine = d[:, : self._free.columns.shape[1], None]
        twists = self._twists.follow(machine)
        drive_errors = (self._by_machine @ machine)[:, None]
        correction = self.correction if self._batch else self.correction[None]
        result = np.array(np.broadcast_to(correction, (len(d), *correction.shape[1:])))
        for block, closures in self._blocks:
            opened = (closures.by_drive_errors @ drive_errors)[..., 0]
            moved = twists
            if twists.shape[1] > 1:
                moved = twists[:, self._model.states.variant[block.states]]
            opened += self._pattern.times(closures.by_twists, moved, opened.shape[2])
            result[:, block.states] -= (closures.inverse @ opened[..., None])[..., 0]
        return result if change.ndim > 1 else result[0]

    def _evaluate_closures(self, block: _Block, passive: Array) -> _Closures:
        n_sets, k = len(passive), block.states.size
        outputs = self._model.functions.closure_jacobian(
            self._machines.actuated[:, block.states].reshape(n_sets * k, -1),
            passive[:, block.states].reshape(n_sets * k, -1),
            self._machines.placements(block.states),
        )
        g, g_a, g_q, nonzeros = (v.reshape(n_sets, k, *v.shape[1:]) for v in outputs)
        by_drive_errors = g_a @ self._by_drive_errors[:, block.states]
        return _Closures(g, _inverse(g_q), by_drive_errors, nonzeros[:, :, self._pattern.chosen])

    def _evaluate_readings(self, block: _Block, passive: Array, nuisance: Array) -> _Readings:
        model, (k, m) = self._model, block.entries.shape
        n_sets, n_passive = len(passive), passive.shape[2]
        n_drive_errors = self._by_drive_errors.shape[-1]
        by_twists: list[tuple[Indices, Indices, Array]] = []
        result = _Readings(
            np.empty((n_sets, k * m)),
            np.zeros((n_sets, k * m, n_drive_errors)),
            np.zeros((n_sets, k * m, n_passive)),
            np.zeros((n_sets, k * m, nuisance.shape[1])),
            by_twists,
        )
        for index, of_second, where, place in block.members:
            group, states = model.groups[index], block.states[where // m]
            setups = group.setups[place]
            inputs = model._inputs(group, place, self._machines, passive, nuisance)
            outputs = group.reading.jacobian(*inputs)
            h, h_a, h_q, nonzeros, h_r, h_nu, *second = (
                v.reshape(n_sets, where.size, -1) for v in outputs
            )
            if of_second:
                h_a, h_q = second
            by_drive_errors = h_a[:, :, None] @ self._by_drive_errors[:, states]
            result.by_passive[:, where] = h_q
            if of_second:  # the other parts belong to the first posture
                result.value[:, where] = 0.0
                result.by_drive_errors[:, where] = by_drive_errors[:, :, 0]
                continue
            by_drive_errors += h_r[:, :, None] @ self._by_reference[:, setups]
            result.value[:, where] = h[..., 0]
            result.by_drive_errors[:, where] = by_drive_errors[:, :, 0]
            result.by_nuisance[:, where[:, None], group.nuisance[place]] = h_nu
            _, columns = group.reading.jacobian.pattern("by_twists")
            by_twists.append((where, columns, nonzeros))
        return result

    def _machine_rows(self, block: _Block, closures: _Closures, readings: _Readings) -> Array:
        """∂h by the machine's parameters with the loops closed, shape (S, k m, n_machine)."""
        (k, m), n_sets, used = block.entries.shape, len(readings.value), self._pattern.used
        pull = -(readings.by_passive.reshape(n_sets, k, m, -1) @ closures.inverse)
        by_drive_errors = readings.by_drive_errors.reshape(n_sets, k, m, -1)
        by_drive_errors = by_drive_errors + pull @ closures.by_drive_errors
        rows = (by_drive_errors @ self._by_machine).reshape(n_sets, k * m, -1)
        if used.size:
            twists = np.zeros((n_sets, k * m, used.size))
            for where, columns, nonzeros in readings.by_twists:
                moved = np.flatnonzero(self._pattern.place[columns] >= 0)
                at = self._pattern.place[columns[moved]]
                twists[:, where[:, None], at] = nonzeros[:, :, moved]
            dense = self._pattern.dense(closures.by_twists, pull.shape[-1])
            twists += (pull @ dense).reshape(n_sets, k * m, -1)
            rows += self._twists(twists, np.repeat(block.states, m))
        return rows

    def _squeeze(self, values: Array) -> Array:
        return values if self._batch else values[0]


class _TwistChain:
    """Chain rule from the twists of placements to the machine parameters, for S machines.

    Args:
        map_: The error map.
        errors: Elementary errors of the machines, shape (S, n_errors), [SI].
        states: States, with the conditions of their placements.
        free: The free parameters.
        sparse: Multiply rows with a sparse matrix; for one machine.
    """

    def __init__(
        self, map_: ErrorMap, errors: Array, states: States, free: FreeParameters, *, sparse: bool
    ) -> None:
        pattern, commands = free.pattern, states.variant_commands
        self._used, self._columns, self._variant = pattern.used, free.columns, states.variant
        self._map, self._errors, self._command = map_, errors, commands[0]
        self._sparse = sparse and self._used.size > 0
        self._inner = map_.twist_columns(errors, free.columns, self._command)
        self._right = np.zeros((1, len(map_.moved), 6, 6))
        if self._used.size:
            self._right = map_.right_jacobians(errors, self._command)
        self._varying: VaryingDerivatives | None = None
        if len(commands) > 1 and self._used.size:
            self._varying = map_.varying_derivatives(errors, free.columns, commands)
            self._of_varying = (6 * map_.varying[:, None] + np.arange(6)).reshape(-1)
            self._place = pattern.place[self._of_varying]

    @cached_property
    def _matrix(self) -> Any:  # noqa: ANN401 - SciPy has no types
        """∂ξ/∂θ̂ of the twists that parameters move, (S, n_used, n), or sparse and transposed.

        Twists that vary with the conditions are 0.
        """
        jacobian = self._map.jacobian(
            self._errors, self._columns, command=self._command, right=self._right
        )
        if self._varying is not None:
            jacobian[:, self._of_varying] = 0.0
        matrix = jacobian[:, self._used]
        if not self._sparse:
            return matrix
        from scipy.sparse import csr_array

        return csr_array(matrix[0].T)

    def __call__(self, rows: Array, states: Indices) -> Array:
        """Rows by machine parameters, (S, n, n_machine), of rows by twists, (S, n, n_used).

        Args:
            rows: The rows.
            states: State of each of them, shape (n,).
        """
        if self._sparse:
            result = np.asarray((self._matrix @ np.ascontiguousarray(rows[0].T)).T[None])
        else:
            result = np.asarray(rows @ self._matrix)
        if self._varying is not None:
            result += self._by_varying(self._varying, rows, self._variant[states])
        return result

    def _by_varying(self, varying: VaryingDerivatives, rows: Array, variant: Indices) -> Array:
        """The part of a call's result through the placements that vary."""
        by = np.where(self._place >= 0, rows[:, :, self._place], 0.0)
        by = by.reshape(*rows.shape[:2], -1, 1, 6) @ varying.right[:, variant]
        local = by.reshape(*rows.shape[:2], -1)
        curved = (local[:, :, None, varying.rows] @ varying.jacobian[:, variant])[:, :, 0]
        return np.asarray(local @ varying.constant + curved @ varying.columns)

    def follow(self, change: Array) -> Array:
        """Twists ∂ξ of changes of machine parameters, (D, n_machine, 1).

        Returns:
            Shape (D, 1, n_twists), or (D, V, n_twists) if placements vary under V conditions.
        """
        inner = (self._inner @ change).reshape(len(change), -1, 6, 1)
        result = np.asarray((self._right @ inner).reshape(len(change), 1, -1))
        varying = self._varying
        if varying is None:
            return result
        result = np.repeat(result, varying.right.shape[1], axis=1)
        local = np.repeat((varying.constant @ change)[:, None], result.shape[1], axis=1)
        curved = varying.jacobian @ (varying.columns @ change)[:, None]
        local[:, :, varying.rows] += curved
        moved = varying.right @ local.reshape(*local.shape[:2], -1, 6, 1)
        result[:, :, self._of_varying] = moved.reshape(*local.shape[:2], -1)
        return result


def predict_readings(
    session: Session,
    errors: Mapping[str, float] | None = None,
    *,
    observations: Observations | None = None,
    passive: Array | None = None,
    nuisance: Array | None = None,
) -> Array:
    """Readings of a machine with known errors, gauge zeros at 0, shape (n_entries,), [m].

    Args:
        session: Postures, setups and robot.
        errors: Parameter name to value, [unit of the parameter].
        observations: The entries to predict; those of the session's readings by default.
        passive: Passive coordinates of every state, shape (n_states, n_passive), [m, rad]; solved
            here by default.
        nuisance: Nuisance parameters in the order of `nuisance_parameters`, [SI]; 0 by default.

    Raises:
        ClosureError: If the machine cannot reach a posture.
    """
    model, closure = (
        ObservationModel(session, observations),
        LoopClosure(session.robot, fixed=errors),
    )
    if passive is None:
        passive = closure.close(model.states.commands, names=model.states.names)
    return model.predict(closure.errors(), passive, nuisance)


def nominal_sensitivity(session: Session) -> Array:
    """Derivative of a session's readings by all elementary errors, on the nominal machine.

    Returns:
        Shape (n_entries, n_errors), [m per SI unit of the error].

    Raises:
        ClosureError: If the nominal machine cannot reach a posture.
    """
    model, closure = ObservationModel(session), LoopClosure(session.robot)
    n = len(model.functions.errors.names)
    free = model.parametrise(np.eye(n), np.ones(len(model.nuisance.parameters)))
    passive = closure.close(model.states.commands, names=model.states.names)
    linear = model.linearise(closure.errors(), passive, free=free, aligned=False)
    return linear.jacobian[:, :n]


def _inverse(matrices: ArrayLike) -> Array:
    """Inverses of square matrices, shape (..., n, n); pseudo-inverses of others."""
    m: Array = np.asarray(matrices)
    if m.shape[-2] == m.shape[-1]:
        return np.asarray(np.linalg.inv(m))
    return np.asarray(np.linalg.pinv(m, rcond=RANK_TOLERANCE))
