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

import numpy as np
from numpy.typing import NDArray

from orthocal.assessment.controller_entries import find_entries
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ClosureError, ParameterError
from orthocal.kinematics.loop_closure import Assembly, nominal_assembly
from orthocal.output.scene.deviations import (
    Measurement,
    Stop,
    measurement_of_calibration,
    measurement_of_session,
    plan_stops,
)
from orthocal.output.scene.readings import draw_readings, write_headline, write_steps
from orthocal.output.scene.tool_errors import draw_tool_errors
from orthocal.output.text.layout import counted, typeset
from orthocal.robot.model import Robot, coordinate_units
from orthocal.robot.reference_posture import count_free_motions
from orthocal.session.session import Session
from orthocal.units import MM
from orthocal.viewer.motion import (
    Film,
    Timeline,
    exaggerate,
    find_largest_shift,
    place_frames,
    plan_motion,
)
from orthocal.viewer.scene import LegendEntry, Scene, round_scale
from orthocal.viewer.shapes import Colour, css
from orthocal.viewer.stage import GHOST_COLOUR, LINE_COLOUR, LINES, Stage

Array = NDArray[np.float64]

SHOWN = ("readings", "tool", "all")

LARGEST_DEVIATION = 0.05
"""Part of the machine's size that its largest deviation is drawn as."""

FURTHEST = 1.0
"""The same, at most."""

NOTHING = 1e-9
"""Deviations below this are none, [m]."""

FREE_REACH = 0.3
"""How far a drive without limits could go, for a robot that is shown, [rad] or characteristic
lengths."""

LARGEST_REACH = 1.0
"""How far any drive could, at most."""

MACHINE = "Machine"
GHOST = "Machine, nominal (ghost)"
SOLID = "Machine, calibrated"

SOLID_COLOUR: Colour = (0.5, 0.52, 0.55)
"""In the legend: a machine has many."""


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
    show: str | None = None,
) -> Scene:
    """A scene of a calibration, a session or a robot.

    Args:
        subject: What to draw.
        posture: Where the machine stands; by default at the mechanical zero, from where it can be
            played through the measurement.
        exaggeration: How many times its size the deviation of the calibrated machine is drawn; 1
            for true scale. By default as large as can be seen well.
        show: What of a calibration is shown at first: "readings", which is what else there is,
            "tool" (its errors), or "all".

    Raises:
        ParameterError: If there is no such posture, nothing deviates or by no positive factor, or
            there is no such thing to show.
        TypeError: If the subject is none of these.
        RobotError: If the robot's visuals cannot be loaded.
        ClosureError: If the machine cannot reach a posture.
    """
    if exaggeration is not None and not (math.isfinite(exaggeration) and exaggeration > 0.0):
        raise ParameterError(
            f"is {exaggeration:g}; expected a positive number", where="exaggeration"
        )
    if show is not None and show not in SHOWN:
        raise ParameterError(f"'{show}' is none of {', '.join(SHOWN)}", where="show")
    if show is not None and not isinstance(subject, Calibration):
        raise ParameterError("only a calibration has a choice of what is shown", where="show")
    if exaggeration is not None and not isinstance(subject, Calibration):
        raise ParameterError(
            "only a calibration has a machine that deviates from another", where="exaggeration"
        )
    if isinstance(subject, Robot):
        return _draw_robot(subject, posture)
    if isinstance(subject, Session):
        return _draw_session(subject, posture)
    if not isinstance(subject, Calibration):
        raise TypeError(
            f"found a {type(subject).__name__}; expected a Calibration, a Session or a Robot, such "
            "as load_calibration(...)"
        )
    return _draw_calibration(subject, posture, exaggeration, show or SHOWN[0])


# ---- a robot alone


def _draw_robot(robot: Robot, posture: str | None) -> Scene:
    if posture is not None:
        raise ParameterError("a robot alone has no postures; it takes a session", where="posture")
    stage = Stage(robot, f"{robot.name}: the nominal machine")
    stops = _tour(robot)
    timeline = plan_motion([s.drives for s in stops], count=_longest_tour(robot))
    poses = _follow(robot, nominal_assembly(robot), timeline, stage.frames, allow_free=True)
    stage.draw_links(MACHINE, poses)
    stage.look_at(poses)
    stage.scene.explain(LegendEntry("Machine", (MACHINE,), css(SOLID_COLOUR), "solid"))
    if robot.legs:
        stage.draw_leg_lines(poses, timeline.stops)
        _explain_lines(stage.scene)
    film = Film()
    stage.move_links(film, MACHINE, timeline.times, poses)
    stage.move_leg_lines(film, timeline.times, poses)
    write_steps(stage.scene, stops, timeline, [f"{s.name}" for s in stops])
    stage.scene.animate(film.animation)
    stage.scene.facts[:0] = _state_zero(robot)
    loops = counted(len(robot.closures), "closed loop")
    stage.scene.headline = f"{counted(len(robot.drives), 'drive')}, {loops}"
    return stage.scene


