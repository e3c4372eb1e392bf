"""The robot in calibration.json: its files, and checks of the record against it.

The embedded files are those of the calibrated robot. Its original directory may have changed.
"""

from __future__ import annotations

import base64
import hashlib
import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path, PurePosixPath

from orthocal.calibration.records import (
    CalibrationRecord,
    RobotFile,
    RobotRecord,
    SessionRecord,
    SetupRecord,
)
from orthocal.effects.adjustment import require_adjustment
from orthocal.effects.loading import (
    load_robot,
    load_robot_content,
    with_adjustments,
    with_effects,
)
from orthocal.errors import CalibrationFileError, ParameterError, RobotError, SessionError
from orthocal.io.fields import finite_or_none
from orthocal.measurement.files.readings_checks import check_conditions
from orthocal.robot.files import LARGEST_MESHES, MESH_FORMATS, collect_files
from orthocal.robot.loading import content_digest, packaged_robots, robot_digest
from orthocal.robot.model import Robot
from orthocal.session.session import Session
from orthocal.text import printable, shorten, text_problem


def record_robot(session: Session) -> RobotRecord:
    """Record of the robot of a session, with its files."""
    robot = session.robot
    packaged = session.robot_reference in packaged_robots()
    return RobotRecord(
        name=robot.name,
        reference=session.robot_reference,
        directory=None if packaged or robot.folder is None else str(robot.folder.resolve()),
        sha256=robot.sha256,
        files=_record_files(robot),
        legs=tuple((name, leg.length) for name, leg in robot.legs.items()),
        travel=tuple(
            (d.name, d.unit, finite_or_none(d.lower), finite_or_none(d.upper)) for d in robot.drives
        ),
        tolerances=tuple(robot.parameters.stated.items()),
        effects=robot.chosen_effects,
        adjusted=robot.adjusted,
    )


@lru_cache(maxsize=8)
def _record_files(robot: Robot) -> tuple[RobotFile, ...]:
    """Files of a robot as text, or as base64 if they are binary."""
    files = []
    for name, content in collect_files(robot).items():
        text: str | None = content.decode(errors="surrogateescape")
        binary = None
        if text_problem(text):
            text, binary = None, base64.b64encode(content).decode()
        files.append(RobotFile(name, hashlib.sha256(content).hexdigest(), text, binary))
    return tuple(files)


def load_recorded_robot(record: RobotRecord, *, file: str) -> Robot:
    """Nominal robot of a record, with the tolerances of the record.

    The robot is built from the embedded files. If its directory exists and is unchanged, the robot
    is loaded from there, so that it is shared. If the directory has changed, a warning is logged.

    Args:
        record: Record of the robot in a calibration.json.
        file: File name, for messages.

    Raises:
        CalibrationFileError: If a file or a tolerance is invalid; names the key.
    """
    content = {
        f.name: _read_content(f, f"{file}: robot.files[{i}]") for i, f in enumerate(record.files)
    }
    urdf, yaml = _require_robot_files(content, len(record.files), f"{file}: robot.files")
    if content_digest(urdf, yaml) != record.sha256:
        raise CalibrationFileError(
            f"found {shorten(record.sha256)}; the embedded URDF and YAML have "
            f"{content_digest(urdf, yaml)}",
            where=f"{file}: robot.sha256",
        )
    packaged = record.reference in packaged_robots()
    source = record.reference if packaged and record.directory is None else record.directory
    present = None if source is None else robot_digest(source)
    try:
        if source is not None and present == record.sha256:
            robot = load_robot(source)
        else:
            robot = load_robot_content(record.name, content)
    except RobotError as e:
        place = (e.where or "").removeprefix(str(Path(record.name)) + os.sep)
        raise CalibrationFileError(e.problem, where=f"{file}: robot.files: {place}") from None
    if present not in (None, record.sha256):
        logging.getLogger(__name__).warning(
            "%s: the files of robot '%s' in %s have changed since the calibration. The robot is "
            "used as it was calibrated.",
            *(printable(text) for text in (file, record.name, str(source))),
        )
    with _errors_at(f"{file}: robot.effects"):
        robot = with_effects(robot, record.effects)
    if record.adjusted:
        robot = with_adjustments(robot)
    with _errors_at(f"{file}: robot.tolerances"):
        return robot.with_tolerances(dict(record.tolerances))


