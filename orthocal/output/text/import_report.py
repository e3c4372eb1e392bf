"""Report of an import of readings, as text and as JSON."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from orthocal.assessment.wording import counted
from orthocal.io.documents import format_json
from orthocal.io.tables.cell import column_letters
from orthocal.io.tables.table import Table
from orthocal.measurement.files.readings_file import RawReading, has_standard_headings
from orthocal.measurement.files.write_session import firmware_document
from orthocal.measurement.importing.import_readings import VALUES, TableImport
from orthocal.measurement.importing.printer_log import PrinterImport
from orthocal.printers.log import PrintedDistance
from orthocal.printers.settings import DeltaSettings
from orthocal.text import list_some, quote_path, spans
from orthocal.units import DEG, MM, to_mm

CHANGES = {
    "filled": "filled in",
    "added": "added",
    "replaced": "replaced",
    "unchanged": "unchanged",
}
"""Numbers of rows that an import states, in words."""

MOST_NAMES = 6
"""Maximum number of replaced names in the text."""


def format_import(result: TableImport) -> str:
    """Interpretation of the table, one line per item, and the changes of the session."""
    items = _interpretation(result)
    width = max(len(name) for name, _ in items)
    return "\n".join(
        [
            f"{counted(len(result.long_table.rows), 'reading')} in {result.table.path}",
            *(f"  {name.ljust(width)}   {text}" for name, text in items),
            _describe_changes(result),
        ]
    )


def _interpretation(result: TableImport) -> list[tuple[str, str]]:
    """Names and descriptions of what was detected in the table."""
    table, long_table = result.table, result.long_table
    if table.sheet is not None:
        items = [("sheet", f"'{table.sheet}'")]
    else:
        items = [
            ("encoding", f"{table.encoding} ({table.encoding_reason})"),
            ("separator", f"{table.separator} ({table.separator_reason})"),
        ]
    items.append(("decimal sign", _describe_decimal_sign(result)))
    reason = "requested" if long_table.unit_assumed else "stated in the table"
    units = ", ".join("µm" if unit == "um" else unit for unit in long_table.units)
    items.append(("unit", f"{units} ({reason})"))
    items += _columns_by_role(result)
    if result.columns.extra:
        names = ", ".join(_describe_column(table, i) for i in result.columns.extra)
        items.append(("unused", f"columns {names}"))
    if table.above:
        items.append(("skipped", f"above the headings: {_format_rows(table.above)}"))
    for reason in dict.fromkeys(reason for _, reason in long_table.skipped):
        lines = [line for line, other in long_table.skipped if other == reason]
        items.append(("skipped", f"{reason}: {_format_rows(lines)}"))
    if long_table.missing:
        lines = [row.line for row in long_table.missing]
        items.append(("empty", f"{counted(len(lines), 'reading')}: {_format_rows(lines)}"))
    if long_table.renamed:
        pairs = [f"'{written}' as {name}" for written, name in long_table.renamed]
        items.append(("names", list_some(pairs, MOST_NAMES)))
    if table.formulas:
        items.append(("formulas", f"{table.formulas}, imported with their saved values"))
    if table.hidden:
        items.append(("hidden rows", f"{table.hidden}, imported like all others"))
    return items


def _describe_decimal_sign(result: TableImport) -> str:
    decimal = result.long_table.decimal
    if result.options.decimal is not None:
        return f"{decimal.sign} (requested)"
    if decimal.evidence is not None:
        return f"{decimal.sign} (from '{decimal.evidence.text}' in row {decimal.evidence.line})"
    if result.table.sheet is not None:
        return "not needed (numbers of the workbook)"
    if has_standard_headings(result.table.header):
        return "point (format of readings.csv)"
    return "not needed (whole numbers only)"


def _columns_by_role(result: TableImport) -> list[tuple[str, str]]:
    columns, table = result.columns, result.table
    roles = [(role, _describe_column(table, index)) for role, index in columns.single.items()]
    readings: dict[str, list[str]] = {}
    for i, h in columns.readings.items():
        cycle = f" as cycle {h.cycle}" if h.cycle is not None else ""
        readings.setdefault(h.role, []).append(_describe_column(table, i) + cycle)
    return [*roles, *((role, ", ".join(of_role)) for role, of_role in readings.items())]


def _describe_column(table: Table, index: int) -> str:
    """Heading of a column, or its letter if it has no heading."""
    heading = " ".join(table.header[index].split()) if index < len(table.header) else ""
    return f"'{heading}'" if heading else column_letters(index)


def _format_rows(lines: Iterable[int]) -> str:
    """Numbers of rows as ranges, such as `rows 3, 7 to 12`."""
    return spans(sorted(set(lines)), "row")


def _describe_changes(result: TableImport) -> str:
    """Changes of the session's readings.csv."""
    parts = [f"{n} {words}" for name, words in CHANGES.items() if (n := getattr(result, name))]
    empty = f"; {counted(result.empty, 'row')} still without a reading" if result.empty else ""
    planned = result.filled or result.replaced or result.unchanged or result.empty
    rows = _format_rows(result.unplanned)
    unplanned = f"\nIn addition to the rows of the session: {rows} of the table."
    return f"{result.readings_path}: {', '.join(parts)}{empty}" + unplanned * bool(
        planned and result.unplanned
    )


