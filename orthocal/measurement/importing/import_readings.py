"""Import of the readings of a table into a session."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, cast, get_args

from orthocal.arguments import require_kind
from orthocal.errors import SessionError
from orthocal.io.files import content_withheld_outside, exists, read_file, write_file
from orthocal.io.tables.numerals import Sign
from orthocal.io.tables.table import Table, read_table
from orthocal.measurement.files.point_rows import PointRows
from orthocal.measurement.files.readings_checks import (
    check_readings,
    parse_cycle,
    parse_row,
    parse_time,
)
from orthocal.measurement.files.readings_file import (
    CONDITIONS,
    COORDINATES,
    REQUIRED,
    REQUIRED_OF_POINTS,
    RawReading,
    format_readings,
    read_rows,
)
from orthocal.measurement.files.session_file import check_contacts, load_unread
from orthocal.measurement.importing.headings import (
    EXPECTED,
    EXPECTED_POINTS,
    UNITS,
    Columns,
    UnitName,
    choose_columns,
    find_header,
    parse_role,
)
from orthocal.measurement.importing.long_table import LongTable, make_long_table, read_time
from orthocal.session.session import Conditions, Reading, Session
from orthocal.text import shorten

Key = tuple[str, str, str, int]
"""Setup, posture, minus and cycle of a reading."""


@dataclass(frozen=True, slots=True)
class TableOptions:
    """Options that resolve ambiguities of a table."""

    sheet: str | None = None
    """Worksheet of a workbook; by default the only one with readings."""
    separator: str | None = None
    """semicolon, tab, comma or pipe; detected by default."""
    decimal: str | None = None
    """Decimal sign, comma or point; inferred by default."""
    unit: str | None = None
    """Unit of readings without a unit: mm, um, inch, cm, thou or hundredths (of a mm)."""
    encoding: str | None = None
    """Encoding of a text file; detected by default."""
    columns: Mapping[str, str] = field(default_factory=dict)
    """Heading of a column, or its number (#4), by role, such as `reading` or `reading 2`."""
    fill: bool = False
    """True to copy an empty setup or posture from the row above."""


@dataclass(frozen=True, slots=True, eq=False)
class TableImport:
    """Readings of a table, merged into the readings.csv of a session."""

    options: TableOptions
    table: Table
    columns: Columns
    long_table: LongTable
    session: Path
    """Path of the session.yaml."""
    readings_path: Path
    text: str
    """New content of the readings.csv."""
    filled: int
    """Number of rows that receive a reading or further conditions."""
    replaced: int
    """Number of readings whose value or conditions change."""
    unchanged: int
    """Number of readings that the session already has."""
    unplanned: tuple[int, ...]
    """Rows of the table that the readings.csv does not have."""
    empty: int
    """Number of rows still without a reading."""

    @property
    def added(self) -> int:
        """Number of new rows."""
        return len(self.unplanned)

    @property
    def changes(self) -> bool:
        """True if the readings.csv changes."""
        return bool(self.filled or self.replaced or self.added)


def import_readings(
    table: str | Path,
    session: str | Path,
    options: TableOptions | None = None,
    *,
    overwrite: bool = False,
) -> TableImport:
    """Read a table and merge its readings into those of a session; writes nothing.

    Rows match by setup, posture, minus and cycle, and by approach where both state one.

    Args:
        table: A CSV file of any spreadsheet program, or an .xlsx workbook.
        session: The session.yaml or its directory. Its readings.csv may be missing or incomplete.
        options: Options that resolve ambiguities of the table.
        overwrite: Whether to replace readings of the session that differ.

    Raises:
        SessionError: If a row is wrong or ambiguous; names file and row, the expected content, and
            the option that resolves an ambiguity.
    """
    options = options or TableOptions()
    require_kind(options, TableOptions, expected="TableOptions")
    _check_options(options)
    path = Path(table)
    plan, readings_path = load_unread(session)
    content, columns, long_table = _read_long_table(path, plan, options)
    _, points = check_readings(long_table.rows, plan, file=path)
    new = [(row, parse_row(row, plan, points)) for row in long_table.rows]
    with content_withheld_outside((plan.path or Path(session)).parent, readings_path):
        existing = [
            (row, parse_row(row, plan, points))
            for row in _read_existing(readings_path, path, long_table, overwrite)
        ]
    merged, added, counts = _merge(existing, new, overwrite)
    readings, points = check_readings(merged, plan, file=readings_path)
    check_contacts(replace(plan, readings=readings, setups=points.setups, gauges=points.gauges))
    required = {
        c for row in merged for c in (REQUIRED_OF_POINTS if points.is_point(row) else REQUIRED)
    }
    return TableImport(
        options=options,
        table=content,
        columns=columns,
        long_table=long_table,
        session=plan.path or Path(session),
        readings_path=readings_path,
        text=format_readings(merged, required=required),
        filled=counts["filled"],
        replaced=counts["replaced"],
        unchanged=counts["unchanged"],
        unplanned=tuple(row.line for row in added),
        empty=sum(not _is_filled(row) for row in merged),
    )


def _read_long_table(
    path: Path, plan: Session, options: TableOptions
) -> tuple[Table, Columns, LongTable]:
    """Table of a file, the roles of its columns, and its long form."""
    points = PointRows(plan)
    content = read_table(
        path,
        read_file(path, error=SessionError),
        lambda rows: find_header(rows, options.columns, points=points.has_points),
        expected=EXPECTED_POINTS if points.has_points else EXPECTED,
        sheet=options.sheet,
        separator=options.separator,
        encoding=options.encoding,
    )
    columns = choose_columns(
        content.header,
        options.columns,
        where=content.place(content.header_line),
        points=points.has_points,
        one_setup=points.has_points and len(points.names) == 1,
    )
    if "time" not in options.columns:
        columns = _without_clock_times(content, columns)
    long_table = make_long_table(
        content,
        columns,
        names={"setup": points.names, "posture": plan.postures},
        decimal=cast("Sign | None", options.decimal),
        unit=cast("UnitName | None", options.unit),
        separator_known=options.separator is not None,
        fill=options.fill,
        points={
            n: p.values for n, p in plan.postures.items() if p.form == "tcp" and p.values.size == 3
        },
    )
    return content, columns, long_table


def write_import(result: TableImport) -> None:
    """Write the readings.csv of a session atomically.

    Raises:
        OrthocalError: If the file cannot be written.
    """
    write_file(result.readings_path, result.text)


def _check_options(options: TableOptions) -> None:
    """Refuse an unknown decimal sign, unit or role of a column."""
    for value, expected, option, kind in (
        (options.decimal, get_args(Sign), "--decimal", "decimal sign"),
        (options.unit, tuple(UNITS), "--unit", "unit of readings"),
    ):
        if value is not None and value not in expected:
            raise SessionError(
                f"'{shorten(value)}' is not a {kind}; expected {', '.join(expected)}", where=option
            )
    for key in options.columns:
        parse_role(key)


def _without_clock_times(table: Table, columns: Columns) -> Columns:
    """Columns without a column of times that lack a date, such as those of a clock."""
    time_column = columns.single.get("time")
    if time_column is None:
        return columns
    texts = (read_time(row.cell(time_column).text) for row in table.rows)
    try:
        for text in texts:
            if text:
                parse_time(text)
    except SessionError:
        single = {role: i for role, i in columns.single.items() if i != time_column}
        return replace(columns, single=single, extra=tuple(sorted((*columns.extra, time_column))))
    return columns


def _read_existing(
    readings_path: Path, table: Path, long_table: LongTable, overwrite: bool
) -> list[RawReading]:
    """Rows of the session's readings.csv; empty if there is no such file.

    Raises:
        SessionError: If the table itself is this file and must not be overwritten.
    """
    if not exists(readings_path):
        return []
    if readings_path.resolve() != table.resolve():
        content = read_file(readings_path, error=SessionError)
        return list(read_rows(readings_path, content)) if content.strip() else []
    if not overwrite:
        raise SessionError(
            "is the session's own table; --replace rewrites it with its readings only",
            where=str(table),
        )
    empty: dict[str, Any] = dict.fromkeys(VALUES, "")
    rows = [replace(row, **empty) for row in (*long_table.rows, *long_table.missing)]
    return sorted(rows, key=lambda row: row.line)


VALUES = ("reading_mm", *COORDINATES)
"""Columns of measured values."""

_Row = tuple[RawReading, Sequence[Reading]]
"""Text of a row, and its reading or the three readings of a point."""


def _is_filled(row: RawReading) -> bool:
    """True if a row has a reading or a point."""
    return any(getattr(row, column) for column in VALUES)


def _key(row: RawReading) -> Key:
    return row.setup, row.posture, row.minus, parse_cycle(row.cycle)


def _merge(
    existing: Sequence[_Row], new: Sequence[_Row], overwrite: bool
) -> tuple[list[RawReading], list[RawReading], Counter[str]]:
    """Merge new readings into the existing rows; further readings follow at the end.

    Returns:
        All rows, the added ones, and the numbers of filled, replaced and unchanged rows.

    Raises:
        SessionError: If a reading or a condition differs and must not be overwritten.
    """
    pending: dict[Key, list[_Row]] = {}
    for row in new:
        pending.setdefault(_key(row[0]), []).append(row)
    existing_counts = Counter(_key(text) for text, _ in existing)
    rows: list[RawReading] = []
    rows_by_key: dict[Key, list[RawReading]] = {}
    counts: Counter[str] = Counter()
    differing: list[_Row] = []
    for row in existing:
        key = _key(row[0])
        match = _match(row[0], pending.get(key, []), unique=existing_counts[key] == 1)
        merged = row[0]
        if match is not None:
            pending[key].remove(match)
            change = _change(row, match)
            counts[change] += 1
            if change == "replaced" and not differing:
                differing = [row, match]
            merged = merged if change == "unchanged" else _update(merged, match[0])
        rows.append(merged)
        rows_by_key.setdefault(key, []).append(merged)
    if differing and not overwrite:
        (first, _), (other, _) = differing
        more = counts["replaced"] - 1
        raise SessionError(
            f"{first.setup} {first.posture} of cycle {first.cycle or 1} is {_describe(first)}, but "
            f"{_describe(other)} in {other.where}{f' ({more} more differ)' if more else ''}; "
            "--replace overwrites existing readings",
            where=first.where,
        )
    added = [row for rows_of_key in pending.values() for row, _ in rows_of_key]
    for text in added:
        _check_approach(text, rows_by_key.get(_key(text), []))
    return [*rows, *added], added, counts


def _check_approach(row: RawReading, existing: Sequence[RawReading]) -> None:
    """Refuse a new row that lacks an approach, or is approached from another side than planned.

    Args:
        row: The new row.
        existing: Rows of the session with its setup, postures and cycle.

    Raises:
        SessionError: If the session reads its posture from several sides, or plans another one.
    """
    reading, sides = f"{row.setup} {row.posture} of cycle {row.cycle or 1}", []
    for other in existing:
        sides.append(other.approach)
        directions = map(set, zip(row.approach, other.approach, strict=False))
        if not _is_filled(other) and {"p", "n"} in directions:
            raise SessionError(
                f"{reading} is approached with '{row.approach}', but {other.where} plans "
                f"'{other.approach}'; correct one of them, p where the drive coordinate grows and "
                "n where it falls",
                where=row.where,
            )
    if not row.approach and len(sides) > 1 and all(sides):
        raise SessionError(
            f"{reading} is read from several sides ({', '.join(sides)}); expected a column "
            "'approach' that states which",
            where=row.where,
        )


def _match(row: RawReading, candidates: Sequence[_Row], *, unique: bool) -> _Row | None:
    """New reading of an existing row: the one with its approach, or a single one without approach.

    Args:
        row: The existing row.
        candidates: New rows with its setup, postures and cycle.
        unique: Whether no other existing row has this setup, these postures and this cycle.
    """
    for candidate in candidates:
        if candidate[0].approach == row.approach:
            return candidate
    if unique and len(candidates) == 1 and not (row.approach and candidates[0][0].approach):
        return candidates[0]
    return None


def _change(row: _Row, match: _Row) -> Literal["replaced", "filled", "unchanged"]:
    """Effect of a new reading on an existing row."""
    (text, old), (_, new) = row, match
    before, after = (astuple(r[0].conditions or Conditions()) for r in (old, new))
    conditions = [(b, a) for b, a in zip(before, after, strict=True) if a is not None]
    differs = [r.value for r in old] != [r.value for r in new]
    if (_is_filled(text) and differs) or any(b is not None and b != a for b, a in conditions):
        return "replaced"
    if not _is_filled(text) or any(b is None for b, _ in conditions):
        return "filled"
    return "unchanged"


def _update(row: RawReading, other: RawReading) -> RawReading:
    """Existing row with the reading and the stated conditions of another row."""
    conditions = {name: getattr(other, name) or getattr(row, name) for name in CONDITIONS}
    return replace(row, **{name: getattr(other, name) for name in VALUES}, **conditions)


def _describe(row: RawReading) -> str:
    """Reading and conditions of a row, for messages."""
    temperature = f"{row.temperature_C} °C" if row.temperature_C else ""
    measured = ", ".join(text for name in VALUES if (text := getattr(row, name)))
    parts = f"{measured} mm" if measured else "", row.approach, temperature, row.time
    return ", ".join(part for part in parts if part)
