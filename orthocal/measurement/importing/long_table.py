"""Long form of a table of readings: one row per reading, names of the session, values in mm.

Cycles side by side become rows. Rows without a reading are skipped, each with its reason.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from decimal import Decimal, localcontext
from itertools import chain

from orthocal.errors import SessionError
from orthocal.io.strict_yaml import LONGEST_NUMBER
from orthocal.io.tables.cell import Cell, Row
from orthocal.io.tables.numerals import (
    DecimalSign,
    Numeral,
    Sign,
    is_missing,
    parse_numeral,
    plain_minus,
    tidy_text,
)
from orthocal.io.tables.table import Table
from orthocal.measurement.files.readings_file import (
    RawReading,
    decide_sign,
    is_house,
    mm_text,
    require_whole_cells,
)
from orthocal.measurement.importing.headings import (
    SINGLE,
    UNITS,
    Columns,
    Role,
    UnitName,
    parse_unit,
    split_degrees,
)
from orthocal.text import composed, shorten

NO_READING = "no reading"

NAMED: tuple[Role, ...] = ("setup", "posture")
"""Columns that no row of a reading leaves empty."""

SkippedRows = list[tuple[int, str]]
"""Lines of the table that are not imported, with the reason."""

CHOOSE_SIGN = "choose one by --decimal comma or --decimal point"

LONGEST_NAME = 200
"""Maximum length of a name in a session."""

WARMEST = Decimal(45)
"""Largest temperature of a workshop in °C; larger ones without a unit may be in °F."""

_DAY_FIRST = re.compile(r"([0-9]{1,2})\.([0-9]{1,2})\.([0-9]{4}),? +([0-9]{1,2})(:[0-9]{2}.*)")
_NUMBER_AND_WORD = re.compile(r"(.*[0-9.,])\s*([^0-9.,\s].*)", re.S)


@dataclass(frozen=True, slots=True)
class Entry:
    """A cell of a column of readings."""

    row: RawReading
    """The row with names as written, without its reading."""
    column: int
    number: str | None
    """Text of the number without its unit; None if the cell has no reading."""
    value: Decimal | None = None
    """Value of a workbook's number."""
    unit: UnitName | None = None


@dataclass(frozen=True, slots=True)
class LongTable:
    """Readings of a table in its order, and how they were interpreted."""

    rows: tuple[RawReading, ...]
    missing: tuple[RawReading, ...]
    """Rows of the session whose cell is empty."""
    decimal: DecimalSign
    units: tuple[UnitName, ...]
    """Units of the readings."""
    unit_assumed: bool
    """True if readings without a unit have the unit of the option."""
    skipped: tuple[tuple[int, str], ...]
    """Lines that are not imported, with the reason."""
    renamed: tuple[tuple[str, str], ...]
    """Names of the table with the names of the session that replace them."""


def make_long_table(
    table: Table,
    columns: Columns,
    *,
    names: Mapping[str, Iterable[str]],
    decimal: Sign | None = None,
    unit: UnitName | None = None,
    separator_known: bool = False,
    fill: bool = False,
) -> LongTable:
    """Convert a table to its long form.

    Args:
        table: The table.
        columns: Roles of its columns.
        names: Names of the session for `setup` and `posture`. Upper case, and blanks in place of
            underscores, make no difference.
        decimal: Decimal sign; inferred by default.
        unit: Unit of readings without a unit.
        separator_known: True if the user stated the separator.
        fill: True to copy an empty setup or posture from the row above.

    Raises:
        SessionError: Naming the row, if a cell is not a number, has no unit, or is ambiguous.
    """
    require_whole_cells(table, columns, sure=separator_known or decimal == "point")
    skipped: SkippedRows = []
    entries = list(_read_entries(table, columns, skipped, fill))
    sign = _decide_decimal_sign(table, entries, decimal)
    setups, postures = (_folded_names(names[role]) for role in ("setup", "posture"))
    renamed: dict[str, str] = {}
    units: dict[UnitName, None] = {}
    unit_assumed = False
    rows, missing = [], []
    for entry in entries:
        row = _with_session_names(entry.row, setups, postures)
        if entry.number is None:
            if row.setup in setups and row.posture in postures:
                missing.append(row)
            elif (row.line, NO_READING) not in skipped[-1:]:
                skipped.append((row.line, NO_READING))
            continue
        names_of_rows = zip(_names(entry.row), _names(row), strict=True)
        renamed |= {old: new for old, new in names_of_rows if old != new}
        value = _parse_value(entry, sign.sign)
        entry_unit = _choose_unit(entry, unit, table.header[entry.column])
        units[entry_unit] = None
        unit_assumed |= entry.unit is None
        with localcontext(prec=2 * LONGEST_NUMBER):
            rows.append(replace(row, reading_mm=mm_text(value * UNITS[entry_unit])))
    return LongTable(
        rows=tuple(rows),
        missing=tuple(missing),
        decimal=sign,
        units=tuple(units),
        unit_assumed=unit_assumed,
        skipped=tuple(skipped),
        renamed=tuple(renamed.items()),
    )