def _state_zero(robot: Robot) -> list[str]:
    """Where the machine stands, who says so, and what its loops leave free there."""
    drives = ", ".join(
        f"{d.name} {d.zero * (1e3 if d.unit == 'm' else 1.0):g} {'mm' if d.unit == 'm' else 'rad'}"
        for d in robot.drives
    )
    facts = [f"Mechanical zero: {drives}."]
    found = [d.name for d in robot.drives if d.zero_found]
    if found:
        facts.append(
            f"Found when the loops were closed, not given: the zero of {', '.join(found)}."
        )
    free = count_free_motions(robot)
    if free:
        loose = counted(free, "passive motion")
        facts.append(f"The loops leave {loose} free; where they stand is a choice.")
    return facts


def _tour(robot: Robot) -> list[Stop]:
    """The zero, and every drive moved some way to either end of its travel, if it can."""
    zero = robot.drive_zero
    reaches = np.where(coordinate_units(robot) == 1.0, robot.characteristic_length, 1.0)
    stops = [Stop("mechanical zero", zero, ())]
    for i, drive in enumerate(robot.drives):
        unit = float(reaches[robot.drive_index[i]])
        for end, word in ((drive.lower, "down"), (drive.upper, "up")):
            reach = end - drive.zero
            if not math.isfinite(reach):
                reach = math.copysign(FREE_REACH * unit, end)
            reach = math.copysign(min(abs(reach), LARGEST_REACH * unit), reach)
            target = _furthest(robot, i, 0.4 * reach)
            if target is not None:
                stops += [Stop(f"{drive.name} {word}", target, ()), stops[0]]
    return stops


def _longest_tour(robot: Robot) -> int:
    """Stops of a robot all of whose drives move."""
    return 1 + 4 * len(robot.drives)


def _furthest(robot: Robot, drive: int, move: float) -> Array | None:
    """Where a drive gets to by a move or a part of it, with loops that close in every frame."""
    zero = robot.drive_zero
    for part in (1.0, 0.5, 0.25):
        target = zero + part * move * np.eye(len(zero))[drive]
        way = plan_motion([zero, target, zero], count=_longest_tour(robot)).drives
        try:
            nominal_assembly(robot).close(way, allow_free=True)
        except ClosureError:
            continue  # that far it does not go
        return np.asarray(target)
    return None


# ---- a session


def _draw_session(session: Session, posture: str | None) -> Scene:
    robot, measured = session.robot, measurement_of_session(session)
    stage = Stage(robot, session.title, looked_at=_looked_at(measured))
    stops, left_out = plan_stops(measured, posture)
    timeline = plan_motion([s.drives + measured.offsets for s in stops])
    poses = _follow(robot, nominal_assembly(robot), timeline, stage.followed)
    stage.draw_links(MACHINE, poses)
    stage.draw_leg_lines(poses, timeline.stops)
    stage.look_at(poses)
    scene = stage.scene
    scene.explain(LegendEntry("Machine, nominal", (MACHINE,), css(SOLID_COLOUR), "solid"))
    _explain_lines(scene)
    film = Film()
    stage.move_links(film, MACHINE, timeline.times, poses)
    stage.move_leg_lines(film, timeline.times, poses)
    draw_readings(stage, measured, stops, timeline, poses, film)
    scene.headline = write_headline(measured)
    _finish(scene, film, session.source, stops, left_out)
    return scene


# ---- a calibration


