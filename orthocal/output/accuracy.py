"""Where the tool is and how well that is known, as tables."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.errors import ClosureError
from orthocal.identification.calibration import Calibration
from orthocal.output.layout import add_row, print_rich, table_of, um
from orthocal.study.accuracy import (
    HALF_SIDE,
    ErrorSize,
    ToolAccuracy,
    assess_cube,
    assess_remaining,
    find_remaining_errors,
    measure_deviations,
)

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
    if calibration.robot.tcp is None:
        return Text("This robot has no tool centre point: give orthocal.tcp in its YAML.")
    try:
        accuracy = assess_cube(calibration)
    except ClosureError as e:
        return Text(f"The cube of ±{HALF_SIDE * 1e3:g} mm is out of reach: {e}.")
    return render_accuracy(
        calibration, accuracy, region=f"a cube of ±{HALF_SIDE * 1e3:g} mm around the zero"
    )


def print_accuracy(calibration: Calibration, accuracy: ToolAccuracy, *, region: str) -> None:
    """Print the tool's errors over a region."""
    print_rich(render_accuracy(calibration, accuracy, region=region))


def render_accuracy(
    calibration: Calibration, accuracy: ToolAccuracy, *, region: str
) -> RenderableType:
    """The tool's errors over a region.

    Args:
        calibration: The calibration.
        accuracy: Its errors at the tool.
        region: What the points are, in words.
    """
    weights = accuracy.workspace.weights
    sizes = ("95 %", "worst point")
    table = table_of("[µm]", "r.m.s.", *sizes, "shift out: r.m.s.", *sizes)
    rows: list[tuple[str, ErrorSize, ErrorSize]] = [
        (
            "off its target now",
            measure_deviations(accuracy.deviation, weights),
            measure_deviations(accuracy.relative_deviation, weights),
        ),
    ]
    if len(calibration.free) > len(calibration.controller_entries()):
        rows.append(
            (
                "with the offsets entered",
                measure_deviations(accuracy.left, weights),
                measure_deviations(accuracy.relative_left, weights),
            )
        )
    rows.append(("not known before", accuracy.before.absolute, accuracy.before.relative))
    remaining, excess = assess_remaining(calibration, accuracy)
    if accuracy.after is not None:
        rows.append(("not known after", accuracy.after.absolute, accuracy.after.relative))
    if remaining is not None and excess > 1.0:
        rows.append((f"  at {excess:.1f} × tolerances", remaining.absolute, remaining.relative))
    for name, absolute, relative in rows:
        add_row(table, name, *(um(v) for size in (absolute, relative) for v in _parts(size)))
    lines: list[RenderableType] = [
        table,
        Text(f"Over {region}: absolute, then with the common shift taken out (shift out)."),
    ]
    if accuracy.after is None:
        lines.append(Text("What is not known after cannot be told: nothing tells the noise."))
    else:
        lines.append(
            Text(
                "Not known: one standard deviation in space (95 %: 95 of 100 errors are smaller; "
                "worst point: one standard deviation there), with all errors of the machine that "
                "were not identified at their tolerances."
            )
        )
        if excess > 1.0:
            lines.append(
                Text(
                    f"What remains of the readings is {excess:.1f} times what such errors would "
                    "leave: this machine seems to be as much worse than its tolerances."
                )
            )
        if len(calibration.free) <= len(calibration.controller_entries()):
            last = "not known after" if excess == 1.0 else f"at {excess:.1f} × tolerances"
            lines.append(Text(f"With the offsets entered, '{last}' is what the tool is good for."))
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
        numbers = [f"{round(v * 1e3, 6) + 0.0:.9g}" for v in row[:3]]
        numbers += [f"{v * 1e6:.3f}" for v in row[3:]]
        lines.append(",".join("" if n == "nan" else n for n in numbers) + "\n")
    return "".join(lines)


def accuracy_json(calibration: Calibration, accuracy: ToolAccuracy) -> str:
    """Sizes over the region as JSON, SI units."""
    weights = accuracy.workspace.weights

    def size(s: ErrorSize) -> dict[str, float]:
        return {"rms": s.rms, "percentile_95": s.percentile_95, "largest": s.largest}

    def both(name: str) -> dict[str, Any] | None:
        found = getattr(accuracy, name)
        if found is None:
            return None
        return {"absolute": size(found.absolute), "relative": size(found.relative)}

    document = {
        "schema": "orthocal/accuracy/1",
        "robot": calibration.robot_record.name,
        "model": calibration.model,
        "points": len(accuracy.workspace.points),
        "deviation": {
            "absolute": size(measure_deviations(accuracy.deviation, weights)),
            "relative": size(measure_deviations(accuracy.relative_deviation, weights)),
        },
        "offsets_entered": {
            "absolute": size(measure_deviations(accuracy.left, weights)),
            "relative": size(measure_deviations(accuracy.relative_left, weights)),
        },
        "uncertainty_before": both("before"),
        "uncertainty_after": both("after"),
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def _parts(size: ErrorSize) -> tuple[float, float, float]:
    return size.rms, size.percentile_95, size.largest
