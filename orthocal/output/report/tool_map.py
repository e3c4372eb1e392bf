"""A calibration at the tool: maps of the planes through the middle of a region."""

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
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RectBivariateSpline

from orthocal.assessment.controller_entries import find_entries
from orthocal.assessment.tool_error import ToolAccuracy, assess_remaining
from orthocal.calibration.calibration import Calibration
from orthocal.output.report.figure import open_figure, render_figure
from orthocal.units import MM, UM

Array = NDArray[np.float64]

Field = Literal["now", "left", "unknown"]

TITLES: dict[Field, str] = {
    "now": "How far the tool is off its target now, shift and rotation taken out",
    "left": "How far the tool is off with the offsets entered, shift and rotation out",
    "unknown": "What is not known of the tool after calibration, 1 σ, shift and rotation out",
}

FINEST = 1e-3
"""Errors, and differences of errors, below which they are none, [µm]."""

EVEN = 1e-4
"""Part of an error by which it must differ over a plane not to be the same everywhere."""

LEVELS = 8

FINE = 43
"""Points a side that the map is drawn from."""

ARROWS = np.array([-2.0, 0.0, 2.0]) / 3.0
"""Where arrows are drawn along a side, from -1 to 1."""

HIGHEST_DEGREE = 4
"""Of the splines between points: with five a side they are the polynomials through all of them."""

COLOURS = "cividis"

MARGIN = 0.09
"""Part of a side within which a border would cut a label off."""

ARROW = 0.85
"""Length of the longest arrow, in distances between arrows."""


def plot_tool_map(calibration: Calibration, accuracy: ToolAccuracy, *, which: Field) -> str:
    """The tool's error in the planes through the middle of a region, shift and rotation taken out.

    Args:
        calibration: The calibration.
        accuracy: Its errors at the tool, over a grid with an odd number of points a side.
        which: The error as the machine is now, what is left of it with the identified offsets in
            the controller, or what is not known after the calibration.

    Returns:
        "" where the points are no such grid, where nothing tells what is not known, and for what
        is left where nothing but offsets was identified: it would be nothing by definition.
    """
    lines = _find_grid(accuracy.workspace.points)
    told = {
        "now": True,
        "left": not calibration.only_offsets and bool(find_entries(calibration)),
        "unknown": accuracy.after is not None,
    }
    if lines is None or not told[which]:
        return ""
    label = f"{TITLES[which]}: maps of the planes through the middle of the region, in µm."
    return render_figure(
        f"tool-{which}", label, lambda: _draw_tool_map(calibration, accuracy, which, lines)
    )


def _find_grid(points: Array) -> list[Array] | None:
    """Coordinates along each side, where points are a grid of two or three with a middle."""
    lines = [np.unique(column) for column in points.T]
    if len(lines) < 2 or any(line.size < 3 or line.size % 2 == 0 for line in lines):
        return None
    grid = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, len(lines))
    return lines if np.array_equal(grid, points) else None


def _error_parts(calibration: Calibration, accuracy: ToolAccuracy, which: Field) -> Array:
    """What the size of the error is the length of, (K, 3) or without direction (K, 1), [µm].

    Shift and rotation of the whole region are no errors of a workpiece that is aligned there.
    """
    if which == "now":
        return accuracy.align(accuracy.deviation) / UM
    remaining = assess_remaining(calibration, accuracy)
    if which == "left" or remaining is None:
        return accuracy.align(accuracy.error_after_offsets) / UM
    variance = np.trace(remaining.aligned_covariance, axis1=1, axis2=2)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0))[:, None] / UM)


