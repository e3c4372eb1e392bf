"""A table of readings to one row a reading: names of the session, mm, nothing left open.

Cycles that stand side by side are put below each other; rows that are of no reading are left out,
and it is said which and why.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from decimal import Decimal, localcontext
from itertools import islice

from orthocal.errors import SessionError
from orthocal.io.strict_yaml import LONGEST_NUMBER
from orthocal.io.tables.cell import Cell, Row, column_letters
from orthocal.io.tables.numerals import (
    DecimalSign,
    Seen,
    Sign,
    is_unread,
    parse_numeral,
    plain_minus,
    tidy_text,
)
from orthocal.io.tables.table import Table
from orthocal.measurement.files.readings_checks import RawReading
from orthocal.measurement.files.readings_file import (
    decide_sign,
    is_house,
    mm_text,
    require_whole_cells,
)
from orthocal.measurement.importing.headings import (
    UNITS,
    Columns,
    ReadingColumn,
    UnitName,
    parse_unit,
)
from orthocal.text import composed, shorten

NO_READING = "no reading"

LeftOut = list[tuple[int, str]]
"""Lines that are of no reading, and why."""

ASK_SIGN = "say which: --decimal comma or --decimal point"

_NUMBER_AND_WORD = re.compile(r"(.*[0-9.,])\s*([^0-9.,\s].*)", re.S)


@dataclass(frozen=True, slots=True)
class Entry:
    """A cell that says a reading, and what its row says of it."""

    line: int
    column: ReadingColumn
    setup: str
    posture: str
    minus: str
    cycle: str
    read: bool
    """Whether something stands there."""
    number: str
    """Text without its unit."""
    value: Decimal | None
    """Of a workbook's number."""
    unit: UnitName | None


@dataclass(frozen=True, slots=True)
class LongTable:
    """The readings of a table, in its order, and how they were understood."""

    rows: tuple[RawReading, ...]
    unread: tuple[RawReading, ...]
    """Those whose cell is empty."""
    decimal: DecimalSign
    decimal_said: bool
    units: tuple[UnitName, ...]
    """Those that there are."""
    unit_said: bool
    """Whether the unit is from an option."""
    left_out: tuple[tuple[int, str], ...]
    renamed: tuple[tuple[str, str], ...]
    """Names as they stand in the table, where they are others in the session, and these."""


def make_long(
    table: Table,
    columns: Columns,
    *,
    names: Mapping[str, Iterable[str]],
    decimal: Sign | None = None,
    unit: UnitName | None = None,
    separator_said: bool = False,
    fill: bool = False,
) -> LongTable:
    """One row a reading.

    Args:
        table: The table.
        columns: Which column is what.
        names: The session's names of `setup` and `posture`; capitals and blanks for underscores
            make no difference.
        decimal: The decimal sign, where it is said.
        unit: The unit of readings that state none.
        separator_said: Whether it was said what separates the cells.
        fill: Whether an empty setup or posture is the one above.

    Raises:
        SessionError: Naming the row, for what is no number, has no unit, or may be two things.
    """
    require_whole_cells(table, columns, sure=separator_said or decimal == "point")
    left_out: LeftOut = []
    entries = list(_entries(table, columns, left_out, fill))
    sign = _sign(table, entries, decimal)
    lookup = {role: _folded(list(known)) for role, known in names.items()}
    renamed: dict[str, str] = {}
    units: dict[UnitName, bool] = {}
    rows, unread = [], []
    for entry in entries:
        where = table.place(entry.line, entry.column.index)
        meant = {
            "setup": _rename(entry.setup, lookup["setup"]),
            "posture": _rename(entry.posture, lookup["posture"]),
            "minus": _rename(entry.minus, lookup["posture"]),
        }
        row = RawReading(where=where, line=entry.line, cycle=entry.cycle, reading="", **meant)
        if not entry.read:
            if row.setup in lookup["setup"] and row.posture in lookup["posture"]:
                unread.append(row)
            elif (entry.line, NO_READING) not in left_out[-1:]:
                left_out.append((entry.line, NO_READING))
            continue
        renamed.update(
            {
                w: m
                for w in (entry.setup, entry.posture, entry.minus)
                for m in meant.values()
                if _fold(w) == _fold(m) and w != m
            }
        )
        value = _number(entry, sign.sign, where)
        own = _unit(entry, unit, where, table.header[entry.column.index])
        units[own] = units.get(own, False) or entry.unit is None
        with localcontext(prec=2 * LONGEST_NUMBER):
            text = mm_text(value * UNITS[own])
        rows.append(replace(row, reading=text))
    return LongTable(
        rows=tuple(rows),
        unread=tuple(unread),
        decimal=sign,
        decimal_said=decimal is not None,
        units=tuple(units),
        unit_said=any(units.values()),
        left_out=tuple(left_out),
        renamed=tuple(renamed.items()),
    )


