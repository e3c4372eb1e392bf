"""Long form of a table of readings: one row per reading, names of the session, values in mm.

Cycles side by side become rows. Rows without a reading are skipped, and the reason is listed.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal, localcontext
from itertools import chain
from typing import Any

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import SessionError, errors_at
from orthocal.io.strict_yaml import LONGEST_NUMBER
from orthocal.io.tables.cell import Cell, Row
from orthocal.io.tables.numerals import (
    DecimalSign,
    Numeral,
    Sign,
    decide_decimal_sign,
    is_missing,
    parse_numeral,
    plain_minus,
    tidy_text,
)
from orthocal.io.tables.table import Table
from orthocal.measurement.files.readings_file import (
    RawReading,
    format_mm,
    has_standard_headings,
    require_unsplit_numbers,
)
from orthocal.measurement.importing.headings import (
    NOMINAL,
    POINT,
    SINGLE,
    UNITS,
    Columns,
    Heading,
    Role,
    UnitName,
    parse_unit,
    split_degrees,
)
from orthocal.text import composed, shorten
from orthocal.units import MM

NO_READING = "no reading"

TOTALS = ("sum", "total", "mean", "average", "summe", "mittelwert", "mittel", "durchschnitt", "σ")
"""Words in a row that is computed from others."""

REQUIRED_NAMES: tuple[Role, ...] = ("setup", "posture")
"""Columns of names that every row with a reading needs."""

SkippedRows = list[tuple[int, str]]
"""Lines of the table that are not imported, with the reason."""

NamesByFold = Mapping[str, Sequence[str]]
"""Names in the session by folded name."""

SIGN_ADVICE = "choose one by --decimal comma or --decimal point"

SAME_POINT_MM = 0.1
"""Largest difference per coordinate between a commanded point and its posture, [mm]."""

LONGEST_NAME = 200
"""Maximum length of a name in a session."""

WARMEST = Decimal(45)
"""Largest temperature without a unit that is certainly in °C; larger ones may be in °F."""

_DAY_FIRST = re.compile(r"([0-9]{1,2})\.([0-9]{1,2})\.([0-9]{4}),? +([0-9]{1,2})(:[0-9]{2}.*)")
_NUMBER_AND_WORD = re.compile(r"(.*[0-9.,])\s*([^0-9.,\s].*)", re.S)


@dataclass(frozen=True, slots=True)
class LengthCell:
    """Cell of a column of readings or coordinates."""

    row: RawReading
    """The row with names as in the table, without its reading."""
    column: int
    role: Role
    number: str | None
    """Text of the number without its unit; None if the cell has no reading."""
    value: Decimal | None = None
    """Value of the number in a workbook; None for text."""
    unit: UnitName | None = None


@dataclass(frozen=True, slots=True)
class LongTable:
    """Readings of a table in their order, and their interpretation."""

    rows: tuple[RawReading, ...]
    missing: tuple[RawReading, ...]
    """Rows of the session whose cell is empty."""
    decimal: DecimalSign
    units: tuple[UnitName, ...]
    """Units of the readings."""
    unit_assumed: bool
    """True if the option --unit applies to some readings."""
    skipped: tuple[tuple[int, str], ...]
    """Lines that are not imported, with the reason."""
    renamed: tuple[tuple[str, str], ...]
    """Names in the table, each with the name in the session that replaces it."""


def make_long_table(
    table: Table,
    columns: Columns,
    *,
    names: Mapping[str, Iterable[str]],
    decimal: Sign | None = None,
    unit: UnitName | None = None,
    separator_known: bool = False,
    fill: bool = False,
    points: Mapping[str, Array] | None = None,
) -> LongTable:
    """Convert a table to its long form.

    Args:
        table: The table.
        columns: Roles of its columns.
        names: Names in the session for `setup` and `posture`. Without a column of setups, all rows
            belong to the first setup. Case is ignored; blanks and underscores are equal.
        decimal: Decimal sign; inferred by default.
        unit: Unit of readings without a unit.
        separator_known: Whether the user stated the separator.
        fill: Whether to copy an empty setup or posture from the row above.
        points: Commanded points by posture, shape (3,), [m], for tables that state points instead
            of postures.

    Raises:
        SessionError: If a cell is not a number, has no unit, or is ambiguous; names the row.
    """
    require_unsplit_numbers(table, columns, separator_known=separator_known or decimal == "point")
    skipped: SkippedRows = []
    first_setup = next(iter(names["setup"]))
    lengths = list(_read_lengths(table, columns, skipped, fill, first_setup))
    sign = _decide_decimal_sign(table, lengths, decimal)
    setups, postures = (_names_by_fold(names[role]) for role in REQUIRED_NAMES)
    rows = _Rows(setups, postures, skipped)
    for length in lengths:
        if length.number is None:
            rows.skip(length)
            continue
        with errors_at(length.row.where):
            value = _parse_value(length, sign.sign)
            rows.add(length, value, _choose_unit(length, unit, table.header[length.column]))
    return LongTable(
        rows=rows.located(points or {}),
        missing=tuple(r for r in rows.missing if (r.line, r.cycle) not in rows.by_place),
        decimal=sign,
        units=tuple(rows.units),
        unit_assumed=any(c.number is not None and c.unit is None for c in lengths),
        skipped=tuple(skipped),
        renamed=tuple(rows.renamed.items()),
    )


@dataclass
class _Rows:
    """Accumulator of the rows of a long table; a point has several cells."""

    setups: NamesByFold
    """Setups of the session."""
    postures: NamesByFold
    """Postures of the session."""
    skipped: SkippedRows
    by_place: dict[tuple[int, str], RawReading] = field(default_factory=dict)
    """Rows by line and cycle."""
    missing: list[RawReading] = field(default_factory=list)
    commanded: dict[int, dict[Role, Decimal]] = field(default_factory=dict)
    """Coordinates of the commanded points by line, [mm]."""
    units: dict[UnitName, None] = field(default_factory=dict)
    renamed: dict[str, str] = field(default_factory=dict)

    def skip(self, length: LengthCell) -> None:
        """Record an empty cell."""
        row = self._with_session_names(length.row)
        if _is_known(row.setup, self.setups) and _is_known(row.posture, self.postures):
            self.missing.append(row)
        elif (row.line, NO_READING) not in self.skipped[-1:]:
            self.skipped.append((row.line, NO_READING))

    def add(self, length: LengthCell, value: Decimal, unit: UnitName) -> None:
        """Record a number."""
        row = self._with_session_names(length.row)
        names = ((getattr(length.row, k), getattr(row, k)) for k in ("setup", "posture", "minus"))
        self.renamed |= {old: new for old, new in names if old != new}
        self.units[unit] = None
        with localcontext(prec=2 * LONGEST_NUMBER):
            value *= UNITS[unit]
        if length.role in NOMINAL:
            self.commanded.setdefault(row.line, {})[length.role] = value
            return
        key = row.line, row.cycle
        cell: dict[str, Any] = {f"{length.role}_mm": format_mm(value)}
        self.by_place[key] = replace(self.by_place.get(key, row), **cell)

    def _with_session_names(self, row: RawReading) -> RawReading:
        """Row with the names in the session instead of those in the table."""
        return replace(
            row,
            setup=_session_name(row.setup, self.setups),
            posture=_session_name(row.posture, self.postures),
            minus=_session_name(row.minus, self.postures),
        )

    def located(self, points: Mapping[str, Array]) -> tuple[RawReading, ...]:
        """Rows in which commanded points are replaced by their postures.

        Args:
            points: Commanded points by posture, shape (3,), [m].
        """
        return tuple(
            replace(row, posture=_find_posture(self.commanded[row.line], points, row.where))
            if row.line in self.commanded
            else row
            for row in self.by_place.values()
        )


def _find_posture(
    commanded: Mapping[Role, Decimal], points: Mapping[str, Array], where: str
) -> str:
    """Posture of a commanded point.

    Args:
        commanded: Coordinates by role, [mm], without empty ones.
        points: Commanded points by posture, shape (3,), [m].
        where: File and row, for messages.

    Raises:
        SessionError: If the point is incomplete, or does not belong to exactly one posture.
    """
    missing = next((role for role in NOMINAL if role not in commanded), None)
    if missing is not None:
        raise SessionError(f"{missing} is empty; expected a commanded point", where=where)
    point = np.array([float(commanded[role]) for role in NOMINAL])
    postures = [n for n, p in points.items() if np.abs(p / MM - point).max() <= SAME_POINT_MM]
    if len(postures) != 1:
        owner = f"that of {' and '.join(postures[:3])}" if postures else "that of no posture"
        raise SessionError(
            f"the commanded point ({', '.join(f'{v:g}' for v in point)}) mm is {owner}; expected "
            f"one of the session within {SAME_POINT_MM:g} mm, from the mechanical zero",
            where=where,
        )
    return postures[0]


def _require_names(
    table: Table, row: Row, names: Mapping[Role, str], roles: Sequence[Role]
) -> None:
    """Refuse a row with a reading that lacks a name.

    Raises:
        SessionError: If a name is missing.
    """
    for role in roles:
        if not names[role]:
            total = any(_name(c).rstrip(":").casefold() in TOTALS for c in row.cells)
            advice = f"--fill copies the {role} from the row above"
            advice = "it seems to be a total of others: delete it" if total else advice
            raise SessionError(
                f"has a reading but no {role}; {advice}", where=table.place(row.line)
            )


def _read_lengths(
    table: Table, columns: Columns, skipped: SkippedRows, fill: bool, setup: str
) -> Iterator[LengthCell]:
    """Cells of the columns of readings and points, row by row.

    Args:
        table: The table.
        columns: Roles of its columns.
        skipped: Lines without a reading are appended to it.
        fill: Whether to copy an empty setup or posture from the row above.
        setup: Setup of all rows, if there is no column of setups.

    Raises:
        SessionError: If a cell of readings is merged, a name is missing, or units contradict.
    """
    for column, top, _ in table.merged:
        if column in columns.readings:
            raise SessionError(
                "is merged with cells below; expected one cell for each reading",
                where=table.place(top, column),
            )
    name_roles = [role for role in REQUIRED_NAMES if role in columns.single]
    measured = [i for i, h in columns.readings.items() if h.role not in NOMINAL]
    above = dict.fromkeys(REQUIRED_NAMES, "")
    rows, units_below = _without_units_row(table, columns, skipped)
    for row in rows:
        names = {role: _name(row.cell(columns.single.get(role))) for role in REQUIRED_NAMES}
        if "setup" not in name_roles:
            names["setup"] = setup
        filled_cells = [i for i in measured if not _is_missing(row.cell(i))]
        unheaded = sum(not c.is_blank for c in row.cells[len(table.header) :])
        if unheaded:
            cells = "1 cell" if unheaded == 1 else f"{unheaded} cells"
            skipped.append((row.line, f"{cells} without a heading"))
        complete = all(names[role] for role in name_roles)
        if fill:  # also from a row that states a name only
            names = above = {role: name or above[role] for role, name in names.items()}
        # a row without a reading is skipped unless it states all names itself
        if not filled_cells and not complete:
            skipped.append((row.line, NO_READING))
            continue
        _require_names(table, row, names, name_roles)
        optional = _read_optional_cells(table, row, columns) | names
        for i, heading in _length_columns(columns, filled_cells).items():
            where = table.place(row.line, i)
            cycle = {} if heading.cycle is None else {"cycle": str(heading.cycle)}
            length = LengthCell(
                RawReading(where, row.line, **{**optional, **cycle}), i, heading.role, None
            )
            if _is_missing(row.cell(i)):
                if heading.role not in NOMINAL:
                    yield length
                continue
            with errors_at(where):
                number, value, unit = _read_number(row.cell(i))
                stated = heading.unit or units_below.get(i)
                if unit and stated and unit != stated:
                    raise SessionError(f"the reading is in {unit}, and its heading says {stated}")
            yield replace(length, number=number, value=value, unit=unit or stated)


def _without_units_row(
    table: Table, columns: Columns, skipped: SkippedRows
) -> tuple[Iterable[Row], dict[int, UnitName]]:
    """Rows below the headings without a row of units, and these units by column."""
    rows = table.fill_merged(columns.single.values())
    first = next(rows, None)
    if first is None:
        return rows, {}
    units = _read_units_row(first, columns)
    if not units:
        return chain([first], rows), {}
    skipped.append((first.line, "units"))
    return rows, units


def _length_columns(columns: Columns, filled: Sequence[int]) -> dict[int, Heading]:
    """Columns of lengths that belong to a row: those of its point, or of its readings.

    A reading beside a point remains. The session then refuses the row of the point.

    Args:
        columns: Roles of the columns.
        filled: Indices of the columns with a number in this row.
    """
    is_point = any(columns.readings[i].role in POINT for i in filled)
    if not filled:
        is_point = not any(h.role == "reading" for h in columns.readings.values())
    excluded: tuple[Role, ...] = ("reading",) if is_point else POINT
    return {i: h for i, h in columns.readings.items() if h.role not in excluded or i in filled}


def _read_optional_cells(table: Table, row: Row, columns: Columns) -> dict[str, str]:
    """Cells of a row in the optional columns of a readings.csv."""
    cells = {role: row.cell(columns.single.get(role)) for role in SINGLE}
    temperature = columns.single.get("temperature")
    return {
        "minus": _name(cells["minus"]),
        "cycle": _name(cells["cycle"]),
        "approach": _name(cells["approach"]).casefold(),
        "temperature_C": (
            "" if temperature is None else _read_temperature(table, row, temperature)
        ),
        "time": read_time(cells["time"].text),
    }


def _read_temperature(table: Table, row: Row, column: int) -> str:
    """Temperature of a row in °C; empty for a dash.

    Other text that is not a number is returned unchanged.

    Raises:
        SessionError: If the temperature may be in °C or °F.
    """
    cell = row.cell(column)
    text = _name(cell)
    number, unit = split_degrees(text)
    degrees = unit or split_degrees(cell.unit)[1] or split_degrees(table.header[column])[1]
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
    """Date and time in the form of ISO 8601, converted from a date such as 14.03.2025.

    Other text is returned unchanged.
    """
    text = text.strip()
    day = _DAY_FIRST.match(text)
    return text if day is None else f"{day[3]}-{day[2]:0>2}-{day[1]:0>2}T{day[4]:0>2}{day[5]}"


def _read_units_row(row: Row, columns: Columns) -> dict[int, UnitName]:
    """Units by column, if a row below the headings contains units only; empty otherwise."""
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
    if len(cell.text) > 2 * LONGEST_NAME:  # normalising needs quadratic time
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


def _read_number(cell: Cell) -> tuple[str, Decimal | None, UnitName | None]:
    """Text, value and unit of the number of a cell; value and unit are None if not known.

    Raises:
        SessionError: If the cell is a date, a Boolean, an unsaved formula or a percentage.
    """
    if cell.kind in _NOT_A_NUMBER:
        raise SessionError(f"the reading {_NOT_A_NUMBER[cell.kind].format(shorten(cell.text))}")
    if cell.kind == "number":
        return cell.text, cell.number, parse_unit(cell.unit)
    text = tidy_text(cell.text)
    match = _NUMBER_AND_WORD.fullmatch(text) if len(text) <= 2 * LONGEST_NUMBER else None
    unit = parse_unit(match[2]) if match else None
    return (match[1], None, unit) if match and unit else (text, None, None)


def _decide_decimal_sign(
    table: Table, lengths: list[LengthCell], stated: Sign | None
) -> DecimalSign:
    if stated is not None:
        return DecimalSign(stated, None)
    numerals = [
        Numeral(c.number, c.row.line) for c in lengths if c.number is not None and c.value is None
    ]
    return decide_decimal_sign(
        numerals,
        standard=has_standard_headings(table.header),
        advice=SIGN_ADVICE,
        place=table.place,
    )


def _parse_value(length: LengthCell, sign: Sign) -> Decimal:
    """Number of a cell in the cell's unit."""
    if length.value is not None:
        return length.value
    number = length.number or ""
    value = parse_numeral(number, sign)
    if value is None:
        hint = ""
        if any(parse_numeral(number, s) is not None for s in ("point", "comma")):
            hint = f" with a decimal {sign}"
        raise SessionError(f"the reading is '{shorten(number)}'; expected a number{hint}")
    return value


