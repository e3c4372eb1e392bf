"""G-code programs that move the machine through a setup and pause (M0) where the operator acts.

A program starts at the mechanical zero, without a gauge. The first pause is in the alignment
posture, where the operator mounts and aligns the gauge. A pause for each reading follows. With a
logger, a program dwells and triggers it instead. It still pauses where the operator sets the dial
or holds the plunger up. The fixed ball of a ball bar may be in the way of the first motion. So its
program also pauses before this motion, and starts in the first posture if the ball stays mounted.
With a probe it pauses above each posture, where the operator probes.

Every motion is in machine coordinates (G53), so that work offsets (G54 to G59.3), G92 and a
coordinate rotation have no effect. Coordinates are those of nominal kinematics; comments list the
joints. The firmware of a printer does not run these programs: it has other pauses, and macros that
move the nozzle at a pause. Its operator sends the lines of one reading after the other.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import ParameterError
from orthocal.measurement.motion.approach import describe_approach
from orthocal.measurement.motion.guidance import (
    describe_mounting,
    dial_zero,
    shown_joints,
    shown_tool,
    start_point,
)
from orthocal.measurement.motion.stops import SetupMotion, Stop
from orthocal.robot.model import Robot
from orthocal.sensors.ball_bar import BallBar
from orthocal.sensors.leg_indicator import BallIndicator
from orthocal.sensors.protocol import Sensor, has_dial, mounting_steps, probing_direction
from orthocal.session.session import Session
from orthocal.text import comment_safe, shorten
from orthocal.units import MM, format_fixed

LETTERS = "XYZ"

DECIMALS = 4
"""Decimals of coordinates in mm and of joints in mm or degrees."""

LONGEST_NAME = 40
"""Largest length of a name in a comment: controllers read lines of 80 to 256 characters."""

LARGEST_FEED = 20_000.0
"""Largest feed, [mm/min]."""

LONGEST_DWELL = 600.0
"""Longest dwell at a reading, [s]."""

SETTLING_TIME = 1.0
"""Dwell before a trigger if none is stated, [s]."""

PULSE_TIME = 0.1
"""Duration of a pulse of a digital output, [s]."""

TRIGGER = re.compile(r"(?P<output>[0-9]|[1-5][0-9]|6[0-3])|M1[0-9][0-9]")
"""Digital output of LinuxCNC, or an M-code of the user."""

PREAMBLE = (
    "(Every motion is in machine coordinates: G53 G1 in G90)",
    "(Work offsets G54 to G59.3, G92 and rotation have no effect; G49 cancels the tool length)",
    "(Requires a controller that runs G53 with G1 at the programmed feed)",
    "(Cancel scaling and mirroring first. Run once without gauge at low feed override)",
    "G21 G90 G94 G40 G49",
)

LINES_HEAD = [
    "; Written by orthocal: lines to send",
    "; Send the lines of one reading after the other from the console of the firmware.",
    "; Do not run this file: it has no pauses.",
]

SIGNS = str.maketrans("↑↓·", "+-0")
"""Arrows of an approach in ASCII."""

SIGNS_NOTE = "(Approach: + the number of the joint grows at the end, - it falls, 0 either)"


@dataclass(frozen=True, slots=True)
class ProgramOptions:
    """Options of measuring programs.

    Raises:
        ParameterError: If a feed, the dwell or the trigger is out of range.
    """

    feed: float = 600.0
    """Feed between postures, [mm/min]."""
    approach_feed: float = 120.0
    """Feed of the approach, [mm/min]."""
    dwell: float | None = None
    """Dwell at each reading instead of a pause, [s]; None for a pause."""
    trigger: str | None = None
    """Trigger of a logger at the end of the dwell: an M-code from M100 to M199, or the number of a
    digital output for a pulse."""

    def __post_init__(self) -> None:
        for name, feed in (("--feed", self.feed), ("--approach-feed", self.approach_feed)):
            if not 1.0 <= feed <= LARGEST_FEED:
                raise ParameterError(
                    f"found {feed:g}; expected 1 to {LARGEST_FEED:g} mm/min", where=name
                )
        if self.dwell is not None and not 0.1 <= self.dwell <= LONGEST_DWELL:
            raise ParameterError(
                f"found {self.dwell:g}; expected 0.1 to {LONGEST_DWELL:g} s", where="--dwell"
            )
        if self.trigger is not None and not TRIGGER.fullmatch(self.trigger):
            raise ParameterError(
                f"found '{shorten(self.trigger)}'; expected a digital output, 0 to 63, or an "
                "M-code, M100 to M199",
                where="--trigger",
            )

    @property
    def automatic(self) -> bool:
        """True if the program dwells or triggers a logger instead of a pause."""
        return self.dwell is not None or self.trigger is not None

    @property
    def reading_lines(self) -> list[str]:
        """Lines of G-code at a reading without an operator."""
        lines = [f"G4 P{SETTLING_TIME if self.dwell is None else self.dwell:g}"]
        if self.trigger is None:
            return lines
        if TRIGGER.fullmatch(self.trigger)["output"] is None:  # type: ignore[index] # checked above
            return [*lines, self.trigger]
        return [*lines, f"M64 P{self.trigger}", f"G4 P{PULSE_TIME:g}", f"M65 P{self.trigger}"]


def program_name(session: Session, motion: SetupMotion) -> str:
    """File name of a setup's program: its number, then its name in safe characters.

    Lines for a printer have the ending txt, because no printer may run them as a file.
    """
    safe = re.sub(r"[^A-Za-z0-9_-]", "_", motion.setup)[:LONGEST_NAME]
    return f"{motion.number:02d}-{safe}.{'ngc' if session.firmware is None else 'txt'}"


def write_lines(
    session: Session, motion: SetupMotion, options: ProgramOptions | None = None
) -> str:
    """Lines that the operator of a printer sends, reading by reading.

    The arguments are those of `write_program`.
    """
    options, sensor = options or ProgramOptions(), session.setups[motion.setup].sensor
    stops = motion.stops if motion.alignment is None else (motion.alignment, *motion.stops)
    blocks = [LINES_HEAD]
    blocks += [[f"; {_label(s)}", *_moves(session, sensor, s, options)] for s in stops]
    return "\n\n".join("\n".join(block) for block in blocks) + "\n"


def write_program(
    session: Session, motion: SetupMotion, options: ProgramOptions | None = None
) -> str:
    """Program of a setup.

    Args:
        session: The session.
        motion: Path through the setup.
        options: Options of the program.

    Raises:
        ParameterError: If the drives do not command the tool.
    """
    options, robot = options or ProgramOptions(), session.robot
    if robot.tcp is None or any(s.point is None for s in motion.stops):
        raise ParameterError(
            "the drives do not command the tool: there are no coordinates for a program",
            where=str(robot.yaml),
        )
    of_setup = session.setups[motion.setup]
    sensor = of_setup.sensor
    read, aligned = "read", session.alignment_postures[motion.setup]
    if probing_direction(sensor) is not None:  # the operator probes
        read = "probe, note the trigger, move back"
        options = replace(options, dwell=None, trigger=None)
    stops = motion.stops if motion.alignment is None else (motion.alignment, *motion.stops)
    stated = any(r.approach for r in session.readings)
    lines = [
        f"(orthocal: {comment_safe(robot.name, LONGEST_NAME)}, setup "
        f"{comment_safe(motion.setup, LONGEST_NAME)}, {motion.number} of {motion.count})",
        f"({comment_safe(describe_mounting(robot, sensor, aligned), 120)})",
        f"(Machine coordinates, mm; tool at the mechanical zero: "
        f"{_words(session, start_point(session))})",
        *_before_start(session, sensor, stops[0]),
        *([SIGNS_NOTE] if stated else []),
        *PREAMBLE[:-1],
        *(["(Dwells at each reading: G4 P in seconds)"] if options.automatic else []),
        PREAMBLE[-1],
        f"F{options.feed:g}",
        *_before_motion(session, sensor, stops[0]),
    ]
    mount = _mount(sensor, session.distinguish_gauge(of_setup.gauge))
    for i, stop in enumerate(stops):
        zero = _zero_to_set(session, motion, stop)
        set_dial = f"set the dial to {zero}" if zero else ""
        actions = mount * (i == 0), set_dial, read * (stop.role == "reading")
        instruction = ", then ".join(filter(None, actions))
        instruction = "; ".join(filter(None, (instruction, motion.closing(stop, sensor))))
        side = "; approach " + describe_approach(robot, stop.approach).translate(SIGNS)
        lines += [
            f"({_label(stop)}{side if stated else ''}; joints {_joints(robot, stop)})",
            *(f"G53 {move}" for move in _moves(session, sensor, stop, options)),
            f"(MSG, {_label(stop)}: {instruction})",
        ]
        following = stops[i + 1] if i + 1 < len(stops) else None
        lines += _read(stop, following, options, needs_hand=bool(i == 0 or zero or stop.lift))
    return "\n".join([*lines, f"(MSG, end: {_end(sensor)})", "M2", ""])


def _before_start(session: Session, sensor: Sensor, first: Stop) -> tuple[str, ...]:
    """Comments of the header about the position of the machine before the start."""
    if not isinstance(sensor, BallBar):
        return ("(Before start: gauge removed, machine at its mechanical zero)",)
    return (
        "(Before start: bar, fixed ball and its post removed, machine at its mechanical zero)",
        "(Or, where ball and post stay from an earlier setup, machine jogged around them to "
        f"{_words(session, first.point)})",
    )


def _before_motion(session: Session, sensor: Sensor, first: Stop) -> tuple[str, ...]:
    """Pause before the first motion of a ball bar, whose fixed ball may be in the way."""
    if not isinstance(sensor, BallBar):
        return ()
    start = _words(session, first.point)
    return (
        "(MSG, before the first motion: remove fixed ball and post, or jog around them to "
        f"{start})",
        "M0",
    )


def _mount(sensor: Sensor, name: str) -> str:
    """Instruction at the first pause after a motion.

    Args:
        sensor: The sensor of the setup.
        name: Name of its gauge; empty if the readings have no other.
    """
    gauge = f"gauge {comment_safe(name, LONGEST_NAME)}" if name else "the gauge"
    if isinstance(sensor, BallBar):
        bar = f"the bar with {gauge}" if name else "the bar"
        return f"place the fixed ball unless it is in place, then mount {bar} as the sheet shows"
    if mounting_steps(sensor) is not None:
        return f"mount {gauge} as the sheet shows"
    align = "align its ball as the sheet shows" if isinstance(sensor, BallIndicator) else "align it"
    return f"mount {gauge}, {align}"


def _zero_to_set(session: Session, motion: SetupMotion, stop: Stop) -> str:
    """Reading to which the dial is set at a stop, in mm; empty if it is not set there."""
    setup = session.setups[motion.setup]
    if not has_dial(setup.sensor):
        return ""
    if stop.role == "subtracted":
        return "0"
    is_first = stop is motion.stops[0] and setup.zero == "free"
    return dial_zero(session.gauges[setup.gauge]) if is_first else ""


def _end(sensor: Sensor) -> str:
    """Instruction at the end of a program."""
    if isinstance(sensor, BallBar):
        return (
            "remove bar, ball and post, then jog to the mechanical zero; if ball and post stay, "
            "jog around them to the next setup"
        )
    return "remove the gauge, then jog the machine to its mechanical zero"


def _read(
    stop: Stop, following: Stop | None, options: ProgramOptions, *, needs_hand: bool
) -> list[str]:
    """Pause for the operator, or dwell and trigger of a logger.

    Args:
        stop: Stop in the posture to read.
        following: The next stop; None after the last one.
        options: Options of the program.
        needs_hand: Whether the operator has to act before the reading.
    """
    hold = []
    if following is not None and following.lift:
        hold = [f"(MSG, hold the plunger up on the way to {_label(following)})"]
    if stop.role == "return" or not options.automatic:
        return hold if stop.role == "return" else [*hold, "M0"]
    lines = ["M0"] * needs_hand
    if stop.role == "reading":
        lines += options.reading_lines
    return [*lines, *hold, "M0"] if hold else lines


def _moves(session: Session, sensor: Sensor, stop: Stop, options: ProgramOptions) -> list[str]:
    """Motion to the start of the approach, and the approach unless the operator probes."""
    targets: list[tuple[Array | None, float]] = [(point, options.feed) for point in stop.via]
    targets.append((stop.approach_point, options.feed))
    if probing_direction(sensor) is None:
        targets.append((stop.point, options.approach_feed))
    return [f"G1 {_words(session, point)} F{feed:g}" for point, feed in targets]


def _words(session: Session, point: Array | None) -> str:
    """G-code words of a point of the world in machine coordinates, [mm]."""
    coordinates = () if session.robot.tcp is None else session.robot.tcp.coordinates
    return " ".join(
        f"{LETTERS[c]}{format_fixed((v + session.controller_origin[c]) / MM, DECIMALS)}"
        for c, v in zip(coordinates, shown_tool(session, np.asarray(point)[None])[0], strict=True)
    )


def _joints(robot: Robot, stop: Stop) -> str:
    """Joints at a stop, as the controller displays them, in mm or degrees."""
    shown = zip(robot.drives, shown_joints(robot, stop.drives), strict=True)
    return " ".join(format_fixed(float(v) / d.joint_size, DECIMALS) for d, v in shown)


def _label(stop: Stop) -> str:
    """Line of readings.csv and posture of a stop."""
    name = comment_safe(stop.posture, LONGEST_NAME)
    if stop.line is not None:
        return f"reading line {stop.line}, posture {name}"
    return f"{'alignment' if stop.role == 'alignment' else 'first'} posture {name}"
