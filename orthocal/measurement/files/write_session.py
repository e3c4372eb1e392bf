"""Writing of sessions: a session.yaml with its readings in a CSV beside it, in mm.

Keys are added to a session.yaml such that its comments, order and form remain.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from orthocal.arguments import require_kind
from orthocal.effects.adjustment import subtract_amounts
from orthocal.effects.compensation import (
    compensates_alike,
    format_table,
    home_positions,
    table_name,
)
from orthocal.errors import SessionError
from orthocal.io.documents import read_yaml, validate
from orthocal.io.files import exists, read_file, write_file, write_files
from orthocal.measurement.files.point_rows import is_of_row, point_cells
from orthocal.measurement.files.readings_file import (
    COLUMN_OF_ROLE,
    FIRST_LINE,
    REQUIRED,
    REQUIRED_OF_POINTS,
    RawReading,
    format_readings,
)
from orthocal.measurement.files.session_keys import SessionKeys
from orthocal.observation.conditions import needed_conditions
from orthocal.observation.contacts import balls_aligned_elsewhere
from orthocal.printers.settings import DeltaSettings
from orthocal.robot.loading import packaged_robots, robot_digest
from orthocal.robot.model import Robot
from orthocal.sensors.points import Points
from orthocal.sensors.protocol import default_zero
from orthocal.sensors.registry import write_sensor
from orthocal.session.points import base_name, gather_points, names_in_files
from orthocal.session.session import Conditions, Gauge, Posture, Purpose, Reading, Session, Setup
from orthocal.text import composed
from orthocal.units import DEG, MM, tidy, to_mm, trim_zeros

SAME_OFFSET = 1e-9
"""Largest difference between equal active offsets, [m, rad]."""


def session_document(session: Session) -> dict[str, Any]:
    """Content of the session.yaml of a session, as plain data.

    Raises:
        SessionError: If setups differ in what a file states once; see `_payload` and
            `_require_one_state`.
    """
    _require_one_state(session)
    gauges = {
        name: _gauge_document(g) for name, g in session.gauges.items() if base_name(name) == name
    }
    postures = session.postures.values()
    entries = {
        "robot": session.robot_reference,
        "title": session.title,
        "source": session.source,
        "seed": None if session.seed is None else int(session.seed),
        "gauges": None if "" in gauges else gauges,
        "gauge": gauges.get("", {}),
        "postures": {p.name: _posture_document(p, session.robot) for p in postures},
        "payload_kg": _payload(session) or None,
        "controller": _controller_document(session),
        "adjusted_mm": {n: tidy(v / MM) for n, v in session.adjusted.items()},
        "calibration": _calibration_document(session),
        "setups": _setup_documents(session),
        "readings": "readings.csv",
    }
    stated = {"gauges", "postures", "setups"}  # an empty one is refused
    return {
        k: v for k, v in entries.items() if v not in (None, "", {}) or (v == {} and k in stated)
    }


def _setup_documents(session: Session) -> dict[str, dict[str, Any]]:
    """Keys of each setup by name; a setup of points is one, as in its files."""
    aligned_at, elsewhere = session.alignment_postures, balls_aligned_elsewhere(session)
    setups: dict[str, Any] = {}
    for setup in session.setups.values():
        (name, gauge), sensor = names_in_files(setup), setup.sensor
        if isinstance(sensor, Points):
            sensor = sensor.in_file
            if is_of_row(setup.name):
                sensor = replace(sensor, covariance=None)
        setups.setdefault(
            name,
            {
                # a ball that is aligned elsewhere is centred there if it states no displacement
                **({"beside_mm": [0.0, 0.0, 0.0]} if setup.name in elsewhere else {}),
                **write_sensor(sensor),
                **({"gauge": gauge} if gauge else {}),
                "aligned_at": aligned_at[setup.name],
                **({"zero": setup.zero} if setup.zero != default_zero(sensor) else {}),
            },
        )
    return setups


def _posture_document(posture: Posture, robot: Robot) -> dict[str, list[float]]:
    if posture.form == "joints" and robot.drives[0].unit == "rad":
        return {"joints_deg": [tidy(np.rad2deg(v)) for v in posture.values]}
    return {f"{posture.form}_mm": [to_mm(v) for v in posture.values]}


def _gauge_document(gauge: Gauge) -> dict[str, Any]:
    entries = {
        "sigma_mm": None if gauge.sigma is None else to_mm(gauge.sigma),
        "resolution_mm": None if gauge.resolution is None else to_mm(gauge.resolution),
        "range_mm": None if gauge.range is None else [to_mm(v) for v in gauge.range],
    }
    return {k: v for k, v in entries.items() if v is not None}


def _payload(session: Session) -> float:
    """Mass on the tool, [kg].

    Raises:
        SessionError: If setups differ in it, as they may after joining sessions.
    """
    payloads = {s.payload for s in session.setups.values()}
    if len(payloads) > 1:
        listed = ", ".join(f"{v:g}" for v in sorted(payloads))
        raise SessionError(f"has setups under {listed} kg; a file has one payload_kg")
    return payloads.pop()


def _require_one_state(session: Session) -> None:
    """Refuse setups in other states of machine and controller than that of the session.

    Raises:
        SessionError: If there are such setups, as there may be after joining sessions.
    """
    for name, setup in session.setups.items():
        state = {
            "controller offsets": bool(
                np.abs(session.active_during(name) - session.active_offsets).max() > SAME_OFFSET
            ),
            "compensation": setup.compensation is not None
            and not compensates_alike(setup.compensation, session.compensation),
            "adjustments": setup.adjusted is not None
            and bool(subtract_amounts(setup.adjusted, session.adjusted)),
        }
        for key, differs in state.items():
            if differs:
                raise SessionError(
                    f"has setup '{name}' with other {key} than the session states; a file states "
                    "them once for all setups: write each session by itself"
                )


def _calibration_document(session: Session) -> dict[str, Any]:
    """Purpose, stated tolerances and chosen effects of a session."""
    purpose = session.purpose or Purpose()
    entries = {
        "model": purpose.model,
        "free": list(purpose.free),
        "tolerances": dict(session.robot.parameters.stated),
    }
    document = {key: value for key, value in entries.items() if value}
    chosen = session.robot.chosen_effects
    return document if chosen is None else document | {"effects": list(chosen)}


def _controller_document(session: Session) -> dict[str, Any]:
    """Offsets of prismatic drives in mm, of revolute drives in mrad, and the compensation.

    Raises:
        SessionError: If it does not state the compensation or the home position of each drive.
    """
    _require_complete(session)
    document: dict[str, Any] = {}
    stated: dict[str, Sequence[float]] = {}
    if session.controller_offsets is not None:
        for drive, offset in zip(session.robot.drives, session.active_offsets, strict=True):
            key = "offsets_mm" if drive.unit == "m" else "offsets_mrad"
            document.setdefault(key, []).append(tidy(float(offset) / MM))
    if any(joint.backlash or joint.table is None for joint in session.compensation):
        stated["backlash"] = [joint.backlash for joint in session.compensation]
    if (homes := home_positions(session.compensation)) is not None:
        stated["home_offset"] = homes
    for quantity, values in stated.items():
        for drive, value in zip(session.robot.drives, values, strict=True):
            key = f"{quantity}_{drive.joint_unit}"
            document.setdefault(key, []).append(tidy(value / drive.joint_size))
    if any(joint.table is not None for joint in session.compensation):
        document["comp_file"] = [
            None if joint.table is None else table_name(i)
            for i, joint in enumerate(session.compensation)
        ]
    if session.firmware is not None:
        document["firmware"] = firmware_document(session.firmware)
    if any(session.controller_origin):
        document["origin_mm"] = [tidy(v / MM) for v in session.controller_origin]
    return document


def _require_complete(session: Session) -> None:
    """Refuse a compensation, or home positions, of some drives only.

    Raises:
        SessionError: If a drive has none.
    """
    joints, count = session.compensation, len(session.robot.drives)
    homes = sum(joint.home is not None for joint in joints)
    for number, noun in ((len(joints), "compensations"), (homes, "home positions")):
        if number not in (0, count):
            raise SessionError(f"has {number} {noun} of joints; expected {count}, one per drive")


def firmware_document(settings: DeltaSettings) -> dict[str, Any]:
    """Settings of the firmware of a delta printer."""
    return {
        "name": settings.firmware,
        "radius_mm": to_mm(settings.radius),
        "rods_mm": [to_mm(v) for v in settings.rods],
        "angles_deg": [tidy(v / DEG) for v in settings.angles],
        "homed_mm": [to_mm(v) for v in settings.homed],
        "tilts": list(settings.tilts),
        "probe_mm": [to_mm(v) for v in settings.probe],
    }


def session_tables(session: Session) -> dict[str, str]:
    """Tables of trims of a session: text by file name."""
    drives = zip(session.robot.drives, session.compensation, strict=False)
    return {
        table_name(i): format_table(joint, drive)
        for i, (drive, joint) in enumerate(drives)
        if joint.table is not None
    }


def write_session(
    session: Session,
    folder: str | Path,
    *,
    decimals: int = 6,
    comment: str = "",
    extra: Mapping[str, str] | None = None,
    blank: bool = False,
) -> Path:
    """Write session.yaml and readings.csv into a directory, both or neither.

    The files of a robot without a directory are written into a subdirectory before.

    Args:
        session: The session.
        folder: The directory; created if it does not exist.
        decimals: Decimals of a reading in mm.
        comment: Text of comment lines at the top of the YAML.
        extra: Text of other files in the directory by name, written together with them.
        blank: Whether to write empty cells for readings and measured conditions.

    Returns:
        Path of the session.yaml.

    Raises:
        OrthocalError: If the directory is not writable.
        SessionError: If a name is not possible in a file.
    """
    require_kind(session, Session, expected="a Session, such as load_session(...)")
    folder = Path(folder)
    document = session_document(session)
    validate(SessionKeys, document, where=str(folder / "session.yaml"), error=SessionError)
    document["robot"] = _place_robot(session, folder)
    if session.offsets_from is not None:
        entered = os.path.relpath(session.offsets_from.resolve(), folder.resolve())
        document["offsets_from"] = entered
    heading = "".join(f"# {line}\n" for line in comment.splitlines())
    text = heading + yaml.safe_dump(
        document, sort_keys=False, default_flow_style=None, allow_unicode=True, width=100
    )
    conditions = needed_conditions(session.robot) if blank else ()
    needed = [COLUMN_OF_ROLE.get(c, c) for c in conditions]
    table = readings_table(
        session.readings, session.setups, decimals=decimals, blank=blank, needed=needed
    )
    files = {
        "session.yaml": text,
        "readings.csv": table,
        **session_tables(session),
        **(extra or {}),
    }
    write_files(folder, files)
    return folder / "session.yaml"


def _place_robot(session: Session, folder: Path) -> str:
    """Reference to the robot in a session.yaml; writes the files of an embedded robot.

    Raises:
        SessionError: If the robot's directory exists and contains another robot.
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


