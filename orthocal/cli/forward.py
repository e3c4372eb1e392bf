"""The commands `forward` and `inverse`: transformation of tables of any size."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import orthocal
from orthocal.cli.options import UseOptions, command
from orthocal.cli.printing import print_rows, put_note
from orthocal.errors import SessionError

if TYPE_CHECKING:
    from orthocal.assessment.tool_tables import Chunk
    from orthocal.measurement.files.coordinate_tables import Block


@command()
def forward(calibration: Path, joints: Path, *, use: UseOptions) -> None:
    """Print tool positions for drive coordinates, as CSV.

    Drive coordinates are those of the encoders, without any offset of the controller. Tables can
    have any size: rows from a pipe are evaluated in blocks as they arrive.

    Exit code 3: some rows cannot be reached; they are named, and their cells are empty.

    Args:
        joints (JOINTS.csv): Columns of the drives, such as x_slide_mm; - for standard input.
    """
    from orthocal.assessment.tool_tables import forward_blocks
    from orthocal.measurement.files.coordinate_tables import TOOL_COLUMNS, stream_joints

    result = orthocal.load_calibration(calibration)
    _print_transformed(result, use, joints, stream_joints, forward_blocks, TOOL_COLUMNS)


@command()
def inverse(calibration: Path, targets: Path, *, use: UseOptions) -> None:
    """Print drive coordinates for tool positions, as CSV.

    Drive coordinates are those of the encoders, without any offset of the controller. Tables can
    have any size: rows from a pipe are evaluated in blocks as they arrive.

    Exit code 3: some rows cannot be reached; they are named, and their cells are empty.

    Args:
        targets (TARGETS.csv): Columns of the tool: x_mm, y_mm, z_mm; - for standard input.
    """
    from orthocal.assessment.tool_tables import inverse_blocks
    from orthocal.measurement.files.coordinate_tables import drive_columns, stream_points

    result = orthocal.load_calibration(calibration)
    columns = drive_columns(result.robot)
    _print_transformed(result, use, targets, stream_points, inverse_blocks, columns)


def _print_transformed(
    calibration: orthocal.Calibration,
    use: UseOptions,
    path: Path,
    stream: Callable[..., Iterator[Block]],
    transform: Callable[..., Iterator[Chunk]],
    columns: dict[str, float],
) -> None:
    """Print a transformed table; a file is checked completely before its first row is printed.

    Args:
        calibration: The calibration.
        use: Conditions of use; a note lists the assumed ones.
        path: The table; - for standard input.
        stream: Function that reads a file or a stream in blocks.
        transform: Function from these blocks to chunks of the transformed table.
        columns: Columns of the transformed table and their factors to SI units.

    Raises:
        SessionError: If a row is wrong; names file and line.
    """
    from orthocal.measurement.files.coordinate_tables import format_rows

    conditions = use.read(calibration.robot)
    if str(path) != "-":
        for _ in stream(path, calibration.robot, name=str(path)):
            pass
        blocks = stream(path, calibration.robot, name=str(path))
    elif sys.stdin is None:
        raise SessionError("is closed", where="standard input")
    else:
        blocks = stream(sys.stdin.buffer, calibration.robot, name="standard input")
    put_assumed(calibration, conditions)
    chunks = transform(calibration, blocks, conditions=conditions)
    print_rows(columns, partial(format_rows, columns), chunks)


def put_assumed(calibration: orthocal.Calibration, conditions: orthocal.UseConditions) -> None:
    """Note the assumed conditions and their effect on the tool error, if there is one."""
    from orthocal.output.text.conditions import describe_assumed

    put_note(describe_assumed(calibration, conditions))
