"""Comparison of the programs of a session with the soft limits of a controller."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from orthocal.arrays import Array
from orthocal.kinematics.workspace import tool_at_zero
from orthocal.measurement.motion.guidance import shown_joints, shown_tool
from orthocal.measurement.motion.motion import plan_motion
from orthocal.measurement.motion.stops import Stop
from orthocal.robot.model import require_tcp
from orthocal.session.points import one_row_per_point
from orthocal.session.session import Session
from orthocal.units import DRIVE_UNITS, Unit, format_fixed

ROUNDING = 1e-6
"""Largest excess over a limit that is ignored, [m, rad]: limits are written to 1 µm."""

AT_ZERO = ("the mechanical zero,", "where every program begins,")
"""Named in place of setup and posture if the start of programs is beyond a limit."""

MOST_PLACES = 4
"""Largest number of postures that are named for a limit."""


def describe_beyond_limits(
    session: Session,
    limits: Sequence[tuple[float, float]],
    axis_limits: Sequence[tuple[float, float]] = (),
    *,
    file: str,
) -> str:
    """Motions of the programs beyond soft limits, and the remedy; "" without any.

    The path to each posture counts, with its approach.

    Args:
        session: The plan.
        limits: MIN_LIMIT and MAX_LIMIT of each joint, [m, rad].
        axis_limits: Those of the axes X, Y and Z, [m]; by default none.
        file: Name of the file with the limits.

    Raises:
        SessionError: If the machine cannot go through the plan.
    """
    robot = session.robot
    titles: list[tuple[str, Unit]] = [
        (f"JOINT_{i} ({d.name})", d.unit) for i, d in enumerate(robot.drives)
    ]
    all_limits = list(limits)
    if axis_limits and robot.commands_tool:
        coordinates = require_tcp(robot).coordinates
        titles += [(f"AXIS_{'XYZ'[c]}", "m") for c in coordinates]
        all_limits += [axis_limits[c] for c in coordinates]
    lines = [
        _describe_beyond(*titles[i], key, limit, places)
        for (i, key, limit), places in _find_beyond(session, all_limits).items()
    ]
    if not lines:
        return ""
    head = f"{file}: the controller refuses motions of this plan, which exceed its soft limits."
    remedy = (
        "If the machine can go there, widen the limit. Otherwise change these postures in "
        "session.yaml or their approach in readings.csv, and run `orthocal sheet --ini`. The "
        "mechanical zero must be within the limits."
    )
    return "\n".join([head, *lines, remedy])


def _find_beyond(
    session: Session, limits: Sequence[tuple[float, float]]
) -> dict[tuple[int, str, float], dict[tuple[str, str], float]]:
    """Farthest coordinate of a joint or an axis on the way to each posture beyond a limit.

    If the mechanical zero is beyond a limit, it is named alone.

    Args:
        session: The plan.
        limits: Limits of the joints, and of the axes after them if they count, [m, rad].

    Returns:
        Coordinates, [m, rad], by (index of the limits, key of the limit, limit), then by setup and
        posture.
    """
    paths = [] if session.firmware is not None else [(AT_ZERO, _shown_at_zero(session))]
    for motion in plan_motion(one_row_per_point(session)):
        alignment = () if motion.alignment is None else (motion.alignment,)
        paths += [
            ((motion.setup, stop.posture), _shown_on_path(session, stop))
            for stop in (*alignment, *motion.stops)
        ]
    beyond: dict[tuple[int, str, float], dict[tuple[str, str], float]] = {}
    for place, shown in paths:
        for i, ((low, high), coordinates) in enumerate(zip(limits, shown, strict=False)):
            for key, limit, sign in (("MIN_LIMIT", low, -1.0), ("MAX_LIMIT", high, 1.0)):
                farthest = (sign * coordinates).max()
                places = beyond.setdefault((i, key, limit), {})
                if farthest > sign * limit + ROUNDING and AT_ZERO not in places:
                    before = places.get(place, sign * farthest)
                    places[place] = sign * float(max(farthest, sign * before))
    return {limit: places for limit, places in beyond.items() if places}


def _shown_at_zero(session: Session) -> list[Array]:
    """Coordinates that the controller displays in the mechanical zero; as `_shown_on_path`."""
    robot = session.robot
    shown = list(shown_joints(robot, robot.drive_zero[None]).T)
    if not robot.commands_tool:
        return shown
    origin = np.array(session.controller_origin)[list(require_tcp(robot).coordinates)]
    return [*shown, *(tool_at_zero(robot) + origin)[:, None]]


def _shown_on_path(session: Session, stop: Stop) -> list[Array]:
    """Coordinates that the controller displays on the way to a stop, [m, rad].

    Those of each joint, then those of each commanded coordinate of the tool.
    """
    path = np.array([stop.approach_drives, stop.drives]) if stop.path is None else stop.path
    shown = list(shown_joints(session.robot, path).T)
    if stop.point is None or stop.approach_point is None:
        return shown
    corners = np.array([*stop.via, stop.approach_point, stop.point])  # straight lines between them
    coordinates = list(require_tcp(session.robot).coordinates)
    origin = np.array(session.controller_origin)[coordinates]
    return [*shown, *(shown_tool(session, corners) + origin).T]


def _describe_beyond(
    title: str, unit_of: Unit, key: str, limit: float, places: dict[tuple[str, str], float]
) -> str:
    """Line about a limit: setups and postures with the farthest coordinate.

    Args:
        title: Section of the INI file.
        unit_of: SI unit of the coordinate.
        key: Key of the limit.
        limit: The limit, [m, rad].
        places: Farthest coordinate by setup and posture, [m, rad].
    """
    unit, size = DRIVE_UNITS[unit_of]
    named = [
        f"{setup} {posture} reaches {format_fixed(value / size, 3)}"
        for (setup, posture), value in list(places.items())[:MOST_PLACES]
    ]
    more = f" and {len(places) - MOST_PLACES} more" if len(places) > MOST_PLACES else ""
    return (
        f"  {title}, {key} {format_fixed(limit / size, 3)} {unit}: {', '.join(named)} {unit}{more}"
    )
