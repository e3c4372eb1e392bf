"""The command `import`."""

from __future__ import annotations

from pathlib import Path

import orthocal
from orthocal.cli.options import command, read_pairs
from orthocal.cli.printing import deliver, put_note, put_out
from orthocal.errors import SessionError
from orthocal.io.files import exists
from orthocal.text import printable, quote_path
from orthocal.units import MM

OF_TABLES = (
    *("--sheet", "--decimal", "--separator", "--unit"),
    *("--encoding", "--column", "--fill", "--replace"),
)
"""Options that apply to tables only."""


@command(name="import")
def import_(
    table: Path,
    session: Path,
    sheet: str | None = None,
    decimal: str | None = None,
    separator: str | None = None,
    unit: str | None = None,
    encoding: str | None = None,
    column: list[str] | None = None,
    fill: bool = False,
    replace: bool = False,
    dry_run: bool = False,
    format: str | None = None,
    settings: list[Path] | None = None,
    radius_mm: float | None = None,
    json: bool = False,
) -> None:
    """Import readings from a spreadsheet, or the log of a printer.

    Encoding, separator, decimal sign and units are detected. An ambiguous table is refused with the
    option that decides. Rows match those of the session by setup, posture, minus and cycle.

    The log of a delta printer becomes a new session with its robot: heights of the bed that
    Klipper, Marlin or RepRapFirmware probed. It contains the settings of the firmware, or
    --settings names their files.

    Args:
        table (TABLE): CSV file of any spreadsheet program, or .xlsx workbook; or a printer's log.
        session (SESSION): session.yaml, or its directory; a new directory for a printer's log.
        sheet: Worksheet of a workbook.
        decimal (comma|point): Decimal sign of the readings.
        separator (semicolon|tab|comma|pipe): Separator of the cells.
        unit (mm|um|inch|cm|thou|hundredths): Unit of readings without a unit; hundredths of a mm.
        encoding: Encoding of the file: utf-8, utf-16, cp1252, cp850, mac-roman ...
        column (ROLE=HEADING): Role of a column: setup, posture, minus, cycle, approach,
            temperature, time, reading, 'reading 2' of cycles side by side, x, y, z of points,
            'nominal x' ... of commanded points; HEADING is its heading, or its number such as #4.
        fill: Copy an empty setup or posture from the row above.
        replace: Overwrite existing readings that differ.
        dry_run: Show the result without writing it.
        format (FIRMWARE): klipper, marlin or reprapfirmware; default: recognised.
        settings (FILE): Settings that a log lacks, such as printer.cfg, config.g or bed.g.
        radius_mm (MM): Marlin's log: largest distance from the middle that G33 or G29 probed.
    """
    if format or settings or radius_mm is not None or _is_printer_log(table):
        _refuse_options(sheet, decimal, separator, unit, encoding, column, fill, replace)
        _import_printer(table, session, format, settings, radius_mm, dry_run=dry_run, json=json)
        return
    _require_session(table, session)
    options = orthocal.TableOptions(
        sheet=sheet,
        separator=separator,
        decimal=decimal,
        unit=unit,
        encoding=encoding,
        columns=read_pairs(column, "--column", "ROLE=HEADING"),
        fill=fill,
    )
    result = orthocal.import_readings(table, session, options, overwrite=replace)
    _show(result, dry_run=dry_run, json=json)


def _show(result: orthocal.TableImport, *, dry_run: bool, json: bool) -> None:
    """Write an import unless it is a dry run, and print it."""
    from orthocal.output.text.import_report import format_import, format_import_json

    written = result.changes and not dry_run
    if written:
        orthocal.write_import(result)
    deliver(
        lambda: format_import_json(result, written=written),
        lambda: format_import(result),
        json=json,
    )
    if written:
        put_note(f"Wrote {result.readings_path}")
    elif result.changes:
        put_note("Nothing written (--dry-run)")
    else:
        put_note("Nothing written: the session already has all readings")


def _refuse_options(*values: object) -> None:
    """Refuse options of tables, in the order of `OF_TABLES`, for the log of a printer.

    Raises:
        SessionError: If one has a value; names it.
    """
    for name, value in zip(OF_TABLES, values, strict=True):
        if value:
            raise SessionError("is for tables; found the log of a printer", where=name)


def _session_file(session: Path) -> Path:
    return session / "session.yaml" if session.suffix not in (".yaml", ".yml") else session


def _is_printer_log(table: Path) -> bool:
    """True if the file is clearly a printer's log."""
    from orthocal.measurement.importing.printer_log import recognise_log

    return recognise_log(table) is not None


def _require_session(table: Path, session: Path) -> None:
    """Refuse a file that is missing, and a table without a session to import it into.

    Raises:
        SessionError: Naming what is missing, or the order of exchanged arguments.
    """
    from orthocal.measurement.files.session_file import list_sessions

    if exists(_session_file(session)):
        return
    if not exists(table):
        raise orthocal.SessionError("there is no such file", where=str(table))
    if exists(_session_file(table)):
        raise orthocal.SessionError(
            "is no session; expected first the table, then the session: "
            f"orthocal import {quote_path(session)} {quote_path(table)}",
            where=str(session),
        )
    if inner := list_sessions(session):
        raise orthocal.SessionError(f"is no session{inner}", where=str(session))
    raise orthocal.SessionError(
        f"there is no session to import into, and {table} is not recognised as a printer's log; "
        "--format names its firmware. Expected a table and a session.yaml or its directory, or a "
        "log and a new directory",
        where=str(session),
    )


def _import_printer(
    log: Path,
    directory: Path,
    firmware: str | None,
    settings: list[Path] | None,
    radius_mm: float | None,
    *,
    dry_run: bool,
    json: bool,
) -> None:
    """Import a printer's log as a new session, and print it."""
    from orthocal.measurement.importing.printer_log import import_printer_log, write_printer_import
    from orthocal.output.text.import_report import (
        describe_printer_import,
        format_printer_json,
        printer_commands,
    )

    radius = None if radius_mm is None else radius_mm * MM
    result = import_printer_log(log, firmware=firmware, settings=settings or (), radius=radius)
    written = None if dry_run else write_printer_import(result, directory)
    deliver(
        lambda: format_printer_json(result, log, written),
        lambda: describe_printer_import(result),
        json=json,
    )
    for note in result.log.notes:
        put_note(note)
    if dry_run:
        put_note("Nothing written (--dry-run)")
        return
    put_note(f"Wrote {directory}")
    if not json:
        put_out(printable(printer_commands(result, directory), keep="\n"))
