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

from orthocal.errors import RobotError
from orthocal.identification.pieces import (
    DirectExpressions,
    PosturePiece,
    ReadingPiece,
    SharedInputs,
)
from orthocal.identification.selection import Known, Selection, select_parameters
from orthocal.kinematics.assembly import Assembly
from orthocal.kinematics.batch import BatchFunction
from orthocal.kinematics.slopes import SharedPlacements
from orthocal.kinematics.symbolic import SymbolicRobot
from orthocal.measurement.gauge import (
    Observations,
    build_observations,
    drive_table,
    reading_expression,
    setup_columns,
    zero_root_coordinate,
)
from orthocal.measurement.session import Session
from orthocal.robot.model import Robot, closure_row_units, coordinate_units
from orthocal.robot.parameters import AXES

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

LENGTH_SCALE = 1e-3
"""What closures, passive motions and gauge zeros are scaled by, [m]."""


class CalibrationProblem:
    """Readings of a session, and the error parameters they are to determine.

    Args:
        session: The session.
        selection: What is free, and what is known of it beforehand.

    Raises:
        RobotError: If closure rows of the robot depend on each other.
    """

    def __init__(self, session: Session, selection: Selection) -> None:
        self.session = session
        self.robot = session.robot
        self.selection = selection
        self.free = selection.names
        self.parameters = selection.parameters
        self.fixed = dict(selection.fixed)
        _require_independent_rows(self.robot)
        self.observations: Observations = build_observations(session)
        self.drives = drive_table(session)
        self.setup_columns = setup_columns(session)
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
        """Readings as single ones, shape (n_entries,), [m]."""
        return self.observations.values(self.session.values)

    @cached_property
    def zero_incidence(self) -> Array:
        """1 where an entry (row) has a zero (column), shape (n_entries, n_zeros)."""
        result = np.zeros((self.observations.size, self.observations.n_zeros))
        result[np.arange(self.observations.size), self.observations.zero] = 1.0
        return result

    @cached_property
    def assembly(self) -> Assembly:
        """Closes the loops for given values of the free parameters."""
        return Assembly(self.robot, free=self.free, fixed=self.fixed)

    def close(self, theta: ArrayLike, *, start: Array | None = None) -> Array:
        """Passive coordinates of every posture, shape (n_postures, n_passive), [m, rad].

        Raises:
            ClosureError: If the machine with these errors cannot reach a posture.
        """
        names = list(self.session.postures)
        return self.assembly.close(self.drives, theta=theta, start=start, names=names)

    @cached_property
    def shared(self) -> SharedInputs:
        """What depends on θ̂ alone."""
        theta, placements = self._placements.theta, self._placements
        machine = placements.machine(
            drives=ca.SX(self.session.zero_drives), passive=self._nominal_zero_passive
        )
        values, symbols = [], []
        for leg, (coordinate, slope) in self._zero_roots.items():
            frame = self.robot.frame_id(self.robot.legs[leg].root)
            axis = ca.SX(np.array(self.robot.legs[leg].axis)).T
            _, by_theta = placements.position_slopes(machine, frame, axis)
            index = self._leg_theta[leg].tolist()
            values += [zero_root_coordinate(self.robot.legs[leg], machine), by_theta[0, index].T]
            symbols += [coordinate, slope]
        inner = ca.Function("roots", [theta, placements.values, placements.slope_nonzeros], values)
        values_at, slopes_at = placements.function(theta)
        outputs = [theta, values_at, slopes_at]
        if values:
            found = inner(theta, values_at, slopes_at)
            outputs += [ca.densify(v) for v in (found if isinstance(found, tuple) else (found,))]
        return SharedInputs(
            (theta, placements.values, placements.slope_nonzeros, *symbols),
            ca.Function("shared", [theta], outputs),
        )

    @cached_property
    def posture_piece(self) -> PosturePiece:
        """The closures of one posture."""
        drives, passive = self._posture_symbols()
        machine = self._placements.machine(drives=drives, passive=passive * self.passive_scale)
        scale = closure_row_units(self.robot) / LENGTH_SCALE
        by_joints, by_theta = self._placements.closure_slopes(machine)
        rows = ca.diag(ca.SX(scale))
        columns = ca.diag(ca.SX(self.passive_scale))
        return PosturePiece(
            passive=passive,
            drives=drives,
            closure=machine.closure_residual() * scale,
            by_passive=rows @ by_joints[:, self.robot.passive_index.tolist()] @ columns,
            by_theta=rows @ by_theta,
        )

    @cached_property
    def reading_pieces(self) -> tuple[ReadingPiece, ...]:
        """The readings, leg by leg; legs that are not read are left out."""
        drives, passive = self._posture_symbols()
        machine = self._placements.machine(drives=drives, passive=passive * self.passive_scale)
        legs = list(self.robot.legs)
        leg_of_setup = np.array(
            [legs.index(s.leg) for s in self.session.setups.values()], dtype=np.int64
        )
        pieces = []
        for name, (zero_root, zero_slope) in self._zero_roots.items():
            leg = self.robot.legs[name]
            setup = ca.SX.sym("setup", 5)
            root, tip = ca.SX.sym("root", 3), ca.SX.sym("tip", 3)
            section = ca.SX.sym("section")
            h = reading_expression(root, tip, axis=leg.axis, direction=setup[:3], section=section)
            rows = [ca.jacobian(h, v) for v in (root, tip, section)]
            local = ca.Function("local", [root, tip, section, setup], [h, *rows])
            places = [machine.frame_pose(f).position for f in (leg.root, leg.tip)]
            value, by_root, by_tip, by_section = local(
                *places, setup[3] + setup[4] * zero_root, setup
            )
            by_joints, by_theta = ca.SX(1, self.robot.model.nv), ca.SX(1, self.n_free)
            for frame, row in ((leg.root, by_root), (leg.tip, by_tip)):
                joints, theta = self._placements.position_slopes(
                    machine, self.robot.frame_id(frame), row
                )
                by_joints, by_theta = by_joints + joints, by_theta + theta
            theta_index = self._leg_theta[name]
            by_passive = ca.sparsify(by_joints[0, self.robot.passive_index.tolist()])
            used = _dependencies(value, passive)
            pieces.append(
                ReadingPiece(
                    leg=name,
                    entries=np.flatnonzero(
                        leg_of_setup[self.observations.setup] == legs.index(name)
                    ),
                    passive_index=used,
                    theta_index=theta_index,
                    passive=passive[used.tolist()],
                    drives=drives,
                    setup=setup,
                    reading=value,
                    by_passive=by_passive[0, used.tolist()] * ca.SX(self.passive_scale[used]).T,
                    by_theta=by_theta[0, theta_index.tolist()]
                    + by_section * setup[4] * zero_slope.T,
                )
            )
        return tuple(pieces)

    @cached_property
    def direct(self) -> DirectExpressions:
        """Closures and readings as expressions of θ̂ itself."""
        drives, passive = self._posture_symbols()
        theta, setup = ca.SX.sym("theta", self.n_free), ca.SX.sym("setup", 5)
        errors = self._errors(theta)
        machine, at_zero = (
            SymbolicRobot(self.robot, drives=d, passive=p, errors=errors)
            for d, p in (
                (drives, passive * self.passive_scale),
                (ca.SX(self.session.zero_drives), self._nominal_zero_passive),
            )
        )
        readings = {}
        for name in self._zero_roots:
            leg = self.robot.legs[name]
            root, tip = (machine.frame_pose(f).position for f in (leg.root, leg.tip))
            section = setup[3] + setup[4] * zero_root_coordinate(leg, at_zero)
            readings[name] = reading_expression(
                root, tip, axis=leg.axis, direction=setup[:3], section=section
            )
        scale = closure_row_units(self.robot) / LENGTH_SCALE
        return DirectExpressions(
            theta, passive, drives, setup, machine.closure_residual() * scale, readings
        )

    def predict(self, theta: ArrayLike, passive: Array | None = None) -> Array:
        """Readings h(q(θ), θ) of all entries, gauge zeros at 0, shape (n_entries,), [m]."""
        q = self.close(theta) if passive is None else passive
        return self._evaluate_readings(np.asarray(theta), q)[0]

    def linearise(self, theta: ArrayLike, passive: Array | None = None) -> tuple[Array, Array]:
        """Readings and identification Jacobian at given parameters.

        The passive coordinates are eliminated by the implicit function theorem,
        ∂q/∂θ = −g_q⁻¹ g_θ, so that J = h_θ − h_q g_q⁻¹ g_θ.

        Args:
            theta: Shape (n_free,), [SI].
            passive: Passive coordinates with closed loops at theta; closed here by default.

        Returns:
            Readings, shape (n_entries,), [m], and dh/dθ̂, shape (n_entries, n_free),
            [m per tolerance].

        Raises:
            ClosureError: If the machine with these errors cannot reach a posture.
        """
        q = self.close(theta) if passive is None else passive
        h, by_passive, by_theta = self._evaluate_readings(np.asarray(theta), q)
        g_q, g_theta = self._closure_jacobians(
            q / self.passive_scale, self.drives, *self._shared_values(np.asarray(theta))
        )
        if g_q.shape[1] == g_q.shape[2]:
            slopes = -np.linalg.solve(g_q, g_theta)
        else:
            slopes = -np.linalg.pinv(g_q, rcond=1e-10) @ g_theta
        jacobian = by_theta
        for start in range(0, len(jacobian), 1024):
            part = slice(start, start + 1024)
            chosen = slopes[self.observations.posture[part]]
            jacobian[part] += np.einsum("ni,nij->nj", by_passive[part], chosen)
        return h, jacobian

    def split_errors(self, theta: ArrayLike) -> dict[str, float]:
        """Parameter name to value, free and fixed, [SI]."""
        return {**self.fixed, **dict(zip(self.free, np.asarray(theta).tolist(), strict=True))}

    def _errors(self, theta: ca.SX) -> dict[str, ca.SX | float]:
        errors: dict[str, ca.SX | float] = dict(self.fixed)
        errors.update({name: theta[i] * self.theta_scale[i] for i, name in enumerate(self.free)})
        return errors

    def _posture_symbols(self) -> tuple[ca.SX, ca.SX]:
        return (
            ca.SX.sym("drives", len(self.robot.drives)),
            ca.SX.sym("passive", self.robot.passive_index.size),
        )

    @cached_property
    def _placements(self) -> SharedPlacements:
        theta = ca.SX.sym("theta", self.n_free)
        return SharedPlacements(self.robot, theta, self._errors(theta))

    @property
    def _nominal_zero_passive(self) -> ca.SX:
        return ca.SX(self.robot.zero[self.robot.passive_index])

    @cached_property
    def _leg_theta(self) -> dict[str, Indices]:
        """Leg that is read to the free parameters that its readings depend on."""
        drives, passive = self._posture_symbols()
        machine = self._placements.machine(drives=drives, passive=passive)
        found = {}
        read = {list(self.session.setups.values())[i].leg for i in self.observations.setup}
        for name, leg in self.robot.legs.items():
            if name not in read:
                continue
            used: set[int] = set()
            for frame in (leg.root, leg.tip):
                row = ca.SX.sym("row", 1, 3)
                _, by_theta = self._placements.position_slopes(
                    machine, self.robot.frame_id(frame), row
                )
                used.update(ca.sparsify(by_theta).sparsity().get_col())
            found[name] = np.array(sorted(used), dtype=np.int64)
        return found

    @cached_property
    def _zero_roots(self) -> dict[str, tuple[ca.SX, ca.SX]]:
        """Leg that is read to symbols for its root's coordinate in the zero posture and slope."""
        return {
            name: (ca.SX.sym("zero_root"), ca.SX.sym("zero_slope", index.size))
            for name, index in self._leg_theta.items()
        }

    @cached_property
    def _closure_jacobians(self) -> BatchFunction:
        piece = self.posture_piece
        function = ca.Function(
            "closure_jacobians",
            [piece.passive, piece.drives, *self.shared.symbols],
            [piece.by_passive, piece.by_theta],
        )
        return BatchFunction(function, shared=function.name_in()[2:], matrices=function.name_out())

    @cached_property
    def _reading_functions(self) -> tuple[BatchFunction, ...]:
        functions = []
        for piece in self.reading_pieces:
            function = ca.Function(
                "reading",
                [piece.passive, piece.drives, piece.setup, *self.shared.symbols],
                [piece.reading, piece.by_passive, piece.by_theta],
            )
            functions.append(BatchFunction(function, shared=function.name_in()[3:]))
        return tuple(functions)

    def _shared_values(self, theta: Array) -> list[Array]:
        values = self.shared.function(theta / self.theta_scale)
        return [np.asarray(v.full()).reshape(-1) for v in values]

    def _evaluate_readings(self, theta: Array, passive: Array) -> tuple[Array, Array, Array]:
        """h, ∂h/∂q̂ and ∂h/∂θ̂ at fixed q, shapes (n,), (n, n_passive), (n, n_free)."""
        o = self.observations
        h = np.zeros(o.size)
        by_passive = np.zeros((o.size, self.robot.passive_index.size))
        by_theta = np.zeros((o.size, self.n_free))
        q_hat = passive / self.passive_scale
        shared = self._shared_values(theta)
        for piece, function in zip(self.reading_pieces, self._reading_functions, strict=True):
            n, postures = piece.entries, o.posture[piece.entries]
            value, h_q, h_theta = function(
                q_hat[postures][:, piece.passive_index],
                self.drives[postures],
                self.setup_columns[o.setup[n]],
                *shared,
            )
            h[n] = value[:, 0]
            by_passive[np.ix_(n, piece.passive_index)] = h_q.reshape(len(n), -1)
            by_theta[np.ix_(n, piece.theta_index)] = h_theta.reshape(len(n), -1)
        return h, by_passive, by_theta


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


def _dependencies(expression: ca.SX, symbols: ca.SX) -> Indices:
    """Indices of the symbols that an expression contains."""
    present = {s.__hash__() for s in ca.symvar(expression)}
    found = [i for i in range(symbols.numel()) if symbols[i].__hash__() in present]
    return np.array(found, dtype=np.int64)