def number_rows(session: Session) -> Session:
    """Session whose rows have the lines that `write_session` gives them.

    Rows of an earlier session have its lines, with gaps where a row was deleted.
    """
    lines = enumerate(gather_points(session.readings, session.setups), FIRST_LINE)
    readings = tuple(replace(r, line=line) for line, group in lines for r in group)
    return replace(session, readings=readings)


def readings_table(
    readings: Sequence[Reading],
    setups: Mapping[str, Setup],
    *,
    decimals: int = 6,
    blank: bool = False,
    needed: Collection[str] = (),
) -> str:
    """Text of a readings.csv; cells of readings that are NaN are empty.

    Args:
        readings: The readings, in order.
        setups: Their setups.
        decimals: Decimals of a reading in mm.
        blank: Whether to write empty cells for readings and measured conditions.
        needed: Optional columns that the operator fills in.
    """
    rows, required = [], set[str]()
    for group in gather_points(readings, setups):
        r = group[0]
        is_point = isinstance(setups[r.setup].sensor, Points)
        conditions, value, temperature = r.conditions or Conditions(), "", ""
        cells = point_cells(group, setups, decimals) if is_point and not blank else {}
        required |= set(REQUIRED_OF_POINTS if is_point else REQUIRED)
        if r.is_read and not blank and not is_point:
            value = trim_zeros(f"{round(r.value / MM, decimals) + 0.0:.{decimals}f}")
        if conditions.temperature is not None:
            temperature = f"{conditions.temperature:.12g}"
        row = RawReading(
            where="",
            line=0,
            setup=base_name(r.setup) if is_point else r.setup,
            posture=r.posture,
            minus=r.minus or "",
            cycle=str(r.cycle),
            reading_mm=value,
            approach=conditions.approach or "",
            temperature_C=temperature,
            time="" if conditions.time is None else conditions.time.isoformat(),
            **cells,
        )
        rows.append(row)
    return format_readings(rows, blank=blank, needed=needed, required=required or REQUIRED)


