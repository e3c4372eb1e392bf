"""The tool of a calibrated machine: over which region, and how it answers to errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ClosureError
from orthocal.io.fields import read_only
from orthocal.kinematics.conditions import APPROACH, UseConditions, UseSamples, sample_use
from orthocal.kinematics.loop_closure import LoopClosure, nominal_closure
from orthocal.kinematics.reachable_box import find_workspace
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.kinematics.workspace import Workspace
from orthocal.robot.model import Robot

KEPT = 4
"""Calibrations whose tools are kept."""

MOST_DEVIATIONS = 8
"""Deviations of tools that are kept."""

LIMIT_SLACK = 1e-9
"""By which a drive may seem to be beyond its travel, [m, rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedTool:
    """The tool of a calibrated machine at commanded points, under C conditions of use in turn."""

    workspace: Workspace
    """The points, once for each of the conditions."""
    use: UseSamples
    """The conditions."""
    targets: Array
    """Where a nominal machine's tool would be, shape (C K, 3), [m]."""
    drives: Array
    """Drive coordinates of a nominal machine, shape (K, n_drives), [m, rad]."""
    passive: Array
    """Its passive coordinates, shape (K, n_passive), [m, rad]: others are near."""
    sensitivities: tuple[ToolSensitivity, ...]
    """Under each of the conditions."""
    trims: Array
    """Displacement of the drives by what the controller compensates, (C, K, n_drives), [m, rad]."""
    trims_unstated: Array
    """The same where the side of approach is not stated, shape (K, n_drives), [m, rad]."""
    jacobian: Array
    """∂p/∂θ there, with the offsets active while measuring, shape (C K, 3, n), [m per unit]."""

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.sensitivities[0].free

    def compensating(self, backlash: Array) -> CalibratedTool:
        """The tool with a controller that takes up more backlash.

        Args:
            backlash: Change of the compensated backlash of each drive, (n_drives,), [m, rad].
        """
        if not backlash.any():
            return self
        unknown = "u" * backlash.size
        sides = [[APPROACH[s] for s in c.approach or unknown] for c in self.use.conditions]
        trims = self.trims + 0.5 * np.array(sides)[:, None, :] * backlash
        return replace(self, trims=read_only(trims))

    def deviation(self, offsets: ArrayLike, *, names: Sequence[str] | None = None) -> Array:
        """Actual less commanded position of the tool, shape (C K, 3), [m].

        Args:
            offsets: In the controller, shape (n_drives,), [m, rad].
            names: What to call the points in messages.
        """
        at = np.asarray(offsets, dtype=np.float64)
        if names is None:
            return np.array(_deviation(self, at.tobytes()))
        return self._place(self.drives - at + self.trims, names) - self.targets

    def deviation_unless_stated(self) -> Array:
        """Error of a controller that corrects all errors for the conditions of `UseConditions()`.

        Shape (C K, 3), [m].
        """
        closure, points = self.middle, self.workspace.points[: len(self.drives)]
        commanded, passive = closure.reach(points)
        reached = closure.tcp(commanded, passive)
        commanded = commanded + self.trims - self.trims_unstated
        return self._place(commanded, None) - np.tile(reached, (self.use.size, 1))

    @property
    def middle(self) -> LoopClosure:
        """Closures of the machine under conditions that are not stated."""
        closure = self.sensitivities[0].closure
        return LoopClosure(closure.robot, fixed=closure.fixed, conditions=UseConditions())

    def _place(self, commanded: Array, names: Sequence[str] | None) -> Array:
        """Tool under each of the conditions at its drive coordinates, shape (C K, 3), [m].

        Args:
            commanded: Shape (C, K, n_drives), [m, rad].
            names: What to call the points in messages.
        """
        closures = (s.closure for s in self.sensitivities)
        workspaces = [
            c.forward(drives, start=self.passive, names=names)
            for c, drives in zip(closures, commanded, strict=True)
        ]
        return np.concatenate(workspaces)


@lru_cache(maxsize=MOST_DEVIATIONS)
def _deviation(tool: CalibratedTool, offsets: bytes) -> Array:
    """Deviation with offsets in the controller, of the last ones: several figures need it."""
    return tool._place(tool.drives - np.frombuffer(offsets) + tool.trims, None) - tool.targets


@lru_cache(maxsize=KEPT)
def find_tool(calibration: Calibration, use: UseSamples | None = None) -> CalibratedTool | None:
    """The tool over the workspace, or over the largest box of its shape that the machine reaches.

    The tools of the last calibrations are kept: values to enter and tool errors need them.

    That is within all limits and reached by the nominal and the calibrated machine, with the
    offsets that were active while measuring and with the identified ones.

    Args:
        calibration: The calibration.
        use: Conditions of use; those that the robot's YAML states by default.

    Returns:
        None for a robot whose drives do not command a tool, or whose tool hardly moves.
    """
    robot = calibration.robot
    if robot.tcp is None or len(robot.tcp.coordinates) != len(robot.drives):
        return None
    use = sample_use(robot) if use is None else use
    sensitivities = _sensitivities(calibration, use)
    identified = calibration.offsets

    def reach(points: Array) -> None:
        drives, passive = nominal_closure(robot).reach(points)
        for offsets in (calibration.active_offsets, identified):
            _require_travel(robot, drives - offsets)
            sensitivities[0].closure.forward(drives - offsets, start=passive)

    try:
        space = find_workspace(robot, reach)
    except ClosureError:
        return None
    return _place(calibration, space, use, sensitivities)


def place_tool(
    calibration: Calibration,
    workspace: Workspace,
    use: UseSamples | None = None,
    *,
    names: Sequence[str] | None = None,
) -> CalibratedTool:
    """The tool of a calibrated machine over given points.

    Args:
        calibration: The calibration.
        workspace: The points.
        use: Conditions of use; those that the robot's YAML states by default.
        names: What to call the points in messages.

    Raises:
        RobotError: If the robot has no tool centre point, or the drives do not command it.
        ClosureError: If a point cannot be reached.
    """
    named = names or [f"point {i + 1}" for i in range(len(workspace.points))]
    samples = sample_use(calibration.robot) if use is None else use
    sensitivities = _sensitivities(calibration, samples)
    return _place(calibration, workspace, samples, sensitivities, named)


def _sensitivities(calibration: Calibration, use: UseSamples) -> tuple[ToolSensitivity, ...]:
    """Tool sensitivity by the free parameters, the unmodelled errors and the remaining offsets."""
    robot, errors = calibration.robot, calibration.errors
    free = [*(p.name for p in calibration.free), *calibration.unmodelled.names]
    is_offset = [row.any() for row in calibration.offset_weights]
    offsets = [f"{d.name}.offset" for d, has in zip(robot.drives, is_offset, strict=True) if has]
    free += [n for n in offsets if n not in free]
    return tuple(
        ToolSensitivity(robot, free=free, values=errors, conditions=c) for c in use.conditions
    )


def _place(
    calibration: Calibration,
    space: Workspace,
    use: UseSamples,
    sensitivities: tuple[ToolSensitivity, ...],
    names: Sequence[str] | None = None,
) -> CalibratedTool:
    nominal = nominal_closure(calibration.robot)
    drives, passive = nominal.reach(space.points, names=names)
    commanded = drives - calibration.active_offsets
    jacobians = []
    for sensitivity in sensitivities:
        closed = sensitivity.closure.close(commanded, start=passive, names=names)
        jacobians.append(sensitivity(commanded, passive=closed))
    return CalibratedTool(
        workspace=space.repeat(use.size),
        use=use,
        targets=read_only(np.tile(nominal.tcp(drives, passive), (use.size, 1))),
        drives=read_only(drives),
        passive=read_only(passive),
        trims=read_only([calibration.displacement(drives, c.approach) for c in use.conditions]),
        trims_unstated=read_only(calibration.displacement(drives)),
        sensitivities=sensitivities,
        jacobian=read_only(np.concatenate(jacobians)),
    )


def _require_travel(robot: Robot, drives: Array) -> None:
    """Refuse drive coordinates beyond a drive's travel, shape (K, n_drives)."""
    for drive, values in zip(robot.drives, drives.T, strict=True):
        if values.min() < drive.lower - LIMIT_SLACK or values.max() > drive.upper + LIMIT_SLACK:
            raise ClosureError(f"is beyond the travel of {drive.name}", posture="a corner")


def error_covariance(calibration: Calibration) -> Array:
    """Covariance of what the estimate has wrong, free and unmodelled parameters in turn, [SI].

    With e = θ − θ̂ it is −L θᵤ and the estimate's own scatter for the free ones, θᵤ for the others.
    """
    unmodelled = calibration.unmodelled
    variance = unmodelled.prior_stds**2
    taken_on = unmodelled.leakage * variance
    return np.block(
        [
            [calibration.model_covariance + taken_on @ unmodelled.leakage.T, -taken_on],
            [-taken_on.T, np.diag(variance)],
        ]
    )
