"""Scenes of a robot, a session and a calibration.

The scene of a calibration shows the calibrated machine as a solid, and the nominal machine, which
the controller assumes, as a pale ghost. The deviation between them is enlarged by a stated factor.
Arrows at the gauges show the deviations of the readings before and after the calibration, enlarged
by another factor.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from orthocal.arguments import require_kind
from orthocal.arrays import Array
from orthocal.assessment.assess import assessment_of
from orthocal.assessment.controller_entries import find_entries
from orthocal.assessment.wording import counted
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ClosureError, ParameterError
from orthocal.kinematics.loop_closure import LoopClosure, nominal_closure
from orthocal.output.scene.deviations import (
    Measurement,
    Stop,
    measurement_of_calibration,
    measurement_of_session,
    plan_stops,
)
from orthocal.output.scene.readings import (
    NEGLIGIBLE,
    draw_readings,
    write_headline,
    write_steps,
)
from orthocal.output.scene.tool_errors import draw_tool_errors
from orthocal.output.text.layout import typeset
from orthocal.robot.model import Robot, coordinate_units, name_coordinates
from orthocal.robot.reference_posture import count_free_motions
from orthocal.session.session import Session
from orthocal.units import MM
from orthocal.viewer.machine import MachineScene
from orthocal.viewer.motion import (
    Timeline,
    exaggerate,
    find_largest_shift,
    place_frames,
    plan_motion,
)
from orthocal.viewer.scene import Scene, round_scale

SHOW_CHOICES = ("readings", "tool", "all")
"""Initially visible content of a calibration's scene."""

DEFAULT_DEVIATION = 0.05
"""Default drawn size of the largest deviation, relative to the machine."""

MAX_DEVIATION = 1.0
"""Largest drawn size of the largest deviation, relative to the machine."""

UNLIMITED_TRAVEL = 0.3
"""Drawn travel of a drive without limits, [rad] or characteristic lengths."""

MAX_TRAVEL = 1.0
"""Largest drawn travel of a drive, [rad] or characteristic lengths."""

MACHINE = "Machine"
GHOST = "Machine, nominal (ghost)"
SOLID = "Machine, calibrated"


def draw_scene(
    subject: Calibration | Session | Robot,
    *,
    posture: str | None = None,
    exaggeration: float | None = None,
    show: str | None = None,
) -> Scene:
    """Scene of a calibration, a session or a robot.

    Args:
        subject: The calibration, session or robot.
        posture: Name of the posture to show; by default the mechanical zero and an animation of the
            measurement.
        exaggeration: Factor that enlarges the deviation of the calibrated machine; 1 for true
            scale. By default a factor that makes the deviation visible.
        show: Initially visible content of a calibration's scene: "readings", "tool" (tool errors)
            or "all".

    Raises:
        ParameterError: If the posture does not exist, or an argument is out of range or does not
            apply to the subject.
        TypeError: If the subject is of another type.
        RobotError: If the visuals of the robot cannot be loaded.
        ClosureError: If the machine cannot reach a posture.
    """
    if exaggeration is not None and not (math.isfinite(exaggeration) and exaggeration > 0.0):
        raise ParameterError(
            f"is {exaggeration:g}; expected a positive number", where="exaggeration"
        )
    if show is not None and show not in SHOW_CHOICES:
        raise ParameterError(f"'{show}' is none of {', '.join(SHOW_CHOICES)}", where="show")
    if isinstance(subject, Calibration):
        return _draw_calibration(subject, posture, exaggeration, show or SHOW_CHOICES[0])
    for name, value in (("show", show), ("exaggeration", exaggeration)):
        if value is not None:
            raise ParameterError("applies to a calibration only", where=name)
    if isinstance(subject, Session):
        return _draw_session(subject, posture)
    expected = "a Calibration, a Session or a Robot, such as load_calibration(...)"
    require_kind(subject, Robot, expected=expected)
    return _draw_robot(subject, posture)


def _draw_robot(robot: Robot, posture: str | None) -> Scene:
    """Scene of a robot that moves each drive."""
    if posture is not None:
        raise ParameterError("a robot has no postures; name a session", where="posture")
    drawing = MachineScene(robot, f"{robot.name}: the nominal machine")
    stops = _tour(robot)
    timeline = plan_motion([s.drives for s in stops], count=1 + 4 * len(robot.drives))
    poses = _follow(nominal_closure(robot), robot, timeline, drawing.frames, allow_free=True)
    drawing.draw_machine(MACHINE, "Machine", timeline, poses)
    drawing.draw_leg_lines(timeline, poses)
    drawing.look_at(poses)
    scene = drawing.scene
    write_steps(scene, stops, timeline, [s.name for s in stops])
    scene.animate()
    scene.facts[:0] = _state_zero(robot)
    loops = counted(len(robot.closures), "closed loop")
    scene.headline = f"{counted(len(robot.drives), 'drive')}, {loops}"
    return scene


