"""Gauges in a scene, arrows as long as what they read, labels, and which leg is not parallel."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.kinematics.robot_functions import reference_poses
from orthocal.output.scene.deviations import (
    Deviation,
    Measurement,
    Place,
    Stop,
    worst_of_setups,
)
from orthocal.output.text.layout import counted, list_places, short_name, typeset
from orthocal.sensors.protocol import Contact, TouchingTip
from orthocal.session.session import Setup
from orthocal.units import MM
from orthocal.viewer.motion import Film, Timeline
from orthocal.viewer.scene import Label, LegendEntry, Scene, Step, node_name, round_scale
from orthocal.viewer.shapes import (
    Colour,
    arrow_parts,
    css,
    dial_distance,
    draw_arrow,
    draw_gauge,
    to_triple,
)
from orthocal.viewer.stage import VIEW, Stage

Array = NDArray[np.float64]

GAUGES = "Gauges"
BEFORE = "Readings before"
AFTER = "Readings after"

BEFORE_COLOUR: Colour = (0.93, 0.62, 0.0)
AFTER_COLOUR: Colour = (0.0, 0.40, 0.72)
GAUGE_COLOUR: Colour = (0.16, 0.17, 0.2)

LONGEST_ARROW = 0.16
"""Part of the machine's size that the longest arrow at a gauge is drawn as."""

DIAL = 0.034
"""Part of the machine's size that a dial's radius is drawn as, where there are not too many."""

FIRST_ARROW, NEXT_ARROW = 0.42, 0.6
"""From a contact to the first arrow beside it, and from each to the next, in radii of a dial."""

MANY_GAUGES = 9
"""Gauges above which they are drawn smaller."""

MOST_LABELS = 8
"""Gauges above which the overview names the worst of each leg and direction only."""

LONGEST_LABEL = 16
"""Characters of a setup's name in a label."""

NOTHING = 1e-9

