"""Gauges of a scene, arrows for their deviations, labels and captions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from orthocal.arrays import Array
from orthocal.assessment.wording import counted
from orthocal.kinematics.robot_functions import reference_poses
from orthocal.output.scene.deviations import Deviation, Measurement, Place, Stop, find_worst
from orthocal.output.text.layout import list_places, short_name, typeset
from orthocal.sensors.protocol import Contact, has_dial
from orthocal.session.session import Setup
from orthocal.units import MM
from orthocal.viewer.machine import VIEW, MachineScene
from orthocal.viewer.motion import Timeline
from orthocal.viewer.scene import Label, LegendEntry, Scene, Step, node_name, round_scale
from orthocal.viewer.shapes import (
    BAR,
    Colour,
    css,
    dial_distance,
    draw_arrow,
    draw_bar,
    draw_gauge,
    pose_along,
    to_triple,
)

GAUGES = "Gauges"
BEFORE = "Readings before"
AFTER = "Readings after"

COLOURS: dict[str, Colour] = {BEFORE: (0.93, 0.62, 0.0), AFTER: (0.0, 0.40, 0.72)}
"""Colour of the arrows by their node."""

GAUGE_COLOUR: Colour = (0.16, 0.17, 0.2)

LONGEST_ARROW = 0.16
"""Drawn length of the longest arrow at a gauge, relative to the machine."""

DIAL_RADIUS = 0.034
"""Radius of a dial, relative to the machine; smaller with many gauges."""

FIRST_ARROW, NEXT_ARROW = 0.42, 0.6
"""Distances from a contact to the first arrow and between arrows, in radii of a dial."""

BAR_BALL = 0.3
"""Radius of the balls of a bar, in radii of a dial."""

MAX_FULL_SIZE = 9
"""Most gauges that are drawn in full size."""

MAX_ALL_LABELLED = 8
"""Most gauges that the overview labels; of more, it labels the worst of each leg and direction."""

MAX_LABEL = 16
"""Most characters of a setup's name in a label."""

NEGLIGIBLE = 1e-9
"""Deviations below this are zero, [m]."""

PERPENDICULAR = 1e-6
"""Largest cosine between directions that count as perpendicular."""


def draw_readings(
    drawing: MachineScene,
    measured: Measurement,
    stops: Sequence[Stop],
    timeline: Timeline,
    poses: Mapping[str, Array],
    *,
    shown: bool = True,
) -> None:
    """Draw gauges, and arrows and labels for their deviations at every stop.

    Args:
        drawing: The scene of the machine.
        measured: The deviations.
        stops: The stops of the animation.
        timeline: The times of the stops.
        poses: Frame to drawn poses, shape (F, 4, 4), [m].
        shown: Whether gauges and arrows are initially visible.
    """
    scene, nodes = drawing.scene, _arrow_nodes(measured)
    setups = [measured.setups[name] for name in dict.fromkeys(r.setup for r in measured.rows)]
    contacts = {s.name: _find_contact(drawing, s, poses) for s in setups}
    longest = max((abs(_deviation(r, node)) for node in nodes for r in measured.rows), default=0.0)
    if longest > NEGLIGIBLE:
        scene.arrow_scale = round_scale(LONGEST_ARROW * drawing.size / longest)
    dial = DIAL_RADIUS * drawing.size * min(1.0, math.sqrt(MAX_FULL_SIZE / max(len(setups), 1)))
    labelled = _labelled_setups(setups, measured, contacts)
    for i, (setup, contact) in enumerate(zip(setups, contacts.values(), strict=True)):
        rows = [next((r for r in s.rows if r.setup == setup.name), None) for s in stops]
        gauge = _draw_gauge(drawing, setup, contact, dial)
        _animate_gauge(scene, gauge, setup, contact, stops, timeline)
        points, directions, across = _axes_at_stops(contact, timeline)
        # arrows of gauges with the same contact are drawn side by side
        others = (contacts[s.name].points[0] for s in setups[:i])
        count = sum(float(np.linalg.norm(points[0] - other)) < dial for other in others)
        shift = (FIRST_ARROW + NEXT_ARROW * count) * dial * across
        tips = points
        for node in nodes:
            feet = points + (shift if node == AFTER else -shift)
            lengths = np.array([_deviation(row, node) * scene.arrow_scale for row in rows])
            draw_arrow(
                scene,
                f"{node}/{node_name(setup.name)}",
                np.repeat(pose_along(feet, directions), 2, axis=0),
                np.repeat(lengths, 2),
                width=arrow_width(dial),
                colour=COLOURS[node],
                times=timeline.rests,
                in_front=_moves(contact),
            )
            ends = feet + lengths[:, None] * directions
            drawing.lower_ground(float(ends[:, 2].min()))
            tips = ends if node == BEFORE else tips
        texts = ["" if row is None else _label(row, measured) for row in rows]
        if len(stops) > 1 and setup.name not in labelled:  # the first and last stop is the overview
            texts[0] = texts[-1] = ""
        rank = max(abs(r.before) for r in measured.rows if r.setup == setup.name)
        scene.labels.append(_label_gauge(gauge, contact, dial, texts, points, tips, rank))
    _explain(scene, nodes, shown)
    write_steps(scene, stops, timeline, _captions(measured, stops, shown))