def _state_zero(robot: Robot) -> list[str]:
    """Facts about the mechanical zero in joint coordinates, and about free motions."""
    zero = [float(d.to_joint(d.zero)) for d in robot.drives]
    drives = name_coordinates(robot.drives, zero, lambda v: f"{v + 0.0:.6g}")
    facts = [f"Mechanical zero: {', '.join(drives)}."]
    computed = [d.name for d in robot.drives if d.zero_computed]
    if computed:
        facts.append(f"Computed by closing the loops: the zero of {', '.join(computed)}.")
    free = count_free_motions(robot)
    if free:
        motions = counted(free, "passive motion")
        facts.append(f"The loops do not constrain {motions}. Their drawn position is arbitrary.")
    return facts


def _tour(robot: Robot) -> list[Stop]:
    """Stops at the mechanical zero and, for every drive, towards both ends of its travel."""
    units = np.where(coordinate_units(robot) == 1.0, robot.characteristic_length, 1.0)
    none = np.zeros(len(robot.drives))
    stops = [Stop("mechanical zero", robot.drive_zero, none)]
    for i, drive in enumerate(robot.drives):
        unit = float(units[robot.drive_index[i]])
        for end, direction in ((drive.lower, "down"), (drive.upper, "up")):
            travel = end - drive.zero
            if not math.isfinite(travel):
                travel = math.copysign(UNLIMITED_TRAVEL * unit, end)
            travel = math.copysign(min(abs(travel), MAX_TRAVEL * unit), travel)
            target = _find_reachable(robot, i, 0.4 * travel)
            if target is not None:
                stops += [Stop(f"{drive.name} {direction}", target, none), stops[0]]
    return stops


def _find_reachable(robot: Robot, drive: int, move: float) -> Array | None:
    """Drive coordinates after a move or a fraction of it; None if no loops close on the way.

    Args:
        robot: The robot.
        drive: Index of the drive that moves.
        move: Change of its coordinate, [m or rad].
    """
    zero = robot.drive_zero
    for fraction in (1.0, 0.5, 0.25):
        target = zero + fraction * move * np.eye(len(zero))[drive]
        timeline = plan_motion([zero, target, zero], count=1 + 4 * len(zero))
        try:
            nominal_closure(robot).close(timeline.drives, allow_free=True)
        except ClosureError:
            continue
        return np.asarray(target)
    return None


def _draw_session(session: Session, posture: str | None) -> Scene:
    """Scene of a session on the nominal machine."""
    robot, measured = session.robot, measurement_of_session(session)
    drawing = MachineScene(robot, session.title, sensor_frames=_sensor_frames(measured))
    stops, omitted = plan_stops(measured, posture)
    timeline = plan_motion([s.drives + s.offsets for s in stops])
    poses = _follow(nominal_closure(robot), robot, timeline, drawing.all_frames)
    drawing.draw_machine(MACHINE, "Machine, nominal", timeline, poses)
    drawing.draw_leg_lines(timeline, poses)
    drawing.look_at(poses)
    draw_readings(drawing, measured, stops, timeline, poses)
    drawing.scene.headline = write_headline(measured)
    _finish(drawing.scene, session.source, stops, omitted)
    return drawing.scene


def _draw_calibration(
    calibration: Calibration, posture: str | None, exaggeration: float | None, show: str
) -> Scene:
    """Scene of a calibration with both machines, deviations and tool errors."""
    measured = measurement_of_calibration(calibration)
    title = f"{calibration.session.title} · model '{calibration.model}'"
    drawing = MachineScene(measured.robot, title, sensor_frames=_sensor_frames(measured))
    scene = drawing.scene
    stops, omitted = plan_stops(measured, posture)
    machines = _Machines(calibration, measured, stops, drawing, exaggeration)
    timeline, real = machines.timeline, machines.drawn
    drawing.draw_machine(SOLID, "Calibrated machine", timeline, real)
    if machines.largest > NEGLIGIBLE:
        text = "Nominal machine, as the controller assumes"
        drawing.draw_machine(GHOST, text, timeline, machines.nominal, ghost_of=real)
    drawing.draw_leg_lines(timeline, real)
    drawing.look_at(real, machines.nominal)
    scene.exaggeration = machines.exaggeration
    scene.facts.insert(0, machines.describe())
    readings, tool = show in ("readings", "all"), show in ("tool", "all")
    draw_readings(drawing, measured, stops, timeline, real, shown=readings)
    tool_headline = draw_tool_errors(drawing, calibration, shown=tool)
    scene.headline = write_headline(measured) if readings or not tool_headline else tool_headline
    entries = ", ".join(
        f"{e.drive} {typeset(e.enter * e.edge_factor)} {e.edge_unit}"
        for e in find_entries(calibration)
    )
    if entries and assessment_of(calibration).decision.verdict == "enter":
        keep = assessment_of(calibration).keeps_offsets
        which = "Offsets that stay as they are" if keep else "Offsets to enter"
        scene.facts.insert(0, f"{which}: {entries}. Each leg leans by the offsets of all drives.")
    _finish(scene, calibration.session.source, stops, omitted)
    return scene