def _draw_calibration(
    calibration: Calibration, posture: str | None, exaggeration: float | None, show: str
) -> Scene:
    measured = measurement_of_calibration(calibration)
    title = f"{calibration.session.title} · model '{calibration.model}'"
    stage = Stage(measured.robot, title, looked_at=_looked_at(measured))
    scene = stage.scene
    stops, left_out = plan_stops(measured, posture)
    machines = _place_machines(calibration, measured, stops, stage, exaggeration)
    scene.exaggeration = machines.exaggeration
    stage.draw_links(SOLID, machines.real)
    stage.draw_links(GHOST, machines.nominal, ghost_of=machines.real)
    stage.draw_leg_lines(machines.real, machines.timeline.stops)
    stage.look_at(machines.real, machines.nominal)
    _explain_machines(scene, machines)
    film = Film()
    times = machines.timeline.times
    stage.move_links(film, SOLID, times, machines.real)
    stage.move_links(film, GHOST, times, machines.nominal)
    stage.move_leg_lines(film, times, machines.real)
    readings, tool = show in ("readings", "all"), show in ("tool", "all")
    draw_readings(stage, measured, stops, machines.timeline, machines.real, film, shown=readings)
    of_tool = draw_tool_errors(stage, calibration, shown=tool)
    scene.headline = of_tool if of_tool and not readings else write_headline(measured)
    _state_offsets(scene, calibration)
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
    nominal = _follow(robot, nominal_assembly(robot), believed, stage.followed)
    assembly = Assembly(robot, fixed=calibration.errors)
    real = _follow(robot.with_errors(calibration.errors), assembly, timeline, stage.followed)
    largest, where = _find_largest(measured, assembly, calibration, stage)
    if exaggeration is None:
        wanted = LARGEST_DEVIATION * stage.size / largest if largest > NOTHING else 1.0
        exaggeration = round_scale(wanted)
    if exaggeration * largest > FURTHEST * stage.size:
        raise ParameterError(
            f"is {exaggeration:g}; the largest deviation of {largest / MM:.3g} mm would be drawn "
            f"larger than the machine: expected at most {stage.size / largest:.0f}",
            where="exaggeration",
        )
    drawn = {name: exaggerate(nominal[name], real[name], exaggeration) for name in real}
    return _Machines(timeline, nominal, drawn, exaggeration, largest, where)


def _find_largest(
    measured: Measurement, assembly: Assembly, calibration: Calibration, stage: Stage
) -> tuple[float, str]:
    """Largest deviation of any frame in any posture of the session, whichever is shown, [m]."""
    robot = measured.robot
    drives = np.array([robot.drive_zero - measured.offsets, *measured.drives.values()])
    believed = drives + measured.offsets
    closed = nominal_assembly(robot).close(believed), assembly.close(drives)
    nominal = place_frames(robot, believed, closed[0], stage.frames)
    machine = robot.with_errors(calibration.errors)
    return find_largest_shift(nominal, place_frames(machine, drives, closed[1], stage.frames))


def _explain_machines(scene: Scene, machines: _Machines) -> None:
    scene.explain(LegendEntry("Machine where it really is", (SOLID,), css(SOLID_COLOUR), "solid"))
    if machines.largest > NOTHING:
        scene.explain(
            LegendEntry(
                "Machine where the controller takes it to be", (GHOST,), css(GHOST_COLOUR), "ghost"
            )
        )
    _explain_lines(scene)
    if machines.largest <= NOTHING:
        scene.facts.insert(0, "The machine is where the controller takes it to be.")
        return
    size = f"largest {machines.largest / MM:.3f} mm, at {machines.where}"
    if machines.exaggeration == 1.0:
        scene.facts.insert(0, f"Machine: true scale ({size}).")
    else:
        scene.facts.insert(0, f"Machine: deviation × {machines.exaggeration:g} ({size}).")


def _state_offsets(scene: Scene, calibration: Calibration) -> None:
    """Say what is to be entered: the leg that leans is often not the one whose drive is off."""
    entries = find_entries(calibration)
    if not entries:
        return
    words = []
    for entry in entries:
        words.append(f"{entry.drive} {typeset(entry.enter * entry.edge_factor)} {entry.edge_unit}")
    found = f"Offsets to enter: {', '.join(words)}. A leg leans by its own drive's and by others'."
    scene.facts.insert(0, found)


def _explain_lines(scene: Scene) -> None:
    scene.explain(LegendEntry("Leg, from its root to its tip", (LINES,), css(LINE_COLOUR), "line"))


# ---- small things


def _looked_at(measured: Measurement) -> list[str]:
    """Frames that sensors look at."""
    sensors = (s.sensor for s in measured.setups.values())
    return [f for s in sensors for f in s.frames(measured.robot).in_posture]


def _follow(
    robot: Robot,
    assembly: Assembly,
    timeline: Timeline,
    frames: Sequence[str],
    *,
    allow_free: bool = False,
) -> dict[str, Array]:
    """Poses of frames in all frames of a motion, loops closed."""
    passive = assembly.close(timeline.drives, allow_free=allow_free)
    return place_frames(robot, timeline.drives, passive, frames)


def _finish(scene: Scene, film: Film, source: str, stops: Sequence[Stop], left_out: int) -> None:
    """Animate, and say what has to be said of it, and where the readings are from."""
    if len(stops) > 1:
        scene.animate(film.animation)
    if left_out:
        shown = len(stops) - 2
        scene.facts.append(f"The animation stops at {shown} of {shown + left_out} postures.")
    if source:
        scene.facts.append(f"Source: {source}")
