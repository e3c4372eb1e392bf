"""Dimensions of a machine, from options or from answers at a terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

from orthocal.cli.printing import put_note
from orthocal.errors import ParameterError
from orthocal.io.documents import parse_number
from orthocal.robot.builder.machine_file import Counting, Dimensions, find_counting_problem, in_mm
from orthocal.units import MM

AXES = "xyz"

Box = tuple[tuple[float, float], ...]
Answer = TypeVar("Answer")

USUAL_OFFSET = "2"
"""Tolerance of the home switches that is proposed, [mm]."""

MOST_OFFSET = 50.0
"""[mm]"""


@dataclass(frozen=True, slots=True)
class Answers:
    """Answers so far; dimensions without an answer have values that cause no error message."""

    dimensions: Dimensions
    counting: tuple[Counting, Counting, Counting]


@dataclass(frozen=True, slots=True)
class Question:
    """Question about a machine, with the option that answers it."""

    option: str
    words: Callable[[Answers], str]
    """Text at the terminal."""
    answer: Callable[[Answers, str, str], Answers]
    """Answers so far, the new text and the option's name, to the answers with it."""
    field: str
    """Name of the dimension, as in `Dimensions.find_problem`."""


def _number(text: str, option: str) -> float:
    return parse_number(text.strip(), where=option, name="it", error=ParameterError) * MM


def _leg(known: Answers, text: str, option: str) -> Answers:
    leg = _number(text, option)
    proportional = Dimensions(
        leg=leg,
        lower=0.9 * leg,
        upper=1.1 * leg,
        attachment=0.0,
        rods_apart=0.3 * leg,
        rod_radius=0.01 * leg,
    )
    return replace(known, dimensions=proportional)


def _travel(known: Answers, text: str, option: str) -> Answers:
    low, colon, high = text.partition(":")
    if not colon:
        raise ParameterError(
            f"found '{text}'; expected LEAST:LARGEST, in mm, such as 100:320", where=option
        )
    ends: dict[str, Any] = {"lower": _number(low, option), "upper": _number(high, option)}
    return replace(known, dimensions=replace(known.dimensions, **ends))


def _size(name: str) -> Callable[[Answers, str, str], Answers]:
    def answer(known: Answers, text: str, option: str) -> Answers:
        change: dict[str, Any] = {name: _number(text, option)}
        return replace(known, dimensions=replace(known.dimensions, **change))

    return answer


def _rods_apart(known: Answers, text: str, option: str) -> Answers:
    apart = _number(text, option)
    thin = (
        min(known.dimensions.rod_radius, 0.4 * apart)
        if apart > 0.0
        else known.dimensions.rod_radius
    )
    return replace(known, dimensions=replace(known.dimensions, rods_apart=apart, rod_radius=thin))


def _each(text: str, option: str) -> list[str]:
    """Parts of an answer: one for all of x, y, z, or one for each."""
    parts = [part.strip() for part in text.split(",")]
    if len(parts) == 1:
        return parts * len(AXES)
    if len(parts) != len(AXES):
        raise ParameterError(
            f"has {len(parts)} parts; expected one for all, or three: x,y,z", where=option
        )
    return parts


def _counts(known: Answers, text: str, option: str) -> Answers:
    words = [word.lower() for word in _each(text, option)]
    for word in words:
        if word not in ("up", "down"):
            raise ParameterError(f"found '{word}'; expected up or down", where=option)
    x, y, z = (
        replace(joint, up=word == "up") for joint, word in zip(known.counting, words, strict=True)
    )
    return replace(known, counting=(x, y, z))


def _at_zero(known: Answers, text: str, option: str) -> Answers:
    x, y, z = (
        replace(joint, at_zero=_number(part, option))
        for joint, part in zip(known.counting, _each(text, option), strict=True)
    )
    problem = find_counting_problem((x, y, z))
    if problem:
        raise ParameterError(problem, where=option)
    return replace(known, counting=(x, y, z))


