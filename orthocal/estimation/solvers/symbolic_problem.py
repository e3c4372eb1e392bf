"""A calibration problem as CasADi expressions of one posture and of one reading.

The variables are scaled to order one:

    θ̂ = θ/(prior std),  q̂ = q · (1 or characteristic length)/1 mm,  ĝ = g · (1 or length)/1 mm
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocal.estimation.problem import LENGTH_SCALE, CalibrationProblem
from orthocal.kinematics.error_map import SymbolicErrorMap
from orthocal.kinematics.symbolic import SymbolicRobot
from orthocal.robot.model import closure_row_units
from orthocal.sensors.compiled import express_reading

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class PostureExpressions:
    """The closures of one posture and their derivatives."""

    passive: ca.SX
    """q̂, shape (n_passive,)."""
    command: ca.SX
    """Command of the posture, shape (n_command,)."""
    closure: ca.SX
    """ĝ, shape (closure_rows,)."""
    by_passive: ca.SX
    """∂ĝ/∂q̂, shape (closure_rows, n_passive)."""
    by_theta: ca.SX
    """∂ĝ/∂θ̂, shape (closure_rows, n_free)."""


@dataclass(frozen=True, slots=True, eq=False)
class ReadingExpressions:
    """One reading of a sensor group, in the variables that it depends on."""

    group: int
    """Index of the sensor group."""
    entries: Indices
    """Entries of the group, shape (n,)."""
    table: Array
    """Constants of their sensors, shape (n, n_constants)."""
    setups: Indices
    """Setup of each entry, shape (n,)."""
    nuisance_index: Indices
    """Indices of their nuisance parameters among the free parameters, shape (n, n_nuisance)."""
    nuisance: ca.SX
    """Nuisance parameters, shape (n_nuisance,), [SI]."""
    by_nuisance: ca.SX
    """∂h by them, shape (1, n_nuisance)."""
    passive_index: Indices
    """Indices of the passive coordinates that it depends on."""
    theta_index: Indices
    """Indices of the free parameters that it depends on."""
    passive: ca.SX
    """Those coordinates q̂."""
    command: ca.SX
    """Command of the posture, shape (n_command,)."""
    reference: ca.SX
    """Command of the reference posture, shape (n_command,)."""
    constants: ca.SX
    """Constants of the sensor and conditions of the reading, shape (n_constants,)."""
    reading: ca.SX
    """h, [m]."""
    by_passive: ca.SX
    """∂h/∂q̂ of those coordinates, shape (1, n), [m]."""
    by_theta: ca.SX
    """∂h/∂θ̂ of those parameters, shape (1, n), [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class DirectExpressions:
    """Closures and readings as direct expressions of the machine's θ̂, for second derivatives."""

    theta: ca.SX
    passive: ca.SX
    command: ca.SX
    reference: ca.SX
    """Command of the reference posture, shape (n_command,)."""
    closure: ca.SX
    """ĝ, shape (closure_rows,)."""
    constants: tuple[ca.SX, ...]
    """Constants of a sensor, by sensor group."""
    nuisance: tuple[ca.SX, ...]
    """Nuisance parameters of a sensor, by sensor group, [SI]."""
    readings: tuple[ca.SX, ...]
    """h by sensor group, [m]."""


class SymbolicProblem:
    """Expressions of a calibration problem.

    Args:
        problem: The problem.
    """

    def __init__(self, problem: CalibrationProblem) -> None:
        self.problem = problem

    @cached_property
    def error_map(self) -> SymbolicErrorMap:
        """Geometry of the machine as expressions of θ̂."""
        p = self.problem
        return SymbolicErrorMap(p.functions.errors, fixed=p.closure.errors(), columns=p.columns)

    @cached_property
    def posture(self) -> PostureExpressions:
        """The closures of one posture."""
        functions, shared, scale = (
            self.problem.functions,
            self.error_map,
            self.problem.passive_scale,
        )
        command, passive = self._posture_symbols()
        g, g_a, g_q, g_t = functions.closure_expressions(
            shared.actuated(command), passive * scale, shared.placements
        )
        columns = ca.diag(ca.SX(scale))
        return PostureExpressions(
            passive=passive,
            command=command,
            closure=g / LENGTH_SCALE,
            by_passive=g_q @ columns / LENGTH_SCALE,
            by_theta=shared.chain(g_t, g_a, command) / LENGTH_SCALE,
        )

    @cached_property
    def readings(self) -> tuple[ReadingExpressions, ...]:
        """One reading of each sensor group."""
        problem, shared = self.problem, self.error_map
        result = []
        for k, group in enumerate(problem.model.groups):
            command, passive = self._posture_symbols()
            reference = ca.SX.sym("reference", command.numel())
            constants = ca.SX.sym("constants", group.constants.shape[1])
            nuisance = ca.SX.sym("nuisance", group.nuisance.shape[1])
            h, h_a, h_q, h_t, h_r, h_nu = group.reading.expression(
                shared.actuated(command),
                passive * problem.passive_scale,
                shared.placements,
                shared.actuated(reference),
                constants,
                nuisance,
            )
            by_theta = shared.chain(h_t, h_a, command)
            by_theta += shared.chain(ca.SX(*h_t.shape), h_r, reference)
            by_theta, by_passive = ca.sparsify(by_theta), ca.sparsify(h_q)
            theta_index, used = _columns_of(by_theta), _columns_of(by_passive)
            scale = ca.SX(problem.passive_scale[used]).T
            result.append(
                ReadingExpressions(
                    group=k,
                    entries=group.entries,
                    table=group.constants,
                    setups=group.setups,
                    nuisance_index=problem.n_machine + group.nuisance,
                    nuisance=nuisance,
                    by_nuisance=h_nu,
                    passive_index=used,
                    theta_index=theta_index,
                    passive=passive[used.tolist()],
                    command=command,
                    reference=reference,
                    constants=constants,
                    reading=h,
                    by_passive=by_passive[0, used.tolist()] * scale,
                    by_theta=by_theta[0, theta_index.tolist()],
                )
            )
        return tuple(result)

    @cached_property
    def direct(self) -> DirectExpressions:
        """Closures and readings as direct expressions of the machine's θ̂."""
        problem, robot = self.problem, self.problem.robot
        command, passive = self._posture_symbols()
        theta = ca.SX.sym("theta", problem.n_machine)
        reference = ca.SX.sym("reference", command.numel())
        errors: dict[str, ca.SX | float] = dict(problem.fixed)
        names = problem.machine_selection.names
        errors.update({n: theta[i] * problem.theta_scale[i] for i, n in enumerate(names)})
        map_, n = problem.functions.errors, len(robot.drives)
        machine, at_reference = (
            SymbolicRobot(
                robot, drives=u[:n], passive=q, errors=errors, conditions=map_.split(u[n:])
            )
            for u, q in (
                (command, passive * problem.passive_scale),
                (reference, ca.SX(robot.reference_passive)),
            )
        )
        setups = list(problem.session.setups.values())
        constants, nuisance, readings = [], [], []
        for group in problem.model.groups:
            sensor = setups[int(problem.observations.setup[group.entries[0]])].sensor
            frames = sensor.frames(robot)
            values = ca.SX.sym("constants", group.constants.shape[1])
            symbols = ca.SX.sym("nuisance", group.nuisance.shape[1])
            poses = [machine.frame_pose(f) for f in frames.in_posture]
            at_zero = [at_reference.frame_pose(f) for f in frames.at_zero]
            constants.append(values)
            nuisance.append(symbols)
            readings.append(express_reading(robot, sensor, poses, at_zero, values, symbols))
        scale = closure_row_units(robot) / LENGTH_SCALE
        return DirectExpressions(
            theta,
            passive,
            command,
            reference,
            machine.closure_residual() * scale,
            tuple(constants),
            tuple(nuisance),
            tuple(readings),
        )

    def _posture_symbols(self) -> tuple[ca.SX, ca.SX]:
        return (
            ca.SX.sym("command", self.problem.states.commands.shape[1]),
            ca.SX.sym("passive", self.problem.robot.passive_index.size),
        )


def _columns_of(row: ca.SX) -> Indices:
    """Indices of the columns of a sparse row that are not empty."""
    return np.array(sorted(set(row.sparsity().get_col())), dtype=np.int64)
