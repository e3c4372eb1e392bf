"""A plan of measuring as text, as plain data, and as a picture of what more time is worth."""

from __future__ import annotations

import json
from typing import Any

from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.text import Text

from orthocal.output.text.layout import add_row, bullets, counted, plain, section, table_of
from orthocal.planning.expected_error import Criterion, Expected
from orthocal.planning.marginal_gain import ENOUGH, HOUR, Stage
from orthocal.planning.plan import MeasuringPlan
from orthocal.planning.plan_comparison import Alternative
from orthocal.units import UM

FORMS: dict[Criterion, str] = {
    "aligned": "r.m.s., shift and rotation taken out",
    "relative": "r.m.s., common shift taken out",
    "absolute": "r.m.s., absolute",
    "worst": "at the worst point, shift and rotation taken out",
    "A": "mean variance of the errors in their tolerances",
    "D": "determinant of the errors' covariance in their tolerances",
    "E": "worst combination of errors in their tolerances",
}
"""What each criterion makes small, in words."""

SOME_LOST = 0.01
"""Share of readings that would not exist, above which that is told."""

HELPFUL = 0.1
"""Part of the error that a help must take off to be one."""

NOTICEABLE = 0.02
"""Part of it below which a help is none: the search for a plan leaves as much."""

MOST_LISTED = 24
"""Setups that are listed one by one."""

HOW = (
    "In each setup stand the gauge so that it touches where `section` says, go to its first "
    "posture, and set the dial to the middle of its range there.",
    "Approach every posture from the same side, from a millimetre before it.",
    "Read the first posture again at the end of the setup (cycle 2): it tells drift and noise.",
)


def render_plan(plan: MeasuringPlan, *, details: bool = False) -> RenderableType:
    """A plan as rich renderables: what it is worth first."""
    s, robot = plan.session, plan.session.robot
    read, closing = _counts(plan)
    head = Text.assemble(
        (f"{_um(plan.expected)} µm", "bold"),
        f" at the tool are to be expected from {counted(read, 'reading')} in "
        f"{counted(len(s.setups), 'setup')}, about {_hours(plan.minutes)}, instead of "
        f"{_um(plan.known)} µm without them (r.m.s. over {plan.forecast.workspace.words}, shift "
        "and rotation taken out).",
    )
    parts: list[RenderableType] = [
        Text(f"Plan for {robot.name}, model '{plan.forecast.selection.label}'", style="bold"),
        Text(),
        head,
        *([Text(first_round_words(plan))] if first_round_words(plan) else []),
        Text(_when_enough(plan)),
        section("At equal cost", _alternatives(plan, closing)),
        section("What would help", bullets(_helps(plan))),
        *(
            [section("What it still cannot tell apart", bullets(_remaining(plan)))]
            if details
            else []
        ),
        section("Setups", _setups(plan)),
        section("How to measure", bullets(list(HOW))),
    ]
    return Group(*parts)


def first_round_words(plan: MeasuringPlan) -> str:
    """What is to be expected before any offsets were entered, and what of it can be read."""
    first = plan.first_round
    text = f"In a first round, before offsets are entered: {_um(first)} µm."
    if first.headline.rms < 1.1 * plan.expected.headline.rms:
        text = ""
    if first.lost > SOME_LOST:
        text += (
            f" With offsets within their tolerances {first.lost:.0%} of the readings would not "
            "exist then: the tip passes the rod. Enter offsets from a first few, or take a blade."
        )
    return text.strip()


def plan_document(plan: MeasuringPlan) -> dict[str, Any]:
    """A plan as plain data: numbers in µm and minutes."""

    def sizes(e: Expected) -> dict[str, float | None]:
        a = e.sizes.aligned
        return {
            "aligned_um": None if a is None else a.rms / UM,
            "relative_um": e.sizes.relative.rms / UM,
            "absolute_um": e.sizes.absolute.rms / UM,
            "worst_um": e.headline.largest / UM,
        }

    def alternative(a: Alternative) -> dict[str, Any]:
        return {
            "name": a.name,
            "setups": a.setups,
            "readings": a.readings,
            "minutes": a.minutes,
            **sizes(a.expected),
        }

    def stage(s: Stage) -> dict[str, float]:
        unit = UM if plan.criterion in ("aligned", "relative", "absolute", "worst") else 1.0
        return {
            "setups": s.setups,
            "readings": s.readings,
            "minutes": s.minutes,
            "left": s.error / unit,
        }

    read, closing = _counts(plan)
    return {
        "robot": plan.session.robot.name,
        "model": plan.forecast.selection.label,
        "criterion": plan.criterion,
        "setups": len(plan.session.setups),
        "readings": read,
        "closing_readings": closing,
        "minutes": plan.minutes,
        "candidates": plan.candidates,
        "before": sizes(plan.known),
        "expected": sizes(plan.expected),
        "first_round": {**sizes(plan.first_round), "lost": plan.first_round.lost},
        "compared": [alternative(a) for a in plan.compared],
        "helps": [alternative(a) for a in plan.helps],
        "curve": [stage(s) for s in plan.curve],
        "enough": None if plan.enough is None else stage(plan.enough),
        "remaining": [
            {"rms_um": r.rms / UM, "parts": [{"name": n, "tolerances": t} for n, t in r.parts]}
            for r in plan.find_remaining()
        ],
    }


def plan_json(plan: MeasuringPlan) -> str:
    """The same as JSON."""
    return json.dumps(plan_document(plan), indent=1, allow_nan=False) + "\n"


