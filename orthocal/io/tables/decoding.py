"""Bytes of a table to text: which encoding, and how that is known."""

from __future__ import annotations

import codecs
import re
from dataclasses import dataclass

from orthocal.errors import SessionError

ENCODINGS = (
    *("utf-8", "utf-16", "utf-16-le", "utf-16-be"),
    *("cp1252", "latin-1", "cp1250", "cp850", "cp437", "mac-roman"),
)
"""Names of encodings that may be asked for."""

_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
"""Byte order marks; that of UTF-32 begins with one of UTF-16."""

_OTHER_FILES = (
    (b"\xd0\xcf\x11\xe0", "is an old .xls, or protected by a password; save it as .xlsx or CSV"),
    (b"%PDF", "is a PDF; expected a CSV or an .xlsx"),
)
"""What files that are no tables begin with."""

_NO_TEXT = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]")

_LOOKED_AT = 4096
"""Bytes in which zeros tell UTF-16 without a mark."""


@dataclass(frozen=True, slots=True)
class Decoded:
    """A text, and the encoding that it came in."""

    text: str
    """Lines end with a newline, without a byte order mark."""
    encoding: str
    reason: str
    """How the encoding is known."""


def decode(content: bytes, *, where: str, encoding: str | None = None) -> Decoded:
    """Text of a table.

    A byte order mark decides; then zeros in every second byte (UTF-16); then whether it is UTF-8;
    what is not is taken for cp1252, as spreadsheets on Windows write. In another encoding of one
    byte digits, separators and ASCII names are the same, and whatever else differs is in no
    number.

    Args:
        content: The bytes.
        where: File, for messages.
        encoding: One of ENCODINGS, where it is said.

    Raises:
        SessionError: If the bytes are not text, or not in the encoding that was said.
    """
    for begin, problem in _OTHER_FILES:
        if content.startswith(begin):
            raise SessionError(problem, where=where)
    name, reason = _find_encoding(content, encoding, where)
    try:
        text = content.decode(name)
    except UnicodeDecodeError as e:
        problem = f"is not {name} text (byte {e.start})"
        if encoding is None and name == "cp1252":
            problem = f"is neither UTF-8 nor cp1252 text (byte {e.start}); say --encoding"
        raise SessionError(problem, where=where) from None
    text = text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n")
    found = _NO_TEXT.search(text)
    if found:
        line = text.count("\n", 0, found.start()) + 1
        raise SessionError(
            f"holds the control character {ord(found[0]):#04x}; expected text ({name})",
            where=f"{where}:{line}",
        )
    return Decoded(text, name, reason)


def _find_encoding(content: bytes, asked: str | None, where: str) -> tuple[str, str]:
    """Name of the encoding, and how it is known."""
    mark = next((name for mark, name in _MARKS if content.startswith(mark)), None)
    if asked is not None:
        if asked not in ENCODINGS:
            raise SessionError(
                f"'{asked}' is not an encoding; expected one of {', '.join(ENCODINGS)}",
                where="--encoding",
            )
        if mark is not None and asked not in (mark, mark[:6]):
            raise SessionError(
                f"begins with the byte order mark of {mark}, and --encoding says {asked}",
                where=where,
            )
        if asked == "utf-16":
            return (mark or _utf16_by_zeros(content) or "utf-16-le"), "as asked for"
        return asked, "as asked for"
    if mark is not None:
        return mark, "by its byte order mark"
    zeros = _utf16_by_zeros(content)
    if zeros is not None:
        return zeros, "by zeros in every second byte"
    try:
        content.decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252", "because it is not UTF-8"
    return "utf-8", "ASCII alone" if content.isascii() else "by its bytes"


def _utf16_by_zeros(content: bytes) -> str | None:
    """UTF-16 of one order or the other, where every second byte of most characters is zero."""
    head = content[:_LOOKED_AT]
    pairs = len(head) // 2
    if not pairs or 0 not in head:
        return None
    even, odd = head[0::2].count(0), head[1::2].count(0)
    if odd > pairs // 2 and even == 0:
        return "utf-16-le"
    if even > pairs // 2 and odd == 0:
        return "utf-16-be"
    return None
