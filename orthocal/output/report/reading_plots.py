"""Plots of the readings: deviations before and after, RMS per setup, distribution, circles."""

from __future__ import annotations

import math
from operator import attrgetter
from typing import cast

import numpy as np
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes
from numpy.typing import NDArray
from scipy import special

from orthocal.arrays import Array
from orthocal.assessment.circular_deviation import Circle
from orthocal.assessment.wording import um
from orthocal.calibration.calibration import Calibration
from orthocal.estimation.diagnostics.residual_rows import (
    largest_first,
    root_mean_square,
    rows_by_setup,
)
from orthocal.output.report.figure import (
    AFTER,
    AFTER_LOOK,
    BEFORE,
    BEFORE_LOOK,
    PREDICTED_LOOK,
    ROW_HEIGHT,
    count_of,
    draw_legend,
    open_figure,
    open_list,
    plot,
    round_up,
    scale_log,
    shade,
)
from orthocal.units import MM, UM

_deviation, _residual, _prediction_error = map(
    attrgetter, ("deviation", "residual", "prediction_error")
)

SMALLEST_LENGTH = 1e-9
"""Smallest length on a logarithmic axis, [m]."""

MAX_ROWS = 40
"""Largest number of readings or setups that are shown."""

MAX_POINTS = 500
"""Largest number of points in a quantile plot, which always include the outermost ones."""


@plot("residuals")
def plot_residuals(calibration: Calibration) -> Figure:
    """Deviations of the readings before and after calibration, the largest residual first."""
    residuals = calibration.residuals
    rows = largest_first(residuals)[:MAX_ROWS]
    title = "Readings before and after calibration, the largest residual first"
    if len(rows) < len(residuals):
        largest = f"the {len(rows)} largest residuals of {len(residuals)}"
        title = f"Readings before and after calibration: {largest}"
    repeated = any(r.cycle != 1 for r in residuals)
    names = [f"{r.label}, cycle {r.cycle}" if repeated else r.label for r in rows]
    figure, axes = open_list(title, names)
    y = np.arange(len(rows))
    before, after = (np.array([f(r) for r in rows]) / MM for f in (_deviation, _residual))
    sigma = np.array([calibration.row_sigma(r) for r in rows]) / MM
    if np.isfinite(sigma).all():
        kind = "row" if np.ptp(sigma) > 0.0 else _row_noun(calibration)
        shade(axes, y, -2.0 * sigma, 2.0 * sigma, f"±2 σ of a {kind}")
    axes.hlines(y, before, after, color="#888888", linewidth=0.8)
    axes.axvline(0.0, color="black", linewidth=0.8)
    axes.plot(before, y, label="before", **BEFORE_LOOK)
    axes.plot(after, y, label="after", **AFTER_LOOK)
    axes.set_xlabel("measured − model [mm]")
    draw_legend(figure, axes)
    return figure


@plot("setups")
def plot_setups(calibration: Calibration) -> Figure:
    """RMS of every setup before, after, and predicted from all other setups."""
    groups = rows_by_setup(calibration.residuals)
    names = sorted(groups, key=lambda n: -root_mean_square(map(_residual, groups[n])))[:MAX_ROWS]
    title = "Residuals per setup, the worst first"
    if len(names) < len(groups):
        title = f"Residuals per setup: the {len(names)} worst of {len(groups)}"
    figure, axes = open_list(title, names, height=2.0 * ROW_HEIGHT)
    y = np.arange(len(names))
    shown = []
    for get, shift, label, look in (
        (_deviation, -0.2, "before", BEFORE_LOOK),
        (_residual, 0.0, "after", AFTER_LOOK),
        (_prediction_error, 0.2, "predicted from all other setups", PREDICTED_LOOK),
    ):
        sizes = np.array([root_mean_square(map(get, groups[n])) for n in names])
        finite = np.isfinite(sizes)
        if finite.any():
            sizes = np.maximum(sizes[finite], SMALLEST_LENGTH) / MM
            axes.plot(sizes, y[finite] + shift, label=label, **look)
            shown.append(sizes)
    one_gauge = len(calibration.gauges) == 1
    if one_gauge and math.isfinite(calibration.sigma) and calibration.sigma > SMALLEST_LENGTH:
        sigma = calibration.sigma / MM
        axes.axvline(sigma, color="black", linestyle=":", label=f"σ of a {_row_noun(calibration)}")
        shown.append(np.array([sigma]))
    scale_log(axes, "x", np.concatenate(shown))
    axes.set_xlabel("RMS of measured − model [mm], logarithmic")
    draw_legend(figure, axes)
    return figure


