"""Readings of any table into a session: rows matched by setup, posture, minus and cycle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import cast, get_args

from orthocal.arguments import require_kind
from orthocal.errors import SessionError
from orthocal.io.files import content_withheld_outside, exists, read_file, write_file
from orthocal.io.tables.numerals import Sign
from orthocal.io.tables.table import Table, read_table
from orthocal.measurement.files.readings_checks import RawReading, check_readings, parse_cycle
from orthocal.measurement.files.readings_file import read_rows
from orthocal.measurement.files.session_file import check_contacts, load_unread
from orthocal.measurement.files.write_session import COLUMNS
from orthocal.measurement.importing.headings import (
    EXPECTED,
    UNITS,
    Columns,
    UnitName,
    choose_columns,
    find_header,
    require_role,
)
from orthocal.measurement.importing.long_table import LongTable, make_long

Key = tuple[str, str, str, int]
"""Setup, posture, minus and cycle of a reading."""


@dataclass(frozen=True, slots=True)
class TableOptions:
    """What a table does not say itself."""

    sheet: str | None = None
    """Name of the sheet of a workbook."""
    separator: str | None = None
    """semicolon, tab, comma or pipe."""
    decimal: str | None = None
    """comma or point."""
    unit: str | None = None
    """mm, um, inch, cm or thou: of readings that state none."""
    encoding: str | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    """Role, such as `reading` or `reading 2`, to the heading of its column, or its number (#4)."""
    fill: bool = False
    """Whether an empty setup or posture is the one above."""


@dataclass(frozen=True, slots=True, eq=False)
class TableImport:
    """Readings of a table, and what a session's readings.csv is with them."""

    table: Table
    columns: Columns
    long: LongTable
    session: Path
    """The session.yaml."""
    readings_path: Path
    text: str
    """Of the readings.csv."""
    filled: int
    """Readings whose cell was empty."""
    replaced: int
    unchanged: int
    """Readings that were there already, the same."""
    added: int
    """Readings that had no row."""
    empty: int
    """Rows that have no reading still."""

    @property
    def changes(self) -> bool:
        """Whether anything is new."""
        return bool(self.filled or self.replaced or self.added)


def import_readings(
    table: str | Path,
    session: str | Path,
    options: TableOptions | None = None,
    *,
    overwrite: bool = False,
) -> TableImport:
    """Read a table for a session; nothing is written yet.

    Args:
        table: A CSV of any spreadsheet, or an .xlsx.
        session: The session.yaml, or the folder that holds it; its readings.csv may be missing, or
            have cells that are empty.
        options: What the table does not say itself.
        overwrite: Whether readings that are there may become others.

    Raises:
        SessionError: Naming file and row, what was found and what was expected; also where two
            readings are possible, with the option that decides.
    """
    options = options or TableOptions()
    require_kind(options, TableOptions, expected="TableOptions")
    _check_options(options)
    path = Path(table)
    plan, readings_path = load_unread(session)
    found = read_table(
        path,
        read_file(path, error=SessionError),
        lambda rows: find_header(rows, options.columns),
        expected=EXPECTED,
        sheet=options.sheet,
        separator=options.separator,
        encoding=options.encoding,
    )
    columns = choose_columns(found.header, options.columns, where=found.place(found.header_line))
    long = make_long(
        found,
        columns,
        names={"setup": plan.setups, "posture": plan.postures},
        decimal=cast("Sign | None", options.decimal),
        unit=cast("UnitName | None", options.unit),
        separator_said=options.separator is not None,
        fill=options.fill,
    )
    check_readings(long.rows, plan, file=path)
    with content_withheld_outside((plan.path or Path(session)).parent, readings_path):
        there = _existing(readings_path, path, long, overwrite)
        if there:
            check_readings(there, plan, file=readings_path, unread=set())
    merged = _merge(there, long.rows, readings_path, overwrite)
    text = _house_text(merged.rows)
    again = read_rows(readings_path, text.encode())
    readings = check_readings(again, plan, file=readings_path, unread=set())
    check_contacts(replace(plan, readings=readings))
    return TableImport(
        table=found,
        columns=columns,
        long=long,
        session=plan.path or Path(session),
        readings_path=readings_path,
        text=text,
        filled=merged.filled,
        replaced=merged.replaced,
        unchanged=merged.unchanged,
        added=merged.added,
        empty=sum(not r.reading for r in merged.rows),
    )


def write_import(found: TableImport) -> None:
    """Write the readings.csv of a session, whole or not at all.

    Raises:
        OrthocalError: If it cannot be written.
    """
    write_file(found.readings_path, found.text)


def _check_options(options: TableOptions) -> None:
    if options.decimal is not None and options.decimal not in get_args(Sign):
        raise SessionError(
            f"'{options.decimal}' is no decimal sign; expected comma or point", where="--decimal"
        )
    if options.unit is not None and options.unit not in UNITS:
        raise SessionError(
            f"'{options.unit}' is no unit of readings; expected {', '.join(UNITS)}", where="--unit"
        )
    for key in options.columns:
        require_role(key)


def _existing(
    readings_path: Path, table: Path, long: LongTable, overwrite: bool
) -> list[RawReading]:
    """Rows of the session's readings.csv, where there is one.

    Raises:
        SessionError: If it is the table itself, and is not to be written over.
    """
    if not exists(readings_path):
        return []
    if readings_path.resolve() != table.resolve():
        content = read_file(readings_path, error=SessionError)
        return list(read_rows(readings_path, content)) if content.strip() else []
    if not overwrite:
        raise SessionError(
            "is the session's own table; --replace writes it anew, with its readings alone",
            where=str(table),
        )
    rows = [replace(row, reading="") for row in (*long.rows, *long.unread)]
    return sorted(rows, key=lambda row: row.line)


@dataclass(frozen=True, slots=True)
class _Merged:
    rows: Sequence[RawReading]
    filled: int
    replaced: int
    unchanged: int
    added: int


def _key(row: RawReading) -> Key:
    return row.setup, row.posture, row.minus, parse_cycle(row.cycle, row.where)


def _merge(
    there: Sequence[RawReading], new: Sequence[RawReading], file: Path, overwrite: bool
) -> _Merged:
    """Rows in the session's order, with the new readings in their cells; others at the end."""
    pending = {_key(row): row for row in new}
    rows: list[RawReading] = []
    filled = replaced = unchanged = 0
    differing: list[tuple[RawReading, RawReading]] = []
    for row in there:
        given = pending.pop(_key(row), None)
        if given is None:
            rows.append(row)
        elif not row.reading:
            filled += 1
            rows.append(replace(row, reading=given.reading))
        elif _same(row.reading, given.reading):
            unchanged += 1
            rows.append(row)
        else:
            replaced += 1
            differing.append((row, given))
            rows.append(replace(row, reading=given.reading))
    if differing and not overwrite:
        row, given = differing[0]
        more = f", as {len(differing) - 1} more" if len(differing) > 1 else ""
        raise SessionError(
            f"{row.setup} {row.posture} of cycle {row.cycle or 1} is {given.reading} mm in "
            f"{given.where}, and {row.reading} mm here{more}; --replace writes over what is there",
            where=row.where,
        )
    rows += pending.values()
    return _Merged(rows, filled, replaced, unchanged, len(pending))


def _same(a: str, b: str) -> bool:
    try:
        return Decimal(a) == Decimal(b)
    except InvalidOperation:
        return False


def _house_text(rows: Sequence[RawReading]) -> str:
    """A readings.csv; columns that no row needs are left out."""
    needed = {
        "minus": any(r.minus for r in rows),
        "cycle": any(r.cycle not in ("", "1") for r in rows),
    }
    columns = [c for c in COLUMNS if needed.get(c, True)]
    lines = [",".join(columns)]
    for r in rows:
        cells = {
            "setup": r.setup,
            "posture": r.posture,
            "minus": r.minus,
            "cycle": r.cycle or "1",
            "reading_mm": r.reading,
        }
        lines.append(",".join(cells[c] for c in columns))
    return "\n".join(lines) + "\n"
