"""Sessions from files: session.yaml with its readings in a CSV beside it, in mm.

They are checked against the robot and the nominal machine.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import replace
from difflib import get_close_matches
from itertools import islice
from pathlib import Path

from orthocal.effects.adjustment import require_adjustment
from orthocal.effects.loading import load_robot, with_effects
from orthocal.errors import ParameterError, RobotError, SessionError
from orthocal.io.documents import read_yaml, validate
from orthocal.io.files import (
    content_withheld_outside,
    exists,
    is_folder,
    read_file,
    require_plain_name,
)
from orthocal.measurement.files.point_rows import locate_stations, split_points
from orthocal.measurement.files.readings_checks import check_readings, require_name, require_read
from orthocal.measurement.files.readings_file import read_rows
from orthocal.measurement.files.schema import MOST_READINGS, CalibrationKeys, GaugeKeys, SessionKeys
from orthocal.measurement.files.session_robot import (
    build_compensation,
    build_firmware,
    build_offsets,
    build_postures,
    require_given_zero,
)
from orthocal.observation.contacts import locate_contacts
from orthocal.robot.model import Robot
from orthocal.sensors.protocol import (
    NuisanceParameter,
    Sensor,
    SetupKeys,
    default_zero,
    reads_pairs,
)
from orthocal.sensors.registry import read_setup
from orthocal.session.points import base_name
from orthocal.session.session import Gauge, Purpose, Reading, Session, Setup
from orthocal.units import MM, show_limit

SESSION = "session.yaml"

MOST_LOOKED_AT = 200
"""Largest number of subdirectories searched for sessions."""

MOST_NAMED = 5
"""Largest number of sessions of subdirectories in a message."""

OTHER_KINDS = (".csv", ".json", ".urdf")
"""Suffixes of files of other kinds."""


def load_session(path: str | Path, *, partial: bool = False) -> Session:
    """Read a session: its YAML, its CSV and its robot, checked against each other.

    Args:
        path: The session.yaml, or the folder that holds it.
        partial: Whether some of the readings may be missing: their values are NaN.

    Raises:
        SessionError: Naming file and line or key, what was found and what was expected.
        RobotError: If the robot does not load.
    """
    file, content, keys = _read_keys(Path(path))
    session = _load_session(file, content, keys)
    require_read(session, partial=partial)
    return locate_stations(session)


def _load_session(file: Path, content: bytes, keys: SessionKeys) -> Session:
    """A session with readings, stations not located; readings of empty cells are NaN."""
    plan, readings_path = _build_unread(file, keys)
    table = read_file(readings_path, error=SessionError)
    with content_withheld_outside(file.parent, readings_path):
        rows = read_rows(readings_path, table)
        readings, points = check_readings(rows, plan, file=readings_path)
    digest = hashlib.sha256(content + b"\0" + table)
    for joint in plan.compensation:
        digest.update(b"" if joint.table is None else joint.table.tobytes())
    session = replace(
        plan,
        setups=points.setups,
        gauges=points.gauges,
        readings=readings,
        readings_path=readings_path,
        sha256=digest.hexdigest(),
    )
    check_contacts(session)
    return session


def load_unread(path: str | Path) -> tuple[Session, Path]:
    """Read a session without its readings, and where they are or shall be.

    Args:
        path: The session.yaml, or the folder that holds it.

    Raises:
        SessionError: Naming file and key.
        RobotError: If the robot does not load.
    """
    file, _, keys = _read_keys(Path(path))
    return _build_unread(file, keys)


def _build_unread(file: Path, keys: SessionKeys) -> tuple[Session, Path]:
    if keys.readings is None:
        raise SessionError("is missing; expected the name of a CSV file", where=f"{file}: readings")
    require_plain_name(file, error=SessionError)
    plan = _build_plan(file, keys, _read_setups(file, keys))
    if not keys.readings.strip() or "\0" in keys.readings:
        raise SessionError(
            f"found {keys.readings!r}; expected the name of a CSV file", where=f"{file}: readings"
        )
    return plan, file.parent / keys.readings


def load_plan(path: str | Path) -> Session:
    """Read a plan: a session.yaml without `readings`; each planned reading is 0.

    A setup is read in all postures, or in those its `postures` names; `cycles` times. A sensor that
    reads pairs of postures reads the first and second one, the third and fourth one and so on. A
    session that has readings is a plan too: that of its rows, filled in or not.

    Raises:
        SessionError: Naming file and key.
        RobotError: If the robot does not load.
    """
    session = load_rows(path)
    return replace(
        session,
        readings=tuple(r if r.is_read else replace(r, value=0.0) for r in session.readings),
    )


def load_rows(path: str | Path) -> Session:
    """Read a plan as `load_plan` does; readings that are not there yet are NaN.

    These are the empty cells of a session with readings; else all, and it has no `readings_path`.

    Raises:
        SessionError: Naming file and key.
        RobotError: If the robot does not load.
    """
    file, content, keys = _read_keys(Path(path))
    if keys.readings is not None:
        return locate_stations(_load_session(file, content, keys), partial=True)
    read = _read_setups(file, keys)
    count = keys.cycles * sum(len(s.postures or keys.postures) for s, _ in read.values())
    if count > MOST_READINGS:
        raise SessionError(
            f"plans {count} readings, {keys.cycles} times those of all setups; expected at most "
            f"{MOST_READINGS}",
            where=f"{file}: cycles",
        )
    plan = _build_plan(file, keys, read)
    parts: dict[str, list[str]] = {}
    for name in plan.setups:
        parts.setdefault(name if name in read else base_name(name), []).append(name)
    readings = tuple(
        Reading(part, posture, minus, cycle, math.nan)
        for name, (setup, sensor) in read.items()
        for cycle in range(1, keys.cycles + 1)
        for posture, minus in _planned(name, sensor, [*(setup.postures or plan.postures)], file)
        for part in parts[name]
    )
    session = replace(plan, readings=readings)
    check_contacts(session)
    return session


def _planned(
    setup: str, sensor: Sensor, postures: list[str], file: Path
) -> list[tuple[str, str | None]]:
    """Planned postures of a setup; those of a pair are neighbours in its list.

    Raises:
        SessionError: If a posture has no partner.
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
    keys: CalibrationKeys | None, robot: Robot, *, where: str
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
    if keys is None:
        return None, robot
    at = "effects"
    try:
        if keys.effects is not None:
            robot = with_effects(robot, keys.effects)
        parameters = robot.parameters
        at = "model"
        patterns = [] if keys.model is None else parameters.patterns(keys.model)
        at = "free"
        free = parameters.select([*patterns, *keys.free])
        at = "tolerances"
        robot = robot.with_tolerances(keys.tolerances)
    except (ParameterError, RobotError) as e:
        raise SessionError(e.problem, where=f"{where}.{at}") from None
    if keys.model is None and not keys.free:
        return None, robot
    if not free:
        raise SessionError("leaves no error free", where=f"{where}.free")
    return Purpose(keys.model, tuple(keys.free)), robot