QUESTIONS = (
    Question("--leg-mm", lambda _: "Leg length, from hinge to hinge of a rod, mm", _leg, "leg"),
    Question(
        "--travel-mm",
        lambda known: (
            "Travel of a slider, LEAST:LARGEST, mm. Count "
            f"{in_mm(known.dimensions.leg)} (the leg) where the legs are parallel to their axes, "
            "and more further out"
        ),
        _travel,
        "travel",
    ),
    Question(
        "--attachment-mm",
        lambda _: "Attachment offset, from slider to hinge and from hinge to tool, mm",
        _size("attachment"),
        "attachment",
    ),
    Question(
        "--rods-apart-mm",
        lambda _: "Distance of the two rods of a leg, from axis to axis, mm",
        _rods_apart,
        "rods_apart",
    ),
    Question("--rod-radius-mm", lambda _: "Radius of a rod, mm", _size("rod_radius"), "rod_radius"),
    Question(
        "--counts",
        lambda _: (
            "Does the number of a joint go up or down as its slider moves outwards? up or down, "
            "for all or as x,y,z"
        ),
        _counts,
        "",
    ),
    Question(
        "--at-zero-mm",
        lambda _: (
            "What does the controller show where the legs are parallel to their axes, mm? One "
            "number for all, or x,y,z"
        ),
        _at_zero,
        "",
    ),
)

NO_ANSWERS = Answers(Dimensions(), (Counting(), Counting(), Counting()))


def find_answers(given: Mapping[str, str | None]) -> Answers:
    """Dimensions of a machine from its options; missing ones are asked for at a terminal.

    Args:
        given: Option to its value; None where it is missing.

    Raises:
        ParameterError: If an option is invalid, contradicts the others, or is missing without a
            terminal.
    """
    asked = sys.stdin is not None and sys.stdin.isatty()
    missing = [q.option for q in QUESTIONS if given.get(q.option) is None]
    if missing and not asked:
        raise ParameterError(
            f"{'are' if len(missing) > 1 else 'is'} missing; without a terminal every dimension "
            "must be an option",
            where=", ".join(missing),
        )
    known = NO_ANSWERS
    for question in QUESTIONS:
        text = given.get(question.option)
        if text is None:
            known = _ask_until_valid(
                question.words(known), question.option, partial(_require, question, known)
            )
        else:
            known = _add(question, known, text)
    return known


def _require(question: Question, known: Answers, text: str) -> Answers:
    if not text:
        raise ParameterError("found nothing; expected an answer")
    return _add(question, known, text)


def ask_tolerance() -> list[str]:
    """Tolerance of the drives' offsets, as values of --tolerance.

    Raises:
        ParameterError: If the input ends.
    """

    def read(text: str) -> list[str]:
        size = _number(text, "--tolerance") / MM
        if not 0.0 < size <= MOST_OFFSET:
            raise ParameterError(
                f"found {size:g} mm; expected more than 0, and at most {MOST_OFFSET:g} mm"
            )
        return [f"*.offset_mm={size:g}"]

    return _ask_until_valid(
        "How far may the zeros of the joints be off, one standard deviation, mm? Enter alone: "
        f"{USUAL_OFFSET}, usual for home switches that were never measured",
        "--tolerance",
        lambda text: read(text or USUAL_OFFSET),
    )


def ask_workspace(usual: str, read: Callable[[str], Box]) -> Box | None:
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


def _add(question: Question, known: Answers, text: str) -> Answers:
    """Answers with one more.

    Raises:
        ParameterError: If the answer is invalid, or contradicts earlier ones.
    """
    found = question.answer(known, text, question.option)
    problem = found.dimensions.find_problem()
    if problem:
        hint = ""
        if question.field == "leg" and 0.0 < found.dimensions.leg < 0.005:
            hint = ": mm, not m"
        raise ParameterError(problem[1] + hint, where=question.option)
    return found