def _draw_tool_map(
    calibration: Calibration, accuracy: ToolAccuracy, which: Field, lines: list[Array]
) -> Figure:
    planes = list(combinations(range(len(lines)), 2))
    tcp = calibration.robot.tcp
    world = tuple(range(len(lines))) if tcp is None else tcp.coordinates
    grid = _error_parts(calibration, accuracy, which).reshape(*(line.size for line in lines), -1)
    cuts = [_cut(grid, plane) for plane in planes]
    between = [
        _interpolate([lines[k] for k in plane], cut)
        for plane, cut in zip(planes, cuts, strict=True)
    ]
    fine = [
        _refine([lines[k] for k in plane], at) for plane, at in zip(planes, between, strict=True)
    ]
    levels = _choose_levels(np.concatenate([size.reshape(-1) for *_, size in fine]))
    figure = open_figure(3.0 if len(planes) > 1 else 5.0, TITLES[which], legend=False)
    panels = np.atleast_1d(figure.subplots(1, len(planes)))
    for axes, plane, at, (x, y, size) in zip(panels, planes, between, fine, strict=True):
        axes.set(aspect="equal", title=_describe_cut(lines, plane, world))
        axes.set_xlabel(f"{'xyz'[world[plane[0]]]} [mm]")
        axes.set_ylabel(f"{'xyz'[world[plane[1]]]} [mm]", labelpad=0.0)
        taken = np.zeros((0, 2))
        if which != "unknown":
            sides = [lines[k] for k in plane]
            taken = _draw_arrows(axes, sides, at, [world[k] for k in plane], levels)
        _draw_size(axes, x, y, size, levels, taken)
    label = "size of the error [µm]; arrows: its part in the plane"
    if which == "unknown":
        label = "standard deviation in space [µm]"
        excess = calibration.tolerance_scale
        if excess > 1.0:
            label += f", errors at {excess:.1f} × their tolerances"
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
    """Values over a plane through the middle of a grid, shape (n_x, n_y, parts)."""
    middle = tuple(
        slice(None) if k in plane else size // 2 for k, size in enumerate(grid.shape[:-1])
    )
    return np.asarray(grid[middle])


def _interpolate(lines: list[Array], parts: Array) -> Callable[[Array, Array], Array]:
    """An error between points of its grid: (x, y) in m to (parts, n_x, n_y), by splines."""
    degree = {
        k: min(HIGHEST_DEGREE, line.size - 1) for k, line in zip(("kx", "ky"), lines, strict=True)
    }
    splines = [RectBivariateSpline(*lines, p, **degree) for p in np.moveaxis(parts, -1, 0)]
    return lambda x, y: np.array([spline(x, y) for spline in splines])


def _refine(
    lines: list[Array], between: Callable[[Array, Array], Array]
) -> tuple[Array, Array, Array]:
    """Size of an error all over a plane.

    Returns:
        x and y, [mm], and the size, shape (n_y, n_x).
    """
    x, y = (np.linspace(line[0], line[-1], FINE) for line in lines)
    return x / MM, y / MM, np.linalg.norm(between(x, y), axis=0).T


def _describe_cut(lines: list[Array], plane: tuple[int, ...], world: tuple[int, ...]) -> str:
    """Where the plane lies: z = 0 mm."""
    return ", ".join(
        f"{'xyz'[world[k]]} = {line[line.size // 2] / MM + 0.0:g} mm"
        for k, line in enumerate(lines)
        if k not in plane
    )


def _choose_levels(size: Array) -> Array:
    """Round levels around all sizes, two at least, [µm]."""
    low, high = float(size.min()), float(size.max())
    if _is_even(size):
        around = max(0.01 * high, 0.5)
        low, high = max(low - around, 0.0), high + around
    return np.asarray(MaxNLocator(LEVELS, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high))


def _is_even(size: Array) -> bool:
    """Whether an error is the same everywhere."""
    return float(np.ptp(size)) < max(EVEN * float(size.max()), FINEST)


def _draw_size(axes: Axes, x: Array, y: Array, size: Array, levels: Array, taken: Array) -> None:
    """Colours and labelled contour lines of the size over a plane, shape (n_y, n_x), [µm]."""
    axes.contourf(x, y, size, levels=levels, norm=BoundaryNorm(levels, 256), cmap=COLOURS)
    inside = levels[(levels > size.min()) & (levels < size.max())]
    if _is_even(size):
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
    """A point on each contour away from border, arrows and other labels; none on the shortest."""
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
    """The part of an error in the plane.

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
    """What can be read on the colour of a size."""
    return "white" if size < 0.5 * (levels[0] + levels[-1]) else "black"