def check_contacts(session: Session) -> None:
    """Check, on the nominal machine, that a sensor touches in every posture it is read in.

    Raises:
        SessionError: Naming the setup and the posture.
    """
    for setup, (postures, contact) in locate_contacts(session).items():
        for posture, problem in zip(postures, contact.problems, strict=True):
            if problem:
                raise SessionError(
                    f"in posture '{posture}' {problem}",
                    where=_where(session.path, f"setups.{setup}.{contact.key}"),
                )


def _where(path: Path | None, key: str) -> str:
    return key if path is None else f"{path}: {key}"


def _read_keys(path: Path) -> tuple[Path, bytes, SessionKeys]:
    file = path / SESSION if is_folder(path) else path
    if file.suffix.lower() in OTHER_KINDS:
        raise SessionError("is no session.yaml", where=str(file))
    if file is not path and not exists(file):
        raise SessionError(_describe_content(path), where=str(path))
    if not exists(file) and (near := get_close_matches(path.name, _names_in(path.parent), n=1)):
        meant = path.with_name(near[0])
        raise SessionError(
            f"there is no such file or directory; did you mean {meant}?", where=str(path)
        )
    content = read_file(file, error=SessionError)
    data = read_yaml(file, error=SessionError, content=content)
    return file, content, validate(SessionKeys, data, where=str(file), error=SessionError)


def _describe_content(folder: Path) -> str:
    """Problem of a directory without a session: a calibration, or sessions below it."""
    if exists(folder / "calibration.json"):
        return "is a calibration; name the session that it was made from"
    sessions = sorted(f.parent for f in islice(folder.glob(f"*/{SESSION}"), MOST_LOOKED_AT))
    if not sessions:
        return f"is a directory without {SESSION}"
    named = [str(s) for s in sessions[:MOST_NAMED]] + ["..."] * (len(sessions) > MOST_NAMED)
    return f"is a directory without {SESSION}; sessions in it: {', '.join(named)}"


def _names_in(folder: Path) -> list[str]:
    """Names of files and directories in a directory; none if it cannot be read."""
    try:
        return [f.name for f in islice(folder.iterdir(), MOST_LOOKED_AT)]
    except OSError:
        return []


