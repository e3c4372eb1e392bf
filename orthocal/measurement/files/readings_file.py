"""Rows of a readings.csv, as orthocal writes it or as a spreadsheet saved it.

The house form is UTF-8 with commas, decimal points and mm. What a spreadsheet makes of it, with
semicolons or tabs, decimal commas, another encoding, German headings or a typographic minus, is
taken where it can mean one thing only; whatever is less clear is for `orthocal import`.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from decimal import Decimal
from itertools import islice
from pathlib import Path

from orthocal.errors import SessionError
from orthocal.io.documents import MOST_CSV_ROWS, csv_rows, read_text
from orthocal.io.tables.cell import Row
from orthocal.io.tables.delimited import SEPARATORS, decode, stated_separator
from orthocal.io.tables.numerals import (
    DecimalSign,
    Numeral,
    Sign,
    format_decimal,
    infer_decimal_sign,
    parse_numeral,
    plain_minus,
)
from orthocal.io.tables.table import Table, read_table
from orthocal.io.tables.workbook import ZIP_SIGNATURE
from orthocal.measurement.files.schema import MOST_READINGS
from orthocal.measurement.importing.headings import EXPECTED, Columns, choose_columns, find_header
from orthocal.text import composed, shorten
from orthocal.units import trim_zeros


@dataclass(frozen=True, slots=True)
class RawReading:
    """A row of a table of readings, as text; fields after the first two are the columns."""

    where: str
    """File and line, for messages."""
    line: int
    setup: str
    posture: str
    minus: str = ""
    cycle: str = ""
    reading_mm: str = ""
    """With a decimal point."""
    x_mm: str = ""
    """Coordinates of a point, likewise."""
    y_mm: str = ""
    z_mm: str = ""
    cov_xx_um2: str = ""
    """Covariance of a point, where rows differ, likewise."""
    cov_yy_um2: str = ""
    cov_zz_um2: str = ""
    cov_xy_um2: str = ""
    cov_xz_um2: str = ""
    cov_yz_um2: str = ""
    approach: str = ""
    temperature_C: str = ""
    """With a decimal point."""
    time: str = ""


COLUMNS = tuple(field.name for field in fields(RawReading))[2:]
"""Columns of a readings.csv, in order."""

COORDINATES = ("x_mm", "y_mm", "z_mm")
COVARIANCES = tuple(name for name in COLUMNS if name.startswith("cov_"))

REQUIRED = ("setup", "posture", "reading_mm")
OPTIONAL = tuple(name for name in COLUMNS if name not in (*REQUIRED, *COORDINATES, *COVARIANCES))

OF_POINTS = ("setup", "posture", *COORDINATES)
"""Required columns of a table with points; the others are optional."""

NUMBERS = ("reading_mm", *COORDINATES, *COVARIANCES, "temperature_C")
"""Columns of numbers that may have a decimal sign."""

COLUMN_OF_ROLE = {"reading": "reading_mm", "temperature": "temperature_C"}
"""Roles of columns in other tables, where the column of a readings.csv has another name."""

CONDITIONS = ("approach", "temperature_C", "time")
"""Columns that state conditions."""

MEASURED = ("temperature_C", "time")
"""Conditions that are measured with a reading, not planned."""

UNSTATED = {"cycle": "1"}
"""Values of optional columns that need not be stated."""


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
        blank: Leave the cells of measured conditions empty.
        needed: Optional columns to be filled in, with or without content.
        required: Columns that the table has in any case.
    """
    columns = [
        c
        for c in COLUMNS
        if c in (*required, *needed)
        or any(getattr(r, c) not in ("", UNSTATED.get(c)) for r in rows)
    ]
    cells = [
        ["" if blank and c in MEASURED else getattr(r, c) or UNSTATED.get(c, "") for c in columns]
        for r in rows
    ]
    lines = [columns, *cells]  # ISO 8601 allows a comma in a fraction of a second
    return "".join(",".join(c.replace(",", ".") for c in line) + "\n" for line in lines)


def mm_text(value: Decimal) -> str:
    """A reading in mm as a readings.csv has it: exactly, with two decimals at least."""
    return trim_zeros(f"{value:f}") if -30 < value.adjusted() < 30 else f"{value:e}"


def is_house(header: Iterable[str]) -> bool:
    """True for the exact headings of a readings.csv."""
    names = [composed(name.strip()) for name in header]
    required, optional = _schema(names)
    return set(required) <= set(names) <= {*required, *optional} and len(set(names)) == len(names)


