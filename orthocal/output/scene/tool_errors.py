"""Errors of the tool in a scene: now, with the offsets entered, and what is not known of them."""

from __future__ import annotations

import meshcat.geometry as g
import numpy as np
from numpy.typing import NDArray

from orthocal.assessment.tool_error import ToolAccuracy, assess_remaining, assess_tool
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ClosureError, RobotError
from orthocal.output.text.layout import um
from orthocal.units import MM
from orthocal.viewer.scene import LegendEntry, Scene, round_scale
from orthocal.viewer.shapes import Colour, css, draw_arrow, material
from orthocal.viewer.stage import Stage

Array = NDArray[np.float64]

TOOL_NOW = "Tool error now"
TOOL_LEFT = "Tool error, offsets entered"
TOOL_UNKNOWN = "Tool error, not known"

NOW_COLOUR: Colour = (0.78, 0.12, 0.42)
LEFT_COLOUR: Colour = (0.10, 0.58, 0.42)
UNKNOWN_COLOUR: Colour = (0.45, 0.40, 0.65)

LONGEST_ARROW = 0.08
"""Part of the machine's size that the largest error of the tool is drawn as."""

ARROW_WIDTH = 0.006
"""The same for the width of arrows."""

VANISHING = 1e-7
"""Errors of the tool below this are not drawn, [m]."""


def draw_tool_errors(stage: Stage, calibration: Calibration, *, shown: bool) -> str:
    """Where the tool goes instead of where it is sent, now and with the offsets entered.

    Args:
        stage: The robot's scene.
        calibration: The calibration.
        shown: Whether that is shown at first.

    Returns:
        What is to be seen, in a sentence; empty where nothing is.
    """
    scene = stage.scene
    if calibration.robot.tcp is None:
        return ""
    try:
        found = assess_tool(calibration)
    except (ClosureError, RobotError) as e:
        scene.facts.append(f"Errors of the tool: none are shown. {e}.")
        return ""
    region = f"±{(found.workspace.half_side or 0.0) / MM:.3g} mm"
    fields = found.align(found.deviation), found.align(found.error_after_offsets)
    now, left = (float(np.linalg.norm(d, axis=1).max()) for d in fields)
    # in space, as in all tables: the axes of an ellipsoid are shorter
    after, excess = assess_remaining(calibration, found), calibration.tolerance_scale
    spread = 0.0 if after is None else after.sizes.headline.largest
    largest = max(now, left, spread)
    if largest < VANISHING:
        return ""
    chosen = _choose_points(found)
    scene.tool_scale = round_scale(LONGEST_ARROW * stage.size / largest)
    width = ARROW_WIDTH * stage.size
    for node, deviations, colour in (
        (TOOL_NOW, fields[0], NOW_COLOUR),
        (TOOL_LEFT, fields[1], LEFT_COLOUR),
    ):
        _draw_deviations(scene, node, found.targets[chosen], deviations[chosen], colour, width)
    drawn = f"× {scene.tool_scale:g}"
    text = f"Tool now, over {region}, aligned: up to {um(now)} µm off ({drawn})"
    scene.explain(LegendEntry(text, (TOOL_NOW,), css(NOW_COLOUR), "arrow", shown))
    if left > VANISHING:
        text = f"Tool with the offsets entered: up to {um(left)} µm off ({drawn})"
        scene.explain(LegendEntry(text, (TOOL_LEFT,), css(LEFT_COLOUR), "arrow", shown))
    if after is not None:
        _draw_ellipsoids(scene, found.targets[chosen], after.aligned_covariance[chosen])
        worse = f", errors {excess:.1f} × tolerances" if excess > 1.0 else ""
        text = f"Tool, all that was found corrected: one σ, up to {um(spread)} µm{worse} ({drawn})"
        scene.explain(LegendEntry(text, (TOOL_UNKNOWN,), css(UNKNOWN_COLOUR), "ball", shown))
    headline = (
        f"The tool is up to {um(now)} µm off where it is sent, over {region}, shift and rotation "
        "out."
    )
    if after is not None:
        headline += f" Corrected, it is known to {um(spread)} µm or better (one σ)."
    return headline


def _choose_points(found: ToolAccuracy) -> NDArray[np.int64]:
    """Points of the grid that are drawn: middles and ends of its sides."""
    points = found.workspace.points
    chosen = np.ones(len(points), dtype=bool)
    for column in points.T:
        line = np.unique(column)
        chosen &= np.isin(column, line[[0, line.size // 2, -1]])
    return np.flatnonzero(chosen)


def _draw_deviations(
    scene: Scene, node: str, targets: Array, deviations: Array, colour: Colour, width: float
) -> None:
    for i, (target, deviation) in enumerate(zip(targets, deviations, strict=True)):
        length = float(np.linalg.norm(deviation))
        if length > VANISHING:
            draw_arrow(
                scene,
                f"{node}/point {i + 1}",
                target,
                deviation / length,
                length=length * scene.tool_scale,
                width=width,
                colour=colour,
            )


def _draw_ellipsoids(scene: Scene, targets: Array, covariances: Array) -> None:
    """One standard deviation of the tool's position, around where it is taken to be at best."""
    for i, (target, covariance) in enumerate(zip(targets, covariances, strict=True)):
        values, vectors = np.linalg.eigh(covariance)
        if np.linalg.det(vectors) < 0.0:
            vectors[:, 0] = -vectors[:, 0]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = vectors, target
        radii = scene.tool_scale * np.sqrt(np.maximum(values, 1e-18))
        path = f"{TOOL_UNKNOWN}/point {i + 1}"
        scene.add(path, g.Sphere(1.0), material(UNKNOWN_COLOUR, opacity=0.3))
        scene.place(path, pose @ np.diag([*radii, 1.0]))
