"""Tool errors in a scene: now, with the values entered, and their uncertainty."""

from __future__ import annotations

import meshcat.geometry as g
import numpy as np
from numpy.typing import NDArray

from orthocal.arrays import Array
from orthocal.assessment.assess import changes_offsets
from orthocal.assessment.tool_error import ToolAccuracy, assess_tool
from orthocal.assessment.wording import um
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ClosureError, RobotError
from orthocal.viewer.machine import MachineScene
from orthocal.viewer.scene import LegendEntry, Scene, round_scale
from orthocal.viewer.shapes import Colour, css, draw_arrow, material, pose_along

TOOL_NOW = "Tool error now"
TOOL_ENTERED = "Tool error, values entered"
TOOL_UNCERTAINTY = "Tool error, uncertainty"

NOW_COLOUR: Colour = (0.78, 0.12, 0.42)
ENTERED_COLOUR: Colour = (0.10, 0.58, 0.42)
UNCERTAINTY_COLOUR: Colour = (0.45, 0.40, 0.65)

LONGEST_ARROW = 0.08
"""Drawn length of the largest tool error, relative to the machine."""

ARROW_WIDTH = 0.006
"""Width of the arrows, relative to the machine."""

NEGLIGIBLE = 1e-7
"""Tool errors below this are not drawn, [m]."""


def draw_tool_errors(drawing: MachineScene, calibration: Calibration, *, shown: bool) -> str:
    """Draw tool errors, now and with the values entered, and their uncertainty.

    Arrows are means over the conditions of use. Texts state the largest error under any of them.

    Args:
        drawing: The scene of the machine.
        calibration: The calibration.
        shown: Whether they are initially visible.

    Returns:
        Main result in a sentence; "" if nothing is drawn.
    """
    scene = drawing.scene
    if calibration.robot.tcp is None:
        return ""
    try:
        accuracy = assess_tool(calibration)
    except (ClosureError, RobotError) as e:
        scene.facts.append(f"Tool errors are not shown: {e}.")
        return ""
    region = accuracy.workspace.words.removeprefix("the workspace ")
    fields = (accuracy.deviation, accuracy.deviation_with_entries)
    now, entered = (accuracy.align(d) for d in fields)
    now_largest, entered_largest = (_largest(d) for d in (now, entered))
    now, entered = (accuracy.average(d) for d in (now, entered))
    # uncertainty as in all tables: RMS in space, longer than the axes of its ellipsoid
    calibrated, scale_factor = accuracy.after, calibration.tolerance_scale.factor
    uncertainty = 0.0 if calibrated is None else calibrated.sizes.reported.largest
    largest = max(now_largest, entered_largest, uncertainty)
    if largest < NEGLIGIBLE:
        return ""
    chosen = _choose_points(accuracy)
    scene.tool_scale = round_scale(LONGEST_ARROW * drawing.size / largest)
    scale, targets = f"× {scene.tool_scale:g}", accuracy.targets[chosen]
    averaged = "; arrows: mean over the conditions" if accuracy.use.size > 1 else ""
    width = ARROW_WIDTH * drawing.size
    _draw_deviations(scene, TOOL_NOW, targets, now[chosen], NOW_COLOUR, width)
    text = f"Tool error now, {region}, aligned: up to {um(now_largest)} µm{averaged} ({scale})"
    scene.explain(LegendEntry(text, (TOOL_NOW,), css(NOW_COLOUR), "arrow", shown))
    if changes_offsets(calibration) or accuracy.deviation_without_backlash is not None:
        _draw_deviations(scene, TOOL_ENTERED, targets, entered[chosen], ENTERED_COLOUR, width)
        size = f"up to {um(entered_largest)} µm{averaged}"
        text = f"Tool error with the values entered: {size} ({scale})"
        scene.explain(LegendEntry(text, (TOOL_ENTERED,), css(ENTERED_COLOUR), "arrow", shown))
    headline = f"Tool error now: up to {um(now_largest)} µm over {region}, workpiece aligned."
    if calibrated is not None:
        _draw_ellipsoids(scene, targets, accuracy.average(calibrated.aligned_covariance)[chosen])
        scaled = f", errors at {scale_factor:.1f} × tolerances" if scale_factor > 1.0 else ""
        size = f"up to {um(uncertainty)} µm RMS"
        text = f"Tool uncertainty, all identified errors corrected: {size}{scaled} ({scale})"
        colour = css(UNCERTAINTY_COLOUR)
        scene.explain(LegendEntry(text, (TOOL_UNCERTAINTY,), colour, "ball", shown))
        headline += f" With all identified errors corrected: {size}."
    return headline


def _largest(deviations: Array) -> float:
    """Largest length of deviations of shape (n, 3), [m]."""
    return float(np.linalg.norm(deviations, axis=1).max())


def _choose_points(accuracy: ToolAccuracy) -> NDArray[np.int64]:
    """Indices of the drawn grid points: first, middle and last along each axis."""
    points = accuracy.points
    chosen = np.ones(len(points), dtype=bool)
    for column in points.T:
        line = np.unique(column)
        chosen &= np.isin(column, line[[0, line.size // 2, -1]])
    return np.flatnonzero(chosen)


def _draw_deviations(
    scene: Scene, node: str, targets: Array, deviations: Array, colour: Colour, width: float
) -> None:
    """Draw deviations of the tool as arrows at its targets."""
    for i, (target, deviation) in enumerate(zip(targets, deviations, strict=True)):
        length = float(np.linalg.norm(deviation))
        if length > NEGLIGIBLE:
            pose = pose_along(target, deviation / length)
            lengths = [length * scene.tool_scale]
            draw_arrow(scene, f"{node}/point {i + 1}", pose, lengths, width=width, colour=colour)


def _draw_ellipsoids(scene: Scene, targets: Array, covariances: Array) -> None:
    """Draw ellipsoids of one standard deviation of the tool's position at its targets."""
    for i, (target, covariance) in enumerate(zip(targets, covariances, strict=True)):
        values, vectors = np.linalg.eigh(covariance)
        if np.linalg.det(vectors) < 0.0:
            vectors[:, 0] = -vectors[:, 0]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = vectors, target
        radii = scene.tool_scale * np.sqrt(np.maximum(values, 1e-18))
        appearance = material(UNCERTAINTY_COLOUR, opacity=0.3)
        path = f"{TOOL_UNCERTAINTY}/point {i + 1}"
        scene.add(path, g.Sphere(1.0), appearance, pose @ np.diag([*radii, 1.0]))
