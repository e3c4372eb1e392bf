"""Tables of joint coordinates and tool points, as CSV with units in the column names."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import SessionError
from orthocal.io.documents import csv_rows, parse_number, read_csv_rows
from orthocal.io.files import read_lines
from orthocal.robot.model import Robot
from orthocal.units import DRIVE_UNITS, MM

Array = NDArray[np.float64]

ROWS_AT_ONCE = 512
"""Rows of a block of a table that streams."""

LONGEST_LINE = 2**17
"""Characters of a line of such a table."""

TOOL_COLUMNS = {"x_mm": MM, "y_mm": MM, "z_mm": MM}
"""Columns of tool points, and their factors to SI."""


def drive_columns(robot: Robot) -> dict[str, float]:
    """Columns of drive coordinates, and their factors to SI."""
    return {f"{d.name}_{unit}": size for d in robot.drives for unit, size in [DRIVE_UNITS[d.unit]]}


def read_points(path: Path, robot: Robot) -> tuple[list[str], Array]:
    """Tool points from a CSV file: the coordinates that the drives control; others are ignored.

    Returns:
        Names of the rows for messages, and values, shape (K, n_coordinates), [m].

    Raises:
        SessionError: Naming file and line.
    """
    columns, others = _point_columns(robot)
    return _read(path, columns, ignored=others)


Block = tuple[list[str], Array]
"""Names of some rows for messages, and their values, shape (k, n_columns), [SI]."""


def stream_joints(source: Path | BinaryIO, robot: Robot, *, name: str) -> Iterator[Block]:
    """Drive coordinates from CSV of any size, some rows at a time.

    Args:
        source: A file, or a stream that is open.
        robot: The robot.
        name: Of the source, for messages.

    Raises:
        SessionError: Naming file and line.
    """
    yield from _stream(source, drive_columns(robot), name=name)


def stream_points(source: Path | BinaryIO, robot: Robot, *, name: str) -> Iterator[Block]:
    """Tool points from CSV of any size, as `read_points`, some rows at a time.

    Args:
        source: A file, or a stream that is open.
        robot: The robot.
        name: Of the source, for messages.

    Raises:
        SessionError: Naming file and line.
    """
    columns, others = _point_columns(robot)
    yield from _stream(source, columns, ignored=others, name=name)


def format_rows(columns: dict[str, float], values: Array) -> str:
    """Values in SI as lines of CSV in the units of the columns; rows with NaN are empty cells."""
    scaled = values / np.array(list(columns.values()))
    empty = "," * (len(columns) - 1)
    return "".join(
        (",".join(f"{v:.6f}" for v in row) if np.isfinite(row).all() else empty) + "\n"
        for row in scaled
    )


def _point_columns(robot: Robot) -> tuple[dict[str, float], tuple[str, ...]]:
    """Columns of the coordinates that the drives control, and those of the others."""
    wanted = range(3) if robot.tcp is None else robot.tcp.coordinates
    columns = {name: f for i, (name, f) in enumerate(TOOL_COLUMNS.items()) if i in wanted}
    return columns, tuple(name for name in TOOL_COLUMNS if name not in columns)


def _read(
    path: Path, columns: dict[str, float], *, ignored: tuple[str, ...] = ()
) -> tuple[list[str], Array]:
    rows = read_csv_rows(path, required=tuple(columns), optional=ignored, error=SessionError)
    names, values = _parse(rows, columns, name=str(path))
    if not names:
        raise SessionError("holds no rows", where=str(path))
    return names, values


def _stream(
    source: Path | BinaryIO,
    columns: dict[str, float],
    *,
    ignored: tuple[str, ...] = (),
    name: str,
) -> Iterator[Block]:
    lines = read_lines(source, longest=LONGEST_LINE, name=name, error=SessionError)
    rows = csv_rows(lines, name=name, required=tuple(columns), optional=ignored, error=SessionError)
    begun = False
    while (block := _parse(islice(rows, ROWS_AT_ONCE), columns, name=name))[0]:
        begun = True
        yield block
    if not begun:
        raise SessionError("holds no rows", where=name)


def _parse(
    rows: Iterable[tuple[int, dict[str, str]]], columns: dict[str, float], *, name: str
) -> Block:
    names, values = [], []
    for line, row in rows:
        where = f"{name}:{line}"
        names.append(where)
        values.append(
            [
                parse_number(row[c], where=where, name=c, error=SessionError) * factor
                for c, factor in columns.items()
            ]
        )
    return names, np.array(values)
