"""How far the tool moves with an error of the machine, passive joints following the loops.

    J = p_θ − p_q g_q⁻¹ g_θ

with p the tool's position and g the closures, by the errors θ and the passive joints q.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.errors import RobotError
from orthocal.kinematics.assembly import Assembly
from orthocal.kinematics.batch import BatchFunction
from orthocal.kinematics.slopes import SharedPlacements
from orthocal.robot.model import Robot

Array = NDArray[np.float64]


class ToolSensitivity:
    """∂p/∂θ of the tool at commanded postures.

    Args:
        robot: The nominal robot.
        free: Names of the parameters.
        values: Values of all parameters about which to differentiate, [SI]; 0 where absent.

    Raises:
        RobotError: If the robot has no tool centre point.
    """

    def __init__(
        self, robot: Robot, *, free: Sequence[str], values: Mapping[str, float] | None = None
    ) -> None:
        if robot.tcp is None:
            raise RobotError("has no tool centre point; add orthocal.tcp", where=str(robot.yaml))
        at = dict(values or {})
        self.robot = robot
        self.free = tuple(free)
        self.theta = np.array([at.get(name, 0.0) for name in self.free])
        self.assembly = Assembly(robot, fixed=at)
        theta = ca.SX.sym("theta", len(self.free))
        errors: dict[str, ca.SX | float] = {k: v for k, v in at.items() if k not in self.free}
        errors.update({name: theta[i] for i, name in enumerate(self.free)})
        shared = SharedPlacements(robot, theta, errors)
        drives = ca.SX.sym("drives", len(robot.drives))
        passive = ca.SX.sym("passive", robot.passive_index.size)
        machine = shared.machine(drives=drives, passive=passive)
        frame = robot.frame_id(robot.tcp.frame)
        rows = [shared.position_slopes(machine, frame, ca.SX(np.eye(3)[i]).T) for i in range(3)]
        by_joints, by_theta = (ca.vertcat(*(r[k] for r in rows)) for k in (0, 1))
        g_joints, g_theta = shared.closure_slopes(machine)
        index = robot.passive_index.tolist()
        function = ca.Function(
            "tool_sensitivity",
            [drives, passive, theta, shared.values, shared.slope_nonzeros],
            [by_joints[:, index], by_theta, g_joints[:, index], g_theta],
            ["drives", "passive", "theta", "placements", "slopes"],
            ["p_q", "p_theta", "g_q", "g_theta"],
        )
        self._function = BatchFunction(
            function, shared=["theta", "placements", "slopes"], matrices=function.name_out()
        )
        self._shared = [np.asarray(v.full()).reshape(-1) for v in shared.function(self.theta)]

    def __call__(
        self,
        drives: ArrayLike,
        *,
        names: Sequence[str] | None = None,
        passive: ArrayLike | None = None,
    ) -> Array:
        """∂p/∂θ at commanded drive coordinates.

        Args:
            drives: Shape (K, n_drives), [m, rad].
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
            passive = self.assembly.close(d, names=names)
        p_q, p_theta, g_q, g_theta = self._function(d, passive, self.theta, *self._shared)
        if g_q.shape[1] == g_q.shape[2]:
            slopes = np.linalg.solve(g_q, g_theta)
        else:
            slopes = np.linalg.pinv(g_q, rcond=1e-10) @ g_theta
        return np.asarray(p_theta - p_q @ slopes)
