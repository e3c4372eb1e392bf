"""Plots of studies, and of the expected tool error over measuring time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter

from orthocal.output.report.figure import (
    AFTER,
    AFTER_LOOK,
    BAND,
    BEFORE,
    BEFORE_LOOK,
    CHARACTER,
    MAX_NAME_IN_MATRIX,
    PREDICTED,
    PREDICTED_LOOK,
    Look,
    Plot,
    count_of,
    draw_legend,
    open_figure,
    open_list,
    plot,
    round_up,
    scale_log,
)
from orthocal.output.text.layout import short_names, true_minus
from orthocal.planning.cost_curve import HOUR, HOURLY_GAIN
from orthocal.planning.plan import MeasuringPlan
from orthocal.study.bootstrap import BootstrapSummary
from orthocal.study.linearisation import LinearisationSummary
from orthocal.study.runner import StudyTable
from orthocal.study.sensitivity import SensitivitySummary
from orthocal.text import percent
from orthocal.units import UM

GREY = "#777777"

SMALLEST_DRAWN_MM = 1e-4
"""Smallest error of the estimates on a logarithmic axis, [mm]."""

SMALLEST_DRAWN_UM = 1e-3
"""Smallest tool error on a logarithmic axis, [µm]; that of an exact machine is zero."""

MAX_ERRORS = 40
"""Largest number of errors in a plot."""

_OPEN: Look = {"markerfacecolor": "none", "markeredgewidth": 1.4}
USUAL_LOOKS: tuple[Look, ...] = (
    {**BEFORE_LOOK, **_OPEN, "markersize": 12.0},
    {**PREDICTED_LOOK, **_OPEN, "markersize": 9.0},
)
"""Looks of the usual plans beside a plan, which remain visible around it and each other."""

NORMAL_95 = 1.96
"""Half width of the 95 % interval of a normal distribution, [σ]."""


@plot("study")
def plot_machines(table: StudyTable, predicted: float) -> Figure:
    """Share of machines below a tool error, before and after calibration.

    Args:
        table: Result of an accuracy study.
        predicted: Predicted tool error, [µm]; NaN if it is unknown.
    """
    figure = open_figure(3.2, "Share of machines below a tool error")
    axes = figure.subplots()
    drawn = [predicted] if math.isfinite(predicted) else []
    for name, colour, label in (
        ("before_um", BEFORE, "before calibration"),
        ("tool_um", AFTER, "after calibration"),
    ):
        values = np.array(table.columns.get(name, []), dtype=np.float64)
        values = np.sort(values[np.isfinite(values)]).clip(min=SMALLEST_DRAWN_UM)
        if values.size:
            share = 100.0 * (np.arange(values.size) + 1) / values.size
            axes.plot(values, share, color=colour, label=label)
            drawn += [values[0], values[-1]]
    if math.isfinite(predicted):
        axes.axvline(predicted, color="black", linestyle=":", label="predicted RMS")
    scale_log(axes, "x", np.array(drawn or [1.0]))
    axes.set_ylim(bottom=0.0)
    _finish(figure, axes, "tool error, workpiece aligned [µm]", "machines [%]")
    return figure


@plot("study")
def plot_linearisation(s: LinearisationSummary, names: Mapping[str, str]) -> Figure:
    """Error of linearised identification as a function of the machine's errors.

    Args:
        s: Summary of a linearisation study.
        names: Names of the methods on the plot.
    """
    looks: dict[str, Look] = {
        "six": {"color": BEFORE, "linewidth": 3.0},
        "first_order": {"color": AFTER},
        "steps_2": {"color": AFTER, "linestyle": "--"},
        "steps_3": {"color": AFTER, "linestyle": ":"},
    }
    figure = open_figure(3.6, "Error of linearised identification")
    axes = figure.subplots()
    for m in s.methods:
        if m.name in looks:
            axes.plot(s.sizes, m.errors, label=names[m.name], **looks[m.name])
    (noise,) = (m.standard_error for m in s.methods if m.name == "first_order")
    for label, size, colour in (
        ("standard error", noise, PREDICTED),
        ("resolution", s.resolution, GREY),
    ):
        if size > 0.0 or label != "resolution":
            axes.axhline(size, color=colour, linewidth=1.0)
            axes.annotate(label, (s.sizes.min(), size), va="bottom")
    largest = max(m.errors[np.isfinite(m.errors)].max(initial=0.0) for m in s.methods)
    scale_log(axes, "x", s.sizes)
    limits = (SMALLEST_DRAWN_MM, max(largest, 10.0 * SMALLEST_DRAWN_MM))
    scale_log(axes, "y", np.array(limits))
    _finish(figure, axes, "largest error of the machine [mm]", "error of the estimates [mm]")
    return figure


@plot("study")
def plot_bootstrap(s: BootstrapSummary) -> Figure:
    """Intervals with 95 % of the draws around the estimates, in predicted standard deviations."""
    shown = s.parameters[:MAX_ERRORS]
    unit = np.array([p.predicted or math.nan for p in shown])
    low, high = (
        np.array([getattr(p, end) - p.estimate for p in shown]) / unit for end in ("low", "high")
    )
    title = "Intervals with 95 % of the draws"
    if len(shown) < len(s.parameters):
        title += f": the first {len(shown)} of {len(s.parameters)} parameters"
    figure, axes = open_list(title, [p.parameter.name for p in shown])
    y = np.arange(len(shown))
    axes.axvspan(-NORMAL_95, NORMAL_95, color=BAND, label="predicted interval")
    axes.hlines(y, low, high, color=AFTER, label="95 % of the draws")
    axes.plot(0.0 * y, y, label="estimate", **AFTER_LOOK)
    axes.set_xlabel("draw − estimate [predicted standard deviation]")
    draw_legend(figure, axes)
    return figure


@plot("study")
def plot_sensitivity(s: SensitivitySummary) -> Figure:
    """Heat map of the change of each reading and tool coordinate by each error.

    Colours are logarithmic beyond a linear range around zero.
    """
    by_influence = np.argsort(-np.abs(s.per_prior_std).max(axis=0), kind="stable")
    chosen = np.sort(by_influence[:MAX_ERRORS])
    number = count_of(len(chosen), len(s.parameters))
    values = s.per_prior_std[:, chosen] / UM
    largest = max(float(np.abs(values).max()), 1e-9)
    decades = 10.0 ** np.arange(math.floor(math.log10(largest)) - 1, math.ceil(math.log10(largest)))
    limit, linear = round_up(largest), float(decades[0])
    title = f"Change by one prior standard deviation of each error, {number} errors"
    columns = short_names([s.parameters[i] for i in chosen], MAX_NAME_IN_MATRIX)
    below = CHARACTER * max(map(len, columns))
    figure = open_figure(0.2 + 0.16 * len(s.rows) + below, title, legend=False)
    axes = figure.subplots()
    norm = SymLogNorm(linthresh=linear, vmin=-limit, vmax=limit)
    look: dict[str, Any] = {"aspect": "auto", "cmap": "RdBu_r", "interpolation": "nearest"}
    image = axes.imshow(values, norm=norm, **look)
    rows = short_names([f"{posture}  {output}" for posture, output in s.rows])
    axes.set_yticks(range(len(rows)), rows, fontsize=6.5)
    axes.set_xticks(range(len(columns)), columns, fontsize=6.5, rotation=90)
    sizes = np.append(decades[decades < 0.4 * limit], limit)  # labels do not overlap
    ticks = FixedLocator([*-sizes, 0.0, *sizes])
    text = FuncFormatter(lambda v, _: true_minus(f"{v:+g}") if v else "0")
    label = f"change [µm], logarithmic beyond ±{linear:g}"
    bar = figure.colorbar(image, ax=axes, fraction=0.04, ticks=ticks, format=text, label=label)
    bar.minorticks_off()
    return figure


PLOTS: dict[str, Plot[...]] = {
    "accuracy": plot_machines,
    "linearisation": plot_linearisation,
    "sensitivity": plot_sensitivity,
    "bootstrap": plot_bootstrap,
}
"""Plots by kind of study."""


@plot("plan")
def plot_plan(plan: MeasuringPlan, unit: float, when: str) -> Figure:
    """Expected tool error over measuring time.

    Args:
        plan: The plan.
        unit: Unit of its criterion, [m] for a tool error, otherwise 1.
        when: Measurement after which the tool error is expected.
    """
    quantity = "Expected error" if unit == UM else "Criterion"
    figure = open_figure(3.2, f"{quantity} over measuring time")
    axes = figure.subplots()
    stages = [s for s in plan.curve if s.setups]
    hours, errors = [s.minutes / HOUR for s in stages], [s.error / unit for s in stages]
    axes.plot(hours, errors, ".-", color=AFTER, label="setups added one by one")
    errors.append(plan.stage.error / unit)
    axes.plot(plan.minutes / HOUR, errors[-1], label="this plan", **AFTER_LOOK)
    if plan.criterion == "aligned":
        for look, other in zip(USUAL_LOOKS, plan.usual_plans, strict=False):
            if other.expected is not None:
                errors.append(other.expected.reported.rms / unit)
                axes.plot(other.minutes / HOUR, errors[-1], label=other.name, **look)
    if plan.enough is not None:
        label = f"another hour gains < {percent(HOURLY_GAIN)}"
        axes.axvline(plan.enough.minutes / HOUR, color="#999999", linestyle=":", label=label)
    scale_log(axes, "y", np.array(errors))
    axes.set_xlim(left=0.0)
    error = f"expected tool error [µm]{when}" if unit == UM else "criterion"
    _finish(figure, axes, "time [h]", error)
    return figure


def _finish(figure: Figure, axes: Axes, x_label: str, y_label: str) -> None:
    """Add grid, labels and legend."""
    axes.grid(True)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    draw_legend(figure, axes)
