"""Scenes of a robot, of a session and of a calibration.

A calibration shows the machine that the controller takes for granted as a pale ghost, and the
calibrated one solid: where it really is when it is sent there. Their deviation is drawn larger, by
a factor that the scene states. Gauges stand where they stood; arrows along what they measure are
as long as the deviations before and the residuals after, by a factor of their own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import meshcat.geometry as g
import numpy as np
from numpy.typing import NDArray

from orthocal.errors import ClosureError, ParameterError
from orthocal.identification.calibration import Calibration
from orthocal.measurement.session import DIRECTIONS, Session, Setup, section_plane
from orthocal.output.deviations import (
    Deviation,
    Measurement,
    Stop,
    measurement_of_calibration,
    measurement_of_session,
    plan_stops,
    worst_of_setups,
)
from orthocal.output.layout import signed, um
from orthocal.output.motion import (
    Film,
    Timeline,
    exaggerate,
    find_largest_shift,
    place_frames,
    plan_motion,
)
from orthocal.output.scene import Label, LegendEntry, Scene, Step, round_scale
from orthocal.output.shapes import Colour, arrow_parts, draw_arrow, draw_gauge, material, to_triple
from orthocal.output.stage import GHOST_COLOUR, LINE_COLOUR, LINES, VIEW, Stage
from orthocal.robot.assembly import Assembly, nominal_assembly
from orthocal.robot.model import Robot
from orthocal.study.accuracy import ToolAccuracy, assess_tool, cube

Array = NDArray[np.float64]

SHOWN = ("readings", "tool", "all")

LARGEST_DEVIATION = 0.05
"""Part of the machine's size that its largest deviation is drawn as."""

LONGEST_ARROW = 0.16
"""Part of the machine's size that the longest arrow at a gauge is drawn as."""

LONGEST_TOOL_ARROW = 0.08
"""Part of the machine's size that the largest error of the tool is drawn as."""

NOTHING = 1e-9
"""Deviations below this are none, [m]."""

VANISHING = 1e-7
"""Errors of the tool below this are not drawn, [m]."""

MOST_LABELS = 8
"""Gauges above which the overview names the worst of each leg and direction only."""

MACHINE = "Machine"
GHOST = "Machine, nominal (ghost)"
SOLID = "Machine, calibrated"
GAUGES = "Gauges"
BEFORE = "Readings before"
AFTER = "Readings after"
TOOL_NOW = "Tool error now"
TOOL_LEFT = "Tool error, offsets entered"
TOOL_UNKNOWN = "Tool error, not known"

BEFORE_COLOUR: Colour = (0.93, 0.62, 0.0)
AFTER_COLOUR: Colour = (0.0, 0.40, 0.72)
TOOL_NOW_COLOUR: Colour = (0.84, 0.37, 0.0)
TOOL_LEFT_COLOUR: Colour = (0.25, 0.62, 0.90)
UNKNOWN_COLOUR: Colour = (0.45, 0.40, 0.65)


@dataclass(frozen=True, slots=True, eq=False)
class _Machines:
    """The nominal and the real machine in all frames of a motion."""

    timeline: Timeline
    nominal: Mapping[str, Array]
    """Frame to poses, shape (F, 4, 4), [m]."""
    real: Mapping[str, Array]
    """The same; as drawn, with the deviation made larger."""
    exaggeration: float
    largest: float
    """Largest deviation of any frame, [m]."""
    where: str
    """Which frame that is."""


def draw_scene(
    subject: Calibration | Session | Robot,
    *,
    posture: str | None = None,
    exaggeration: float | None = None,
    show: str = "readings",
) -> Scene:
    """A scene of a calibration, a session or a robot.

    Args:
        subject: What to draw.
        posture: Where the machine stands; by default at the mechanical zero, from where it can be
            played through the measurement.
        exaggeration: How many times its size the deviation of the calibrated machine is drawn; 1
            for true scale. By default as large as can be seen well.
        show: What of a calibration is shown at first: "readings", "tool" (its errors), or "all".

    Raises:
        ParameterError: If there is no such posture, the exaggeration is not positive, or there is
            no such thing to show.
        RobotError: If the robot's visuals cannot be loaded.
        ClosureError: If the machine cannot reach a posture.
    """
    if exaggeration is not None and not (math.isfinite(exaggeration) and exaggeration > 0.0):
        raise ParameterError(
            f"is {exaggeration:g}; expected a positive number", where="exaggeration"
        )
    if show not in SHOWN:
        raise ParameterError(f"'{show}' is none of {', '.join(SHOWN)}", where="show")
    if isinstance(subject, Robot):
        return _draw_robot(subject, posture)
    if isinstance(subject, Session):
        return _draw_session(subject, posture)
    return _draw_calibration(subject, posture, exaggeration, show)