SQUARE = 1e-6
"""Cosine below which a direction is square to an axis of the world."""
"""Deviations below this are none, [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class _Kind:
    """Arrows of what was read before, or of what is left after."""

    node: str
    colour: Colour
    side: float
    """Which side of the gauge they stand on, along the leg: -1 or 1."""

    def length(self, row: Deviation | None) -> float:
        """What the arrow stands for, [m]."""
        if row is None:
            return 0.0
        return row.before if self.node == BEFORE else (row.after or 0.0)


def draw_readings(
    stage: Stage,
    measured: Measurement,
    stops: Sequence[Stop],
    timeline: Timeline,
    poses: Mapping[str, Array],
    film: Film,
    *,
    shown: bool = True,
) -> None:
    """Gauges, and arrows and labels for what they read at every stop.

    Args:
        stage: The robot's scene.
        measured: What was read.
        stops: Where the machine stops.
        timeline: When it does.
        poses: Frame to its poses as they are drawn, shape (F, 4, 4), [m].
        film: Takes how arrows change.
        shown: Whether all of this is shown at first.
    """
    scene = stage.scene
    used = [measured.setups[name] for name in dict.fromkeys(r.setup for r in measured.rows)]
    kinds = _find_kinds(measured)
    longest = max(abs(k.length(r)) for k in kinds for r in measured.rows) if kinds else 0.0
    if longest > NOTHING:
        scene.arrow_scale = round_scale(LONGEST_ARROW * stage.size / longest)
    dial = DIAL * stage.size * min(1.0, math.sqrt(MANY_GAUGES / max(len(used), 1)))
    overview = len(stops) > 1
    found = {s.name: _find_contact(stage, s, poses) for s in used}
    named = _named_setups(used, measured, found)
    contacts: list[Array] = []
    for setup in used:
        rows = [next((r for r in s.rows if r.setup == setup.name), None) for s in stops]
        contact, direction = found[setup.name].points[0], found[setup.name].direction
        gauge = f"{GAUGES}/{node_name(setup.name)}"
        touching = found[setup.name].tip
        draw_gauge(
            scene,
            gauge,
            contact,
            direction,
            _facing(direction),
            dial,
            ball=None if touching is None else touching.radius,
            edge=None if touching is None or touching.edge is None else _whole_edge(touching),
        )
        tips = [contact for _ in rows]
        # arrows of gauges that touch at the same place stand beside each other
        beside = sum(float(np.linalg.norm(contact - other)) < dial for other in contacts)
        contacts.append(contact)
        for kind in kinds:
            away = kind.side * (FIRST_ARROW + NEXT_ARROW * beside) * dial
            foot = contact + away * found[setup.name].along
            lengths = [kind.length(row) * scene.arrow_scale for row in rows]
            path, width = f"{kind.node}/{node_name(setup.name)}", arrow_width(dial)
            draw_arrow(
                scene,
                path,
                foot,
                direction,
                length=lengths[0],
                width=width,
                colour=kind.colour,
            )
            _film_arrow(film, path, timeline, lengths, width)
            stage.lower_ground(min(float(foot[2] + v * direction[2]) for v in lengths))
            if kind.node == BEFORE:
                tips = [foot + v * direction for v in lengths]
        # while another leg is measured its gauge is not there: the leg moves sideways
        there = [s.place is None or s.place == setup.sensor.place for s in stops]
        _film_presence(film, gauge, timeline, there)
        silent = overview and setup.name not in named
        texts = [
            "" if row is None or (silent and stop is stops[0]) else _label(row, measured)
            for row, stop in zip(rows, stops, strict=True)
        ]
        middle = contact + dial_distance(dial) * direction
        rim = [to_triple(middle + r * axis) for axis in np.eye(3) for r in (-dial, dial)]
        scene.labels.append(
            Label(
                (to_triple(middle),),
                tuple(texts),
                gauge,
                rank=max(abs(r.before) for r in measured.rows if r.setup == setup.name),
                uncovered=tuple((to_triple(contact), to_triple(tip), *rim) for tip in tips),
            )
        )
    _explain(scene, len(kinds), shown)
    captions = [_caption(s, measured) for s in stops]
    if overview:  # the last stop may be the first one again
        of_all = _overview(measured, shown)
        captions = [of_all if s is stops[0] else c for s, c in zip(stops, captions, strict=True)]
    write_steps(scene, stops, timeline, captions)


def arrow_width(dial: float) -> float:
    """Width of the arrows at a gauge whose dial has a radius, [m]."""
    return 0.28 * dial


def _find_kinds(measured: Measurement) -> tuple[_Kind, ...]:
    before, after = _Kind(BEFORE, BEFORE_COLOUR, -1.0), _Kind(AFTER, AFTER_COLOUR, 1.0)
    if measured.planned:
        return ()
    return (before, after) if any(r.after is not None for r in measured.rows) else (before,)


def _named_setups(
    used: Sequence[Setup], measured: Measurement, contacts: Mapping[str, Contact]
) -> set[str]:
    """Setups that the overview names: of many the worst of each place and direction."""
    if len(used) <= MOST_LABELS:
        return {s.name for s in used}
    worst: dict[tuple[Place, int], Deviation] = {}
    for row in worst_of_setups(measured.rows):
        axis = int(np.abs(contacts[row.setup].direction).argmax())
        key = (measured.place(row), axis)
        if key not in worst or abs(row.before) > abs(worst[key].before):
            worst[key] = row
    return {row.setup for row in worst.values()}


def _find_contact(stage: Stage, setup: Setup, poses: Mapping[str, Array]) -> Contact:
    """Where a sensor touches what is drawn in the first frame."""
    frames = setup.sensor.frames(stage.robot)
    at_zero = reference_poses(stage.robot, frames.at_zero)
    return setup.sensor.contact([poses[f][:1] for f in frames.in_posture], at_zero, stage.robot)


def _whole_edge(tip: TouchingTip) -> Array:
    """From one end of a blade's edge to the other, shape (3,), [m]."""
    return np.asarray(tip.width * (np.zeros(3) if tip.edge is None else tip.edge))


def _facing(direction: Array) -> Array:
    """Way across a direction that the camera sees best, shape (3,).

    Along an axis of the world where one is square to it.
    """
    square = np.abs(direction) < SQUARE
    if not square.any():
        across = np.array(VIEW) - np.dot(VIEW, direction) * direction
        return np.asarray(across / np.linalg.norm(across))
    view = np.where(square, VIEW, 0.0)
    axis = int(np.abs(view).argmax())
    return np.asarray(np.eye(3)[axis] * np.sign(view[axis]))


