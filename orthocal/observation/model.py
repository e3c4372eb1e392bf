"""Observation model: predicted readings h(q, θ, ν) and their derivatives.

A reading depends on the errors θ of the machine, on the passive coordinates q that close the loops,
and on nuisance parameters ν of its sensor. Gauge zeros are not part of the model. Near
closed loops, g(q, θ) ≈ 0, the implicit function theorem gives

    dq = −g_q⁻¹ (g + g_θ dθ),  J = h_θ − h_q g_q⁻¹ g_θ

Subscripts denote partial derivatives, and J is the total derivative of h.

All functions accept batches of S machines that differ in their errors, in K postures with any
number of readings each. One machine is a batch of one. Simulation, solvers, predictive
distributions, plans and studies use this module.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from orthocal.arrays import Array, Indices, Mask
from orthocal.effects.adjustment import find_adjustments
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.robot_functions import RobotFunctions, robot_functions
from orthocal.observation.manual_alignment import ManualAlignment, list_alignments, virtual_session
from orthocal.observation.observations import (
    Observations,
    adjustment_table,
    build_observations,
)
from orthocal.observation.sensor_groups import (
    NuisanceParameters,
    SensorGroup,
    group_sensors,
    nuisance_parameters,
)
from orthocal.observation.twist_derivatives import ClosurePattern, FreeParameters, TwistChain
from orthocal.robot.closing import invert_closures
from orthocal.session.session import Session

MAX_POSTURES, MAX_READINGS = 64, 640
"""Largest numbers of postures and readings of a block. Its Jacobians then fit the processor's
cache."""

MAX_PREDICTED = 4096
"""Largest number of readings of all machines per call of a prediction, to limit memory."""

MIN_SPARSE_ROWS = 400
"""Number of rows from which a product with a sparse matrix is faster than with a dense one."""


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """Loop closures with the same number of readings."""

    states: Indices
    """Indices of the loop closures, shape (k,)."""
    entries: Indices
    """Entries of each closure, shape (k, m). The second postures of pairs follow all entries."""
    members: tuple[tuple[int, bool, Indices, Indices], ...]
    """For each sensor group in the block: its index, True for second postures of pairs, positions
    in the flattened `entries`, shape (n,), and positions in the group, shape (n,)."""


@dataclass(frozen=True, slots=True, eq=False)
class _Closures:
    """Derivatives of the loop closures of a block, for S machines."""

    residual: Array
    """g, shape (S, k, n_rows), [m]."""
    inverse: Array
    """g_q⁻¹, shape (S, k, n_passive, n_rows)."""
    by_drive_errors: Array
    """Derivative of g with respect to the drive errors, shape (S, k, n_rows, n_drive_errors)."""
    by_twists: Array
    """Nonzeros of ∂g/∂ξ in the order of the closure pattern, shape (S, k, nnz)."""


@dataclass(frozen=True, slots=True, eq=False)
class _Readings:
    """Readings of a block and their derivatives, for S machines."""

    value: Array
    """h, shape (S, k m), [m]."""
    by_drive_errors: Array
    """Derivative of h with respect to the drive errors, which change the posture and the reference
    posture, shape (S, k m, n_drive_errors)."""
    by_passive: Array
    """h_q, shape (S, k m, n_passive)."""
    by_nuisance: Array
    """h_ν for one unit of each nuisance parameter, shape (S, k m, n_nuisance_columns)."""
    by_alignment: Array | None
    """Part of dh/dθ̂ that is due to the manual alignment, shape (S, k m, n_machine); None without
    alignment."""
    by_twists: Sequence[tuple[Indices, Indices, Array]]
    """For each sensor group: positions of its readings, (n,), columns of the nonzeros of ∂h/∂ξ,
    (nnz,), and the nonzeros, (S, n, nnz)."""


class ObservationModel:
    """Readings of a session's entries as functions of errors and nuisance parameters.

    Args:
        session: Setups, postures and robot; the values of its readings are not used.
        observations: The entries to predict; those of the session's readings by default.

    Attributes:
        states: Loop closures: one per posture, or several if effects on the kinematics depend on
            conditions of its readings (`States`).
        nuisance: Nuisance parameters of the session.
    """

    def __init__(self, session: Session, observations: Observations | None = None) -> None:
        self.session = session
        self.observations = build_observations(session) if observations is None else observations
        self.functions: RobotFunctions = robot_functions(session.robot)
        self.nuisance: NuisanceParameters = nuisance_parameters(session)
        self.states = self.observations.states

    @cached_property
    def groups(self) -> tuple[SensorGroup, ...]:
        """Groups of entries whose sensors have the same expression."""
        return group_sensors(self.session, self.observations)

    @cached_property
    def alignment(self) -> ManualAlignment:
        """Nuisance parameters of aligned gauges as functions of errors.

        Raises:
            ClosureError: If the nominal machine cannot reach an alignment posture.
        """
        errors = self.functions.errors
        sensitivity = np.zeros((len(self.nuisance.parameters), len(errors.names)))
        start = np.zeros(len(self.nuisance.parameters))
        alignments = list_alignments(self.session, self.nuisance)
        if alignments:
            index = [a.parameter for a in alignments]
            virtual = virtual_session(self.session, alignments)
            by_errors = nominal_sensitivity(virtual)
            offsets = errors.unit_errors([f"{d.name}.offset" for d in self.session.robot.drives])
            active = np.array([a.active for a in alignments])
            sensitivity[index] = by_errors
            start[index] = -((by_errors @ offsets) * active).sum(axis=1)
            amounts = [a.parameter for a in find_adjustments(self.session.robot)]
            changes = (by_errors @ errors.unit_errors(amounts)) * adjustment_table(virtual)
            start[index] += changes.sum(axis=1)
        return ManualAlignment(sensitivity, start)

    def parametrise(
        self,
        unit_errors: Array,
        nuisance_scale: Array,
        nuisance_columns: Indices | None = None,
    ) -> FreeParameters:
        """Free parameters for `linearise`; arguments are the fields of `FreeParameters`.

        By default each nuisance parameter has a column of its own.
        """
        if nuisance_columns is None:
            nuisance_columns = np.arange(nuisance_scale.size)
        pattern = ClosurePattern.of(self.functions, unit_errors)
        return FreeParameters(unit_errors, nuisance_scale, nuisance_columns, pattern)

    def predict(
        self,
        errors: Array,
        passive: Array,
        nuisance: Array | None = None,
    ) -> Array:
        """Predict readings with gauge zeros at 0.

        Args:
            errors: Elementary errors, shape (n_errors,), or (S, n_errors) for a batch, [SI].
            passive: Passive coordinates with closed loops, shape (n_states, n_passive), or
                (S, n_states, n_passive), [m, rad].
            nuisance: Nuisance parameters as deviations from the manual alignment, shape
                (n_nuisance,) or (S, n_nuisance), [SI]; 0 by default.

        Returns:
            Shape (n_entries,), or (S, n_entries) for a batch, [m].
        """
        theta, q, nu = self._batch(errors, passive, nuisance)
        machines, n_sets = _Machines(self, theta), len(theta)
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
        """Linearise readings about machines and passive coordinates near closed loops.

        Args:
            errors: Elementary errors, shape (n_errors,), or (S, n_errors) for a batch, [SI].
            passive: Passive coordinates with nearly closed loops, shape (n_states, n_passive), or
                (S, n_states, n_passive), [m, rad].
            nuisance: Nuisance parameters as deviations from the manual alignment, shape
                (n_nuisance,) or (S, n_nuisance), [SI]; 0 by default.
            free: The free parameters.
            noise_ratio: Divisor of each entry's reading (see `CalibrationProblem`), shape
                (n_entries,); 1 by default.
            aligned: True to add the manual alignment to the nuisance parameters.

        Raises:
            LinAlgError: If a posture is singular.
        """
        theta, q, nu = self._batch(errors, passive, nuisance, aligned=aligned)
        shape = nu.shape[1], theta.shape[1]
        alignment = self.alignment.sensitivity if aligned else np.zeros(shape)
        divisor = np.ones(self.observations.size) if noise_ratio is None else noise_ratio
        return ReadingLinearisation(
            self,
            theta,
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
        theta, n = np.atleast_2d(errors), len(self.nuisance.parameters)
        q = passive if passive.ndim == 3 else np.broadcast_to(passive, (len(theta), *passive.shape))
        nu = self.alignment(theta) if aligned else np.zeros((len(theta), n))
        return theta, q, nu if nuisance is None else nu + np.atleast_2d(nuisance)

    def _inputs(
        self,
        group: SensorGroup,
        part: Indices,
        machines: _Machines,
        passive: Array,
        nuisance: Array,
    ) -> tuple[Array, ...]:
        """Inputs of the functions of a sensor group, for some of its entries on all machines.

        Args:
            group: The group.
            part: Positions of the entries in the group, shape (n,).
            machines: The machines.
            passive: Passive coordinates, shape (S, n_states, n_passive), [m, rad].
            nuisance: Nuisance parameters, shape (S, n_nuisance), [SI].
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
        """Commands of the reference posture of each setup, shape (n_setups, n_command).

        The drives are at the mechanical zero with the active offsets of the setup. Conditions are
        neutral, because the position of a gauge on the base does not change when the machine warms
        up.
        """
        return self.functions.errors.command(self.session.zero_drives)

    def blocks(self, n_sets: int) -> tuple[_Block, ...]:
        """Blocks of loop closures with the same number of readings, for S = n_sets machines."""
        o, paired = self.observations, self.paired
        group, position = np.zeros((2, o.size), dtype=np.int64)
        for i, g in enumerate(self.groups):
            group[g.entries], position[g.entries] = i, np.arange(g.entries.size)
        # member 2 i: first postures of sensor group i; member 2 i + 1: its second postures
        member = np.concatenate([2 * group, 2 * group[paired] + 1])
        position = np.concatenate([position, position[paired]])
        state = np.concatenate([o.state, o.second[paired]])
        order = np.argsort(state, kind="stable")
        states, starts, counts = np.unique(state[order], return_index=True, return_counts=True)
        blocks = []
        for m in np.unique(counts).tolist():
            chosen = np.flatnonzero(counts == m)
            size = max(1, min(MAX_POSTURES, MAX_READINGS // m) // n_sets)
            for first in range(0, chosen.size, size):
                rows = chosen[first : first + size]
                entries = order[starts[rows][:, None] + np.arange(m)]
                flat = entries.reshape(-1)
                members = []
                for i in np.unique(member[flat]).tolist():
                    where = np.flatnonzero(member[flat] == i)
                    members.append((i // 2, i % 2 == 1, where, position[flat[where]]))
                blocks.append(_Block(states[rows], entries, tuple(members)))
        return tuple(blocks)

    @cached_property
    def paired(self) -> Indices:
        """Indices of the entries that are pairs of postures, shape (n_pairs,)."""
        return np.flatnonzero(self.observations.second >= 0)

    def gather(self, values: Array) -> Array:
        """Add the values of the second postures of pairs to those of their entries.

        Args:
            values: Values of all entries, then of the second postures, shape (S, n + n_pairs, ...).

        Returns:
            Shape (S, n, ...).
        """
        if not self.paired.size:
            return values
        n = self.observations.size
        result = values[:, :n].copy()
        result[:, self.paired] += values[:, n:]
        return result

    @cached_property
    def single_blocks(self) -> tuple[_Block, ...]:
        """Blocks for one machine."""
        return self.blocks(1)


class _Machines:
    """Drives and placements of S machines in the states of a model.

    Args:
        model: The observation model.
        errors: Elementary errors, shape (S, n_errors), [SI].

    Attributes:
        actuated: Actual drive coordinates, shape (S, n_states, n_drives), [m, rad].
        reference: Actual drive coordinates in the reference posture of each setup, shape
            (S, n_setups, n_drives), [m, rad].
    """

    def __init__(self, model: ObservationModel, errors: Array) -> None:
        map_, self._states = model.functions.errors, model.states
        self.geometry = map_.geometry(errors, self._states.variant_commands[0])
        self.actuated = self.geometry.drives(self._states.commands)
        self.reference = self.geometry.drives(model.reference_commands)
        self._placements = map_.placements_under(errors, self._states.variant_commands)

    def placements(self, states: Indices) -> Array:
        """Moved placements, shape (S, 12 n_moved), or (S n, 12 n_moved) if n states differ."""
        placements = self._placements
        if placements.shape[1] > 1:
            placements = placements[:, self._states.variant[states]]
        return placements.reshape(-1, placements.shape[-1])


class ReadingLinearisation:
    """Linearised readings of a batch of machines.

    Shapes are those of a batch of S machines; S is absent if one machine was linearised.

    Args:
        model: The observation model.
        errors: Elementary errors, shape (S, n_errors), [SI].
        passive: Passive coordinates, shape (S, n_states, n_passive), [m, rad].
        nuisance: Nuisance parameters, shape (S, n_nuisance), [SI].
        free: The free parameters.
        alignment: Derivative of the nuisance parameters with respect to errors, shape
            (n_nuisance, n_errors).
        noise_ratio: Divisor of each entry's reading, shape (n_entries,).
        batch: True to keep the leading dimension of results.

    Attributes:
        reading: h at the passive coordinates, shape (S, n_entries), [m].
        opening: First-order change of h when the loops are closed, shape (S, n_entries), [m].
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
        self._alignment = alignment @ free.unit_errors
        self._aligned: Mask = np.asarray(self._alignment.any(axis=1))
        self._machines = _Machines(model, errors)
        geometry = self._machines.geometry
        _, self._by_drive_errors = geometry.drive_derivatives(model.states.commands)
        _, self._by_reference = geometry.drive_derivatives(model.reference_commands)
        self._pattern = free.pattern
        map_, n_sets = model.functions.errors, len(errors)
        n = model.observations.size + model.paired.size
        sparse = n_sets == 1 and n >= MIN_SPARSE_ROWS
        self._twists = TwistChain(map_, errors, model.states, free, sparse=sparse)
        self._by_machine = free.unit_errors[map_.drive_errors]
        n_machine = free.unit_errors.shape[1]
        reading, opening = np.empty((n_sets, n)), np.empty((n_sets, n))
        correction = np.zeros_like(passive, dtype=np.float64)
        jacobian = np.empty((n_sets, n, n_machine + free.n_nuisance_columns))
        self._blocks: list[tuple[_Block, _Closures]] = []
        for block in model.single_blocks if n_sets == 1 else model.blocks(n_sets):
            closures = self._evaluate_closures(block, passive)
            readings = self._evaluate_readings(block, passive, nuisance)
            dq = -(closures.inverse @ closures.residual[..., None])[..., 0]
            correction[:, block.states] = dq
            k, m = block.entries.shape
            entries = block.entries.reshape(-1)
            by_passive = readings.by_passive.reshape(n_sets, k, m, -1)
            reading[:, entries] = readings.value
            opening[:, entries] = (by_passive @ dq[..., None]).reshape(n_sets, k * m)
            by_machine = self._machine_rows(block, closures, readings)
            if readings.by_alignment is not None:
                by_machine += readings.by_alignment
            jacobian[:, entries, :n_machine] = by_machine
            jacobian[:, entries, n_machine:] = readings.by_nuisance
            self._blocks.append((block, closures))
        reading, opening, jacobian = (model.gather(v) for v in (reading, opening, jacobian))
        if (noise_ratio != 1.0).any():
            reading, opening = reading / noise_ratio, opening / noise_ratio
            jacobian /= noise_ratio[:, None]
        self.reading, self.opening = self._squeeze(reading), self._squeeze(opening)
        self.correction, self.jacobian = self._squeeze(correction), self._squeeze(jacobian)

    def follow(self, change: Array) -> Array:
        """Change of the passive coordinates that closes the loops after a change of θ̂.

        Args:
            change: dθ̂, shape (S, n_free); one machine may have any number of changes.

        Returns:
            Shape (S, n_states, n_passive), [m, rad], including `correction`.
        """
        changes = np.atleast_2d(change)
        machine = changes[:, : self._free.unit_errors.shape[1], None]
        twists = self._twists.follow(machine)
        drive_errors = (self._by_machine @ machine)[:, None]
        correction = self.correction if self._batch else self.correction[None]
        result = np.array(np.broadcast_to(correction, (len(changes), *correction.shape[1:])))
        for block, closures in self._blocks:
            residual = (closures.by_drive_errors @ drive_errors)[..., 0]
            block_twists = twists
            if twists.shape[1] > 1:
                block_twists = twists[:, self._model.states.variant[block.states]]
            residual += self._pattern.times(closures.by_twists, block_twists, residual.shape[2])
            result[:, block.states] -= (closures.inverse @ residual[..., None])[..., 0]
        return result if change.ndim > 1 else result[0]

    def _evaluate_closures(self, block: _Block, passive: Array) -> _Closures:
        """Loop closures of a block and their derivatives."""
        n_sets, k = len(passive), block.states.size
        outputs = self._model.functions.closure_jacobian(
            self._machines.actuated[:, block.states].reshape(n_sets * k, -1),
            passive[:, block.states].reshape(n_sets * k, -1),
            self._machines.placements(block.states),
        )
        g, g_a, g_q, nonzeros = (v.reshape(n_sets, k, *v.shape[1:]) for v in outputs)
        by_drive_errors = g_a @ self._by_drive_errors[:, block.states]
        return _Closures(
            g, invert_closures(g_q), by_drive_errors, nonzeros[:, :, self._pattern.chosen]
        )

    def _evaluate_readings(self, block: _Block, passive: Array, nuisance: Array) -> _Readings:
        """Readings of a block and their derivatives with constant passive coordinates."""
        model, free, (k, m) = self._model, self._free, block.entries.shape
        n_sets, n_passive = len(passive), passive.shape[2]
        n_drive_errors = self._by_drive_errors.shape[-1]
        by_twists: list[tuple[Indices, Indices, Array]] = []
        result = _Readings(
            np.empty((n_sets, k * m)),
            np.zeros((n_sets, k * m, n_drive_errors)),
            np.zeros((n_sets, k * m, n_passive)),
            np.zeros((n_sets, k * m, free.n_nuisance_columns)),
            np.zeros((n_sets, k * m, free.unit_errors.shape[1])) if self._aligned.any() else None,
            by_twists,
        )
        for index, of_second, where, part in block.members:
            group, states = model.groups[index], block.states[where // m]
            setups = group.setups[part]
            inputs = model._inputs(group, part, self._machines, passive, nuisance)
            outputs = group.reading.jacobian(*inputs)
            h, h_a, h_q, nonzeros, h_r, h_nu, *second = (
                v.reshape(n_sets, where.size, -1) for v in outputs
            )
            if of_second:
                h_a, h_q = second
            by_drive_errors = h_a[:, :, None] @ self._by_drive_errors[:, states]
            result.by_passive[:, where] = h_q
            if of_second:  # all other derivatives are those of the first posture
                result.value[:, where] = 0.0
                result.by_drive_errors[:, where] = by_drive_errors[:, :, 0]
                continue
            by_drive_errors += h_r[:, :, None] @ self._by_reference[:, setups]
            result.value[:, where] = h[..., 0]
            result.by_drive_errors[:, where] = by_drive_errors[:, :, 0]
            which = group.nuisance[part]
            columns = free.nuisance_columns[which]
            result.by_nuisance[:, where[:, None], columns] = h_nu * free.nuisance_scale[which]
            if result.by_alignment is not None:
                for j in np.flatnonzero(self._aligned[which].any(axis=0)).tolist():
                    by_machine = h_nu[:, :, j, None] * self._alignment[which[:, j]]
                    result.by_alignment[:, where] += by_machine
            _, columns = group.reading.jacobian.patterns["by_twists"]
            by_twists.append((where, columns, nonzeros))
        return result

    def _machine_rows(self, block: _Block, closures: _Closures, readings: _Readings) -> Array:
        """dh/dθ̂ for machine parameters with the loops closed, shape (S, k m, n_machine)."""
        (k, m), n_sets, used = block.entries.shape, len(readings.value), self._pattern.used
        multiplier = -(readings.by_passive.reshape(n_sets, k, m, -1) @ closures.inverse)
        by_drive_errors = readings.by_drive_errors.reshape(n_sets, k, m, -1)
        by_drive_errors = by_drive_errors + multiplier @ closures.by_drive_errors
        rows = (by_drive_errors @ self._by_machine).reshape(n_sets, k * m, -1)
        if used.size:
            twists = np.zeros((n_sets, k * m, used.size))
            for where, columns, nonzeros in readings.by_twists:
                used_columns = np.flatnonzero(self._pattern.position[columns] >= 0)
                positions = self._pattern.position[columns[used_columns]]
                twists[:, where[:, None], positions] = nonzeros[:, :, used_columns]
            dense = self._pattern.dense(closures.by_twists, multiplier.shape[-1])
            twists += (multiplier @ dense).reshape(n_sets, k * m, -1)
            rows += self._twists(twists, np.repeat(block.states, m))
        return rows

    def _squeeze(self, values: Array) -> Array:
        """Values without the leading dimension if one machine was linearised."""
        return values if self._batch else values[0]


def predict_readings(
    session: Session,
    errors: Mapping[str, float] | None = None,
    *,
    observations: Observations | None = None,
    passive: Array | None = None,
    nuisance: Array | None = None,
) -> Array:
    """Predict the readings of a machine with known errors and gauge zeros at 0.

    Args:
        session: Postures, setups and robot.
        errors: Names of parameters, mapped to values, [unit of the parameter]; 0 where absent.
        observations: The entries to predict; those of the session's readings by default.
        passive: Passive coordinates of every state, shape (n_states, n_passive), [m, rad]; solved
            by default.
        nuisance: Nuisance parameters in the order of `nuisance_parameters`, shape (n_nuisance,),
            [SI]; 0 by default.

    Returns:
        Shape (n_entries,), [m].

    Raises:
        ClosureError: If the machine cannot reach a posture.
        ParameterError: If a name is unknown.
    """
    model = ObservationModel(session, observations)
    closure = LoopClosure(session.robot, fixed=errors)
    if passive is None:
        passive = closure.close(model.states.commands, names=model.states.names)
    return model.predict(closure.errors(), passive, nuisance)


def nominal_sensitivity(session: Session, unit_errors: Array | None = None) -> Array:
    """Derivative of readings with respect to errors of the machine, on the nominal machine.

    Args:
        session: The session.
        unit_errors: Elementary errors for one unit of each parameter, shape (n_errors, n), [SI];
            by default all elementary errors.

    Returns:
        Shape (n_entries, n), [m per unit of the parameter].

    Raises:
        ClosureError: If the nominal machine cannot reach a posture.
    """
    model, closure = ObservationModel(session), LoopClosure(session.robot)
    units = np.eye(len(model.functions.errors.names)) if unit_errors is None else unit_errors
    n = len(model.nuisance.parameters)
    # derivatives with respect to nuisance parameters are not needed: they share one column
    free = model.parametrise(units, np.ones(n), np.zeros(n, dtype=np.int64))
    passive = closure.close(model.states.commands, names=model.states.names)
    linear = model.linearise(closure.errors(), passive, free=free, aligned=False)
    return linear.jacobian[:, : units.shape[1]]
