"""Postures and controller offsets of a session, checked against its robot."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from orthocal.arrays import Array
from orthocal.effects.compensation import Compensation, JointTrim
from orthocal.errors import ClosureError, SessionError
from orthocal.io.fields import read_only
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.measurement.files.linuxcnc_ini import read_trims
from orthocal.measurement.files.schema import (
    BACKLASH_KEYS,
    OFFSET_KEYS,
    ControllerKeys,
    PostureKeys,
    SessionKeys,
)
from orthocal.printers.settings import DeltaSettings
from orthocal.robot.model import Robot
from orthocal.session.session import Posture, PostureForm
from orthocal.units import DRIVE_UNITS, MM, Unit


def require_given_zero(robot: Robot, where: str) -> None:
    """Refuse a robot without a stated mechanical zero: legs, sections and offsets count from it.

    Args:
        robot: The robot.
        where: File and key that name it, for messages.

    Raises:
        SessionError: With the zeros that were found, which may be adopted.
    """
    zeros = [
        f"{d.name}.zero_{unit} ({d.zero / size:.6g} was found)"
        for d in robot.drives
        for unit, size in [DRIVE_UNITS[d.unit]]
        if d.zero_computed
    ]
    if zeros:
        raise SessionError(
            f"'{robot.name}' cannot be posed with its drives at 0, and its mechanical zero is not "
            f"stated; add to orthocal.drives in {robot.yaml}: {', '.join(zeros)}",
            where=where,
        )


def build_postures(
    keys: SessionKeys, robot: Robot, offsets: Array | None, file: Path
) -> dict[str, Posture]:
    """Postures with their commanded drive coordinates, by the nominal inverse kinematics.

    Args:
        keys: Keys of the session.yaml.
        robot: The robot.
        offsets: Active offsets, shape (n_drives,), [m, rad]; None if not stated.
        file: The session.yaml, for messages.

    Raises:
        SessionError: If a posture has the wrong coordinates, or the machine cannot reach it.
    """
    closure = nominal_closure(robot)
    active = np.zeros(len(robot.drives)) if offsets is None else offsets
    stated = [] if keys.controller is None else keys.controller.stated
    values = {n: _read_posture(p, robot, f"{file}: postures.{n}") for n, p in keys.postures.items()}
    points = {name: point for name, (form, point) in values.items() if form == "tcp"}
    try:
        commanded = {name: v for name, (_, v) in values.items()}
        if points:
            joints = closure.inverse(np.array(list(points.values())), names=list(points))
            commanded |= dict(zip(points, joints, strict=True))
        for name, drives in commanded.items():
            _check_travel(robot, drives, f"postures.{name}: ", file)
            key = f"controller.{' and '.join(stated)}: in posture '{name}' "
            _check_travel(robot, drives - active, key, file)
        closure.close(np.array(list(commanded.values())), names=list(commanded))
    except ClosureError as e:
        raise SessionError(e.reason, where=f"{file}: postures.{e.posture}") from None
    return {
        name: Posture(name, form, read_only(v), read_only(commanded[name] - active))
        for name, (form, v) in values.items()
    }


def _read_posture(keys: PostureKeys, robot: Robot, where: str) -> tuple[PostureForm, Array]:
    """Form and coordinates of a posture, [m, rad]."""
    key, values = keys.stated
    count = len(robot.drives)
    if key == "tcp_mm":
        if robot.tcp is None or len(robot.tcp.coordinates) != count:
            raise SessionError(
                f"{robot.name} cannot be commanded by its tool; give joints", where=where
            )
        if len(values) != count:
            raise SessionError(
                f"has {len(values)} coordinates; expected {count}", where=f"{where}.{key}"
            )
        return "tcp", np.array(values) * MM
    where = f"{where}.{key}"
    if len(values) != count:
        names = ", ".join(d.name for d in robot.drives)
        raise SessionError(
            f"has {len(values)} numbers; expected {count}, one a drive: {names}", where=where
        )
    unit = "m" if key == "joints_mm" else "rad"
    for drive in robot.drives:
        if drive.unit != unit:
            raise SessionError(
                f"drive {drive.name} is in {DRIVE_UNITS[drive.unit][0]}", where=where
            )
    return "joints", np.array(values) * MM if unit == "m" else np.deg2rad(values)


def _check_travel(robot: Robot, drives: Array, key: str, file: Path) -> None:
    """Refuse drive coordinates beyond a drive's travel, in the numbers of the controller."""
    for drive, value in zip(robot.drives, drives, strict=True):
        if not drive.lower - 1e-9 <= value <= drive.upper + 1e-9:
            unit, size = DRIVE_UNITS[drive.unit]
            number, low, high = (v / size for v in (drive.to_joint(value), *drive.joint_limits))
            raise SessionError(
                f"{key}{drive.name} would be at {number:.2f} {unit}; it reaches from {low:g} to "
                f"{high:g} {unit}",
                where=str(file),
            )