def _names(row: RawReading) -> tuple[str, str, str]:
    return row.setup, row.posture, row.minus


def _with_session_names(
    row: RawReading, setups: Mapping[str, str], postures: Mapping[str, str]
) -> RawReading:
    """A row with the names of the session in place of those of the table."""
    return replace(
        row,
        setup=_session_name(row.setup, setups),
        posture=_session_name(row.posture, postures),
        minus=_session_name(row.minus, postures),
    )


def _read_entries(
    table: Table, columns: Columns, skipped: SkippedRows, fill: bool
) -> Iterator[Entry]:
    """Cells of the columns of readings, row by row."""
    for column, top, _ in table.merged:
        if column in columns.readings:
            raise SessionError(
                "is merged with cells below; expected one cell for each reading",
                where=table.place(top, column),
            )
    above = dict.fromkeys(NAMED, "")
    units_below: dict[int, UnitName] = {}
    rows = table.fill_merged(columns.keys)
    for first in rows:
        units_below = _read_units_row(first, columns)
        if units_below:
            skipped.append((first.line, "units"))
        else:
            rows = chain([first], rows)
        break
    for row in rows:
        names = {role: _name(row.cell(columns.single[role])) for role in NAMED}
        filled_cells = [i for i in columns.readings if not _is_missing(row.cell(i))]
        beyond = sum(not c.is_blank for c in row.cells[len(table.header) :])
        if beyond:
            skipped.append((row.line, f"{beyond} cells without a heading"))
        if not filled_cells and not all(names.values()):
            skipped.append((row.line, NO_READING))
            continue
        if fill:
            names = above = {role: name or above[role] for role, name in names.items()}
        for role, name in names.items():
            if not name:
                raise SessionError(
                    f"has a reading but no {role}; --fill copies the {role} from the row above",
                    where=table.place(row.line),
                )
        cells = _read_optional_cells(table, row, columns) | {role: names[role] for role in NAMED}
        for i, heading in columns.readings.items():
            where = table.place(row.line, i)
            numbered = cells if heading.cycle is None else {**cells, "cycle": str(heading.cycle)}
            entry = Entry(RawReading(where, row.line, **numbered), i, None)
            if i not in filled_cells:
                yield entry
                continue
            number, value, unit = _read_number(row.cell(i), where)
            stated = heading.unit or units_below.get(i)
            if unit and stated and unit != stated:
                raise SessionError(
                    f"the reading is in {unit}, and its heading says {stated}", where=where
                )
            yield replace(entry, number=number, value=value, unit=unit or stated)


def _read_optional_cells(table: Table, row: Row, columns: Columns) -> dict[str, str]:
    """Cells of a row in the optional columns of a readings.csv."""
    cells = {role: row.cell(columns.single.get(role)) for role in SINGLE}
    warm = columns.single.get("temperature")
    return {
        "minus": _name(cells["minus"]),
        "cycle": _name(cells["cycle"]),
        "approach": _name(cells["approach"]).casefold(),
        "temperature_C": "" if warm is None else _read_temperature(table, row, warm),
        "time": read_time(cells["time"].text),
    }


def _read_temperature(table: Table, row: Row, column: int) -> str:
    """Temperature of a row in °C; text that is no number as it is.

    Raises:
        SessionError: If it may be in °C or °F.
    """
    text = row.cell(column).text.strip()
    number, unit = split_degrees(text)
    degrees = unit or split_degrees(table.header[column])[1]
    value = parse_numeral(number.strip(), "comma" if "," in number else "point")
    if value is None or value.adjusted() > 3:
        return text
    if degrees is None and value > WARMEST:
        raise SessionError(
            f"the temperature '{shorten(text)}' may be in °C or °F; write the unit into the "
            "heading, such as temperature [°F]",
            where=table.place(row.line, column),
        )
    if degrees == "F":
        value = round((value - 32) / Decimal("1.8"), 3).normalize()
    return f"{value:f}"


