"""Words of a sheet: joints, gauges and what is active in the controller."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orthocal.measurement.motion.motion import shown_joints
from orthocal.robot.model import Robot
from orthocal.session.session import Session
from orthocal.units import DRIVE_UNITS, MM

Array = NDArray[np.float64]


def gauge_words(session: Session) -> str:
    """What the gauges are."""
    words = []
    for name, gauge in session.gauges.items():
        parts = [name] if name else []
        if gauge.range is not None:
            low, high = (number(v / MM, 3).rstrip("0").rstrip(".") for v in gauge.range)
            parts.append(f"{low} … {high} mm")
        if gauge.resolution is not None:
            parts.append(f"to be read to {gauge.resolution / MM:g} mm")
        words.append(" ".join(parts) or "any dial")
    return "; ".join(words)


def active_words(session: Session) -> str:
    """What is active in the controller."""
    if session.controller_offsets is None:
        key = "offsets_mm" if all(d.unit == "m" for d in session.robot.drives) else "offsets_deg"
        zeros = ", ".join("0" for _ in session.robot.drives)
        return (
            "session.yaml does not say which offsets are active in the controller: write "
            f"controller: {{{key}: [{zeros}]}} there, with what is entered now."
        )
    active = ", ".join(
        f"{d.name} {v / DRIVE_UNITS[d.unit][1]:g} {DRIVE_UNITS[d.unit][0]}"
        for d, v in zip(session.robot.drives, session.active_offsets, strict=True)
    )
    return (
        f"Offsets that are active in the controller while measuring: {active}, as session.yaml "
        "says. Enter no others until all is read."
    )


def counting_words(robot: Robot) -> str:
    """How joints count, in words."""
    words = {1: "grow", -1: "fall"}
    if len({d.direction for d in robot.drives}) == 1:
        return f"{words[robot.drives[0].direction]}, of each"
    return ", ".join(f"{words[d.direction]} for {d.name}" for d in robot.drives)


def approach_words(robot: Robot, side: int) -> str:
    """Which way the last move of each drive goes, by what its joint shows."""
    ways = ["larger" if -side * d.direction > 0 else "smaller" for d in robot.drives]
    if len(set(ways)) == 1:
        return f"{ways[0]} numbers of all joints"
    return ", ".join(
        f"{way} numbers of {d.name}" for way, d in zip(ways, robot.drives, strict=True)
    )


def limit_words(robot: Robot) -> list[str]:
    """From where to where joints may go."""
    found = []
    for drive in robot.drives:
        unit, size = DRIVE_UNITS[drive.unit]
        low, high = (v / size for v in drive.joint_limits)
        if np.isfinite([low, high]).all():
            found.append(f"{drive.name} {number(low, 1)} to {number(high, 1)} {unit}")
    return found or ["anywhere"]


def joint_list(robot: Robot, drives: Array) -> str:
    """Every drive with what its joint shows."""
    return ", ".join(
        f"{d.name} {text} {DRIVE_UNITS[d.unit][0]}"
        for d, text in zip(robot.drives, joint_numbers(robot, drives), strict=True)
    )


def joint_numbers(robot: Robot, drives: Array) -> list[str]:
    """What the controller's joints show."""
    return [
        number(float(v) / DRIVE_UNITS[d.unit][1], 3)
        for d, v in zip(robot.drives, shown_joints(robot, drives), strict=True)
    ]


def number(value: float, decimals: int, *, sign: bool = False) -> str:
    """A number with as many decimals, and a minus that is seen."""
    text = f"{round(value, decimals) + 0.0:{'+' if sign else ''}.{decimals}f}"
    return text.replace("-", "−")
