"""Dimensions of a machine, from options or from answers at a terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from orthocal.builder.machine_file import (
    AS_DRIVE,
    Counting,
    Dimensions,
    find_counting_problem,
    in_mm,
)
from orthocal.cli.options import read_number
from orthocal.cli.printing import put_note
from orthocal.errors import ParameterError
from orthocal.units import MM

if TYPE_CHECKING:
    from orthocal.cli.options import Array

AXES = "xyz"

Answer = TypeVar("Answer")

LARGEST_OFFSET = 100.0
"""Largest tolerance of the home switches, [mm]."""

QUESTIONS = {
    "--leg-mm": "Leg length, from hinge to hinge of a rod, mm",
    "--travel-mm": "Lowest and highest coordinate of a slide, LEAST:LARGEST, mm. It is {leg} (the "
    "leg) where the legs are parallel to their axes, and grows outwards",
    "--attachment-mm": "Distance from the tool centre point to the hinges on the platform, mm",
    "--rods-apart-mm": "Distance between the two rods of a leg, from axis to axis, mm",
    "--rod-radius-mm": "Radius of a rod, mm",
    "--counts": "Does the number of a joint go up or down as its slide moves outwards? up or "
    "down, for all or as x,y,z",
    "--at-zero-mm": "What does the controller show where the legs are parallel to their axes, mm? "
    "One number for all, or x,y,z",
}
"""Options and the questions at the terminal that replace them; {leg} is the leg length in mm."""


COUNTING = ("--counts", "--at-zero-mm")
"""Options about the joints of the controller."""


class Answers(NamedTuple):
    """Answers so far; the usual values in place of other ones."""

    dimensions: Dimensions = Dimensions()
    counting: tuple[Counting, ...] = (AS_DRIVE,) * len(AXES)


def find_answers(options: Mapping[str, str | None]) -> Answers:
    """Dimensions of a machine and how its joints count; missing ones are asked for at a terminal.

    Args:
        options: Each option of `QUESTIONS` to its value; None where it is missing.

    Raises:
        ParameterError: If an option is invalid, contradicts the others, or is missing without a
            terminal.
    """
    missing = [option for option in QUESTIONS if options[option] is None]
    if missing and not (sys.stdin is not None and sys.stdin.isatty()):
        for option, text in options.items():
            if text and option in COUNTING:
                _read_counting(Answers().counting, option, text)
            elif text:
                _read_lengths(option, text)
        raise ParameterError(
            f"missing options: {', '.join(missing)}; without a terminal every dimension must be an "
            "option"
        )
    answers = Answers()
    for option, question in QUESTIONS.items():
        text, add = options[option], partial(_add, answers, option)
        words = question.format(leg=in_mm(answers.dimensions.leg))
        answers = _ask_until_valid(words, option, add) if text is None else add(text)
    return answers


def _add(answers: Answers, option: str, text: str) -> Answers:
    """Answers with one more.

    Raises:
        ParameterError: If the answer is missing or invalid, or contradicts earlier ones.
    """
    if not text:
        raise ParameterError("found nothing; expected an answer", where=option)
    if option in COUNTING:
        return answers._replace(counting=_read_counting(answers.counting, option, text))
    name = option.strip("-").removesuffix("-mm").replace("-", "_")
    dimensions = replace(answers.dimensions, **_read_lengths(option, text))
    problem = dimensions.find_problem()
    if problem and problem[0] == name:  # dimensions after it have no answers yet
        in_metres = name == "leg" and 0.0 < dimensions.leg < 0.005
        raise ParameterError(problem[1] + (": mm, not m" if in_metres else ""), where=option)
    return answers._replace(dimensions=dimensions)


def _read_lengths(option: str, text: str) -> dict[str, Any]:
    """Fields of `Dimensions` of an option, [m].

    Raises:
        ParameterError: If the option is malformed.
    """
    if option != "--travel-mm":
        return {option.strip("-").removesuffix("-mm").replace("-", "_"): _length(text, option)}
    low, colon, high = text.partition(":")
    if not colon:
        raise ParameterError(
            f"found '{text}'; expected LEAST:LARGEST, in mm, such as 100:320", where=option
        )
    return {"lower": _length(low, option), "upper": _length(high, option)}


def _read_counting(counting: tuple[Counting, ...], option: str, text: str) -> tuple[Counting, ...]:
    """Joints with an answer for all, or one for each of x, y, z.

    Raises:
        ParameterError: If the answer is invalid.
    """
    parts = [part.strip() for part in text.split(",")]
    if len(parts) not in (1, len(AXES)):
        raise ParameterError(
            f"has {len(parts)} parts; expected one for all, or three: x,y,z", where=option
        )
    joints = list(zip(counting, parts * (len(AXES) // len(parts)), strict=True))
    if option == "--at-zero-mm":
        counting = tuple(replace(joint, at_zero=_length(part, option)) for joint, part in joints)
        problem = find_counting_problem(counting)
        if problem:
            raise ParameterError(problem, where=option)
        return counting
    for word in parts:
        if word.lower() not in ("up", "down"):
            raise ParameterError(f"found '{word.lower()}'; expected up or down", where=option)
    return tuple(replace(joint, up=word.lower() == "up") for joint, word in joints)


def _length(text: str, option: str) -> float:
    return read_number(text, option) * MM


def ask_tolerance(usual: float) -> list[str]:
    """Tolerance of the drives' offsets, as values of --tolerance.

    Args:
        usual: The usual one, [mm].

    Raises:
        ParameterError: If the input ends.
    """

    def read(text: str) -> list[str]:
        size = _length(text or f"{usual:g}", "--tolerance") / MM
        if not 0.0 < size <= LARGEST_OFFSET:
            raise ParameterError(
                f"found {size:g} mm; expected more than 0, and at most {LARGEST_OFFSET:g} mm"
            )
        return [f"*.offset_mm={size:g}"]

    return _ask_until_valid(
        "By how much may the zeros of the joints be off, ± limit in mm? Enter alone: "
        f"{usual:g}, usual for home switches that were never measured",
        "--tolerance",
        read,
    )


def ask_workspace(usual: str, read: Callable[[str], Array]) -> Array | None:
    """Workspace of a machine; None for the usual one.

    Args:
        usual: The usual one in words.
        read: Box of a text; raises ParameterError for an invalid one.

    Raises:
        ParameterError: If the input ends.
    """
    return _ask_until_valid(
        "Workspace around the mechanical zero, mm: half side of a cube, such as 80, or ranges of "
        f"x,y,z, such as -80:80,-80:80,-100:60. Enter alone: {usual}",
        "--workspace-mm",
        lambda text: read(text) if text else None,
    )


def _ask_until_valid(question: str, option: str, read: Callable[[str], Answer]) -> Answer:
    """Ask until there is a valid answer.

    Raises:
        ParameterError: If the input ends.
    """
    while True:
        sys.stderr.write(f"{question}: ")
        sys.stderr.flush()
        text = sys.stdin.readline()
        if not text:
            put_note("")
            raise ParameterError("was not answered: the input ended", where=option)
        try:
            return read(text.strip())
        except ParameterError as e:
            put_note(f"  {e.problem}")
