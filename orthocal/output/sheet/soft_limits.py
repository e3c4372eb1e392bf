"""Comparison of the programs of a session with the soft limits of a controller."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from orthocal.measurement.motion.guidance import shown_joints
from orthocal.measurement.motion.motion import plan_motion
from orthocal.session.points import one_row_per_point
from orthocal.session.session import Session
from orthocal.units import DRIVE_UNITS, format_fixed

ROUNDING = 1e-6
"""Largest excess over a limit that is ignored, [m, rad]: limits are written to 1 µm."""

MOST_PLACES = 4
"""Largest number of postures that are named for a limit."""


def describe_beyond_limits(
    session: Session, limits: Sequence[tuple[float, float]], *, file: str
) -> str:
    """Motions of the programs beyond the soft limits of joints, and the remedy; "" without any.

    The path to each posture counts, with its approach.

    Args:
        session: The plan.
        limits: MIN_LIMIT and MAX_LIMIT of each joint, [m, rad].
        file: Name of the file with the limits.

    Raises:
        SessionError: If the machine cannot go through the plan.
    """
    lines = [
        _describe_beyond(session, i, key, limit, places)
        for (i, key, limit), places in _find_beyond(session, limits).items()
    ]
    if not lines:
        return ""
    head = f"{file}: the controller refuses motions of this plan, which exceed its soft limits."
    remedy = (
        "If the drive can go there, widen the limit. Otherwise change these postures in "
        "session.yaml or their approach in readings.csv, and run `orthocal sheet --ini`."
    )
    return "\n".join([head, *lines, remedy])


def _find_beyond(
    session: Session, limits: Sequence[tuple[float, float]]
) -> dict[tuple[int, str, float], dict[tuple[str, str], float]]:
    """Farthest coordinate of a joint on the way to each posture beyond a limit, [m, rad].

    Returns:
        Coordinates by (number of the joint, key of the limit, limit), then by setup and posture.
    """
    beyond: dict[tuple[int, str, float], dict[tuple[str, str], float]] = {}
    for motion in plan_motion(one_row_per_point(session)):
        alignment = () if motion.alignment is None else (motion.alignment,)
        for stop in (*alignment, *motion.stops):
            path = np.array([stop.approach_drives, stop.drives]) if stop.path is None else stop.path
            shown = shown_joints(session.robot, path)
            for i, (low, high) in enumerate(limits):
                for key, limit, sign in (("MIN_LIMIT", low, -1.0), ("MAX_LIMIT", high, 1.0)):
                    farthest = (sign * shown[:, i]).max()
                    if farthest > sign * limit + ROUNDING:
                        places = beyond.setdefault((i, key, limit), {})
                        place = motion.setup, stop.posture
                        before = places.get(place, sign * farthest)
                        places[place] = sign * float(max(farthest, sign * before))
    return beyond


def _describe_beyond(
    session: Session, joint: int, key: str, limit: float, places: dict[tuple[str, str], float]
) -> str:
    """Line about a limit: setups and postures with the farthest coordinate of the joint.

    Args:
        session: The plan.
        joint: Number of the joint.
        key: Key of the limit.
        limit: The limit, [m, rad].
        places: Farthest coordinate by setup and posture, [m, rad].
    """
    drive = session.robot.drives[joint]
    unit, size = DRIVE_UNITS[drive.unit]
    named = [
        f"{setup} {posture} reaches {format_fixed(value / size, 3)}"
        for (setup, posture), value in list(places.items())[:MOST_PLACES]
    ]
    more = f" and {len(places) - MOST_PLACES} more" if len(places) > MOST_PLACES else ""
    return (
        f"  JOINT_{joint} ({drive.name}), {key} {format_fixed(limit / size, 3)} {unit}: "
        f"{', '.join(named)} {unit}{more}"
    )