def add_readings(file: Path, name: str) -> bytes:
    """Content of a session.yaml with the key `readings` appended.

    Args:
        file: The session.yaml.
        name: Name of the readings.csv beside it.

    Raises:
        SessionError: If the key cannot be appended; says what to add.
    """
    content = read_file(file, error=SessionError)
    extended = content.rstrip() + f"\nreadings: {name}\n".encode()
    document = read_yaml(file, error=SessionError, content=content) | {"readings": name}
    if not _has_values(file, extended, document):
        raise SessionError(f"is missing; add `readings: {name}` to it", where=f"{file}: readings")
    return extended


def add_alignment(file: Path, aligned_at: Mapping[str, str]) -> bytes:
    """Content of a session.yaml in which setups state their alignment postures.

    Args:
        file: The session.yaml.
        aligned_at: Alignment posture by setup, of setups that state none yet.

    Raises:
        SessionError: If the keys cannot be inserted; says what to add.
    """
    content = read_file(file, error=SessionError)
    document = read_yaml(file, error=SessionError, content=content)
    text = content.decode()
    setups = _nodes(_nodes(yaml.compose(text, Loader=yaml.SafeLoader)).get("setups"))
    insertions = []
    for name, posture in aligned_at.items():
        setup = setups.get(name)
        if not isinstance(setup, yaml.MappingNode) or not setup.value:
            continue
        document["setups"][name]["aligned_at"] = posture
        place = setup.value[0][0].start_mark  # before the first key
        flow = yaml.safe_dump({"aligned_at": posture}, default_flow_style=True, allow_unicode=True)
        end = ", " if setup.flow_style else "\n" + " " * place.column
        insertions.append((place.index, flow.strip()[1:-1] + end))
    for index, added in sorted(insertions, reverse=True):
        text = text[:index] + added + text[index:]
    if len(insertions) < len(aligned_at) or not _has_values(file, text.encode(), document):
        name, posture = next(iter(aligned_at.items()))
        raise SessionError(
            f"is missing; add `aligned_at: {posture}` to it", where=f"{file}: setups.{name}"
        )
    return text.encode()


def _nodes(node: yaml.Node | None) -> dict[str, yaml.Node]:
    """Nodes of the values of a mapping, by key; none of another node."""
    pairs = node.value if isinstance(node, yaml.MappingNode) else []
    return {composed(key.value): value for key, value in pairs}


def _has_values(file: Path, content: bytes, document: Any) -> bool:  # noqa: ANN401 - any document
    """True if the content of a session.yaml is a document with these values."""
    try:
        return bool(read_yaml(file, error=SessionError, content=content) == document)
    except SessionError:
        return False
