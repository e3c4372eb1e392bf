"""A calibration as plots: each returns one inline `<svg>` for an HTML page.

Text stays text and is never parsed: names come from files. Every plot can be read in black and
white, by its markers, and its ids are its own, so that several stand on one page.
"""

from __future__ import annotations

import hashlib
import io
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from operator import attrgetter
from typing import Any, Literal

import matplotlib
import numpy as np
from lxml import etree
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator
from numpy.typing import NDArray
from scipy import special

from orthocal.identification.calibration import Calibration
from orthocal.identification.records import ParameterEstimate, ResidualRow

Array = NDArray[np.float64]

_deviation, _residual, _unseen = map(attrgetter, ("deviation", "residual", "unseen"))

WIDTH = 7.2
"""Of a figure, [inch], at 100 pixels an inch on the page."""

ROW_HEIGHT = 0.17
"""Of a line of a plot that lists things, [inch]."""

HEAD = 0.48
"""Height of title and legend, [inch]."""

BEFORE, AFTER, UNSEEN, BAND = "#E69F00", "#0072B2", "#009E73", "#DDDDDD"

LONGEST_NAME = 44
"""Characters of a name that are shown."""

SMALLEST_LENGTH = 1e-9
"""What a logarithmic axis shows for smaller lengths, [m]."""

FEW_PARAMETERS = 12
"""Parameters up to which they are shown in their own unit, and their correlations as numbers."""

CHEAP = 0.1
"""Cost of linearising below which it does not matter, [σ]."""

MOST_SHIFTS = 20
"""Parameters whose cost of linearising is shown."""

MOST_POINTS = 500
"""Points of a quantile plot: of more, the outermost and a selection of the others are shown."""

CLEAR, DARK = 0.1, 0.6
"""Correlations above which the sign is marked, and whose colour is a dark one."""

STEPS = (-1.0, -0.9, -0.7, -0.5, -0.3, -CLEAR, CLEAR, 0.3, 0.5, 0.7, 0.9, 1.0)
"""Correlations between which the colour is the same."""

LONGEST_IN_MATRIX = 24

_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Verdana", "Arial", "sans-serif"],
    "font.size": 8.5,
    "axes.titlelocation": "left",
    "axes.titlesize": 8.5,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#E4E4E4",
    "legend.borderaxespad": 0.0,
    "legend.borderpad": 0.0,
    "legend.columnspacing": 1.4,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "legend.handletextpad": 0.4,
    "legend.loc": "upper left",
    "lines.markersize": 5.0,
    "svg.fonttype": "none",
    "svg.hashsalt": "orthocal",
    "text.parse_math": False,
}

_SVG = "{http://www.w3.org/2000/svg}"
_HREF = "{http://www.w3.org/1999/xlink}href"

Look = dict[str, Any]
"""How markers are drawn, as keyword arguments of `plot`."""

_BEFORE: Look = {
    "marker": "o",
    "color": BEFORE,
    "markerfacecolor": "white",
    "markeredgewidth": 1.4,
    "linestyle": "none",
}
_AFTER: Look = {"marker": "s", "color": AFTER, "markersize": 4.5, "linestyle": "none"}
_UNSEEN: Look = {"marker": "^", "color": UNSEEN, "markersize": 6.0, "linestyle": "none"}
_BOUND: Look = {"marker": "X", "color": "black", "markersize": 7.0, "linestyle": "none"}

_MIDDLE: Look = {"horizontalalignment": "center", "verticalalignment": "center"}


def plot_residuals(calibration: Calibration, *, most: int = 40) -> str:
    """Every reading before and after, the largest deviation first.

    Args:
        calibration: The calibration.
        most: Readings that are shown.
    """
    count = len(calibration.residuals)
    label = f"Residuals of {_of(min(most, count), count)} readings before and after calibration."
    return render_figure("residuals", label, lambda: _draw_residuals(calibration, most))


def plot_setups(calibration: Calibration, *, most: int = 40) -> str:
    """Root mean square of every setup before, after and as all others predict it.

    Args:
        calibration: The calibration.
        most: Setups that are shown, those with the largest remainder first.
    """
    label = "Root mean square of the residuals of each setup before and after calibration."
    return render_figure("setups", label, lambda: _draw_setups(calibration, most))


