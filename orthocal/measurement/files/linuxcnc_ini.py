"""Joints of a LinuxCNC machine from its INI file: home positions and compensation."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from orthocal.arrays import Array
from orthocal.effects.compensation import Compensation, JointTrim
from orthocal.errors import ParameterError, SessionError
from orthocal.io.documents import parse_number, read_text
from orthocal.io.fields import read_only
from orthocal.io.files import content_withheld_outside
from orthocal.measurement.files.schema import LARGEST_TRIM
from orthocal.robot.model import Drive, Robot
from orthocal.units import DRIVE_UNITS

TABLE_COLUMNS = ("position", "forward trim", "reverse trim")
"""Columns of a COMP_FILE of type 1."""

MOST_TABLE_ROWS = 256
"""Largest number of lines of a COMP_FILE."""

MILLIMETRES = ("mm", "metric")
"""Values of LINEAR_UNITS with which lengths are in mm."""


@dataclass(frozen=True, slots=True, eq=False)
class ControllerJoints:
    """Joints of a controller, in the order of the drives."""

    home_offsets: tuple[float, ...]
    """HOME_OFFSET, [m, rad]."""
    latched: tuple[int, ...] | None
    """Sign of HOME_LATCH_VEL, 1 or -1; None if no joint states one, as in lines of an export."""
    compensation: Compensation
    """BACKLASH and COMP_FILE; empty if no joint has any."""


def read_ini(path: Path, robot: Robot) -> ControllerJoints:
    """Joints of a LinuxCNC machine: JOINT_0 is the first drive, and so on.

    Args:
        path: The INI file.
        robot: The robot.

    Raises:
        ParameterError: Naming the file and section, if a joint or a number is missing or wrong.
        SessionError: If a table is wrong.
    """
    sections = _read_sections(path)
    units = sections.get("TRAJ", {}).get("LINEAR_UNITS", "mm")
    if units not in MILLIMETRES:
        raise ParameterError(f"LINEAR_UNITS is {units}; expected mm", where=f"{path}: [TRAJ]")
    homes, latched, trims = list[float](), list[int](), list[JointTrim]()
    for i, drive in enumerate(robot.drives):
        where, size = f"{path}: [JOINT_{i}]", DRIVE_UNITS[drive.unit][1]
        if f"JOINT_{i}" not in sections:
            raise ParameterError(
                f"is missing; expected a section for each drive, this one of {drive.name}",
                where=where,
            )
        keys = sections[f"JOINT_{i}"]
        numbers = {
            key: parse_number(keys.get(key, "0"), where=where, name=key, error=ParameterError)
            for key in ("HOME_OFFSET", "HOME_LATCH_VEL", "BACKLASH", "COMP_FILE_TYPE")
        }
        homes.append(numbers["HOME_OFFSET"] * size)
        latched.append(-1 if numbers["HOME_LATCH_VEL"] < 0.0 else 1)
        if not 0.0 <= numbers["BACKLASH"] <= LARGEST_TRIM:
            raise ParameterError(
                f"BACKLASH is {numbers['BACKLASH']:g}; expected 0 to {LARGEST_TRIM:g}", where=where
            )
        name, table = keys.get("COMP_FILE"), None
        if name is not None:
            if numbers["COMP_FILE_TYPE"] != 1.0:
                raise ParameterError(
                    "has a COMP_FILE of another type; expected COMP_FILE_TYPE = 1", where=where
                )
            table = read_trims(path.parent, name, drive, where)
        trims.append(JointTrim(numbers["BACKLASH"] * size, table))
    compensated = any(t.backlash or t.table is not None for t in trims)
    stated = any("HOME_LATCH_VEL" in sections[f"JOINT_{i}"] for i in range(len(homes)))
    return ControllerJoints(
        tuple(homes), tuple(latched) if stated else None, tuple(trims) if compensated else ()
    )


def _read_sections(path: Path) -> Mapping[str, Mapping[str, str]]:
    """Sections of an INI file; of keys that stand twice the first, as LinuxCNC reads them."""
    sections = dict[str, dict[str, str]]()
    current = dict[str, str]()
    for line in read_text(path, error=ParameterError).splitlines():
        bare = re.sub(r"(^|\s)[#;].*", "", line).strip()
        if bare.startswith("[") and bare.endswith("]"):
            current = sections.setdefault(bare[1:-1].strip(), {})
        elif "=" in bare:
            key, _, value = bare.partition("=")
            current.setdefault(key.strip(), value.strip())
    return sections


def read_trims(folder: Path, name: str, drive: Drive, where: str) -> Array:
    """Table of a COMP_FILE of type 1: positions and trims, shape (n, 3), [m, rad].

    Args:
        folder: Directory of the file that names the table.
        name: Name of the table, relative to it.
        drive: Drive of the joint.
        where: File and section or key that name it, for messages.

    Raises:
        SessionError: Naming the file and the line.
    """
    if not name.strip() or "\0" in name:
        raise SessionError(f"found {name!r}; expected the name of a file", where=where)
    file, (unit, size) = folder / name, DRIVE_UNITS[drive.unit]
    with content_withheld_outside(folder, file):
        text = read_text(file, error=SessionError)
        rows = list[list[float]]()
        for number, line in enumerate(text.splitlines(), start=1):
            at = f"{file}:{number}"
            if not (cells := line.split()):
                continue
            if len(cells) != len(TABLE_COLUMNS):
                raise SessionError(
                    f"has {len(cells)} numbers; expected {', '.join(TABLE_COLUMNS)}", where=at
                )
            row = [
                parse_number(cell, where=at, name=column, error=SessionError)
                for cell, column in zip(cells, TABLE_COLUMNS, strict=True)
            ]
            if rows and not row[0] > rows[-1][0]:
                raise SessionError(
                    f"the position {row[0]:g} {unit} does not exceed that of the line before",
                    where=at,
                )
            if max(map(abs, row[1:])) > LARGEST_TRIM:
                raise SessionError(
                    f"found a trim of {max(row[1:], key=abs):g} {unit}; expected at most "
                    f"{LARGEST_TRIM:g}, as in a table of COMP_FILE_TYPE = 1",
                    where=at,
                )
            rows.append(row)
        if not 1 < len(rows) <= MOST_TABLE_ROWS:
            raise SessionError(
                f"has {len(rows)} lines; expected 2 to {MOST_TABLE_ROWS}", where=str(file)
            )
    return read_only(np.array(rows) * size)
