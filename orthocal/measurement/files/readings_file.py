"""Rows of a readings.csv, as orthocal writes it or as a spreadsheet saved it.

orthocal writes UTF-8 with commas, decimal points and mm: the standard form. A spreadsheet may save
semicolons or tabs, decimal commas, another encoding, German headings or a typographic minus. Such a
file is read unless its numbers are ambiguous; then the user needs `orthocal import`.
"""

from __future__ import annotations

import io
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from decimal import Decimal
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from orthocal.errors import SessionError
from orthocal.io.documents import MOST_CSV_ROWS, csv_rows, read_text
from orthocal.io.tables.cell import ZIP_SIGNATURE, Row
from orthocal.io.tables.delimited import SEPARATORS, decode, stated_separator
from orthocal.io.tables.numerals import (
    Numeral,
    Sign,
    decide_decimal_sign,
    parse_numeral,
    plain_minus,
)
from orthocal.measurement.files.session_keys import MOST_READINGS
from orthocal.text import composed, shorten
from orthocal.units import trim_zeros

if TYPE_CHECKING:
    from orthocal.io.tables.table import Table
    from orthocal.measurement.importing.headings import Columns


@dataclass(frozen=True, slots=True)
class RawReading:
    """Row of a table of readings, as text. Numbers have a decimal point.

    The fields from `setup` on are the columns of readings.csv. The columns x_mm to z_mm are a
    measured point; cov_xx_um2 to cov_yz_um2 are its covariance, if it differs from its setup's.
    """

    where: str
    """File and line, for messages."""
    line: int
    setup: str
    posture: str
    minus: str = ""
    cycle: str = ""
    reading_mm: str = ""
    x_mm: str = ""
    y_mm: str = ""
    z_mm: str = ""
    cov_xx_um2: str = ""
    cov_yy_um2: str = ""
    cov_zz_um2: str = ""
    cov_xy_um2: str = ""
    cov_xz_um2: str = ""
    cov_yz_um2: str = ""
    approach: str = ""
    temperature_C: str = ""
    time: str = ""


COLUMNS = tuple(field.name for field in fields(RawReading))[2:]
"""Columns of a readings.csv, in order."""

COORDINATES = ("x_mm", "y_mm", "z_mm")
COVARIANCES = tuple(name for name in COLUMNS if name.startswith("cov_"))

REQUIRED = ("setup", "posture", "reading_mm")
OPTIONAL = tuple(name for name in COLUMNS if name not in (*REQUIRED, *COORDINATES, *COVARIANCES))

REQUIRED_OF_POINTS = ("setup", "posture", *COORDINATES)
"""Required columns of a table with points; the others are optional."""

NUMBERS = ("reading_mm", *COORDINATES, *COVARIANCES, "temperature_C")
"""Columns of numbers, which may have a decimal point or comma."""

COLUMN_OF_ROLE = {"reading": "reading_mm", "temperature": "temperature_C"}
"""Columns of a readings.csv whose name differs from their role in other tables, by role."""

CONDITIONS = ("approach", "temperature_C", "time")
"""Columns that state conditions."""

MEASURED = ("temperature_C", "time")
"""Conditions that are measured with a reading, not planned."""

FIRST_LINE = 2
"""Line of the first row of a readings.csv, after the header."""

OPTIONAL_DEFAULTS = {"cycle": "1"}
"""Values of optional columns in rows that do not state them."""


def format_readings(
    rows: Sequence[RawReading],
    *,
    blank: bool = False,
    needed: Collection[str] = (),
    required: Collection[str] = REQUIRED,
) -> str:
    """Text of a readings.csv without the optional columns that no row needs.

    Args:
        rows: The rows.
        blank: Whether to write empty cells for measured conditions.
        needed: Optional columns that the operator fills in.
        required: Required columns.
    """
    columns = [
        c
        for c in COLUMNS
        if c in (*required, *needed)
        or any(getattr(r, c) not in ("", OPTIONAL_DEFAULTS.get(c)) for r in rows)
    ]
    cells = [
        [
            "" if blank and c in MEASURED else getattr(r, c) or OPTIONAL_DEFAULTS.get(c, "")
            for c in columns
        ]
        for r in rows
    ]
    lines = [columns, *cells]
    # a time in ISO 8601 may contain a comma before fractions of a second
    return "".join(",".join(c.replace(",", ".") for c in line) + "\n" for line in lines)


def format_mm(value: Decimal) -> str:
    """Text of a reading in mm in a readings.csv: exact, with at least two decimals."""
    return trim_zeros(f"{value:f}") if -30 < value.adjusted() < 30 else f"{value:e}"


def has_standard_headings(header: Iterable[str]) -> bool:
    """True for the exact headings of a readings.csv."""
    names = [composed(name.strip()) for name in header]
    required, optional = _schema(names)
    return set(required) <= set(names) <= {*required, *optional} and len(set(names)) == len(names)