def build_offsets(keys: ControllerKeys | None, robot: Robot, where: str) -> Array | None:
    """Offsets that are active in the controller; None where not stated.

    Arguments, result and errors are those of `_read_drive_values`.
    """
    return None if keys is None else _read_drive_values(keys, OFFSET_KEYS, robot, where)


def build_compensation(
    keys: ControllerKeys | None, robot: Robot, *, folder: Path, where: str
) -> Compensation:
    """Backlash and errors of screws that the controller compensates; empty for none.

    Args:
        keys: What the session says, None for nothing.
        robot: The robot.
        folder: Directory of the session, from which names of tables count.
        where: File and key, for messages.

    Raises:
        SessionError: If there are not as many numbers or tables as drives, or a table is wrong.
    """
    if keys is None:
        return ()
    backlash = _read_drive_values(keys, BACKLASH_KEYS, robot, where)
    if backlash is None and keys.comp_file is None:
        return ()
    names = keys.comp_file or [None] * len(robot.drives)
    if len(names) != len(robot.drives):
        drives = ", ".join(d.name for d in robot.drives)
        raise SessionError(
            f"has {len(names)} names; expected {len(robot.drives)}, one a drive ({drives}), with "
            "null for a drive without a table",
            where=f"{where}.comp_file",
        )
    values = np.zeros(len(names)) if backlash is None else backlash
    where = f"{where}.comp_file"
    tables = (
        None if name is None else read_trims(folder, name, drive, where)
        for name, drive in zip(names, robot.drives, strict=True)
    )
    return tuple(JointTrim(float(v), table) for v, table in zip(values, tables, strict=True))


def build_firmware(keys: ControllerKeys | None, robot: Robot, where: str) -> DeltaSettings | None:
    """Settings of the firmware of a delta printer; None where not stated.

    Raises:
        SessionError: If the robot does not have three drives along lines.
    """
    if keys is None or keys.firmware is None:
        return None
    if [d.unit for d in robot.drives] != ["m"] * 3:
        raise SessionError(
            f"{robot.name} is no delta printer; expected a robot with three slides",
            where=f"{where}.firmware",
        )
    return keys.firmware.to_settings()


def _read_drive_values(
    keys: ControllerKeys, kinds: Mapping[str, tuple[Unit, float]], robot: Robot, where: str
) -> Array | None:
    """Numbers for all drives from keys of which each has those of the drives of its kind.

    Args:
        keys: What the session says.
        kinds: Keys with the unit of their drives and the factor to it.
        robot: The robot.
        where: File and key, for messages.

    Returns:
        Shape (n_drives,), [m, rad], or None where none of the keys is stated.

    Raises:
        SessionError: If a drive has no number, or a number no drive.
    """
    stated = [key for key in kinds if getattr(keys, key) is not None]
    if not stated:
        return None
    result = np.zeros(len(robot.drives))
    units: set[str] = set()
    for key in stated:
        values, (unit, factor) = getattr(keys, key), kinds[key]
        drives = [i for i, d in enumerate(robot.drives) if d.unit == unit]
        kind = "prismatic" if unit == "m" else "revolute"
        if not drives:
            fitting = " or ".join(k for k, (u, _) in kinds.items() if u != unit)
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
        result[drives] = np.array(values) * factor
        units.add(unit)
    for drive in robot.drives:
        if drive.unit not in units:
            expected = " or ".join(k for k, (unit, _) in kinds.items() if unit == drive.unit)
            what = stated[0].partition("_")[0].removesuffix("s")
            raise SessionError(
                f"states no {what} of {drive.name}; expected {expected}, too", where=where
            )
    return read_only(result)