def _captions(measured: Measurement, stops: Sequence[Stop], shown: bool) -> list[str]:
    """Captions of all stops."""
    overview = "Overview at the mechanical zero"
    if shown:
        content = "places of the gauges" if measured.planned else "largest deviation at each gauge"
        overview = f"{overview}: {content}"
    # the last stop may be identical to the first one
    return [overview if len(stops) > 1 and s is stops[0] else _caption(s, measured) for s in stops]


def arrow_width(dial: float) -> float:
    """Width of the arrows at a gauge with a dial of a radius, [m]."""
    return 0.28 * dial


def _arrow_nodes(measured: Measurement) -> tuple[str, ...]:
    """Nodes of the arrows: before, and with a calibration also after; none for a plan."""
    if measured.planned:
        return ()
    return (BEFORE, AFTER) if any(r.after is not None for r in measured.rows) else (BEFORE,)


def _deviation(row: Deviation | None, node: str) -> float:
    """Deviation that an arrow shows, [m]."""
    if row is None:
        return 0.0
    return row.before if node == BEFORE else (row.after or 0.0)


def _moves(contact: Contact) -> bool:
    """True if the contact of a gauge moves with the tool; the others are fixed in space."""
    return contact.at_tool or contact.fixed is not None


def _stem(contact: Contact) -> Array:
    """Unit vector from the contact to the dial of a gauge without a fixed end, shape (3,)."""
    return -contact.direction if contact.at_tool else contact.direction


def _axes_at_stops(contact: Contact, timeline: Timeline) -> tuple[Array, Array, Array]:
    """Points of contact, directions of a growing reading, and directions across, at all stops.

    Returns:
        Points, [m], and unit vectors, each of shape (S, 3).
    """
    count = len(timeline.stops)
    points = contact.points[timeline.stops if _moves(contact) else np.zeros(count, dtype=int)]
    if contact.fixed is None:
        return points, np.tile(contact.direction, (count, 1)), np.tile(contact.along, (count, 1))
    bars = points - contact.fixed
    directions = bars / np.linalg.norm(bars, axis=1, keepdims=True)
    return points, directions, pose_along(points, directions)[:, :3, 0]


def _draw_gauge(drawing: MachineScene, setup: Setup, contact: Contact, dial: float) -> str:
    """Draw the gauge of a setup, and return its node."""
    node, tip = f"{GAUGES}/{node_name(setup.name)}", contact.tip
    if contact.fixed is not None:
        draw_bar(drawing.scene, node, contact.fixed, contact.points[0], BAR_BALL * dial)
        return node
    stem = _stem(contact)
    draw_gauge(
        drawing.scene,
        node,
        contact.points[0],
        stem,
        _facing(stem),
        dial,
        ball=None if tip is None else tip.radius,
        edge=None if tip is None or tip.edge is None else tip.width * tip.edge,
        with_dial=has_dial(setup.sensor),
    )
    return node


def _animate_gauge(
    scene: Scene,
    node: str,
    setup: Setup,
    contact: Contact,
    stops: Sequence[Stop],
    timeline: Timeline,
) -> None:
    """Move a gauge with the tool, rotate a bar, and hide both in postures that they do not read.

    Args:
        scene: The scene.
        node: Node of the gauge.
        setup: Setup of the gauge.
        contact: Contact of the gauge in all frames of the animation.
        stops: The stops of the animation.
        timeline: Times of the frames and stops.
    """
    points = contact.points
    if contact.fixed is not None:
        ends = points - contact.fixed
        lengths = np.linalg.norm(ends, axis=1)
        poses = pose_along(np.tile(contact.fixed, (len(ends), 1)), ends / lengths[:, None])
        scene.move(f"{node}/{BAR}", timeline.times, poses)
    elif contact.at_tool:
        scene.track(node, "position", "vector3", timeline.times, points)
    present = np.array([stop.has(setup) for stop in stops])
    if not present.all():
        scene.set_property(node, "visible", bool(present[0]))
        scene.track(node, "visible", "bool", timeline.times[timeline.stops], present)


def _label_gauge(
    node: str,
    contact: Contact,
    dial: float,
    texts: Sequence[str],
    points: Array,
    tips: Array,
    rank: float,
) -> Label:
    """Label at a dial or fixed ball that covers neither it, nor contact and tip of the arrow.

    Args:
        node: Node of the gauge.
        contact: Contact of the gauge.
        dial: Radius of the dial, [m].
        texts: Text at every stop.
        points: Point of contact at every stop, shape (S, 3), [m].
        tips: Tip of the arrow at every stop, shape (S, 3), [m].
        rank: Rank of the label.
    """
    if contact.fixed is None:
        middles, radius = points + dial_distance(dial) * _stem(contact), dial
    else:
        middles, radius = np.tile(contact.fixed, (len(points), 1)), BAR_BALL * dial
    rims = middles[:, None] + radius * np.concatenate([np.eye(3), -np.eye(3)])
    around = np.concatenate([points[:, None], tips[:, None], rims], axis=1)
    return Label(
        tuple(map(to_triple, middles)),
        tuple(texts),
        node,
        rank=rank,
        uncovered=tuple(tuple(map(to_triple, corners)) for corners in around),
    )


