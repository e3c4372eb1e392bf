"""A study of what readings answer to errors as text, plain data and a heat map."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.output.text.layout import add_row, counted, section, table_of
from orthocal.study.runner import StudyTable
from orthocal.study.sensitivity import SensitivitySummary
from orthocal.units import UM

Array = NDArray[np.float64]

MOST_COLUMNS = 6
"""Of the table, unless all are asked for."""

MOST_DRAWN = 40
"""Columns of the heat map."""


def answer_sensitivity(table: StudyTable, s: SensitivitySummary) -> str:
    """The answer, in a sentence or two."""
    place = np.unravel_index(np.abs(s.per_tolerance).argmax(), s.per_tolerance.shape)
    posture, reads = s.rows[place[0]]
    return (
        f"{counted(len(s.parameters), 'error')} in {counted(len(s.rows), 'row')} of readings and "
        f"tool coordinates. Most moves {reads} in posture {posture} with {s.parameters[place[1]]}: "
        f"{s.per_tolerance[place] / UM:+.0f} µm for a tolerance."
    )


def render_sensitivity(
    table: StudyTable, s: SensitivitySummary, *, all_rows: bool
) -> RenderableType:
    """All of it: the answer first."""
    order = np.argsort(-np.abs(s.per_tolerance).max(axis=0), kind="stable")
    chosen = np.sort(order[:MOST_COLUMNS]) if not all_rows else np.arange(len(s.parameters))
    slopes = table_of("posture", "reads", *(s.parameters[i] for i in chosen), left=2)
    for (posture, reads), row in zip(s.rows, s.slopes, strict=True):
        add_row(slopes, posture, reads, *(f"{round(row[i], 4) + 0.0:+.4f}" for i in chosen))
    units = ", ".join(sorted({s.units[i] for i in chosen}))
    parts: list[RenderableType] = [
        Text(answer_sensitivity(table, s), style="bold"),
        section(f"First derivatives about the nominal machine [{units}]", slopes),
    ]
    if len(chosen) < len(s.parameters):
        parts.append(
            Text(f"The {len(chosen)} that move most of {len(s.parameters)}; --all lists all.")
        )
    return Group(*parts)


def sensitivity_document(s: SensitivitySummary) -> dict[str, Any]:
    """What it says as plain data."""
    return {
        "parameters": [{"name": n, "unit": u} for n, u in zip(s.parameters, s.units, strict=True)],
        "rows": [
            {
                "posture": posture,
                "reads": reads,
                "slopes": slopes.tolist(),
                "um_per_tolerance": (moved / UM).tolist(),
            }
            for (posture, reads), slopes, moved in zip(
                s.rows, s.slopes, s.per_tolerance, strict=True
            )
        ],
    }


def draw_sensitivity(table: StudyTable, s: SensitivitySummary) -> str:
    """A heat map of it, as SVG: of many parameters those that move most."""
    from matplotlib.colors import SymLogNorm
    from matplotlib.ticker import FixedLocator, FuncFormatter

    from orthocal.output.report.figure import count_of, open_figure, render_figure

    order = np.argsort(-np.abs(s.per_tolerance).max(axis=0), kind="stable")[:MOST_DRAWN]
    chosen = np.sort(order)
    values = s.per_tolerance[:, chosen] / UM
    most = max(float(np.abs(values).max()), 1e-9)
    decades = 10.0 ** np.arange(int(np.floor(np.log10(most))) - 1, int(np.ceil(np.log10(most))))
    shown = f"{count_of(len(chosen), len(s.parameters))} errors"

    def draw() -> Any:  # noqa: ANN401 - a figure
        title = f"What an error of one tolerance does [µm], {shown}"
        figure = open_figure(1.6 + 0.16 * len(s.rows), title, legend=False)
        axes = figure.subplots()
        norm = SymLogNorm(linthresh=decades[0], vmin=-most, vmax=most)
        picture = axes.imshow(
            values, aspect="auto", cmap="RdBu_r", norm=norm, interpolation="nearest"
        )
        axes.set_yticks(range(len(s.rows)), [f"{p}  {r}" for p, r in s.rows], fontsize=6.5)
        names = [s.parameters[i] for i in chosen]
        axes.set_xticks(range(len(chosen)), names, fontsize=6.5, rotation=90)
        ticks = FixedLocator([*-decades[::-1], 0.0, *decades])
        form = FuncFormatter(lambda v, _: f"{v:+g}" if v else "0")
        bar = figure.colorbar(picture, ax=axes, fraction=0.04, ticks=ticks, format=form)
        bar.minorticks_off()
        return figure

    return render_figure("study", "What each reading answers to each error", draw)
