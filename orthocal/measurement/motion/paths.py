"""Paths of the tool that sensors prescribe, and samples of paths that the machine reaches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from orthocal.arrays import Array, Triple
from orthocal.errors import ClosureError, UnreachablePathError
from orthocal.kinematics.continuation import Failures
from orthocal.kinematics.loop_closure import find_beyond_travel, nominal_closure
from orthocal.kinematics.tool_rotation import place_turning, rotation_shift
from orthocal.kinematics.workspace import position_at_zero
from orthocal.measurement.motion.guidance import below_bed
from orthocal.measurement.motion.stops import Stop
from orthocal.robot.model import require_tcp
from orthocal.sensors.protocol import ToolPath, probing_direction, tool_path
from orthocal.session.session import Session

STEP = 5e-3
"""Largest distance between samples of a segment, [m]."""

Path = Callable[[Array, Array], Array]
"""Corners of the path of the tool between two coordinates, shape (n, n_coordinates), [m]."""


class SampledPath(NamedTuple):
    """Samples of a path."""

    points: Array
    """Tool coordinates, shape (n, n_coordinates), [m]."""
    drives: Array
    """Drive coordinates, shape (n, n_drives), [m, rad]."""
    passive: Array
    """Passive coordinates, shape (n, n_passive), [m, rad]."""


def guided_setups(session: Session) -> dict[str, Path]:
    """Prescribed paths of the tool between readings, by setup, for sensors that have one."""
    if not session.robot.commands_tool:
        return {}
    return {
        name: _in_coordinates(session, path, getattr(setup.sensor, "tool", (0.0, 0.0, 0.0)))
        for name, setup in session.setups.items()
        if (path := tool_path(setup.sensor)) is not None
    }


def probed_setups(session: Session) -> dict[str, Triple]:
    """Directions of probes, by setup."""
    if not session.robot.commands_tool:
        return {}
    return {
        name: direction
        for name, setup in session.setups.items()
        if (direction := probing_direction(setup.sensor)) is not None
    }


def _in_coordinates(session: Session, path: ToolPath, tool: Triple) -> Path:
    """Path between coordinates that the drives control: in space, or in the plane of motion.

    Args:
        session: The session.
        path: Path of a tool without rotation.
        tool: Point of the tool that follows the path, in the tool's frame, [m].
    """
    robot = session.robot
    coordinates = list(require_tcp(robot).coordinates)
    others = [k for k in range(3) if k not in coordinates]
    normal = [np.eye(3)[others[0]]] if len(others) == 1 else []
    fixed = position_at_zero(robot)

    def between(start: Array, end: Array) -> Array:
        ends = np.array([fixed, fixed])
        on_path = np.array([start, end])
        ends[:, coordinates] = on_path + rotation_shift(robot, on_path, tool)
        corners = place_turning(robot, path(*ends, *normal)[:, coordinates], tool)
        if below_bed(session, corners) and not below_bed(session, on_path):
            corners = place_turning(robot, path(*ends, *normal, above=True)[:, coordinates], tool)
        return corners

    return between


def require_paths(
    session: Session,
    setup: str,
    stops: Sequence[Stop],
    paths: Sequence[SampledPath | None],
    remark: str = "",
) -> list[SampledPath]:
    """Paths to the stops of a setup.

    Raises:
        UnreachablePathError: If a path leaves the workspace; names the posture.
    """
    below = "" if session.robot.bed is None else " or goes below the bed"
    for stop, path in zip(stops, paths, strict=True):
        if path is None:
            raise UnreachablePathError(
                f"the path to posture '{stop.posture}' of setup '{setup}' leaves the workspace"
                f"{below}{remark}",
                setup=setup,
                posture=stop.posture,
                where=str(session.path or "session"),
            )
    return [path for path in paths if path is not None]


def walk(corners: Array, length: float) -> Array:
    """Point of a polyline at a distance from its start; its end if the polyline is shorter.

    Args:
        corners: Shape (n, n_coordinates), [m].
        length: Distance along the polyline, [m].
    """
    for start, end in pairwise(corners):
        step = float(np.linalg.norm(end - start))
        if step >= length:
            return np.asarray(start + length / step * (end - start))
        length -= step
    return np.asarray(corners[-1])


def sample_paths(
    session: Session, polylines: Sequence[Sequence[Array]], *, probing: bool = False
) -> list[SampledPath | None]:
    """Samples of polylines of tool coordinates; None if the machine does not reach all of one.

    Args:
        session: The session.
        polylines: Corners of each, shape (n_coordinates,) each, [m].
        probing: Whether a surface stops the last motion of each, so that its end may be below it.
    """
    robot, sampled = session.robot, [_sample(corners) for corners in polylines]
    closure, points, failures = nominal_closure(robot), np.concatenate(sampled), Failures()
    try:
        drives, passive = closure.reach(points)  # cached: gauges of a leg have the same path
    except ClosureError:
        drives, passive = closure.reach(points, failures=failures)
    paths, first = list[SampledPath | None](), 0
    for part, corners in zip(sampled, polylines, strict=True):
        last = first + len(part)
        path = SampledPath(part, drives[first:last], passive[first:last])
        reached = failures.keys().isdisjoint(range(first, last))
        moved = np.array(corners[1:-1] if probing else corners[1:])
        if reached and (find_beyond_travel(robot, path.drives) or below_bed(session, moved)):
            reached = False
        paths.append(path if reached else None)
        first = last
    return paths


def _sample(corners: Sequence[Array]) -> Array:
    """Points of a polyline at distances of at most STEP, shape (n, n_coordinates), [m]."""
    segments = [corners[0][None]]
    for start, end in pairwise(corners):
        count = max(2, int(np.ceil(np.linalg.norm(end - start) / STEP)))
        segments.append(start + np.arange(1, count + 1)[:, None] / count * (end - start))
    return np.concatenate(segments)
