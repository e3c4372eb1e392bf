"""Delimited text files: encoding, separator and rows."""

from __future__ import annotations

import codecs
import itertools
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass

from orthocal.errors import SessionError
from orthocal.io.documents import csv_cells
from orthocal.io.tables.cell import BLANK, MOST_CELLS, MOST_COLUMNS, MOST_ROWS, Cell, Row, make_row
from orthocal.text import shorten

LARGEST_TEXT = 16 * 2**20
"""Maximum size of a text file, [bytes]; 50,000 readings take 3 MiB."""

LONGEST_ROW = 2**17
"""Maximum number of characters of a row."""

ENCODINGS = (
    *("utf-8", "utf-16", "utf-16-le", "utf-16-be"),
    *("cp1252", "latin-1", "cp1250", "cp850", "cp437", "mac-roman"),
)
"""Encodings that can be requested."""

SEPARATORS = {"semicolon": ";", "tab": "\t", "comma": ",", "pipe": "|"}
"""Names and characters of separators."""

HEADER_ROWS = 100
"""Number of first rows in which the headings are searched."""

FindHeader = Callable[[Sequence[Row]], int | None]
"""Function that finds the row with the expected headings among the first rows of a table."""

_BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32"),  # begins with the mark of UTF-16
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)

_OTHER_FILES = (
    (b"\xd0\xcf\x11\xe0", "is an old .xls, or protected by a password; save it as .xlsx or CSV"),
    (b"%PDF", "is a PDF; expected a CSV or an .xlsx"),
)
"""Signatures of files that are not tables."""

_NOT_TEXT = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]")
_SEPARATOR_LINE = re.compile(r'"?sep=(.)"?[;,\t|]*', re.I)
"""First line by which spreadsheet programs state the separator."""
_LINE = re.compile(r"[^\n]*\n|[^\n]+")


@dataclass(frozen=True, slots=True)
class DecodedText:
    """Text of a file, and its encoding."""

    text: str
    """Text without a byte order mark; lines end with a newline."""
    encoding: str
    reason: str
    """Evidence for the encoding."""


def decode(content: bytes, *, where: str, encoding: str | None = None) -> DecodedText:
    """Decode the text of a table.

    The encoding follows from the byte order mark, then from zeros in every second byte (UTF-16),
    then from valid UTF-8. Any other file is decoded as cp1252, the default of spreadsheet programs
    on Windows. All one-byte encodings agree in digits, separators and ASCII names. So a wrongly
    detected encoding does not change a number.

    Args:
        content: Content of the file.
        where: Path of the file, for messages.
        encoding: One of ENCODINGS; detected by default.

    Raises:
        SessionError: If the content is too large, is not text, or has another encoding than the
            requested one.
    """
    for signature, problem in _OTHER_FILES:
        if content.startswith(signature):
            raise SessionError(problem, where=where)
    if len(content) > LARGEST_TEXT:
        raise SessionError(
            f"has {len(content) / 2**20:.1f} MiB; expected at most {LARGEST_TEXT / 2**20:g} MiB",
            where=where,
        )
    name, reason = _find_encoding(content, encoding, where)
    try:
        text = content.decode(name)
    except UnicodeDecodeError as e:
        problem = f"is not {name} text (byte {e.start})"
        if encoding is None and name == "cp1252":
            problem = f"is neither UTF-8 nor cp1252 text (byte {e.start}); use --encoding"
        raise SessionError(problem, where=where) from None
    text = text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n")
    unexpected = _NOT_TEXT.search(text)
    if unexpected:
        line = text.count("\n", 0, unexpected.start()) + 1
        raise SessionError(
            f"contains the control character {ord(unexpected[0]):#04x}; expected text ({name})",
            where=f"{where}:{line}",
        )
    return DecodedText(text, name, reason)


def _require_choice(requested: str, choices: Collection[str], noun: str) -> None:
    """Refuse a requested encoding or separator that is none of the choices."""
    if requested not in choices:
        raise SessionError(
            f"'{shorten(requested)}' is not {noun}; expected one of {', '.join(choices)}",
            where=f"--{noun.split()[-1]}",
        )


