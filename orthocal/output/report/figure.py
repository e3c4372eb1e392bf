"""Figures of all reports as inline `<svg>`, in one style.

Text is not converted to curves and never parsed, because names come from files. Markers make every
plot readable in black and white. Ids are unique, so that a page can contain several figures.
"""

from __future__ import annotations

import hashlib
import io
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any, Generic, Literal, ParamSpec

import matplotlib
import numpy as np
from lxml import etree
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import NDArray

from orthocal.arrays import Array
from orthocal.output.text.layout import short_names

WIDTH = 7.2
"""Width of a figure, [inch]; 100 pixels per inch on the page."""

ROW_HEIGHT = 0.17
"""Height of a row of a list, [inch]."""

HEAD_HEIGHT = 0.48
"""Height of title and legend together, [inch]."""

MOST_TICKS = 6
"""Largest number of intervals between the ticks of a list, which long names make narrow."""

CHARACTER = 0.073
"""Width of a character of a name below a matrix, [inch]."""

MAX_NAME_IN_MATRIX = 24
"""Most characters of a name in a matrix."""

PADDING = 0.1
"""Distance of text from the border, [inch]; browsers draw text wider than matplotlib expects."""

BEFORE, AFTER, PREDICTED, BAND = "#E69F00", "#0072B2", "#009E73", "#DDDDDD"
"""Colours of deviations before, deviations after, predictions, and bands."""

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
"""Keyword arguments of matplotlib's drawing functions."""

P = ParamSpec("P")

BEFORE_LOOK: Look = {
    "marker": "o",
    "color": BEFORE,
    "markerfacecolor": "white",
    "markeredgewidth": 1.4,
    "linestyle": "none",
}
AFTER_LOOK: Look = {"marker": "s", "color": AFTER, "markersize": 4.5, "linestyle": "none"}
PREDICTED_LOOK: Look = {"marker": "^", "color": PREDICTED, "markersize": 6.0, "linestyle": "none"}
BOUND_LOOK: Look = {"marker": "X", "color": "black", "markersize": 7.0, "linestyle": "none"}