def read_time(text: str) -> str:
    """Date and time of ISO 8601, of a day such as 14.03.2025; other text as it is."""
    text = text.strip()
    day = _DAY_FIRST.match(text)
    return text if day is None else f"{day[3]}-{day[2]:0>2}-{day[1]:0>2}T{day[4]:0>2}{day[5]}"


def _read_units_row(row: Row, columns: Columns) -> dict[int, UnitName]:
    """Units by column, if a row below the headings contains units only."""
    if any(_name(row.cell(i)) for i in columns.keys):
        return {}
    units: dict[int, UnitName] = {}
    for i, heading in columns.readings.items():
        text = tidy_text(row.cell(i).text).strip("[]()")
        unit = parse_unit(text)
        if (text and unit is None) or (unit and heading.unit and heading.unit != unit):
            return {}
        if unit is not None:
            units[i] = unit
    return units


def _name(cell: Cell) -> str:
    """Name of a cell; empty for a dash."""
    if len(cell.text) > 2 * LONGEST_NAME:  # normalising takes quadratic time
        return cell.text
    text = composed(" ".join(tidy_text(cell.text).split()))
    return "" if plain_minus(text) in ("-", "—") else text


def _is_missing(cell: Cell) -> bool:
    return cell.kind == "text" and is_missing(cell.text)


_NOT_A_NUMBER = {
    "date": "is the date {}; expected a number: the spreadsheet program took the typed number for "
    "a date",
    "boolean": "is {}; expected a number",
    "unsaved formula": "is a formula{} without a saved value: open the workbook in a spreadsheet "
    "program and save it",
    "scaled number": "is {}, shown as a percentage or in thousands; format its cell as a plain "
    "number",
}


def _read_number(cell: Cell, where: str) -> tuple[str, Decimal | None, UnitName | None]:
    """Text, value and unit of the number of a cell.

    Raises:
        SessionError: If the cell is not a number, whatever the decimal sign.
    """
    if cell.kind in _NOT_A_NUMBER:
        raise SessionError(
            f"the reading {_NOT_A_NUMBER[cell.kind].format(shorten(cell.text))}", where=where
        )
    if cell.kind == "number":
        return cell.text, cell.number, parse_unit(cell.unit)
    text = tidy_text(cell.text)
    match = _NUMBER_AND_WORD.fullmatch(text) if len(text) <= 2 * LONGEST_NUMBER else None
    unit = parse_unit(match[2]) if match else None
    return (match[1], None, unit) if match and unit else (text, None, None)


def _decide_decimal_sign(table: Table, entries: list[Entry], stated: Sign | None) -> DecimalSign:
    if stated is not None:
        return DecimalSign(stated, None)
    numerals = [
        Numeral(e.number, e.row.line) for e in entries if e.number is not None and e.value is None
    ]
    return decide_sign(numerals, house=is_house(table.header), ask=CHOOSE_SIGN, place=table.place)


def _parse_value(entry: Entry, sign: Sign | None) -> Decimal:
    if entry.value is not None:
        return entry.value
    number = entry.number or ""
    value = parse_numeral(number, sign or "point")
    if value is None:
        hint = ""
        if any(parse_numeral(number, s) is not None for s in ("point", "comma")):
            hint = f" with a decimal {sign}"
        raise SessionError(
            f"the reading is '{shorten(number)}'; expected a number{hint}", where=entry.row.where
        )
    return value


def _choose_unit(entry: Entry, stated: UnitName | None, heading: str) -> UnitName:
    where = entry.row.where
    if stated and entry.unit and stated != entry.unit:
        raise SessionError(
            f"the reading is in {entry.unit}, which contradicts --unit {stated}", where=where
        )
    unit = entry.unit or stated
    if unit is None:
        raise SessionError(
            f"neither the heading '{shorten(' '.join(heading.split()))}' nor the cell has a unit; "
            "state it by --unit mm, um or inch",
            where=where,
        )
    return unit


def _fold(name: str) -> str:
    if len(name) > 2 * LONGEST_NAME:
        return name
    return "_".join(plain_minus(composed(name)).casefold().split())


def _folded_names(names: Iterable[str]) -> dict[str, str]:
    """Names of the session by themselves and, where it is unique, by their folded form."""
    by_fold: dict[str, list[str]] = {}
    for name in names:
        by_fold.setdefault(_fold(name), []).append(name)
    unique = {fold: alike[0] for fold, alike in by_fold.items() if len(alike) == 1}
    return unique | {name: name for alike in by_fold.values() for name in alike}


def _session_name(written: str, known: Mapping[str, str]) -> str:
    """The session's name for a name as written; the same text if the session has none."""
    return known.get(written) or known.get(_fold(written)) or written
