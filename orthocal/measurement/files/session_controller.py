"""Active offsets, compensation and firmware of a session, checked against its robot."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from orthocal.arrays import Array
from orthocal.effects.compensation import Compensation, JointTrim, with_homes
from orthocal.errors import SessionError, errors_at
from orthocal.io.fields import read_only
from orthocal.measurement.files.linuxcnc_ini import read_comp_file
from orthocal.measurement.files.session_keys import ControllerKeys, Quantity, drive_value_keys
from orthocal.printers.settings import DeltaSettings
from orthocal.robot.model import Drive, Robot, drive_keys
from orthocal.units import Unit

KINDS: dict[Unit, str] = {"m": "prismatic", "rad": "revolute"}
"""Kind of a drive by the unit of its coordinate."""


def require_count(
    values: Sequence[object],
    noun: str,
    drives: Sequence[Drive],
    *,
    each: str = "drive",
    remark: str = "",
) -> None:
    """Refuse a list without exactly one item per drive.

    Args:
        values: The list.
        noun: Name of its items in the plural.
        drives: The drives.
        each: Kind of the drives.
        remark: End of the message.

    Raises:
        SessionError: If the numbers of items and drives differ.
    """
    if len(values) != len(drives):
        names = ", ".join(d.name for d in drives)
        raise SessionError(
            f"has {len(values)} {noun}; expected {len(drives)}, one per {each}: {names}{remark}"
        )


def build_offsets(keys: ControllerKeys | None, robot: Robot, where: str) -> Array | None:
    """Active offsets, shape (n_drives,), [m, rad]; None if not stated.

    Args:
        keys: Keys under `controller`; None if absent.
        robot: The robot.
        where: File and key, for messages.

    Raises:
        SessionError: If numbers and drives do not match.
    """
    return None if keys is None else _read_drive_values(keys, "offsets", robot, where)


def build_compensation(
    keys: ControllerKeys | None, robot: Robot, *, folder: Path, where: str
) -> Compensation:
    """What the controller compensates, and home positions of its joints; empty if not stated.

    Args:
        keys: Keys under `controller`; None if absent.
        robot: The robot.
        folder: Directory of the session, to which names of tables are relative.
        where: File and key, for messages.

    Raises:
        SessionError: If numbers or tables and drives do not match, a table is wrong, or home
            positions are stated without the compensation.
    """
    if keys is None:
        return ()
    backlash = _read_drive_values(keys, "backlash", robot, where)
    homes = _read_drive_values(keys, "home_offset", robot, where)
    if backlash is None and keys.comp_file is None:
        if homes is not None:
            stated = drive_keys("backlash", robot.drives)
            raise SessionError(
                "states home_offset without the backlash; for a controller that compensates "
                f"nothing add {stated}",
                where=where,
            )
        return ()
    names = keys.comp_file or [None] * len(robot.drives)
    with errors_at(f"{where}.comp_file"):
        remark = "; null for a drive without a table"
        require_count(names, "names", robot.drives, remark=remark)
        values = np.zeros(len(names)) if backlash is None else backlash
        trims = [
            JointTrim(float(v), None if name is None else read_comp_file(folder, name, drive))
            for v, name, drive in zip(values, names, robot.drives, strict=True)
        ]
    return with_homes(trims, None if homes is None else homes.tolist())


def build_firmware(keys: ControllerKeys | None, robot: Robot, where: str) -> DeltaSettings | None:
    """Settings of the firmware of a delta printer; None if not stated.

    Raises:
        SessionError: If the robot does not have three prismatic drives.
    """
    if keys is None or keys.firmware is None:
        return None
    if [d.unit for d in robot.drives] != ["m"] * 3:
        raise SessionError(
            f"{robot.name} is not a delta printer; expected three prismatic drives",
            where=f"{where}.firmware",
        )
    return keys.firmware.to_settings()


def _read_drive_values(
    keys: ControllerKeys, quantity: Quantity, robot: Robot, where: str
) -> Array | None:
    """Assemble one value per drive from the keys for prismatic and revolute drives.

    Args:
        keys: Keys under `controller`.
        quantity: The quantity.
        robot: The robot.
        where: File and key, for messages.

    Returns:
        Shape (n_drives,), [m, rad]; None if no key is stated.

    Raises:
        SessionError: If numbers and drives do not match.
    """
    stated = keys.stated(quantity)
    if not stated:
        return None
    key_units = drive_value_keys(quantity)
    result = np.zeros(len(robot.drives))
    units: set[str] = set()
    for key in stated:
        values, (unit, factor) = getattr(keys, key), key_units[key]
        indices = [i for i, d in enumerate(robot.drives) if d.unit == unit]
        with errors_at(f"{where}.{key}"):
            if not indices:
                expected = " or ".join(k for k, (u, _) in key_units.items() if u != unit)
                raise SessionError(f"{robot.name} has no {KINDS[unit]} drive; expected {expected}")
            each = "drive" if len(indices) == len(robot.drives) else f"{KINDS[unit]} drive"
            require_count(values, "numbers", [robot.drives[i] for i in indices], each=each)
        result[indices] = np.array(values) * factor
        units.add(unit)
    for drive in robot.drives:
        if drive.unit not in units:
            expected = " or ".join(drive_value_keys(quantity, drive.unit))
            noun = quantity.removesuffix("s").replace("_", " ")
            raise SessionError(
                f"the {noun} of drive {drive.name} is missing; add {expected}", where=where
            )
    return read_only(result)
