"""Arcs from the words that tell them: a centre or a radius."""

from __future__ import annotations

import math

from orthocal.errors import GcodeError
from orthocal.gcode.path import PLANES, Arc, Vector

UNEQUAL_RADII = 5e-6
"""By how much the radii at both ends of an arc may differ, [m]: centres are written with three or
four decimals."""

UNEQUAL_SHARE = 1e-3
"""The same as part of the radius; controllers refuse more than that and 0.13 mm."""

MOST_UNEQUAL = 127e-6
SMALLEST_RADIUS = 1e-7
MOST_TURNS = 10_000

SHORT_RADIUS = 5e-6
"""By how much R may be less than half the distance of the ends, for a half circle, [m]."""

NAMES = "XYZ"
CENTRES = "IJK"


def arc_about(
    start: Vector,
    end: Vector,
    center: tuple[float, float],
    *,
    plane: int,
    clockwise: bool,
    turns: int,
    where: str,
) -> Arc:
    """The arc about a centre.

    Args:
        start: [m].
        end: [m].
        center: In the axes of the plane, [m].
        plane: 17, 18 or 19.
        clockwise: G2, seen from the positive end of the axis square to the plane.
        turns: Times that it reaches its end.
        where: For messages.

    Raises:
        GcodeError: If its ends are not equally far from the centre.
    """
    i, j, _ = PLANES[plane]
    first = (start[i] - center[0], start[j] - center[1])
    last = (end[i] - center[0], end[j] - center[1])
    r0, r1 = math.hypot(*first), math.hypot(*last)
    if min(r0, r1) < SMALLEST_RADIUS:
        raise GcodeError("an arc has its centre at one of its ends", where=where)
    allowed = max(UNEQUAL_RADII, min(UNEQUAL_SHARE * r0, MOST_UNEQUAL))
    if abs(r0 - r1) > allowed:
        raise GcodeError(
            f"an arc begins {r0 * 1e3:.6g} mm from its centre and ends {r1 * 1e3:.6g} mm from it; "
            "expected the same",
            where=where,
        )
    angle = math.atan2(first[1], first[0])
    sweep = math.atan2(last[1], last[0]) - angle
    if start[i] == end[i] and start[j] == end[j]:
        sweep = 0.0
    sweep %= 2.0 * math.pi
    if clockwise:
        sweep -= 2.0 * math.pi
    elif sweep == 0.0:
        sweep = 2.0 * math.pi
    sweep += math.copysign(2.0 * math.pi * (turns - 1), sweep)
    return Arc(plane, center, (r0, r1), angle, sweep)


def center_of_radius(
    start: Vector, end: Vector, radius: float, *, plane: int, clockwise: bool, where: str
) -> tuple[float, float]:
    """The centre of an arc that is told by R: below 0 the long way.

    Raises:
        GcodeError: If there is no such arc, or more than one.
    """
    i, j, _ = PLANES[plane]
    across = (end[i] - start[i], end[j] - start[j])
    distance = math.hypot(*across)
    if distance < SMALLEST_RADIUS:
        raise GcodeError(
            f"R with both ends at the same {NAMES[i]} and {NAMES[j]} tells no centre; "
            f"expected {CENTRES[i]} and {CENTRES[j]}",
            where=where,
        )
    half = 0.5 * distance
    if abs(radius) < half - SHORT_RADIUS:
        raise GcodeError(
            f"R is {abs(radius) * 1e3:.6g} mm, less than half the distance of the arc's ends, "
            f"{half * 1e3:.6g} mm",
            where=where,
        )
    height = math.sqrt(max(radius * radius - half * half, 0.0))
    if clockwise != (radius < 0.0):
        height = -height
    middle = (0.5 * (start[i] + end[i]), 0.5 * (start[j] + end[j]))
    return (
        middle[0] - height * across[1] / distance,
        middle[1] + height * across[0] / distance,
    )
