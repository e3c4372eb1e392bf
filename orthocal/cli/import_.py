"""The command `import`."""

from __future__ import annotations

from pathlib import Path

import orthocal
from orthocal.cli.options import Json, SessionPath, command
from orthocal.cli.printing import deliver, put_note, put_out
from orthocal.errors import SessionError
from orthocal.text import printable, shorten


@command(name="import")
def import_(
    table: Path,
    session: SessionPath,
    sheet: str | None = None,
    decimal: str | None = None,
    separator: str | None = None,
    unit: str | None = None,
    encoding: str | None = None,
    column: list[str] | None = None,
    fill: bool = False,
    replace: bool = False,
    dry_run: bool = False,
    json: Json = False,
) -> None:
    """Import readings from a spreadsheet into a session.

    Encoding, separator, decimal sign and units are detected. An ambiguous table is refused with
    the option that decides. Rows match those of the session by setup, posture, minus and cycle.

    Args:
        table (TABLE): CSV file of any spreadsheet program, or .xlsx workbook.
        sheet: Worksheet of a workbook.
        decimal (comma|point): Decimal sign of the readings.
        separator (semicolon|tab|comma|pipe): Separator of the cells.
        unit (mm|um|inch|cm|thou): Unit of readings without a unit.
        encoding: Encoding of the file: utf-8, utf-16, cp1252, cp850, mac-roman ...
        column (ROLE=HEADING): Role of a column: setup, posture, minus, cycle, approach,
            temperature, time, reading, or 'reading 2' for cycles side by side; HEADING is its
            heading, or its number such as #4.
        fill: Copy an empty setup or posture from the row above.
        replace: Overwrite existing readings that differ.
        dry_run: Show the result without writing it.
    """
    from orthocal.output.text.import_report import format_import, format_import_json

    options = orthocal.TableOptions(
        sheet=sheet,
        separator=separator,
        decimal=decimal,
        unit=unit,
        encoding=encoding,
        columns=_parse_columns(column or []),
        fill=fill,
    )
    result = orthocal.import_readings(table, session, options, overwrite=replace)
    written = result.changes and not dry_run
    if written:
        orthocal.write_import(result)
    deliver(
        lambda: format_import_json(result, written=written),
        lambda: put_out(printable(format_import(result), keep="\n")),
        json=json,
    )
    if written:
        put_note(f"Wrote {result.readings_path}")
    elif result.changes:
        put_note("Nothing written (--dry-run)")
    else:
        put_note("Nothing written: the session already has all readings")


def _parse_columns(assignments: list[str]) -> dict[str, str]:
    """Role and heading of every ROLE=HEADING."""
    columns: dict[str, str] = {}
    for text in assignments:
        role, separator, heading = text.partition("=")
        role = role.strip()
        if not separator or not heading.strip():
            raise SessionError(f"found '{shorten(text)}'; expected ROLE=HEADING", where="--column")
        if role in columns:
            raise SessionError(f"assigns the role {shorten(role)} twice", where="--column")
        columns[role] = heading
    return columns