def draw_plan(plan: MeasuringPlan) -> str:
    """What is left over the hours, as an SVG picture."""
    import numpy as np
    from matplotlib.figure import Figure

    from orthocal.output.report.figure import (
        AFTER,
        BEFORE,
        UNSEEN,
        draw_legend,
        open_figure,
        render_figure,
        scale_log,
    )

    stages = [s for s in plan.curve if s.setups]
    unit = UM if plan.criterion in ("aligned", "relative", "absolute", "worst") else 1.0

    def draw() -> Figure:
        figure = open_figure(3.2, "What another hour is worth")
        axes = figure.subplots()
        hours = [s.minutes / HOUR for s in stages]
        left = [s.error / unit for s in stages]
        axes.plot(hours, left, "-", color=AFTER, label="setups, the most telling first")
        axes.plot(hours, left, ".", color=AFTER)
        here = next(s for s in stages if s.setups == len(plan.session.setups))
        axes.plot(here.minutes / HOUR, here.error / unit, "s", color=AFTER, label="this plan")
        values = list(left)
        if plan.criterion == "aligned":
            for marker, colour, other in zip("o^", (BEFORE, UNSEEN), plan.compared, strict=False):
                size = other.expected.headline.rms / unit
                values.append(size)
                axes.plot(other.minutes / HOUR, size, marker, color=colour, label=other.name)
        if plan.enough is not None:
            axes.axvline(plan.enough.minutes / HOUR, color="#999999", linestyle=":", label="enough")
        scale_log(axes, "y", np.array(values))
        axes.set_xlim(left=0.0)
        axes.grid(True)
        axes.set_xlabel("time [h]")
        axes.set_ylabel("left at the tool [µm]" if unit == UM else "left")
        draw_legend(figure, axes)
        return figure

    label = "What is left unknown over the hours of measuring"
    return f'<?xml version="1.0" encoding="utf-8"?>\n{render_figure("plan", label, draw)}\n'


def _counts(plan: MeasuringPlan) -> tuple[int, int]:
    """Readings, and those that close a setup."""
    closing = sum(r.cycle > 1 for r in plan.session.readings)
    return len(plan.session.readings) - closing, closing


def _when_enough(plan: MeasuringPlan) -> str:
    """When enough is enough, in a sentence."""
    enough = plan.enough
    if plan.criterion not in ("aligned", "relative", "absolute", "worst"):
        return f"Made small: {FORMS[plan.criterion]}."
    if enough is None:
        last = plan.curve[-1]
        return (
            f"Another hour still takes more than {ENOUGH:.0%} off, as far as {_hours(last.minutes)}"
            f" ({counted(last.setups, 'setup')}), which leave {plain(last.error / UM, 1)} µm."
        )
    here = plan.curve[len(plan.session.setups)]
    if enough.minutes <= here.minutes:
        return (
            f"That is enough: from {counted(enough.setups, 'setup')} on another hour takes less "
            f"than {ENOUGH:.0%} off."
        )
    return (
        f"Enough is {counted(enough.setups, 'setup')}, {_hours(enough.minutes)}, which leave "
        f"{plain(enough.error / UM, 1)} µm: from there on another hour takes less than "
        f"{ENOUGH:.0%} off."
    )


def _alternatives(plan: MeasuringPlan, closing: int) -> RenderableType:
    table = table_of("plan", "setups", "readings", "time", "at the tool [µm]", "absolute [µm]")
    s = plan.session
    add_row(
        table,
        "this one",
        str(len(s.setups)),
        f"{len(s.readings) - closing} + {closing}",
        _hours(plan.minutes),
        _um(plan.expected),
        plain(plan.expected.sizes.absolute.rms / UM, 0),
    )
    for a in plan.compared:
        absolute = plain(a.expected.sizes.absolute.rms / UM, 0)
        time, left = _hours(a.minutes), _um(a.expected)
        add_row(table, a.name, str(a.setups), str(a.readings), time, left, absolute)
    return table


def _helps(plan: MeasuringPlan) -> list[str]:
    """What would help, the most first; all that was tried, where nothing does."""
    mine = plan.expected.headline.rms
    found = sorted(plan.helps, key=lambda a: a.expected.headline.rms)
    some = [a for a in found if a.expected.headline.rms < (1.0 - NOTICEABLE) * mine]
    texts = [f"The same readings with {a.name}: {_um(a.expected)} µm." for a in some]
    if found and found[0].expected.headline.rms > (1.0 - HELPFUL) * mine:
        tried = "; ".join(a.name for a in found)
        none = f"None of this takes {HELPFUL:.0%} off"
        if not some:
            none = f"Nothing that was tried ({tried}) takes {NOTICEABLE:.0%} off"
        texts.append(
            f"{none}: what is left asks for another sensor, such as an indicator at the tool along "
            "a square."
        )
    return texts


def _remaining(plan: MeasuringPlan) -> list[str]:
    found = []
    for r in plan.find_remaining():
        parts = ", ".join(f"{n} {t:+.1f}" for n, t in r.parts[:5]) or "many small errors"
        found.append(f"{plain(r.rms / UM, 1)} µm, from {parts} tolerances together.")
    return found


def _setups(plan: MeasuringPlan) -> RenderableType:
    s = plan.session
    table = table_of("setup", "what is read", "postures", left=3)
    for setup in list(s.setups.values())[:MOST_LISTED]:
        postures = [r.posture for r in s.readings if r.setup == setup.name]
        add_row(table, setup.name, setup.sensor.describe(), " ".join(postures))
    more = len(s.setups) - MOST_LISTED
    if more <= 0:
        return table
    return Group(table, Padding(Text(f"and {more} more"), (0, 0, 0, 2)))


def _um(expected: Expected) -> str:
    value = expected.headline.rms / UM
    return plain(value, 0 if value >= 20.0 else 1)


def _hours(minutes: float) -> str:
    return f"{minutes:.0f} min" if minutes < 2.0 * HOUR else f"{minutes / HOUR:.1f} h"
