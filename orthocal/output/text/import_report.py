"""What was understood of a table that was imported, in words and as JSON."""

from __future__ import annotations

import json
from typing import Any

from orthocal.measurement.files.readings_file import is_house
from orthocal.measurement.importing.import_readings import TableImport
from orthocal.measurement.importing.long_table import describe_column, list_lines
from orthocal.output.text.layout import counted

WORDS = {"um": "µm"}
"""Units as people read them."""

MOST_NAMES = 6
"""Names that are others in the session, of which it is said."""


def format_import(found: TableImport) -> str:
    """What was understood, a line each, and what becomes of the session."""
    lines = [f"{counted(len(found.long.rows), 'reading')} in {found.table.path}"]
    understood = _understood(found)
    width = max(len(name) for name, _ in understood)
    lines += [f"  {name.ljust(width)}   {text}" for name, text in understood]
    lines.append(_outcome(found))
    return "\n".join(lines)


def _understood(found: TableImport) -> list[tuple[str, str]]:
    table, long = found.table, found.long
    lines = []
    if table.sheet is not None:
        lines.append(("sheet", f"'{table.sheet}'"))
    else:
        lines.append(("encoding", f"{table.encoding}, {table.encoding_reason}"))
        lines.append(("separator", f"{table.separator}, {table.separator_reason}"))
    lines.append(("decimal sign", _decimal(found)))
    reason = "as asked for" if long.unit_said else "as the table says"
    lines.append(("unit", f"{', '.join(WORDS.get(u, u) for u in long.units)}, {reason}"))
    for role, names in _columns(found):
        lines.append((role, names))
    if found.columns.extra:
        names = ", ".join(describe_column(table, i) for i in found.columns.extra)
        lines.append(("not used", f"columns {names}"))
    if table.above:
        above = [(line, "") for line in table.above]
        lines.append(("left out", f"above the headings: row {list_lines(above)}"))
    for reason in dict.fromkeys(reason for _, reason in long.left_out):
        rows = [pair for pair in long.left_out if pair[1] == reason]
        lines.append(("left out", f"{reason}: row {list_lines(rows)}"))
    if long.unread:
        rows = [(row.line, "") for row in long.unread]
        lines.append(("not yet read", f"{len(rows)}: row {list_lines(rows)}"))
    if long.renamed:
        pairs = [f"'{written}' is {meant}" for written, meant in long.renamed]
        more = f" and {len(pairs) - MOST_NAMES} more" if len(pairs) > MOST_NAMES else ""
        lines.append(("names", ", ".join(pairs[:MOST_NAMES]) + more))
    if table.formulas:
        lines.append(("formulas", f"{table.formulas}: their saved values"))
    if table.hidden:
        lines.append(("hidden rows", f"{table.hidden}: read as all others"))
    return lines


def _decimal(found: TableImport) -> str:
    sign = found.long.decimal
    if found.long.decimal_said:
        return f"{sign.sign}, as asked for"
    if sign.evidence is not None:
        return f"{sign.sign}, as in '{sign.evidence.text}' (row {sign.evidence.line})"
    if found.table.sheet is not None:
        return "none needed: numbers of the workbook"
    if is_house(found.table.header):
        return "point, as in every readings.csv"
    return "none needed: whole numbers alone"


def _columns(found: TableImport) -> list[tuple[str, str]]:
    columns, table = found.columns, found.table
    named = [
        ("setup", columns.setup),
        ("posture", columns.posture),
        ("minus", columns.minus),
        ("cycle", columns.cycle),
    ]
    lines = [(role, describe_column(table, i)) for role, i in named if i is not None]
    readings = [
        describe_column(table, r.index) + (f" as cycle {r.cycle}" if r.cycle is not None else "")
        for r in columns.readings
    ]
    return [*lines, ("reading", ", ".join(readings))]


def _outcome(found: TableImport) -> str:
    """What becomes of the session's readings.csv."""
    parts = [
        f"{number} {words}"
        for number, words in (
            (found.filled, "filled in"),
            (found.added, "added"),
            (found.replaced, "replaced"),
            (found.unchanged, "there already"),
        )
        if number
    ]
    rest = f"; {counted(found.empty, 'row')} still without a reading" if found.empty else ""
    return f"{found.readings_path}: {', '.join(parts)}{rest}"


def printed_import(found: TableImport, *, written: bool) -> str:
    """The same as JSON."""
    table, long = found.table, found.long
    document: dict[str, Any] = {
        "table": str(table.path),
        "sheet": table.sheet,
        "encoding": table.encoding,
        "separator": table.separator,
        "decimal": long.decimal.sign,
        "units": list(long.units),
        "columns": dict(_columns(found)),
        "not_used": [describe_column(table, i) for i in found.columns.extra],
        "left_out": [{"row": line, "reason": reason} for line, reason in long.left_out],
        "not_yet_read": sorted({row.line for row in long.unread}),
        "names": dict(long.renamed),
        "readings": [
            {
                "row": row.line,
                "setup": row.setup,
                "posture": row.posture,
                "minus": row.minus or None,
                "cycle": int(row.cycle or 1),
                "reading_mm": float(row.reading),
            }
            for row in long.rows
        ],
        "session": str(found.session),
        "filled": found.filled,
        "added": found.added,
        "replaced": found.replaced,
        "unchanged": found.unchanged,
        "empty": found.empty,
        "written": str(found.readings_path) if written else None,
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"
