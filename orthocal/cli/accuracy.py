"""The command `accuracy`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

from typer import Argument, Exit

import orthocal
from orthocal.cli.forward import put_assumed
from orthocal.cli.options import (
    Approach,
    CalibrationPath,
    HalfSideMm,
    Json,
    Payload,
    Temperature,
    command,
    read_conditions,
    require_between,
)
from orthocal.cli.printing import deliver, print_rows, put_note
from orthocal.errors import ClosureError, SessionError
from orthocal.units import MM


@command()
def accuracy(
    calibration: CalibrationPath,
    points: Annotated[Path | None, Argument()] = None,
    half_side_mm: HalfSideMm = None,
    approach: Approach = None,
    temperature: Temperature = None,
    payload: Payload = None,
    json: Json = False,
) -> None:
    """Print the tool error over the workspace, or at points.

    With points it prints CSV: the absolute error of the tool at each, without alignment of the
    workpiece, and its standard deviation.
    Without --approach, --temperature and --payload a tool error is that under the conditions of
    use that the robot's YAML states.

    Exit code 3: some points cannot be reached; they are named, and their cells are empty.

    Args:
        points (TARGETS.csv): Columns of the tool: x_mm, y_mm, z_mm.
    """
    from orthocal.assessment.tool_error import MOST_POINTS
    from orthocal.assessment.tool_tables import accuracy_rows
    from orthocal.kinematics.workspace import cube, describe_box
    from orthocal.measurement.files.coordinate_tables import read_points
    from orthocal.output.text import accuracy as text

    if half_side_mm is not None:
        require_between(half_side_mm, 0.0, 1e5, "--half-side-mm")
    result = orthocal.load_calibration(calibration)
    conditions = read_conditions(
        result.robot, approach=approach, temperature=temperature, payload=payload
    )
    stated = conditions if conditions.stated else None
    names, workspace = None, None
    if points is not None:
        names, targets = read_points(points, result.robot)
        if not json:
            rows = accuracy_rows(result, targets, names=names, conditions=conditions)
            put_assumed(result, conditions)
            note = text.ABSOLUTE_NOTE.format(shlex.quote(str(calibration)))
            try:
                print_rows(text.POINT_COLUMNS, text.format_points, rows)
            except Exit:  # some rows are empty
                put_note(note)
                raise
            put_note(note)
            return
        if len(targets) > MOST_POINTS:
            raise SessionError(
                f"contains {len(targets)} points; expected at most {MOST_POINTS} with --json, "
                "which evaluates all together",
                where=str(points),
            )
        workspace = orthocal.Workspace.even(targets)
    elif half_side_mm is not None:
        workspace = cube(result.robot, half_side=half_side_mm * MM)
    try:
        assessment = orthocal.assess_tool(result, workspace, names=names, conditions=stated)
    except ClosureError as e:
        if half_side_mm is None:
            raise SessionError(e.reason, where=e.posture) from None
        reached = describe_box(orthocal.assess_tool(result).workspace.limits)
        raise SessionError(
            f"the machine does not reach a cube of ±{half_side_mm:g} mm; without this it is "
            f"{reached} ({e.reason})",
            where="--half-side-mm",
        ) from None
    deliver(
        lambda: text.accuracy_json(result, assessment),
        lambda: text.print_accuracy(result, assessment),
        json=json,
    )
