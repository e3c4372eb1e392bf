"""G-code of the way through a setup: a pause (M0) at each reading.

Tool coordinates in mm, as nominal kinematics command them; what the joints show stands in comments.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import ParameterError
from orthocal.kinematics.workspace import tool_at_zero
from orthocal.measurement.motion.motion import SetupMotion, Stop, shown_joints
from orthocal.robot.model import Robot
from orthocal.session.session import Session
from orthocal.units import DRIVE_UNITS, MM

Array = NDArray[np.float64]

LETTERS = "XYZ"

LONGEST_NAME = 40
"""Characters of a name in a comment: controllers read lines of 80 to 256."""

FASTEST = 20_000.0
"""[mm/min]"""

FURTHEST = 1e5
"""No work offset is larger, [mm]."""

_STRANGE = re.compile(r"[^A-Za-z0-9 _.,:;=+\-/*]")
"""What controllers take for something else in a comment, or cannot show."""


@dataclass(frozen=True, slots=True)
class ProgramOptions:
    """How programs are written."""

    feed: float = 600.0
    """From posture to posture, [mm/min]."""
    approach_feed: float = 120.0
    """On the last millimetres, [mm/min]."""
    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What the program's coordinates have more than the world's, [mm]."""

    def require_sane(self) -> None:
        """Refuse feeds and shifts that nobody means.

        Raises:
            ParameterError: Naming the option.
        """
        for name, feed in (("--feed", self.feed), ("--approach-feed", self.approach_feed)):
            if not 1.0 <= feed <= FASTEST:
                raise ParameterError(
                    f"found {feed:g}; expected 1 to {FASTEST:g} mm/min", where=name
                )
        if not all(abs(v) <= FURTHEST for v in self.shift_mm):
            raise ParameterError(f"expected numbers within ±{FURTHEST:g} mm", where="--shift-mm")


def program_name(motion: SetupMotion) -> str:
    """Name of a setup's program: its number, for the order, and what its name has of plain text."""
    plain = re.sub(r"[^A-Za-z0-9_-]", "_", motion.setup)[:LONGEST_NAME]
    return f"{motion.number:02d}-{plain}.ngc"


def write_program(
    session: Session, motion: SetupMotion, options: ProgramOptions | None = None
) -> str:
    """The program of a setup.

    Raises:
        ParameterError: If a feed or a shift is nothing that can be meant, or the drives command no
            tool.
    """
    options = options or ProgramOptions()
    options.require_sane()
    robot = session.robot
    if robot.tcp is None or any(s.point is None for s in motion.stops):
        raise ParameterError(
            "the drives do not command the tool: there are no coordinates for a program",
            where=str(robot.yaml),
        )
    first = motion.stops[0]
    shift = ", ".join(f"{v:g}" for v in options.shift_mm)
    lines = [
        f"(orthocal: {robot_name(robot)}, setup {plain(motion.setup)}, {motion.number} of "
        f"{motion.count})",
        f"({plain(session.setups[motion.setup].sensor.describe(), 120)})",
        f"(Coordinates: nominal kinematics, world + {shift} mm; no tool length)",
        "(Start in the mechanical zero, with nothing at the rods)",
        "G21 G90 G94 G40 G49",
        f"F{options.feed:g}",
    ]
    for i, stop in enumerate(motion.stops):
        after = motion.stops[i + 1] if i + 1 < len(motion.stops) else None
        lines += [f"(to {_label(stop)})", *_moves(robot, stop, options)]
        lines += [f"(MSG, {text})" for text in _messages(robot, stop, after, first is stop)]
        if stop.role != "return":
            lines.append("M0")
    return "\n".join([*lines, "M2", ""])


def _moves(robot: Robot, stop: Stop, options: ProgramOptions) -> list[str]:
    """To a little before a posture, and into it."""
    places: list[tuple[Array | None, float]] = []
    if stop.over_zero:
        places.append((tool_at_zero(robot), options.feed))
    places += [(stop.approach_point, options.feed), (stop.point, options.approach_feed)]
    return [f"G1 {_words(robot, point, options)} F{feed:g}" for point, feed in places]


def _words(robot: Robot, point: Array | None, options: ProgramOptions) -> str:
    coordinates = () if robot.tcp is None else robot.tcp.coordinates
    values = np.asarray(point) / MM
    return " ".join(
        f"{LETTERS[c]}{round(v + options.shift_mm[c], 4) + 0.0:.4f}"
        for c, v in zip(coordinates, values, strict=True)
    )


def _messages(robot: Robot, stop: Stop, after: Stop | None, first: bool) -> list[str]:
    """What is to be done at a stop, and on the way to the next."""
    what = {
        "reading": "read",
        "taken off": "set the dial to 0",
        "return": "back at the first: does the dial show what it did",
    }[stop.role]
    if first:
        what = f"stand the gauge, set its zero, then {what}"
    texts = [f"{_label(stop)}; joints {joint_words(robot, stop.drives)}; {what}"]
    if after is not None and after.lift:
        texts.append(f"hold the plunger up on the way to {_label(after)}")
    return texts


def _label(stop: Stop) -> str:
    if stop.line is None:
        return f"posture {plain(stop.posture)}"
    return f"line {stop.line}: {plain(stop.posture)}"


def joint_words(robot: Robot, drives: Array) -> str:
    """What the controller's joints show, in mm or degrees with four decimals."""
    shown = shown_joints(robot, drives)
    return " ".join(
        f"{round(float(v) / DRIVE_UNITS[d.unit][1], 4) + 0.0:.4f}"
        for d, v in zip(robot.drives, shown, strict=True)
    )


def robot_name(robot: Robot) -> str:
    """A robot's name, as it can stand in a comment."""
    return plain(robot.name)


def plain(text: str, longest: int = LONGEST_NAME) -> str:
    """A text as it can stand in a comment of any controller."""
    return _STRANGE.sub("_", text)[:longest]
