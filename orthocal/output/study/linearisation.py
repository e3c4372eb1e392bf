"""A study of what linearising costs as text, plain data and a picture."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.output.study.numbers import sized
from orthocal.output.text.layout import add_row, counted, section, table_of
from orthocal.study.linearisation import METHOD_WORDS
from orthocal.study.linearisation_summary import LinearisationSummary, Method
from orthocal.study.runner import StudyTable

Array = NDArray[np.float64]

LEAST_DRAWN = 1e-4
"""[mm]"""


def answer_linearisation(table: StudyTable, s: LinearisationSummary) -> str:
    """The answer, in a sentence or two."""
    first = next(m for m in s.methods if m.name == "first_order")
    six = next((m for m in s.methods if m.name == "six"), None)
    named = (("The paper's six equations miss", six),) if six else ()
    parts = []
    for words, m in (*named, ("The general first-order solution misses", first)):
        parts.append(f"{words} {_from_when(m, s.resolution)}")
    most = max((n for n in s.steps if n is not None), default=None)
    if most is not None and all(n is not None for n in s.steps):
        parts.append(f"{counted(most, 'Gauss-Newton step')} do up to {s.sizes[-1]:g} mm.")
    elif most is not None:
        last = max(z for z, n in zip(s.sizes, s.steps, strict=True) if n is not None)
        parts.append(f"Undamped Gauss-Newton converges in every direction up to {last:.3g} mm.")
    exact = next(m for m in s.methods if m.name == "exact")
    if exact.ends is not None:
        parts.append(f"The exact solver fails from {exact.ends:.3g} mm on, in some direction.")
    if s.assembled is not None and s.assembled < s.sizes[-1]:
        parts.append(f"Machines can be assembled in every direction up to {s.assembled:.3g} mm.")
    return " ".join(parts)


def _from_when(m: Method, resolution: float) -> str:
    def size(value: float | None) -> str:
        return "nowhere" if value is None else f"from errors of {value:.2g} mm on"

    noise = f"more than a standard error ({m.standard_error:.3f} mm) {size(m.beyond_noise)}."
    if not resolution > 0.0:
        return noise
    finer = f"more than the resolution ({resolution:g} mm) {size(m.beyond_resolution)}"
    return f"{finer}, {noise}"


def render_linearisation(
    table: StudyTable, s: LinearisationSummary, *, all_rows: bool
) -> RenderableType:
    """All of it: the answer first."""
    chosen = _some(len(s.sizes))
    errors = table_of("largest error [mm]", *(f"{s.sizes[i]:.3g}" for i in chosen))
    for m in s.methods:
        add_row(errors, METHOD_WORDS[m.name], *(sized(m.missed[i]) for i in chosen))
    add_row(errors, "a linearised reading", *(sized(s.reading[i]) for i in chosen))
    add_row(
        errors,
        "Gauss-Newton steps that do",
        *("none" if s.steps[i] is None else str(s.steps[i]) for i in chosen),
    )
    limits = table_of("misses more than", "the resolution", "a standard error", "comes to nothing")
    for m in s.methods:
        values = (m.beyond_resolution, m.beyond_noise, m.ends)
        add_row(limits, METHOD_WORDS[m.name], *("-" if v is None else f"{v:.3g}" for v in values))
    return Group(
        Text(answer_linearisation(table, s), style="bold"),
        section("Missed by, r.m.s. over directions [mm]", errors),
        section("From which error on [mm]", limits),
    )


def linearisation_document(s: LinearisationSummary) -> dict[str, Any]:
    """What it says as plain data."""
    return {
        "sizes_mm": s.sizes.tolist(),
        "resolution_mm": s.resolution,
        "reading_mm": s.reading.tolist(),
        "steps": list(s.steps),
        "assembled_up_to_mm": s.assembled,
        "methods": [
            {
                "name": m.name,
                "missed_mm": m.missed.tolist(),
                "standard_error_mm": m.standard_error,
                "beyond_resolution_mm": m.beyond_resolution,
                "beyond_noise_mm": m.beyond_noise,
                "ends_mm": m.ends,
            }
            for m in s.methods
        ],
    }


def draw_linearisation(table: StudyTable, s: LinearisationSummary) -> str:
    """A picture of it, as SVG."""
    from orthocal.output.report.figure import (
        AFTER,
        BEFORE,
        UNSEEN,
        draw_legend,
        open_figure,
        render_figure,
        scale_log,
    )

    looks = {
        "six": (BEFORE, "-", "the paper's six equations"),
        "first_order": (AFTER, "-", "first order"),
        "steps_2": (AFTER, "--", "two steps"),
        "steps_3": (AFTER, ":", "three steps"),
    }

    def draw() -> Any:  # noqa: ANN401 - a figure
        figure = open_figure(3.6, "What linearising misses as errors grow")
        axes = figure.subplots()
        for m in s.methods:
            if m.name in looks:
                colour, line, label = looks[m.name]
                width = 3.0 if m.name == "six" else 1.5
                axes.plot(s.sizes, m.missed, line, color=colour, linewidth=width, label=label)
        noise = next(m for m in s.methods if m.name == "first_order").standard_error
        levels = [(noise, UNSEEN, "a standard error")]
        if s.resolution > 0.0:
            levels.append((s.resolution, "#777777", "the resolution"))
        for level, colour, word in levels:
            axes.axhline(level, color=colour, linewidth=1.0)
            axes.annotate(word, (s.sizes[0], level), va="bottom")
        largest = max(float(np.nanmax(m.missed)) for m in s.methods)
        scale_log(axes, "x", s.sizes)
        scale_log(axes, "y", np.array([LEAST_DRAWN, max(largest, 10.0 * LEAST_DRAWN)]))
        axes.set_xlabel("largest error of the machine [mm]")
        axes.set_ylabel("missed by [mm]")
        axes.grid(True)
        draw_legend(figure, axes)
        return figure

    return render_figure("study", "What linearising misses as errors grow", draw)


def _some(count: int) -> list[int]:
    """Places of a few of many, first and last among them."""
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, 8))})
