"""Tip of a tool on the calibrated machine, a point fixed to the platform.

A controller adds a constant tool offset t, in the orientation of the nominal platform at the
mechanical zero. The platform of the calibrated machine is rotated by R, with the tip at p' + R t
for the tool centre point p'. So the tip is at the commanded p + t if p' = p + t − R t.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ExportError, ParameterError
from orthocal.kinematics.conditions import UseConditions
from orthocal.kinematics.continuation import Failures
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.robot_functions import reference_poses, robot_functions
from orthocal.units import MM

TOLERANCE = 1e-12
"""Largest distance of a tip from its target, [m]."""

MAX_STEPS = 60
"""Largest number of corrections of a point."""

LARGEST_COORDINATE = 10.0
"""Largest accepted coordinate of a tip, [m]; a larger one is probably in another unit."""


def require_tip(tool: Sequence[float]) -> None:
    """Refuse a tip out of range.

    Raises:
        ParameterError: If a coordinate is not a number, or too large.
    """
    if not all(abs(v) <= LARGEST_COORDINATE for v in tool):
        raise ParameterError(
            f"found {', '.join(f'{v / MM:g}' for v in tool)} mm; expected numbers of at most "
            f"{LARGEST_COORDINATE / MM:g} mm",
            where="--tool",
        )


class ToolTip:
    """Forward and inverse kinematics of a tool's tip on the calibrated machine.

    Args:
        calibration: Calibration of a robot whose drives command the tool.
        tool: Tip in the frame of the robot's tool centre point, shape (3,), [m].
        errors: Errors of the machine by name, [SI]; by default the identified ones.
        conditions: Conditions of use; by default the middle between both sides of each drive, the
            reference temperature and no payload.

    Raises:
        ExportError: If the drives do not command the tool.
        ParameterError: If the tip is out of range.
    """

    def __init__(
        self,
        calibration: Calibration,
        tool: ArrayLike = (0.0, 0.0, 0.0),
        *,
        errors: Mapping[str, float] | None = None,
        conditions: UseConditions | None = None,
    ) -> None:
        robot = calibration.robot
        if robot.tcp is None or not robot.commands_tool:
            raise ExportError("the machine has no tool that its drives command")
        self.calibration = calibration
        self.tool = np.array(tool, dtype=np.float64)
        require_tip(self.tool.tolist())
        self.coordinates = list(robot.tcp.coordinates)
        """Indices of the coordinates that the drives command."""
        errors = calibration.errors if errors is None else errors
        self._closure = LoopClosure(robot, fixed=errors, conditions=conditions or UseConditions())
        self._pose = robot_functions(robot).pose(robot.tcp.frame)
        (reference,) = reference_poses(robot, [robot.tcp.frame])
        self.level = np.array(reference[:3, :3])
        """Rotation of the nominal platform at the mechanical zero, shape (3, 3)."""

    def targets(self, points: Array) -> Array:
        """Desired tips for commanded points, shape (k, n), [m]."""
        return np.asarray(points + (self.level @ self.tool)[self.coordinates])

    def place(self, drives: Array, *, start: Array | None = None) -> Array:
        """Tips at drive coordinates, shape (k, n), [m]."""
        return self._tips(drives, self._closure.close(drives, start=start))

    def _tips(self, drives: Array, passive: Array) -> Array:
        """Tips at drive coordinates with closed loops, shape (k, n), [m]."""
        poses = self.poses(drives, passive)
        tips = poses[:, :3, 3] + poses[:, :3, :3] @ self.tool
        return np.asarray(tips[:, self.coordinates])

    def poses(self, drives: Array, passive: Array) -> Array:
        """Poses of the robot's tool centre point, shape (k, 4, 4), [1, m].

        Args:
            drives: Drive coordinates, shape (k, n_drives), [m, rad].
            passive: Passive coordinates that close the loops, shape (k, n_passive), [m, rad].
        """
        (poses,) = self._pose(*self._closure.inputs(drives, passive))
        return np.asarray(poses)

    def reach(
        self, points: Array, *, start: Array | None = None, failures: Failures | None = None
    ) -> tuple[Array, Array]:
        """Drive and passive coordinates that bring the tip to its targets.

        Args:
            points: Commanded points, shape (k, n), [m].
            start: Drive and passive coordinates to start from, shape (k, n_drives + n_passive); the
                reference posture by default.
            failures: Filled with the points out of reach, whose results are NaN. If it is None, the
                first such point raises an error.

        Raises:
            ClosureError: If a point is out of reach.
            ExportError: If the iteration diverges because the platform tilts too much.
        """
        shifted, targets = np.array(points), self.targets(points)
        for _ in range(MAX_STEPS):
            drives, passive = self._closure.reach(shifted, start=start, failures=failures)
            reached = np.isfinite(drives).all(axis=1)
            if not self.tool.any() or not reached.any():
                return drives, passive
            distance = targets[reached] - self._tips(drives[reached], passive[reached])
            if np.abs(distance).max() < TOLERANCE:
                return drives, passive
            shifted[reached] += distance
            shifted[~reached] = np.nan  # these are in `failures`
            start = np.hstack([drives, passive])
        raise ExportError(
            "the platform tilts too much for a tool of this length; use a shorter one"
        )