# ---- a robot alone


def _draw_robot(robot: Robot, posture: str | None) -> Scene:
    if posture is not None:
        raise ParameterError("a robot alone has no postures; it takes a session", where="posture")
    stage = Stage(robot, f"{robot.name}: the nominal machine")
    stops = _tour(robot)
    timeline = plan_motion([s.drives for s in stops])
    poses = _follow(robot, nominal_assembly(robot), timeline, stage.frames)
    stage.draw_links(MACHINE, poses)
    stage.scene.explain(LegendEntry("Machine", (MACHINE,), _css((0.5, 0.52, 0.55)), "solid"))
    if robot.legs:
        stage.draw_leg_lines(poses)
        _explain_lines(stage.scene)
    film = Film()
    stage.move_links(film, MACHINE, timeline.times, poses)
    stage.move_leg_lines(film, timeline.times, poses)
    _write_steps(stage.scene, stops, timeline, [f"{s.name}" for s in stops])
    stage.scene.animate(film.animation)
    drives = ", ".join(
        f"{d.name} {d.zero * (1e3 if d.unit == 'm' else 1.0):g} {'mm' if d.unit == 'm' else 'rad'}"
        for d in robot.drives
    )
    stage.scene.facts.insert(0, f"Mechanical zero: {drives}.")
    loops = f"{len(robot.closures)} closed loop{'' if len(robot.closures) == 1 else 's'}"
    stage.scene.headline = f"{len(robot.drives)} drives, {loops}"
    return stage.scene


def _tour(robot: Robot) -> list[Stop]:
    """The zero, and every drive moved some way to either end of its travel, if it can."""
    zero = robot.drive_zero
    stops = [Stop("mechanical zero", zero, ())]
    for i, drive in enumerate(robot.drives):
        for end, word in ((drive.lower, "down"), (drive.upper, "up")):
            reach = end - drive.zero
            if not math.isfinite(reach):
                reach = math.copysign(0.3, end)
            target = np.array(zero)
            target[i] += 0.4 * reach
            try:
                nominal_assembly(robot).close(target)
            except ClosureError:
                continue  # that far it does not go
            stops += [Stop(f"{drive.name} {word}", target, ()), stops[0]]
    return stops


# ---- a session


def _draw_session(session: Session, posture: str | None) -> Scene:
    robot, measured = session.robot, measurement_of_session(session)
    stage = Stage(robot, session.title)
    stops, left_out = plan_stops(measured, posture)
    timeline = plan_motion([s.drives + measured.offsets for s in stops])
    poses = _follow(robot, nominal_assembly(robot), timeline, stage.frames)
    stage.draw_links(MACHINE, poses)
    stage.draw_leg_lines(poses)
    scene = stage.scene
    scene.explain(LegendEntry("Machine, nominal", (MACHINE,), _css((0.5, 0.52, 0.55)), "solid"))
    _explain_lines(scene)
    film = Film()
    stage.move_links(film, MACHINE, timeline.times, poses)
    stage.move_leg_lines(film, timeline.times, poses)
    _draw_readings(stage, measured, stops, timeline, poses, film)
    scene.headline = _headline(measured)
    _finish(scene, film, session.source, stops, left_out)
    return scene


# ---- a calibration


def _draw_calibration(
    calibration: Calibration, posture: str | None, exaggeration: float | None, show: str
) -> Scene:
    measured = measurement_of_calibration(calibration)
    title = f"{calibration.session.title} · model '{calibration.model}'"
    stage = Stage(measured.robot, title)
    scene = stage.scene
    stops, left_out = plan_stops(measured, posture)
    machines = _place_machines(calibration, measured, stops, stage, exaggeration)
    scene.exaggeration = machines.exaggeration
    stage.draw_links(SOLID, machines.real)
    stage.draw_links(GHOST, machines.nominal, ghost_of=machines.real)
    stage.draw_leg_lines(machines.real)
    _explain_machines(scene, machines)
    film = Film()
    times = machines.timeline.times
    stage.move_links(film, SOLID, times, machines.real)
    stage.move_links(film, GHOST, times, machines.nominal)
    stage.move_leg_lines(film, times, machines.real)
    readings, tool = show in ("readings", "all"), show in ("tool", "all")
    _draw_readings(stage, measured, stops, machines.timeline, machines.real, film, shown=readings)
    _draw_tool_errors(stage, calibration, shown=tool)
    scene.headline = _headline(measured)
    _finish(scene, film, calibration.session.source, stops, left_out)
    return scene


