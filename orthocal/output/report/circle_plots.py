"""Radial plots of ball-bar circles."""

from __future__ import annotations

from typing import cast

import numpy as np
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes

from orthocal.assessment.circular_deviation import Circle
from orthocal.output.report.figure import AFTER, BEFORE, draw_legend, open_figure, plot
from orthocal.units import UM


@plot("circle")
def plot_circle(circle: Circle) -> Figure:
    """Radial plot of a circle: deviations from the least-squares circle, magnified."""
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
        text = f"{label}: G = {g / UM:.3g} µm"
        axes.plot(
            closed, radii, mark if few else "-", color=colour, label=text, markersize=3.0, lw=1.0
        )
    reach = max(float(np.abs([circle.before, circle.after]).max()) / UM, 1e-3)
    step = _round_up(reach)
    axes.set_ylim(-2.0 * step, step)
    axes.set_yticks([-step, 0.0, step], [f"−{step:g} µm", "0", f"+{step:g} µm"])
    axes.set_rlabel_position(67.5)
    axes.plot(np.linspace(0.0, 2.0 * np.pi, 181), np.zeros(181), color="black", lw=0.8)
    names = [f"{sign}{axis}" for sign in "+−" for axis in circle.plane]
    axes.set_xticks(np.pi / 2.0 * np.arange(4), names)
    draw_legend(figure, axes)
    return figure


def _round_up(value: float) -> float:
    """Next larger number of 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(
        next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= value * (1.0 - 1e-9))
    )
