"""Tool of a calibrated machine: its positions over a workspace and their sensitivities."""

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
from orthocal.kinematics.loop_closure import (
    LoopClosure,
    nominal_closure,
    require_within_travel,
)
from orthocal.kinematics.reachable_box import find_workspace
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.kinematics.workspace import Workspace

TOOL_CACHE_SIZE = 4
"""Number of calibrations whose tools are cached."""

DEVIATION_CACHE_SIZE = 8
"""Number of cached deviations of tools."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedTool:
    """Tool of a calibrated machine at K commanded points under C conditions of use.

    Arrays with C K rows hold all points under the first condition, then under the second etc.
    """

    workspace: Workspace
    """The C K points."""
    use: UseSamples
    """The conditions."""
    targets: Array
    """Commanded tool positions: those of the nominal machine, shape (C K, 3), [m]."""
    drives: Array
    """Drive coordinates of a nominal machine, shape (K, n_drives), [m, rad]."""
    passive: Array
    """Passive coordinates of a nominal machine, shape (K, n_passive), [m, rad]. Those of the
    calibrated machine are close to them."""
    sensitivities: tuple[ToolSensitivity, ...]
    """Sensitivity of the tool under each of the conditions."""
    trims: Array
    """Displacement of the drives by the controller's compensation, shape (C, K, n_drives),
    [m, rad]."""
    trims_unstated: Array
    """Displacement of the drives by the controller's compensation if the side of approach is not
    stated, shape (K, n_drives), [m, rad]."""
    jacobian: Array
    """∂p/∂θ with the offsets that were active while measuring, shape (C K, 3, n),
    [m per parameter unit]."""

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.sensitivities[0].free

    def compensating(self, backlash: Array) -> CalibratedTool:
        """Tool with a controller that compensates more backlash.

        Args:
            backlash: Change of the compensated backlash of each drive, shape (n_drives,), [m, rad].
        """
        if not backlash.any():
            return self
        unstated = "u" * backlash.size
        sides = [[APPROACH[s] for s in c.approach or unstated] for c in self.use.conditions]
        trims = self.trims + 0.5 * np.array(sides)[:, None, :] * backlash
        return replace(self, trims=read_only(trims))

    def deviation(self, offsets: ArrayLike, *, names: Sequence[str] | None = None) -> Array:
        """Actual minus commanded position of the tool, shape (C K, 3), [m].

        Args:
            offsets: Offsets in the controller, shape (n_drives,), [m, rad].
            names: Names of the points, for messages.
        """
        offset_array = np.asarray(offsets, dtype=np.float64)
        if names is None:
            return np.array(_deviation(self, offset_array.tobytes()))
        return self._place(self.drives - offset_array + self.trims, names) - self.targets

    def deviation_ignoring_conditions(self) -> Array:
        """Tool error if all errors are corrected for `UseConditions()`, shape (C K, 3), [m]."""
        closure = self.sensitivities[0].closure
        reference = LoopClosure(closure.robot, fixed=closure.fixed, conditions=UseConditions())
        commanded, passive = reference.reach(self.workspace.points[: len(self.drives)])
        reached = reference.tcp(commanded, passive)
        commanded = commanded + self.trims - self.trims_unstated
        return self._place(commanded, None) - np.tile(reached, (self.use.size, 1))

    def _place(self, commanded: Array, names: Sequence[str] | None) -> Array:
        """Tool positions under each of the conditions, shape (C K, 3), [m].

        Args:
            commanded: Drive coordinates, shape (C, K, n_drives), [m, rad].
            names: Names of the points, for messages.
        """
        closures = (s.closure for s in self.sensitivities)
        positions = [
            c.forward(drives, start=self.passive, names=names)
            for c, drives in zip(closures, commanded, strict=True)
        ]
        return np.concatenate(positions)


@lru_cache(maxsize=DEVIATION_CACHE_SIZE)
def _deviation(tool: CalibratedTool, offsets: bytes) -> Array:
    """Deviation with offsets in the controller, shape (C K, 3), [m].

    Cached, because several figures need it. Offsets are bytes, as arrays are not hashable.
    """
    return tool._place(tool.drives - np.frombuffer(offsets) + tool.trims, None) - tool.targets


@lru_cache(maxsize=TOOL_CACHE_SIZE)
def find_tool(calibration: Calibration, use: UseSamples | None = None) -> CalibratedTool | None:
    """Tool over the workspace, or over the largest reachable box of its shape.

    The box is within all limits and reached by the nominal and the calibrated machine, with the
    offsets that were active while measuring and with the identified ones.

    Cached, because values to enter and tool errors need it.

    Args:
        calibration: The calibration.
        use: Conditions of use; by default those that the robot's YAML states.

    Returns:
        None if the drives do not command a tool, or if no box of ±1 mm can be reached.
    """
    robot = calibration.robot
    if not robot.commands_tool:
        return None
    use = sample_use(robot) if use is None else use
    closure = LoopClosure(robot, fixed=calibration.errors, conditions=use.conditions[0])
    identified_offsets = calibration.offsets

    def require_reach(points: Array) -> None:
        drives, passive = nominal_closure(robot).reach(points)
        for offsets in (calibration.active_offsets, identified_offsets):
            require_within_travel(robot, drives - offsets)
            closure.forward(drives - offsets, start=passive)

    try:
        workspace = find_workspace(robot, require_reach)
    except ClosureError:
        return None
    return _place(calibration, workspace, use)


def place_tool(
    calibration: Calibration,
    workspace: Workspace,
    use: UseSamples | None = None,
    *,
    names: Sequence[str] | None = None,
) -> CalibratedTool:
    """Tool of a calibrated machine at commanded points.

    Args:
        calibration: The calibration.
        workspace: The points.
        use: Conditions of use; by default those that the robot's YAML states.
        names: Names of the points, for messages.

    Raises:
        RobotError: If the robot has no tool centre point, or the drives do not command it.
        ClosureError: If a point cannot be reached.
    """
    point_names = names or [f"point {i + 1}" for i in range(len(workspace.points))]
    samples = sample_use(calibration.robot) if use is None else use
    return _place(calibration, workspace, samples, point_names)


def _place(
    calibration: Calibration,
    workspace: Workspace,
    use: UseSamples,
    names: Sequence[str] | None = None,
) -> CalibratedTool:
    """Tool at the points of a workspace; arguments as for `place_tool`.

    It is differentiated by free parameters, unmodelled errors and the remaining offsets.
    """
    robot, errors = calibration.robot, calibration.errors
    free = [*(p.name for p in calibration.free), *calibration.unmodelled.names]
    is_offset = [row.any() for row in calibration.offset_weights]
    offsets = [f"{d.name}.offset" for d, has in zip(robot.drives, is_offset, strict=True) if has]
    free += [n for n in offsets if n not in free]
    sensitivities = tuple(
        ToolSensitivity(robot, free=free, values=errors, conditions=c) for c in use.conditions
    )
    nominal = nominal_closure(robot)
    drives, passive = nominal.reach(workspace.points, names=names)
    commanded = drives - calibration.active_offsets
    jacobians = []
    for sensitivity in sensitivities:
        closed = sensitivity.closure.close(commanded, start=passive, names=names)
        jacobians.append(sensitivity(commanded, passive=closed))
    return CalibratedTool(
        workspace=workspace.repeat(use.size),
        use=use,
        targets=read_only(np.tile(nominal.tcp(drives, passive), (use.size, 1))),
        drives=read_only(drives),
        passive=read_only(passive),
        trims=read_only([calibration.displacement(drives, c.approach) for c in use.conditions]),
        trims_unstated=read_only(calibration.displacement(drives)),
        sensitivities=sensitivities,
        jacobian=read_only(np.concatenate(jacobians)),
    )
