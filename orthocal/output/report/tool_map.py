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
from orthocal.assessment.assess import changes_offsets
from orthocal.assessment.tool_error import ToolAccuracy
from orthocal.assessment.wording import um
from orthocal.calibration.calibration import Calibration
from orthocal.kinematics.workspace import grid_points
from orthocal.output.report.figure import Plot, open_figure
from orthocal.output.text.layout import true_minus
from orthocal.units import MM, UM

Field = Literal["now", "entered", "uncertainty"]

TITLES: dict[Field, str] = {
    "now": "Tool error now, workpiece aligned",
    "entered": "Tool error with the offsets entered, workpiece aligned",
    "uncertainty": "Uncertainty of the tool error, RMS, workpiece aligned",
}

AVERAGED = ", mean over conditions"

NEGLIGIBLE = 1e-3
"""Errors and differences of errors up to this count as zero, [µm]."""

CONSTANT_VARIATION = 1e-4
"""Relative variation over a plane up to which an error counts as constant."""

MAX_LEVELS = 8
"""Largest number of contour levels."""

DRAWN_POINTS = 43
"""Number of points per side of the drawn grid."""

ARROW_POSITIONS = np.array([-2.0, 0.0, 2.0]) / 3.0
"""Positions of the arrows along a side, from -1 to 1."""

MAX_DEGREE = 4
"""Largest degree of the splines, which are interpolating polynomials with five points per side."""

COLOURS = "cividis"

LABEL_MARGIN = 0.09
"""Smallest distance of a label from the border, relative to the shorter side."""

ARROW_LENGTH = 0.85
"""Length of the longest arrow, relative to the smaller distance between arrows."""


ARROW_WIDTH = 0.014
"""Width of the arrows, [inch]."""


def _find_grid(points: Array) -> list[Array] | None:
    """Coordinates along the sides of a grid with a middle point; None without such a grid."""
    lines = [np.unique(column) for column in points.T]
    if len(lines) < 2 or any(line.size < 3 or line.size % 2 == 0 for line in lines):
        return None
    grid = grid_points(*lines)
    return lines if np.array_equal(grid, points) else None


def _error_parts(accuracy: ToolAccuracy, which: Field) -> Array:
    """Tool errors after alignment, shape (K, 3), or their uncertainty, shape (K, 1), [µm].

    They are averaged over the conditions of use.
    """
    if which == "now":
        return accuracy.average(accuracy.align(accuracy.deviation)) / UM
    after = accuracy.after
    if which == "entered" or after is None:
        return accuracy.average(accuracy.align(accuracy.deviation_with_entries)) / UM
    variance = accuracy.average(np.trace(after.aligned_covariance, axis1=1, axis2=2))
    return np.asarray(np.sqrt(np.maximum(variance, 0.0))[:, None] / UM)


def plot_tool_map(calibration: Calibration, accuracy: ToolAccuracy, *, which: Field) -> str:
    """Tool error in the planes through the middle of the workspace, after alignment.

    Args:
        calibration: The calibration.
        accuracy: Tool errors over a grid with an odd number of points per side.
        which: The present error, the error with the offsets entered, or the uncertainty.

    Returns:
        The inline `<svg>`; "" if the points are not such a grid, the uncertainty is unknown, or the
        offsets do not change or are the only identified errors.
    """
    return Plot(f"tool-{which}", _draw_tool_map)(calibration, accuracy, which)


