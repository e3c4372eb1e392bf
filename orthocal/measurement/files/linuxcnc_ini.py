"""Joints of a LinuxCNC machine from its INI file: home positions and compensation."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from orthocal.arrays import Array
from orthocal.effects.compensation import (
    MAX_COMP_FILE_ENTRIES,
    Compensation,
    JointTrim,
    home_positions,
    with_homes,
)
from orthocal.errors import ParameterError, SessionError, errors_at
from orthocal.io.documents import LARGEST_NUMBER, parse_number, read_text
from orthocal.io.fields import read_only
from orthocal.io.files import content_withheld_outside
from orthocal.measurement.files.session_keys import LARGEST_TRIM
from orthocal.robot.model import Drive, Robot
from orthocal.units import MM

COMP_FILE_COLUMNS = ("position", "forward trim", "reverse trim")
"""Columns of a COMP_FILE of type 1."""

EXPORTED_OFFSETS = re.compile(r"(?m)^# controller: \{(offsets_[^{}]*)\}\r?$")
"""Comment of exported lines with the offsets of the drives (`drive_keys`)."""

EXPORTED_SIGNS = re.compile(r"(?m)^# signs of HOME_LATCH_VEL: \[([+-](?:, [+-])*)\]\r?$")
"""Comment of exported lines with the directions in which homing latches the switches."""

OFFSETS_OF_UNIT = re.compile(r"offsets_(\w+): \[([^\]]*)\]")
"""Offsets of the drives with one unit in this comment."""

KEYS = frozenset(
    {
        "ANGULAR_UNITS",
        "BACKLASH",
        "COMP_FILE",
        "COMP_FILE_TYPE",
        "HOME",
        "HOME_LATCH_VEL",
        "HOME_OFFSET",
        "HOME_SEARCH_VEL",
        "LINEAR_UNITS",
        "MAX_LIMIT",
        "MIN_LIMIT",
        "UNITS",
    }
)
"""Keys that are read from the sections of the trajectory, the joints and the axes."""

UNIT_KEYS = {"mm": "LINEAR_UNITS", "deg": "ANGULAR_UNITS"}
"""Keys of [TRAJ] that state the unit of a drive, by this unit."""

UNIT_WORDS = {"mm": ("mm", "metric"), "deg": ("deg", "degree")}
"""Values of these keys that mean the unit of the drive, in lower case."""


@dataclass(frozen=True, slots=True, eq=False)
class ControllerJoints:
    """Joints of a controller, in the order of the drives."""

    limits: tuple[tuple[float, float], ...]
    """MIN_LIMIT and MAX_LIMIT, [m, rad]; infinite if not stated."""
    axis_limits: tuple[tuple[float, float], ...]
    """Those of the axes X, Y and Z, which programs of tool coordinates must keep, [m]."""
    latched: tuple[int, ...]
    """Sign of HOME_LATCH_VEL, 1 or -1, which the comment of exported lines may state; 0 if it is
    missing or 0."""
    compensation: Compensation
    """BACKLASH, COMP_FILE and HOME_OFFSET of each joint. HOME_OFFSET is None if no joint states it
    or HOME_LATCH_VEL, as in a fragment that states changes only."""
    offsets: tuple[float, ...] | None = None
    """Offsets of the slides that the comment of exported lines states, [m, rad]; None otherwise."""
    opposed: tuple[str, ...] = ()
    """Sections of joints whose HOME_LATCH_VEL and HOME_SEARCH_VEL have opposite signs."""
    after_homing: tuple[float | None, ...] = ()
    """HOME, the position to which each joint moves after homing, [m, rad]; None if not stated."""

    @property
    def home_offsets(self) -> tuple[float, ...] | None:
        """HOME_OFFSET, [m, rad]; None if not stated."""
        return home_positions(self.compensation)


def read_controller_joints(path: Path, robot: Robot) -> ControllerJoints:
    """Joints of a LinuxCNC machine: JOINT_0 is the first drive, and so on.

    Args:
        path: The INI file.
        robot: The robot.

    Raises:
        ParameterError: If a joint or a number is missing or wrong; names file and section.
        SessionError: If a COMP_FILE is wrong.
    """
    text = read_text(path, error=ParameterError)
    sections = _read_sections(text, path)
    trajectory = sections.get("TRAJ", {})
    joints, opposed, after_homing = [], [], []
    for i, drive in enumerate(robot.drives):
        unit = drive.joint_unit
        with errors_at(f"{path}: [TRAJ]"):
            _require_unit(trajectory, UNIT_KEYS[unit], unit)
        with errors_at(f"{path}: [JOINT_{i}]"):
            keys = sections.get(f"JOINT_{i}")
            if keys is None:
                raise ParameterError(f"the section is missing; it belongs to drive {drive.name}")
            _require_unit(keys, "UNITS", unit)
            home, latch, trim = _read_joint(keys, drive, folder=path.parent)
            if (latch or 0) * _read_number(keys, "HOME_SEARCH_VEL") < 0.0:
                opposed.append(f"[JOINT_{i}]")
            of_joint = _read_limits(keys, drive.joint_unit, drive.joint_size)
            at_home = _read_number(keys, "HOME") * drive.joint_size
            after_homing.append(at_home if "HOME" in keys else None)
            joints.append((home, of_joint, latch, trim))
    homes, limits, latched, trims = zip(*joints, strict=True)
    stated = any(latch is not None for latch in latched)
    known = stated or any(home is not None for home in homes)
    return ControllerJoints(
        limits,
        tuple(_read_axis(sections, letter, path) for letter in "XYZ"),
        tuple(latch or 0 for latch in latched) if stated else _read_signs(text, robot.drives),
        with_homes(trims, [home or 0.0 for home in homes] if known else None),
        None if stated else _read_offsets(text, robot.drives),
        tuple(opposed),
        tuple(after_homing),
    )


def _read_number(keys: Mapping[str, str], key: str) -> float:
    """Number of a key; 0 if it is not stated.

    Raises:
        ParameterError: If it is no number.
    """
    return parse_number(keys.get(key, "0"), name=key, error=ParameterError)


def _require_unit(keys: Mapping[str, str], key: str, unit: str) -> None:
    """Refuse a section that states another unit than that of a drive, mm or deg.

    Raises:
        ParameterError: If it does; names the key.
    """
    stated = keys.get(key)
    if stated is not None and stated.casefold() not in UNIT_WORDS[unit]:
        raise ParameterError(
            f"{key} is {stated}; expected {unit}. For a controller with other units leave out "
            f"--ini, and state numbers in {unit}: --backlash, and --home-offset of `export`"
        )


def _read_signs(text: str, drives: Sequence[Drive]) -> tuple[int, ...]:
    """Signs of HOME_LATCH_VEL that a comment of exported lines states; 0 without it."""
    match = EXPORTED_SIGNS.search(text)
    signs = () if match is None else tuple(1 if s == "+" else -1 for s in match[1].split(", "))
    return signs if len(signs) == len(drives) else (0,) * len(drives)


def _read_offsets(text: str, drives: Sequence[Drive]) -> tuple[float, ...] | None:
    """Offsets of the drives that a comment of exported lines states, [m, rad]; None without it."""
    match = EXPORTED_OFFSETS.search(text)
    stated = {} if match is None else dict(OFFSETS_OF_UNIT.findall(match[1]))
    try:
        values = {unit: [float(v) for v in numbers.split(",")] for unit, numbers in stated.items()}
    except ValueError:
        return None
    names = [d.joint_unit for d in drives]
    if {unit: len(v) for unit, v in values.items()} != {n: names.count(n) for n in names}:
        return None
    return tuple(values[d.joint_unit].pop(0) * d.joint_size for d in drives)


def _read_joint(
    keys: Mapping[str, str], drive: Drive, *, folder: Path
) -> tuple[float | None, int | None, JointTrim]:
    """Home offset, [m, rad], sign of HOME_LATCH_VEL and compensation of a joint.

    Home offset and sign are None if not stated.

    Args:
        keys: Keys of its section.
        drive: Its drive.
        folder: Directory to which the name of its COMP_FILE is relative.

    Raises:
        ParameterError: If a number is wrong.
        SessionError: If the COMP_FILE is wrong.
    """
    numbers = {
        key: _read_number(keys, key)
        for key in ("HOME_OFFSET", "HOME_LATCH_VEL", "BACKLASH", "COMP_FILE_TYPE")
    }
    unit, factor = drive.joint_unit, drive.joint_size
    if not 0.0 <= numbers["BACKLASH"] <= LARGEST_TRIM:
        raise ParameterError(
            f"BACKLASH is {numbers['BACKLASH']:g} {unit}; expected 0 to {LARGEST_TRIM:g} {unit}"
        )
    name, table = keys.get("COMP_FILE"), None
    if name is not None:
        if numbers["COMP_FILE_TYPE"] != 1.0:
            raise ParameterError(f"COMP_FILE_TYPE is {numbers['COMP_FILE_TYPE']:g}; expected 1")
        table = read_comp_file(folder, name, drive)
    latch = None
    if "HOME_LATCH_VEL" in keys:
        latch = int(np.sign(numbers["HOME_LATCH_VEL"]))
    home = numbers["HOME_OFFSET"] * factor if "HOME_OFFSET" in keys else None
    return home, latch, JointTrim(numbers["BACKLASH"] * factor, table)


def _read_axis(
    sections: Mapping[str, Mapping[str, str]], letter: str, path: Path
) -> tuple[float, float]:
    """MIN_LIMIT and MAX_LIMIT of an axis, [m]; infinite if not stated.

    Raises:
        ParameterError: If they are wrong, or not in mm; names file and section.
    """
    keys = sections.get(f"AXIS_{letter}", {})
    if keys:
        with errors_at(f"{path}: [TRAJ]"):
            _require_unit(sections.get("TRAJ", {}), UNIT_KEYS["mm"], "mm")
    with errors_at(f"{path}: [AXIS_{letter}]"):
        return _read_limits(keys, "mm", MM)


def _read_limits(keys: Mapping[str, str], unit: str, factor: float) -> tuple[float, float]:
    """MIN_LIMIT and MAX_LIMIT of a joint or an axis, [m, rad]; infinite if not stated.

    Numbers beyond LARGEST_NUMBER are infinite, too: for LinuxCNC, ±1e99 means no limit.

    Args:
        keys: Keys of its section.
        unit: Its unit, mm or deg.
        factor: Metres or radians of this unit.

    Raises:
        ParameterError: If one is no number, or the lowest is above the highest.
    """
    stated = (
        parse_number(keys.get(key, default), name=key, error=ParameterError, largest=math.inf)
        for key, default in (("MIN_LIMIT", "-1e99"), ("MAX_LIMIT", "1e99"))
    )
    low, high = (v if abs(v) <= LARGEST_NUMBER else math.copysign(math.inf, v) for v in stated)
    if low >= high:
        raise ParameterError(f"MIN_LIMIT is {low:g} {unit}, not below MAX_LIMIT, {high:g} {unit}")
    return low * factor, high * factor


def _read_sections(text: str, path: Path) -> Mapping[str, Mapping[str, str]]:
    """Sections of an INI file. The first of repeated keys counts, as in LinuxCNC.

    Raises:
        ParameterError: If the file includes another one, or states a key of KEYS twice with
            different values; names the line.
    """
    sections = dict[str, dict[str, str]]()
    lines = dict[tuple[str, str], int]()
    section, current = "", dict[str, str]()
    for number, line in enumerate(text.splitlines(), start=1):
        if line.lstrip().startswith("#INCLUDE"):
            raise ParameterError(
                "#INCLUDE is not supported; replace it by the lines of the included file",
                where=f"{path}:{number}",
            )
        bare = re.sub(r"(^|\s)[#;].*", "", line).strip()  # without its comment
        if bare.startswith("[") and bare.endswith("]"):
            section = bare[1:-1].strip()
            current = sections.setdefault(section, {})
        elif "=" in bare:
            key, value = (part.strip() for part in bare.split("=", 1))
            first = lines.setdefault((section, key), number)
            if current.setdefault(key, value) != value and key in KEYS:
                raise ParameterError(
                    f"[{section}] has {key} = {value}, but {current[key]} in line {first}, and "
                    "LinuxCNC uses the first one; expected one line",
                    where=f"{path}:{number}",
                )
    return sections


def read_comp_file(folder: Path, name: str, drive: Drive) -> Array:
    """Table of a COMP_FILE of type 1: position, forward trim, reverse trim.

    The content of a file outside the directory is not quoted in messages.

    Args:
        folder: Directory to which `name` is relative.
        name: Name of the table.
        drive: Drive of the joint.

    Returns:
        Shape (n, 3), [m, rad].

    Raises:
        SessionError: If the table is wrong; names file and line, or no place for a wrong name.
    """
    if not name.strip() or "\0" in name:
        raise SessionError(f"found {name!r}; expected a file name")
    file, unit = folder / name, drive.joint_unit
    with content_withheld_outside(folder, file):
        text = read_text(file, error=SessionError)
        rows = list[list[float]]()
        for number, line in enumerate(text.splitlines(), start=1):
            if not (cells := line.split()):
                continue
            with errors_at(f"{file}:{number}"):
                if len(cells) != len(COMP_FILE_COLUMNS):
                    raise SessionError(
                        f"has {len(cells)} numbers; expected {', '.join(COMP_FILE_COLUMNS)}"
                    )
                row = [
                    parse_number(cell, name=column, error=SessionError)
                    for cell, column in zip(cells, COMP_FILE_COLUMNS, strict=True)
                ]
                if rows and row[0] <= rows[-1][0]:
                    raise SessionError(
                        f"positions must increase: {row[0]:g} {unit} follows {rows[-1][0]:g} {unit}"
                    )
                if max(map(abs, row[1:])) > LARGEST_TRIM:
                    raise SessionError(
                        f"found a trim of {max(row[1:], key=abs):g} {unit}; expected at most "
                        f"{LARGEST_TRIM:g} {unit}; is the table of COMP_FILE_TYPE = 0?"
                    )
                rows.append(row)
        if not 1 < len(rows) <= MAX_COMP_FILE_ENTRIES:
            raise SessionError(
                f"has {len(rows)} entries; expected 2 to {MAX_COMP_FILE_ENTRIES}", where=str(file)
            )
    return read_only(np.array(rows) * drive.joint_size)