def _choose_unit(length: LengthCell, stated: UnitName | None, heading: str) -> UnitName:
    """Unit of a cell or its heading, or the unit of the option `--unit`."""
    if stated and length.unit and stated != length.unit:
        raise SessionError(f"the reading is in {length.unit}, which contradicts --unit {stated}")
    unit = length.unit or stated
    if unit is None:
        raise SessionError(
            f"neither the heading '{shorten(' '.join(heading.split()))}' nor the cell has a unit; "
            "state it by --unit mm, um, inch or hundredths"
        )
    return unit


def _fold(name: str) -> str:
    """Name in lower case with underscores instead of blanks."""
    if len(name) > 2 * LONGEST_NAME:
        return name
    return "_".join(plain_minus(composed(name)).casefold().split())


def _names_by_fold(names: Iterable[str]) -> dict[str, list[str]]:
    """Names in the session by folded name."""
    by_fold: dict[str, list[str]] = {}
    for name in names:
        by_fold.setdefault(_fold(name), []).append(name)
    return by_fold


def _is_known(name: str, by_fold: NamesByFold) -> bool:
    """True for a name in the session."""
    return name in by_fold.get(_fold(name), ())


def _session_name(written: str, by_fold: NamesByFold) -> str:
    """Name in the session for a name in the table.

    The name in the table is returned if no name or several names differ from it in case and blanks
    only.
    """
    same = by_fold.get(_fold(written), ())
    return same[0] if len(same) == 1 else written
