"""Lines of a program (RS274/NGC) as their words, blanks and comments, as they were written."""

from __future__ import annotations

import re
from typing import NamedTuple

from orthocal.errors import GcodeError
from orthocal.text import shorten

LONGEST_LINE = 1000
"""Characters; controllers read 255."""

_NUMBER = r"[-+]?(?:[0-9]++\.?+[0-9]*+|\.[0-9]++)"  # one way to read it, however long

_ITEM = re.compile(rf"[ \t]*(?:([A-Za-z])[ \t]*({_NUMBER})(?![0-9.])|(\([^()]*\)|;.*))")

_WORD = re.compile(rf"([ \t]*([A-Za-z])[ \t]*({_NUMBER})(?![0-9.]))")

_PLAIN = re.compile(
    r"(N[0-9]++)?+(?:[ \t]*+G0?([01]))?+"
    rf"(?:[ \t]*+X({_NUMBER}))?+(?:[ \t]*+Y({_NUMBER}))?+(?:[ \t]*+Z({_NUMBER}))?+[ \t]*+(\r?\n)"
)

_CONTROL = re.compile("[\x00-\x08\x0a-\x1f\x7f-\x9f]")
_SUBROUTINE = re.compile(r"[ \t]*(?:[Nn][0-9. \t]*)?[Oo]")

_HINTS = {
    "#": "parameters",
    "[": "expressions",
    "]": "expressions",
    "/": "lines that the controller may leave out",
    "@": "polar coordinates",
    "^": "polar coordinates",
    "=": "assignments",
}
"""What a character that begins no word begins instead."""


class Word(NamedTuple):
    """A letter and its number."""

    letter: str
    value: float
    text: str
    """As it was written, with blanks before it."""

    @property
    def code(self) -> str:
        """As it is spoken of: G1 for g01."""
        return f"{self.letter}{self.value:g}"


Item = Word | str
"""A word, or a comment; each with the blanks before it."""


class Line(NamedTuple):
    """A line of a program."""

    number: int
    """Counted from 1."""
    items: tuple[Item, ...]
    """In the order in which they stand."""
    ending: str
    """Blanks at its end, and what ends it."""
    text: str
    """All of it."""


class Plain(NamedTuple):
    """A line with nothing but a place, as most are."""

    number: int
    """Counted from 1."""
    label: str | None
    """N and its digits."""
    motion: str | None
    """0 or 1."""
    x: str | None
    y: str | None
    z: str | None
    ending: str


def split_plain(text: str, number: int) -> Plain | None:
    """A line with nothing but a place; None for any other, and for some of those.

    Args:
        text: With what ends it.
        number: Of the line.
    """
    found = _PLAIN.fullmatch(text)
    return None if found is None or len(text) > LONGEST_LINE else Plain(number, *found.groups())


def split_line(text: str, number: int, *, file: str) -> Line:
    """The items of a line.

    Args:
        text: With what ends it.
        number: Of the line.
        file: For messages.

    Raises:
        GcodeError: If there is something in it that is neither a word nor a comment.
    """
    body = text.rstrip(" \t\r\n")
    if len(text) > LONGEST_LINE:
        raise GcodeError(
            f"has {len(text)} characters; expected at most {LONGEST_LINE}", where=f"{file}:{number}"
        )
    words = _WORD.findall(body)
    if sum([len(word[0]) for word in words]) == len(body):  # nothing but words
        alone = [Word(letter.upper(), float(digits), own) for own, letter, digits in words]
        return Line(number, tuple(alone), text[len(body) :], text)
    items: list[Item] = []
    at, end = 0, len(body)
    while at < end:
        found = _ITEM.match(body, at)
        if found is None:
            raise _refuse(body, at, where=f"{file}:{number}")
        letter, digits, comment = found.groups()
        if letter is not None:
            items.append(Word(letter.upper(), float(digits), found[0]))
        else:
            control = _CONTROL.search(comment)
            if control:
                raise GcodeError(
                    f"a comment holds the control character '{control[0]}'",
                    where=f"{file}:{number}",
                )
            items.append(found[0])
        at = found.end()
    return Line(number, tuple(items), text[len(body) :], text)


def _refuse(body: str, at: int, *, where: str) -> GcodeError:
    rest = body[at:].lstrip()
    hint = next((f" ({words})" for c, words in _HINTS.items() if c in rest[:2]), "")
    if _SUBROUTINE.match(body):
        rest, hint = body.strip(), " (subroutines and loops)"
    if rest[:1] == "(":
        hint = " (a comment that does not end)"
    return GcodeError(
        f"found '{shorten(rest)}'{hint}; expected words such as X1.5 and comments", where=where
    )
