"""The command `import`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from orthocal.cli.options import Json, SessionPath, app
from orthocal.cli.printing import deliver, put_note, put_out
from orthocal.errors import SessionError
from orthocal.text import printable, shorten


@app.command("import")
def import_(
    table: Annotated[
        Path,
        Argument(metavar="TABLE", help="CSV file of any spreadsheet program, or .xlsx workbook."),
    ],
    session: SessionPath,
    sheet: Annotated[str | None, Option(help="Worksheet of a workbook.")] = None,
    decimal: Annotated[
        str | None, Option(metavar="comma|point", help="Decimal sign of the readings.")
    ] = None,
    separator: Annotated[
        str | None, Option(metavar="semicolon|tab|comma|pipe", help="Separator of the cells.")
    ] = None,
    unit: Annotated[
        str | None, Option(metavar="mm|um|inch|cm|thou", help="Unit of readings without a unit.")
    ] = None,
    encoding: Annotated[
        str | None, Option(help="Encoding of the file: utf-8, utf-16, cp1252, cp850, mac-roman ...")
    ] = None,
    column: Annotated[
        list[str] | None,
        Option(
            metavar="ROLE=HEADING",
            help="Role of a column: setup, posture, minus, cycle, approach, temperature, time, "
            "reading, or 'reading 2' for cycles side by side; HEADING is its heading, or its "
            "number such as #4.",
        ),
    ] = None,
    fill: Annotated[
        bool, Option("--fill", help="Copy an empty setup or posture from the row above.")
    ] = False,
    replace: Annotated[
        bool, Option("--replace", help="Overwrite existing readings that differ.")
    ] = False,
    dry_run: Annotated[
        bool, Option("--dry-run", help="Show the result without writing it.")
    ] = False,
    json: Json = False,
) -> None:
    """Import readings from a spreadsheet into a session.

    Encoding, separator, decimal sign and units are detected. An ambiguous table is refused with
    the option that decides. Rows match those of the session by setup, posture, minus and cycle.
    """
    from orthocal.measurement.importing.import_readings import (
        TableOptions,
        import_readings,
        write_import,
    )
    from orthocal.output.text.import_report import format_import, format_import_json

    options = TableOptions(
        sheet=sheet,
        separator=separator,
        decimal=decimal,
        unit=unit,
        encoding=encoding,
        columns=_parse_columns(column or []),
        fill=fill,
    )
    result = import_readings(table, session, options, overwrite=replace)
    written = result.changes and not dry_run
    if written:
        write_import(result)
    deliver(
        partial(format_import_json, result, written=written),
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
