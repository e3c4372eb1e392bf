"""Sensitivity of the tool's position to errors of the machine, with the loops closed.

    J = p_θ − p_q g_q⁻¹ g_θ

with p the tool's position and g the closures, by the errors θ and the passive joints q.
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
from orthocal.robot.model import Robot, require_tcp

CONDITIONS_AT_ONCE = 64
"""Postures with placements of their own that are differentiated together; each takes 300 kB."""


class ToolSensitivity:
    """∂p/∂θ of the tool at commanded postures.

    Args:
        robot: The nominal robot.
        free: Names of the parameters.
        values: Values of all parameters about which to differentiate, [SI]; 0 where absent.
        conditions: As for `LoopClosure`.

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
        at = dict(values or {})
        self.robot = robot
        self.free = tuple(free)
        self.theta = np.array([at.get(name, 0.0) for name in self.free])
        self.closure = LoopClosure(robot, fixed=at, conditions=conditions)
        self._functions = robot_functions(robot)
        errors = self._functions.errors
        self._columns = errors.columns(self.free)
        self._drive_errors = self._columns[errors.drive_errors]

    def __call__(
        self,
        drives: ArrayLike,
        *,
        names: Sequence[str] | None = None,
        passive: ArrayLike | None = None,
    ) -> Array:
        """∂p/∂θ at commanded drive coordinates.

        Args:
            drives: Shape (K, n_drives), [m, rad], or commands, shape (K, n_command).
            names: What to call the postures in messages.
            passive: Passive coordinates that close the loops there, shape (K, n_passive), [m, rad],
                if they are known.

        Returns:
            Shape (K, 3, n_free), [m per parameter unit].

        Raises:
            ClosureError: If a posture cannot be reached.
        """
        d = np.atleast_2d(np.asarray(drives, dtype=np.float64))
        if passive is None:
            passive = self.closure.close(d, names=names)
        commands, q = self.closure.commands(d), np.atleast_2d(passive)
        under = commands[:, self._functions.errors.of_placements]
        if not under.size:
            return self._differentiate(commands, q, self._twists)
        if (under == under[0]).all():
            return self._differentiate(commands, q, self._twists_under(commands[:1])[0])
        rows = [slice(k, k + CONDITIONS_AT_ONCE) for k in range(0, len(d), CONDITIONS_AT_ONCE)]
        parts = [
            self._differentiate(commands[r], q[r], self._twists_under(commands[r])) for r in rows
        ]
        return np.concatenate(parts)

    @cached_property
    def _twists(self) -> Array:
        """Derivative of the moved placements by the parameters, shape (n_twists, n_free)."""
        return self._functions.errors.jacobian(self.closure.errors(), self._columns)

    def _twists_under(self, commands: Array) -> Array:
        """Derivative of the moved placements under commands, shape (K, n_twists, n_free)."""
        errors = np.tile(self.closure.errors(), (len(commands), 1))
        return self._functions.errors.jacobian(errors, self._columns, command=commands)

    def _differentiate(self, commands: Array, passive: Array, moved: Array) -> Array:
        """∂p/∂θ at commands, with the derivative of the moved placements by the parameters."""
        arguments = self.closure.inputs(commands, passive)
        _, p_a, p_q, p_t = self._functions.tool_jacobian(*arguments)
        _, g_a, g_q, nonzeros = self._functions.closure_jacobian(*arguments)
        if g_q.shape[1] == g_q.shape[2]:
            multiplier = np.swapaxes(
                np.linalg.solve(np.swapaxes(g_q, 1, 2), np.swapaxes(p_q, 1, 2)), 1, 2
            )
        else:
            multiplier = p_q @ np.linalg.pinv(g_q, rcond=1e-10)
        twists = p_t - self._times_twists(multiplier, nonzeros)
        _, by_drive_errors = self.closure.geometry().drive_derivatives(commands)
        drives = (p_a - multiplier @ g_a) @ by_drive_errors
        return np.asarray(twists @ moved + drives @ self._drive_errors)

    def _times_twists(self, multiplier: Array, nonzeros: Array) -> Array:
        """Rows times ∂g by twists, shape (K, 3, n_twists) of (K, 3, n_rows) and (K, nnz)."""
        rows, columns = self._functions.twist_pattern
        result = np.zeros((*multiplier.shape[:2], self._functions.n_twists))
        if columns.size:
            used, starts = np.unique(columns, return_index=True)
            products = multiplier[:, :, rows] * nonzeros[:, None, :]
            result[:, :, used] = np.add.reduceat(products, starts, axis=2)
        return result
