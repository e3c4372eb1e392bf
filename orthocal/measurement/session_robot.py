"""What a session says of its robot, held against it: zero, controller, directions of gauges."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import SessionError
from orthocal.measurement.schema import OFFSET_KEYS, ControllerKeys
from orthocal.measurement.session import DIRECTIONS
from orthocal.robot.model import Leg, Robot, read_only

Array = NDArray[np.float64]

LARGEST_OBLIQUITY_DEG = 1.0
"""How far a measured direction may be from square to the leg; the nominal leg, in the mechanical
zero."""


def require_given_zero(robot: Robot, where: str) -> None:
    """Refuse a robot whose zero is one of many: legs, sections and offsets count from it.

    Args:
        robot: The robot.
        where: File and key that name it, for messages.

    Raises:
        SessionError: With the zeros that were found, which may be adopted.
    """
    found = [
        f"{d.name}.{'zero_mm' if d.unit == 'm' else 'zero_deg'} ({d.zero * factor:.6g} was found)"
        for d in robot.drives
        for factor in [1e3 if d.unit == "m" else 180.0 / np.pi]
        if d.zero_found
    ]
    if found:
        raise SessionError(
            f"'{robot.name}' cannot stand with its drives at 0, and its mechanical zero is not "
            f"given; add to orthocal.drives in {robot.yaml}: {', '.join(found)}",
            where=where,
        )


def build_offsets(keys: ControllerKeys | None, robot: Robot, where: str) -> Array | None:
    """Offsets that are active in the controller; each key has those of the drives of its kind.

    Args:
        keys: What the session says, None for nothing.
        robot: The robot.
        where: File and key, for messages.

    Returns:
        Shape (n_drives,), [m, rad], or None.

    Raises:
        SessionError: If a drive has no offset, or an offset no drive.
    """
    if keys is None:
        return None
    offsets = np.zeros(len(robot.drives))
    units: set[str] = set()
    for key in keys.stated:
        values, (unit, factor) = getattr(keys, key), OFFSET_KEYS[key]
        drives = [i for i, d in enumerate(robot.drives) if d.unit == unit]
        kind = "prismatic" if unit == "m" else "revolute"
        if not drives:
            fitting = "offsets_deg or offsets_mrad" if unit == "m" else "offsets_mm"
            raise SessionError(
                f"{robot.name} has no {kind} drive; expected {fitting}", where=f"{where}.{key}"
            )
        if len(values) != len(drives):
            names = ", ".join(robot.drives[i].name for i in drives)
            one = "drive" if len(drives) == len(robot.drives) else f"{kind} drive"
            raise SessionError(
                f"has {len(values)} numbers; expected {len(drives)}, one a {one}: {names}",
                where=f"{where}.{key}",
            )
        offsets[drives] = np.array(values) * factor
        units.add(unit)
    for drive in robot.drives:
        if drive.unit not in units:
            expected = " or ".join(k for k, (unit, _) in OFFSET_KEYS.items() if unit == drive.unit)
            raise SessionError(
                f"states no offset of {drive.name}; expected {expected}, too", where=where
            )
    return read_only(offsets)


def _crooked(leg: Leg) -> str:
    """That a leg lies along no axis, which may not be meant."""
    along = ", ".join(f"{v:.3f}" for v in leg.axis)
    return (
        f". In the mechanical zero the leg lies along ({along}): where it should lie along an axis "
        "of the world, check lengths and zeros in the robot's files"
    )


def check_direction(direction: str, leg: Leg, *, where: str) -> None:
    """Refuse a gauge that does not measure square to the leg, as its model takes for granted.

    An oblique plunger also sees how far the leg moves along itself.

    Args:
        direction: One of `DIRECTIONS`.
        leg: The leg it touches.
        where: File and key, for messages.

    Raises:
        SessionError: With the angle to the leg, and the directions that are square to it.
    """
    angles = {
        name: float(np.degrees(np.arccos(np.clip(np.dot(axis, leg.axis), -1.0, 1.0))))
        for name, axis in DIRECTIONS.items()
    }
    if abs(angles[direction] - 90.0) <= LARGEST_OBLIQUITY_DEG:
        return
    square = [n for n, a in angles.items() if abs(a - 90.0) <= LARGEST_OBLIQUITY_DEG]
    choice = f"; square to it: {', '.join(square)}" if square else ""
    found = min(angles[direction], 180.0 - angles[direction])
    if found < LARGEST_OBLIQUITY_DEG:
        problem = f"'{direction}' is along leg {leg.name}; a gauge measures across it{choice}"
    else:
        problem = (
            f"'{direction}' is at {found:.1f}° to leg {leg.name} in the mechanical zero; expected "
            f"a direction square to the leg, to within {LARGEST_OBLIQUITY_DEG:g}°{choice}"
            + ("" if square else _crooked(leg))
        )
    raise SessionError(problem, where=where)
