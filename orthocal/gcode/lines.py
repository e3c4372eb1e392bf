"""Splitting of the lines of a program (RS274/NGC) into words and comments."""

from __future__ import annotations

import re
from typing import NamedTuple

from orthocal.errors import GcodeError
from orthocal.text import shorten

LONGEST_LINE = 1000
"""Largest number of characters in a line; controllers read 255."""

_NUMBER = r"[-+]?(?:[0-9]++\.?+[0-9]*+|\.[0-9]++)"  # possessive: linear time for any length

_ITEM = re.compile(rf"[ \t]*(?:([A-Za-z])[ \t]*({_NUMBER})(?![0-9.])|(\([^()]*\)|;.*))")

_WORD = re.compile(rf"([ \t]*([A-Za-z])[ \t]*({_NUMBER})(?![0-9.]))")

_POINT = re.compile(
    r"(N[0-9]++)?+(?:[ \t]*+G0?([01]))?+"
    rf"(?:[ \t]*+X({_NUMBER}))?+(?:[ \t]*+Y({_NUMBER}))?+(?:[ \t]*+Z({_NUMBER}))?+[ \t]*+(\r?\n)"
)

CONTROL = re.compile("[\x00-\x08\x0a-\x1f\x7f-\x9f]")
"""Control characters except the tabulator."""

_SUBROUTINE = re.compile(r"[ \t]*(?:[Nn][0-9. \t]*)?[Oo]")

_HINTS = {
    "#": "parameters",
    "[": "expressions",
    "]": "expressions",
    "/": "optional lines",
    "@": "polar coordinates",
    "^": "polar coordinates",
    "=": "assignments",
}
"""Unsupported syntax by its first character."""


class Word(NamedTuple):
    """Word of a program: a letter and its number."""

    letter: str
    value: float
    text: str
    """Text in the program with preceding blanks."""

    @property
    def code(self) -> str:
        """Normal form: G1 for g01."""
        return f"{self.letter}{self.value:g}"


Item = Word | str
"""Word or comment, with preceding blanks."""


class Line(NamedTuple):
    """Line of a program."""

    number: int
    """Number of the line, from 1."""
    items: tuple[Item, ...]
    """Words and comments in order."""
    ending: str
    """Trailing blanks and line end."""
    text: str
    """Text of the line."""


class PointLine(NamedTuple):
    """Line of coordinates only, the most frequent kind."""

    number: int
    """Number of the line, from 1."""
    label: str | None
    """N and its digits; None if absent."""
    motion: str | None
    """0 or 1 of G0 or G1; None if absent."""
    x: str | None
    y: str | None
    z: str | None
    ending: str


def split_point_line(text: str, number: int) -> PointLine | None:
    """Split a line of coordinates only; None for other lines and unusual forms.

    Args:
        text: Line with its line end.
        number: Number of the line.
    """
    match = _POINT.fullmatch(text)
    return None if match is None or len(text) > LONGEST_LINE else PointLine(number, *match.groups())


def split_line(text: str, number: int) -> Line:
    """Split a line into words and comments.

    Args:
        text: Line with its line end.
        number: Number of the line.

    Raises:
        GcodeError: If a part of the line is neither a word nor a comment; without a place.
    """
    body = text.rstrip(" \t\r\n")
    ending = text[len(body) :]
    if len(text) > LONGEST_LINE:
        raise GcodeError(f"has {len(text)} characters; expected at most {LONGEST_LINE}")
    words = _WORD.findall(body)
    if sum([len(word[0]) for word in words]) == len(body):  # no comments: the fast case
        items = [Word(letter.upper(), float(digits), word) for word, letter, digits in words]
        return Line(number, tuple(items), ending, text)
    mixed: list[Item] = []
    position = 0
    while position < len(body):
        match = _ITEM.match(body, position)
        if match is None:
            raise _refuse(body, position)
        letter, digits, comment = match.groups()
        if letter is not None:
            mixed.append(Word(letter.upper(), float(digits), match[0]))
        else:
            control = CONTROL.search(comment)
            if control:
                raise GcodeError(f"a comment holds the control character '{control[0]}'")
            mixed.append(match[0])
        position = match.end()
    return Line(number, tuple(mixed), ending, text)


def _refuse(body: str, position: int) -> GcodeError:
    """Error about the part of a line at a position."""
    text = body[position:].lstrip()
    hint = next((f" ({syntax})" for c, syntax in _HINTS.items() if c in text[:2]), "")
    if _SUBROUTINE.match(body):
        text, hint = body.strip(), " (subroutines and loops)"
    if text[:1] == "(":
        hint = " (a comment without an end)"
    return GcodeError(f"found '{shorten(text)}'{hint}; expected words such as X1.5 and comments")
