"""Drives of a session, checked against its robot: offsets, compensation, firmware and postures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from orthocal.arrays import Array
from orthocal.effects.compensation import Compensation, JointTrim, with_homes
from orthocal.errors import ClosureError, SessionError, UnreachablePostureError, errors_at
from orthocal.io.fields import read_only
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.measurement.files.linuxcnc_ini import read_comp_file
from orthocal.measurement.files.session_keys import (
    ControllerKeys,
    PostureKeys,
    Quantity,
    SessionKeys,
    drive_value_keys,
)
from orthocal.printers.settings import DeltaSettings
from orthocal.robot.model import Drive, Robot, drive_keys
from orthocal.robot.redundant import require_independent_rows
from orthocal.session.session import Posture, PostureForm
from orthocal.units import DRIVE_UNITS, MM, Unit

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


def build_compensation(
    keys: ControllerKeys, robot: Robot, *, folder: Path, where: str
) -> Compensation:
    """Compensation by the controller, with the home positions of its joints; empty if not stated.

    Args:
        keys: Keys under `controller`.
        robot: The robot.
        folder: Directory of the session, to which names of tables are relative.
        where: File and key, for messages.

    Raises:
        SessionError: If numbers or tables and drives do not match, a table is wrong, or home
            positions are stated without the compensation.
    """
    backlash = read_drive_values(keys, "backlash", robot, where)
    homes = read_drive_values(keys, "home_offset", robot, where)
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


def build_firmware(keys: ControllerKeys, robot: Robot, where: str) -> DeltaSettings | None:
    """Settings of the firmware of a delta printer; None if not stated.

    Raises:
        SessionError: If the robot does not have three prismatic drives.
    """
    if keys.firmware is None:
        return None
    if [d.unit for d in robot.drives] != ["m"] * 3:
        raise SessionError(
            f"{robot.name} is not a delta printer; expected three prismatic drives",
            where=f"{where}.firmware",
        )
    return keys.firmware.to_settings()


def read_drive_values(
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


def require_mechanical_zero(robot: Robot, where: str) -> None:
    """Refuse a robot whose mechanical zero was computed instead of stated.

    Legs, sections and offsets refer to the mechanical zero.

    Args:
        robot: The robot.
        where: File and key that name it, for messages.

    Raises:
        SessionError: If the zero is not stated; lists the computed zeros, ready to copy.
    """
    zeros = [_state_zero(drive) for drive in robot.drives if drive.zero_computed]
    if zeros:
        raise SessionError(
            f"the mechanical zero of '{robot.name}' is not stated, and its loops do not close with "
            f"the drives at 0; add to orthocal.drives in {robot.yaml}: {', '.join(zeros)}",
            where=where,
        )


def _state_zero(drive: Drive) -> str:
    """Key and value of the mechanical zero of a drive."""
    return f"{drive.name}.zero_{drive.joint_unit}: {drive.zero / drive.joint_size:.6g}"


def build_postures(
    keys: SessionKeys, robot: Robot, offsets: Array | None, file: Path
) -> dict[str, Posture]:
    """Postures with their drive coordinates, by the nominal inverse kinematics.

    Args:
        keys: Keys of the session.yaml.
        robot: The robot.
        offsets: Active offsets, shape (n_drives,), [m, rad]; None if not stated.
        file: The session.yaml, for messages.

    Raises:
        SessionError: If a posture has the wrong coordinates, or the machine cannot reach it.
        RobotError: If the closures of the robot leave motions free, or depend on each other.
    """
    require_independent_rows(robot)
    closure = nominal_closure(robot)
    active = np.zeros(len(robot.drives)) if offsets is None else offsets
    offset_keys = [] if keys.controller is None else keys.controller.stated("offsets")
    stated = {n: _read_posture(p, robot, f"{file}: postures.{n}") for n, p in keys.postures.items()}
    points = {name: values for name, (form, values) in stated.items() if form == "tcp"}
    try:
        commanded = {name: values for name, (_, values) in stated.items()}
        if points:
            joints = closure.inverse(np.array(list(points.values())), names=list(points))
            commanded |= dict(zip(points, joints, strict=True))
        for name, drives in commanded.items():
            _check_travel(robot, drives, where=f"{file}: postures.{name}")
            # the controller subtracts the active offsets: its encoders are at commanded − active
            where = f"{file}: controller.{' and '.join(offset_keys)}"
            _check_travel(robot, drives - active, where=where, posture=name)
        closure.close(np.array(list(commanded.values())), names=list(commanded))
    except ClosureError as e:
        raise UnreachablePostureError(e.reason, where=f"{file}: postures.{e.posture}") from None
    return {
        name: Posture(name, form, read_only(values), read_only(commanded[name] - active))
        for name, (form, values) in stated.items()
    }


def _read_posture(keys: PostureKeys, robot: Robot, where: str) -> tuple[PostureForm, Array]:
    """Form and coordinates of a posture, shape (n_drives,), [m, rad]."""
    key, values = keys.stated
    count = len(robot.drives)
    if key == "tcp_mm" and not robot.commands_tool:
        raise SessionError(
            f"{robot.name} has no tool coordinate for every drive; use {_usable_key(robot)}",
            where=where,
        )
    with errors_at(f"{where}.{key}"):
        if key == "tcp_mm":
            if len(values) != count:
                raise SessionError(f"has {len(values)} coordinates; expected {count}")
            return "tcp", np.array(values) * MM
        require_count(values, "numbers", robot.drives)
        unit = "m" if key == "joints_mm" else "rad"
        for drive in robot.drives:
            if drive.unit != unit:
                usable = _usable_key(robot)
                raise SessionError(f"drive {drive.name} is {KINDS[drive.unit]}; use {usable}")
    return "joints", np.array(values) * MM if unit == "m" else np.deg2rad(values)


def _usable_key(robot: Robot) -> str:
    """Key with which a posture of a robot can be stated, and what the robot's YAML lacks for it."""
    units = {d.unit for d in robot.drives}
    if len(units) == 1:
        return f"joints_{DRIVE_UNITS[units.pop()][0]}"
    if robot.commands_tool:
        return "tcp_mm"
    return (
        "tcp_mm, because the drives are of both kinds, and state one tool coordinate for each "
        f"drive in {robot.yaml}: orthocal.tcp.coordinates"
    )


def _check_travel(robot: Robot, drives: Array, *, where: str, posture: str | None = None) -> None:
    """Refuse drive coordinates beyond a drive's travel.

    Args:
        robot: The robot.
        drives: Drive coordinates, shape (n_drives,), [m, rad].
        where: File and key, for messages.
        posture: Name of the posture, if the key does not contain it.

    Raises:
        UnreachablePostureError: If a drive does not reach its coordinate; the message has the joint
            coordinates of the controller.
    """
    prefix = "" if posture is None else f"in posture '{posture}' "
    for drive, value in zip(robot.drives, drives, strict=True):
        if drive.is_beyond(value):
            low, high = drive.joint_limits
            raise UnreachablePostureError(
                f"{prefix}{drive.name} would be at {drive.show(float(drive.to_joint(value)))}; it "
                f"reaches from {low / drive.joint_size:g} to {drive.show(high, 'g')}",
                where=where,
            )