def _labelled_setups(
    setups: Sequence[Setup], measured: Measurement, contacts: Mapping[str, Contact]
) -> set[str]:
    """Names of setups that the overview labels; of many, the worst of each leg and direction."""
    if len(setups) <= MAX_ALL_LABELLED:
        return {s.name for s in setups}

    def place_and_axis(row: Deviation) -> tuple[Place, int]:
        return measured.place(row), int(np.abs(contacts[row.setup].direction).argmax())

    return {row.setup for row in find_worst(find_worst(measured.rows), place_and_axis)}


def _find_contact(drawing: MachineScene, setup: Setup, poses: Mapping[str, Array]) -> Contact:
    """Contact of a sensor with the drawn machine in all frames."""
    frames = setup.sensor.frames(drawing.robot)
    at_zero = reference_poses(drawing.robot, frames.at_zero)
    in_posture = [poses[f] for f in frames.in_posture]
    return setup.sensor.contact(in_posture, at_zero, drawing.robot)


def _facing(direction: Array) -> Array:
    """Direction towards the camera, perpendicular to another one; a world axis if possible."""
    perpendicular = np.abs(direction) < PERPENDICULAR
    if not perpendicular.any():
        across = np.array(VIEW) - np.dot(VIEW, direction) * direction
        return np.asarray(across / np.linalg.norm(across))
    view = np.where(perpendicular, VIEW, 0.0)
    axis = int(np.abs(view).argmax())
    return np.asarray(np.eye(3)[axis] * np.sign(view[axis]))


def _label(row: Deviation, measured: Measurement) -> str:
    """Label of a gauge at a stop."""
    name = short_name(row.setup, MAX_LABEL)
    if measured.planned:
        return name
    after = "" if row.after is None else f" → {_mm(row.after)}"
    return f"{name} {_mm(row.before)}{after} mm\n{short_name(row.where, 2 * MAX_LABEL)}"


def _caption(stop: Stop, measured: Measurement) -> str:
    """Caption of a stop with its readings."""
    if not stop.rows:
        place = "" if stop.place is None else f", {list_places([stop.place])}"
        minuends = ", ".join(stop.subtracted_from)
        subtracted = f"{stop.name}{place}: subtracted from the readings at {minuends}"
        return subtracted if minuends else f"{stop.name}: no reading"
    places = list_places(measured.place(r) for r in stop.rows)
    readings = "; ".join(_label(r, measured).split("\n")[0] for r in stop.rows)
    return f"{stop.name}, {places}: {readings}"


def _explain(scene: Scene, nodes: Sequence[str], shown: bool) -> None:
    """Add gauges, arrows and their scale to the legend."""
    scene.explain(LegendEntry("Gauges", (GAUGES,), css(GAUGE_COLOUR), "solid", shown))
    texts = {
        BEFORE: "Before: measured − nominal" if AFTER in nodes else "Measured − nominal",
        AFTER: "After: measured − calibrated",
    }
    for node in nodes:
        text = f"{texts[node]} (× {scene.arrow_scale:g})"
        scene.explain(LegendEntry(text, (node,), css(COLOURS[node]), "arrow", shown))


def write_headline(measured: Measurement) -> str:
    """Sentence with the largest deviation before and after the calibration, and its place."""
    worst = max(measured.rows, key=lambda r: abs(r.before))
    if measured.planned:
        postures = len({r.posture for r in measured.rows})
        readings = counted(measured.count, "reading")
        return f"A plan: {readings} in {counted(postures, 'posture')}, none measured yet."
    if abs(worst.before) < NEGLIGIBLE:
        return "No gauge shows a deviation."
    place = list_places([measured.place(worst)])
    mean = f", mean of {worst.cycles} cycles" if worst.cycles > 1 else ""
    text = (
        f"{place[0].upper()}{place[1:]} is furthest from "
        f"{measured.setups[worst.setup].sensor.ideal}: {_mm(worst.before)} mm in setup "
        f"{worst.setup}, {worst.where}{mean}."
    )
    if worst.after is None or measured.largest_after is None:
        return text
    return (
        f"{text} After calibration: {_mm(worst.after)} mm there, and at most "
        f"{measured.largest_after / MM:.3f} mm at any reading."
    )


def write_steps(
    scene: Scene, stops: Sequence[Stop], timeline: Timeline, captions: Sequence[str]
) -> None:
    """Add the stops of the animation with their captions."""
    for i, (stop, caption) in enumerate(zip(stops, captions, strict=True)):
        scene.steps.append(Step(stop.name, caption, *timeline.interval(i)))


def _mm(value: float) -> str:
    """Length in mm with sign."""
    return typeset(value / MM)