def _read_content(file: RobotFile, where: str) -> bytes:
    """Content of an embedded file, compared with its checksum."""
    if (file.text is None) == (file.base64 is None):
        raise CalibrationFileError("expected either text or base64", where=where)
    try:
        if file.base64 is None:
            content = (file.text or "").encode()
        else:
            content = base64.b64decode(file.base64, validate=True)
    except ValueError:
        raise CalibrationFileError("is not base64", where=f"{where}.base64") from None
    digest = hashlib.sha256(content).hexdigest()
    if digest != file.sha256:
        raise CalibrationFileError(
            f"found {shorten(file.sha256)}; the content of {file.name} has {digest}",
            where=f"{where}.sha256",
        )
    return content


def _require_robot_files(
    content: Mapping[str, bytes], count: int, where: str
) -> tuple[bytes, bytes]:
    """URDF and YAML of an embedded robot; all other files must be meshes of limited size."""
    if len(content) != count:
        raise CalibrationFileError("two files have the same name", where=where)
    main_files = sorted(
        (name for name in content if "/" not in name and name.endswith((".urdf", ".yaml"))),
        key=lambda name: name[-5:],
    )
    if [name[-5:] for name in main_files] != [".urdf", ".yaml"]:
        raise CalibrationFileError(
            f"expected one .urdf and one .yaml; found {shorten(', '.join(main_files)) or 'none'}",
            where=where,
        )
    meshes = content.keys() - set(main_files)
    for name in sorted(meshes):
        parents = {parent.as_posix() for parent in PurePosixPath(name).parents}
        if not name.lower().endswith(MESH_FORMATS) or parents & content.keys():
            raise CalibrationFileError(
                f"'{shorten(name)}' is neither the URDF nor the YAML nor a mesh "
                f"({', '.join(MESH_FORMATS)})",
                where=where,
            )
    mesh_bytes = sum(len(content[name]) for name in meshes)
    if mesh_bytes > LARGEST_MESHES:
        raise CalibrationFileError(
            f"has meshes of {mesh_bytes / 2**20:.1f} MiB; expected at most "
            f"{LARGEST_MESHES / 2**20:g} MiB",
            where=where,
        )
    urdf, yaml = main_files
    return content[urdf], content[yaml]


def require_calibrated_robot(calibration: CalibrationRecord, session: Session) -> None:
    """Refuse a session of another robot than the calibrated one.

    Raises:
        SessionError: If the robots differ; names both.
    """
    record = calibration.robot_record
    if session.robot.sha256 != record.sha256:
        raise SessionError(
            f"is of robot '{session.robot.name}'; the calibration is of another, or of another "
            f"version of '{record.name}'. If the files of the robot have changed since, calibrate "
            "again",
            where=None if session.path is None else str(session.path),
        )


def require_consistent(record: CalibrationRecord, robot: Robot, *, file: str) -> None:
    """Refuse a record that does not fit its robot, or rows with unknown setups or postures.

    Args:
        record: The record.
        robot: Its robot.
        file: File name, for messages.

    Raises:
        CalibrationFileError: If the record is inconsistent; names the key.
    """
    for i, p in enumerate(record.parameters):
        with _errors_at(f"{file}: parameters[{i}].name"):
            unit = robot.parameters[p.name].unit
        if p.unit != unit:
            raise CalibrationFileError(
                f"found '{p.unit}'; {p.name} is in {unit}", where=f"{file}: parameters[{i}].unit"
            )
    for i, name in enumerate(record.unmodelled.names):
        with _errors_at(f"{file}: unmodelled.names[{i}]"):
            robot.parameters[name]
    for key, problem in (*_wrong_counts(record, robot), *_unknown_names(record, robot)):
        raise CalibrationFileError(problem, where=f"{file}: {key}")
    for i, setup in enumerate(record.setups):
        with _errors_at(f"{file}: setups[{i}].reads"):
            setup.sensor.require_fit(robot, where=f"{file}: setups[{i}].reads")
    for key, stating in _stating(record):
        for name, _ in stating.adjusted or ():
            where = f"{file}: {key}.adjusted"
            require_adjustment(robot, name, where=where, error=CalibrationFileError)
    for i, row in enumerate(record.residuals):
        if row.conditions is not None:
            with _errors_at(f"{file}: residuals[{i}].conditions"):
                check_conditions(row.conditions, robot, two_postures=row.minus is not None)