def _draw_tool_map(calibration: Calibration, accuracy: ToolAccuracy, which: Field) -> Figure | None:
    """Figure with one panel per plane; None without content."""
    lines = _find_grid(accuracy.points)
    shown = {
        "now": True,
        "entered": changes_offsets(calibration),
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
        interpolate = _interpolate(sides, _cut(grid, plane))
        maps.append((plane, sides, interpolate, *_refine(sides, interpolate)))
    levels = _choose_levels(np.concatenate([size.reshape(-1) for *_, size in maps]))
    title = TITLES[which] + (AVERAGED if accuracy.use.size > 1 else "")
    figure = open_figure(3.0 if len(planes) > 1 else 5.0, title, legend=False)
    panels = np.atleast_1d(figure.subplots(1, len(planes)))
    for axes, (plane, sides, interpolate, x, y, size) in zip(panels, maps, strict=True):
        axes.set(aspect="equal", title=_describe_cut(lines, plane, world))
        axes.set_xlabel(f"{'xyz'[world[plane[0]]]} [mm]")
        axes.set_ylabel(f"{'xyz'[world[plane[1]]]} [mm]", labelpad=0.0)
        covered = np.zeros((0, 2))
        if which != "uncertainty":
            covered = _draw_arrows(axes, sides, interpolate, [world[k] for k in plane], levels)
        _draw_size(axes, x, y, size, levels, covered)
    label = "size of the tool error [µm]; arrows: component in the plane"
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
    """Values in a plane through the middle of a grid, shape (n_x, n_y, n_components)."""
    middle = tuple(
        slice(None) if k in plane else size // 2 for k, size in enumerate(grid.shape[:-1])
    )
    return np.asarray(grid[middle])


def _interpolate(lines: list[Array], parts: Array) -> Callable[[Array, Array], Array]:
    """Spline interpolation of an error: (x, y), [m], to values, shape (n_components, n_x, n_y)."""
    degree = {
        k: min(MAX_DEGREE, line.size - 1) for k, line in zip(("kx", "ky"), lines, strict=True)
    }
    splines = [RectBivariateSpline(*lines, p, **degree) for p in np.moveaxis(parts, -1, 0)]
    return lambda x, y: np.array([spline(x, y) for spline in splines])


def _refine(
    lines: list[Array], interpolate: Callable[[Array, Array], Array]
) -> tuple[Array, Array, Array]:
    """Coordinates x and y of a fine grid, [mm], and norm of the error, shape (n_y, n_x), [µm]."""
    x, y = (np.linspace(line[0], line[-1], DRAWN_POINTS) for line in lines)
    return x / MM, y / MM, np.linalg.norm(interpolate(x, y), axis=0).T


def _describe_cut(lines: list[Array], plane: tuple[int, ...], world: tuple[int, ...]) -> str:
    """Position of a plane, such as z = 0 mm."""
    return ", ".join(
        f"{'xyz'[world[k]]} = {true_minus(f'{line[line.size // 2] / MM + 0.0:g}')} mm"
        for k, line in enumerate(lines)
        if k not in plane
    )


def _choose_levels(size: Array) -> Array:
    """Round contour levels, at least two, around all sizes, [µm]."""
    low, high = float(size.min()), float(size.max())
    if _is_constant(size):
        margin = max(0.01 * high, 0.5)
        low, high = max(low - margin, 0.0), high + margin
    return np.asarray(MaxNLocator(MAX_LEVELS, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high))


def _is_constant(size: Array) -> bool:
    """True if an error is constant over a plane."""
    return float(np.ptp(size)) < max(CONSTANT_VARIATION * float(size.max()), NEGLIGIBLE)


def _draw_size(axes: Axes, x: Array, y: Array, size: Array, levels: Array, covered: Array) -> None:
    """Draw colours and labelled contour lines of a size, shape (n_y, n_x), [µm]."""
    axes.contourf(x, y, size, levels=levels, norm=BoundaryNorm(levels, 256), cmap=COLOURS)
    inside = levels[(levels > size.min()) & (levels < size.max())]
    if _is_constant(size):
        ink = _ink(levels, float(size.mean()))
        text = f"{um(size.mean() * UM)} µm everywhere"
        axes.text(x.mean(), y.mean(), text, color=ink, horizontalalignment="center")
    elif inside.size:
        inks = [_ink(levels, value) for value in inside]
        contours = axes.contour(x, y, size, levels=inside, colors=inks, linewidths=0.8)
        places = _place_labels([path.vertices for path in contours.get_paths()], x, y, covered)
        axes.clabel(contours, fmt="%g", fontsize=7.0, inline_spacing=2, manual=places)


def _place_labels(
    contours: Sequence[ArrayLike], x: Array, y: Array, covered: Array
) -> list[tuple[float, float]]:
    """Label position on each contour, away from border, arrows and other labels."""
    side = float(min(x[-1] - x[0], y[-1] - y[0]))
    places: list[tuple[float, float]] = []
    for vertices in map(np.asarray, contours):
        edges = [vertices[:, 0] - x[0], x[-1] - vertices[:, 0]]
        edges += [vertices[:, 1] - y[0], y[-1] - vertices[:, 1]]
        to_border = np.minimum.reduce(edges)
        others = np.concatenate([covered, np.reshape(places, (-1, 2))])
        clearance = 2.0 * to_border
        if len(others):
            nearest = np.linalg.norm(vertices[:, None] - others, axis=-1).min(axis=1)
            clearance = np.minimum(clearance, nearest)
        clearance[to_border < LABEL_MARGIN * side] = -1.0
        if clearance.size and clearance.max() > 0.0:
            best = vertices[clearance.argmax()]
            places.append((float(best[0]), float(best[1])))
    return places


def _draw_arrows(
    axes: Axes,
    lines: list[Array],
    interpolate: Callable[[Array, Array], Array],
    within: list[int],
    levels: Array,
) -> Array:
    """Draw the component of an error in the plane as arrows.

    Args:
        axes: The axes.
        lines: Coordinates along both sides of the plane, [m].
        interpolate: Function for the error at coordinates.
        within: Components of the error in the plane.
        levels: Contour levels, [µm].

    Returns:
        Points that the arrows cover, shape (n, 2), [mm].
    """
    x, y = (0.5 * (v[0] + v[-1] + (v[-1] - v[0]) * ARROW_POSITIONS) for v in lines)
    errors = interpolate(x, y).transpose(2, 1, 0).reshape(-1, 3)
    in_plane = errors[:, within]
    longest = float(np.linalg.norm(in_plane, axis=1).max())
    if longest < NEGLIGIBLE:
        return np.zeros((0, 2))
    drawn = in_plane * (ARROW_LENGTH * min(x[1] - x[0], y[1] - y[0]) / MM / longest)
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) / MM
    axes.quiver(
        *points.T,
        *drawn.T,
        color=[_ink(levels, size) for size in np.linalg.norm(errors, axis=1)],
        pivot="middle",
        angles="xy",
        scale_units="xy",
        scale=1.0,
        units="inches",
        width=ARROW_WIDTH,
        zorder=2.0,
    )
    along = np.linspace(-0.5, 0.5, 7)[:, None, None]
    return np.asarray((points + along * drawn).reshape(-1, 2))


def _ink(levels: Array, size: float) -> str:
    """Readable text colour, white or black, on the colour of a size."""
    return "white" if size < 0.5 * (levels[0] + levels[-1]) else "black"
