"""Sessions to files: session.yaml with its readings in a CSV beside it, in mm."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from orthocal.errors import SessionError
from orthocal.io.files import exists, write_file, write_files
from orthocal.robot.loading import packaged_robots, robot_digest
from orthocal.sensors.protocol import default_zero
from orthocal.sensors.registry import write_sensor
from orthocal.session.session import Conditions, Gauge, Purpose, Reading, Session
from orthocal.units import MM, tidy, to_mm

COLUMNS = (
    *("setup", "posture", "minus", "cycle", "reading_mm"),
    *("approach", "temperature_C", "time"),
)
"""Columns of a readings.csv; all but `setup`, `posture` and `reading_mm` may be absent."""

UNSTATED = {"cycle": "1"}
"""Values of optional columns that need not be stated."""

MEASURED = ("temperature_C", "time")
"""Conditions that are measured with a reading, not planned."""


def session_document(session: Session, *, readings: str = "readings.csv") -> dict[str, Any]:
    """The session.yaml of a session, as plain data."""
    document: dict[str, Any] = {"robot": session.robot_reference}
    if session.title:
        document["title"] = session.title
    if session.source:
        document["source"] = session.source
    if session.seed is not None:
        document["seed"] = session.seed
    gauges = {name: _gauge_document(g) for name, g in session.gauges.items()}
    if "" not in gauges:
        document["gauges"] = gauges
    elif gauges[""]:
        document["gauge"] = gauges[""]
    document["postures"] = {
        p.name: {
            p.form: [tidy(np.rad2deg(v)) if p.form == "joints_deg" else to_mm(v) for v in p.values]
        }
        for p in session.postures.values()
    }
    if session.controller_offsets is not None:
        document["controller"] = _offsets_document(session)
    if calibration := _calibration_document(session):
        document["calibration"] = calibration
    aligned_at = session.alignment_postures
    document["setups"] = {
        s.name: {
            **write_sensor(s.sensor),
            **({"gauge": s.gauge} if s.gauge else {}),
            "aligned_at": aligned_at[s.name],
            **({"zero": s.zero} if s.zero != default_zero(s.sensor) else {}),
        }
        for s in session.setups.values()
    }
    document["readings"] = readings
    return document


def _gauge_document(gauge: Gauge) -> dict[str, Any]:
    entries = {
        "sigma_mm": None if gauge.sigma is None else to_mm(gauge.sigma),
        "resolution_mm": None if gauge.resolution is None else to_mm(gauge.resolution),
        "range_mm": None if gauge.range is None else [to_mm(v) for v in gauge.range],
    }
    return {k: v for k, v in entries.items() if v is not None}


def _calibration_document(session: Session) -> dict[str, Any]:
    """Purpose and stated tolerances of a session."""
    purpose = session.purpose or Purpose()
    entries = {
        "model": purpose.model,
        "free": list(purpose.free),
        "tolerances": dict(session.robot.parameters.stated),
    }
    return {key: value for key, value in entries.items() if value}


def _offsets_document(session: Session) -> dict[str, list[float]]:
    """Offsets of prismatic drives in mm, of revolute ones in mrad."""
    document: dict[str, list[float]] = {}
    for drive, offset in zip(session.robot.drives, session.active_offsets, strict=True):
        key = "offsets_mm" if drive.unit == "m" else "offsets_mrad"
        document.setdefault(key, []).append(tidy(float(offset) / MM))
    return document


def write_session(
    session: Session,
    folder: str | Path,
    *,
    decimals: int = 6,
    comment: str = "",
    extra: Mapping[str, str] | None = None,
    blank: bool = False,
) -> Path:
    """Write session.yaml and readings.csv into a folder, both or neither.

    The files of a robot that has no directory are written into a subdirectory before.

    Args:
        session: The session.
        folder: Made if need be.
        decimals: Decimals of a reading in mm.
        comment: Lines put first into the YAML.
        extra: Other files of the folder, name to text, written with them.
        blank: Whether readings are left empty, to be filled in.

    Returns:
        Path of the session.yaml.

    Raises:
        OrthocalError: If the folder cannot be written to.
    """
    folder = Path(folder)
    document = session_document(session)
    document["robot"] = _place_robot(session, folder)
    head = "".join(f"# {line}\n" for line in comment.splitlines())
    text = head + yaml.safe_dump(
        document, sort_keys=False, default_flow_style=None, allow_unicode=True, width=100
    )
    values = [None if blank else r.value for r in session.readings]
    table = readings_table(session.readings, values, decimals=decimals, blank=blank)
    files = {"session.yaml": text, "readings.csv": table, **(extra or {})}
    write_files(folder, files)
    return folder / "session.yaml"


def _place_robot(session: Session, folder: Path) -> str:
    """Reference to the robot in a session.yaml; files of an embedded robot are written.

    Raises:
        SessionError: If the robot's directory exists and holds another robot.
    """
    robot = session.robot
    if robot.folder is not None:
        if session.robot_reference in packaged_robots():
            return session.robot_reference
        return os.path.relpath(robot.folder.resolve(), folder.resolve())
    target = folder / robot.name
    if exists(target) and robot_digest(target) != robot.sha256:
        raise SessionError("exists already and holds another robot", where=str(target))
    for name, content in robot.content.items():
        write_file(target / name, content)
    return f"./{robot.name}"


def readings_table(
    rows: Sequence[Reading],
    values: Sequence[float | None],
    *,
    decimals: int = 6,
    blank: bool = False,
) -> str:
    """Text of a readings.csv.

    Args:
        rows: What is read where, under which conditions.
        values: Their readings, [m]; None for a cell that stays empty.
        decimals: Decimals of a reading in mm.
        blank: Leave the cells of measured conditions empty.
    """
    cells = [
        {
            "setup": r.setup,
            "posture": r.posture,
            "minus": r.minus or "",
            "cycle": str(r.cycle),
            "reading_mm": "" if value is None else _trim(f"{value / MM:.{decimals}f}"),
            **condition_cells(r.conditions),
        }
        for r, value in zip(rows, values, strict=True)
    ]
    return format_cells(cells, blank=blank)


def format_cells(rows: Sequence[Mapping[str, str]], *, blank: bool = False) -> str:
    """Text of a readings.csv without the optional columns that no row needs.

    Args:
        rows: Cells by column.
        blank: Leave the cells of measured conditions empty.
    """
    columns = used_columns(rows)
    empty = MEASURED if blank else ()
    lines = [columns, *(["" if c in empty else row[c] for c in columns] for row in rows)]
    return "".join(",".join(line) + "\n" for line in lines)


def condition_cells(conditions: Conditions | None) -> dict[str, str]:
    """Cells of the conditions of a row; empty for those that are not stated."""
    c = conditions or Conditions()
    return {
        "approach": c.approach or "",
        "temperature_C": "" if c.temperature is None else f"{c.temperature:.12g}",
        "time": "" if c.time is None else c.time.isoformat(),
    }


def used_columns(rows: Sequence[Mapping[str, str]]) -> list[str]:
    """Columns of a readings.csv without the optional ones that no row needs."""
    needed = {"setup", "posture", "reading_mm"}
    needed |= {c for c in COLUMNS if any(row[c] not in ("", UNSTATED.get(c)) for row in rows)}
    return [c for c in COLUMNS if c in needed]


def _trim(number: str) -> str:
    """A decimal number without trailing zeros beyond the second decimal."""
    integer, _, decimals = number.partition(".")
    return f"{integer}.{decimals.rstrip('0').ljust(2, '0')}"
