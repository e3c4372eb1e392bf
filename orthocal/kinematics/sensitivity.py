"""Sensitivity of the tool's position to errors of the machine, with the loops closed.

    J = (p_ξ − M g_ξ) ∂ξ/∂θ + (p_a − M g_a) ∂a/∂θ,  M = p_q g_q⁻¹

p is the tool position and g = 0 are the loop closures. Both depend on the actual drive coordinates
a, the passive coordinates q and the twists ξ of the placements. A subscript denotes a partial
derivative, and θ are the errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.kinematics.conditions import UseConditions
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.robot_functions import robot_functions
from orthocal.robot.closing import invert_closures
from orthocal.robot.model import Robot, require_tcp

POSTURE_BLOCK_SIZE = 64
"""Number of postures per block if placements depend on the posture; one needs 300 kB."""


class ToolSensitivity:
    """Sensitivity ∂p/∂θ of the tool at commanded postures.

    Args:
        robot: The nominal robot.
        free: Names of the parameters.
        values: Parameter values at the point of differentiation, [SI]; 0 where absent.
        conditions: Conditions of use of drive coordinates; neutral by default.

    Attributes:
        theta: Values of the free parameters at the point of differentiation, shape (n_free,), [SI].
        closure: Loop closures with all values fixed.

    Raises:
        RobotError: If the robot has no tool centre point.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        free: Sequence[str],
        values: Mapping[str, float] | None = None,
        conditions: UseConditions | None = None,
    ) -> None:
        require_tcp(robot)
        values = dict(values or {})
        self.robot = robot
        self.free = tuple(free)
        self.theta = np.array([values.get(name, 0.0) for name in self.free])
        self.closure = LoopClosure(robot, fixed=values, conditions=conditions)
        self._functions = robot_functions(robot)
        errors = self._functions.errors
        self._unit_errors = errors.unit_errors(self.free)
        self._drive_errors = self._unit_errors[errors.drive_errors]

    def __call__(
        self,
        drives: ArrayLike,
        *,
        names: Sequence[str] | None = None,
        passive: ArrayLike | None = None,
    ) -> Array:
        """Evaluate ∂p/∂θ at commanded drive coordinates.

        If effects make placements depend on the command, postures are evaluated in blocks to limit
        memory.

        Args:
            drives: Shape (K, n_drives), [m, rad], or commands, shape (K, n_command).
            names: Names of the postures, for messages.
            passive: Passive coordinates that close the loops in these postures, shape
                (K, n_passive), [m, rad]; solved by default.

        Returns:
            Shape (K, 3, n_free), [m per parameter unit].

        Raises:
            ClosureError: If a posture cannot be reached.
            LinAlgError: If passive coordinates are passed and a posture is singular.
        """
        coordinates = np.atleast_2d(np.asarray(drives, dtype=np.float64))
        if passive is None:
            passive = self.closure.close(coordinates, names=names)
        commands, q = self.closure.commands(coordinates), np.atleast_2d(passive)
        conditions = commands[:, self._functions.errors.of_placements]
        if not conditions.size:
            return self._differentiate(commands, q, self._placement_jacobian)
        if (conditions == conditions[0]).all():
            return self._differentiate(commands, q, self._placement_jacobians(commands[:1])[0])
        starts = range(0, len(commands), POSTURE_BLOCK_SIZE)
        blocks = [slice(k, k + POSTURE_BLOCK_SIZE) for k in starts]
        return np.concatenate(
            [
                self._differentiate(commands[b], q[b], self._placement_jacobians(commands[b]))
                for b in blocks
            ]
        )

    @cached_property
    def _placement_jacobian(self) -> Array:
        """∂ξ/∂θ of the placements under neutral conditions, shape (n_twists, n_free)."""
        return self._functions.errors.placement_jacobian(self.closure.errors(), self._unit_errors)

    def _placement_jacobians(self, commands: Array) -> Array:
        """∂ξ/∂θ of the placements under the conditions of commands, (K, n_twists, n_free)."""
        errors = np.tile(self.closure.errors(), (len(commands), 1))
        return self._functions.errors.placement_jacobian(
            errors, self._unit_errors, commands=commands
        )

    def _differentiate(self, commands: Array, passive: Array, placement_jacobian: Array) -> Array:
        """Evaluate the equation of the module's docstring.

        Args:
            commands: Shape (K, n_command).
            passive: q, shape (K, n_passive), [m, rad].
            placement_jacobian: ∂ξ/∂θ, shape (n_twists, n_free) or (K, n_twists, n_free).

        Returns:
            Shape (K, 3, n_free).
        """
        arguments = self.closure.inputs(commands, passive)
        _, p_a, p_q, p_xi = self._functions.tool_jacobian(*arguments)
        _, g_a, g_q, g_xi = self._functions.closure_jacobian(*arguments)
        multiplier = p_q @ invert_closures(g_q)
        by_twists = p_xi - self._multiply_closures(multiplier, g_xi)
        _, drive_jacobian = self.closure.geometry().drive_derivatives(commands)
        by_drive_errors = (p_a - multiplier @ g_a) @ drive_jacobian
        return np.asarray(by_twists @ placement_jacobian + by_drive_errors @ self._drive_errors)

    def _multiply_closures(self, multiplier: Array, nonzeros: Array) -> Array:
        """Product M g_ξ with the sparse g_ξ, whose nonzeros are in the order of columns.

        Args:
            multiplier: M, shape (K, 3, n_rows).
            nonzeros: Nonzeros of g_ξ, shape (K, nnz).

        Returns:
            Shape (K, 3, n_twists).
        """
        rows, columns = self._functions.twist_pattern
        result = np.zeros((*multiplier.shape[:2], self._functions.n_twists))
        if columns.size:
            used, starts = np.unique(columns, return_index=True)
            products = np.take(multiplier, rows, axis=2) * nonzeros[:, None, :]
            result[:, :, used] = np.add.reduceat(products, starts, axis=2)
        return result
