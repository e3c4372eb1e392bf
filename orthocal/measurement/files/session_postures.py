"""Postures of a session, checked against its robot."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import ClosureError, SessionError, UnreachablePostureError, errors_at
from orthocal.io.fields import read_only
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.measurement.files.session_controller import KINDS, require_count
from orthocal.measurement.files.session_keys import PostureKeys, SessionKeys
from orthocal.robot.model import Drive, Robot
from orthocal.robot.redundant import require_independent_rows
from orthocal.session.session import Posture, PostureForm
from orthocal.units import DRIVE_UNITS, MM


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
