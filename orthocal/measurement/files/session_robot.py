"""What a session says of its robot, held against it: zero and controller."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import SessionError
from orthocal.io.fields import read_only
from orthocal.measurement.files.schema import OFFSET_KEYS, ControllerKeys
from orthocal.robot.model import Robot
from orthocal.units import DRIVE_UNITS

Array = NDArray[np.float64]


def require_given_zero(robot: Robot, where: str) -> None:
    """Refuse a robot whose zero is one of many: legs, sections and offsets count from it.

    Args:
        robot: The robot.
        where: File and key that name it, for messages.

    Raises:
        SessionError: With the zeros that were found, which may be adopted.
    """
    found = [
        f"{d.name}.zero_{unit} ({d.zero / size:.6g} was found)"
        for d in robot.drives
        for unit, size in [DRIVE_UNITS[d.unit]]
        if d.zero_computed
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
