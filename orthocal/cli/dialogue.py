"""Dimensions of a machine, from options or from answers at a terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

from orthocal.builder.machine_file import Counting, Dimensions, find_counting_problem, in_mm
from orthocal.cli.options import read_number
from orthocal.cli.printing import put_note
from orthocal.errors import ParameterError
from orthocal.units import MM

AXES = "xyz"

Box = tuple[tuple[float, float], ...]
Answer = TypeVar("Answer")

USUAL_OFFSET = "4"
"""Proposed tolerance of the home switches, [mm]."""

LARGEST_OFFSET = 100.0
"""Largest tolerance of the home switches, [mm]."""


@dataclass(frozen=True, slots=True)
class Answers:
    """Answers so far; dimensions without an answer have values that cause no error message."""

    dimensions: Dimensions
    counting: tuple[Counting, Counting, Counting]

    def with_dimensions(self, **changes: Any) -> Answers:  # noqa: ANN401 - dimensions, [m]
        """Copy of the answers with other dimensions."""
        return replace(self, dimensions=replace(self.dimensions, **changes))


def _length(text: str, option: str) -> float:
    return read_number(text, option) * MM


def _leg(answers: Answers, text: str, option: str) -> Answers:
    leg = _length(text, option)
    return answers.with_dimensions(
        leg=leg,
        lower=0.9 * leg,
        upper=1.1 * leg,
        attachment=0.0,
        rods_apart=0.3 * leg,
        rod_radius=0.01 * leg,
    )


def _travel(answers: Answers, text: str, option: str) -> Answers:
    low, colon, high = text.partition(":")
    if not colon:
        raise ParameterError(
            f"found '{text}'; expected LEAST:LARGEST, in mm, such as 100:320", where=option
        )
    return answers.with_dimensions(lower=_length(low, option), upper=_length(high, option))


def _attachment(answers: Answers, text: str, option: str) -> Answers:
    return answers.with_dimensions(attachment=_length(text, option))


def _rods_apart(answers: Answers, text: str, option: str) -> Answers:
    apart, radius = _length(text, option), answers.dimensions.rod_radius
    clear = min(radius, 0.4 * apart) if apart > 0.0 else radius
    return answers.with_dimensions(rods_apart=apart, rod_radius=clear)


def _rod_radius(answers: Answers, text: str, option: str) -> Answers:
    return answers.with_dimensions(rod_radius=_length(text, option))


def _each(text: str, option: str) -> list[str]:
    """Parts of an answer: one for all of x, y, z, or one for each."""
    parts = [part.strip() for part in text.split(",")]
    if len(parts) not in (1, len(AXES)):
        raise ParameterError(
            f"has {len(parts)} parts; expected one for all, or three: x,y,z", where=option
        )
    return parts * len(AXES) if len(parts) == 1 else parts


def _counts(answers: Answers, text: str, option: str) -> Answers:
    words = [word.lower() for word in _each(text, option)]
    for word in words:
        if word not in ("up", "down"):
            raise ParameterError(f"found '{word}'; expected up or down", where=option)
    x, y, z = (replace(j, up=w == "up") for j, w in zip(answers.counting, words, strict=True))
    return replace(answers, counting=(x, y, z))


def _at_zero(answers: Answers, text: str, option: str) -> Answers:
    parts = zip(answers.counting, _each(text, option), strict=True)
    x, y, z = (replace(joint, at_zero=_length(part, option)) for joint, part in parts)
    problem = find_counting_problem((x, y, z))
    if problem:
        raise ParameterError(problem, where=option)
    return replace(answers, counting=(x, y, z))


@dataclass(frozen=True, slots=True)
class Question:
    """Question about a machine, with the option that answers it."""

    option: str
    answer: Callable[[Answers, str, str], Answers]
    """Answers so far, the new text and the option's name, to the answers with it."""
    words: str
    """Text at the terminal; {leg} is the leg length in mm."""


QUESTIONS = (
    Question("--leg-mm", _leg, "Leg length, from hinge to hinge of a rod, mm"),
    Question(
        "--travel-mm",
        _travel,
        "Travel of a slider, LEAST:LARGEST, mm. Count {leg} (the leg) where the legs are parallel "
        "to their axes, and more further out",
    ),
    Question(
        "--attachment-mm",
        _attachment,
        "Attachment offset, from slider to hinge and from hinge to tool, mm",
    ),
    Question(
        "--rods-apart-mm", _rods_apart, "Distance of the two rods of a leg, from axis to axis, mm"
    ),
    Question("--rod-radius-mm", _rod_radius, "Radius of a rod, mm"),
    Question(
        "--counts",
        _counts,
        "Does the number of a joint go up or down as its slider moves outwards? up or down, for "
        "all or as x,y,z",
    ),
    Question(
        "--at-zero-mm",
        _at_zero,
        "What does the controller show where the legs are parallel to their axes, mm? One number "
        "for all, or x,y,z",
    ),
)

NO_ANSWERS = Answers(Dimensions(), (Counting(), Counting(), Counting()))


def find_answers(options: Mapping[str, str | None]) -> Answers:
    """Dimensions of a machine from its options; missing ones are asked for at a terminal.

    Args:
        options: Option to its value; None where it is missing.

    Raises:
        ParameterError: If an option is invalid, contradicts the others, or is missing without a
            terminal.
    """
    missing = [q.option for q in QUESTIONS if options.get(q.option) is None]
    if missing and not (sys.stdin is not None and sys.stdin.isatty()):
        raise ParameterError(
            f"{'are' if len(missing) > 1 else 'is'} missing; without a terminal every dimension "
            "must be an option",
            where=", ".join(missing),
        )
    answers = NO_ANSWERS
    for question in QUESTIONS:
        text = options.get(question.option)
        if text is not None:
            answers = _add(question, answers, text)
            continue
        words = question.words.format(leg=in_mm(answers.dimensions.leg))
        answers = _ask_until_valid(words, question.option, partial(_add, question, answers))
    return answers


def _add(question: Question, answers: Answers, text: str) -> Answers:
    """Answers with one more.

    Raises:
        ParameterError: If the answer is missing or invalid, or contradicts earlier ones.
    """
    if not text:
        raise ParameterError("found nothing; expected an answer", where=question.option)
    added = question.answer(answers, text, question.option)
    problem = added.dimensions.find_problem()
    if problem:
        in_metres = question.option == "--leg-mm" and 0.0 < added.dimensions.leg < 0.005
        raise ParameterError(
            problem[1] + (": mm, not m" if in_metres else ""), where=question.option
        )
    return added


def ask_tolerance() -> list[str]:
    """Tolerance of the drives' offsets, as values of --tolerance.

    Raises:
        ParameterError: If the input ends.
    """

    def read(text: str) -> list[str]:
        size = _length(text or USUAL_OFFSET, "--tolerance") / MM
        if not 0.0 < size <= LARGEST_OFFSET:
            raise ParameterError(
                f"found {size:g} mm; expected more than 0, and at most {LARGEST_OFFSET:g} mm"
            )
        return [f"*.offset_mm={size:g}"]

    return _ask_until_valid(
        "By how much may the zeros of the joints be off, ± limit in mm? Enter alone: "
        f"{USUAL_OFFSET}, usual for home switches that were never measured",
        "--tolerance",
        read,
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
