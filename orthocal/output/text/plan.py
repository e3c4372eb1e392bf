"""Measuring plan as text, as plain data, and as a plot of the error over measuring time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.assessment.effect_limits import DETERMINED, EffectLimits
from orthocal.assessment.wording import counted, joined, name_offsets, tool_mm, um
from orthocal.assessment.words.entries import describe_aligned
from orthocal.io.documents import format_json
from orthocal.kinematics.conditions import stated_use
from orthocal.kinematics.reachable_box import find_workspace
from orthocal.measurement.motion.approach import (
    AS_ARROWS_SHOW,
    approach_length,
    approach_rule,
    describe_approach,
)
from orthocal.measurement.motion.guidance import describe_mounting
from orthocal.output.sheet.gauge_position import name_tip
from orthocal.output.text.accuracy import (
    NOTICEABLE,
    describe_gains,
    describe_remaining,
    describe_remedy,
)
from orthocal.output.text.layout import bullets, indented, section, table_of
from orthocal.planning.cost_curve import HOUR, HOURLY_GAIN, Stage
from orthocal.planning.equipment import Equipment
from orthocal.planning.expected_error import Criterion, Expected
from orthocal.planning.first_plan import FixedPlan
from orthocal.planning.further_readings import FurtherReadings
from orthocal.planning.owned_sensors import DIAL
from orthocal.planning.plan import MeasuringPlan
from orthocal.planning.plan_comparison import Alternative
from orthocal.planning.sensor_gains import SensorGain
from orthocal.robot.model import Robot
from orthocal.sensors.ball_bar import BallBar
from orthocal.sensors.leg_indicator import LegIndicator
from orthocal.sensors.points import Points
from orthocal.sensors.probe import Probe
from orthocal.sensors.tool_indicator import ToolIndicator
from orthocal.session.points import one_row_per_point
from orthocal.session.session import Reading, Session
from orthocal.text import capitalised, percent
from orthocal.units import DRIVE_UNITS, EDGE_UNITS, MM, UM

FORMS: dict[Criterion, str] = {
    "aligned": "RMS tool error, workpiece aligned on the machine",
    "relative": "RMS tool error, translation removed",
    "absolute": "RMS tool error, absolute",
    "worst": "tool error that weighs the worst points most, workpiece aligned on the machine",
    "A": "mean variance of the errors, in prior standard deviations",
    "D": "determinant of the covariance of the errors, in prior standard deviations",
}
"""Criteria in words."""

PLAN_BASIS = {"travel": "travel", "workspace_mm": "workspace"}
"""Keys of plan.json for the properties of the machine on which a plan depends, with words."""

ALIKE = 0.03
"""Relative difference of durations and errors below which a plan is as good as another one."""

SOME_LOST = 0.01
"""Fraction of impossible readings above which the plan says so."""

MOST_LISTED = 24
"""Largest number of setups that are listed one by one."""

KNOWN_ZERO = {BallBar.kind: "the ball bar", Probe.kind: "the probe"}
"""Sensors whose zero is known, with their nouns."""

PLACE_TOLERANCES = {BallBar.kind: ("centre_tolerance_mm", "length_tolerance_mm")}
"""Keys of sensors with a known zero for the tolerances that their range must hold."""

HOW_TO = {
    LegIndicator.kind: (
        "Dial at a leg: mount it in the first posture of its setup, where the sheet states the "
        "place of contact. The stated part of its length is that at the mechanical zero."
    ),
    BallBar.kind: (
        "Ball bar: fix one ball on the table at the stated place and clamp the other to the tool. "
        "Put the bar between them. The {programs} move along arcs around the fixed ball."
    ),
    ToolIndicator.kind: (
        "Indicator at the tool: clamp the dial to the tool and align the artefact with the axes of "
        "the machine by eye. It must not move until the setup is finished."
    ),
    Probe.kind: (
        "Probe: the {programs} stop above each posture. Move the probe towards the surface until "
        "it triggers. A reading is the height of the tip above the surface in the posture: the "
        "coordinate of the posture minus that at the trigger."
    ),
    Points.kind: (
        "Points: set up the instrument so that it sees the target in every posture, and fix the "
        "target at the tool. Read x, y and z in each posture."
    ),
}
"""Instructions for the kinds of sensor of a plan, with what moves the machine."""


def render_plan(plan: MeasuringPlan, *, details: bool = False) -> RenderableType:
    """Plan as rich renderables, its expected tool error first."""
    s, robot = plan.session, plan.session.robot
    remaining = describe_remaining(plan.find_remaining()) if details else []
    gains = plan.find_sensor_gains()
    helps = _helps(plan, gains)
    names = [*_unusable_names(plan), *plan.unchosen]
    absent = f", without {joined(names)}" if names else ""
    after = _second_measurement(plan, ", tool error after ")
    parts: list[RenderableType] = [
        Text(
            f"Plan for {robot.name}, model {plan.forecast.selection.label}: {describe_size(s)}, "
            f"about {show_duration(plan.minutes)}{absent}",
            style="bold",
        ),
        Text(),
        *map(Text, describe_expected(plan)),
        *map(Text, _undetermined(plan, gains)),
        Text(_when_enough(plan)),
        section(f"Other plans in the same time{after}", _alternatives(plan)),
        *([section(f"What would help{after}", bullets(helps))] if helps else []),
        *([section("Largest contributions", bullets(remaining))] if remaining else []),
        section("Setups", _setups(plan)),
        section("How to measure", bullets(_how_to_measure(plan))),
        *([Text(), *map(Text, describe_absent(plan))] if names else []),
    ]
    return Group(*parts)


def describe_assumed_tip(equipment: Equipment, session: Session) -> str:
    """Note that the tip of a gauge is assumed; "" if the plan does not depend on it."""
    sensors = [setup.sensor for setup in session.setups.values()]
    touches = any(isinstance(s, LegIndicator) and s.tip == equipment.tip for s in sensors)
    if equipment.tip is None or equipment.without_tip is None or not touches:
        return ""
    return (
        f"Gauge: {name_tip(equipment.tip)} (not stated in {equipment.without_tip}). State another "
        "tip there, such as tip: {blade: {width_mm: 20}}, and plan again."
    )


def describe_size(session: Session) -> str:
    """Numbers of readings and setups of a plan; readings are counted as on its sheet."""
    setups, first, closing = _count_rows(session)
    words = f" ({closing} closing)" if closing else ""
    return f"{counted(first + closing, 'reading')}{words} in {counted(setups, 'setup')}"


def _count_rows(session: Session) -> tuple[int, int, int]:
    """Numbers of setups, of readings, and of those that close a setup, as on the sheet."""
    session = one_row_per_point(session)
    closing = sum(r.cycle > 1 for r in session.readings)
    return len(session.setups), len(session.readings) - closing, closing


def describe_expected(plan: MeasuringPlan | FixedPlan) -> list[str]:
    """Expected tool error with its conditions, and the readings that are impossible at first."""
    first, workspace = plan.first_round, plan.forecast.workspace
    expected, before, now = (tool_mm(e.reported.rms) for e in (plan.expected, first, plan.before))
    corrected = "with all identified errors corrected"
    figures = (
        f": now {now}; {corrected} {before} after this measurement, {expected} after a second one"
    )
    if plan.complements_session:
        figures = (
            f" {corrected}: {expected} with these readings added, {now} with those of the session "
            "alone"
        )
    lines = [
        f"Expected tool error{figures}.",
        describe_aligned(workspace.words, stated_use(plan.forecast.robot)),
    ]
    if first.lost > SOME_LOST:
        lines.append(
            f"With offsets within their tolerances the tip misses the rod in {percent(first.lost)} "
            "of the readings. Enter offsets from a few readings first, or use a blade."
        )
    further = {(f.limit.effect, f.limit.unit): _describe_further(f) for f in plan.further}
    for effect in plan.effects:
        lines.append(_describe_limits(effect) + further.get((effect.effect, effect.unit), ""))
    return lines


def _undetermined(plan: MeasuringPlan | FixedPlan, gains: Sequence[SensorGain]) -> list[str]:
    """Offsets that the readings do not determine, and the sensor that helps, as sentences."""
    after = plan.expected
    stds = np.sqrt(np.diag(after.covariance))
    ratios = dict(zip(after.names, (stds / after.prior_stds).tolist(), strict=True))
    names = (d.name for d in plan.session.robot.drives)
    drives = [name for name in names if ratios.get(f"{name}.offset", 0.0) > DETERMINED]
    offsets = name_offsets(drives, firmware=False)
    return [describe_remedy(offsets, gains, after.reported.rms)] if drives else []


def describe_absent(plan: MeasuringPlan) -> list[str]:
    """Gauges that are not in the plan, and what to do, as sentences."""
    entered = plan.complements_session and bool(np.any(plan.session.active_offsets))
    kinds = {sensor.name: sensor.keys["sensor"] for sensor in plan.equipment.owned}
    unusable = dict(zip(_unusable_names(plan), plan.unusable.values(), strict=True))
    sentences = []
    for name, needed in {**unusable, **plan.unchosen}.items():
        keys = PLACE_TOLERANCES.get(kinds.get(name, ""), ())
        tolerances = f"tolerances ({joined(keys)})" if keys else "tolerances"
        remedies = [f"state smaller {tolerances}", "use a gauge of more range"]
        if not entered:
            remedies.append("enter offsets of other readings first and plan from their session")
        better = reach = ""
        if name not in unusable:
            better = " In this time other readings reduce the expected tool error more."
        if needed:
            whose = "its" if name in unusable else "many of its"
            reach = (
                f" Within the tolerances of machine, place and gauge {whose} readings reach "
                f"±{needed / MM:.1f} mm, beyond its range. To plan with it, "
                f"{joined(remedies, 'or')}."
            )
        sentences.append(f"Not in the plan: {name}.{better}{reach}")
    return sentences


def _unusable_names(plan: MeasuringPlan) -> list[str]:
    """Names of the gauges whose range is too small for their readings."""
    return [name or DIAL for name in plan.unusable]


def _describe_limits(effect: EffectLimits) -> str:
    """Limit of an effect before and after the readings, in a sentence."""
    before, after = (_limit_words(effect, v) for v in (effect.before, effect.after))
    name = capitalised(effect.words)
    if effect.determined:
        return f"{name}: known to ±{after} after these readings (tolerance ±{before})."
    return f"{name}: these readings do not determine it; it keeps its tolerance of ±{before}."


def _limit_words(effect: EffectLimits, limit: float) -> str:
    """A limit of an effect with its unit."""
    unit, factor = EDGE_UNITS[effect.unit]
    words = unit.replace("_per_", "/").replace("um/", "µm/")
    return tool_mm(limit) if words == "mm" else f"{limit / factor:.3g} {words}"


def _describe_further(further: FurtherReadings) -> str:
    """Readings that would determine an effect and what they bring, in a sentence."""
    if further.warmer:
        what = f"{counted(further.readings, 'further reading')}, {further.warmer:g} K warmer"
    else:
        what = (
            f"{counted(further.readings, 'further reading')} of the first postures, "
            f"{further.wait:g} min after the last reading of each setup"
        )
    after, duration = _limit_words(further.limit, further.limit.after), further.minutes
    only = "" if further.limit.determined else " only"
    percent = round(100.0 * further.gain)
    gain = f"reduce the tool error by {percent} %" if percent else "not reduce the tool error"
    return f" {what} ({show_duration(duration)}), would bring it to ±{after}{only} and {gain}."


def _how_to_measure(plan: MeasuringPlan) -> list[str]:
    """Instructions for the operator: for indicators at legs, and for each kind at the tool."""
    session = plan.session
    sensors = [setup.sensor for setup in session.setups.values()]
    first = {sensor.kind: sensor for sensor in reversed(sensors)}
    programs = "programs" if session.firmware is None else "lines to send"
    words = [HOW_TO[kind].format(programs=programs) for kind in HOW_TO if kind in first]
    zeros = {setup.zero for setup in session.setups.values()}
    if "free" in zeros:
        only = " of a setup" if zeros == {"free"} else " of a setup with an indicator"
        words.append(
            f"Go to the first posture{only} and set the dial to the middle of its range there."
        )
    fixed = {setup.sensor.kind for setup in session.setups.values() if setup.zero == "known"}
    if nouns := [noun for kind, noun in KNOWN_ZERO.items() if kind in fixed]:
        words.append(
            f"Do not set the zero of {joined(nouns)} on the machine: readings are absolute."
        )
    if rule := approach_rule(session):
        moving = f" The {programs} do this." if rule == AS_ARROWS_SHOW else ""
        words.append(f"{rule.format(approach_length(session))}{moving}")
    return [
        *words,
        "Read the first posture again at the end of the setup (cycle 2). This reveals drift.",
    ]


def describe_basis(robot: Robot) -> dict[str, Any]:
    """Properties of a machine on which a plan depends, by the keys of `PLAN_BASIS`.

    Travel is in mm or deg, with None for a drive without limit; the workspace is in mm.
    """
    travel = [
        [
            round(limit / DRIVE_UNITS[d.unit][1], 6) if math.isfinite(limit) else None
            for limit in (d.lower, d.upper)
        ]
        for d in robot.drives
    ]
    return {
        "travel": travel,
        "workspace_mm": np.round(find_workspace(robot).limits / MM, 6).tolist(),
    }


def plan_document(plan: MeasuringPlan) -> dict[str, Any]:
    """Plan as plain data: numbers in µm and minutes."""

    def sizes(e: Expected | None) -> dict[str, float | None]:
        if e is None:
            return dict.fromkeys(("aligned_um", "relative_um", "absolute_um", "worst_um"))
        a = e.sizes.aligned
        return {
            "aligned_um": None if a is None else a.rms / UM,
            "relative_um": e.sizes.relative.rms / UM,
            "absolute_um": e.sizes.absolute.rms / UM,
            "worst_um": e.reported.largest / UM,
        }

    def alternative(a: Alternative) -> dict[str, Any]:
        numbers = {name: getattr(a, name) for name in ("name", "setups", "readings", "minutes")}
        return {**numbers, "in_range": a.expected is not None, **sizes(a.expected)}

    def stage(s: Stage) -> dict[str, float]:
        return {**asdict(s), "error": s.error / _unit(plan)}

    setups, read, closing = _count_rows(plan.session)
    box = plan.forecast.workspace.box
    basis = describe_basis(plan.session.robot)
    return {
        "robot": plan.session.robot.name,
        "model": plan.forecast.selection.label,
        "criterion": plan.criterion,
        "travel": basis["travel"],
        "workspace_mm": None if box is None else np.round(box / MM, 6).tolist(),
        "setups": setups,
        "readings": read,
        "closing_readings": closing,
        "minutes": plan.minutes,
        "candidates": plan.candidates,
        "before": sizes(plan.before),
        "expected": sizes(plan.expected),
        "first_round": {**sizes(plan.first_round), "lost": plan.first_round.lost},
        "usual_plans": [alternative(a) for a in plan.usual_plans],
        "other_gauges": [alternative(a) for a in plan.other_gauges],
        "curve": [stage(s) for s in plan.curve],
        "enough": None if plan.enough is None else stage(plan.enough),
        "unusable_mm": {name: needed / MM for name, needed in plan.unusable.items()},
        "unchosen_mm": {name: needed / MM for name, needed in plan.unchosen.items()},
        "effects": [asdict(e) for e in plan.effects],
        "further_readings": [asdict(f) for f in plan.further],
        "remaining": [
            {"rms_um": r.rms / UM, "parts": [{"name": n, "prior_stds": t} for n, t in r.parts]}
            for r in plan.find_remaining()
        ],
    }


def plan_json(plan: MeasuringPlan) -> str:
    """Plan as JSON."""
    return format_json(plan_document(plan))


def draw_plan(plan: MeasuringPlan) -> str:
    """Expected error over measuring time, as an SVG file."""
    from orthocal.output.report.study_plots import plot_plan

    return plot_plan.document(plan, _unit(plan), _second_measurement(plan, "\nafter "))


def show_duration(minutes: float) -> str:
    """Duration in minutes or hours."""
    return f"{minutes:.0f} min" if minutes < 2.0 * HOUR else f"{minutes / HOUR:.1f} h"


def _unit(plan: MeasuringPlan) -> float:
    """Unit of the criterion of a plan: a micrometre, or 1."""
    return 1.0 if plan.criterion in ("A", "D") else UM


def _when_enough(plan: MeasuringPlan) -> str:
    """Number of setups beyond which another hour gains little, in a sentence."""
    if _unit(plan) != UM:
        return f"Criterion: {FORMS[plan.criterion]}."
    other = "" if plan.criterion == "aligned" else f" This is the {FORMS[plan.criterion]}."
    enough = plan.enough
    if enough is None:
        last = plan.curve[-1]
        return (
            f"More setups gain more than {percent(HOURLY_GAIN)} an hour: expect {um(last.error)} "
            f"µm instead of {um(plan.stage.error)} µm{_second_measurement(plan, ' after ')} "
            f"with {counted(last.setups, 'setup')} ({show_duration(last.minutes)}).{other}"
        )
    as_long = plan.stage.minutes < (1.0 + ALIKE) * enough.minutes
    if as_long and plan.stage.error < (1.0 + ALIKE) * enough.error:
        return f"Further setups gain less than {percent(HOURLY_GAIN)} an hour."
    return (
        f"With {counted(enough.setups, 'setup')} ({show_duration(enough.minutes)}) expect "
        f"{um(enough.error)} µm instead of {um(plan.stage.error)} µm"
        f"{_second_measurement(plan, ' after ')}. "
        f"More setups gain less than {percent(HOURLY_GAIN)} an hour.{other}"
    )


def _second_measurement(plan: MeasuringPlan, prefix: str) -> str:
    """Measurement after which tool errors of a first plan are stated; "" for a complement."""
    return "" if plan.complements_session else f"{prefix}a second measurement"


def _alternatives(plan: MeasuringPlan) -> RenderableType:
    setups, first, closing = _count_rows(plan.session)
    this = Alternative("this plan", setups, first + closing, plan.minutes, plan.expected)
    rows = []
    for a in (this, *plan.usual_plans):
        error = "beyond the dial's range"
        if a.expected is not None:
            error = um(a.expected.reported.rms)
        rows.append((a.name, str(a.setups), str(a.readings), show_duration(a.minutes), error))
    headers = ("plan", "setups", "readings", "time", "tool error [µm]")
    return table_of(headers, rows)


def _helps(plan: MeasuringPlan, gains: Sequence[SensorGain]) -> list[str]:
    """Other gauges and sensors that reduce the error, the best first."""
    mine = plan.expected.reported.rms
    sizes = {a.name: a.expected.reported.rms for a in plan.other_gauges if a.expected is not None}
    names = sorted(sizes, key=sizes.__getitem__)
    better = [n for n in names if sizes[n] < (1.0 - NOTICEABLE) * mine]
    texts = [f"The same readings with {n}: {tool_mm(sizes[n])}." for n in better]
    if names and not better:
        texts.append(f"None ({'; '.join(names)}) gains {percent(NOTICEABLE)}.")
    return texts + describe_gains(gains, mine)


def _posture(reading: Reading, robot: Robot) -> str:
    """Posture of a reading, with an arrow for its approach."""
    approach = reading.approach
    return reading.posture + ("" if approach is None else describe_approach(robot, approach))


def _setups(plan: MeasuringPlan) -> RenderableType:
    s = one_row_per_point(plan.session)
    aligned_at = s.alignment_postures
    rows = [
        (
            setup.name,
            describe_mounting(s.robot, setup.sensor, aligned_at[setup.name], brief=True),
            " ".join(_posture(r, s.robot) for r in s.readings if r.setup == setup.name),
        )
        for setup in list(s.setups.values())[:MOST_LISTED]
    ]
    table, more = table_of(("setup", "gauge", "postures"), rows, left=3), len(s.setups) - len(rows)
    return Group(table, indented(Text(f"and {more} more"))) if more else table