def _schema(header: Collection[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Required and optional columns of a table, with points or without."""
    if not set(COORDINATES) & set(header):
        return REQUIRED, OPTIONAL
    return OF_POINTS, tuple(name for name in COLUMNS if name not in OF_POINTS)


def decide_sign(
    cells: Sequence[Numeral], *, house: bool, ask: str, place: Callable[[int], str]
) -> DecimalSign:
    """The decimal sign of readings, which have one only.

    Args:
        cells: The readings.
        house: Whether headings are those of a readings.csv: then a point is a decimal point.
        ask: What to do where it is not certain.
        place: Line to file and line, for messages.

    Raises:
        SessionError: Where two signs are possible.
    """
    sign = infer_decimal_sign(cells)
    if sign.sign is not None:
        return sign
    if sign.rival is not None and sign.evidence is not None:
        raise SessionError(
            f"the reading '{shorten(sign.rival.text)}' has a decimal point, and "
            f"'{shorten(sign.evidence.text)}' in line {sign.evidence.line} a decimal comma; "
            "use one decimal sign",
            where=place(sign.rival.line),
        )
    open_cells = (c for c in cells if _is_open(c.text) and not (house and "," not in c.text))
    rival = next(open_cells, None)
    if rival is None:
        return DecimalSign("point", None)
    comma, point = parse_numeral(rival.text, "comma"), parse_numeral(rival.text, "point")
    raise SessionError(
        f"the reading '{rival.text}' is {format_decimal(comma)} with a decimal comma and "
        f"{format_decimal(point)} with a decimal point, and no other reading decides; {ask}",
        where=place(rival.line),
    )


def _is_open(text: str) -> bool:
    """True for a numeral that is a number with either decimal sign."""
    both = parse_numeral(text, "comma"), parse_numeral(text, "point")
    return None not in both and both[0] != both[1]


def read_rows(path: Path, content: bytes) -> Iterator[RawReading]:
    """Rows of a session's own table of readings, with numbers in the house form.

    Args:
        path: The file, for messages.
        content: What it holds.

    Raises:
        SessionError: Naming file and line.
    """
    if content.startswith(ZIP_SIGNATURE):
        raise SessionError(
            "is a workbook; expected a CSV file: `orthocal import` makes one of it",
            where=str(path),
        )
    try:
        decoded = decode(content, where=str(path))
    except SessionError:
        return _plain_rows(path, content)
    first = decoded.text.partition("\n")[0]
    if any(is_house(first.split(separator)) for separator in ",;"):
        if decoded.encoding != "utf-8":
            content = decoded.text.encode()
        return _plain_rows(path, content)
    table = _clean_table(path, content)
    return _plain_rows(path, content) if table is None else _table_rows(*table)


def _plain_rows(path: Path, content: bytes) -> Iterator[RawReading]:
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
            error=SessionError,
            most=MOST_CSV_ROWS,
        )

    sign: Sign | None = None
    if not content.isascii() or b'"' in content or b";" in content:
        numerals = []
        # what is wrong with a row is told when it is read
        with suppress(SessionError):
            for line, row in islice(rows(), MOST_READINGS + 1):
                names = ("reading_mm", *COORDINATES)
                numerals += [Numeral(row[name], line) for name in names if row.get(name)]
        sign = _plain_sign(numerals, path)
    for line, cells in rows():
        if sign is not None:
            cells |= {name: _house_number(cells.get(name, ""), sign) for name in NUMBERS}
        yield RawReading(f"{path}:{line}", line, **cells)


ASK = "write it with a decimal point, or use `orthocal import --decimal comma|point`"


def _plain_sign(cells: Sequence[Numeral], path: Path) -> Sign | None:
    """The decimal sign below the headings of a readings.csv, where a point is a decimal point."""
    if not any("," in cell.text for cell in cells) or infer_decimal_sign(cells).contradictory:
        return "point"
    return decide_sign(cells, house=True, ask=ASK, place=lambda line: f"{path}:{line}").sign


def _house_number(text: str, sign: Sign) -> str:
    """A number in the form of a readings.csv; other text is left to be refused later."""
    if sign == "point":
        return plain_minus(text)
    value = parse_numeral(text, sign)
    return text if value is None else mm_text(value)


def _clean_table(path: Path, content: bytes) -> tuple[Table, Columns] | None:
    """A table that a spreadsheet saved, with nothing beside the readings; None if it is none.

    Raises:
        SessionError: For a column that is nothing of a session's.
    """
    try:
        table = read_table(path, content, find_header, expected=EXPECTED)
        columns = choose_columns(table.header, {}, where=f"{path}:{table.header_line}")
    except SessionError:
        return None
    first = table.header_line == 1 or stated_separator(decode(content, where="").text) is not None
    if table.above or not first:
        return None
    strange = [
        *columns.extra,
        *(i for i, h in columns.readings.items() if h.unit != "mm" or h.cycle is not None),
    ]
    if strange:
        name = " ".join(table.header[min(strange)].split())
        raise SessionError(
            f"unknown column '{shorten(name)}'; expected {', '.join(REQUIRED)} and optionally "
            f"{', '.join(OPTIONAL)}",
            where=f"{path}:{table.header_line}",
        )
    return table, columns


def _table_rows(table: Table, columns: Columns) -> Iterator[RawReading]:
    require_whole_cells(table, columns)
    (reading,) = columns.readings
    numerals = [Numeral(row.cell(reading).text, row.line) for row in table.rows]
    sign = decide_sign(numerals, house=is_house(table.header), ask=ASK, place=table.place).sign
    width = len(table.header)
    for row in table.rows:
        where = table.place(row.line)
        if len(row.cells) > width or row.width < width:
            names = SEPARATORS[table.separator or "comma"].join(table.header)
            count = max(len(row.cells), row.width if row.width < width else 0)
            raise SessionError(
                f"has {count} fields; expected {width} ({shorten(names)})", where=where
            )
        cells = {
            COLUMN_OF_ROLE.get(role, role): composed(row.cell(index).text.strip())
            for role, index in (*columns.single.items(), ("reading", reading))
        }
        for name in NUMBERS:
            value = None if sign is None else parse_numeral(cells.get(name, ""), sign)
            if value is not None:
                cells[name] = mm_text(value)
        yield RawReading(where, row.line, **cells)


def _is_grouped(row: Row, pairs: Collection[tuple[int, int]]) -> bool:
    """True if two cells of a row may be one number with a comma between thousands."""
    cells = [(row.cell(i).text.strip(), row.cell(j).text.strip()) for i, j in pairs]
    return any(_WHOLE.fullmatch(a) and _GROUP.fullmatch(b) for a, b in cells)


_WHOLE = re.compile(r"[-+\u2212\u2013]?[0-9]+(?:[\s'\u2019][0-9]{3})*")
_DIGITS = re.compile(r"[0-9]+")
_GROUP = re.compile(r"[0-9]{3}(\.[0-9]*)?")


def require_whole_cells(table: Table, columns: Columns, *, sure: bool = False) -> None:
    """Refuse a table with commas as separators in which a comma may be a decimal sign as well.

    Who writes 3,5 without quotes between commas makes two cells of a number: the row has a cell
    more than the headings, or, where nothing followed, looks like two whole numbers. 1,000.0 does
    the same: a row alone does not decide, but another row with other cells does.

    Args:
        table: The table.
        columns: Which column is what.
        sure: Whether it was said that commas separate.

    Raises:
        SessionError: Naming the row.
    """
    if table.separator != "comma":
        return
    readings = list(columns.readings)
    texts = [row.cell(i).text for row in table.rows for i in readings]
    sure = sure or is_house(table.header)
    certain = sure or any("." in t or "," in t for t in texts)
    pairs = {(i, i + 1) for i in readings} | {(i - 1, i) for i in readings if i}
    pairs -= {(i - 1, i) for i in readings if i - 1 in columns.keys}
    grouped = not sure and all(_is_grouped(row, pairs) for row in table.rows)
    for row in table.rows:
        if row.width > table.header_width:
            raise SessionError(
                f"has {row.width} fields; expected {table.header_width}; a decimal comma "
                "between commas? Save the table with semicolons, or its numbers in quotes",
                where=table.place(row.line),
            )
        if certain and not grouped:
            continue
        for first, second in sorted(pairs):
            a, b = row.cell(first).text.strip(), row.cell(second).text.strip()
            if _WHOLE.fullmatch(a) and (_GROUP if grouped else _DIGITS).fullmatch(b):
                sign = "comma between thousands" if grouped else "decimal comma"
                raise SessionError(
                    f"'{shorten(a)},{shorten(b)}' may be two cells or one number with a {sign}; "
                    "for two cells use `orthocal import --separator comma`, for one number save "
                    "the table with semicolons",
                    where=table.place(row.line),
                )
