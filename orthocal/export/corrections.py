"""Corrections of the tool over a grid, for controllers with nominal kinematics and such a table.

A controller that is nominal but for its offsets o sends the drives to ρ(p) − o for a point p. The
drives belong at c(p), the calibrated machine's inverse. So it is to be sent to p + d instead,

    d = f(c(p) + o) − p,  f the nominal forward kinematics.
"""

from __future__ import annotations

import csv
import io

from orthocal.assessment.calibrated_tool import find_tool
from orthocal.assessment.controller_entries import entered_offsets
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ClosureError, ExportError
from orthocal.kinematics.loop_closure import nominal_assembly
from orthocal.kinematics.workspace import even_grid
from orthocal.units import MM

AXES = "xyz"

POINTS_A_SIDE = 7


def export_corrections(calibration: Calibration) -> dict[str, str]:
    """corrections.csv: points of the tool, and what to add to each once offsets are entered, mm.

    Raises:
        ExportError: If the machine has no tool, or does not reach the grid.
    """
    tool, robot = find_tool(calibration), calibration.robot
    if tool is None or robot.tcp is None:
        raise ExportError("the machine has no tool that its drives command over a region")
    points = even_grid(robot, tool.workspace.limits, points_a_side=POINTS_A_SIDE)
    nominal = nominal_assembly(robot)
    chosen = list(robot.tcp.coordinates)
    try:
        drives = calibration.machine.inverse(points) + entered_offsets(calibration)
        sent = nominal.forward(drives)[:, chosen]
    except ClosureError as e:
        raise ExportError(f"the calibrated machine does not reach the whole grid: {e}") from None
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    names = [AXES[k] for k in chosen]
    rows.writerow([*(f"{n}_mm" for n in names), *(f"d{n}_mm" for n in names)])
    for point, change in zip(points, sent - points, strict=True):
        rows.writerow([*(_fixed(v / MM, 3) for v in point), *(_fixed(v / MM, 6) for v in change)])
    return {"corrections.csv": text.getvalue()}


def _fixed(value: float, decimals: int) -> str:
    """A number with so many decimals; 0 has no sign."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"