class _Machines:
    """The nominal and the calibrated machine in all frames of a motion.

    Args:
        calibration: The calibration.
        measured: Its deviations.
        stops: The stops of the motion.
        drawing: The scene.
        exaggeration: Factor that enlarges the deviation; None for a visible deviation.

    Raises:
        ParameterError: If the factor is too large.
    """

    def __init__(
        self,
        calibration: Calibration,
        measured: Measurement,
        stops: Sequence[Stop],
        drawing: MachineScene,
        exaggeration: float | None,
    ) -> None:
        robot, frames, size = measured.robot, drawing.all_frames, drawing.size
        rigid = {n: v for n, v in calibration.errors.items() if robot.parameters.are_rigid(n)}
        machine, nominal = robot.with_errors(rigid), nominal_closure(robot)
        real = LoopClosure(robot, fixed=calibration.errors)
        n, motion = len(robot.drives), plan_motion([np.append(s.drives, s.offsets) for s in stops])
        self.timeline = Timeline(motion.drives[:, :n], motion.times, motion.stops)
        expected = motion.drives[:, :n] + motion.drives[:, n:]
        assumed = Timeline(expected, motion.times, motion.stops)
        self.nominal = _follow(nominal, robot, assumed, frames)
        """Frame to poses of the nominal machine, shape (F, 4, 4), [m]."""
        poses = _follow(real, machine, self.timeline, frames)
        # the largest deviation includes postures that are not shown
        drives = np.array([robot.drive_zero - measured.offsets, *measured.drives.values()])
        offsets = [measured.active.get(name, measured.offsets) for name in measured.drives]
        expected = drives + np.array([measured.offsets, *offsets])
        self.largest, self.frame = find_largest_shift(
            place_frames(robot, expected, nominal.close(expected), drawing.frames),
            place_frames(machine, drives, real.close(drives), drawing.frames),
        )
        """Largest deviation of a frame, [m], and the name of this frame."""
        usual = DEFAULT_DEVIATION * size / self.largest if self.largest > NEGLIGIBLE else 1.0
        self.exaggeration = round_scale(usual) if exaggeration is None else exaggeration
        limit = math.inf if self.largest == 0.0 else MAX_DEVIATION * size / self.largest
        if self.exaggeration > limit:
            raise ParameterError(
                f"is {self.exaggeration:g}; the largest deviation of {self.largest / MM:.3g} mm "
                f"would be drawn larger than the machine: expected at most {math.floor(limit)}",
                where="exaggeration",
            )
        self.drawn = {
            name: exaggerate(self.nominal[name], pose, self.exaggeration)
            for name, pose in poses.items()
        }
        """Frame to poses of the calibrated machine with enlarged deviation."""

    def describe(self) -> str:
        """Sentence with the size and the scale of the machine's deviation."""
        if self.largest <= NEGLIGIBLE:
            return "The calibrated machine does not deviate from the nominal one."
        scale = "true scale"
        if self.exaggeration != 1.0:
            scale = f"deviation × {self.exaggeration:g}"
        return f"Machine: {scale} (largest {self.largest / MM:.3f} mm, at {self.frame})."


def _sensor_frames(measured: Measurement) -> list[str]:
    """Names of the frames that the sensors of all setups measure."""
    sensors = (s.sensor for s in measured.setups.values())
    return [f for s in sensors for f in s.frames(measured.robot).in_posture]


def _follow(
    closure: LoopClosure,
    robot: Robot,
    timeline: Timeline,
    frames: Sequence[str],
    *,
    allow_free: bool = False,
) -> dict[str, Array]:
    """Poses of robot frames at all times of a motion, with closed loops."""
    passive = closure.close(timeline.drives, allow_free=allow_free)
    return place_frames(robot, timeline.drives, passive, frames)


def _finish(scene: Scene, source: str, stops: Sequence[Stop], omitted: int) -> None:
    """Add the animation, and facts about omitted stops and the source of the readings."""
    if len(stops) > 1:
        scene.animate()
    if omitted:
        shown = len(stops) - 2
        scene.facts.append(
            f"The animation shows {shown} of {shown + omitted} stops, which are the postures of "
            "one measured part after another."
        )
    if source:
        scene.facts.append(f"Source: {source}")