def _place_machines(
    calibration: Calibration,
    measured: Measurement,
    stops: Sequence[Stop],
    stage: Stage,
    exaggeration: float | None,
) -> _Machines:
    """Where the controller takes the links to be, and where they are, in every frame."""
    robot = measured.robot
    timeline = plan_motion([s.drives for s in stops])
    believed = Timeline(timeline.drives + measured.offsets, timeline.times, timeline.stops)
    nominal = _follow(robot, nominal_assembly(robot), believed, stage.frames)
    assembly = Assembly(robot, fixed=calibration.errors)
    real = _follow(robot.with_errors(calibration.errors), assembly, timeline, stage.frames)
    largest, where = find_largest_shift(nominal, real)
    if exaggeration is None:
        wanted = LARGEST_DEVIATION * stage.size / largest if largest > NOTHING else 1.0
        exaggeration = round_scale(wanted)
    drawn = {name: exaggerate(nominal[name], real[name], exaggeration) for name in real}
    return _Machines(timeline, nominal, drawn, exaggeration, largest, where)


def _explain_machines(scene: Scene, machines: _Machines) -> None:
    scene.explain(LegendEntry("Machine as calibrated", (SOLID,), _css((0.5, 0.52, 0.55)), "solid"))
    if machines.largest > NOTHING:
        scene.explain(
            LegendEntry("Machine as the controller takes it", (GHOST,), _css(GHOST_COLOUR), "ghost")
        )
    _explain_lines(scene)
    if machines.largest <= NOTHING:
        scene.facts.insert(0, "The machine is where the controller takes it to be.")
        return
    size = f"largest {machines.largest * 1e3:.3f} mm, at {machines.where}"
    if machines.exaggeration == 1.0:
        scene.facts.insert(0, f"Machine: true scale ({size}).")
    else:
        scene.facts.insert(0, f"Machine: deviation × {machines.exaggeration:g} ({size}).")


def _explain_lines(scene: Scene) -> None:
    scene.explain(LegendEntry("Leg, from its root to its tip", (LINES,), _css(LINE_COLOUR), "line"))


# ---- gauges and what they read


def _draw_readings(
    stage: Stage,
    measured: Measurement,
    stops: Sequence[Stop],
    timeline: Timeline,
    poses: Mapping[str, Array],
    film: Film,
    *,
    shown: bool = True,
) -> None:
    """Gauges, and arrows and labels for what they read at every stop."""
    scene, size = stage.scene, stage.size
    used = [measured.setups[name] for name in dict.fromkeys(r.setup for r in measured.rows)]
    longest = max((max(abs(r.before), abs(r.after or 0.0)) for r in measured.rows), default=0.0)
    calibrated = any(r.after is not None for r in measured.rows)
    scene.arrow_scale = round_scale(LONGEST_ARROW * size / longest) if longest > NOTHING else 1.0
    dial = 0.034 * size * min(1.0, math.sqrt(9.0 / max(len(used), 1)))
    width = 0.28 * dial
    kinds = [(BEFORE, BEFORE_COLOUR, -1.0), (AFTER, AFTER_COLOUR, 1.0)]
    kinds = kinds[: 0 if measured.planned else 2 if calibrated else 1]
    named = _named_setups(used, measured)
    for setup in used:
        contact = _find_contact(stage, setup, poses)
        direction = np.array(DIRECTIONS[setup.direction])
        name = _node(setup.name)
        draw_gauge(scene, f"{GAUGES}/{name}", contact, direction, _facing(direction), dial)
        rows = [next((r for r in s.rows if r.setup == setup.name), None) for s in stops]
        for node, colour, side in kinds:
            lengths = [_length(r, node) * scene.arrow_scale for r in rows]
            beside = side * 1.5 * width * measured.robot.legs[setup.leg].axis
            path = f"{node}/{name}"
            draw_arrow(
                scene,
                path,
                contact + beside,
                direction,
                length=lengths[0],
                width=width,
                colour=colour,
            )
            _film_arrow(film, path, timeline, lengths, width)
        scene.labels.append(
            Label(
                to_triple(contact),
                tuple(
                    ""
                    if r is None or (s is stops[0] and setup.name not in named)
                    else _label(r, measured)
                    for r, s in zip(rows, stops, strict=True)
                ),
                f"{GAUGES}/{name}",
                rank=max(abs(r.before) for r in measured.rows if r.setup == setup.name),
            )
        )
    _explain_readings(scene, len(kinds), shown)
    captions = [_caption(s, measured, overview=len(stops) > 1 and s is stops[0]) for s in stops]
    _write_steps(scene, stops, timeline, captions)


