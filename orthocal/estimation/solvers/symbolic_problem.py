"""Calibration problem as CasADi expressions of one posture and of one reading.

The variables are scaled to order one:

    θ̂ = θ/(prior std),  q̂ = q l/(1 mm),  ĝ = g l/(1 mm)

l is 1 for lengths, and the characteristic length of the robot for angles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from orthocal.arrays import Indices
from orthocal.estimation.problem import LENGTH_SCALE, CalibrationProblem
from orthocal.kinematics.error_map import SymbolicErrorMap
from orthocal.observation.sensor_groups import SensorGroup
from orthocal.robot.model import closure_row_units


@dataclass(frozen=True, slots=True, eq=False)
class ReadingExpressions:
    """Reading of a sensor group as expressions of the variables on which it depends."""

    group: SensorGroup
    """The sensor group."""
    passive_index: Indices
    """Indices of the passive coordinates on which the reading depends, shape (n,)."""
    second_index: Indices
    """Those in the second posture of a pair, shape (m,); empty for other sensors."""
    theta_index: Indices
    """Indices of the free parameters of the machine on which the reading depends, shape (k,)."""
    constants: ca.SX
    """Constants of the sensor and conditions of the reading, shape (n_constants,)."""
    nuisance: ca.SX
    """Nuisance parameters, shape (n_nuisance,), [SI]."""
    reading: ca.SX
    """h, [m]."""
    by_nuisance: ca.SX
    """∂h/∂ν, shape (1, n_nuisance), [m per SI unit]."""
    by_passive: ca.SX
    """∂h/∂q̂, with the second posture last, shape (1, n), [m]."""
    by_theta: ca.SX
    """∂h/∂θ̂, shape (1, n), [m]."""


class SymbolicProblem:
    """Expressions of a calibration problem.

    Args:
        problem: The problem.

    Attributes:
        error_map: Geometry of the machine as expressions of θ̂.
        command: Symbol of the command of a posture, shape (n_command,).
        reference: Symbol of the command of the reference posture, shape (n_command,).
        passive: Symbol of q̂ of a posture, shape (n_passive,).
        second: Symbols of the command and of q̂ in the second posture of a pair.
    """

    def __init__(self, problem: CalibrationProblem) -> None:
        self.problem = problem
        self.error_map = SymbolicErrorMap(
            problem.functions.errors,
            fixed=problem.closure.errors(),
            unit_errors=problem.errors_per_theta,
        )
        n_command = problem.states.commands.shape[1]
        self.command = ca.SX.sym("command", n_command)
        self.reference = ca.SX.sym("reference", n_command)
        self.passive = ca.SX.sym("passive", problem.robot.passive_index.size)
        self.second = ca.SX.sym("command_2", n_command), ca.SX.sym("passive_2", *self.passive.shape)

    @property
    def theta(self) -> ca.SX:
        """Symbol of the machine's θ̂, shape (n_machine,)."""
        return self.error_map.symbols[0]

    @cached_property
    def closure(self) -> tuple[ca.SX, ca.SX]:
        """ĝ of one posture, (closure_rows,), and ∂ĝ/∂(θ̂, q̂), (closure_rows, n)."""
        map_, scale = self.error_map, self.problem.passive_scale
        g, g_a, g_q, g_t = self.problem.functions.closure_expressions(
            map_.actuated(self.command), self.passive * scale, map_.placements
        )
        by_theta = map_.chain(g_t, g_a, self.command)
        jacobian = ca.horzcat(by_theta, g_q @ ca.diag(ca.SX(scale)))
        return self._row_scale * g, ca.diag(self._row_scale) @ jacobian

    @cached_property
    def _row_scale(self) -> ca.SX:
        """Scale of the closure rows, shape (closure_rows,), [1/m, 1/rad]."""
        return ca.SX(closure_row_units(self.problem.robot) / LENGTH_SCALE)

    @cached_property
    def readings(self) -> tuple[ReadingExpressions, ...]:
        """Expressions of one reading of each sensor group."""
        return tuple(self._express(group) for group in self.problem.model.groups)

    def _express(self, group: SensorGroup) -> ReadingExpressions:
        """Expressions of one reading of a sensor group."""
        map_, scale = self.error_map, self.problem.passive_scale
        constants = ca.SX.sym("constants", group.constants.shape[1])
        nuisance = ca.SX.sym("nuisance", group.nuisance.shape[1])
        h, h_a, h_q, h_t, h_r, h_nu, *by_second = self._evaluate(
            group, map_.placements, constants, nuisance
        )
        by_theta = map_.chain(h_t, h_a, self.command)
        by_theta += map_.chain(ca.SX(*h_t.shape), h_r, self.reference)
        h_q2 = ca.SX(1, 0)
        if by_second:
            h_a2, h_q2 = by_second
            by_theta += map_.chain(ca.SX(*h_t.shape), h_a2, self.second[0])
        by_theta, by_q = ca.sparsify(by_theta), [ca.sparsify(h_q), ca.sparsify(h_q2)]
        theta_index, indices = _used_columns(by_theta), [_used_columns(row) for row in by_q]
        by_passive = ca.horzcat(
            *(
                row[0, index.tolist()] * ca.SX(scale[index]).T
                for row, index in zip(by_q, indices, strict=True)
            )
        )
        return ReadingExpressions(
            group=group,
            passive_index=indices[0],
            second_index=indices[1],
            theta_index=theta_index,
            constants=constants,
            nuisance=nuisance,
            reading=h,
            by_nuisance=h_nu,
            by_passive=by_passive,
            by_theta=by_theta[0, theta_index.tolist()],
        )

    def passive_of(self, expressions: ReadingExpressions) -> ca.SX:
        """Symbols of q̂ on which a reading depends, with the second posture last."""
        first, second = self.passive, self.second[1]
        indices = expressions.passive_index.tolist(), expressions.second_index.tolist()
        return ca.vertcat(first[indices[0]], second[indices[1]])

    # ---- direct expressions of θ̂ and q̂, for second derivatives

    @cached_property
    def _direct_placements(self) -> ca.SX:
        """Moved placements in a posture, shape (12 n_moved,)."""
        return self.error_map.direct_placements(self.command)

    @cached_property
    def direct_closure(self) -> ca.SX:
        """ĝ of one posture, shape (closure_rows,)."""
        g, _, _, _ = self.problem.functions.closure_expressions(
            self.error_map.actuated(self.command),
            self.passive * self.problem.passive_scale,
            self._direct_placements,
        )
        return self._row_scale * g

    def direct_reading(self, expressions: ReadingExpressions) -> ca.SX:
        """Reading h, [m]."""
        constants, nuisance = expressions.constants, expressions.nuisance
        return self._evaluate(expressions.group, self._direct_placements, constants, nuisance)[0]

    def _evaluate(
        self, group: SensorGroup, placements: ca.SX, constants: ca.SX, nuisance: ca.SX
    ) -> list[ca.SX]:
        """Reading of a sensor group and its derivatives (see `CompiledReading.expression`)."""
        actuated, scale = self.error_map.actuated, self.problem.passive_scale
        command, passive = self.second
        inputs = [actuated(self.command), self.passive * scale, placements]
        inputs += [actuated(self.reference), constants, nuisance]
        inputs += [actuated(command), passive * scale] if group.reading.pairs else []
        return group.reading.expression.call(inputs)


def _used_columns(row: ca.SX) -> Indices:
    """Indices of the nonzeros of a sparse row."""
    return np.array(sorted(set(row.sparsity().get_col())), dtype=np.int64)
