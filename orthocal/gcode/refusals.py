"""Words of a program that cannot be corrected, and why."""

from __future__ import annotations

from typing import NoReturn

from orthocal.errors import GcodeError
from orthocal.gcode.words import Word

STRAIGHT = "write the motion as lines and arcs (G0 to G3)"
CYCLE = "is a canned cycle, whose motions the controller makes"
PROBE = "is a probing move, which ends where nobody knows"
COMPENSATION = "is cutter compensation, which the controller makes of uncorrected paths"
LENGTH = "is a tool length, which moves the tool off where the machine is calibrated"
STORED = "goes by way of a place that the controller has stored"
SPLINE = "is a spline"
THREAD = "is a motion that the spindle leads"
SHIFTED = "moves the program's zero"

REASONS: dict[str, tuple[str, str]] = {
    "G5": (SPLINE, STRAIGHT),
    "G5.1": (SPLINE, STRAIGHT),
    "G5.2": (SPLINE, STRAIGHT),
    "G5.3": (SPLINE, STRAIGHT),
    "G7": ("is diameter mode", "expected G8"),
    "G10": ("sets values of the controller", "set them before the program"),
    "G15": ("is about polar coordinates", "write X, Y and Z"),
    "G16": ("is about polar coordinates", "write X, Y and Z"),
    "G28": (STORED, "write where it is to go"),
    "G28.1": (STORED, "write where it is to go"),
    "G30": (STORED, "write where it is to go"),
    "G30.1": (STORED, "write where it is to go"),
    "G33": (THREAD, STRAIGHT),
    "G33.1": (THREAD, STRAIGHT),
    "G38.2": (PROBE, "leave it out"),
    "G38.3": (PROBE, "leave it out"),
    "G38.4": (PROBE, "leave it out"),
    "G38.5": (PROBE, "leave it out"),
    "G41": (COMPENSATION, "have the CAM write the path of the tool's centre"),
    "G41.1": (COMPENSATION, "have the CAM write the path of the tool's centre"),
    "G42": (COMPENSATION, "have the CAM write the path of the tool's centre"),
    "G42.1": (COMPENSATION, "have the CAM write the path of the tool's centre"),
    "G43": (LENGTH, "have the CAM write the path of the tool centre point"),
    "G43.1": (LENGTH, "have the CAM write the path of the tool centre point"),
    "G43.2": (LENGTH, "have the CAM write the path of the tool centre point"),
    "G53": ("is a motion in other coordinates", "write it in those of the program"),
    "G73": (CYCLE, STRAIGHT),
    "G76": (CYCLE, STRAIGHT),
    **{f"G{k}": (CYCLE, STRAIGHT) for k in range(81, 90)},
    "G92": (SHIFTED, "leave it out, and say where the zero is with --work-offset-mm"),
    "G92.2": (SHIFTED, "leave it out, and say where the zero is with --work-offset-mm"),
    "G92.3": (SHIFTED, "leave it out, and say where the zero is with --work-offset-mm"),
    "G93": ("is inverse time feed", "expected G94"),
    "G95": ("is feed a revolution", "expected G94"),
    "G96": ("is a spindle speed that follows X", "expected G97"),
    "M61": ("changes the tool that the controller thinks of", "leave it out"),
    "M66": ("waits for an input", "leave it out"),
    "M98": ("calls a subroutine", "write its lines out"),
    "M99": ("ends a subroutine", "write its lines out"),
}
"""A word to why it cannot be corrected, and what is expected."""

LETTERS: dict[str, tuple[str, str]] = {
    **dict.fromkeys("ABC", ("a rotary axis", "expected {axes}")),
    **dict.fromkeys("UVW", ("a further axis", "expected {axes}")),
    **dict.fromkeys("XYZ", ("an axis that the drives do not command", "expected {axes}")),
    "D": ("a tool's radius", "leave it out"),
    "H": ("a tool's length", "leave it out"),
    "O": ("subroutines and loops", "write their lines out"),
    "L": ("repetitions", "write them out"),
    "E": ("a word of splines", "write the motion as lines and arcs (G0 to G3)"),
}


def refuse_code(word: Word, where: str) -> NoReturn:
    """Raise for a G or M word that is not corrected.

    Raises:
        GcodeError: Always.
    """
    reason = REASONS.get(word.code)
    if reason is None:
        raise GcodeError(
            f"found {word.code}, which is not known here; expected G0 to G3 and words that leave "
            "coordinates as they are",
            where=where,
        )
    raise GcodeError(f"found {word.code}, which {reason[0]}; {reason[1]}", where=where)


def refuse_letter(word: Word, where: str, *, axes: str) -> NoReturn:
    """Raise for a word of another letter than those that are known.

    Raises:
        GcodeError: Always.
    """
    reason = LETTERS.get(word.letter, ("a word that is not known here", "leave it out"))
    raise GcodeError(
        f"found {word.text.strip()}, {reason[0]}; {reason[1].format(axes=axes)}", where=where
    )