def _named_setups(used: Sequence[Setup], measured: Measurement) -> set[str]:
    """Setups that the overview names: of many the worst of each leg and direction."""
    if len(used) <= MOST_LABELS:
        return {s.name for s in used}
    worst: dict[tuple[str, str], Deviation] = {}
    for row in worst_of_setups(measured.rows):
        setup = measured.setups[row.setup]
        key = (setup.leg, setup.direction.strip("-"))
        if key not in worst or abs(row.before) > abs(worst[key].before):
            worst[key] = row
    return {row.setup for row in worst.values()}


def _find_contact(stage: Stage, setup: Setup, poses: Mapping[str, Array]) -> Array:
    """Where the gauge touches the leg's line as it is drawn in the first frame, shape (3,), [m]."""
    leg = stage.robot.legs[setup.leg]
    plane, from_root = section_plane(stage.robot, setup)
    if from_root:
        plane = plane + float(leg.axis @ leg.zero_root)
    root, tip = (poses[frame][0][:3, 3] for frame in (leg.root, leg.tip))
    along = (plane - leg.axis @ root) / (leg.axis @ (tip - root))
    return np.asarray(root + along * (tip - root))


def _facing(direction: Array) -> Array:
    """Way along an axis of the world across a direction that the camera sees best, shape (3,)."""
    view = np.where(np.abs(direction) > 0.5, 0.0, VIEW)
    axis = int(np.abs(view).argmax())
    return np.asarray(np.eye(3)[axis] * np.sign(view[axis]))


def _length(row: Deviation | None, node: str) -> float:
    if row is None:
        return 0.0
    return row.before if node == BEFORE else (row.after or 0.0)


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


def _label(row: Deviation, measured: Measurement) -> str:
    if measured.planned:
        return row.setup
    after = "" if row.after is None else f" → {_mm(row.after)}"
    return f"{row.setup} {_mm(row.before)}{after} mm\n{row.where}"


def _caption(stop: Stop, measured: Measurement, *, overview: bool) -> str:
    if overview:
        return (
            "Overview at the zero: where the gauges will stand"
            if measured.planned
            else "Overview at the zero: the largest deviation that each gauge saw"
        )
    if not stop.rows:
        return f"{stop.name}: nothing read here"
    legs = ", ".join(sorted({measured.setups[r.setup].leg for r in stop.rows}))
    readings = "; ".join(_label(r, measured).split("\n")[0] for r in stop.rows)
    return f"{stop.name}, leg {legs}: {readings}"


def _explain_readings(scene: Scene, kinds: int, shown: bool) -> None:
    """Legend and scale of gauges and of so many kinds of arrows at them."""
    dark = _css((0.16, 0.17, 0.2))
    scene.explain(LegendEntry("Gauges", (GAUGES,), dark, "solid", shown))
    if kinds == 0:
        return
    scene.explain(
        LegendEntry("Before: measured − nominal", (BEFORE,), _css(BEFORE_COLOUR), "arrow", shown)
    )
    if kinds == 2:
        text = "After: measured − calibrated"
        scene.explain(LegendEntry(text, (AFTER,), _css(AFTER_COLOUR), "arrow", shown))
    scene.facts.insert(-1, f"Arrows at the gauges: × {scene.arrow_scale:g}.")


def _headline(measured: Measurement) -> str:
    """Which leg is not parallel, by how much, where; and after."""
    worst = max(measured.rows, key=lambda r: abs(r.before))
    if measured.planned:
        postures = len({r.posture for r in measured.rows})
        return f"A plan: {len(measured.rows)} readings in {postures} postures, none taken yet."
    if abs(worst.before) < NOTHING:
        return "All legs are parallel to their axes: no gauge has seen anything."
    leg = measured.setups[worst.setup].leg
    text = (
        f"Leg {leg} is furthest from parallel: {_mm(worst.before)} mm at gauge "
        f"{worst.setup}, {worst.where}."
    )
    if worst.after is None:
        return text
    largest = max(abs(r.after) for r in measured.rows if r.after is not None)
    return (
        f"{text} Calibrated: {_mm(worst.after)} mm there, at most {largest * 1e3:.3f} mm anywhere."
    )


# ---- errors of the tool over the workspace