def _film_arrow(
    film: Film, path: str, timeline: Timeline, lengths: Sequence[float], width: float
) -> None:
    """Let an arrow have its length at every stop, and change it between."""
    times = np.array([timeline.times[f + k] for f in timeline.stops for k in (0, 1)])
    parts = [arrow_parts(v, width) for v in lengths for _ in (0, 1)]
    shafts, heads = np.array([p.shaft for p in parts]), np.array([p.head for p in parts])
    feet = np.array([[0.0, 0.0, p.foot] for p in parts])
    film.track(f"{path}/shaft", "scale", "vector3", times, shafts)
    film.track(f"{path}/head", "position", "vector3", times, feet)
    film.track(f"{path}/head", "scale", "vector3", times, heads)


def _film_presence(film: Film, path: str, timeline: Timeline, there: Sequence[bool]) -> None:
    """Let a node be there at some stops, and until the next one."""
    if not all(there):
        film.track(path, "visible", "bool", timeline.times[timeline.stops], np.array(there))


def _label(row: Deviation, measured: Measurement) -> str:
    name = short_name(row.setup, LONGEST_LABEL)
    if measured.planned:
        return name
    after = "" if row.after is None else f" → {_mm(row.after)}"
    return f"{name} {_mm(row.before)}{after} mm\n{short_name(row.where, 2 * LONGEST_LABEL)}"


def _overview(measured: Measurement, shown: bool) -> str:
    if not shown:
        return "Overview at the zero"
    if measured.planned:
        return "Overview at the zero: where the gauges will stand"
    return "Overview at the zero: the largest deviation that each gauge saw"


def _caption(stop: Stop, measured: Measurement) -> str:
    if not stop.rows and stop.taken_off:
        place = "" if stop.place is None else f", {list_places([stop.place])}"
        return f"{stop.name}{place}: taken off what is read at {', '.join(stop.taken_off)}"
    if not stop.rows:
        return f"{stop.name}: nothing is read here"
    places = list_places(measured.place(r) for r in stop.rows)
    readings = "; ".join(_label(r, measured).split("\n")[0] for r in stop.rows)
    return f"{stop.name}, {places}: {readings}"


def _explain(scene: Scene, kinds: int, shown: bool) -> None:
    """Legend and scale of gauges and of so many kinds of arrows at them."""
    scene.explain(LegendEntry("Gauges", (GAUGES,), css(GAUGE_COLOUR), "solid", shown))
    if kinds == 0:
        return
    drawn = f"× {scene.arrow_scale:g}"
    text = f"{'Measured' if kinds == 1 else 'Before: measured'} − nominal ({drawn})"
    scene.explain(LegendEntry(text, (BEFORE,), css(BEFORE_COLOUR), "arrow", shown))
    if kinds == 2:
        text = f"After: measured − calibrated ({drawn})"
        scene.explain(LegendEntry(text, (AFTER,), css(AFTER_COLOUR), "arrow", shown))


def write_headline(measured: Measurement) -> str:
    """Which leg is not parallel, by how much, where; and after the calibration."""
    worst = max(measured.rows, key=lambda r: abs(r.before))
    if measured.planned:
        postures = len({r.posture for r in measured.rows})
        readings = counted(measured.count, "reading")
        return f"A plan: {readings} in {counted(postures, 'posture')}, none taken yet."
    if abs(worst.before) < NOTHING:
        return "No gauge has seen any deviation."
    place = list_places([measured.place(worst)])
    mean = f", mean of {worst.cycles} cycles" if worst.cycles > 1 else ""
    text = (
        f"{place[0].upper()}{place[1:]} is furthest from "
        f"{measured.setups[worst.setup].sensor.ideal}: {_mm(worst.before)} mm at gauge "
        f"{worst.setup}, {worst.where}{mean}."
    )
    if worst.after is None or measured.largest_after is None:
        return text
    return (
        f"{text} Calibrated: {_mm(worst.after)} mm there; no reading is off by more than "
        f"{measured.largest_after / MM:.3f} mm."
    )


def write_steps(
    scene: Scene, stops: Sequence[Stop], timeline: Timeline, captions: Sequence[str]
) -> None:
    """Say when the animation stops where, and what is to be seen there."""
    for i, (stop, caption) in enumerate(zip(stops, captions, strict=True)):
        scene.steps.append(Step(stop.name, caption, *timeline.interval(i)))


def _mm(value: float) -> str:
    return typeset(value / MM)
