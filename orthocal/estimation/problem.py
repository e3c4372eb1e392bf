"""The calibration problem: which errors are free, and the scaled pieces its solvers are made of.

    min over θ, z, q_1..q_K   Σ ρ((y − h(q_k, θ) − z)/σ) + ½ Σ ((θ − mean)/tolerance)²
    s.t.                      g(q_k, θ) = 0 for every posture k

A problem is made of two kinds of piece: one posture (its closures) and one reading of a leg. Both
are CasADi expressions in scaled variables of order one:

    θ̂ = θ/tolerance,  q̂ = q · (1 or characteristic length)/1 mm,  ĝ = g · (1 or length)/1 mm
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.errors import ClosureError, RobotError
from orthocal.estimation.pieces import (
    DirectExpressions,
    PosturePiece,
    ReadingPiece,
)
from orthocal.estimation.selection import Known, Selection, select_parameters
from orthocal.kinematics.compiled import CompiledRobot, compiled_robot
from orthocal.kinematics.continuation import MachineNumbers
from orthocal.kinematics.error_map import Slopes
from orthocal.kinematics.function_cache import once_a_robot
from orthocal.kinematics.loop_closure import Assembly
from orthocal.kinematics.machine_map import MachineMap
from orthocal.kinematics.symbolic import SymbolicRobot
from orthocal.observation.expansion import Expander, Expansion
from orthocal.observation.manual_alignment import Setting, find_setting
from orthocal.observation.observations import Observations, build_observations, drive_table
from orthocal.observation.sensor_groups import (
    SensorGroup,
    SensorUnknowns,
    group_sensors,
    sensor_unknowns,
)
from orthocal.robot.model import Robot, closure_row_units, coordinate_units
from orthocal.robot.parameters import AXES
from orthocal.sensors.protocol import View
from orthocal.session.session import Session

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

LENGTH_SCALE = 1e-3
"""What closures, passive motions and gauge zeros are scaled by, [m]."""


READINGS_AT_ONCE = 1024
"""Readings whose derivatives are held at a time, for their memory."""


class CalibrationProblem:
    """Readings of a session, and the error parameters they are to determine.

    Its free parameters are errors of the machine, then what is not known of its sensors. Readings
    count by their noise: all that is told of entries is in metres of the first gauge, in which
    every reading has the same standard deviation.

    Args:
        session: The session, or several that were joined.
        selection: Which errors of the machine are free, and what is known of them beforehand.
        noise: Standard deviation of each entry's readings, as a multiple of the first gauge's,
            shape (n_entries,); 1 by default.

    Raises:
        RobotError: If closure rows of the robot depend on each other.
    """

    def __init__(
        self, session: Session, selection: Selection, *, noise: Array | None = None
    ) -> None:
        self.session = session
        self.robot = session.robot
        self.machine_selection = selection
        self.unknowns: SensorUnknowns = sensor_unknowns(session)
        selection = selection.with_known(self.unknowns.parameters)
        self.selection = selection
        self.free = selection.names
        self.parameters = selection.parameters
        self.fixed = dict(selection.fixed)
        _require_independent_rows(self.robot)
        self.observations: Observations = build_observations(session)
        self.noise = np.ones(self.observations.size) if noise is None else noise
        self.drives = drive_table(session)
        self.theta_scale = selection.tolerances
        self.prior_precision = selection.prior.astype(np.float64)
        self.prior_mean = np.where(selection.prior, selection.mean, 0.0)
        self.passive_scale = LENGTH_SCALE / coordinate_units(self.robot)[self.robot.passive_index]

    def with_values(self, values: ArrayLike) -> CalibrationProblem:
        """The same problem for other readings of the same rows; nothing is built again.

        Args:
            values: Readings of the session's rows, shape (n_rows,), [m].
        """
        other = copy.copy(self)
        other.session = self.session.with_values(np.asarray(values, dtype=np.float64))
        other.__dict__.pop("values", None)
        return other

    def with_noise(self, noise: Array) -> CalibrationProblem:
        """The same problem with other standard deviations; nothing is built again.

        Args:
            noise: As a multiple of the first gauge's, shape (n_entries,).
        """
        other = copy.copy(self)
        other.noise = noise
        other.__dict__.pop("values", None)
        return other

    @property
    def n_machine(self) -> int:
        """Number of free parameters that are errors of the machine: the first ones."""
        return len(self.machine_selection.parameters)

    @property
    def n_free(self) -> int:
        """Number of free parameters."""
        return len(self.free)

    @property
    def prior(self) -> bool:
        """Whether any parameter has a prior."""
        return bool(self.prior_precision.any())

    @property
    def n_postures(self) -> int:
        """Number of postures."""
        return len(self.drives)

    @cached_property
    def reference(self) -> Array:
        """Parameters that the controller already corrects, shape (n_free,), [SI].

        The point of linearisation and the default start: nominal where the controller has no
        offsets.
        """
        active = dict(
            zip(
                (f"{d.name}.offset" for d in self.robot.drives),
                self.session.active_offsets,
                strict=True,
            )
        )
        at = np.array([active.get(name, 0.0) for name in self.free])
        return np.asarray(np.clip(at, self.selection.lower, self.selection.upper))

    @cached_property
    def values(self) -> Array:
        """Readings as single ones, shape (n_entries,), [m of the first gauge]."""
        return self.observations.values(self.session.values) / self.noise

    @cached_property
    def zero_incidence(self) -> Array:
        """1 where an entry (row) has a zero (column), shape (n_entries, n_zeros)."""
        result = np.zeros((self.observations.size, self.observations.n_zeros))
        result[np.arange(self.observations.size), self.observations.zero] = 1.0
        return result

    @cached_property
    def assembly(self) -> Assembly:
        """Closes the loops for given values of the free parameters."""
        return Assembly(self.robot, free=self.machine_selection.names, fixed=self.fixed)

    def close(self, theta: ArrayLike, *, start: Array | None = None) -> Array:
        """Passive coordinates of every posture, shape (n_postures, n_passive), [m, rad].

        Args:
            theta: Shape (n_free,), [SI], or those of the machine.
            start: Where to start from, of the same shape; the reference by default.

        Raises:
            ClosureError: If the machine with these errors cannot reach a posture.
        """
        return self._close(theta, self._near_reference if start is None else start)

    def _close(self, theta: ArrayLike, start: Array | None) -> Array:
        names = list(self.session.postures)
        machine = self._of_machine(theta)
        return self.assembly.close(self.drives, theta=machine, start=start, names=names)

    @cached_property
    def _near_reference(self) -> Array | None:
        """The reference, where it reaches all postures."""
        try:
            return self.reference_passive
        except ClosureError:
            return None

    @cached_property
    def reference_passive(self) -> Array:
        """Passive coordinates of every posture at the reference, (n_postures, n_passive).

        Raises:
            ClosureError: If the reference machine cannot reach a posture.
        """
        return self._close(self.reference, None)

    @cached_property
    def machine_map(self) -> MachineMap:
        """What θ̂ makes of the machine, as functions of CasADi."""
        return MachineMap(self.compiled.errors, fixed=self._fixed_errors, columns=self.columns)

    @cached_property
    def posture_piece(self) -> PosturePiece:
        """The closures of one posture."""
        compiled, shared = self.compiled, self.machine_map
        drives, passive = self._posture_symbols()
        g, g_a, g_q, g_t = compiled.expressions(
            shared.actuated(drives), passive * self.passive_scale, shared.placements
        )
        columns = ca.diag(ca.SX(self.passive_scale))
        return PosturePiece(
            passive=passive,
            drives=drives,
            closure=g / LENGTH_SCALE,
            by_passive=g_q @ columns / LENGTH_SCALE,
            by_theta=shared.chain(g_t, g_a, drives) / LENGTH_SCALE,
        )

    @cached_property
    def reading_pieces(self) -> tuple[ReadingPiece, ...]:
        """The readings, by the expression that they are of."""
        shared = self.machine_map
        pieces = []
        for k, group in enumerate(self.sensor_groups):
            drives, passive = self._posture_symbols()
            zero = ca.SX.sym("zero", len(self.robot.drives))
            constants = ca.SX.sym("constants", group.constants.shape[1])
            unknowns = ca.SX.sym("unknowns", group.unknowns.shape[1])
            h, h_a, h_q, h_t, h_z, h_u = group.reading.expression(
                shared.actuated(drives),
                passive * self.passive_scale,
                shared.placements,
                shared.actuated(zero),
                constants,
                unknowns,
            )
            by_theta = shared.chain(h_t, h_a, drives) + shared.chain(ca.SX(*h_t.shape), h_z, zero)
            by_theta, by_passive = ca.sparsify(by_theta), ca.sparsify(h_q)
            theta_index, used = _columns_of(by_theta), _columns_of(by_passive)
            scale = ca.SX(self.passive_scale[used]).T
            pieces.append(
                ReadingPiece(
                    group=k,
                    entries=group.entries,
                    table=group.constants,
                    setups=group.setups,
                    unknown_index=self.n_machine + group.unknowns,
                    unknowns=unknowns,
                    by_unknowns=h_u,
                    passive_index=used,
                    theta_index=theta_index,
                    passive=passive[used.tolist()],
                    drives=drives,
                    zero=zero,
                    constants=constants,
                    reading=h,
                    by_passive=by_passive[0, used.tolist()] * scale,
                    by_theta=by_theta[0, theta_index.tolist()],
                )
            )
        return tuple(pieces)

    @cached_property
    def direct(self) -> DirectExpressions:
        """Closures and readings as expressions of the machine's θ̂ itself."""
        robot = self.robot
        drives, passive = self._posture_symbols()
        theta, zero = ca.SX.sym("theta", self.n_machine), ca.SX.sym("zero", len(robot.drives))
        errors = self._errors(theta)
        machine, at_zero = (
            SymbolicRobot(robot, drives=d, passive=p, errors=errors)
            for d, p in (
                (drives, passive * self.passive_scale),
                (zero, ca.SX(robot.zero[robot.passive_index])),
            )
        )
        setups = list(self.session.setups.values())
        constants, unknowns, readings = [], [], []
        for group in self.sensor_groups:
            sensor = setups[int(self.observations.setup[group.entries[0]])].sensor
            frames = sensor.frames(robot)
            own = ca.SX.sym("constants", group.constants.shape[1])
            view = View(
                [machine.frame_pose(f) for f in frames.in_posture],
                [at_zero.frame_pose(f) for f in frames.at_zero],
                own,
                ca.SX.sym("unknowns", group.unknowns.shape[1]),
            )
            constants.append(own)
            unknowns.append(view.unknowns)
            readings.append(sensor.expression(view, robot))
        scale = closure_row_units(robot) / LENGTH_SCALE
        return DirectExpressions(
            theta,
            passive,
            drives,
            zero,
            machine.closure_residual() * scale,
            tuple(constants),
            tuple(unknowns),
            tuple(readings),
        )

    def standing(self, theta: ArrayLike) -> Array:
        """How sensors stand, (n_unknowns,), [SI], of all parameters or the machine's alone."""
        given = np.asarray(theta, dtype=np.float64)[self.n_machine :]
        begun = self.setting(self.assembly.errors(self._of_machine(theta)))
        return begun + given if given.size else begun

    def predict(self, theta: ArrayLike, passive: Array | None = None) -> Array:
        """Readings h(q(θ), θ) of all entries, gauge zeros at 0.

        Shape (n_entries,), [m of the first gauge].
        """
        q = self.close(theta) if passive is None else passive
        machine, unknowns = self.assembly.machine(self._of_machine(theta)), self.standing(theta)
        result = np.empty(self.observations.size)
        for group in self.sensor_groups:
            for entries, part in group.parts(READINGS_AT_ONCE):
                result[entries] = self._read(group, part, machine, q, unknowns)
        return np.asarray(result / self.noise)

    def linearise(self, theta: ArrayLike, passive: Array | None = None) -> tuple[Array, Array]:
        """Readings and identification Jacobian at given parameters.

        The passive coordinates are eliminated by the implicit function theorem,
        ∂q/∂θ = −g_q⁻¹ g_θ, so that J = h_θ − h_q g_q⁻¹ g_θ.

        Args:
            theta: Shape (n_free,), [SI].
            passive: Passive coordinates with closed loops at theta; closed here by default.

        Returns:
            Readings, shape (n_entries,), [m of the first gauge], and dh/dθ̂, shape (n_entries,
            n_free), [the same per tolerance].

        Raises:
            ClosureError: If the machine with these errors cannot reach a posture.
        """
        q = self.close(theta) if passive is None else passive
        found = self.expand(theta, q)
        return found.reading, found.jacobian

    def expand(self, theta: ArrayLike, passive: Array) -> Expansion:
        """Readings to first order about parameters and passive coordinates near closed loops.

        Args:
            theta: Shape (n_free,), [SI].
            passive: Shape (n_postures, n_passive), [m, rad].

        Raises:
            LinAlgError: If a posture is singular.
        """
        machine, slopes = self._machine_and_slopes(theta)
        unknowns = self.standing(theta)
        found = self._expander(machine, slopes, passive, unknowns, self.set_by)
        return found.scaled(self.theta_scale[self.n_machine :], self.noise)

    @cached_property
    def _expander(self) -> Expander:
        errors = self.compiled.errors
        moved = errors.twists_of(self.columns.T).any(axis=0).reshape(-1, 6).any(axis=1)
        return Expander(
            self.compiled,
            self.observations,
            self.sensor_groups,
            drives=self.drives,
            zero_drives=self.session.zero_drives,
            used=np.repeat(moved, 6),
        )

    def split_errors(self, theta: ArrayLike) -> dict[str, float]:
        """Errors of the machine, free and fixed: name to value, [SI]."""
        names, values = self.machine_selection.names, self._of_machine(theta).tolist()
        return {**self.fixed, **dict(zip(names, values, strict=True))}

    def _of_machine(self, theta: ArrayLike) -> Array:
        return np.asarray(theta, dtype=np.float64)[: self.n_machine]

    def _errors(self, theta: ca.SX) -> dict[str, ca.SX | float]:
        errors: dict[str, ca.SX | float] = dict(self.fixed)
        names = self.machine_selection.names
        errors.update({name: theta[i] * self.theta_scale[i] for i, name in enumerate(names)})
        return errors

    def _posture_symbols(self) -> tuple[ca.SX, ca.SX]:
        return (
            ca.SX.sym("drives", len(self.robot.drives)),
            ca.SX.sym("passive", self.robot.passive_index.size),
        )

    @cached_property
    def compiled(self) -> CompiledRobot:
        """The functions of the robot."""
        return compiled_robot(self.robot)

    @cached_property
    def sensor_groups(self) -> tuple[SensorGroup, ...]:
        """Entries by the expression that they are readings of."""
        return group_sensors(self.session, self.observations)

    @cached_property
    def setting(self) -> Setting:
        """What the unknowns of the sensors begin at on a machine with errors."""
        return find_setting(self.session)

    @cached_property
    def set_by(self) -> Array:
        """What one tolerance of each free error adds to that, (n_unknowns, n_machine), [SI]."""
        return np.asarray(self.setting.slopes @ self.columns)

    @cached_property
    def _fixed_errors(self) -> Array:
        return self.compiled.errors.expand(self.fixed)

    @cached_property
    def columns(self) -> Array:
        """What one tolerance of each free error adds to all of them, (n_errors, n_machine)."""
        selection = self.machine_selection
        return self.compiled.errors.columns(selection.names) * selection.tolerances

    def _machine_and_slopes(self, theta: ArrayLike) -> tuple[MachineNumbers, Slopes]:
        """The machine, and what tolerances of the free parameters do to it."""
        machine = self._of_machine(theta)
        errors = self.assembly.errors(machine)
        return self.assembly.machine(machine), self.compiled.errors.slopes(errors, self.columns)

    def _read(
        self,
        group: SensorGroup,
        part: slice,
        machine: MachineNumbers,
        passive: Array,
        unknowns: Array,
    ) -> Array:
        """Readings of part of a group, in their own metres, shape (n,)."""
        postures = self.observations.posture[group.entries[part]]
        zero = machine.drives(self.session.zero_drives)
        (h,) = group.reading.value(
            machine.drives(self.drives[postures]),
            passive[postures],
            machine.placements,
            zero[group.setups[part]],
            group.constants[part],
            unknowns[group.unknowns[part]],
        )
        return np.asarray(h[:, 0])


