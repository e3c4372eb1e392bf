"""What a machine is like: from options, or asked for at a terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from orthocal.cli.printing import put_note
from orthocal.errors import ParameterError
from orthocal.io.documents import parse_number
from orthocal.robot.builder.dimensions import Counting, Sizes, find_counting_problem, in_mm
from orthocal.units import MM

AXES = "xyz"

USUALLY_OFF = "2"
"""mm"""

MOST_OFF = 50.0
"""mm"""


@dataclass(frozen=True, slots=True)
class Answers:
    """What is known of a machine so far; sizes that nobody has said yet are harmless ones."""

    sizes: Sizes
    counting: tuple[Counting, Counting, Counting]


@dataclass(frozen=True, slots=True)
class Question:
    """Something that a machine's files need."""

    option: str
    words: Callable[[Answers], str]
    """What is asked at a terminal."""
    answer: Callable[[Answers, str, str], Answers]
    """What is known with an answer; takes the option's name for messages."""
    field: str
    """What `Sizes.find_problem` calls it."""


def _number(text: str, option: str) -> float:
    return parse_number(text.strip(), where=option, name="it", error=ParameterError) * MM


def _leg(known: Answers, text: str, option: str) -> Answers:
    leg = _number(text, option)
    harmless = Sizes(
        leg=leg,
        lower=0.9 * leg,
        upper=1.1 * leg,
        attachment=0.0,
        rods_apart=0.3 * leg,
        rod_radius=0.01 * leg,
    )
    return replace(known, sizes=harmless)


def _travel(known: Answers, text: str, option: str) -> Answers:
    low, colon, high = text.partition(":")
    if not colon:
        raise ParameterError(
            f"found '{text}'; expected LEAST:LARGEST, in mm, such as 100:320", where=option
        )
    ends = {"lower": _number(low, option), "upper": _number(high, option)}
    return replace(known, sizes=replace(known.sizes, **ends))


def _size(name: str) -> Callable[[Answers, str, str], Answers]:
    def answer(known: Answers, text: str, option: str) -> Answers:
        return replace(known, sizes=replace(known.sizes, **{name: _number(text, option)}))

    return answer


def _rods_apart(known: Answers, text: str, option: str) -> Answers:
    apart = _number(text, option)
    thin = min(known.sizes.rod_radius, 0.4 * apart) if apart > 0.0 else known.sizes.rod_radius
    return replace(known, sizes=replace(known.sizes, rods_apart=apart, rod_radius=thin))


def _each(text: str, option: str) -> list[str]:
    """One for all, or one for each of x, y, z."""
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
            f"{in_mm(known.sizes.leg)} (the leg) where the legs are parallel to their axes, and "
            "more further out"
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

NOTHING_KNOWN = Answers(Sizes(), (Counting(), Counting(), Counting()))


def find_answers(given: Mapping[str, str | None]) -> Answers:
    """What a machine is like: what was given, all else asked for where somebody can answer.

    Args:
        given: Option to what was given with it.

    Raises:
        ParameterError: If an option makes no sense, makes no machine with the others, or is
            missing where nobody can be asked.
    """
    asked = sys.stdin is not None and sys.stdin.isatty()
    missing = [q.option for q in QUESTIONS if given.get(q.option) is None]
    if missing and not asked:
        raise ParameterError(
            "missing, and nobody can be asked: this is no terminal"
            if len(missing) > 1
            else "is missing, and nobody can be asked: this is no terminal",
            where=", ".join(missing),
        )
    known = NOTHING_KNOWN
    for question in QUESTIONS:
        text = given.get(question.option)
        known = _ask(question, known) if text is None else _take(question, known, text)
    return known


def ask_tolerance() -> list[str]:
    """How far zeros of joints may be off, as the option --tolerance says it.

    Raises:
        ParameterError: If the input ends.
    """
    while True:
        sys.stderr.write(
            "How far may the joints' zeros be off, one standard deviation, mm? Enter alone: "
            f"{USUALLY_OFF}, of home switches that nobody has measured: "
        )
        sys.stderr.flush()
        text = sys.stdin.readline()
        if not text:
            put_note("")
            raise ParameterError("was not answered: the input ended", where="--tolerance")
        try:
            size = _number(text.strip() or USUALLY_OFF, "--tolerance") / MM
        except ParameterError as e:
            put_note(f"  {e.problem}")
            continue
        if 0.0 < size <= MOST_OFF:
            return [f"*.offset_mm={size:g}"]
        put_note(f"  found {size:g} mm; expected more than 0, and at most {MOST_OFF:g} mm")


def _take(question: Question, known: Answers, text: str) -> Answers:
    """What is known with an answer.

    Raises:
        ParameterError: If the answer makes no sense, or no machine with what is known before.
    """
    found = question.answer(known, text, question.option)
    problem = found.sizes.find_problem()
    if problem:
        hint = ""
        if question.field == "leg" and 0.0 < found.sizes.leg < 0.005:
            hint = ": mm, not m"
        raise ParameterError(problem[1] + hint, where=question.option)
    return found


def _ask(question: Question, known: Answers) -> Answers:
    """Ask until there is an answer that makes sense.

    Raises:
        ParameterError: If there is none, for the input ends.
    """
    while True:
        sys.stderr.write(f"{question.words(known)}: ")
        sys.stderr.flush()
        text = sys.stdin.readline()
        if not text:
            put_note("")
            raise ParameterError("was not answered: the input ended", where=question.option)
        if not text.strip():
            continue
        try:
            return _take(question, known, text.strip())
        except ParameterError as e:
            put_note(f"  {e.problem}")