def plot_spread(calibration: Calibration) -> str:
    """Whether the residuals have the spread that the noise explains: a normal quantile plot."""
    label = "Residuals after calibration in order, against those that normal noise would leave."
    return render_figure("spread", label, lambda: _draw_spread(calibration))


def plot_linearised(calibration: Calibration) -> str:
    """What linearising costs: exact less linearised estimates in σ; "" where there is no σ."""
    shifts = _linearisation_shifts(calibration)
    if not shifts:
        return ""
    label = "Exact less linearised estimates in their standard deviations, the largest first."
    return render_figure("linearised", label, lambda: _draw_linearised(shifts))


def plot_parameters(calibration: Calibration, *, most: int = 30) -> str:
    """Estimates with their 95 % intervals, and how much the readings told of each.

    Args:
        calibration: The calibration.
        most: Parameters that are shown: offsets, then what the readings tell best.
    """
    count = len(calibration.free)
    label = f"Estimates of {_of(min(most, count), count)} parameters with 95 % intervals."
    return render_figure("parameters", label, lambda: _draw_parameters(calibration, most))


def plot_correlations(calibration: Calibration, *, most: int = 40) -> str:
    """Correlations of the estimates as a matrix; "" for less than two that have any.

    Args:
        calibration: The calibration.
        most: Parameters that are shown: those that take part in the strongest correlations.
    """
    matrix = calibration.correlation
    known = np.flatnonzero(np.isfinite(np.diag(matrix)))
    if known.size < 2:
        return ""
    label = f"Correlations between {_of(min(most, known.size), known.size)} estimated parameters."
    return render_figure("correlations", label, lambda: _draw_correlations(calibration, most))


def plot_singular_values(calibration: Calibration) -> str:
    """What the readings tell beside their noise; "" where they tell nothing at all."""
    found = calibration.identifiability
    if not found.structural_rank:
        return ""
    label = (
        f"Singular values of the readings: {found.rank} of {found.singular_values.size} "
        "combinations of parameters are above the noise."
    )
    return render_figure("singular-values", label, lambda: _draw_singular_values(calibration))


