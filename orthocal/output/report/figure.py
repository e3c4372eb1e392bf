"""Figures as inline `<svg>` for an HTML page, all in one style.

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
from typing import Any, Literal

import matplotlib
import numpy as np
from lxml import etree
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import NDArray

Array = NDArray[np.float64]

WIDTH = 7.2
"""Of a figure, [inch], at 100 pixels an inch on the page."""

ROW_HEIGHT = 0.17
"""Of a line of a plot that lists things, [inch]."""

HEAD = 0.48
"""Height of title and legend, [inch]."""

BEFORE, AFTER, UNSEEN, BAND = "#E69F00", "#0072B2", "#009E73", "#DDDDDD"

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

BEFORE_LOOK: Look = {
    "marker": "o",
    "color": BEFORE,
    "markerfacecolor": "white",
    "markeredgewidth": 1.4,
    "linestyle": "none",
}
AFTER_LOOK: Look = {"marker": "s", "color": AFTER, "markersize": 4.5, "linestyle": "none"}
UNSEEN_LOOK: Look = {"marker": "^", "color": UNSEEN, "markersize": 6.0, "linestyle": "none"}
BOUND_LOOK: Look = {"marker": "X", "color": "black", "markersize": 7.0, "linestyle": "none"}


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
        layout = figure.get_layout_engine()
        if layout is not None:  # else savefig would lay out, and draw, twice
            layout.execute(figure)
            figure.set_layout_engine(None)
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


def open_list(
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


def shade(axes: Axes, y: NDArray[np.int64], low: Array, high: Array, label: str) -> None:
    """A band behind lines of a list."""
    look: Look = {"color": BAND, "edgecolor": BAND, "linewidth": 0.5}
    axes.barh(y, high - low, 1.0, low, zorder=0.5, label=label, **look)


def draw_legend(figure: Figure, axes: Axes) -> None:
    """What the markers mean, in a line below the title."""
    handles, labels = axes.get_legend_handles_labels()
    place = (0.01, 1.0 - 0.27 / figure.get_figheight())
    figure.legend(handles, labels, bbox_to_anchor=place, ncols=len(handles))


def scale_log(axes: Axes, side: Literal["x", "y"], values: Array) -> None:
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


def count_of(shown: int, count: int) -> str:
    """How many are shown of how many there are, in words."""
    return str(count) if shown == count else f"{shown} of {count}"


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
