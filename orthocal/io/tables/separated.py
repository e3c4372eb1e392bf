"""Text to rows: with one separator, or with whichever gives the table that is looked for."""

from __future__ import annotations

import csv
import io
import itertools
import re
from collections.abc import Callable, Iterator, Sequence

from orthocal.errors import SessionError
from orthocal.io.tables.cell import MOST_CELLS, MOST_COLUMNS, MOST_ROWS, Cell, Row, make_row
from orthocal.text import shorten

SEPARATORS = {"semicolon": ";", "tab": "\t", "comma": ",", "pipe": "|"}
"""Names of separators, and what they are."""

LOOKED_AT = 100
"""Rows among which the one with the headings is."""

_SAID = re.compile(r'"?sep=(.)"?[;,\t|]*', re.I)
"""First line by which spreadsheets tell each other the separator."""

FindHeader = Callable[[Sequence[Row]], int | None]
"""Which of the first rows holds the headings that are looked for."""


def find_separator(
    text: str, find_header: FindHeader, *, where: str, asked: str | None = None
) -> tuple[str, str]:
    """Name of the separator with which a table has the headings that are looked for.

    Args:
        text: The table.
        find_header: Whether they are there.
        where: File, for messages.
        asked: Name of the separator, where it is said.

    Returns:
        Name, and how it is known. The name is that of the most frequent separator, or of a
        semicolon, where no separator gives these headings.

    Raises:
        SessionError: If two separators do.
    """
    if asked is not None:
        if asked not in SEPARATORS:
            raise SessionError(
                f"'{shorten(asked)}' is not a separator; expected one of {', '.join(SEPARATORS)}",
                where="--separator",
            )
        return asked, "as asked for"
    said = said_separator(text)
    if said is not None:
        return said, "as the file says"
    fitting = []
    for name, separator in SEPARATORS.items():
        if separator not in text:
            continue
        try:
            head = [row for row in itertools.islice(split(text, name, where=where), LOOKED_AT)]
        except SessionError:
            continue
        if find_header(head) is not None:
            fitting.append(name)
    if len(fitting) > 1:
        raise SessionError(
            f"can be read with {' and with '.join(fitting)} as separator; say which: --separator",
            where=where,
        )
    if fitting:
        return fitting[0], "it gives the columns"
    frequent = max(SEPARATORS, key=lambda name: text.count(SEPARATORS[name]))
    return frequent, "the most frequent"


def said_separator(text: str) -> str | None:
    """Name of the separator that the first line says, as `sep=;`."""
    found = _SAID.fullmatch(text[: text.find("\n")] if "\n" in text else text)
    if not found:
        return None
    return next((name for name, s in SEPARATORS.items() if s == found[1]), None)


def split(text: str, separator: str, *, where: str) -> Iterator[Row]:
    """Rows of a text that are not blank.

    Args:
        text: Lines that end with a newline.
        separator: Name of the separator.
        where: File, for messages.

    Raises:
        SessionError: If quotes do not match, or there is too much.
    """
    lines = io.StringIO(text, newline="\n")
    reader = csv.reader(lines, delimiter=SEPARATORS[separator], skipinitialspace=True, strict=True)
    count = 0
    first = 2 if said_separator(text) is not None else 1
    try:
        for fields in reader:
            line = reader.line_num
            if line > MOST_ROWS:
                raise SessionError(f"has more than {MOST_ROWS} rows", where=where)
            if len(fields) > MOST_COLUMNS:
                raise SessionError(
                    f"has {len(fields)} columns; expected at most {MOST_COLUMNS}",
                    where=f"{where}:{line}",
                )
            if line < first:
                continue
            row = make_row(line, [Cell(field) for field in fields])
            if row is None:
                continue
            count += len(row.cells)
            if count > MOST_CELLS:
                raise SessionError(f"has more than {MOST_CELLS} cells", where=where)
            yield row
    except csv.Error as e:
        raise SessionError(f"is not valid CSV: {e}", where=f"{where}:{reader.line_num}") from None
