"""Readings that were written into a spreadsheet: import."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from orthocal.cli.options import Json, app
from orthocal.cli.printing import put_note, put_out
from orthocal.errors import SessionError
from orthocal.text import printable


@app.command("import")
def import_(
    table: Annotated[
        Path, typer.Argument(metavar="TABLE", help="A CSV of any spreadsheet, or an .xlsx.")
    ],
    session: Annotated[
        Path,
        typer.Argument(metavar="SESSION", help="session.yaml, or the folder that holds it."),
    ],
    sheet: Annotated[str | None, typer.Option(help="Sheet of a workbook, by its name.")] = None,
    decimal: Annotated[
        str | None, typer.Option(metavar="comma|point", help="The decimal sign of readings.")
    ] = None,
    separator: Annotated[
        str | None,
        typer.Option(metavar="semicolon|tab|comma|pipe", help="What separates the cells."),
    ] = None,
    unit: Annotated[
        str | None,
        typer.Option(metavar="mm|um|inch|cm|thou", help="Of readings that state none."),
    ] = None,
    encoding: Annotated[
        str | None, typer.Option(help="utf-8, utf-16, cp1252, cp850, mac-roman ...")
    ] = None,
    column: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROLE=HEADING",
            help="Which column is which: setup, posture, minus, cycle, reading, or 'reading 2' "
            "for a cycle beside others; by its heading, or as #4.",
        ),
    ] = None,
    fill: Annotated[
        bool, typer.Option("--fill", help="An empty setup or posture is the one above.")
    ] = False,
    replace: Annotated[
        bool, typer.Option("--replace", help="Write over readings that are there.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be done, and write nothing.")
    ] = False,
    json: Json = False,
) -> None:
    """Take the readings of a table into a session, and say what was understood."""
    from orthocal.measurement.importing.import_readings import (
        TableOptions,
        import_readings,
        write_import,
    )
    from orthocal.output.text.import_report import format_import, printed_import

    options = TableOptions(
        sheet=sheet,
        separator=separator,
        decimal=decimal,
        unit=unit,
        encoding=encoding,
        columns=_read_columns(column or []),
        fill=fill,
    )
    found = import_readings(table, session, options, overwrite=replace)
    written = found.changes and not dry_run
    if written:
        write_import(found)
    if json:
        put_out(printed_import(found, written=written).removesuffix("\n"))
    else:
        put_out(printable(format_import(found), keep="\n"))
    if written:
        put_note(f"Wrote {found.readings_path}")
    else:
        put_note("Nothing was written" + ("" if found.changes else ": there is nothing new"))


def _read_columns(given: list[str]) -> dict[str, str]:
    """Role to heading, of ROLE=HEADING."""
    found: dict[str, str] = {}
    for text in given:
        role, separator, heading = text.partition("=")
        if not separator or not heading.strip():
            raise SessionError(f"found '{text}'; expected ROLE=HEADING", where="--column")
        if role.strip() in found:
            raise SessionError(f"the {role.strip()} is said twice", where="--column")
        found[role.strip()] = heading
    return found
