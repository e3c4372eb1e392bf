"""CSV tables of drive coordinates and tool points, with units in the column names."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import SessionError
from orthocal.io.documents import MOST_CSV_ROWS, csv_rows, parse_number
from orthocal.io.files import read_lines
from orthocal.robot.model import Robot
from orthocal.units import MM

Block = tuple[list[str], Array]
"""File and line of some rows, for messages, and their values, shape (k, n_columns), [SI]."""

BLOCK_ROWS = 512
"""Number of rows of a block."""

LONGEST_LINE = 2**17
"""Maximum number of characters of a line."""

TOOL_COLUMNS = {"x_mm": MM, "y_mm": MM, "z_mm": MM}
"""Columns of tool points and their factors to SI units."""


def drive_columns(robot: Robot) -> dict[str, float]:
    """Columns of drive coordinates and their factors to SI units."""
    return {f"{d.name}_{d.joint_unit}": d.joint_size for d in robot.drives}


def read_points(path: Path, robot: Robot) -> Block:
    """Read the commanded coordinates of tool points; other coordinates are ignored.

    Returns:
        File and line of every row, and values, shape (K, n_coordinates), [m].

    Raises:
        SessionError: If the table or a row is wrong; names file and line.
    """
    blocks = list(stream_points(path, robot, name=str(path), most=MOST_CSV_ROWS))
    return [name for names, _ in blocks for name in names], np.concatenate([v for _, v in blocks])


def stream_joints(source: Path | BinaryIO, robot: Robot, *, name: str) -> Iterator[Block]:
    """Read drive coordinates block by block; their number is unlimited.

    Args:
        source: A file, or an open stream.
        robot: The robot.
        name: Name of the source, for messages.

    Raises:
        SessionError: If the table or a row is wrong; names file and line.
    """
    yield from stream_columns(source, drive_columns(robot), name=name)


def stream_points(
    source: Path | BinaryIO, robot: Robot, *, name: str, most: int | None = None
) -> Iterator[Block]:
    """Read the commanded coordinates of tool points block by block.

    Args:
        source: A file, or an open stream.
        robot: The robot.
        name: Name of the source, for messages.
        most: Largest number of rows; None for any number.

    Raises:
        SessionError: If the table or a row is wrong; names file and line.
    """
    commanded = range(3) if robot.tcp is None else robot.tcp.coordinates
    columns = {name: f for i, (name, f) in enumerate(TOOL_COLUMNS.items()) if i in commanded}
    ignored = tuple(name for name in TOOL_COLUMNS if name not in columns)
    yield from stream_columns(source, columns, ignored=ignored, name=name, most=most)


def format_rows(columns: dict[str, float], values: Array) -> str:
    """Lines of a CSV table; rows with NaN become empty cells.

    Args:
        columns: Columns and their factors to SI units.
        values: Shape (K, n_columns), [SI].
    """
    scaled = values / np.array(list(columns.values()))
    scaled[np.abs(scaled) < 0.5e-6] = 0.0  # not -0.000000
    empty = "," * (len(columns) - 1)
    return "".join(
        (",".join(f"{v:.6f}" for v in row) if np.isfinite(row).all() else empty) + "\n"
        for row in scaled
    )


def stream_columns(
    source: Path | BinaryIO,
    columns: dict[str, float],
    *,
    ignored: tuple[str, ...] | None = (),
    name: str,
    most: int | None = None,
) -> Iterator[Block]:
    """Read columns of numbers block by block.

    Args:
        source: A file, or an open stream.
        columns: Columns and their factors to SI units.
        ignored: Columns that are ignored; None for all others.
        name: Name of the source, for messages.
        most: Largest number of rows; None for any number.

    Raises:
        SessionError: If the table or a row is wrong; names file and line.
    """
    lines = read_lines(source, longest=LONGEST_LINE, name=name, error=SessionError)
    rows = csv_rows(lines, name=name, required=tuple(columns), optional=ignored, most=most)
    empty = True
    while block := list(islice(rows, BLOCK_ROWS)):
        empty = False
        places = [f"{name}:{line}" for line, _ in block]
        values = [
            [
                parse_number(row[c], where=place, name=c, error=SessionError) * factor
                for c, factor in columns.items()
            ]
            for place, (_, row) in zip(places, block, strict=True)
        ]
        yield places, np.array(values)
    if empty:
        raise SessionError("holds no rows", where=name)