@contextmanager
def _errors_at(where: str) -> Iterator[None]:
    """Convert errors about the robot to errors of the file, at a key unless they state a place."""
    try:
        yield
    except (ParameterError, RobotError, SessionError) as e:
        raise CalibrationFileError(e.problem, where=e.where or where) from None


def _wrong_counts(record: CalibrationRecord, robot: Robot) -> Iterator[tuple[str, str]]:
    """Keys with a wrong number of coordinates, offsets or compensations, with the problem."""
    n_passive = robot.passive_index.size
    for i, p in enumerate(record.postures):
        for key, values in (("values", p.values), ("drives", p.drives)):
            if len(values) != len(robot.drives):
                expected = f"expected {len(robot.drives)}, one per drive"
                yield f"postures[{i}].{key}", f"has {len(values)} numbers; {expected}"
        if len(p.passive) != n_passive:
            expected = f"expected {n_passive}, one per passive joint"
            yield f"postures[{i}].passive", f"has {len(p.passive)} numbers; {expected}"
    names = [d.name for d in robot.drives]
    expected = f"expected {len(names)}, one per drive: {', '.join(names)}"
    for key, stating in _stating(record):
        name = "active" if isinstance(stating, SetupRecord) else "controller_offsets"
        offsets, joints = getattr(stating, name), stating.compensation or ()
        if offsets is not None and len(offsets) != len(names):
            yield f"{key}.{name}", f"has {len(offsets)} numbers; {expected}"
        if joints and len(joints) != len(names):
            yield f"{key}.compensation", f"has {len(joints)} items; {expected}"
        for i, joint in enumerate(joints):
            table = joint.table
            if table is not None and not (
                table.ndim == 2 and table.shape[1] == 3 and (table[1:, 0] > table[:-1, 0]).all()
            ):
                yield (
                    f"{key}.compensation[{i}].table",
                    "expected increasing positions, each with two trims",
                )


def _stating(record: CalibrationRecord) -> Iterator[tuple[str, SessionRecord | SetupRecord]]:
    """Keys and records of sessions and setups, which state what the controller corrected."""

    def sessions(key: str, session: SessionRecord) -> Iterator[tuple[str, SessionRecord]]:
        yield key, session
        for i, part in enumerate(session.parts):
            yield from sessions(f"{key}.parts[{i}]", part)

    yield from sessions("session", record.session)
    yield from ((f"setups[{i}]", setup) for i, setup in enumerate(record.setups))


def _unknown_names(record: CalibrationRecord, robot: Robot) -> Iterator[tuple[str, str]]:
    """Keys with names of unknown setups, postures, gauges and drives, with the problem."""
    postures, setups = {p.name for p in record.postures}, {s.name for s in record.setups}
    gauges, drives = {g.name for g in record.gauges}, {d.name for d in robot.drives}
    read, references = {row.setup for row in record.residuals}, []
    for i, setup in enumerate(record.setups):
        references.append((f"setups[{i}].aligned_at", setup.aligned_at, "postures", postures))
        if setup.name in read:
            references.append((f"setups[{i}].gauge", setup.gauge, "gauges", gauges))
    if record.assessment is not None:
        for key in ("entries", "backlash"):
            references += [
                (f"assessment.{key}[{i}].drive", entry.drive, "drives", drives)
                for i, entry in enumerate(getattr(record.assessment, key))
            ]
    for i, row in enumerate(record.residuals):
        references += [
            (f"residuals[{i}].setup", row.setup, "setups", setups),
            (f"residuals[{i}].posture", row.posture, "postures", postures),
            (f"residuals[{i}].minus", row.minus or row.posture, "postures", postures),
        ]
    for key, name, kind, known_names in references:
        if name not in known_names:
            yield key, f"'{name}' is not among the file's {kind}"
