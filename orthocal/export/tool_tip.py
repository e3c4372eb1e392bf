"""A calibrated machine's tool tip: a point that is fixed to the platform, beside the robot's own.

A controller adds a tool's offset as a constant, t in the world where the nominal platform stands in
its zero. So the machine belongs where its tip, R(p') t beside its own point p', is at p + t. The
platform of a calibrated machine is tilted: its tip is elsewhere than a level platform's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.calibration.calibration import Calibration
from orthocal.errors import ExportError
from orthocal.kinematics.loop_closure import Assembly, Failures
from orthocal.kinematics.robot_functions import reference_poses, robot_functions

Array = NDArray[np.float64]

REACHED = 1e-12
"""By which a tip is beside where it belongs, [m]."""

MOST_STEPS = 60

MOST_AT_ONCE = 1000


class ToolTip:
    """The tip of a tool on the calibrated machine, and the drives that bring it somewhere.

    Args:
        calibration: Of a robot with as many drives as coordinates of the tool that they control.
        tool: The tip in the frame of the robot's tool centre point, shape (3,), [m].
    """

    def __init__(self, calibration: Calibration, tool: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        robot = calibration.robot
        if robot.tcp is None or len(robot.tcp.coordinates) != len(robot.drives):
            raise ExportError("the machine has no tool that its drives command over a region")
        self.chosen = list(robot.tcp.coordinates)
        self.tool = np.array(tool, dtype=np.float64)
        self._assembly = Assembly(robot, fixed=calibration.errors)
        self._pose = robot_functions(robot).pose(robot.tcp.frame)
        (zero,) = reference_poses(robot, [robot.tcp.frame])
        self.level = np.array(zero[:3, :3])
        """Rotation of the nominal platform in its zero, shape (3, 3)."""

    def targets(self, points: Array) -> Array:
        """Where the tip belongs for commanded points, shape (K, n), [m]."""
        return np.asarray(points + (self.level @ self.tool)[self.chosen])

    def place(self, drives: Array, *, start: Array | None = None) -> Array:
        """Where the tip is, shape (K, n), [m], for drive coordinates, shape (K, n)."""
        return self._tips(self.poses(drives, start=start))

    def poses(self, drives: Array, *, start: Array | None = None) -> Array:
        """Poses of the robot's tool centre point, shape (K, 4, 4), [1, m]."""
        parts = _parts(len(drives))
        return np.concatenate(
            [self._poses(drives[p], None if start is None else start[p]) for p in parts]
        )

    def reach(self, points: Array, *, failures: Failures | None = None) -> tuple[Array, Array]:
        """Drive and passive coordinates that bring the tip where it belongs for points.

        Args:
            points: Shape (K, n), [m].
            failures: Filled with the points that cannot be reached, which are NaN then; by default
                the first of them raises.

        Raises:
            ClosureError: If one cannot be reached.
            ExportError: If turning platforms bring the tip no nearer.
        """
        found = []
        for part in _parts(len(points)):
            own: Failures | None = None if failures is None else {}
            found.append(self._reach(points[part], own))
            if failures is not None and own:
                failures.update({part.start + i: e for i, e in own.items()})
        drives, passive = (np.concatenate(part) for part in zip(*found, strict=True))
        return drives, passive

    def _reach(self, points: Array, failures: Failures | None) -> tuple[Array, Array]:
        sent, targets, start = np.array(points), self.targets(points), None
        for _ in range(MOST_STEPS):
            drives, passive = self._assembly.reach(sent, start=start, failures=failures)
            good = np.isfinite(drives).all(axis=1)
            if not self.tool.any() or not good.any():
                return drives, passive
            missing = targets[good] - self._tips(self._poses(drives[good], passive[good]))
            if np.abs(missing).max() < REACHED:
                return drives, passive
            sent[good] += missing
            sent[~good] = np.nan  # refused already
            start = np.hstack([drives, passive])
        raise ExportError("the platform turns too much for such a tool; give one nearer to it")

    def _poses(self, drives: Array, start: Array | None) -> Array:
        machine = self._assembly.geometry()
        passive = self._assembly.close(drives, start=start)
        (poses,) = self._pose(machine.drives(drives), passive, machine.placements)
        return np.asarray(poses)

    def _tips(self, poses: Array) -> Array:
        return np.asarray((poses[:, :3, 3] + poses[:, :3, :3] @ self.tool)[:, self.chosen])


def _parts(count: int) -> list[slice]:
    return [slice(i, i + MOST_AT_ONCE) for i in range(0, count, MOST_AT_ONCE)]