def build_problem(
    session: Session,
    *,
    model: str | None = None,
    free: Sequence[str] = (),
    prior: bool | None = None,
    known: Mapping[str, Known] | None = None,
    tolerances: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
) -> CalibrationProblem:
    """The problem of a model of the robot; arguments as for `select_parameters`."""
    selection = select_parameters(
        session.robot.parameters,
        model=model,
        free=free,
        prior=prior,
        known=known,
        tolerances=tolerances,
        bounds=bounds,
    )
    return CalibrationProblem(session, selection)


@once_a_robot(maxsize=8)
def _require_independent_rows(robot: Robot) -> None:
    """Refuse closures with rows that depend on others: as constraints they cannot all be met.

    Raises:
        RobotError: Naming the closures and the rows.
    """
    passive = robot.zero[robot.passive_index]
    _, jacobian = robot.evaluate_constraints(robot.drive_zero, passive)
    slopes = (jacobian * closure_row_units(robot)[:, None])[:, robot.passive_index]
    rows = [(c.name, AXES[row]) for c in robot.closures for row in c.rows]
    kept = np.zeros((0, slopes.shape[1]))
    dependent = []
    for row, slope in zip(rows, slopes, strict=True):
        trial = np.vstack([kept, slope])
        if np.linalg.matrix_rank(trial, tol=1e-8) == len(trial):
            kept = trial
        else:
            dependent.append(row)
    if dependent:
        named = ", ".join(f"{row} of {closure}" for closure, row in dependent)
        raise RobotError(
            f"closure rows depend on others: {named}; leave them out of "
            "orthocal.closures.<name>.rows",
            where=str(robot.yaml),
        )


def _columns_of(row: ca.SX) -> Indices:
    """Columns of a sparse row that are not empty."""
    return np.array(sorted(set(row.sparsity().get_col())), dtype=np.int64)
