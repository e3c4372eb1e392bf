"""Plots of the parameters: estimates, correlations, singular values, linearisation error."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from orthocal.arrays import Array
from orthocal.calibration.calibration import Calibration
from orthocal.calibration.records import ParameterEstimate
from orthocal.output.report.figure import (
    AFTER,
    AFTER_LOOK,
    BOUND_LOOK,
    CHARACTER,
    MAX_NAME_IN_MATRIX,
    Look,
    draw_legend,
    open_figure,
    open_list,
    plot,
    scale_log,
    shade,
)
from orthocal.output.text.layout import short_names, typeset
from orthocal.robot.parameters import is_offset
from orthocal.units import MM, show_limit

MAX_IN_DETAIL = 12
"""Most parameters for which units and correlations are printed as numbers."""

NEGLIGIBLE = 0.1
"""Largest negligible error of the linearised solution, [σ]."""

MAX_ESTIMATES = 30
"""Largest number of parameters whose estimates are shown."""

MAX_CORRELATED = 40
"""Largest number of parameters in the correlation matrix."""

MAX_SHIFTS = 20
"""Largest number of parameters whose linearised solution is shown."""

SIGN_LIMIT, DARK_LIMIT = 0.1, 0.6
"""Correlations above which the sign is marked, and correlations with dark colours."""

COLOUR_LIMITS = (-1.0, -0.9, -0.7, -0.5, -0.3, -SIGN_LIMIT, SIGN_LIMIT, 0.3, 0.5, 0.7, 0.9, 1.0)
"""Limits between the colours of correlations."""

_MIDDLE: Look = {"horizontalalignment": "center", "verticalalignment": "center"}


@plot("linearised")
def plot_linearised(calibration: Calibration) -> Figure | None:
    """Exact minus linearised estimates, in standard deviations, the largest first."""
    shifts = _linearisation_shifts(calibration)
    if not shifts:
        return None
    errors = [
        f" ({typeset((p.value - p.linear) * p.edge_factor, 4)} {p.edge_unit})" for _, p in shifts
    ]
    title = "Error of the linearised solution, the largest first"
    figure, axes = open_list(title, [p.name for _, p in shifts], remarks=errors)
    y, sizes = np.arange(len(shifts)), np.array([s for s, _ in shifts])
    axes.hlines(y, 0.0, sizes, color="#888888", linewidth=0.8)
    axes.plot(sizes, y, label="exact − linearised", **AFTER_LOOK)
    axes.axvline(0.0, color="black", linewidth=0.8)
    for sign, label in ((-1.0, f"±{NEGLIGIBLE:g} σ: negligible"), (1.0, "")):
        axes.axvline(sign * NEGLIGIBLE, color="black", linestyle=":", label=label)
    axes.set_xlabel("exact − linearised estimate, in σ of the parameter")
    draw_legend(figure, axes)
    return figure


@plot("parameters")
def plot_parameters(calibration: Calibration) -> Figure:
    """Estimates with 95 % intervals, and the share of the prior variance that the readings remove.

    Of many parameters the offsets are shown first, then the best determined ones.
    """
    free = calibration.free
    rows = sorted(free, key=_importance)[:MAX_ESTIMATES]
    title = "Estimates with 95 % intervals"
    if len(rows) < len(free):
        title += f": {len(rows)} of {len(free)}, offsets, then the best determined"
    bounds = [f" at {p.at_bound} bound" if p.at_bound else "" for p in rows]
    in_unit = len(rows) <= MAX_IN_DETAIL and len({p.unit for p in rows}) == 1
    figure, axes = open_list(title, [p.name for p in rows], remarks=bounds, share=calibration.prior)
    scale = np.array([p.edge_factor if in_unit else 1.0 / show_limit(p.prior_std) for p in rows])
    y, values = np.arange(len(rows)), np.array([p.value for p in rows]) * scale
    prior = np.array([i for i, p in enumerate(rows) if p.prior], dtype=int)
    if prior.size and not in_unit:
        means = np.array([rows[i].mean for i in prior]) * scale[prior]
        shade(axes, prior, means - 1.0, means + 1.0, "tolerance (±2 prior standard deviations)")
    axes.axvline(0.0, color="black", linewidth=0.8)
    bound = np.array([p.at_bound is not None for p in rows])
    intervals = {p.name: i for p, i in zip(free, calibration.intervals, strict=True)}
    ends = np.array([intervals[p.name] for p in rows]) * scale[:, None]
    finite = np.isfinite(ends).all(axis=1) & ~bound
    if finite.any():
        look: Look = {"color": AFTER, "linewidth": 1.6, "label": "95 % interval"}
        axes.hlines(y[finite], *ends[finite].T, **look)
    if not bound.all():
        axes.plot(values[~bound], y[~bound], label="estimate", **AFTER_LOOK)
    if bound.any():
        axes.plot(values[bound], y[bound], label="at its bound", **BOUND_LOOK)
    if not finite.any() and not bound.all():
        axes.plot([], [], linestyle="none", label="no intervals: the noise is unknown")
    axes.set_xlabel(f"estimate [{rows[0].edge_unit}]" if in_unit else "estimate [tolerance]")
    draw_legend(figure, axes)
    if calibration.prior:
        _draw_shares(figure.axes[1], rows)
    return figure


def _draw_shares(axes: Axes, rows: Sequence[ParameterEstimate]) -> None:
    """Draw the share of the prior variance that the readings remove."""
    shares = np.nan_to_num([p.data_share for p in rows]).clip(0.0, 1.0)
    axes.barh(np.arange(len(rows)), 100.0 * shares, 0.6, color=AFTER)
    axes.set_xlim(0.0, 100.0)
    axes.set_xticks([0, 50, 100])
    axes.grid(True, axis="x")
    axes.tick_params(axis="y", length=0, labelleft=False)
    axes.set_xlabel("resolved [%]")


@plot("correlations")
def plot_correlations(calibration: Calibration) -> Figure | None:
    """Correlation matrix of the estimates; None for fewer than two parameters.

    Of many parameters, the ones with the strongest correlations are shown.
    """
    matrix = calibration.correlation
    finite = np.flatnonzero(np.isfinite(np.diag(matrix)))
    if finite.size < 2:
        return None
    size = np.abs(matrix[np.ix_(finite, finite)] - np.eye(finite.size))
    chosen = np.sort(finite[np.argsort(-size.max(axis=1), kind="stable")[:MAX_CORRELATED]])
    names = short_names([calibration.free[i].name for i in chosen], MAX_NAME_IN_MATRIX)
    title = "Correlations of the estimates"
    if chosen.size < finite.size:
        title += f": the {chosen.size} of {finite.size} parameters with the strongest"
    few, count = chosen.size <= MAX_IN_DETAIL, chosen.size - 1
    side = (0.3 if few else 0.145) * max(count, 2)
    flat = count <= 2
    below = 0.3 if flat else CHARACTER * max(len(n) for n in names)
    figure = open_figure(0.2 + side + below, title, legend=False)
    axes = figure.subplots()
    rows, columns = np.tril_indices(count)
    r = matrix[chosen[rows + 1], chosen[columns]]
    corners = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    cells = corners + np.stack([columns, rows], axis=1)[:, None, :]
    norm = BoundaryNorm(COLOUR_LIMITS, 256)
    image = PolyCollection(list(cells), cmap="PuOr", norm=norm, edgecolors="white")
    image.set_array(r)
    axes.add_collection(image)
    axes.set(xlim=(0.0, count), ylim=(count, 0.0))
    axes.set_xticks(np.arange(count) + 0.5, names[:-1], rotation=0 if flat else 90)
    axes.set_yticks(np.arange(count) + 0.5, names[1:])
    axes.tick_params(length=0, labelsize=8.5 if few else 7.5)
    axes.spines[:].set_visible(False)
    _mark_signs(axes, columns, rows, r, numbers=few)
    if not few:
        label = "correlation (−: negative)"
        look: Look = {"aspect": side / 0.12, "spacing": "proportional"}
        figure.colorbar(image, ax=axes, label=label, ticks=COLOUR_LIMITS[1:-1], **look)
    return figure


def _mark_signs(
    axes: Axes, columns: NDArray[np.int64], rows: NDArray[np.int64], r: Array, *, numbers: bool
) -> None:
    """Print the values of a matrix in its cells, or a minus sign in negative cells."""
    x, y, inks = columns + 0.5, rows + 0.5, np.where(np.abs(r) > DARK_LIMIT, "white", "black")
    if numbers:
        for i, value in enumerate(r):
            text = typeset(float(value), 2)
            axes.text(x[i], y[i], text, color=str(inks[i]), fontsize=7.5, **_MIDDLE)
        return
    for ink in ("black", "white"):
        marked = (r < -SIGN_LIMIT) & (inks == ink)
        axes.plot(x[marked], y[marked], "_", color=ink, markersize=4.0)


@plot("singular-values")
def plot_singular_values(calibration: Calibration) -> Figure | None:
    """Singular values of the readings and their noise; None if all are zero."""
    spectrum = calibration.identifiability
    if not spectrum.structural_rank:
        return None
    count = spectrum.singular_values.size
    values = spectrum.singular_values[: spectrum.structural_rank] / MM
    title = (
        f"Singular values: {spectrum.rank} of {count} parameter combinations are above the noise"
    )
    figure = open_figure(2.9, title)
    axes = figure.subplots()
    index = np.arange(1, values.size + 1)
    above = values > spectrum.threshold / MM
    kinds = ((above, AFTER, "above the noise"), (~above, "white", "below the noise"))
    for chosen, face, label in kinds:
        if chosen.any():
            look = {**AFTER_LOOK, "markerfacecolor": face}
            axes.plot(index[chosen], values[chosen], label=label, **look)
    noise = calibration.noise.sigma
    kind = "σ of a reading" if noise >= spectrum.threshold else "rounding: the noise is unknown"
    label = f"{kind}: {spectrum.threshold / MM:.2g} mm"
    axes.axhline(spectrum.threshold / MM, color="black", linestyle="--", label=label)
    scale_log(axes, "y", np.r_[values, spectrum.threshold / MM])
    axes.grid(True, axis="y")
    axes.set_xlim(0.5, values.size + 0.5)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    zeros = f" ({count - values.size} more are zero)" if values.size < count else ""
    axes.set_xlabel(f"parameter combination, the best determined first{zeros}")
    axes.set_ylabel("change of all readings\n[mm per prior standard deviation]")
    draw_legend(figure, axes)
    return figure


def _linearisation_shifts(calibration: Calibration) -> list[tuple[float, ParameterEstimate]]:
    """Exact minus linearised estimates in σ with their parameters, the largest first."""
    if not calibration.solver.shows_linearisation_error:
        return []
    finite = [p for p in calibration.free if math.isfinite(p.std) and p.std > 0.0]
    shifts = [((p.value - p.linear) / p.std, p) for p in finite]
    return sorted(shifts, key=lambda s: -abs(s[0]))[:MAX_SHIFTS]


def _importance(parameter: ParameterEstimate) -> tuple[bool, float]:
    """Sort key: offsets first, then the best determined parameters."""
    share = parameter.data_share
    return not is_offset(parameter.name), math.inf if math.isnan(share) else -share
