"""Tables of joint coordinates and tool points, as CSV with units in the column names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthocal.documents import parse_number, read_csv_rows
from orthocal.errors import SessionError
from orthocal.robot.model import Robot
from orthocal.units import DRIVE_UNITS, MM

Array = NDArray[np.float64]

TOOL_COLUMNS = {"x_mm": MM, "y_mm": MM, "z_mm": MM}
"""Columns of tool points, and their factors to SI."""


def drive_columns(robot: Robot) -> dict[str, float]:
    """Columns of drive coordinates, and their factors to SI."""
    return {f"{d.name}_{unit}": size for d in robot.drives for unit, size in [DRIVE_UNITS[d.unit]]}


def read_joints(path: Path, robot: Robot) -> tuple[list[str], Array]:
    """Drive coordinates from a CSV file.

    Returns:
        Names of the rows for messages, and values, shape (K, n_drives), [m, rad].

    Raises:
        SessionError: Naming file and line.
    """
    return _read(path, drive_columns(robot))


def read_points(path: Path, robot: Robot) -> tuple[list[str], Array]:
    """Tool points from a CSV file: the coordinates that the drives control; others are ignored.

    Returns:
        Names of the rows for messages, and values, shape (K, n_coordinates), [m].

    Raises:
        SessionError: Naming file and line.
    """
    wanted = range(3) if robot.tcp is None else robot.tcp.coordinates
    columns = {name: f for i, (name, f) in enumerate(TOOL_COLUMNS.items()) if i in wanted}
    others = tuple(name for name in TOOL_COLUMNS if name not in columns)
    return _read(path, columns, ignored=others)


def format_rows(columns: dict[str, float], values: Array) -> str:
    """Values in SI as lines of CSV in the units of the columns; rows with NaN are empty cells."""
    scaled = values / np.array(list(columns.values()))
    empty = "," * (len(columns) - 1)
    return "".join(
        (",".join(f"{v:.6f}" for v in row) if np.isfinite(row).all() else empty) + "\n"
        for row in scaled
    )


def _read(
    path: Path, columns: dict[str, float], *, ignored: tuple[str, ...] = ()
) -> tuple[list[str], Array]:
    names, rows = [], []
    for line, row in read_csv_rows(
        path, required=tuple(columns), optional=ignored, error=SessionError
    ):
        where = f"{path}:{line}"
        names.append(where)
        rows.append(
            [
                parse_number(row[c], where=where, name=c, error=SessionError) * factor
                for c, factor in columns.items()
            ]
        )
    if not rows:
        raise SessionError("holds no rows", where=str(path))
    return names, np.array(rows)
