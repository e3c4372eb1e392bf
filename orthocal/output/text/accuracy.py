"""Where the tool is and how well that is known, as tables."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.assessment.assess import assessment_of
from orthocal.assessment.controller_entries import find_entries
from orthocal.assessment.remaining_errors import find_remaining_errors
from orthocal.assessment.tool_error import (
    ErrorSize,
    ErrorSizes,
    ToolAccuracy,
    assess_remaining,
    assess_tool,
    summarise_tool,
)
from orthocal.assessment.words.entries import describe_tool_error
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ClosureError, RobotError
from orthocal.output.text.layout import add_row, print_rich, table_of, um
from orthocal.units import MM, UM

THREE_WAYS = (
    "With shift and rotation taken out, as a workpiece sees it that is aligned on the machine; "
    "shift out: with the common shift alone taken out (r.m.s.); absolute (r.m.s.)."
)
"""What the three forms of an error at the tool are."""

Array = NDArray[np.float64]

POINT_COLUMNS = (
    "x_mm",
    "y_mm",
    "z_mm",
    "deviation_x_um",
    "deviation_y_um",
    "deviation_z_um",
    "sigma_x_um",
    "sigma_y_um",
    "sigma_z_um",
)
"""Commanded tool position; where the tool really is, less that; standard deviation of that."""


def render_tool(calibration: Calibration) -> RenderableType:
    """The tool's errors over the cube around the mechanical zero."""
    try:
        return render_accuracy(calibration, assess_tool(calibration))
    except (ClosureError, RobotError) as e:
        return Text(f"Nothing can be said of the tool: {e}.")


def print_accuracy(calibration: Calibration, accuracy: ToolAccuracy) -> None:
    """Print the tool's errors over a region."""
    print_rich(render_accuracy(calibration, accuracy))


def render_accuracy(calibration: Calibration, accuracy: ToolAccuracy) -> RenderableType:
    """The tool's errors over a region.

    Args:
        calibration: The calibration.
        accuracy: Its errors at the tool.
    """
    table = table_of("[µm]", "r.m.s.", "95 %", "worst point", "shift out", "absolute")
    rows = [("known to be off now", accuracy.measure(accuracy.deviation))]
    if not calibration.only_offsets and find_entries(calibration):
        rows.append(("with the offsets entered", accuracy.measure(accuracy.error_after_offsets)))
    rows.append(("not known before", accuracy.before.sizes))
    remaining, excess = assess_remaining(calibration, accuracy), calibration.tolerance_scale
    if accuracy.after is not None:
        rows.append(("not known after", accuracy.after.sizes))
    if remaining is not None and excess > 1.0:
        rows.append((f"  at {excess:.1f} × tolerances", remaining.sizes))
    for name, sizes in rows:
        aligned = ("", "", "") if sizes.aligned is None else tuple(map(um, _parts(sizes.aligned)))
        add_row(table, name, *aligned, um(sizes.relative.rms), um(sizes.absolute.rms))
    lines: list[RenderableType] = [table, Text(f"Over {accuracy.workspace.words}. {THREE_WAYS}")]
    if accuracy.after is None:
        lines.append(Text("What is not known after cannot be told: nothing tells the noise."))
        return Group(*lines)
    lines.append(
        Text(
            "Not known: one standard deviation in space (95 %: 95 of 100 errors are smaller; "
            "worst point: one standard deviation there), with all errors of the machine that "
            "were not identified at their tolerances."
        )
    )
    summary = summarise_tool(calibration, accuracy)
    if summary is not None:
        keep = assessment_of(calibration).keeps_offsets
        lines.append(Text(describe_tool_error(summary, keep=keep)))
    lines += [Text(line) for line in describe_remaining(calibration, accuracy)]
    return Group(*lines)


def describe_remaining(calibration: Calibration, accuracy: ToolAccuracy) -> list[str]:
    """What matters most of what is not known after, in a line each."""
    lines = []
    for found in find_remaining_errors(calibration, accuracy, count=2):
        parts = ", ".join(f"{name} {share:+.1f}" for name, share in found.parts[:5])
        if parts and found.rms > 1e-6:
            lines.append(f"Largest part: {um(found.rms)} µm, from {parts} tolerances together.")
    return lines


def format_points(rows: Array) -> str:
    """Deviation and standard deviation at points as lines of CSV with POINT_COLUMNS, µm.

    Args:
        rows: Commanded position, deviation and its standard deviation, shape (K, 9), [m]; NaN for
            what is not known.
    """
    lines = []
    for row in rows:
        numbers = [f"{round(v / MM, 6) + 0.0:.9g}" for v in row[:3]]
        numbers += [f"{v / UM:.3f}" for v in row[3:]]
        lines.append(",".join("" if n == "nan" else n for n in numbers) + "\n")
    return "".join(lines)


def accuracy_json(calibration: Calibration, accuracy: ToolAccuracy) -> str:
    """Sizes over the region as JSON, SI units."""

    def size(s: ErrorSize | None) -> dict[str, float] | None:
        if s is None:
            return None
        return {"rms": s.rms, "percentile_95": s.percentile_95, "largest": s.largest}

    def all_sizes(sizes: ErrorSizes) -> dict[str, Any]:
        return {
            "aligned": size(sizes.aligned),
            "relative": size(sizes.relative),
            "absolute": size(sizes.absolute),
        }

    after = accuracy.after
    document = {
        "schema": "orthocal/accuracy/2",
        "robot": calibration.robot_record.name,
        "model": calibration.model,
        "points": len(accuracy.workspace.points),
        "box": None if accuracy.workspace.box is None else accuracy.workspace.box.tolist(),
        "deviation": all_sizes(accuracy.measure(accuracy.deviation)),
        "offsets_entered": all_sizes(accuracy.measure(accuracy.error_after_offsets)),
        "uncertainty_before": all_sizes(accuracy.before.sizes),
        "uncertainty_after": None if after is None else all_sizes(after.sizes),
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def _parts(size: ErrorSize) -> tuple[float, float, float]:
    return size.rms, size.percentile_95, size.largest
