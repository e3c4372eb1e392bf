"""The command `accuracy`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Exit

import orthocal
from orthocal.cli.forward import put_assumed
from orthocal.cli.options import UseOptions, command, require_between
from orthocal.cli.printing import deliver, print_rows, put_note
from orthocal.errors import ClosureError, ParameterError, SessionError
from orthocal.text import quote_path
from orthocal.units import MM

if TYPE_CHECKING:
    from rich.console import RenderableType

    from orthocal.arrays import Array


@command()
def accuracy(
    calibration: Path,
    points: Annotated[Path | None, Argument()] = None,
    half_side_mm: float | None = None,
    *,
    use: UseOptions,
    json: bool = False,
    anyway: bool = False,
) -> None:
    """Print the tool error over the workspace, or at points.

    With points it prints CSV: the absolute error of the tool at each, without alignment of the
    workpiece, and its standard deviation.
    --approach, --temperature and --payload replace the conditions of use that the robot's YAML
    states.

    Exit code 3: the verdict is not `enter`; the reason is printed. Or some points cannot be
    reached; they are named, and their cells are empty.

    Args:
        points (TARGETS.csv): Columns of the tool: x_mm, y_mm, z_mm.
    """
    from orthocal.export.formats import require_entering
    from orthocal.kinematics.workspace import cube
    from orthocal.measurement.files.coordinate_tables import read_points
    from orthocal.output.text.accuracy import accuracy_json, expect_further_hour, render_accuracy

    if half_side_mm is not None:
        require_between(half_side_mm, 0.0, 1e5, "--half-side-mm")
        if points is not None:
            raise ParameterError("found with points; expected one of them", where="--half-side-mm")
    result = orthocal.load_calibration(calibration)
    if not anyway:
        require_entering(result)
    conditions = use.read(result.robot)
    names, workspace = None, None
    if points is not None:
        names, targets = read_points(points, result.robot)
        if not json:
            _print_points(result, targets, names, conditions, calibration)
            return
        _require_few(targets, points)
        workspace = orthocal.Workspace.even(targets)
    elif half_side_mm is not None:
        workspace = cube(result.robot, half_side=half_side_mm * MM)
    stated = conditions if conditions.stated else None
    try:
        assessment = orthocal.assess_tool(result, workspace, names=names, conditions=stated)
    except ClosureError as e:
        raise _out_of_reach(result, half_side_mm, e) from None

    def render() -> RenderableType:
        is_default = workspace is None and stated is None
        further = expect_further_hour(result, None if is_default else assessment)
        return render_accuracy(result, assessment, further)

    deliver(lambda: accuracy_json(result, assessment), render, json=json)


def _print_points(
    result: orthocal.Calibration,
    targets: Array,
    names: Sequence[str],
    conditions: orthocal.UseConditions,
    path: Path,
) -> None:
    """Print the tool error at points as CSV.

    Raises:
        typer.Exit: With code 3 if the machine does not reach some points.
    """
    from orthocal.assessment.tool_tables import accuracy_rows
    from orthocal.output.text.accuracy import ABSOLUTE_NOTE, POINT_COLUMNS, format_points

    rows = accuracy_rows(result, targets, names=names, conditions=conditions)
    put_assumed(result, conditions)
    note = ABSOLUTE_NOTE.format(quote_path(path))
    try:
        print_rows(POINT_COLUMNS, format_points, rows)
    except Exit:  # some rows are empty
        put_note(note)
        raise
    put_note(note)


def _require_few(targets: Array, path: Path) -> None:
    """Refuse too many points for an evaluation in one block.

    Raises:
        SessionError: If there are too many points; names their file.
    """
    from orthocal.assessment.tool_error import MOST_POINTS

    if len(targets) > MOST_POINTS:
        raise SessionError(
            f"contains {len(targets)} points; expected at most {MOST_POINTS} with --json, "
            "which evaluates all together",
            where=str(path),
        )


def _out_of_reach(
    result: orthocal.Calibration, half_side_mm: float | None, error: ClosureError
) -> SessionError:
    """Error about a posture out of reach, or about the stated cube.

    Args:
        result: The calibration.
        half_side_mm: Half the side of the cube; None if the option is absent.
        error: The posture and the reason.
    """
    from orthocal.kinematics.workspace import describe_box

    if half_side_mm is None:
        return SessionError(error.reason, where=error.posture)
    workspace = describe_box(orthocal.assess_tool(result).workspace.limits)
    return SessionError(
        f"the machine does not reach a cube of ±{half_side_mm:g} mm; the default is "
        f"{workspace} ({error.reason})",
        where="--half-side-mm",
    )
