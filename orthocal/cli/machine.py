"""What a calibrated machine does: accuracy, forward, inverse."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orthocal.cli.options import (
    CalibrationPath,
    Json,
    app,
)
from orthocal.cli.printing import print_rows, put_out
from orthocal.errors import ClosureError, SessionError
from orthocal.units import MM

if TYPE_CHECKING:
    from orthocal.measurement.files.coordinate_tables import Block
    from orthocal.robot.model import Robot


@app.command()
def accuracy(
    calibration: CalibrationPath,
    points: Annotated[
        Path | None,
        typer.Argument(metavar="[TARGETS.csv]", help="Columns of the tool: x_mm, y_mm, z_mm."),
    ] = None,
    half_side_mm: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            max=1e5,
            help="Half the side of a cube around the mechanical zero, without points; by default "
            "the workspace.",
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Where the tool really is, and how well that is known: over a cube, or at points.

    With points CSV on stdout: by how much the tool is off each, and one standard deviation of that.
    Exit code 3: some cannot be reached; they are named, and their cells are empty.
    """
    from orthocal.assessment.tool_error import MOST_POINTS, assess_tool
    from orthocal.assessment.tool_tables import accuracy_rows
    from orthocal.calibration.file import load_calibration
    from orthocal.kinematics.workspace import Workspace, cube, describe_box
    from orthocal.measurement.files.coordinate_tables import read_points
    from orthocal.output.text.accuracy import (
        POINT_COLUMNS,
        accuracy_json,
        format_points,
        print_accuracy,
    )

    result = load_calibration(calibration)
    names, workspace = None, None
    if points is not None:
        names, given = read_points(points, result.robot)
        if not json:
            print_rows(POINT_COLUMNS, format_points, accuracy_rows(result, given, names=names))
            return
        if len(given) > MOST_POINTS:
            raise SessionError(
                f"holds {len(given)} points; expected at most {MOST_POINTS} with --json, which "
                "looks at all of them together",
                where=str(points),
            )
        workspace = Workspace.even(given)
    elif half_side_mm is not None:
        workspace = cube(result.robot, half_side=half_side_mm * MM)
    try:
        found = assess_tool(result, workspace, names=names)
    except ClosureError as e:
        if half_side_mm is None:
            raise SessionError(e.reason, where=e.posture) from None
        known = f"; without this it is {describe_box(assess_tool(result).workspace.limits)}"
        raise SessionError(
            f"the machine does not reach a cube of ±{half_side_mm:g} mm{known} ({e.reason})",
            where="--half-side-mm",
        ) from None
    if json:
        put_out(accuracy_json(result, found).rstrip("\n"))
    else:
        print_accuracy(result, found)


@app.command()
def forward(
    calibration: CalibrationPath,
    joints: Annotated[
        Path,
        typer.Argument(
            metavar="JOINTS.csv",
            help="Columns as the drives, such as x_slide_mm; - for standard input.",
        ),
    ],
) -> None:
    """Where the calibrated machine's tool is, for drive coordinates: CSV on stdout, mm.

    Drive coordinates are those of the encoders, without any offset of the controller.

    Tables of any size: what comes through a pipe is served in blocks as it comes.

    Exit code 3: some rows cannot be reached; they are named, and their cells are empty.
    """
    from orthocal.assessment.tool_tables import forward_blocks
    from orthocal.calibration.file import load_calibration
    from orthocal.measurement.files.coordinate_tables import (
        TOOL_COLUMNS,
        format_rows,
        stream_joints,
    )

    result = load_calibration(calibration)
    blocks = _read_blocks(stream_joints, joints, result.robot)
    print_rows(TOOL_COLUMNS, partial(format_rows, TOOL_COLUMNS), forward_blocks(result, blocks))


@app.command()
def inverse(
    calibration: CalibrationPath,
    targets: Annotated[
        Path,
        typer.Argument(
            metavar="TARGETS.csv",
            help="Columns of the tool: x_mm, y_mm, z_mm; - for standard input.",
        ),
    ],
) -> None:
    """Drive coordinates that bring the calibrated machine's tool to points: CSV on stdout.

    Drive coordinates are those of the encoders, without any offset of the controller.

    Tables of any size: what comes through a pipe is served in blocks as it comes.

    Exit code 3: some rows cannot be reached; they are named, and their cells are empty.
    """
    from orthocal.assessment.tool_tables import inverse_blocks
    from orthocal.calibration.file import load_calibration
    from orthocal.measurement.files.coordinate_tables import (
        drive_columns,
        format_rows,
        stream_points,
    )

    result = load_calibration(calibration)
    blocks = _read_blocks(stream_points, targets, result.robot)
    columns = drive_columns(result.robot)
    print_rows(columns, partial(format_rows, columns), inverse_blocks(result, blocks))


def _read_blocks(
    stream: Callable[..., Iterator[Block]], path: Path, robot: Robot
) -> Iterator[Block]:
    """Rows of a table; a file is looked through as a whole before the first of them is served.

    Raises:
        SessionError: Naming file and line.
    """
    if str(path) != "-":
        for _ in stream(path, robot, name=str(path)):
            pass
        return stream(path, robot, name=str(path))
    if sys.stdin is None:
        raise SessionError("is closed", where="standard input")
    return stream(sys.stdin.buffer, robot, name="standard input")