@contextmanager
def house_style() -> Iterator[None]:
    """Style of all figures, independent of the user's configuration of matplotlib."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        yield


@dataclass(frozen=True)
class Plot(Generic[P]):
    """Plot that returns an inline `<svg>` if it is called, or "" without content."""

    name: str
    """Prefix of the ids."""
    draw: Callable[P, Figure | None]
    """Function that draws the figure."""

    def figure(self, *args: P.args, **kwargs: P.kwargs) -> Figure | None:
        """Figure in the style of all figures; None without content."""
        with house_style():
            return self.draw(*args, **kwargs)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> str:
        """Draw the plot as an inline `<svg>` that scales with its page."""
        stream = io.BytesIO()
        with house_style(), warnings.catch_warnings():
            # browsers draw the text with the reader's fonts
            warnings.filterwarnings("ignore", message="Glyph .* missing from")
            figure = self.draw(*args, **kwargs)
            if figure is None:
                return ""
            layout = figure.get_layout_engine()
            if layout is not None:  # otherwise savefig would draw twice
                layout.execute(figure)
                figure.set_layout_engine(None)
            no_metadata = dict.fromkeys(("Creator", "Date", "Format", "Type"))
            figure.savefig(stream, format="svg", metadata=no_metadata)
        return _make_inline(stream.getvalue(), figure, self.name)

    def document(self, *args: P.args, **kwargs: P.kwargs) -> str:
        """Text of an SVG file with the plot."""
        return f'<?xml version="1.0" encoding="utf-8"?>\n{self(*args, **kwargs)}\n'


def _make_inline(svg: bytes, figure: Figure, name: str) -> str:
    """Element of a page, with unique ids, from an SVG file of a figure."""
    label = str(figure.get_label())
    root = etree.fromstring(svg, etree.XMLParser(resolve_entities=False, huge_tree=True))
    _name_ids(root, f"{name}-{hashlib.sha256(svg).hexdigest()[:8]}-")
    for styles in root.findall(f".//{_SVG}style"):  # they would apply to the whole page
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


def plot(name: str) -> Callable[[Callable[P, Figure | None]], Plot[P]]:
    """Decorator that turns a function that draws a figure into a plot.

    Args:
        name: Prefix of the ids of the plot.
    """
    return lambda draw: Plot(name, draw)


def open_figure(height: float, title: str, *, legend: bool = True) -> Figure:
    """Empty figure with a title, which is also the description for screen readers.

    Args:
        height: Height of the plot without title and legend, [inch].
        title: The title.
        legend: Whether there is space for a legend below the title.
    """
    head = HEAD_HEIGHT if legend else 0.7 * HEAD_HEIGHT
    height += head
    plot_area = (0.0, 0.0, 1.0, 1.0 - head / height)
    figure = Figure(
        figsize=(WIDTH, height),
        layout=ConstrainedLayoutEngine(rect=plot_area, w_pad=PADDING, h_pad=PADDING),
    )
    bold = {"fontsize": 10.0, "fontweight": "bold", "verticalalignment": "top"}
    figure.text(0.01, 1.0 - 0.06 / height, title, bold)
    figure.set_label(title)
    return figure


def open_list(
    title: str,
    names: Sequence[str],
    *,
    remarks: Sequence[str] = (),
    height: float = ROW_HEIGHT,
    share: bool = False,
) -> tuple[Figure, Axes]:
    """Empty figure with a row for each name.

    Args:
        title: The title.
        names: Names of the rows, which are cut if they are too long.
        remarks: Text behind each name.
        height: Height of a row, [inch].
        share: Whether there is a narrow second panel at the right.
    """
    figure = open_figure(0.6 + height * max(len(names), 2), title)
    if share:
        axes, _ = figure.subplots(1, 2, sharey=True, width_ratios=[4.0, 1.0])
    else:
        axes = figure.subplots()
    axes.use_sticky_edges = False  # markers at the end of a band are not cut
    labels = map("".join, zip_longest(short_names(names), remarks, fillvalue=""))
    axes.set_yticks(np.arange(len(names)), list(labels))
    axes.locator_params(axis="x", nbins=MOST_TICKS)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.grid(True, axis="x")
    return figure, axes


def shade(axes: Axes, y: NDArray[np.int64], low: Array, high: Array, label: str) -> None:
    """Draw a band behind rows of a list.

    Args:
        axes: The axes.
        y: Indices of the rows, shape (n,).
        low: Lower ends of the band, shape (n,).
        high: Upper ends of the band, shape (n,).
        label: Text of the legend.
    """
    look: Look = {"color": BAND, "edgecolor": BAND, "linewidth": 0.5}
    axes.barh(y, high - low, 1.0, low, zorder=0.5, label=label, **look)


def draw_legend(figure: Figure, axes: Axes) -> None:
    """Draw the legend in a line below the title."""
    handles, labels = axes.get_legend_handles_labels()
    position = (0.01, 1.0 - 0.27 / figure.get_figheight())
    figure.legend(handles, labels, bbox_to_anchor=position, ncols=len(handles))


def scale_log(axes: Axes, side: Literal["x", "y"], values: Array) -> None:
    """Make an axis logarithmic, with ticks at 1, 2 and 5 or at decades around positive values."""
    low, high = (math.log10(float(v)) for v in (values.min(), values.max()))
    margin = 0.02 + 0.03 * (high - low)
    decades = range(math.floor(low - margin) - 1, math.ceil(high + margin) + 2)
    steps = (1.0, 2.0, 5.0) if high - low < 2.0 else (1.0,)
    ticks = np.array([s * 10.0**d for d in decades for s in steps])
    first = int(np.flatnonzero(ticks <= 10.0 ** (low - margin))[-1])
    last = int(np.flatnonzero(ticks >= 10.0 ** (high + margin))[0])
    axes.set(**{f"{side}scale": "log", f"{side}lim": (ticks[first], ticks[last])})
    axis = axes.xaxis if side == "x" else axes.yaxis
    stride = math.ceil((last + 1 - first) / 9)
    axis.set_major_locator(FixedLocator(ticks[first : last + 1 : stride].tolist()))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))


def round_up(value: float) -> float:
    """Smallest number of the form 1, 2 or 5 times a power of ten that is not less."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= value * (1.0 - 1e-9))


def count_of(shown: int, count: int) -> str:
    """Number of shown items, and number of all items if some are not shown."""
    return str(count) if shown == count else f"{shown} of {count}"


def _name_ids(root: etree._Element, prefix: str) -> None:
    """Add a prefix to all ids and to all references to them."""
    for element in root.iter():
        for key, value in element.attrib.items():
            if key == "id":
                element.set(key, prefix + value)
            elif key == _HREF and value.startswith("#"):
                element.set(key, f"#{prefix}{value[1:]}")
            elif "url(#" in value:
                element.set(key, value.replace("url(#", f"url(#{prefix}"))
