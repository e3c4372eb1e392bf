"""Reading of sessions: a session.yaml with its readings in a CSV beside it, in mm.

Sessions are checked against the robot and the nominal machine.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import replace
from difflib import get_close_matches
from itertools import islice
from pathlib import Path

from orthocal.arrays import triple
from orthocal.effects.adjustment import require_adjustment
from orthocal.effects.compensation import Compensation
from orthocal.effects.loading import load_robot, with_effects
from orthocal.errors import ParameterError, RobotError, SessionError
from orthocal.io.documents import describe_missing, missing_keys_error, read_yaml, validate
from orthocal.io.files import (
    content_withheld_outside,
    exists,
    is_folder,
    read_file,
    require_plain_name,
)
from orthocal.measurement.files.point_rows import locate_stations, split_points
from orthocal.measurement.files.readings_checks import check_readings, require_read
from orthocal.measurement.files.readings_file import read_rows
from orthocal.measurement.files.session_drives import (
    build_compensation,
    build_firmware,
    build_postures,
    read_drive_values,
    require_mechanical_zero,
)
from orthocal.measurement.files.session_keys import (
    MOST_READINGS,
    CalibrationKeys,
    ControllerKeys,
    GaugeKeys,
    SessionKeys,
)
from orthocal.observation.contacts import centre_balls, locate_contacts
from orthocal.robot.model import Robot
from orthocal.sensors.protocol import (
    NuisanceParameter,
    Sensor,
    SetupKeys,
    default_zero,
    reads_pairs,
)
from orthocal.sensors.registry import read_setup
from orthocal.session.completeness import require_name
from orthocal.session.points import base_name
from orthocal.session.session import Gauge, Purpose, Reading, Session, Setup
from orthocal.text import list_some
from orthocal.units import MM, show_limit

SESSION = "session.yaml"

MAX_SEARCHED = 200
"""Largest number of directory entries searched for a session."""

MAX_LISTED = 3
"""Largest number of sessions of subdirectories in a message."""

OTHER_SUFFIXES = (".csv", ".json", ".urdf")
"""Suffixes of files that are not a session.yaml."""

EXPECTED_ROWS = (
    "expected a header such as setup,posture,cycle,reading_mm and a line for each reading, as on "
    "the sheet. To write the lines of a plan again, repeat its command with --force"
)
"""Expected content of a readings.csv without rows."""


def load_session(path: str | Path, *, partial: bool = False) -> Session:
    """Read a session: its YAML, its CSV and its robot, checked against each other.

    Args:
        path: The session.yaml, or its directory.
        partial: Whether some of the readings may be missing; their values are NaN.

    Raises:
        SessionError: If a file is wrong; names file and line or key, and the expected content.
        RobotError: If the robot does not load.
    """
    file, content, keys = _read_keys(Path(path))
    session = _load_session(file, content, keys)
    require_read(session, partial=partial)
    return locate_stations(session)


def _load_session(
    file: Path, content: bytes, keys: SessionKeys, wrong: list[SessionError] | None = None
) -> Session:
    """Session with readings, stations not located; readings of empty cells are NaN."""
    plan, readings_path = _build_unread(file, keys)
    table = _read_table(readings_path)
    with content_withheld_outside(file.parent, readings_path):
        rows = tuple(read_rows(readings_path, table))
        if not rows:
            raise SessionError(f"holds no readings; {EXPECTED_ROWS}", where=str(readings_path))
        readings, points = check_readings(rows, plan, file=readings_path, wrong=wrong)
    session = replace(
        plan,
        setups=points.setups,
        gauges=points.gauges,
        readings=readings,
        readings_path=readings_path,
        sha256=session_digest(content, table, plan.compensation),
    )
    return _with_contacts(session, keys)


def _read_table(path: Path) -> bytes:
    """Content of a readings.csv.

    Raises:
        SessionError: If it is missing or empty; says how to write the rows of a plan again.
    """
    problem = "there is no such file"
    if exists(path):
        table = read_file(path, error=SessionError)
        if table.strip():
            return table
        problem = "is empty"
    raise SessionError(f"{problem}; {EXPECTED_ROWS}", where=str(path))


def session_digest(keys: bytes, table: bytes, compensation: Compensation) -> str:
    """Digest of a session.

    Args:
        keys: Content of the session.yaml.
        table: Content of the readings.csv.
        compensation: Compensation of the controller, of which tables are in other files.
    """
    digest = hashlib.sha256(keys + b"\0" + table)
    for joint in compensation:
        digest.update(b"" if joint.table is None else joint.table.tobytes())
    return digest.hexdigest()


def load_unread(path: str | Path) -> tuple[Session, Path]:
    """Read a session without its readings, and the path of its readings.csv, which may be missing.

    Args:
        path: The session.yaml, or its directory.

    Raises:
        SessionError: If the session.yaml is wrong; names file and key.
        RobotError: If the robot does not load.
    """
    file, _, keys = _read_keys(Path(path))
    return _build_unread(file, keys)


def _build_unread(file: Path, keys: SessionKeys) -> tuple[Session, Path]:
    """Session without its readings, and the path of its readings.csv."""
    if keys.readings is None:
        raise SessionError("is missing; expected the name of a CSV file", where=f"{file}: readings")
    require_plain_name(file, error=SessionError)
    plan = _build_plan(file, keys, _read_setups(file, keys))
    if not keys.readings.strip() or "\0" in keys.readings:
        raise SessionError(
            f"found {keys.readings!r}; expected the name of a CSV file", where=f"{file}: readings"
        )
    return plan, file.parent / keys.readings


def load_plan(path: str | Path, *, wrong: list[SessionError] | None = None) -> Session:
    """Read a plan: a session.yaml without `readings`. Readings without a value are NaN.

    A setup is read `cycles` times in all postures, or in those of its `postures`. A sensor that
    reads pairs of postures reads the first and second one, the third and fourth one and so on. A
    session with readings is a plan of its rows; without a readings.csv its `readings_path` is None.

    Args:
        path: The session.yaml, or its directory.
        wrong: List that is set to the errors of readings out of range, which become NaN. By
            default, and if most readings are out of range, the first error is raised.

    Raises:
        SessionError: If a file is wrong; names file and line or key.
        RobotError: If the robot does not load.
    """
    file, content, keys = _read_keys(Path(path))
    if keys.readings is not None:
        return locate_stations(_load_session(file, content, keys, wrong), partial=True)
    stated = _read_setups(file, keys)
    count = keys.cycles * sum(len(s.postures or keys.postures) for s, _ in stated.values())
    if count > MOST_READINGS:
        raise SessionError(
            f"plans {count} readings, {keys.cycles} times those of all setups; expected at most "
            f"{MOST_READINGS}",
            where=f"{file}: cycles",
        )
    plan = _build_plan(file, keys, stated)
    split: dict[str, list[str]] = {}  # a setup of points is split into three
    for name in plan.setups:
        split.setdefault(name if name in stated else base_name(name), []).append(name)
    readings = tuple(
        Reading(axis, posture, minus, cycle, math.nan)
        for name, (setup, sensor) in stated.items()
        for cycle in range(1, keys.cycles + 1)
        for posture, minus in _pair_postures(
            name, sensor, [*(setup.postures or plan.postures)], file
        )
        for axis in split[name]
    )
    return _with_contacts(replace(plan, readings=readings), keys)


def _with_contacts(session: Session, keys: SessionKeys) -> Session:
    """Session with balls centred where no displacement is stated; all sensors touch.

    Raises:
        SessionError: If a sensor does not touch; names the setup and the posture.
    """
    undisplaced = [name for name in session.setups if "beside_mm" not in keys.setups.get(name, {})]
    session = centre_balls(session, undisplaced)
    check_contacts(session)
    return session


def _pair_postures(
    setup: str, sensor: Sensor, postures: list[str], file: Path
) -> list[tuple[str, str | None]]:
    """Planned postures of a setup, each with the other posture of its pair, or with None.

    Raises:
        SessionError: If a sensor that reads pairs has an odd number of postures.
    """
    if not reads_pairs(sensor):
        return [(posture, None) for posture in postures]
    if len(postures) % 2:
        raise SessionError(
            f"has {len(postures)} postures; expected pairs of postures",
            where=f"{file}: setups.{setup}.postures",
        )
    return [*zip(postures[::2], postures[1::2], strict=True)]


def read_purpose(
    keys: CalibrationKeys, robot: Robot, *, where: str
) -> tuple[Purpose | None, Robot]:
    """Purpose of a session, and its robot with the stated tolerances.

    Args:
        keys: Keys under `calibration`.
        robot: The robot of the session.
        where: File and key, for messages.

    Returns:
        Model and free errors, None if neither is stated; and the robot.

    Raises:
        SessionError: If the robot has no such model or name, or a unit or number is invalid.
    """
    key = "effects"
    try:
        if keys.effects is not None:
            robot = with_effects(robot, keys.effects)
        parameters = robot.parameters
        key = "model"
        patterns = [] if keys.model is None else parameters.patterns(keys.model)
        key = "free"
        free = parameters.select([*patterns, *keys.free])
        key = "tolerances"
        robot = robot.with_tolerances(keys.tolerances)
    except (ParameterError, RobotError) as e:
        raise SessionError(e.problem, where=f"{where}.{key}") from None
    if keys.model is None and not keys.free:
        return None, robot
    if not free:
        raise SessionError("selects no error", where=f"{where}.free")
    return Purpose(keys.model, tuple(keys.free)), robot


def check_contacts(session: Session) -> None:
    """Check that every sensor of the nominal machine touches in all postures of its readings.

    Raises:
        SessionError: If a sensor does not touch; names the setup and the posture.
    """
    for setup, (postures, contact) in locate_contacts(session).items():
        for posture, problem in zip(postures, contact.problems, strict=True):
            if problem:
                key = f"setups.{setup}.{contact.key}"
                raise SessionError(
                    f"in posture '{posture}' {problem}",
                    where=key if session.path is None else f"{session.path}: {key}",
                )


def _read_keys(path: Path) -> tuple[Path, bytes, SessionKeys]:
    """Path, content and keys of the session.yaml at a path or in a directory."""
    file = path / SESSION if is_folder(path) else path
    if file.suffix.lower() in OTHER_SUFFIXES:
        session = file.with_name(SESSION)
        hint = f"; its session is {session}" if exists(session) else list_sessions(file.parent)
        raise SessionError(f"is no {SESSION}{hint}", where=str(file))
    if file is not path and not exists(file):
        raise SessionError(_describe_content(path), where=str(path))
    if not exists(file) and (similar := get_close_matches(path.name, _names_in(path.parent), n=1)):
        raise SessionError(
            f"there is no such file or directory; did you mean {path.with_name(similar[0])}?",
            where=str(path),
        )
    content = read_file(file, error=SessionError)
    data = read_yaml(file, error=SessionError, content=content)
    return file, content, validate(SessionKeys, data, where=str(file), error=SessionError)


def _describe_content(folder: Path) -> str:
    """Problem of a directory without a session.yaml: it is a calibration, or contains sessions."""
    if exists(folder / "calibration.json"):
        return "is a calibration; name the session that it was made from"
    return f"is a directory without {SESSION}{list_sessions(folder)}"


def list_sessions(folder: Path) -> str:
    """Sessions in a directory, or one level deeper, as the end of a message; empty without any."""
    for pattern in (f"*/{SESSION}", f"*/*/{SESSION}"):
        sessions = sorted(str(f.parent) for f in islice(folder.glob(pattern), MAX_SEARCHED))
        if sessions:
            return f"; sessions there: {list_some(sessions, MAX_LISTED)}"
    return ""


def _names_in(folder: Path) -> list[str]:
    """Names of files and directories in a directory; empty if it is not readable."""
    try:
        return [f.name for f in islice(folder.iterdir(), MAX_SEARCHED)]
    except OSError:
        return []


_Setups = Mapping[str, tuple[SetupKeys, Sensor]]


def _read_setups(file: Path, keys: SessionKeys) -> _Setups:
    """Keys and sensor of each setup.

    Raises:
        SessionError: If a key is wrong, or keys are missing; names all missing ones.
    """
    gauges = keys.named_gauges
    single_gauge = next(iter(gauges.values())) if len(gauges) == 1 else GaugeKeys()
    setups, missing = {}, list[str]()
    for name, data in keys.setups.items():
        gauge_name = data.get("gauge")
        gauge = single_gauge
        if isinstance(gauge_name, str):
            gauge = gauges.get(gauge_name, single_gauge)
        defaults = gauge.model_dump(include={"tip", "scale_tolerance"}, exclude_none=True)
        under = f"setups.{name}"
        try:
            setups[name] = read_setup(
                data, where=str(file), under=under, error=SessionError, gauge=defaults
            )
        except SessionError as e:
            if not e.missing:
                raise
            missing += e.missing
    if missing:
        raise missing_keys_error(missing, str(file), SessionError)
    return setups


def _build_plan(file: Path, keys: SessionKeys, stated: _Setups) -> Session:
    """Session without its readings."""
    try:
        robot = load_robot(keys.robot, beside=file.parent)
    except RobotError as e:
        if e.where is None:
            raise SessionError(e.problem, where=f"{file}: robot") from None
        raise
    require_mechanical_zero(robot, f"{file}: robot")
    purpose, robot = read_purpose(
        keys.calibration or CalibrationKeys(), robot, where=f"{file}: calibration"
    )
    where, controller = f"{file}: controller", keys.controller or ControllerKeys.model_construct()
    offsets = read_drive_values(controller, "offsets", robot, where)
    compensation = build_compensation(controller, robot, folder=file.parent, where=where)
    firmware = build_firmware(controller, robot, where)
    for name in keys.adjusted_mm:
        require_adjustment(robot, name, where=f"{file}: adjusted_mm", error=SessionError)
    gauges = {name: g.to_gauge() for name, g in keys.named_gauges.items()}
    _require_gauges(stated, gauges, file)
    setups = {}
    for name, (setup, sensor) in stated.items():
        where = f"{file}: setups.{name}"
        sensor.require_fit(robot, where=where)
        _check_postures(setup, keys.postures, where)
        setups[name] = Setup(
            name,
            sensor,
            _gauge_of(setup, gauges, where),
            zero=setup.zero or default_zero(sensor),
            aligned_at=setup.aligned_at,
            payload=keys.payload_kg,
        )
    _check_shared(setups, str(file))
    session = Session(
        robot=robot,
        robot_reference=keys.robot,
        title=keys.title,
        source=keys.source,
        gauges=gauges,
        postures=build_postures(keys, robot, offsets, file),
        setups=setups,
        readings=(),
        controller_offsets=offsets,
        controller_origin=triple(controller.origin_mm or (0.0, 0.0, 0.0), MM),
        offsets_from=(
            Path(os.path.normpath(file.parent / keys.offsets_from)) if keys.offsets_from else None
        ),
        compensation=compensation,
        firmware=firmware,
        adjusted={name: amount * MM for name, amount in keys.adjusted_mm.items()},
        path=file,
        purpose=purpose,
        seed=keys.seed,
    )
    return split_points(session)


def _check_shared(setups: Mapping[str, Setup], file: str) -> None:
    """Refuse setups that share a parameter but differ in its place, tolerance or nominal value."""
    first: dict[tuple[str, str], tuple[Setup, NuisanceParameter]] = {}
    for setup in setups.values():
        for parameter in setup.sensor.nuisance_parameters:
            owner = f"gauge {setup.gauge}" if parameter.of_gauge else parameter.shared_by
            if owner is None:
                continue
            before, other = first.setdefault((owner, parameter.name), (setup, parameter))
            if not parameter.of_gauge and before.sensor.place != setup.sensor.place:
                problem = f"is mounted at {' '.join(before.sensor.place)}"
            elif other.prior_std != parameter.prior_std:
                tolerance = show_limit(other.prior_std) * other.edge_factor
                problem = f"states a tolerance of {tolerance:g} {other.edge_unit}"
            elif other.nominal != parameter.nominal:
                problem = f"states {other.nominal * other.edge_factor:g} {other.edge_unit}"
            else:
                continue
            raise SessionError(
                f"shares the {parameter.name} of '{owner}' with '{before.name}', which {problem}",
                where=f"{file}: setups.{setup.name}",
            )


def _require_gauges(stated: _Setups, gauges: Mapping[str, Gauge], file: Path) -> None:
    """Refuse setups without a gauge in a session with several gauges."""
    missing = [f"setups.{name}.gauge" for name, (keys, _) in stated.items() if keys.gauge is None]
    if missing and len(gauges) > 1:
        first, *others = missing
        raise SessionError(
            f"{describe_missing(others)}; expected one of {', '.join(gauges)}",
            where=f"{file}: {first}",
        )


def _gauge_of(setup: SetupKeys, gauges: Mapping[str, Gauge], where: str) -> str:
    """Name of a setup's gauge."""
    if setup.gauge is None:
        return next(iter(gauges))
    if setup.gauge not in gauges or not setup.gauge:
        names = ", ".join(name for name in gauges if name)
        raise SessionError(
            f"'{setup.gauge}' is not a gauge; "
            + (f"gauges: {names}" if names else "the session names none under `gauges`"),
            where=f"{where}.gauge",
        )
    return setup.gauge


def _check_postures(setup: SetupKeys, postures: Collection[str], where: str) -> None:
    """Refuse postures of a setup that do not exist or are listed twice."""
    if setup.aligned_at is not None:
        require_name(setup.aligned_at, postures, "posture", where=f"{where}.aligned_at")
    for posture, count in Counter(setup.postures or ()).items():
        require_name(posture, postures, "posture", where=f"{where}.postures")
        if count > 1:
            raise SessionError(f"'{posture}' is listed twice", where=f"{where}.postures")
