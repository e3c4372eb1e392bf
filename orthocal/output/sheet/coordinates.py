"""Coordinates and other numbers on a sheet."""

from __future__ import annotations

from orthocal.arrays import Array
from orthocal.measurement.motion.guidance import shown_joints
from orthocal.output.text.layout import true_minus
from orthocal.robot.model import Robot, name_coordinates
from orthocal.session.session import Session
from orthocal.units import DRIVE_UNITS, MM, format_fixed


def shown_place(session: Session, drives: Array) -> str:
    """Place of a posture as the controller displays it: its joints, or the nozzle of a printer."""
    if session.firmware is None:
        return joint_list(session.robot, drives)
    nozzle = session.firmware.forward(drives)[0]
    return " ".join(f"{letter}{show_length(v)}" for letter, v in zip("XYZ", nozzle, strict=True))


def joint_list(robot: Robot, drives: Array) -> str:
    """Every joint with its number in the controller."""
    return ", ".join(name_coordinates(robot.drives, shown_joints(robot, drives), show_number))


def joint_values(robot: Robot, drives: Array) -> list[str]:
    """Numbers that the controller shows for its joints."""
    return [
        show_number(float(v) / DRIVE_UNITS[d.unit][1])
        for d, v in zip(robot.drives, shown_joints(robot, drives), strict=True)
    ]


def show_number(value: float, decimals: int = 3, *, sign: bool = False) -> str:
    """A number with a true minus and no negative zero."""
    return true_minus(format_fixed(value, decimals, sign=sign))


def show_length(value: float) -> str:
    """A length in mm without trailing zeros."""
    return show_number(value / MM, 3).rstrip("0").rstrip(".")