@contextmanager
def house_style() -> Iterator[None]:
    """Matplotlib's own defaults and ours, whatever its user has configured."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        yield


def render_figure(name: str, label: str, draw: Callable[[], Figure]) -> str:
    """A figure as an inline `<svg>` that scales with its page.

    Args:
        name: Of the plot, with which its ids begin.
        label: What it shows, for those who do not see it.
        draw: Draws the figure.
    """
    stream = io.BytesIO()
    with house_style(), warnings.catch_warnings():
        # the reader's fonts draw the text, not those here
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        figure = draw()
        nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(stream, format="svg", metadata=nothing)
    parser = etree.XMLParser(resolve_entities=False, huge_tree=True)
    root = etree.fromstring(stream.getvalue(), parser)
    _name_ids(root, f"{name}-{hashlib.sha256(stream.getvalue()).hexdigest()[:8]}-")
    for styles in root.findall(f".//{_SVG}style"):  # would hold for the whole page
        styles.getparent().remove(styles)
    for key in ("width", "height", "version"):
        root.attrib.pop(key, None)
    width = figure.get_figwidth() * 100.0
    root.set("style", f"width:{width:.0f}px;max-width:100%;height:auto;stroke-linejoin:round")
    root.set("role", "img")
    root.set("aria-label", label)
    title = etree.Element(f"{_SVG}title")
    title.text = label
    root.insert(0, title)
    return str(etree.tostring(root, encoding="unicode"))


def open_figure(height: float, title: str, *, legend: bool = True) -> Figure:
    """An empty figure of the page's width with its title.

    Args:
        height: Of the plot itself, [inch].
        title: What the plot is for.
        legend: Whether there is room for one below the title.
    """
    head = HEAD if legend else 0.7 * HEAD
    height += head
    below = (0.0, 0.0, 1.0, 1.0 - head / height)
    figure = Figure(figsize=(WIDTH, height), layout=ConstrainedLayoutEngine(rect=below))
    bold = {"fontsize": 10.0, "fontweight": "bold", "verticalalignment": "top"}
    figure.text(0.01, 1.0 - 0.06 / height, title, bold)
    return figure


def _name_ids(root: etree._Element, prefix: str) -> None:
    """Put a prefix before all ids and before what refers to them."""
    for element in root.iter():
        for key, value in element.attrib.items():
            if key == "id":
                element.set(key, prefix + value)
            elif key == _HREF and value.startswith("#"):
                element.set(key, f"#{prefix}{value[1:]}")
            elif "url(#" in value:
                element.set(key, value.replace("url(#", f"url(#{prefix}"))


def _draw_residuals(calibration: Calibration, most: int) -> Figure:
    found = calibration.residuals
    rows = sorted(found, key=lambda r: -abs(r.deviation))[:most]
    title = "Readings before and after calibration, the largest deviation first"
    if len(rows) < len(found):
        title = f"Readings before and after calibration: the {len(rows)} largest of {len(found)}"
    figure, axes = _open_list(title, _row_names(calibration, rows))
    y = np.arange(len(rows))
    before, after = (np.array([f(r) for r in rows]) * 1e3 for f in (_deviation, _residual))
    sigma = np.array([_row_sigma(calibration, r) for r in rows]) * 1e3
    if np.isfinite(sigma).all():
        kind = "row" if np.ptp(sigma) > 0.0 else _row_word(calibration)
        _shade(axes, y, -2.0 * sigma, 2.0 * sigma, f"±2 σ of a {kind}")
    axes.hlines(y, before, after, color="#888888", linewidth=0.8)
    axes.axvline(0.0, color="black", linewidth=0.8)
    axes.plot(before, y, label="before", **_BEFORE)
    axes.plot(after, y, label="after", **_AFTER)
    axes.set_xlabel("measured − model [mm]")
    _legend(figure, axes)
    return figure


def _draw_setups(calibration: Calibration, most: int) -> Figure:
    groups: dict[str, list[ResidualRow]] = {}
    for row in calibration.residuals:
        groups.setdefault(row.setup, []).append(row)
    names = sorted(groups, key=lambda n: -_rms(groups[n], _residual))[:most]
    title = "Which setup the model fits, the worst first"
    if len(names) < len(groups):
        title = f"Which setup the model fits: the {len(names)} worst of {len(groups)}"
    figure, axes = _open_list(title, [_name(n) for n in names], height=2.0 * ROW_HEIGHT)
    y = np.arange(len(names))
    shown = []
    for get, shift, label, look in (
        (_deviation, -0.2, "before", _BEFORE),
        (_residual, 0.0, "after", _AFTER),
        (_unseen, 0.2, "predicted from all other setups", _UNSEEN),
    ):
        sizes = np.array([_rms(groups[n], get) for n in names])
        known = np.isfinite(sizes)
        if known.any():
            sizes = np.maximum(sizes[known], SMALLEST_LENGTH) * 1e3
            axes.plot(sizes, y[known] + shift, label=label, **look)
            shown.append(sizes)
    if math.isfinite(calibration.sigma) and calibration.sigma > SMALLEST_LENGTH:
        sigma = calibration.sigma * 1e3
        axes.axvline(sigma, color="black", linestyle=":", label=f"σ of a {_row_word(calibration)}")
        shown.append(np.array([sigma]))
    _scale_log(axes, "x", np.concatenate(shown))
    axes.set_xlabel("r.m.s. of measured − model [mm], logarithmic")
    _legend(figure, axes)
    return figure


def _draw_spread(calibration: Calibration) -> Figure:
    found = calibration.residuals
    word = _row_word(calibration)
    single = np.array([_residual(r) / _noise_factor(r) for r in found])
    values = np.sort(single) * calibration.row_factor * 1e3
    quantiles = special.ndtri((np.arange(values.size) + 0.5) / values.size)
    chosen = _thin(values.size)
    figure = open_figure(3.8, "Do the residuals scatter as the noise explains?")
    axes = figure.subplots()
    label = f"residuals after: {_of(chosen.size, values.size)}"
    look = {**_AFTER, "markersize": 3.5}
    axes.plot(quantiles[chosen], values[chosen], label=label, **look)
    # what parameters and gauge zeros have taken up is missing in the residuals
    part = math.sqrt(min(calibration.noise.residual_dof / values.size, 1.0))
    gauge = calibration.session.gauge_sigma
    given = math.nan if gauge is None else gauge * calibration.row_factor
    reach = np.array([-1.0, 1.0]) * max(abs(float(quantiles[0])), 1.0)
    for sigma, name, line in (
        (calibration.sigma, f"σ of a {word}", "-"),
        (given, "σ given for the gauge", "--"),
    ):
        if math.isfinite(sigma):
            label = f"{name}: {sigma * 1e3:.2g} mm"
            axes.plot(reach, reach * part * sigma * 1e3, color="black", linestyle=line, label=label)
    axes.grid(True)
    axes.set_xlabel(
        "normal quantile: what pure noise would give at the same place in the order [σ]\n"
        "lines: what is left of σ when parameters and gauge zeros have taken up their part"
    )
    axes.set_ylabel("residual after [mm]")
    _legend(figure, axes)
    return figure


def _draw_linearised(shifts: list[tuple[float, ParameterEstimate]]) -> Figure:
    costs = [_signed((p.value - p.linear) * p.edge_factor, 4) for _, p in shifts]
    names = [
        f"{_name(p.name)} ({cost} {p.edge_unit})"
        for (_, p), cost in zip(shifts, costs, strict=True)
    ]
    figure, axes = _open_list("What linearising costs, the most first", names)
    y, sizes = np.arange(len(shifts)), np.array([s for s, _ in shifts])
    axes.hlines(y, 0.0, sizes, color="#888888", linewidth=0.8)
    axes.plot(sizes, y, label="exact − linearised", **_AFTER)
    axes.axvline(0.0, color="black", linewidth=0.8)
    for sign, label in ((-1.0, "a tenth of σ: less does not matter"), (1.0, "")):
        axes.axvline(sign * CHEAP, color="black", linestyle=":", label=label)
    axes.set_xlabel("exact − linearised estimate, in σ of the parameter")
    _legend(figure, axes)
    return figure


def _draw_parameters(calibration: Calibration, most: int) -> Figure:
    free = calibration.free
    rows = sorted(free, key=_importance)[:most]
    title = "Estimates with 95 % intervals"
    if len(rows) < len(free):
        title += f": {len(rows)} of {len(free)}, offsets, then the best told"
    names = [f"{_name(p.name)}{f' at {p.at_bound} bound' if p.at_bound else ''}" for p in rows]
    own_unit = len(rows) <= FEW_PARAMETERS and len({p.unit for p in rows}) == 1
    figure, axes = _open_list(title, names, share=calibration.prior)
    scale = np.array([p.edge_factor if own_unit else 1.0 / p.tolerance for p in rows])
    y, values = np.arange(len(rows)), np.array([p.value for p in rows]) * scale
    prior = np.array([i for i, p in enumerate(rows) if p.prior], dtype=int)
    if prior.size and not own_unit:
        means = np.array([rows[i].mean for i in prior]) * scale[prior]
        _shade(axes, prior, means - 1.0, means + 1.0, "±1 tolerance: known before")
    axes.axvline(0.0, color="black", linewidth=0.8)
    bound = np.array([p.at_bound is not None for p in rows])
    ends = np.array([calibration.interval(p) for p in rows]) * scale[:, None]
    known = np.isfinite(ends).all(axis=1) & ~bound
    if known.any():
        look: Look = {"color": AFTER, "linewidth": 1.6, "label": "95 % interval"}
        axes.hlines(y[known], *ends[known].T, **look)
    if not bound.all():
        axes.plot(values[~bound], y[~bound], label="estimate", **_AFTER)
    if bound.any():
        axes.plot(values[bound], y[bound], label="held by its bound", **_BOUND)
    if not known.any() and not bound.all():
        axes.plot([], [], linestyle="none", label="no intervals: nothing tells the noise")
    axes.set_xlabel(f"estimate [{rows[0].edge_unit}]" if own_unit else "estimate [tolerances]")
    _legend(figure, axes)
    if calibration.prior:
        _draw_shares(figure.axes[1], rows)
    return figure


def _draw_shares(axes: Axes, rows: Sequence[ParameterEstimate]) -> None:
    """How much of what was open the readings told, beside the parameters."""
    shares = np.nan_to_num([p.data_share for p in rows]).clip(0.0, 1.0)
    axes.barh(np.arange(len(rows)), 100.0 * shares, 0.6, color=AFTER)
    axes.set_xlim(0.0, 100.0)
    axes.set_xticks([0, 50, 100])
    axes.grid(True, axis="x")
    axes.tick_params(axis="y", length=0, labelleft=False)
    axes.set_xlabel("told [%]")


def _draw_correlations(calibration: Calibration, most: int) -> Figure:
    matrix = calibration.correlation
    known = np.flatnonzero(np.isfinite(np.diag(matrix)))
    size = np.abs(matrix[np.ix_(known, known)] - np.eye(known.size))
    chosen = np.sort(known[np.argsort(-size.max(axis=1), kind="stable")[:most]])
    names = [_name(calibration.free[i].name, LONGEST_IN_MATRIX) for i in chosen]
    title = "Correlations of the estimates"
    if chosen.size < known.size:
        title += f": the {chosen.size} of {known.size} parameters with the strongest"
    few, count = chosen.size <= FEW_PARAMETERS, chosen.size - 1
    side = (0.3 if few else 0.145) * max(count, 2)
    flat = count <= 2
    below = 0.3 if flat else 0.073 * max(len(n) for n in names)
    figure = open_figure(0.2 + side + below, title, legend=False)
    axes = figure.subplots()
    rows, columns = np.tril_indices(count)
    r = matrix[chosen[rows + 1], chosen[columns]]
    corners = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    cells = corners + np.stack([columns, rows], axis=1)[:, None, :]
    norm = BoundaryNorm(STEPS, 256)
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
        figure.colorbar(image, ax=axes, label=label, ticks=STEPS[1:-1], **look)
    return figure


def _mark_signs(
    axes: Axes, columns: NDArray[np.int64], rows: NDArray[np.int64], r: Array, *, numbers: bool
) -> None:
    """Numbers in the cells of a matrix, or a minus where they are negative."""
    x, y, inks = columns + 0.5, rows + 0.5, np.where(np.abs(r) > DARK, "white", "black")
    if numbers:
        for i, value in enumerate(r):
            text = _signed(float(value), 2)
            axes.text(x[i], y[i], text, color=str(inks[i]), fontsize=7.5, **_MIDDLE)
        return
    for ink in ("black", "white"):
        marked = (r < -CLEAR) & (inks == ink)
        axes.plot(x[marked], y[marked], "_", color=ink, markersize=4.0)


def _draw_singular_values(calibration: Calibration) -> Figure:
    found = calibration.identifiability
    count = found.singular_values.size
    values = found.singular_values[: found.structural_rank] * 1e3
    title = f"What the readings tell: {found.rank} of {count} combinations rise above the noise"
    figure = open_figure(2.9, title)
    axes = figure.subplots()
    index = np.arange(1, values.size + 1)
    above = values > found.threshold * 1e3
    for chosen, face, label in (
        (above, AFTER, "told better than its tolerance"),
        (~above, "white", "lost in the noise"),
    ):
        if chosen.any():
            look = {**_AFTER, "markerfacecolor": face}
            axes.plot(index[chosen], values[chosen], label=label, **look)
    noise = calibration.noise.reading_sigma
    kind = "σ of a reading" if noise >= found.threshold else "rounding: the noise is unknown"
    label = f"{kind}: {found.threshold * 1e3:.2g} mm"
    axes.axhline(found.threshold * 1e3, color="black", linestyle="--", label=label)
    _scale_log(axes, "y", np.r_[values, found.threshold * 1e3])
    axes.grid(True, axis="y")
    axes.set_xlim(0.5, values.size + 0.5)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    zeros = f" ({count - values.size} more are zero)" if values.size < count else ""
    axes.set_xlabel(f"combination of parameters, the best told first{zeros}")
    axes.set_ylabel("change of all readings [mm a tolerance]")
    _legend(figure, axes)
    return figure


def _open_list(
    title: str, names: Sequence[str], *, height: float = ROW_HEIGHT, share: bool = False
) -> tuple[Figure, Axes]:
    """A figure with a line for each name, from top to bottom; a narrow panel at its right."""
    figure = open_figure(0.6 + height * max(len(names), 2), title)
    if share:
        axes, _ = figure.subplots(1, 2, sharey=True, width_ratios=[4.0, 1.0])
    else:
        axes = figure.subplots()
    axes.use_sticky_edges = False  # markers stay whole where a band ends
    axes.set_yticks(np.arange(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.grid(True, axis="x")
    return figure, axes


def _shade(axes: Axes, y: NDArray[np.int64], low: Array, high: Array, label: str) -> None:
    """A band behind lines of a list."""
    look: Look = {"color": BAND, "edgecolor": BAND, "linewidth": 0.5}
    axes.barh(y, high - low, 1.0, low, zorder=0.5, label=label, **look)


def _legend(figure: Figure, axes: Axes) -> None:
    """What the markers mean, in a line below the title."""
    handles, labels = axes.get_legend_handles_labels()
    place = (0.01, 1.0 - 0.27 / figure.get_figheight())
    figure.legend(handles, labels, bbox_to_anchor=place, ncols=len(handles))


def _scale_log(axes: Axes, side: Literal["x", "y"], values: Array) -> None:
    """A logarithmic axis around positive values, ticks at 1, 2 and 5 or at decades."""
    low, high = (math.log10(float(v)) for v in (values.min(), values.max()))
    room = 0.02 + 0.03 * (high - low)
    decades = range(math.floor(low - room) - 1, math.ceil(high + room) + 2)
    steps = (1.0, 2.0, 5.0) if high - low < 2.0 else (1.0,)
    ticks = np.array([s * 10.0**d for d in decades for s in steps])
    first = int(np.flatnonzero(ticks <= 10.0 ** (low - room))[-1])
    last = int(np.flatnonzero(ticks >= 10.0 ** (high + room))[0])
    axes.set(**{f"{side}scale": "log", f"{side}lim": (ticks[first], ticks[last])})
    axis = axes.xaxis if side == "x" else axes.yaxis
    every = math.ceil((last + 1 - first) / 9)
    axis.set_major_locator(FixedLocator(ticks[first : last + 1 : every].tolist()))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))


def _linearisation_shifts(calibration: Calibration) -> list[tuple[float, ParameterEstimate]]:
    """Exact less linearised estimate in σ, the largest first."""
    if calibration.solver.loss == "huber":  # the linearised estimate is by squares
        return []
    known = [p for p in calibration.free if math.isfinite(p.std) and p.std > 0.0]
    shifts = [((p.value - p.linear) / p.std, p) for p in known]
    return sorted(shifts, key=lambda s: -abs(s[0]))[:MOST_SHIFTS]


def _importance(parameter: ParameterEstimate) -> tuple[bool, float]:
    """Sorts offsets to the front, then what the readings told best."""
    share = parameter.data_share
    return not parameter.name.endswith(".offset"), math.inf if math.isnan(share) else -share


def _rms(rows: Sequence[ResidualRow], get: Callable[[ResidualRow], float]) -> float:
    """Root mean square of what is known; NaN if nothing is."""
    values = np.array([get(r) for r in rows])
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if values.size else math.nan


def _noise_factor(row: ResidualRow) -> float:
    """Standard deviation of a row over that of one reading."""
    return math.sqrt(2.0) if row.minus else 1.0


def _row_sigma(calibration: Calibration, row: ResidualRow) -> float:
    return calibration.sigma * _noise_factor(row) / calibration.row_factor


def _row_word(calibration: Calibration) -> str:
    return "difference" if calibration.rows_are_differences else "reading"


def _row_names(calibration: Calibration, rows: Sequence[ResidualRow]) -> list[str]:
    """Setup and postures of rows, and the cycle where there are several."""
    repeated = any(r.cycle != 1 for r in calibration.residuals)
    return [_name(f"{r.label}, cycle {r.cycle}" if repeated else r.label) for r in rows]


def _thin(count: int) -> NDArray[np.int64]:
    """Positions in an order that are drawn: of many, the outermost and a selection between."""
    if count <= MOST_POINTS:
        return np.arange(count)
    edge = MOST_POINTS // 4
    between = np.linspace(edge, count - 1 - edge, MOST_POINTS - 2 * edge).round()
    return np.concatenate([np.arange(edge), between, np.arange(count - edge, count)]).astype(
        np.int64
    )


def _of(shown: int, count: int) -> str:
    return str(count) if shown == count else f"{shown} of {count}"


def _signed(value: float, decimals: int) -> str:
    """A number with its sign as axes have it; no sign for nothing."""
    rounded = round(value, decimals)
    return f"{rounded:+.{decimals}f}".replace("-", "−") if rounded else f"{0.0:.{decimals}f}"


def _name(text: str, longest: int = LONGEST_NAME) -> str:
    """A name from a file as it can be shown: printable, and not too long."""
    shown = "".join(c if c.isprintable() else " " for c in text)
    half = longest // 2
    return shown if len(shown) <= longest else f"{shown[:half]}…{shown[-half + 1 :]}"
