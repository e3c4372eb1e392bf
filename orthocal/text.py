"""Safe display of text: escapes for characters that control a terminal or the text direction.

And lists of numbers.
"""

from __future__ import annotations

import re
import shlex
import unicodedata
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

_ESCAPED = frozenset({"Cc", "Cf", "Co", "Cs", "Zl", "Zp"})
"""Unicode categories of control, format, private-use and surrogate characters and of line and
paragraph separators. Terminals obey control characters; format characters reorder text."""

_ORDINARY = re.compile(r"[ -~]*")
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff]")


_NO_TEXT = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
"""Control characters except newline and tab, and half surrogate pairs."""

_UNSAFE = re.compile(r"[^A-Za-z0-9 _.,:;=+-]")

MOST_RUNS = 12
"""Runs of numbers that are listed."""

LONGEST_SHOWN = 58
"""Largest number of characters of a value in a message."""


def printable(text: str, *, keep: str = "") -> str:
    r"""A text with an escape such as \x1b for every invisible character.

    Bytes of a path that are not UTF-8 are lone surrogates in Python; they are shown as bytes.

    Args:
        text: Text from a file, a path or a command line.
        keep: Characters that are not escaped, such as newlines.
    """
    if _ORDINARY.fullmatch(text):
        return text
    escaped = {c for c in set(text) - set(keep) if unicodedata.category(c) in _ESCAPED}
    return "".join(_escape(c) if c in escaped else c for c in text)


def quote_path(path: str | Path) -> str:
    """A path or another word as it can be typed in a shell."""
    return printable(shlex.quote(str(path)))


def control_character(text: str) -> str | None:
    """First control character or half surrogate pair in a text, escaped; None without any."""
    match = _CONTROL.search(text)
    return _escape(match[0]) if match else None


def text_problem(value: object) -> str | None:
    """Problem with the characters of a text; None for valid text and other values."""
    if not isinstance(value, str):
        return None
    match = _NO_TEXT.search(value)
    if not match:
        return None
    if "\ud800" <= match[0] <= "\udfff":
        return "half of a surrogate pair is not a character"
    return "a text contains a control character"


def composed(text: str) -> str:
    """A name in Unicode normal form C: é is one character, not e and an accent."""
    return unicodedata.normalize("NFC", text)


def capitalised(text: str) -> str:
    """A text with a capital first letter."""
    return text[:1].upper() + text[1:]


def uncapitalised(text: str) -> str:
    """A text with a small first letter, unless its first word has further capitals (LinuxCNC)."""
    following = text.partition(" ")[0][1:]
    return text[:1].lower() + text[1:] if following == following.lower() else text


def shorten(text: str) -> str:
    """A value, shortened for a message."""
    return text if len(text) <= LONGEST_SHOWN else f"{text[: LONGEST_SHOWN - 3]}..."


def runs(numbers: Sequence[int]) -> list[tuple[int, int]]:
    """First and last of each run of consecutive numbers in an ascending sequence."""
    by_run = groupby(enumerate(numbers), key=lambda place: place[1] - place[0])
    groups = [[number for _, number in run] for _, run in by_run]
    return [(run[0], run[-1]) for run in groups]


def spans(numbers: Sequence[int], noun: str) -> str:
    """Numbers as runs, such as lines 3, 5 to 8; runs beyond MOST_RUNS as `and more`."""
    every = runs(numbers)
    words = [
        str(a) if a == b else f"{a}{' to' if b > a + 1 else ','} {b}" for a, b in every[:MOST_RUNS]
    ]
    more = " and more" if len(every) > MOST_RUNS else ""
    return f"{noun if len(numbers) == 1 else f'{noun}s'} {', '.join(words)}{more}"


def percent(share: float) -> str:
    """Share as a whole number of per cent, such as 5 %."""
    return f"{100.0 * share:.0f} %"


def list_some(items: Sequence[str], most: int, *, separator: str = ", ") -> str:
    """First items of a list, and the number of the others."""
    more = f" and {len(items) - most} more" if len(items) > most else ""
    return separator.join(items[:most]) + more


def comment_safe(text: str, longest: int = 60) -> str:
    """Text in characters that comments of G-code, C and INI files and Markdown tables accept."""
    return _UNSAFE.sub("_", text)[:longest]


def _escape(character: str) -> str:
    code = ord(character)
    if 0xDC80 <= code <= 0xDCFF:  # a byte that os.fsdecode could not decode
        return f"\\x{code - 0xDC00:02x}"
    return character.encode("unicode_escape").decode()
