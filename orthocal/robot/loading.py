"""Loading of robots: URDF and YAML are checked against each other, and the loops are closed."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pinocchio as pin

from orthocal.arrays import Array
from orthocal.errors import ParameterError, RobotError
from orthocal.io.fields import read_only
from orthocal.io.files import content_withheld_outside, is_folder, read_file, require_plain_name
from orthocal.robot.description import (
    ClosureKeys,
    DriveKeys,
    JointKeys,
    LegKeys,
    RobotKeys,
    RodKeys,
    load_description,
)
from orthocal.robot.frames import find_frame, frame_jacobian
from orthocal.robot.model import (
    Closure,
    Drive,
    Leg,
    Robot,
    Rod,
    Tcp,
    Use,
    build_constraints,
    coordinate_limits,
    joint_unit,
)
from orthocal.robot.parameters import AXES, ParameterSet, split_unit
from orthocal.robot.reference_posture import find_reference_posture
from orthocal.robot.urdf import load_urdf
from orthocal.text import shorten
from orthocal.units import DRIVE_UNITS, MM, Unit

LONGEST_LEG = 20.0
"""Largest length of a leg, [m]; larger values are in mm."""

MAX_LOADED = 8
"""Robots cached in memory, because sessions and calibrations load the same robot repeatedly."""


def packaged_robots() -> dict[str, Path]:
    """Directories of the built-in robots by name."""
    package = Path(str(resources.files("orthocal")))
    # an installed package contains the robots; a source tree has them beside the package
    for folder in (package / "_robots", package.parent / "robots"):
        if folder.is_dir():
            return {f.name: f for f in sorted(folder.iterdir()) if any(f.glob("*.urdf"))}
    return {}


def load_bare_robot(robot: str | Path, *, beside: Path | None = None) -> Robot:
    """Load a robot without its error parameters, which `orthocal.effects.loading` adds.

    URDF and YAML are checked against each other, and the loops are closed. The same files return
    the same object.

    Args:
        robot: Name of a built-in robot, or path to a robot directory.
        beside: Directory to which a relative path refers; the working directory by default.

    Raises:
        RobotError: If the files are missing or invalid; names the file and the line or key.
    """
    packaged = packaged_robots()
    if str(robot) in packaged:
        return _load_folder(packaged[str(robot)])
    folder = Path(robot) if beside is None else beside / robot
    if not str(robot) or not is_folder(folder):
        raise RobotError(
            f"'{robot}' is neither a robot of orthocal ({', '.join(packaged)}) "
            f"nor a directory ({folder})"
        )
    if beside is not None and not any((*folder.glob("*.urdf"), *folder.glob("*.yaml"))):
        raise RobotError(
            f"found '{robot}', expected the directory of a robot; {folder} has no URDF and no "
            "YAML. A session that was moved needs the new path of its robot"
        )
    return _load_folder(folder)


def load_bare_content(
    name: str, content: Mapping[str, bytes], *, folder: Path | None = None
) -> Robot:
    """Load a robot from the content of its files: `load_bare_robot` without a directory.

    Args:
        name: Name of the robot.
        content: File names, mapped to contents: one URDF, one YAML, and meshes.
        folder: Directory from which the files were read; it need not exist any more.

    Raises:
        RobotError: If the files are invalid; names NAME/FILE and the line or key.
    """
    urdf, yaml = (
        next((file for file in content if file.endswith(suffix)), "")
        for suffix in (".urdf", ".yaml")
    )
    if not urdf or not yaml:
        raise RobotError("expected a URDF file and a YAML file")
    place = Path(name) if folder is None else folder
    return _build_robot(name, folder, place / yaml, place / urdf, tuple(content.items()))


def robot_digest(robot: str | Path) -> str | None:
    """SHA-256 of the URDF and YAML of a robot; None if they cannot be read.

    Args:
        robot: Name of a built-in robot, or path to a robot directory.
    """
    try:
        _, _, (urdf, yaml) = _read_folder(packaged_robots().get(str(robot), Path(robot)))
    except RobotError:
        return None
    return content_digest(urdf, yaml)


def content_digest(urdf: bytes, yaml: bytes) -> str:
    """SHA-256 of the URDF and the YAML of a robot."""
    return hashlib.sha256(urdf + b"\0" + yaml).hexdigest()


def _load_folder(folder: Path) -> Robot:
    """Load a robot without error parameters from its directory."""
    require_plain_name(folder.resolve(), error=RobotError)
    urdf_path, yaml_path, content = _read_folder(folder)
    name = folder.resolve().name
    files = tuple(zip((urdf_path.name, yaml_path.name), content, strict=True))
    with content_withheld_outside(folder, yaml_path, urdf_path):
        return _build_robot(name, folder, yaml_path, urdf_path, files)


def _read_folder(folder: Path) -> tuple[Path, Path, tuple[bytes, bytes]]:
    """Paths of the URDF and the YAML of a robot directory, and their contents in this order."""
    yaml_path, urdf_path = find_robot_files(folder)
    urdf, yaml = (read_file(p, error=RobotError) for p in (urdf_path, yaml_path))
    return urdf_path, yaml_path, (urdf, yaml)


@lru_cache(maxsize=MAX_LOADED)
def _build_robot(
    name: str,
    folder: Path | None,
    yaml_path: Path,
    urdf_path: Path,
    files: tuple[tuple[str, bytes], ...],
) -> Robot:
    """Build a robot from the content of its files."""
    content = MappingProxyType(dict(files))
    urdf, description = content[urdf_path.name], content[yaml_path.name]
    keys = load_description(yaml_path, content=description)
    where = str(yaml_path)
    model = load_urdf(urdf_path, content=urdf, joint_types=keys.joint_types, declared_in=where)

    drives = tuple(_build_drive(model, motor, keys, where) for motor in keys.name_mot)
    drive_index = np.array([model.joints[model.getJointId(d.name)].idx_v for d in drives])
    passive_index = np.setdiff1d(np.arange(model.nv), drive_index)
    for index in (drive_index, passive_index):
        index.setflags(write=False)
    closures = _build_closures(model, keys, where)
    robot = Robot(
        name=name,
        folder=folder,
        urdf=urdf_path,
        yaml=yaml_path,
        content=content,
        sha256=content_digest(urdf, description),
        model=model,
        constraints=build_constraints(model, closures),
        drives=drives,
        closures=closures,
        legs={},
        tcp=_build_tcp(model, keys, where),
        workspace=_read_workspace(keys, where),
        bed=_read_bed(keys, where),
        use=_read_use(keys, where),
        declared=keys.orthocal,
        parameters=ParameterSet(),
        drive_index=drive_index,
        passive_index=passive_index,
        reference_posture=read_only(np.zeros(model.nv)),
        drive_gain=read_only(np.ones(len(drives))),
    )
    fixed_zeros = [_has_zero(keys, d.name) for d in drives]
    robot = find_reference_posture(
        robot, _passive_start(robot, keys, where), fixed_zeros=fixed_zeros
    )
    return replace(robot, legs=_build_legs(robot, keys, where))


def find_robot_files(folder: Path) -> tuple[Path, Path]:
    """YAML and URDF of a robot directory.

    They have the name of the directory. In a renamed directory they are its only URDF, and the YAML
    of the same name as this URDF.

    Raises:
        RobotError: If there is no URDF or no YAML, or if several have other names.
    """
    urdf = _find_file(folder, ".urdf", folder.resolve().name)
    return _find_file(folder, ".yaml", folder.resolve().name, urdf.stem), urdf


def _find_file(folder: Path, suffix: str, *names: str) -> Path:
    """File with the first of some names that exists, otherwise the only file with the suffix."""
    preferred = [folder / f"{name}{suffix}" for name in names]
    files = [p for p in preferred if p.is_file()][:1] or sorted(folder.glob(f"*{suffix}"))
    if len(files) != 1:
        listed = ", ".join(f.name for f in files) or "none"
        raise RobotError(
            f"expected one {suffix[1:].upper()} file, or one named {preferred[-1].name}; found "
            f"{listed}",
            where=str(folder),
        )
    return files[0]


def _has_zero(keys: RobotKeys, motor: str) -> bool:
    """True if the YAML states the mechanical zero of a motor."""
    entry = keys.orthocal.drives.get(motor)
    return entry is not None and (entry.zero_mm is not None or entry.zero_deg is not None)


def _build_drive(model: pin.Model, motor: str, keys: RobotKeys, where: str) -> Drive:
    """Build the drive of a motor: unit, mechanical zero, limits and joint of the controller."""
    if not model.existJointName(motor):
        joints = ", ".join(list(model.names)[1:]) or "none"
        raise RobotError(
            f"the URDF has no moving joint '{motor}'; joints: {joints}", where=f"{where}: name_mot"
        )
    joint = model.joints[model.getJointId(motor)]
    unit = joint_unit(model, joint.id)
    here = f"{where}: orthocal.drives.{motor}"
    entry = keys.orthocal.drives.get(motor, DriveKeys())
    joint_keys = entry.joint or JointKeys()
    zero = _in_drive_unit(entry, "zero", unit, here) or 0.0
    lower, upper = (float(limits[joint.idx_v]) for limits in coordinate_limits(model))
    if _has_zero(keys, motor) and not lower <= zero <= upper:
        name, size = DRIVE_UNITS[unit]
        raise RobotError(
            f"the zero, {zero / size:g} {name}, is outside the joint's limits "
            f"{lower / size:g} ... {upper / size:g} {name}",
            where=here,
        )
    return Drive(
        motor,
        unit,
        zero,
        lower,
        upper,
        direction=1 if joint_keys.counts == "up" else -1,
        joint_zero=_in_drive_unit(joint_keys, "at_zero", unit, f"{here}.joint"),
    )


def _in_drive_unit(keys: DriveKeys | JointKeys, key: str, unit: Unit, where: str) -> float | None:
    """Value of a key in the unit of a drive, [m, rad]; None if it is absent."""
    expected, other = (f"{key}_mm", f"{key}_deg") if unit == "m" else (f"{key}_deg", f"{key}_mm")
    if getattr(keys, other) is not None:
        kind = "prismatic" if unit == "m" else "revolute"
        raise RobotError(f"the drive is {kind}; expected {expected}", where=f"{where}.{other}")
    value = getattr(keys, expected)
    return None if value is None else float(value * DRIVE_UNITS[unit][1])


def _build_closures(model: pin.Model, keys: RobotKeys, where: str) -> tuple[Closure, ...]:
    """Build the closures of the pairs of frames in the YAML."""
    entries = keys.orthocal.closures or {
        f"closure_{i + 1}": ClosureKeys() for i in range(len(keys.type))
    }
    closures = []
    for i, (name, pair, kind) in enumerate(zip(entries, keys.closed_loop, keys.type, strict=True)):
        for frame in pair:
            find_frame(model, frame, where=f"{where}: closed_loop[{i}]")
        if pair[0] == pair[1]:
            raise RobotError(
                f"closes the frame '{pair[0]}' on itself", where=f"{where}: closed_loop[{i}]"
            )
        rows = entries[name].rows or AXES[: 3 if kind == "3d" else 6]
        indices = tuple(sorted(AXES.index(row) for row in rows))
        closures.append(Closure(name, pair[0], pair[1], kind, indices))
    return tuple(closures)


def _build_tcp(model: pin.Model, keys: RobotKeys, where: str) -> Tcp | None:
    """Build the tool centre point; None without one in the YAML."""
    tcp = keys.orthocal.tcp
    if tcp is None:
        return None
    find_frame(model, tcp.frame, where=f"{where}: orthocal.tcp.frame")
    return Tcp(tcp.frame, tuple(sorted("xyz".index(c) for c in set(tcp.coordinates))))


def _read_workspace(keys: RobotKeys, where: str) -> Array | None:
    """Box of the workspace, shape (n_coordinates, 2), [m]."""
    tcp, workspace = keys.orthocal.tcp, keys.orthocal.workspace
    if workspace is None:
        return None
    names = sorted(set(tcp.coordinates)) if tcp else []
    if len(workspace.box_mm) != len(names):
        raise RobotError(
            f"has {len(workspace.box_mm)} ranges; expected one for each coordinate of "
            f"orthocal.tcp: {', '.join(names) or 'none'}",
            where=f"{where}: orthocal.workspace.box_mm",
        )
    return read_only(np.array(workspace.box_mm) * MM)


def _read_bed(keys: RobotKeys, where: str) -> float | None:
    """Lowest coordinate z of the tool relative to the mechanical zero, [m]; None without a bed."""
    tcp, workspace, bed = keys.orthocal.tcp, keys.orthocal.workspace, keys.orthocal.bed
    if bed is None:
        return None
    if tcp is None or "z" not in tcp.coordinates:
        raise RobotError(
            "needs a tool that moves along z; expected z among the coordinates of orthocal.tcp",
            where=f"{where}: orthocal.bed",
        )
    if workspace is None:
        raise RobotError(
            "needs orthocal.workspace, because the default one extends below the mechanical zero",
            where=f"{where}: orthocal.bed",
        )
    lowest = workspace.box_mm[sorted(set(tcp.coordinates)).index("z")][0]
    if lowest < bed.z_mm:
        raise RobotError(
            f"begins at z {lowest:g} mm, below the bed; expected at least {bed.z_mm:g} mm, as "
            "orthocal.bed states",
            where=f"{where}: orthocal.workspace.box_mm",
        )
    return bed.z_mm * MM


def _read_use(keys: RobotKeys, where: str) -> Use:
    """Conditions under which the machine is used."""
    use, motors = keys.orthocal.use, keys.name_mot
    approach = "u" * len(motors) if use.approach == "both" else use.approach
    if len(approach) != len(motors) or approach.strip("pnu"):
        raise RobotError(
            f"found '{shorten(use.approach)}'; expected 'both', or {len(motors)} letters, one for "
            f"each drive ({', '.join(motors)}): p if its coordinate grows in the last motion, n if "
            "it falls, u for both sides",
            where=f"{where}: orthocal.use.approach",
        )
    temperature = None if use.temperature_C is None else tuple(use.temperature_C)
    return Use(approach, temperature, tuple(use.payload_kg))  # type: ignore[arg-type] # of two


def _passive_start(robot: Robot, keys: RobotKeys, where: str) -> Array:
    """Start values of the passive coordinates for closing the loops, (n_passive,), [m, rad]."""
    start = np.zeros(robot.model.nv)
    for key, value in keys.orthocal.passive_start.items():
        here = f"{where}: orthocal.passive_start.{key}"
        try:
            name, unit, factor = split_unit(key)
        except ParameterError as e:
            raise RobotError(e.problem, where=here) from None
        model = robot.model
        if not model.existJointName(name) or name in keys.name_mot:
            raise RobotError(f"'{name}' is not a passive joint of the URDF", where=here)
        joint = model.joints[model.getJointId(name)]
        expected = joint_unit(model, joint.id)
        if unit != expected:
            raise RobotError(f"has the wrong unit; the joint is in {expected}", where=here)
        start[joint.idx_v] = value * factor
    return np.asarray(start[robot.passive_index])


def _snap_to_axes(unit_vector: Array) -> Array:
    """Unit vector whose components are exactly 0 or ±1 if they differ only by rounding."""
    nearest = np.round(unit_vector)
    return np.where(np.abs(unit_vector - nearest) < 1e-12, nearest, unit_vector)


def _build_legs(robot: Robot, keys: RobotKeys, where: str) -> Mapping[str, Leg]:
    """Build the legs and their rods in the reference posture."""
    model, legs = robot.model, {}
    data = model.createData()
    q = robot.configuration(robot.reference_posture)
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    for name, entry in keys.orthocal.legs.items():
        here = f"{where}: orthocal.legs.{name}"
        line = _build_line(model, data, name, entry, here)
        rods = {
            rod: Rod(
                **_build_line(model, data, rod, rod_keys, f"{here}.rods.{rod}"),
                radius=rod_keys.radius_mm * MM,
            )
            for rod, rod_keys in entry.rods.items()
        }
        jacobian = frame_jacobian(model, data, find_frame(model, entry.root, where=here))[:3]
        by_passive = np.abs(jacobian[:, robot.passive_index]).max(initial=0.0)
        motion = jacobian[:, robot.drive_index].sum(axis=1)
        motion /= max(float(np.linalg.norm(motion)), 1e-9)  # remains 0 if no drive moves it
        legs[name] = Leg(
            **line,
            axis=read_only(
                _snap_to_axes((line["reference_tip"] - line["reference_root"]) / line["length"])
            ),
            root_driven=bool(by_passive < 1e-9),  # up to rounding
            root_motion=read_only(_snap_to_axes(motion)),
            rods=MappingProxyType(rods),
        )
    return MappingProxyType(legs)


def _build_line(
    model: pin.Model, data: pin.Data, name: str, entry: LegKeys | RodKeys, here: str
) -> dict[str, Any]:
    """Fields of a leg or rod that describe its line in the reference posture.

    Raises:
        RobotError: If a frame does not exist, or the line is too long or has no length.
    """
    ids = [find_frame(model, f, where=here) for f in (entry.root, entry.tip)]
    root, tip = (np.array(data.oMf[i].translation) for i in ids)
    length = float(np.linalg.norm(tip - root))
    if length > LONGEST_LEG:
        raise RobotError(
            f"is {length:g} m long; expected at most {LONGEST_LEG:g} m: lengths in a URDF are "
            "in metres",
            where=here,
        )
    if length < 1e-6:
        raise RobotError(
            f"root '{entry.root}' and tip '{entry.tip}' are at the same place", where=here
        )
    return {
        "name": name,
        "root": entry.root,
        "tip": entry.tip,
        "length": length,
        "reference_root": read_only(root),
        "reference_tip": read_only(tip),
    }