def _draw_tool_errors(stage: Stage, calibration: Calibration, *, shown: bool) -> None:
    """Where the tool goes instead of where it is sent, now and with the offsets entered."""
    scene, robot = stage.scene, calibration.robot
    if robot.tcp is None:
        return
    try:
        found = assess_tool(calibration, cube(robot, points_a_side=3))
    except ClosureError:
        scene.facts.append("Errors of the tool: the cube of ±60 mm is out of reach.")
        return
    unknown = None if found.after is None else found.after.covariance
    now, left = (np.linalg.norm(d, axis=1).max() for d in (found.deviation, found.left))
    spread = 0.0 if unknown is None else math.sqrt(np.linalg.eigvalsh(unknown).max())
    largest = max(float(now), float(left), spread)
    if largest < NOTHING:
        return
    scene.tool_scale = round_scale(LONGEST_TOOL_ARROW * stage.size / largest)
    width = 0.006 * stage.size
    for node, deviations, colour in (
        (TOOL_NOW, found.deviation, TOOL_NOW_COLOUR),
        (TOOL_LEFT, found.left, TOOL_LEFT_COLOUR),
    ):
        _draw_deviations(scene, node, found, deviations, colour, width)
    text = f"Tool now: up to {um(float(now))} µm off"
    scene.explain(LegendEntry(text, (TOOL_NOW,), _css(TOOL_NOW_COLOUR), "arrow", shown))
    if left > VANISHING:
        text = f"Tool with the offsets entered: up to {um(float(left))} µm off"
        scene.explain(LegendEntry(text, (TOOL_LEFT,), _css(TOOL_LEFT_COLOUR), "arrow", shown))
    if unknown is not None:
        _draw_ellipsoids(scene, found, unknown)
        text = f"Tool: not known, one σ: up to {um(spread)} µm"
        scene.explain(LegendEntry(text, (TOOL_UNKNOWN,), _css(UNKNOWN_COLOUR), "ball", shown))
    scene.facts.insert(-1, f"Errors of the tool, over ±60 mm: × {scene.tool_scale:g}.")


def _draw_deviations(
    scene: Scene, node: str, found: ToolAccuracy, deviations: Array, colour: Colour, width: float
) -> None:
    for i, (target, deviation) in enumerate(zip(found.targets, deviations, strict=True)):
        length = float(np.linalg.norm(deviation))
        if length > VANISHING:
            draw_arrow(
                scene,
                f"{node}/point {i + 1}",
                target,
                deviation / length,
                length=length * scene.tool_scale,
                width=width,
                colour=colour,
            )


def _draw_ellipsoids(scene: Scene, found: ToolAccuracy, covariances: Array) -> None:
    """One standard deviation of the tool's position, around where it is taken to be at best."""
    for i, (target, covariance) in enumerate(zip(found.targets, covariances, strict=True)):
        values, vectors = np.linalg.eigh(covariance)
        if np.linalg.det(vectors) < 0.0:
            vectors[:, 0] = -vectors[:, 0]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = vectors, target
        radii = scene.tool_scale * np.sqrt(np.maximum(values, 1e-18))
        path = f"{TOOL_UNKNOWN}/point {i + 1}"
        scene.add(path, g.Sphere(1.0), material(UNKNOWN_COLOUR, opacity=0.3))
        scene.place(path, pose @ np.diag([*radii, 1.0]))


# ---- small things


def _follow(
    robot: Robot, assembly: Assembly, timeline: Timeline, frames: Sequence[str]
) -> dict[str, Array]:
    """Poses of frames in all frames of a motion, loops closed."""
    passive = assembly.close(timeline.drives)
    return place_frames(robot, timeline.drives, passive, frames)


def _write_steps(
    scene: Scene, stops: Sequence[Stop], timeline: Timeline, captions: Sequence[str]
) -> None:
    for i, (stop, caption) in enumerate(zip(stops, captions, strict=True)):
        scene.steps.append(Step(stop.name, caption, *timeline.interval(i)))


def _finish(scene: Scene, film: Film, source: str, stops: Sequence[Stop], left_out: int) -> None:
    """Animate, and say what has to be said of it, and where the readings are from."""
    if len(stops) > 1:
        scene.animate(film.animation)
    if left_out:
        shown = len(stops) - 2
        scene.facts.append(f"The animation stops at {shown} of {shown + left_out} postures.")
    if source:
        scene.facts.append(f"Source: {source}")


def _mm(value: float) -> str:
    return signed(value * 1e3).replace("-", "−")


def _node(name: str) -> str:
    """A setup's name as a node's: a slash would be a level."""
    return name.replace("/", "∕")


def _css(colour: Colour) -> str:
    return "#" + "".join(f"{round(255 * c):02x}" for c in colour)