_Setups = Mapping[str, tuple[SetupKeys, Sensor]]


def _read_setups(file: Path, keys: SessionKeys) -> _Setups:
    """Keys and sensor of each setup."""
    gauges = keys.named_gauges
    only = next(iter(gauges.values())) if len(gauges) == 1 else GaugeKeys()
    setups = {}
    for name, data in keys.setups.items():
        named = data.get("gauge")
        gauge = gauges.get(named, only) if isinstance(named, str) else only
        defaults = gauge.model_dump(include={"tip", "scale_tolerance"}, exclude_none=True)
        setups[name] = read_setup(
            data, where=str(file), under=f"setups.{name}", error=SessionError, gauge=defaults
        )
    return setups


def _build_plan(file: Path, keys: SessionKeys, read: _Setups) -> Session:
    """The session without its readings."""
    try:
        robot = load_robot(keys.robot, beside=file.parent)
    except RobotError as e:
        if e.where is None:
            raise SessionError(e.problem, where=f"{file}: robot") from None
        raise
    require_given_zero(robot, f"{file}: robot")
    purpose, robot = read_purpose(keys.calibration, robot, where=f"{file}: calibration")
    where = f"{file}: controller"
    offsets = build_offsets(keys.controller, robot, where)
    compensation = build_compensation(keys.controller, robot, folder=file.parent, where=where)
    firmware = build_firmware(keys.controller, robot, where)
    for name in keys.adjusted_mm:
        require_adjustment(robot, name, where=f"{file}: adjusted_mm", error=SessionError)
    gauges = {name: g.to_gauge() for name, g in keys.named_gauges.items()}
    setups = {}
    for name, (setup, sensor) in read.items():
        where = f"{file}: setups.{name}"
        sensor.require_fit(robot, where=where)
        _check_postures(setup, keys.postures, where)
        gauge, zero = _gauge_of(setup, gauges, where), setup.zero or default_zero(sensor)
        setups[name] = Setup(
            name,
            sensor,
            gauge,
            zero=zero,
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
        compensation=compensation,
        firmware=firmware,
        adjusted={name: amount * MM for name, amount in keys.adjusted_mm.items()},
        path=file,
        purpose=purpose,
        seed=keys.seed,
    )
    return split_points(session)


def _check_shared(setups: Mapping[str, Setup], file: str) -> None:
    """Refuse setups that share a parameter at another place or with another tolerance."""
    first: dict[tuple[str, str], tuple[Setup, NuisanceParameter]] = {}
    for setup in setups.values():
        for parameter in setup.sensor.nuisance_parameters:
            owner = f"gauge {setup.gauge}" if parameter.of_gauge else parameter.shared_by
            if owner is None:
                continue
            before, other = first.setdefault((owner, parameter.name), (setup, parameter))
            if not parameter.of_gauge and before.sensor.place != setup.sensor.place:
                problem = f"stands at {' '.join(before.sensor.place)}"
            elif other.prior_std != parameter.prior_std:
                problem = f"states a tolerance of {show_limit(other.prior_std):g} {other.unit}"
            elif other.nominal != parameter.nominal:
                problem = f"states {other.nominal:g} {other.unit}"
            else:
                continue
            raise SessionError(
                f"shares the {parameter.name} of '{owner}' with '{before.name}', which {problem}",
                where=f"{file}: setups.{setup.name}",
            )


def _gauge_of(setup: SetupKeys, gauges: Mapping[str, Gauge], where: str) -> str:
    """Name of a setup's gauge."""
    if setup.gauge is None:
        if len(gauges) > 1:
            raise SessionError(
                f"is missing; expected one of {', '.join(gauges)}", where=f"{where}.gauge"
            )
        return next(iter(gauges))
    if setup.gauge not in gauges or not setup.gauge:
        named = ", ".join(name for name in gauges if name)
        raise SessionError(
            f"'{setup.gauge}' is not a gauge; "
            + (f"gauges: {named}" if named else "the session names none under `gauges`"),
            where=f"{where}.gauge",
        )
    return setup.gauge


def _check_postures(setup: SetupKeys, postures: Collection[str], where: str) -> None:
    """Refuse postures of a setup that do not exist, or are planned twice."""
    if setup.aligned_at is not None:
        require_name(setup.aligned_at, postures, "posture", where=f"{where}.aligned_at")
    for posture, count in Counter(setup.postures or ()).items():
        require_name(posture, postures, "posture", where=f"{where}.postures")
        if count > 1:
            raise SessionError(f"'{posture}' stands twice", where=f"{where}.postures")
