"""The command `accuracy`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

from typer import Argument

from orthocal.cli.options import CalibrationPath, HalfSideMm, Json, app, require_between
from orthocal.cli.printing import deliver, print_rows
from orthocal.errors import ClosureError, SessionError
from orthocal.units import MM


@app.command()
def accuracy(
    calibration: CalibrationPath,
    points: Annotated[
        Path | None, Argument(metavar="TARGETS.csv", help="Columns of the tool: x_mm, y_mm, z_mm.")
    ] = None,
    half_side_mm: HalfSideMm = None,
    json: Json = False,
) -> None:
    """Print the tool error over the workspace, or at points.

    With points it prints CSV: the deviation of the tool at each, and its standard deviation.

    Exit code 3: some points cannot be reached; they are named, and their cells are empty.
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

    if half_side_mm is not None:
        require_between(half_side_mm, 0.0, 1e5, "--half-side-mm")
    result = load_calibration(calibration)
    names, workspace = None, None
    if points is not None:
        names, targets = read_points(points, result.robot)
        if not json:
            print_rows(POINT_COLUMNS, format_points, accuracy_rows(result, targets, names=names))
            return
        if len(targets) > MOST_POINTS:
            raise SessionError(
                f"contains {len(targets)} points; expected at most {MOST_POINTS} with --json, "
                "which evaluates all together",
                where=str(points),
            )
        workspace = Workspace.even(targets)
    elif half_side_mm is not None:
        workspace = cube(result.robot, half_side=half_side_mm * MM)
    try:
        assessment = assess_tool(result, workspace, names=names)
    except ClosureError as e:
        if half_side_mm is None:
            raise SessionError(e.reason, where=e.posture) from None
        reached = describe_box(assess_tool(result).workspace.limits)
        raise SessionError(
            f"the machine does not reach a cube of ±{half_side_mm:g} mm; without this it is "
            f"{reached} ({e.reason})",
            where="--half-side-mm",
        ) from None
    deliver(
        partial(accuracy_json, result, assessment),
        partial(print_accuracy, result, assessment),
        json=json,
    )