def _entries(table: Table, columns: Columns, left_out: LeftOut, fill: bool) -> Iterator[Entry]:
    """Cells that hold a reading."""
    indices = [r.index for r in columns.readings]
    for column, spans in table.spans(indices).items():
        raise SessionError(
            "is merged with cells below; expected a cell for each reading",
            where=table.place(spans[0][0], column),
        )
    above = {"setup": "", "posture": ""}
    below_unit: dict[int, UnitName] = {}
    rows = table.filled(columns.keys)
    first = next(rows, None)
    if first is not None:
        found = _units_row(first, columns)
        if found:
            below_unit = found
            left_out.append((first.line, "units"))
        else:
            rows = _chain(first, rows)
    for row in rows:
        setup, posture = (_name(row.cell(i)) for i in (columns.setup, columns.posture))
        read = [r for r in columns.readings if not _is_unread(row.cell(r.index))]
        beyond = [c for c in row.cells[len(table.header) :] if not c.is_blank]
        if beyond:
            left_out.append((row.line, f"{len(beyond)} cells without a heading"))
        if not read and not (setup and posture):
            left_out.append((row.line, NO_READING))
            continue
        if fill:
            setup, posture = setup or above["setup"], posture or above["posture"]
            above = {"setup": setup, "posture": posture}
        for role, name in (("setup", setup), ("posture", posture)):
            if not name:
                raise SessionError(
                    f"has a reading, and its {role} is empty; --fill takes the {role} above",
                    where=table.place(row.line),
                )
        minus, cycle = (_name(row.cell(i)) for i in (columns.minus, columns.cycle))
        for r in columns.readings:
            where = table.place(row.line, r.index)
            number, value, own = (
                _reading(row.cell(r.index), where) if r in read else ("", None, None)
            )
            stated = r.unit or below_unit.get(r.index)
            if own and stated and own != stated:
                raise SessionError(
                    f"the reading is in {own}, and its heading says {stated}", where=where
                )
            numbered = cycle if r.cycle is None else str(r.cycle)
            names = (setup, posture, minus, numbered)
            yield Entry(row.line, r, *names, r in read, number, value, own or stated)


def _chain(first: Row, rest: Iterator[Row]) -> Iterator[Row]:
    yield first
    yield from rest


def _units_row(row: Row, columns: Columns) -> dict[int, UnitName]:
    """Units below the headings of readings, where the first row holds units alone."""
    if any(_name(row.cell(i)) for i in columns.keys):
        return {}
    found: dict[int, UnitName] = {}
    for r in columns.readings:
        text = tidy_text(row.cell(r.index).text).strip("[]()")
        unit = parse_unit(text)
        if text and unit is None:
            return {}
        if unit is not None:
            if r.unit is not None and r.unit != unit:
                return {}
            found[r.index] = unit
    return found


def _name(cell: Cell) -> str:
    """A name, or nothing: a dash alone is none."""
    text = composed(" ".join(tidy_text(cell.text).split()))
    return "" if text in ("-", "–", "—", "−") else text