def _schema(header: Collection[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Required and optional columns of a table of readings or of points."""
    if not set(COORDINATES) & set(header):
        return REQUIRED, OPTIONAL
    return REQUIRED_OF_POINTS, tuple(name for name in COLUMNS if name not in REQUIRED_OF_POINTS)


def read_rows(path: Path, content: bytes) -> Iterator[RawReading]:
    """Rows of the readings.csv of a session, with decimal points.

    Args:
        path: The file, for messages.
        content: Content of the file.

    Raises:
        SessionError: If the table is wrong or ambiguous; names file and line.
    """
    if content.startswith(ZIP_SIGNATURE):
        raise SessionError(
            "is a workbook; expected a CSV file: `orthocal import` makes one of it",
            where=str(path),
        )
    try:
        decoded = decode(content, where=str(path))
    except SessionError:
        return _standard_rows(path, content)
    first_line = decoded.text.partition("\n")[0]
    if any(has_standard_headings(first_line.split(separator)) for separator in ",;"):
        if decoded.encoding != "utf-8":
            content = decoded.text.encode()
        return _standard_rows(path, content)
    table = _read_spreadsheet_table(path, content, decoded.text)
    return _standard_rows(path, content) if table is None else _spreadsheet_rows(*table)


def _standard_rows(path: Path, content: bytes) -> Iterator[RawReading]:
    """Rows below the headings of a readings.csv."""
    text = read_text(path, error=SessionError, content=content)
    header = text.partition("\n")[0].replace(";", ",").split(",")
    required, optional = _schema([composed(name.strip()) for name in header])

    def rows() -> Iterator[tuple[int, dict[str, str]]]:
        return csv_rows(
            io.StringIO(text, newline=None),
            name=str(path),
            required=required,
            optional=optional,
            most=MOST_CSV_ROWS,
        )

    sign: Sign = "point"
    if not content.isascii() or b'"' in content or b";" in content:
        numerals = []
        with suppress(SessionError):  # a wrong row is refused when it is read below
            for line, row in islice(rows(), MOST_READINGS + 1):
                names = ("reading_mm", *COORDINATES)
                numerals += [Numeral(row[name], line) for name in names if row.get(name)]
        if any("," in numeral.text for numeral in numerals):
            sign = decide_decimal_sign(
                numerals, standard=True, advice=SIGN_ADVICE, place=lambda line: f"{path}:{line}"
            ).sign
    for line, cells in rows():
        cells |= {n: _standard_number(text, sign) for n, text in cells.items() if n in NUMBERS}
        yield RawReading(f"{path}:{line}", line, **cells)


SIGN_ADVICE = "write it with a decimal point, or use `orthocal import --decimal comma|point`"


def _standard_number(text: str, sign: Sign) -> str:
    """Number of a table with standard headings, with a decimal point.

    Other text is returned unchanged and refused later.
    """
    if sign == "point" or "," not in text:
        return plain_minus(text)
    value = parse_numeral(text, sign)
    return text if value is None else format_mm(value)


def _read_spreadsheet_table(path: Path, content: bytes, text: str) -> tuple[Table, Columns] | None:
    """Table that a spreadsheet program saved; None for other files.

    Lines above the headings are not accepted, except one that states the separator.

    Args:
        path: The file, for messages.
        content: Content of the file.
        text: Its decoded text.

    Raises:
        SessionError: If a column does not belong to a session, or its readings are not in mm.
    """
    from orthocal.io.tables.table import read_table
    from orthocal.measurement.importing.headings import EXPECTED, choose_columns, find_header

    try:
        table = read_table(path, content, find_header, expected=EXPECTED)
    except SessionError:
        return None
    header_is_first = table.header_line == 1 or stated_separator(text) is not None
    if table.above or not header_is_first or len(set(table.header)) < len(table.header):
        return None
    where = f"{path}:{table.header_line}"
    try:
        columns = choose_columns(table.header, {}, where=where)
    except SessionError as e:
        raise SessionError(f"{e.problem} of `orthocal import`", where=where) from None
    names = [shorten(" ".join(name.split())) for name in table.header]
    if columns.extra:
        first = columns.extra[0]
        problem = (
            f"unknown column '{names[first]}'"
            if names[first]
            else f"column {first + 1} has no heading"
        )
        raise SessionError(
            f"{problem}; expected {', '.join(REQUIRED)} and optionally {', '.join(OPTIONAL)}",
            where=where,
        )
    for i, heading in columns.readings.items():
        if heading.cycle is not None or heading.unit != "mm":
            unit = f"readings in {heading.unit}" if heading.unit else "readings without a unit"
            noun = unit if heading.cycle is None else f"cycle {heading.cycle} alone"
            raise SessionError(
                f"column '{names[i]}' contains {noun}; expected one column of readings in mm, "
                "which `orthocal import` makes of such a table",
                where=where,
            )
    return table, columns


def _spreadsheet_rows(table: Table, columns: Columns) -> Iterator[RawReading]:
    """Rows of a table saved by a spreadsheet program."""
    require_unsplit_numbers(table, columns)
    (reading,) = columns.readings
    numerals = [Numeral(row.cell(reading).text, row.line) for row in table.rows]
    standard = has_standard_headings(table.header)
    sign = decide_decimal_sign(
        numerals, standard=standard, advice=SIGN_ADVICE, place=table.place
    ).sign
    width = len(table.header)
    for row in table.rows:
        where = table.place(row.line)
        if len(row.cells) > width or row.width < width:
            names = SEPARATORS[table.separator or "comma"].join(table.header)
            count = row.width if row.width < width else len(row.cells)
            raise SessionError(
                f"has {count} field{'s' * (count != 1)}; expected {width} ({shorten(names)})",
                where=where,
            )
        cells = {
            COLUMN_OF_ROLE.get(role, role): composed(row.cell(index).text.strip())
            for role, index in (*columns.single.items(), ("reading", reading))
        }
        for name in NUMBERS:
            text = cells.get(name, "")
            value = parse_numeral(text, "point" if standard and "," not in text else sign)
            if value is not None:
                cells[name] = format_mm(value)
        yield RawReading(where, row.line, **cells)


def _may_be_split_thousands(row: Row, pairs: Collection[tuple[int, int]]) -> bool:
    """True if two neighbouring cells may be parts of one number, such as 1,000."""
    cells = [(row.cell(i).text.strip(), row.cell(j).text.strip()) for i, j in pairs]
    return any(_INTEGER.fullmatch(a) and _GROUP.fullmatch(b) for a, b in cells)


def _may_end_in_split_thousands(row: Row, first: int, second: int) -> bool:
    """True if the last two filled cells may be parts of one number, such as 12,500.0."""
    followed = any(row.cell(i).text.strip() for i in range(second + 1, row.width))
    a, b = row.cell(first).text.strip(), row.cell(second).text.strip()
    return not followed and bool(_UP_TO_99.fullmatch(a) and _GROUP.fullmatch(b))


_INTEGER = re.compile(r"[-+\u2212\u2013]?[0-9]+(?:[\s'\u2019][0-9]{3})*")
_UP_TO_99 = re.compile(r"[-+\u2212\u2013]?[0-9]{1,2}")
_DIGITS = re.compile(r"[0-9]+")
_GROUP = re.compile(r"[0-9]{3}(\.[0-9]*)?")


def require_unsplit_numbers(
    table: Table, columns: Columns, *, separator_known: bool = False
) -> None:
    """Refuse a table with commas as separators in which a comma may be part of a number.

    An unquoted 3,5 or 1,000.0 becomes two cells, so that the row has more cells than the headings.
    If the last cell of the row is empty, the number of cells does not show this. Then the table is
    accepted only if at least one row cannot contain such a number. A row that ends in a number such
    as 12,500.0 is refused in any case, because its last cell may be missing.

    Args:
        table: The table.
        columns: Roles of the columns.
        separator_known: Whether the user stated that commas separate cells.

    Raises:
        SessionError: If a number may be split; names the row.
    """
    if table.separator != "comma":
        return
    readings = list(columns.readings)
    texts = [row.cell(i).text for row in table.rows for i in readings]
    separator_known = separator_known or has_standard_headings(table.header)
    # a decimal sign within a cell shows that decimal commas do not separate cells
    sign_known = separator_known or any("." in t or "," in t for t in texts)
    pairs = {(i, i + 1) for i in readings}
    pairs |= {(i - 1, i) for i in readings if i and i - 1 not in columns.keys}
    # every row may contain commas between thousands, and none shows that they separate cells
    grouped = not separator_known and all(_may_be_split_thousands(row, pairs) for row in table.rows)
    for row in table.rows:
        if row.width > table.header_width:
            raise SessionError(
                f"has {row.width} fields; expected {table.header_width}; a decimal comma "
                "between commas? Save the table with semicolons, or its numbers in quotes",
                where=table.place(row.line),
            )
        for first, second in sorted(pairs):
            a, b = row.cell(first).text.strip(), row.cell(second).text.strip()
            # these two cells may be one number such as 1,000, in the table or at the end of its row
            thousands = grouped or (
                not separator_known and _may_end_in_split_thousands(row, first, second)
            )
            if sign_known and not thousands:
                continue
            if _INTEGER.fullmatch(a) and (_GROUP if thousands else _DIGITS).fullmatch(b):
                sign = "comma between thousands" if thousands else "decimal comma"
                raise SessionError(
                    f"'{shorten(a)},{shorten(b)}' may be two cells or one number with a {sign}; "
                    "for two cells use `orthocal import --separator comma`, for one number save "
                    "the table with semicolons",
                    where=table.place(row.line),
                )
