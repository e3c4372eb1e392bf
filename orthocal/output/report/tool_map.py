"""Maps of the tool error in the planes through the middle of the workspace."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike
from scipy.interpolate import RectBivariateSpline

from orthocal.arrays import Array
from orthocal.assessment.assess import assessment_of
from orthocal.assessment.tool_error import ToolAccuracy
from orthocal.calibration.calibration import Calibration
from orthocal.output.report.figure import Plot, open_figure
from orthocal.units import MM, UM

Field = Literal["now", "entered", "uncertainty"]

TITLES: dict[Field, str] = {
    "now": "Tool error now, workpiece aligned",
    "entered": "Tool error with the offsets entered, workpiece aligned",
    "uncertainty": "Uncertainty of the tool error, RMS, workpiece aligned",
}

AVERAGED = ", mean over conditions"

FINEST = 1e-3
"""Errors and differences of errors below this are zero, [µm]."""

EVEN = 1e-4
"""Relative variation over a plane below which an error counts as constant."""

LEVELS = 8
"""Largest number of contour levels."""

FINE = 43
"""Points per side of the drawn grid."""

ARROWS = np.array([-2.0, 0.0, 2.0]) / 3.0
"""Places of the arrows along a side, from -1 to 1."""

HIGHEST_DEGREE = 4
"""Degree of the splines; with five points per side they are polynomials through all points."""

COLOURS = "cividis"

MARGIN = 0.09
"""Distance from the border within which a label would be cut off, in sides."""

ARROW = 0.85
"""Length of the longest arrow, in distances between arrows."""


def _find_grid(points: Array) -> list[Array] | None:
    """Coordinates along the sides of a grid with a middle point; None for other points."""
    lines = [np.unique(column) for column in points.T]
    if len(lines) < 2 or any(line.size < 3 or line.size % 2 == 0 for line in lines):
        return None
    grid = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, len(lines))
    return lines if np.array_equal(grid, points) else None


def _error_parts(accuracy: ToolAccuracy, which: Field) -> Array:
    """Tool errors after alignment, shape (K, 3), or their uncertainty, shape (K, 1), [µm].

    Means over the conditions of use.
    """
    if which == "now":
        return accuracy.average(accuracy.align(accuracy.deviation)) / UM
    remaining = accuracy.after
    if which == "entered" or remaining is None:
        return accuracy.average(accuracy.align(accuracy.deviation_with_entries)) / UM
    variance = accuracy.average(np.trace(remaining.aligned_covariance, axis1=1, axis2=2))
    return np.asarray(np.sqrt(np.maximum(variance, 0.0))[:, None] / UM)


def plot_tool_map(calibration: Calibration, accuracy: ToolAccuracy, *, which: Field) -> str:
    """Tool error in the planes through the middle of the workspace, after alignment.

    Args:
        calibration: The calibration.
        accuracy: Tool errors over a grid with an odd number of points per side.
        which: The present error, the error with the offsets entered, or the uncertainty.

    Returns:
        "" if the points are not such a grid, if the uncertainty is unknown, and for the error with
        the offsets entered if nothing but offsets was identified, because it is zero by definition.
    """
    return Plot(f"tool-{which}", _draw_tool_map)(calibration, accuracy, which)


def _draw_tool_map(calibration: Calibration, accuracy: ToolAccuracy, which: Field) -> Figure | None:
    lines = _find_grid(accuracy.points)
    shown = {
        "now": True,
        "entered": not calibration.only_offsets and not assessment_of(calibration).keeps_offsets,
        "uncertainty": accuracy.after is not None,
    }
    if lines is None or not shown[which]:
        return None
    planes = list(combinations(range(len(lines)), 2))
    tcp = calibration.robot.tcp
    world = tuple(range(len(lines))) if tcp is None else tcp.coordinates
    grid = _error_parts(accuracy, which).reshape(*(line.size for line in lines), -1)
    maps = []
    for plane in planes:
        sides = [lines[k] for k in plane]
        between = _interpolate(sides, _cut(grid, plane))
        maps.append((plane, sides, between, *_refine(sides, between)))
    levels = _choose_levels(np.concatenate([size.reshape(-1) for *_, size in maps]))
    title = TITLES[which] + (AVERAGED if accuracy.use.size > 1 else "")
    figure = open_figure(3.0 if len(planes) > 1 else 5.0, title, legend=False)
    panels = np.atleast_1d(figure.subplots(1, len(planes)))
    for axes, (plane, sides, between, x, y, size) in zip(panels, maps, strict=True):
        axes.set(aspect="equal", title=_describe_cut(lines, plane, world))
        axes.set_xlabel(f"{'xyz'[world[plane[0]]]} [mm]")
        axes.set_ylabel(f"{'xyz'[world[plane[1]]]} [mm]", labelpad=0.0)
        taken = np.zeros((0, 2))
        if which != "uncertainty":
            taken = _draw_arrows(axes, sides, between, [world[k] for k in plane], levels)
        _draw_size(axes, x, y, size, levels, taken)
    label = "size of the tool error [µm]; arrows: its part in the plane"
    if which == "uncertainty":
        label = "RMS uncertainty in space [µm]"
        scale = calibration.tolerance_scale.factor
        if scale > 1.0:
            label += f", tolerances × {scale:.1f}"
    figure.colorbar(
        ScalarMappable(BoundaryNorm(levels, 256), COLOURS),
        ax=list(panels),
        label=label,
        orientation="horizontal",
        aspect=50,
        ticks=levels,
        format="%g",
    )
    return figure


def _cut(grid: Array, plane: tuple[int, ...]) -> Array:
    """Values in a plane through the middle of a grid, shape (n_x, n_y, parts)."""
    middle = tuple(
        slice(None) if k in plane else size // 2 for k, size in enumerate(grid.shape[:-1])
    )
    return np.asarray(grid[middle])


def _interpolate(lines: list[Array], parts: Array) -> Callable[[Array, Array], Array]:
    """Spline interpolation of an error: (x, y) in m to values, shape (parts, n_x, n_y)."""
    degree = {
        k: min(HIGHEST_DEGREE, line.size - 1) for k, line in zip(("kx", "ky"), lines, strict=True)
    }
    splines = [RectBivariateSpline(*lines, p, **degree) for p in np.moveaxis(parts, -1, 0)]
    return lambda x, y: np.array([spline(x, y) for spline in splines])


def _refine(
    lines: list[Array], between: Callable[[Array, Array], Array]
) -> tuple[Array, Array, Array]:
    """Coordinates x and y of a fine grid, [mm], and the size of the error, shape (n_y, n_x)."""
    x, y = (np.linspace(line[0], line[-1], FINE) for line in lines)
    return x / MM, y / MM, np.linalg.norm(between(x, y), axis=0).T


def _describe_cut(lines: list[Array], plane: tuple[int, ...], world: tuple[int, ...]) -> str:
    """Position of a plane, such as z = 0 mm."""
    return ", ".join(
        f"{'xyz'[world[k]]} = {line[line.size // 2] / MM + 0.0:g} mm"
        for k, line in enumerate(lines)
        if k not in plane
    )


def _choose_levels(size: Array) -> Array:
    """Round contour levels, at least two, around all sizes, [µm]."""
    low, high = float(size.min()), float(size.max())
    if _is_constant(size):
        around = max(0.01 * high, 0.5)
        low, high = max(low - around, 0.0), high + around
    return np.asarray(MaxNLocator(LEVELS, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high))


def _is_constant(size: Array) -> bool:
    """True if an error is constant over a plane."""
    return float(np.ptp(size)) < max(EVEN * float(size.max()), FINEST)


def _draw_size(axes: Axes, x: Array, y: Array, size: Array, levels: Array, taken: Array) -> None:
    """Draw colours and labelled contour lines of a size, shape (n_y, n_x), [µm]."""
    axes.contourf(x, y, size, levels=levels, norm=BoundaryNorm(levels, 256), cmap=COLOURS)
    inside = levels[(levels > size.min()) & (levels < size.max())]
    if _is_constant(size):
        ink = _ink(levels, float(size.mean()))
        text = f"{size.mean():.3g} µm everywhere"
        axes.text(x.mean(), y.mean(), text, color=ink, horizontalalignment="center")
    elif inside.size:
        inks = [_ink(levels, value) for value in inside]
        contours = axes.contour(x, y, size, levels=inside, colors=inks, linewidths=0.8)
        places = _place_labels([path.vertices for path in contours.get_paths()], x, y, taken)
        axes.clabel(contours, fmt="%g", fontsize=7.0, inline_spacing=2, manual=places)


def _place_labels(
    contours: Sequence[ArrayLike], x: Array, y: Array, taken: Array
) -> list[tuple[float, float]]:
    """A point for a label on each contour that is away from border, arrows and other labels."""
    side = float(x[-1] - x[0])
    places: list[tuple[float, float]] = []
    for vertices in map(np.asarray, contours):
        edges = [vertices[:, 0] - x[0], x[-1] - vertices[:, 0]]
        edges += [vertices[:, 1] - y[0], y[-1] - vertices[:, 1]]
        room = np.minimum.reduce(edges)
        others = np.concatenate([taken, np.reshape(places, (-1, 2))])
        away = 2.0 * room
        if len(others):
            nearest = np.linalg.norm(vertices[:, None] - others, axis=-1).min(axis=1)
            away = np.minimum(away, nearest)
        away[room < MARGIN * side] = -1.0
        if away.size and away.max() > 0.0:
            best = vertices[away.argmax()]
            places.append((float(best[0]), float(best[1])))
    return places


def _draw_arrows(
    axes: Axes,
    lines: list[Array],
    between: Callable[[Array, Array], Array],
    within: list[int],
    levels: Array,
) -> Array:
    """Draw the part of an error in the plane as arrows.

    Returns:
        Points that the arrows cover, shape (n, 2), [mm].
    """
    x, y = (0.5 * (v[0] + v[-1] + (v[-1] - v[0]) * ARROWS) for v in lines)
    some = between(x, y).transpose(2, 1, 0).reshape(-1, 3)
    parts = some[:, within]
    longest = float(np.linalg.norm(parts, axis=1).max())
    if longest < FINEST:
        return np.zeros((0, 2))
    drawn = parts * (ARROW * (x[1] - x[0]) / MM / longest)
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) / MM
    axes.quiver(
        *points.T,
        *drawn.T,
        color=[_ink(levels, size) for size in np.linalg.norm(some, axis=1)],
        pivot="middle",
        angles="xy",
        scale_units="xy",
        scale=1.0,
        width=0.008,
        zorder=2.0,
    )
    along = np.linspace(-0.5, 0.5, 7)[:, None, None]
    return np.asarray((points + along * drawn).reshape(-1, 2))


def _ink(levels: Array, size: float) -> str:
    """Colour of text that is readable on the colour of a size."""
    return "white" if size < 0.5 * (levels[0] + levels[-1]) else "black"
