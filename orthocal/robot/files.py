"""Files of a robot: its URDF, its YAML, and the meshes of the URDF."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path, PurePosixPath, PureWindowsPath
from types import MappingProxyType

from orthocal.errors import RobotError
from orthocal.io.files import exists, read_file
from orthocal.robot.model import Robot
from orthocal.robot.urdf import parse_urdf

MESH_FORMATS = (".stl", ".obj", ".dae", ".ply")
"""File extensions of meshes."""

LARGEST_MESHES = 8 * 2**20
"""Largest total size of the meshes that are stored with a robot, [bytes]."""

LONGEST_NAME = 255
"""Largest length of the path of a stored file, [bytes]."""

MOST_FILES = 1_000
"""Largest number of files of a stored robot."""


def mesh_path(reference: str) -> Path:
    """Path of a mesh relative to the robot's directory, without package name or file://."""
    if reference.startswith("package://"):
        return Path(*Path(reference.removeprefix("package://")).parts[1:])
    return Path(reference.removeprefix("file://"))


def is_inner_path(name: str) -> bool:
    """True for a short relative path that does not leave its directory on any system."""
    parts = PureWindowsPath(name).parts  # separated by / or \\
    outside = PureWindowsPath(name).anchor or ".." in parts
    short = len(name.encode(errors="surrogateescape")) <= LONGEST_NAME
    return bool(parts and not outside and short and name == PurePosixPath(name).as_posix())


@lru_cache(maxsize=8)
def collect_files(robot: Robot) -> Mapping[str, bytes]:
    """Content of all files of a robot by name: URDF, YAML, then meshes.

    Meshes are needed for drawings only. All are omitted if their total size exceeds LARGEST_MESHES,
    the number of files exceeds MOST_FILES, or one cannot be read. Meshes outside of the directory
    or of other formats are omitted singly.
    """
    if robot.folder is None:
        return robot.content
    meshes: dict[str, bytes] = {}
    size = 0
    for mesh in parse_urdf(robot.urdf, content=robot.content[robot.urdf.name]).iter("mesh"):
        name = Path(os.path.normpath(mesh_path(mesh.get("filename") or ""))).as_posix()
        path = robot.folder / name
        if name in meshes or not is_inner_path(name) or path.suffix.lower() not in MESH_FORMATS:
            continue
        is_inside = path.resolve().is_relative_to(robot.folder.resolve())
        if not (is_inside and exists(path)):
            continue
        try:
            meshes[name] = read_file(path, error=RobotError, largest=LARGEST_MESHES - size)
        except RobotError:  # too large, or no regular file
            return robot.content
        size += len(meshes[name])
        if len(meshes) + len(robot.content) > MOST_FILES:
            return robot.content
    return MappingProxyType({**robot.content, **meshes})


@contextmanager
def robot_directory(robot: Robot) -> Iterator[Path]:
    """Directory with the meshes of a robot; a temporary one for an embedded robot."""
    if robot.folder is not None:
        yield robot.folder.resolve()
        return
    with tempfile.TemporaryDirectory(prefix="orthocal-") as directory:
        folder = Path(directory).resolve()
        for name, content in robot.content.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        yield folder
