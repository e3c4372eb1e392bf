"""Dimensions of a machine, from options or from answers at a terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from orthocal.builder.dimensions import Dimension, Dimensions, in_mm
from orthocal.builder.machine_file import AS_DRIVE, Counting, find_counting_problem
from orthocal.cli.options import read_number
from orthocal.cli.printing import put_note
from orthocal.errors import ParameterError
from orthocal.units import MM

if TYPE_CHECKING:
    from orthocal.arrays import Array

Answer = TypeVar("Answer")

LARGEST_OFFSET = 100.0
"""Largest tolerance of the home switches, [mm]."""

IN_METRES = 5e-3
"""Length of a leg below which it is probably stated in metres instead of mm, [m]."""

COUNTS, AT_ZERO = "counts", "at_zero_mm"
"""Keys of the joints of the controller."""

COUNTING = {
    COUNTS: "Does the number of a joint go up or down as its slide moves {growing}? up or "
    "down, for all or as {letters}",
    AT_ZERO: "What does the controller show {at_zero}, mm? One number for all, or {letters}",
}
"""Questions at the terminal by the key of a property of the joints."""


class Stated(NamedTuple):
    """Value of a dimension or of a property of the joints, as text."""

    option: str
    """Option that states the value."""
    text: str


class Answers(NamedTuple):
    """Dimensions and properties of the joints; missing answers have the usual values."""

    dimensions: Dimensions
    counting: tuple[Counting, ...]
    asked: bool = False
    """Whether some values were asked for at the terminal."""


class _Question(NamedTuple):
    """Question about a dimension or a property of the joints."""

    key: str
    words: str
    usual: str | None = None
    """Usual answer; None if there is none."""
    dimension: Dimension | None = None
    """None for a property of the joints."""

    @property
    def option(self) -> str:
        """Option that states the answer."""
        return OPTIONS.get(self.key, f"--dimension {self.key}")


OPTIONS = {
    key: f"--{key.replace('_', '-')}"
    for key in ("leg_mm", "travel_mm", "attachment_mm", "rods_apart_mm", "rod_radius_mm",
                COUNTS, AT_ZERO)
}  # fmt: skip
"""Options by key, for keys that have an option beside --dimension."""


def _questions(kind: type[Dimensions]) -> list[_Question]:
    """Questions about a machine of a kind, in the order of their answers."""
    words = {
        "growing": kind.growing, "at_zero": kind.at_zero, "letters": ",".join(kind.letters)
    }  # fmt: skip
    usual = {} if kind.legs_determine_offsets else {COUNTS: "up", AT_ZERO: "{zero}"}
    return [
        *(_Question(d.key, d.question, d.usual, d) for d in kind.keys),
        *(_Question(k, text.format(**words), usual.get(k)) for k, text in COUNTING.items()),
    ]


def find_answers(kind: type[Dimensions], stated: Mapping[str, Stated]) -> Answers:
    """Dimensions of a machine and properties of its joints.

    Missing values are asked for at a terminal.

    Args:
        kind: Kind of the machine.
        stated: Values on the command line by key of machine.yaml, counts or at_zero_mm.

    Raises:
        ParameterError: If an option is invalid, contradicts the others, or is missing without a
            terminal.
    """
    questions = _questions(kind)
    keys = {q.key for q in questions}
    for key, (option, _) in stated.items():
        if key not in keys:
            raise ParameterError(
                f"'{key}' is no dimension of the kind {kind.kind}; expected "
                f"{', '.join(d.key for d in kind.keys)}",
                where=option,
            )
    answers = Answers(kind(), (AS_DRIVE,) * len(kind.letters))
    terminal = sys.stdin is not None and sys.stdin.isatty()
    missing = [q for q in questions if q.key not in stated and q.usual is None]
    if missing and not terminal:
        for question in questions:
            if question.key in stated:
                _read(answers, question, stated[question.key])
        raise ParameterError(
            f"missing options: {', '.join(q.option for q in missing)}; without a terminal every "
            "dimension must be an option"
        )
    for question in questions:
        add = partial(_add, answers, question)
        zero = in_mm(answers.dimensions.zero)
        if question.key in stated:
            answers = add(stated[question.key])
        elif not terminal or not missing:
            answers = add(Stated(question.option, ""))
        else:
            answers = _ask_question(question, zero, add)
    return answers._replace(asked=bool(missing))


def _ask_question(question: _Question, zero: str, add: Callable[[Stated], Answers]) -> Answers:
    """Ask a question at the terminal; answers with the new one.

    Args:
        question: The question.
        zero: Coordinate of a slide in the mechanical zero, as text in mm.
        add: Function that adds an answer to the previous ones.
    """
    words = question.words.format(zero=zero)
    if question.usual is not None:
        words = f"{words}. Enter alone: {question.usual.format(zero=zero)}"
    return _ask_until_valid(words, question.option, lambda text: add(Stated(question.option, text)))


def _add(answers: Answers, question: _Question, stated: Stated) -> Answers:
    """Add an answer to the previous ones; an empty one is replaced by the usual one.

    Raises:
        ParameterError: If the answer is missing or invalid, or contradicts earlier ones.
    """
    dimension = question.dimension
    if not stated.text:
        if question.usual is None:
            raise ParameterError("found nothing; expected an answer", where=stated.option)
        if dimension is None:  # the joints keep the convention of the drives
            return answers
        stated = stated._replace(text=question.usual)
    answers = _read(answers, question, stated)
    problem = answers.dimensions.find_problem()
    if dimension and problem and problem[0] == dimension.name:  # later dimensions are not known yet
        value = getattr(answers.dimensions, dimension.name)
        in_metres = dimension.name in ("leg", "rod") and 0.0 < value < IN_METRES
        raise ParameterError(problem[1] + (": mm, not m" if in_metres else ""), where=stated.option)
    return answers


def _read(answers: Answers, question: _Question, stated: Stated) -> Answers:
    """Add an answer to the previous ones; it may contradict them.

    Raises:
        ParameterError: If the answer is malformed.
    """
    if question.dimension is None:
        return answers._replace(counting=_read_counting(answers, question.key, stated))
    d = question.dimension
    parts = stated.text.split(d.separator) if d.separator else [stated.text]
    if len(parts) != d.count:
        raise ParameterError(
            f"found '{stated.text}'; expected {d.form}, in {d.unit}, such as "
            f"{d.usual or '100:320'}",
            where=stated.option,
        )
    value: Any = d.to_si([read_number(part, stated.option) for part in parts])
    changed: Any = {d.name: value}
    return answers._replace(dimensions=replace(answers.dimensions, **changed))


def _read_counting(answers: Answers, key: str, stated: Stated) -> tuple[Counting, ...]:
    """Properties of the joints, from one answer for all joints or one for each.

    Raises:
        ParameterError: If the answer is invalid.
    """
    option, letters, counting = stated.option, answers.dimensions.letters, answers.counting
    count = len(letters)
    parts = [part.strip() for part in stated.text.split(",")]
    if len(parts) not in (1, count):
        raise ParameterError(
            f"has {len(parts)} parts; expected one for all, or one for each of {','.join(letters)}",
            where=option,
        )
    joints = list(zip(counting, parts * (count // len(parts)), strict=True))
    if key == AT_ZERO:
        counting = tuple(replace(joint, at_zero=_length(part, option)) for joint, part in joints)
        problem = find_counting_problem(counting, count)
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
    """Ask for the tolerance of the drives' offsets; values of --tolerance.

    Args:
        usual: Usual tolerance, [mm].

    Raises:
        ParameterError: If the input ends.
    """

    def read(text: str) -> list[str]:
        tolerance = _length(text or f"{usual:g}", "--tolerance") / MM
        if not 0.0 < tolerance <= LARGEST_OFFSET:
            raise ParameterError(
                f"found {tolerance:g} mm; expected more than 0, and at most {LARGEST_OFFSET:g} mm"
            )
        return [f"*.offset_mm={tolerance:g}"]

    return _ask_until_valid(
        "By how much may the zeros of the joints be off, ± limit in mm? Enter alone: "
        f"{usual:g}, usual for home switches that were never measured",
        "--tolerance",
        read,
    )


def ask_workspace(usual: str, read: Callable[[str], Array]) -> Array | None:
    """Ask for the workspace of a machine; None for the usual one.

    Args:
        usual: Description of the usual workspace.
        read: Function from a text to a box, shape (n, 2), [m]; raises ParameterError.

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
            sys.stderr.write("\n")
            raise ParameterError("was not answered: the input ended", where=option)
        try:
            return read(text.strip())
        except ParameterError as e:
            put_note(f"  {e.problem}")
