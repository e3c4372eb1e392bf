"""Calibration, session or robot that a path names."""

from __future__ import annotations

from pathlib import Path

from orthocal.calibration.calibration import Calibration
from orthocal.calibration.file import load_calibration
from orthocal.effects.loading import load_robot
from orthocal.errors import OrthocalError
from orthocal.io.files import exists, is_folder
from orthocal.measurement.files.session_file import list_sessions, load_plan
from orthocal.robot.loading import packaged_robots
from orthocal.robot.model import Robot
from orthocal.session.session import Session

Subject = Calibration | Session | Robot


def load_subject(path: str | Path) -> Subject:
    """A calibration, a session (or a plan of one) or a robot, by its path or name.

    A directory with both a calibration and a session is the calibration.

    Args:
        path: calibration.json, session.yaml, a directory that contains one, or a robot's directory
            or name.

    Raises:
        OrthocalError: If it is none of these, or does not load.
    """
    file = Path(path)
    if not exists(file):
        if str(path) in packaged_robots():
            return load_robot(str(path))
        raise OrthocalError(
            "there is no such file or directory; expected a calibration.json, a session.yaml, a "
            "directory that contains one, or a robot "
            f"({', '.join(packaged_robots())}, or its directory)",
            where=str(path),
        )
    if not is_folder(file):
        return _load_file(file)
    if exists(file / "calibration.json"):
        return load_calibration(file)
    if exists(file / "session.yaml"):
        return load_plan(file)
    if not any(file.glob("*.urdf")):
        raise OrthocalError(
            "contains no calibration.json and no session.yaml, and is no robot directory: it "
            f"contains no *.urdf{list_sessions(file)}",
            where=str(path),
        )
    return load_robot(file.resolve())


def _load_file(file: Path) -> Subject:
    kind = file.suffix.lower()
    if kind == ".json":
        return load_calibration(file)
    if kind == ".urdf" or (kind in (".yaml", ".yml") and exists(file.with_suffix(".urdf"))):
        return load_robot(file.resolve().parent)
    if kind in (".yaml", ".yml"):
        return load_plan(file)
    raise OrthocalError(
        "is neither a calibration.json nor a session.yaml, nor a robot's URDF or YAML",
        where=str(file),
    )
