"""Report of a study: answer, tables and figure, rendered as text, JSON or SVG by one renderer each.

What the report of each kind of study contains is in `contents`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.output.text.layout import add_row, section, table_of

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ReportTable:
    """A table of a report."""

    title: str
    header: tuple[str, ...]
    rows: Sequence[Sequence[str]]
    left: int = 1
    """Number of left-aligned columns."""
    omitted: str = ""
    """Sentence about rows or columns that are not listed."""


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A curve of a figure."""

    label: str
    x: Array
    y: Array
    color: str
    style: str = "-"
    width: float = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class CurveFigure:
    """Curves over a logarithmic axis."""

    title: str
    label: str
    """Description for readers who cannot see the figure."""
    x_label: str
    y_label: str
    curves: tuple[Curve, ...]
    height: float
    """[inch]"""
    y_range: tuple[float, float] | None = None
    """Range of a logarithmic axis; None for a linear one."""
    vertical: tuple[tuple[str, float], ...] = ()
    """Labels and positions of vertical lines."""
    horizontal: tuple[tuple[str, float, str], ...] = ()
    """Labels, positions and colours of horizontal lines."""


@dataclass(frozen=True, slots=True, eq=False)
class IntervalFigure:
    """Intervals around 0, one below the other."""

    title: str
    label: str
    names: tuple[str, ...]
    low: Array
    high: Array
    band: float
    """Half width of the predicted interval."""


@dataclass(frozen=True, slots=True, eq=False)
class MatrixFigure:
    """A matrix as a heat map with a symmetric logarithmic scale."""

    title: str
    label: str
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    values: Array


Figure = CurveFigure | IntervalFigure | MatrixFigure


@dataclass(frozen=True, slots=True, eq=False)
class StudyReport:
    """Everything that is shown of a study."""

    answer: str
    tables: tuple[ReportTable, ...]
    figure: Figure
    document: dict[str, Any]
    """Summary as plain data."""
    notes: tuple[str, ...] = ()


def render_report(report: StudyReport) -> RenderableType:
    """A report as text, the answer first."""
    parts: list[RenderableType] = [Text(report.answer, style="bold")]
    for table in report.tables:
        body = table_of(*table.header, left=table.left)
        for row in table.rows:
            add_row(body, *row)
        parts.append(section(table.title, body))
        if table.omitted:
            parts.append(Text(table.omitted))
    return Group(*parts, *map(Text, report.notes))


def to_json(document: dict[str, Any]) -> str:
    """Plain data as JSON, with null for numbers that are not finite."""
    return json.dumps(_finite(document), indent=1, allow_nan=False) + "\n"


def draw_figure(figure: Figure) -> str:
    """A figure as an SVG document."""
    from orthocal.output.report.figure import render_figure

    def draw() -> Any:  # noqa: ANN401 - a figure
        if isinstance(figure, CurveFigure):
            return _draw_curves(figure)
        if isinstance(figure, IntervalFigure):
            return _draw_intervals(figure)
        return _draw_matrix(figure)

    svg = render_figure("study", figure.label, draw)
    return f'<?xml version="1.0" encoding="utf-8"?>\n{svg}\n'


def _draw_curves(spec: CurveFigure) -> Any:  # noqa: ANN401 - a figure
    from orthocal.output.report.figure import draw_legend, open_figure, scale_log

    figure = open_figure(spec.height, spec.title)
    axes = figure.subplots()
    for c in spec.curves:
        axes.plot(c.x, c.y, c.style, color=c.color, linewidth=c.width, label=c.label)
    for label, x in spec.vertical:
        axes.axvline(x, color="black", linestyle=":", label=label)
    points = np.concatenate([c.x for c in spec.curves] or [np.ones(1)])
    for label, y, color in spec.horizontal:
        axes.axhline(y, color=color, linewidth=1.0)
        axes.annotate(label, (points.min(), y), va="bottom")
    scale_log(axes, "x", points)
    if spec.y_range is not None:
        scale_log(axes, "y", np.array(spec.y_range))
    axes.grid(True)
    axes.set_xlabel(spec.x_label)
    axes.set_ylabel(spec.y_label)
    draw_legend(figure, axes)
    return figure


def _draw_intervals(spec: IntervalFigure) -> Any:  # noqa: ANN401 - a figure
    from orthocal.output.report.figure import AFTER_LOOK, BAND, draw_legend, open_list

    figure, axes = open_list(spec.title, spec.names)
    y = np.arange(len(spec.names))
    axes.axvspan(-spec.band, spec.band, color=BAND, label="predicted")
    axes.hlines(y, spec.low, spec.high, color=AFTER_LOOK["color"])
    axes.plot(0.0 * y, y, label="estimate", **AFTER_LOOK)
    draw_legend(figure, axes)
    return figure


def _draw_matrix(spec: MatrixFigure) -> Any:  # noqa: ANN401 - a figure
    from matplotlib.colors import SymLogNorm
    from matplotlib.ticker import FixedLocator, FuncFormatter

    from orthocal.output.report.figure import open_figure

    largest = max(float(np.abs(spec.values).max()), 1e-9)
    first, last = math.floor(math.log10(largest)) - 1, math.ceil(math.log10(largest))
    decades = 10.0 ** np.arange(first, last)
    figure = open_figure(1.6 + 0.16 * len(spec.rows), spec.title, legend=False)
    axes = figure.subplots()
    norm = SymLogNorm(linthresh=decades[0], vmin=-largest, vmax=largest)
    look: dict[str, Any] = {"aspect": "auto", "cmap": "RdBu_r", "interpolation": "nearest"}
    image = axes.imshow(spec.values, norm=norm, **look)
    axes.set_yticks(range(len(spec.rows)), spec.rows, fontsize=6.5)
    axes.set_xticks(range(len(spec.columns)), spec.columns, fontsize=6.5, rotation=90)
    ticks = FixedLocator([*-decades[::-1], 0.0, *decades])
    text = FuncFormatter(lambda v, _: f"{v:+g}" if v else "0")
    bar = figure.colorbar(image, ax=axes, fraction=0.04, ticks=ticks, format=text)
    bar.minorticks_off()
    return figure


def _finite(value: Any) -> Any:  # noqa: ANN401 - plain data
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