def _find_encoding(content: bytes, requested: str | None, where: str) -> tuple[str, str]:
    """Name of the encoding and the evidence for it."""
    mark = next((name for mark, name in _BYTE_ORDER_MARKS if content.startswith(mark)), None)
    if requested is not None:
        _require_choice(requested, ENCODINGS, "an encoding")
        if mark is not None and requested not in (mark, mark[:6]):
            raise SessionError(
                f"has the byte order mark of {mark}, which contradicts --encoding {requested}",
                where=where,
            )
        if requested == "utf-16":
            return (mark or _find_utf16(content) or "utf-16-le"), "requested"
        return requested, "requested"
    if mark is not None:
        return mark, "byte order mark"
    utf16 = _find_utf16(content)
    if utf16 is not None:
        return utf16, "zeros in every second byte"
    try:
        content.decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252", "not valid UTF-8"
    return "utf-8", "ASCII only" if content.isascii() else "valid UTF-8"


def _find_utf16(content: bytes) -> str | None:
    """Encoding of UTF-16 text without a byte order mark; None for other text.

    Such text has zeros in every second byte of its beginning.
    """
    beginning = content[:4096]
    pairs = len(beginning) // 2
    even, odd = beginning[0::2].count(0), beginning[1::2].count(0)
    if odd > pairs // 2 and even == 0:
        return "utf-16-le"
    if even > pairs // 2 and odd == 0:
        return "utf-16-be"
    return None


def find_separator(
    text: str, find_header: FindHeader, *, where: str, requested: str | None = None
) -> tuple[str, str]:
    """Separator with which a table has the expected headings.

    Args:
        text: Text of the table.
        find_header: Function that finds the expected headings.
        where: Path of the file, for messages.
        requested: Name of the separator; detected by default.

    Returns:
        Name of the separator and the evidence for it. Without evidence, the most frequent separator
        is returned.

    Raises:
        SessionError: If the headings appear with several separators.
    """
    if requested is not None:
        _require_choice(requested, SEPARATORS, "a separator")
        return requested, "requested"
    stated = stated_separator(text)
    if stated is not None:
        return stated, "stated in the first line"
    matching = []
    for name, separator in SEPARATORS.items():
        if separator not in text:
            continue
        try:
            beginning = list(itertools.islice(split_rows(text, name, where=where), HEADER_ROWS))
        except SessionError:
            continue
        if find_header(beginning) is not None:
            matching.append(name)
    if len(matching) > 1:
        raise SessionError(
            f"has the headings with {' and with '.join(matching)} as separator; choose one by "
            "--separator",
            where=where,
        )
    if matching:
        return matching[0], "detected from the headings"
    return max(SEPARATORS, key=lambda name: text.count(SEPARATORS[name])), "most frequent"


def stated_separator(text: str) -> str | None:
    """Name of the separator in a first line such as `sep=;`; None if the line states none."""
    match = _SEPARATOR_LINE.fullmatch(text, 0, text.find("\n") if "\n" in text else len(text))
    if not match:
        return None
    return next((name for name, s in SEPARATORS.items() if s == match[1]), None)


def split_rows(text: str, separator: str, *, where: str) -> Iterator[Row]:
    """Split a text into the rows that are not blank.

    Args:
        text: Lines that end with a newline.
        separator: Name of the separator.
        where: Path of the file, for messages.

    Raises:
        SessionError: If quotes do not match, or the table is too large.
    """
    length = 0

    def lines() -> Iterator[str]:
        nonlocal length
        for number, line in enumerate(_LINE.finditer(text), start=1):
            length += line.end() - line.start()
            if length > LONGEST_ROW:
                raise SessionError(
                    f"the row has more than {LONGEST_ROW} characters", where=f"{where}:{number}"
                )
            yield line[0]

    count = 0
    first_line = 2 if stated_separator(text) is not None else 1
    for line, fields in csv_cells(lines(), SEPARATORS[separator], name=where, most=MOST_ROWS):
        length = 0
        if len(fields) > MOST_COLUMNS:
            raise SessionError(
                f"has {len(fields)} columns; expected at most {MOST_COLUMNS}",
                where=f"{where}:{line}",
            )
        row = make_row(line, [Cell(field) if field else BLANK for field in fields])
        if line < first_line or row is None:
            continue
        count += len(row.cells)
        if count > MOST_CELLS:
            raise SessionError(f"has more than {MOST_CELLS} cells", where=where)
        yield row
