"""A study of many machines as text, plain data and a picture."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.kinematics.workspace import describe_box
from orthocal.output.study.numbers import MOST_ROWS, sized, um_of
from orthocal.output.text.layout import add_row, counted, section, table_of
from orthocal.study.accuracy import AccuracyStudy
from orthocal.study.accuracy_summary import AccuracySummary
from orthocal.study.runner import StudyTable
from orthocal.units import UM

Array = NDArray[np.float64]

DOUBTED = 3.0
"""Standard deviations by which what came differs from what was foretold before that is said."""

SOME_BIAS = 0.1
"""Part by which it differs besides: the prediction is to first order, about some of them."""


def answer_accuracy(table: StudyTable, s: AccuracySummary) -> str:
    """The answer, in a sentence or two."""
    study = table.study
    if not s.machines:
        reasons = ", ".join(f"{n}: {reason}" for reason, n in s.failed.items())
        return f"None of the machines could be calibrated ({reasons})."
    region = describe_box(np.array(study.box)) if isinstance(study, AccuracyStudy) else "unknown"
    text = (
        f"{um_of(s.after)} ± {um_of(s.doubt)} µm are left at the tool of "
        f"{counted(s.machines, 'machine')} ({um_of(s.before)} µm before; r.m.s. over the workspace "
        f"{region}, shift and rotation taken out), in a controller that knows all that was "
        f"identified; 95 % of them stay below {um_of(s.most)} µm."
    )
    if s.foretold is None:
        return text
    expected = s.foretold.headline.rms
    given = isinstance(study, AccuracyStudy) and study.given
    more = s.after - expected > max(DOUBTED * s.doubt, SOME_BIAS * expected)
    held = ": more than that is left" if more and not given else ""
    of = " of machines within their tolerances" if given else ""
    return f"{text} The covariance promises {um_of(expected)} µm{of}{held}."


def render_accuracy(table: StudyTable, s: AccuracySummary, *, all_rows: bool) -> RenderableType:
    """All of it: the answer first."""
    parts: list[RenderableType] = [Text(answer_accuracy(table, s), style="bold")]
    for reason, count in s.failed.items():
        parts.append(Text(f"Not calibrated: {counted(count, 'machine')}, for {reason}."))
    if not s.machines:
        return Group(*parts)
    tool = table_of("[µm]", "before", "after", "±", "foretold")
    sizes = None if s.foretold is None else s.foretold.sizes
    aligned = math.nan if s.foretold is None else s.foretold.headline.rms
    add_row(
        tool,
        "shift and rotation out",
        um_of(s.before),
        um_of(s.after),
        um_of(s.doubt),
        um_of(aligned),
    )
    for word, value, known in (
        ("shift out", s.relative, math.nan if sizes is None else sizes.relative.rms),
        ("absolute", s.absolute, math.nan if sizes is None else sizes.absolute.rms),
        ("worst point, aligned", s.worst, math.nan),
    ):
        add_row(tool, word, "", um_of(value), "", um_of(known))
    parts.append(section("At the tool", tool))
    rows = s.missed if all_rows else s.missed[:MOST_ROWS]
    missed = table_of("parameter", "missed by", "±", "foretold", "of its tolerance", "unit")
    for m in rows:
        f, unit = m.parameter.edge_factor, m.parameter.edge_unit
        values = [sized(v * f) for v in (m.rms, m.doubt, m.foretold)]
        add_row(missed, m.parameter.name, *values, f"{100.0 * m.of_tolerance:.0f} %", unit)
    parts.append(section("What was identified, r.m.s.", missed))
    if len(rows) < len(s.missed):
        parts.append(Text(f"The {len(rows)} least known of {len(s.missed)}; --all lists all."))
    return Group(*parts)


def accuracy_document(s: AccuracySummary) -> dict[str, Any]:
    """What it says as plain data."""

    def edge(m: Any, value: float) -> float:  # noqa: ANN401 - a Missed
        return float(value * m.parameter.edge_factor)

    foretold = None
    if s.foretold is not None:
        sizes = s.foretold.sizes
        foretold = {
            "aligned_um": s.foretold.headline.rms / UM,
            "shift_out_um": sizes.relative.rms / UM,
            "absolute_um": sizes.absolute.rms / UM,
        }
    return {
        "machines": s.machines,
        "failed": dict(s.failed),
        "before_um": s.before / UM,
        "after_um": s.after / UM,
        "after_doubt_um": s.doubt / UM,
        "percentile_95_um": s.most / UM,
        "worst_point_um": s.worst / UM,
        "shift_out_um": s.relative / UM,
        "absolute_um": s.absolute / UM,
        "foretold": foretold,
        "parameters": [
            {
                "name": m.parameter.name,
                "unit": m.parameter.edge_unit,
                "missed": edge(m, m.rms),
                "doubt": edge(m, m.doubt),
                "foretold": edge(m, m.foretold),
                "of_tolerance": m.of_tolerance,
            }
            for m in s.missed
        ],
    }


def draw_accuracy(table: StudyTable, s: AccuracySummary) -> str:
    """A picture of it, as SVG."""
    from orthocal.output.report.figure import (
        AFTER,
        BEFORE,
        draw_legend,
        open_figure,
        render_figure,
        scale_log,
    )

    def column(name: str) -> Array:
        values = np.array(table.columns.get(name, []), dtype=np.float64)
        return np.sort(values[np.isfinite(values)])

    def draw() -> Any:  # noqa: ANN401 - a figure
        figure = open_figure(3.2, "How many machines stay below")
        axes = figure.subplots()
        for name, colour, label in (
            ("before_um", BEFORE, "as they are"),
            ("tool_um", AFTER, "calibrated"),
        ):
            values = column(name)
            if values.size:
                share = 100.0 * (np.arange(values.size) + 1) / values.size
                axes.plot(values, share, color=colour, label=label)
        if s.foretold is not None:
            rms = s.foretold.headline.rms / UM
            axes.axvline(rms, color="black", linestyle=":", label="foretold, r.m.s.")
        drawn = np.concatenate([column("before_um"), column("tool_um")])
        if drawn.size:
            scale_log(axes, "x", drawn)
        axes.grid(True)
        axes.set_xlabel("error at the tool, shift and rotation taken out [µm]")
        axes.set_ylabel("machines [%]")
        draw_legend(figure, axes)
        return figure

    return render_figure("study", "Error at the tool before and after", draw)