@plot("spread")
def plot_spread(calibration: Calibration) -> Figure:
    """Normal quantile plot of the residuals, with the noise as a line.

    Residuals of several gauges are divided by the noise of their gauges.
    """
    values, unit, lines = _spread(calibration)
    quantiles = special.ndtri((np.arange(values.size) + 0.5) / values.size)
    chosen = _thin(values.size)
    figure = open_figure(3.8, "Normal quantile plot of the residuals")
    axes = figure.subplots()
    label = f"residuals after: {count_of(chosen.size, values.size)}"
    look = {**AFTER_LOOK, "markersize": 3.5}
    axes.plot(quantiles[chosen], values[chosen], label=label, **look)
    # parameters and gauge zeros reduce the residuals by their degrees of freedom
    reduction = math.sqrt(min(calibration.noise.residual_dof / values.size, 1.0))
    ends = np.array([-1.0, 1.0]) * max(abs(float(quantiles[0])), 1.0)
    for sigma, label, line in lines:
        if math.isfinite(sigma):
            axes.plot(ends, ends * reduction * sigma, color="black", linestyle=line, label=label)
    axes.grid(True)
    axes.set_xlabel(
        "normal quantile, expected from noise alone [σ]\n"
        "lines: σ reduced by the degrees of freedom of parameters and gauge zeros"
    )
    axes.set_ylabel(f"residual after [{unit}]")
    draw_legend(figure, axes)
    return figure


def _spread(calibration: Calibration) -> tuple[Array, str, list[tuple[float, str, str]]]:
    """Sorted residuals in a unit, and the noise in it with label and look of its line."""
    rows = calibration.residuals
    residuals = np.array([_residual(r) for r in rows])
    if len(calibration.gauges) > 1:
        sigmas = np.array([calibration.row_sigma(r) for r in rows])
        return np.sort(residuals / sigmas), "σ of its gauge", [(1.0, "σ of each gauge", "-")]
    factors = np.array([calibration.noise_factor(r) for r in rows])
    gauge, sigma = calibration.gauges[0].sigma, calibration.sigma / MM
    stated = math.nan if gauge is None else gauge * calibration.row_factor / MM
    lines = [
        (sigma, f"σ of a {_row_noun(calibration)}: {sigma:.2g} mm", "-"),
        (stated, f"σ stated for the gauge: {stated:.2g} mm", "--"),
    ]
    return np.sort(residuals / factors) * calibration.row_factor / MM, "mm", lines


def _row_noun(calibration: Calibration) -> str:
    """Noun for a row: difference or reading."""
    return "difference" if calibration.rows_are_differences else "reading"


def _thin(count: int) -> NDArray[np.int64]:
    """Indices of the drawn points among sorted ones; of many, the outermost and a selection."""
    if count <= MAX_POINTS:
        return np.arange(count)
    edge = MAX_POINTS // 4
    between = np.linspace(edge, count - 1 - edge, MAX_POINTS - 2 * edge).round()
    return np.concatenate([np.arange(edge), between, np.arange(count - edge, count)]).astype(
        np.int64
    )


@plot("circle")
def plot_circle(circle: Circle) -> Figure:
    """Polar plot of a circle's magnified deviations from the least-squares circle."""
    figure = open_figure(3.6, f"Circle of setup {circle.setup}, plane {circle.plane}")
    axes = cast(PolarAxes, figure.subplots(subplot_kw={"projection": "polar"}))
    closed = np.append(circle.angles, circle.angles[0] + 2.0 * np.pi)
    looks = (
        ("as measured", circle.before, circle.g_before, BEFORE, "o-"),
        ("all identified errors corrected", circle.after, circle.g_after, AFTER, "s-"),
    )
    few = len(circle.angles) <= 72
    for label, values, g, colour, mark in looks:
        radii = np.append(values, values[0]) / UM
        text = f"{label}: G = {um(g)} µm"
        axes.plot(
            closed, radii, mark if few else "-", color=colour, label=text, markersize=3.0, lw=1.0
        )
    largest = max(float(np.abs([circle.before, circle.after]).max()) / UM, 1e-3)
    step = round_up(largest)
    axes.set_ylim(-2.0 * step, step)
    axes.set_yticks([-step, 0.0, step], [f"−{step:g} µm", "0", f"+{step:g} µm"])
    axes.set_rlabel_position(67.5)
    axes.plot(np.linspace(0.0, 2.0 * np.pi, 181), np.zeros(181), color="black", lw=0.8)
    names = [f"{sign}{axis}" for sign in "+−" for axis in circle.plane]
    axes.set_xticks(np.pi / 2.0 * np.arange(4), names)
    draw_legend(figure, axes)
    return figure