def _is_unread(cell: Cell) -> bool:
    return cell.kind == "text" and is_unread(cell.text)


_NO_NUMBER = {
    "date": "is the date {}; expected a number: the spreadsheet took what was typed for a date",
    "truth": "is {}; expected a number",
    "unsaved": "is a formula{} whose value was not saved: open the table in a spreadsheet program "
    "and save it",
    "shown otherwise": "is shown as a percentage or in thousands, and is {}; give its cell the "
    "format of a plain number",
}


def _reading(cell: Cell, where: str) -> tuple[str, Decimal | None, UnitName | None]:
    """Text, number and unit of a cell.

    Raises:
        SessionError: If it is no number, whatever the decimal sign.
    """
    if cell.kind in _NO_NUMBER:
        raise SessionError(
            f"the reading {_NO_NUMBER[cell.kind].format(shorten(cell.text))}", where=where
        )
    if cell.kind == "number":
        return cell.text, cell.number, parse_unit(cell.unit)
    text = tidy_text(cell.text)
    found = _NUMBER_AND_WORD.fullmatch(text)
    unit = parse_unit(found[2]) if found else None
    if found and unit is not None:
        return found[1], None, unit
    return text, None, None


def _sign(table: Table, entries: list[Entry], said: Sign | None) -> DecimalSign:
    if said is not None:
        return DecimalSign(said, None)
    cells = [Seen(e.number, e.line) for e in entries if e.value is None]
    return decide_sign(cells, house=is_house(table.header), ask=ASK_SIGN, place=table.place)


def _number(entry: Entry, sign: Sign | None, where: str) -> Decimal:
    if entry.value is not None:
        return entry.value
    value = parse_numeral(entry.number, sign or "point")
    if value is None:
        hint = ""
        if any(parse_numeral(entry.number, s) is not None for s in ("point", "comma")):
            hint = f" with a decimal {sign}"
        raise SessionError(
            f"the reading is '{shorten(entry.number)}'; expected a number{hint}", where=where
        )
    return value


def _unit(entry: Entry, said: UnitName | None, where: str, heading: str) -> UnitName:
    heading = shorten(" ".join(heading.split()))
    if entry.unit is None:
        if said is None:
            raise SessionError(
                f"neither the heading '{heading}' nor the cell says a unit; say it: --unit mm, um "
                "or inch",
                where=where,
            )
        return said
    if said is not None and said != entry.unit:
        raise SessionError(f"the reading is in {entry.unit}, and --unit says {said}", where=where)
    return entry.unit


def _fold(name: str) -> str:
    return "_".join(plain_minus(composed(name)).casefold().split())


def _folded(names: list[str]) -> dict[str, str]:
    """Names by themselves, and by what is the same but for capitals and blanks, if it is one's."""
    folded: dict[str, list[str]] = {}
    for name in names:
        folded.setdefault(_fold(name), []).append(name)
    alike = {key: found[0] for key, found in folded.items() if len(found) == 1}
    return {**alike, **{name: name for name in names}}


def _rename(written: str, known: Mapping[str, str]) -> str:
    """The session's name; what is none of its names stays as it is."""
    return known.get(written) or known.get(_fold(written)) or written


def describe_column(table: Table, index: int) -> str:
    """A column by its heading, or by its letter where it has none."""
    heading = " ".join(table.header[index].split()) if index < len(table.header) else ""
    return f"'{heading}'" if heading else column_letters(index)


def list_lines(left_out: Iterable[tuple[int, str]], *, most: int = 8) -> str:
    """Lines in words: `3, 7-12`; some of many."""
    lines = sorted({line for line, _ in left_out})
    spans: list[list[int]] = []
    for line in lines:
        if spans and line == spans[-1][1] + 1:
            spans[-1][1] = line
        else:
            spans.append([line, line])
    shown = [str(a) if a == b else f"{a}-{b}" for a, b in islice(spans, most)]
    return ", ".join(shown) + (f" and {len(spans) - most} more" if len(spans) > most else "")
