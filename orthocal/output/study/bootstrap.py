"""A session drawn anew as text, plain data and a picture."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.output.study.numbers import MOST_ROWS, sized
from orthocal.output.text.layout import add_row, counted, section, table_of
from orthocal.study.bootstrap import BootstrapSummary
from orthocal.study.runner import StudyTable
from orthocal.units import UM

Array = NDArray[np.float64]


def answer_bootstrap(table: StudyTable, s: BootstrapSummary) -> str:
    """The answer, in a sentence or two."""
    known = [p for p in s.parameters if p.foretold > 0.0 and math.isfinite(p.std)]
    if not known:
        return "Nothing scatters."
    ratios = np.array([p.std / p.foretold for p in known])
    middle = float(np.median(ratios))
    text = (
        f"Estimates scatter {middle:.2f} times as much as the covariance says of noise "
        f"({ratios.min():.2f} to {ratios.max():.2f} times, {counted(s.draws, 'draw')})."
    )
    if s.fewest_cycles is not None:
        text += f" With {s.fewest_cycles} cycles that ratio itself is known to about "
        text += f"{100.0 / math.sqrt(2.0 * (s.fewest_cycles - 1) * len(known)):.0f} %."
    return text


def render_bootstrap(table: StudyTable, s: BootstrapSummary, *, all_rows: bool) -> RenderableType:
    """All of it: the answer first."""
    rows = s.parameters if all_rows else s.parameters[:MOST_ROWS]
    found = table_of(
        "parameter", "estimate", "± drawn", "± foretold", "95 % of the draws", "± in all", "unit"
    )
    for p in rows:
        f, unit = p.parameter.edge_factor, p.parameter.edge_unit
        add_row(
            found,
            p.parameter.name,
            f"{p.estimate * f:+.3f}",
            sized(p.std * f),
            sized(p.foretold * f),
            f"{p.low * f:+.3f} … {p.high * f:+.3f}",
            sized(p.unknown * f),
            unit,
        )
    parts: list[RenderableType] = [
        Text(answer_bootstrap(table, s), style="bold"),
        section("What was identified", found),
        Text(
            "± drawn and foretold: by noise alone; ± in all: with what a prior leaves open, too, "
            "but without errors that are not identified."
        ),
    ]
    if len(rows) < len(s.parameters):
        parts.append(Text(f"The first {len(rows)} of {len(s.parameters)}; --all lists all."))
    return Group(*parts)


def bootstrap_document(s: BootstrapSummary) -> dict[str, Any]:
    """What it says as plain data."""
    return {
        "draws": s.draws,
        "sigma_um": s.sigma / UM,
        "fewest_cycles": s.fewest_cycles,
        "parameters": [
            {
                "name": p.parameter.name,
                "unit": p.parameter.edge_unit,
                **{
                    key: float(value * p.parameter.edge_factor)
                    for key, value in (
                        ("estimate", p.estimate),
                        ("std", p.std),
                        ("std_doubt", p.doubt),
                        ("low", p.low),
                        ("high", p.high),
                        ("foretold", p.foretold),
                        ("unknown", p.unknown),
                    )
                },
            }
            for p in s.parameters
        ],
    }


def draw_bootstrap(table: StudyTable, s: BootstrapSummary) -> str:
    """A picture of it, as SVG."""
    from orthocal.output.report.figure import (
        AFTER_LOOK,
        BAND,
        draw_legend,
        open_list,
        render_figure,
    )

    rows = s.parameters[:40]

    def draw() -> Any:  # noqa: ANN401 - a figure
        title = "Where 95 % of the draws lie, in standard deviations that were foretold"
        figure, axes = open_list(title, [p.parameter.name for p in rows])
        unit = np.array([p.foretold or math.nan for p in rows])
        middle = np.array([p.estimate for p in rows])
        ends = np.array([[p.low, p.high] for p in rows])
        y = np.arange(len(rows))
        low, high = ((ends[:, k] - middle) / unit for k in range(2))
        axes.axvspan(-1.96, 1.96, color=BAND, label="foretold")
        axes.hlines(y, low, high, color=AFTER_LOOK["color"])
        axes.plot(0.0 * y, y, label="estimate", **AFTER_LOOK)
        draw_legend(figure, axes)
        return figure

    return render_figure("study", "Where the draws lie", draw)
