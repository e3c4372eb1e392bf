"""The tool of a calibrated machine: over which region, and how it answers to errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ClosureError
from orthocal.io.fields import read_only
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.kinematics.workspace import Workspace, find_workspace
from orthocal.robot.model import Robot

LIMIT_SLACK = 1e-9
"""By which a drive may seem to be beyond its travel, [m, rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedTool:
    """The tool of a calibrated machine at commanded points."""

    workspace: Workspace
    targets: Array
    """Where a nominal machine's tool would be, shape (K, 3), [m]."""
    drives: Array
    """Drive coordinates of a nominal machine, shape (K, n_drives), [m, rad]."""
    passive: Array
    """Its passive coordinates, shape (K, n_passive), [m, rad]: others are near."""
    sensitivity: ToolSensitivity
    jacobian: Array
    """∂p/∂θ there, with the offsets active while measuring, shape (K, 3, n), [m per unit]."""

    def deviation(self, offsets: ArrayLike, *, names: Sequence[str] | None = None) -> Array:
        """Actual less commanded position of the tool, shape (K, 3), [m].

        Args:
            offsets: In the controller, shape (n_drives,), [m, rad].
            names: What to call the points in messages.
        """
        commanded = self.drives - np.asarray(offsets, dtype=np.float64)
        found = self.sensitivity.closure.forward(commanded, start=self.passive, names=names)
        return np.asarray(found - self.targets)


def find_tool(calibration: Calibration) -> CalibratedTool | None:
    """The tool over the workspace, or over the largest box of its shape that the machine reaches.

    That is within all limits and reached by the nominal and the calibrated machine, with the
    offsets that were active while measuring and with the identified ones.

    Returns:
        None for a robot whose drives do not command a tool, or whose tool hardly moves.
    """
    robot = calibration.robot
    if robot.tcp is None or len(robot.tcp.coordinates) != len(robot.drives):
        return None
    sensitivity = _sensitivity(calibration)
    identified = calibration.offsets

    def reach(points: Array) -> None:
        drives, passive = nominal_closure(robot).reach(points)
        for offsets in (calibration.active_offsets, identified):
            _require_travel(robot, drives - offsets)
            sensitivity.closure.forward(drives - offsets, start=passive)

    try:
        space = find_workspace(robot, reach)
    except ClosureError:
        return None
    return _place(calibration, space, sensitivity, None)


def place_tool(
    calibration: Calibration, workspace: Workspace, *, names: Sequence[str] | None = None
) -> CalibratedTool:
    """The tool of a calibrated machine over given points.

    Args:
        calibration: The calibration.
        workspace: The points.
        names: What to call them in messages.

    Raises:
        RobotError: If the robot has no tool centre point, or the drives do not command it.
        ClosureError: If a point cannot be reached.
    """
    named = names or [f"point {i + 1}" for i in range(len(workspace.points))]
    return _place(calibration, workspace, _sensitivity(calibration), named)


def _sensitivity(calibration: Calibration) -> ToolSensitivity:
    """Tool sensitivity by the free parameters, the unmodelled errors and the remaining offsets."""
    robot, errors = calibration.robot, calibration.errors
    free = [*(p.name for p in calibration.free), *calibration.unmodelled.names]
    own = [row.any() for row in calibration.offset_weights]
    offsets = [f"{d.name}.offset" for d, has in zip(robot.drives, own, strict=True) if has]
    free += [n for n in offsets if n not in free]
    return ToolSensitivity(robot, free=free, values=errors)


def _place(
    calibration: Calibration,
    space: Workspace,
    sensitivity: ToolSensitivity,
    names: Sequence[str] | None,
) -> CalibratedTool:
    nominal = nominal_closure(calibration.robot)
    drives, passive = nominal.reach(space.points, names=names)
    commanded = drives - calibration.active_offsets
    closed = sensitivity.closure.close(commanded, start=passive, names=names)
    return CalibratedTool(
        workspace=space,
        targets=read_only(nominal.tcp(drives, passive)),
        drives=read_only(drives),
        passive=read_only(passive),
        sensitivity=sensitivity,
        jacobian=read_only(sensitivity(commanded, passive=closed)),
    )


def _require_travel(robot: Robot, drives: Array) -> None:
    """Refuse drive coordinates beyond a drive's travel, shape (K, n_drives)."""
    for drive, values in zip(robot.drives, drives.T, strict=True):
        if values.min() < drive.lower - LIMIT_SLACK or values.max() > drive.upper + LIMIT_SLACK:
            raise ClosureError(f"is beyond the travel of {drive.name}", posture="a corner")


def error_covariance(calibration: Calibration, *, excess: float = 1.0) -> Array:
    """Covariance of what the estimate has wrong, free and unmodelled parameters in turn, [SI].

    With e = θ − θ̂ it is −L θᵤ and the estimate's own scatter for the free ones, θᵤ for the others.

    Args:
        calibration: The calibration.
        excess: Factor of the priors of unmodelled errors.
    """
    unmodelled = calibration.unmodelled
    variance = (excess * unmodelled.prior_stds) ** 2
    taken_on = unmodelled.leakage * variance
    return np.block(
        [
            [calibration.model_covariance + taken_on @ unmodelled.leakage.T, -taken_on],
            [-taken_on.T, np.diag(variance)],
        ]
    )