def format_import_json(result: TableImport, *, written: bool) -> str:
    """Report of an import as a JSON document."""
    table, long_table = result.table, result.long_table
    document: dict[str, Any] = {
        "table": str(table.path),
        "sheet": table.sheet,
        "encoding": table.encoding,
        "separator": table.separator,
        "decimal": long_table.decimal.sign,
        "units": list(long_table.units),
        "columns": dict(_columns_by_role(result)),
        "unused": [_describe_column(table, i) for i in result.columns.extra],
        "skipped": [{"row": line, "reason": reason} for line, reason in long_table.skipped],
        "rows_without_reading": sorted({row.line for row in long_table.missing}),
        "renamed": dict(long_table.renamed),
        "readings": [
            {
                "row": row.line,
                "setup": row.setup,
                "posture": row.posture,
                "minus": row.minus or None,
                "cycle": int(row.cycle or 1),
                **{name: float(text) for name in VALUES if (text := getattr(row, name))},
                **_conditions(row),
            }
            for row in long_table.rows
        ],
        "session": str(result.session),
        **{name: getattr(result, name) for name in (*CHANGES, "empty")},
        "written": str(result.readings_path) if written else None,
    }
    return format_json(document)


def _conditions(row: RawReading) -> dict[str, str | float]:
    """Stated conditions of a row."""
    conditions = {
        "approach": row.approach,
        "temperature_C": float(row.temperature_C) if row.temperature_C else "",
        "time": row.time,
    }
    return {name: value for name, value in conditions.items() if value != ""}


def describe_printer_import(result: PrinterImport) -> str:
    """Firmware, settings and points of a printer's log."""
    log, mm = result.log, 1.0 / MM
    s = log.settings
    rods = ", ".join(f"{v * mm:.3f}" for v in s.rods)
    stops = ", ".join(f"{v * mm:.3f}" for v in s.endstops)
    turns = ", ".join(f"{v / DEG:.3f}" for v in s.angles)
    heights = s.touched(log.carriages)[:, 2] - log.heights
    printed = [
        f"  distances  {len(log.distances)} on a print, measured less printed with these settings: "
        f"{misfits.min() * mm:+.3f} to {misfits.max() * mm:+.3f} mm"
        for misfits in [np.array([_misfit(s, d) for d in log.distances])]
        if log.distances
    ]
    return "\n".join(
        [
            f"{counted(len(log.carriages), 'point')} of a bed, probed with {result.title}",
            f"  radius     {s.radius * mm:.3f} mm",
            f"  rods       {rods} mm",
            f"  towers     {turns}°",
            f"  endstops   {stops} mm",
            f"  heights    {heights.min() * mm:+.3f} to {heights.max() * mm:+.3f} mm, as the "
            "firmware sees them",
            *printed,
        ]
    )


def _misfit(settings: DeltaSettings, distance: PrintedDistance) -> float:
    """Measured distance less that of the settings, [m]."""
    far, near = settings.forward(distance.carriages)
    return distance.length - float(np.linalg.norm(far - near))


def format_printer_json(result: PrinterImport, path: Path, written: Path | None) -> str:
    """Import of a printer's log as a JSON document.

    Args:
        result: The import.
        path: The log.
        written: The session.yaml; None if nothing was written.
    """
    log = result.log
    document: dict[str, Any] = {
        "log": str(path),
        "settings": firmware_document(log.settings),
        "points": [
            {"carriages_mm": [to_mm(v) for v in carriages], "height_mm": to_mm(height)}
            for carriages, height in zip(log.carriages.tolist(), log.heights.tolist(), strict=True)
        ],
        "distances": [
            {
                "name": d.name,
                "length_mm": to_mm(d.length),
                "carriages_mm": [[to_mm(v) for v in end] for end in d.carriages.tolist()],
            }
            for d in log.distances
        ],
        "notes": list(log.notes),
        "written": None if written is None else str(written),
    }
    return format_json(document)


def printer_commands(result: PrinterImport, directory: Path) -> str:
    """The next commands after a printer's log."""
    place, one, new = (
        quote_path(p) for p in (directory, directory / "one", directory / result.firmware)
    )
    return "\n".join(
        [
            "Next: calibrate, and look at the new settings:",
            f"  orthocal calibrate {place} --out {one}",
            f"  orthocal export {one} --to {result.firmware} --out {new}",
        ]
    )
