"""Characters as they can be shown: what steers a terminal or turns a line about is escaped."""

from __future__ import annotations

import re
import unicodedata

_ESCAPED = frozenset({"Cc", "Cf", "Co", "Cs", "Zl", "Zp"})
"""Unicode categories of control, format, private and surrogate characters and of line
and paragraph separators. A terminal obeys the first, and the second change the order of others."""

_ORDINARY = re.compile(r"[ -~]*")
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff]")


_NO_TEXT = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
"""Control characters but newline and tabulator, and halves of surrogate pairs."""

_UNSAFE = re.compile(r"[^A-Za-z0-9 _.,:;=+-]")

LONGEST_SHOWN = 58
"""Characters of a value in a message."""


def printable(text: str, *, keep: str = "") -> str:
    r"""A text with every character that is not one to be seen written as its escape, such as \x1b.

    Bytes of a path that are no UTF-8 come as lone surrogates, and are shown as the bytes that they
    are.

    Args:
        text: From a file, a path or a command line.
        keep: Characters that stay as they are, such as a newline between lines of our own.
    """
    if _ORDINARY.fullmatch(text):
        return text
    return "".join(c if c in keep or not _is_escaped(c) else _escape(c) for c in text)


def control_character(text: str) -> str | None:
    """The first control character or half of a surrogate pair in a text, escaped; else None."""
    found = _CONTROL.search(text)
    return _escape(found[0]) if found else None


def text_problem(value: object) -> str | None:
    """What is wrong with the characters of a text, if anything."""
    if not isinstance(value, str):
        return None
    found = _NO_TEXT.search(value)
    if not found:
        return None
    if "\ud800" <= found[0] <= "\udfff":
        return "half of a surrogate pair is not a character"
    return "a text holds a control character"


def composed(text: str) -> str:
    """A name in the one form of those that look alike: é is one character, not e and an accent."""
    return unicodedata.normalize("NFC", text)


def shorten(text: str) -> str:
    """A value as it can stand in a message."""
    return text if len(text) <= LONGEST_SHOWN else f"{text[: LONGEST_SHOWN - 3]}..."


def comment_safe(text: str, longest: int = 60) -> str:
    """Text in characters that comments of G-code, C and INI files and Markdown tables accept."""
    return _UNSAFE.sub("_", text)[:longest]


def _is_escaped(character: str) -> bool:
    return unicodedata.category(character) in _ESCAPED


def _escape(character: str) -> str:
    code = ord(character)
    if character in "\n\r\t":
        return {"\n": "\\n", "\r": "\\r", "\t": "\\t"}[character]
    if 0xDC80 <= code <= 0xDCFF:  # a byte that os.fsdecode could not decode
        return f"\\x{code - 0xDC00:02x}"
    if code <= 0xFF:
        return f"\\x{code:02x}"
    return f"\\u{code:04x}" if code <= 0xFFFF else f"\\U{code:08x}"
