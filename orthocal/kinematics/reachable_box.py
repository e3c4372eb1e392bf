"""Boxes that a machine reaches: the default workspace, and the largest box of a stated shape."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import ClosureError, RobotError
from orthocal.io.fields import read_only
from orthocal.kinematics.function_cache import cached_per_robot, fingerprint, function_key
from orthocal.kinematics.loop_closure import nominal_closure, require_within_travel
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.kinematics.workspace import (
    POINTS_PER_SIDE,
    Workspace,
    box_workspace,
    coordinate_letters,
    cube_limits,
    describe_box,
    find_below_bed,
    tool_at_zero,
)
from orthocal.robot.model import Robot, coordinate_units, require_commanded_tool
from orthocal.runtime import disk_cache

RequireReach = Callable[[Array], object]
"""Check of tool positions, shape (K, n_coordinates), [m]: raises ClosureError if one is out of
reach."""

SMALLEST_HALF_SIDE = 1e-3
"""Half side of the smallest box that is accepted as a workspace, [m]."""

REACH_MARGIN = 1.08
"""Factor by which the nominal machine must reach further than the default cube."""

MAX_CONDITION_NUMBER = 10.0
"""Largest condition number, in a workspace, of the derivative of the tool position with respect to
the drives. Rotations of drives are scaled to metres."""

BISECTION_TOLERANCE = 0.004
"""Relative difference of the limits at which the bisection for the largest box ends."""


def find_workspace(robot: Robot, require_reach: RequireReach | None = None) -> Workspace:
    """Workspace of a robot, or of a machine that must reach it.

    The workspace is the box in the robot's YAML. Without one it is the largest cube of at most
    ±60 mm that the nominal machine reaches with a margin of 8 %. The margin is for other machines
    of these dimensions, which may reach less. If `require_reach` refuses this box, it is the
    largest similar box.

    The largest limit of a reduced box is a multiple of 1 mm, or of 0.1 mm below 10 mm.

    Args:
        robot: The robot.
        require_reach: Check of points on a machine. By default the nominal machine must reach a
            box in the YAML completely.

    Raises:
        RobotError: If the drives do not command the tool; by default also if the nominal machine
            does not reach the box in the YAML.
        ClosureError: If no box of ±1 mm can be reached.
    """
    require_commanded_tool(robot)
    requested = robot.workspace
    if require_reach is not None:
        box = _default_workspace(robot).limits if requested is None else requested
        reached = _largest_box(robot, box, require_reach)
        complete = requested is None or np.array_equal(reached.limits, requested)
        return reached if complete else replace(reached, requested=requested)
    if requested is None:
        return _default_workspace(robot)
    problem = describe_unreachable_box(robot, requested)
    if problem:
        raise RobotError(problem, where=f"{robot.yaml}: orthocal.workspace.box_mm")
    return box_workspace(robot, requested)


@cached_per_robot
def _default_workspace(robot: Robot) -> Workspace:
    """Largest cube of at most ±60 mm that the nominal machine reaches with a margin.

    Its limits are cached on disk.
    """
    cube = cube_limits(robot)
    key = function_key("default workspace", fingerprint(robot))
    content = disk_cache.load(key)
    if content is not None:
        return box_workspace(robot, np.frombuffer(content).reshape(cube.shape))
    zero, require_reach = tool_at_zero(robot), _nominal_reach_check(robot)
    workspace = _largest_box(
        robot, cube, lambda points: require_reach(zero + REACH_MARGIN * (points - zero))
    )
    disk_cache.store(key, workspace.limits.tobytes())
    return workspace


def describe_unreachable_box(robot: Robot, box: Array) -> str:
    """Message that the nominal machine does not reach a box, with the largest similar box.

    Args:
        robot: The robot.
        box: Limits relative to the mechanical zero, shape (n_coordinates, 2), [m].

    Returns:
        The message; "" if the machine reaches the box.
    """
    require_reach, letters = _nominal_reach_check(robot), coordinate_letters(robot)
    try:
        require_reach(box_workspace(robot, box).points)
    except ClosureError as e:
        text = f"the machine does not reach the workspace {describe_box(box, letters)} ({e.reason})"
    else:
        return ""
    try:
        largest = _largest_box(robot, box, require_reach).limits
    except ClosureError:
        return f"{text}; no smaller box of this shape can be reached"
    return f"{text}; the largest box of this shape is {describe_box(largest, letters)}"


def _nominal_reach_check(robot: Robot) -> RequireReach:
    """Check of tool positions on the nominal machine.

    Positions must be within the travel of the drives, above a bed and away from singularities.
    """
    coordinates = list(require_commanded_tool(robot))
    units = coordinate_units(robot)[robot.drive_index]
    sensitivity = ToolSensitivity(robot, free=[f"{d.name}.offset" for d in robot.drives])

    def require_reach(points: Array) -> None:
        for failure in find_below_bed(robot, points).values():
            raise failure
        drives, passive = nominal_closure(robot).reach(points)
        require_within_travel(robot, drives, ["a corner"] * len(drives))
        singular = ClosureError("is nearly singular", posture="a corner")
        try:
            jacobians = sensitivity(drives, passive=passive)[:, coordinates] / units
        except np.linalg.LinAlgError:  # the closures are singular: the drives leave motions free
            raise singular from None
        if (np.linalg.cond(jacobians) > MAX_CONDITION_NUMBER).any():
            raise singular

    return require_reach


def _largest_box(robot: Robot, box: Array, require_reach: RequireReach) -> Workspace:
    """Largest reachable box that is similar to a box and not larger.

    The centre of scaling is the mechanical zero, or the point of the box that is nearest to it.

    Raises:
        ClosureError: If no box of ±1 mm can be reached.
    """
    centre = np.clip(0.0, box[:, 0], box[:, 1])[:, None]
    largest = float(np.abs(box - centre).max())

    def scaled(size: float) -> Array:
        return read_only(centre + (box - centre) * (size / largest))

    def fits(limits: Array, points_per_side: int) -> bool:
        try:
            require_reach(box_workspace(robot, limits, points_per_side=points_per_side).points)
        except ClosureError:
            return False
        return True

    if fits(box, POINTS_PER_SIDE):
        return box_workspace(robot, box)
    low, high = 0.0, largest
    while high - low > BISECTION_TOLERANCE * high and high >= SMALLEST_HALF_SIDE:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(scaled(middle), 3) else (low, middle)
    size = _round_down(high)
    while size >= SMALLEST_HALF_SIDE and not fits(scaled(size), POINTS_PER_SIDE):
        size = _round_down(size - 1e-6)  # the next smaller step
    if size < SMALLEST_HALF_SIDE:
        raise no_workspace_error()
    return box_workspace(robot, scaled(size))


def no_workspace_error() -> ClosureError:
    """Error of a machine that reaches no box of ±1 mm."""
    return ClosureError(
        "cannot be reached: no box of ±1 mm around it is within the limits of the machine",
        posture="mechanical zero",
    )


def _round_down(length: float) -> float:
    """Length rounded down to whole millimetres, or to tenths below ten, [m]."""
    step = 1e-3 if length >= 10e-3 else 1e-4
    # 1e-9: a multiple of the step is not rounded down by a rounding error
    return round(math.floor(length / step + 1e-9) * step, 6)
