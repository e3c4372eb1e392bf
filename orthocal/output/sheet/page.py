"""The measuring sheet: a page to print, with a picture, steps and boxes for each setup."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from importlib import resources

import numpy as np

from orthocal.arrays import Array
from orthocal.assessment.wording import OFFSETS_IN_LINUXCNC, name_direction
from orthocal.effects.compensation import describe_trims
from orthocal.io.html import escape, heading, page, paragraph, prose, table
from orthocal.kinematics.workspace import tool_at_zero
from orthocal.measurement.motion.approach import AS_ARROWS_SHOW, approach_length, describe_approach
from orthocal.measurement.motion.guidance import (
    describe_mounting,
    dial_zero,
    guide,
    is_displaced,
    range_of_expected,
    set_dial,
    shown_joints,
    shown_tool,
)
from orthocal.measurement.motion.motion import plan_motion
from orthocal.measurement.motion.motion_program import (
    ProgramOptions,
    program_name,
    write_lines,
    write_program,
)
from orthocal.measurement.motion.stops import SetupMotion, Stop
from orthocal.observation.conditions import needed_conditions
from orthocal.observation.gauge_noise import usual_difference
from orthocal.output.sheet.gauge_position import (
    ABOUT_ALONG,
    GaugePosition,
    find_gauge_position,
    name_tip,
)
from orthocal.output.sheet.pictures import draw_machine, draw_section, draw_tool
from orthocal.output.text.layout import counted, true_minus
from orthocal.robot.model import PARALLEL_SINE, Robot, drive_keys, name_coordinates
from orthocal.sensors.ball_bar import BallBar
from orthocal.sensors.points import AXES, Points
from orthocal.sensors.protocol import (
    PROBING_DISTANCE,
    has_dial,
    mounting_steps,
    probing_direction,
    tool_path,
)
from orthocal.session.points import one_row_per_point
from orthocal.session.session import Gauge, Session, Setup
from orthocal.units import DRIVE_UNITS, LIMIT, MM, format_fixed
from orthocal.viewer.visuals import load_visuals

SHEET = "sheet.html"
"""Name of the sheet's file."""

END = (
    "Compare the last reading with {}: posture and approach are the same. If they differ by more "
    "than {}, read this setup again: the gauge or the machine was displaced. "
)
"""Check after the readings of a setup: the first reading, and the largest usual difference."""

FROM_ANOTHER_SIDE = (
    "The last reading repeats the first posture from another side: backlash may change it. "
)
"""The same where the closing reading has another approach than the first."""

END_OF_POINTS = (
    "Compare the points of the first posture with each other. If they differ by more than the "
    "instrument scatters, read this setup again: the instrument or the machine was displaced. "
)
"""The same for points."""

REMOVE = "Then remove the gauge and jog the machine to its mechanical zero."
"""What to do after the check."""

REMOVE_BAR = (
    "Then remove the bar. If a later setup uses the same ball, leave ball and post, and jog around "
    "them to its first posture. Otherwise remove them before you jog to the mechanical zero."
)
"""The same for a ball bar."""

REMOVE_FROM_PRINTER = "Then remove the gauge. A fixed ball stays if a later setup uses it."
"""The same for a printer, which begins the next setup where it stands."""

BALL_IN_THE_WAY = (
    " The fixed ball of a ball bar and its post may be in its way. Place them only after the tool "
    "stands in the first posture. Where they stay for a later setup with the same ball, jog around "
    "them to the first posture of its program before you start it, not to the mechanical zero. "
    "Remove them before you start the program of another gauge."
)
"""Rule for programs of a session with a ball bar."""

PROBING = (
    "A probe reaches each posture by the motion towards its surface. The programs stop "
    f"{PROBING_DISTANCE / MM:g} mm before each posture, and you probe."
)
"""Rule for the approach of postures that are probed."""

CHECKS_OF_PRINTER = [
    "Warm the printer up and home it. The firmware must have the settings that session.yaml states "
    "(`controller`). Do not change them until all readings are taken.",
    "Switch the mesh of the bed and other corrections of the height off (Klipper: BED_MESH_CLEAR, "
    "Marlin: M420 S0, RepRapFirmware: G29 S2), and set G90 and G21.",
    "Copy the lines of one reading after the other from the file of the setup (lines to send) into "
    "the console of the firmware. Nothing may be in the way of the first motion of a setup. Mount "
    "the gauge after it.",
    "Check each rod and each hinge for play that the dial shows, and remove it: the calibration "
    "cannot correct it.",
]
"""Checks of a printer."""

LINES_APPROACH = (
    "Send all lines of a reading in their order: the last one approaches the posture from the "
    "right side."
)
"""Rule for the approach of postures on a printer."""

PROBED_BY_HAND = (
    f"The lines of a probe stop {PROBING_DISTANCE / MM:g} mm before the posture. Then move the "
    "probe towards the surface until it triggers."
)
"""The same for postures that are probed."""

BY_EYE = 0.01
"""Angle between a leg and its axis that the eye does not see: half a degree, [rad]."""

VISIBLE = 5e-5
"""Smallest distance that the sheet mentions and smallest deflection that a dial shows, [m]."""


def sheet_files(
    session: Session, *, options: ProgramOptions | None = None, following: str = ""
) -> dict[str, str]:
    """The sheet of a plan and one program per setup, as a mapping of file name to text.

    Args:
        session: The plan, or a session.
        options: Feeds and shift of the programs.
        following: Command for the readings, in the directory of the sheet; by default `calibrate`,
            or `validate` if the controller has offsets of a calibration.

    Raises:
        SessionError: If the machine cannot go through the plan.
        ParameterError: If a feed or a shift is out of range.
        RobotError: If the visuals of the robot cannot be loaded.
    """
    session = one_row_per_point(session)
    motions = plan_motion(session)
    programs: dict[str, str] = {}
    write = write_program if session.firmware is None else write_lines
    if all(stop.point is not None for motion in motions for stop in motion.stops):
        programs = {program_name(session, m): write(session, m, options) for m in motions}
    visuals = load_visuals(session.robot)
    links = tuple(dict.fromkeys(v.link for v in visuals))
    guidance = guide(session)
    setups = []
    for motion in motions:
        gauge = find_gauge_position(session, motion, guidance, links)
        pictures = draw_machine(session.robot, visuals, gauge)
        pictures += draw_section(gauge) if gauge.leg is not None else draw_tool(gauge)
        setups.append(_setup(session, motion, gauge, pictures, with_program=bool(programs)))
    title = f"Measuring sheet: {session.robot.name}, {session.title}"
    style = (resources.files("orthocal.output.sheet") / "sheet.css").read_text(encoding="utf-8")
    front = _front(session, motions, options, with_programs=bool(programs))
    usual = "validate CALIBRATION ." if _is_corrected(session) else "calibrate . --out DIRECTORY"
    afterwards = _afterwards(session, following or f"orthocal {usual}")
    body = "\n".join([front, "".join(setups), afterwards])
    return {SHEET: page(title, style, body), **programs}


def _front(
    session: Session,
    motions: tuple[SetupMotion, ...],
    options: ProgramOptions | None,
    *,
    with_programs: bool,
) -> str:
    """The first page: checks of the machine, rules, and the list of setups."""
    robot = session.robot
    stops = [s for m in motions for s in m.stops if s.role == "reading"]
    gauges = "; ".join(_gauge(name, gauge) for name, gauge in session.gauges.items())
    count = f"{counted(len(stops), 'reading')} in {counted(len(motions), 'setup')}"
    lead = f"{count}. Gauge: {gauges}."
    several = len(session.gauges_with_readings) > 1
    headers = (
        *("", "setup", "measures", *(["gauge"] if several else []), "readings"),
        *(["program" if session.firmware is None else "lines to send"] if with_programs else []),
    )
    rows, aligned_at = [], session.alignment_postures
    for m in motions:
        count = str(sum(s.role == "reading" for s in m.stops))
        setup = session.setups[m.setup]
        gauge = (setup.gauge,) if several else ()
        program = (program_name(session, m),) if with_programs else ()
        measured = describe_mounting(setup.sensor, aligned_at[m.setup])
        rows.append((str(m.number), m.setup, measured, *gauge, count, *program))
    checks = _checks_of_machine(session) if session.firmware is None else CHECKS_OF_PRINTER
    programs = with_programs and session.firmware is None
    blanks = "".join(
        f"<p>{escape(text)}: <span class='fill'>&nbsp;</span></p>"
        for text in ("Date, name", *_asked_once(session))
    )
    with_bar = any(isinstance(s.sensor, BallBar) for s in session.setups.values())
    return (
        f"<header>{heading('Measuring sheet', level=1)}"
        f"{paragraph(f'{robot.name}: {session.title}' if session.title else robot.name)}"
        f"{paragraph(lead, kind='lead')}{blanks}</header>"
        + heading("Before the first reading", level=3)
        + _numbered(checks)
        + heading("Rules for all readings", level=3)
        + _numbered(_reading_rules(session, motions))
        + heading("Setups, in this order", level=3)
        + table(headers, rows, left=3 + several)
        + (_programs(session, options, with_bar=with_bar) if programs else "")
    )


def _checks_of_machine(session: Session) -> list[str]:
    """Checks of a machine whose drives are joints of its controller."""
    robot = session.robot
    normal = "" if _is_corrected(session) else "A few mm are normal: the calibration finds them. "
    return [
        "Warm the machine up. Home it once. Do not home it again until all readings are taken. If "
        "you must home it again, repeat the interrupted setup.",
        f"Move the machine to its mechanical zero by eye, once: {_zero_by_eye(robot)}. The "
        f"controller must show about {_joint_list(robot, robot.drive_zero)}. {normal}If a number "
        f"differs by more than {_largest_difference(robot)}, the zero of the joint, a dimension or "
        "the direction of counting is wrong. Correct the zero in the controller (LinuxCNC: "
        "HOME_OFFSET), or the others in machine.yaml (`orthocal new DIRECTORY --again`). From now "
        "on, drive to the numbers printed here, not by eye. Travel of the joints: "
        f"{'; '.join(_travel(session))}.",
        f"Jog each joint a little {_growing(robot)}. Its number must {_count_outwards(robot)}.",
        _active_offsets(session),
        *([text] if (text := _compensation(session)) else []),
        "Check each rod and each hinge for play that the dial shows, and remove it: the "
        "calibration cannot correct it.",
    ]


def _largest_difference(robot: Robot) -> str:
    """Largest difference of a joint's number in the mechanical zero that errors explain.

    The tolerance of its offset, and what the eye does not see.
    """
    leg = max((leg.length for leg in robot.legs.values()), default=0.0)
    largest: dict[str, float] = {}
    for drive in robot.drives:
        unit, size = DRIVE_UNITS[drive.unit]
        by_eye = BY_EYE * (leg if drive.unit == "m" else 1.0)
        offset = robot.parameters[f"{drive.name}.offset"]
        limit = math.ceil((LIMIT * offset.prior_std + by_eye) / size)
        largest[unit] = max(largest.get(unit, 0), limit)
    return " or ".join(f"{limit} {unit}" for unit, limit in largest.items())


def _programs(session: Session, options: ProgramOptions | None, *, with_bar: bool) -> str:
    """Advice for running the programs."""
    options = options or ProgramOptions()
    at = session.controller_origin
    origin = f", world origin at ({', '.join(f'{v / MM:g}' for v in at)}) mm" if any(at) else ""
    stops = "stop (M0) in the alignment posture and at each reading"
    if options.automatic:
        stops = (
            "stop (M0) where you mount the gauge, set its dial or hold its plunger up. A logger "
            "reads the gauge: its values are in the order of the tables"
        )
    return paragraph(
        f"Programs: G-code in mm, in machine coordinates (G53){origin}. Work offsets, G92 and "
        f"rotation have no effect on them. They cancel the tool length (G49) and {stops}. "
        "Press cycle start to continue. Run the first "
        "program without a gauge and with a slow override. Before you start a program, remove the "
        "gauge and jog the machine to its mechanical zero: its first motion goes straight to the "
        f"first posture, and nothing may be in its way.{BALL_IN_THE_WAY * with_bar}"
    )


def _setup(
    session: Session,
    motion: SetupMotion,
    gauge: GaugePosition,
    pictures: str,
    *,
    with_program: bool,
) -> str:
    title = f"Setup {motion.number} of {motion.count}: {motion.setup}"
    printer = session.firmware is not None
    noun = "Lines to send" if printer else "Program"
    program = f" {noun}: {program_name(session, motion)}." if with_program else ""
    sensor, name = session.setups[motion.setup].sensor, session.setups[motion.setup].gauge
    measured = describe_mounting(sensor, gauge.alignment)
    if session.distinguish_gauge(name):
        measured += f". Gauge: {_gauge(name, session.gauges[name])}"
    at_zero = "" if gauge.leg is None or is_displaced(sensor) else "At the mechanical zero: "
    end = _compare_closing(session, motion)
    remove = REMOVE_BAR if isinstance(sensor, BallBar) else REMOVE
    end += REMOVE_FROM_PRINTER if printer else remove
    return (
        f'<section id="setup-{motion.number}">{heading(title)}'
        f"{paragraph(f'{at_zero}{measured}.{program}', kind='lead')}"
        f'<div class="pictures">{pictures}</div>'
        f"{_numbered(_steps(session, motion, gauge))}"
        f"{_warnings(session, motion, gauge)}{_boxes(session, motion)}{paragraph(end)}"
        "</section>"
    )


def _compare_closing(session: Session, motion: SetupMotion) -> str:
    """Check after the readings of a setup."""
    setup = session.setups[motion.setup]
    if isinstance(setup.sensor, Points):
        return END_OF_POINTS
    first, last = motion.stops[0], motion.stops[-1]
    if last is first or last.posture != first.posture:
        return ""
    if last.repeats is None or last.approach != first.approach:
        return FROM_ANOTHER_SIDE
    largest = usual_difference(session.gauges[setup.gauge])
    reading = "0" if first.role == "subtracted" else f"that of line {last.repeats}"
    return END.format(reading, f"{_short(largest)} mm" if largest else "three steps of the dial")


def _steps(session: Session, motion: SetupMotion, gauge: GaugePosition) -> list[str]:
    """Steps before the readings of a setup."""
    first = motion.stops[0]
    go = [f"Move to the first posture, {first.posture}: {_place(session, first.drives)}."]
    align = "Move to the alignment posture"
    if gauge.alignment == first.posture:
        align, go = f"{align}, which is also the first posture", []
    to_alignment = [
        f"{align}, {gauge.alignment}: {_place(session, gauge.drives)}."
        f"{_around_ball(session, gauge.setup, motion.alignment or first)}"
    ]
    if probing_direction(gauge.setup.sensor) is not None:  # nothing is aligned on the surface
        to_alignment, go = [], []
    return [
        *to_alignment,
        *(mounting_steps(gauge.setup.sensor) or _mount_on_base(gauge)),
        *go,
        _gauge_zero(session, gauge.setup, first),
        "Take the readings in the order below. The line numbers are those of readings.csv.",
    ]


def _mount_on_base(gauge: GaugePosition) -> tuple[str, ...]:
    """Steps that mount an indicator on the base."""
    side = name_direction(gauge.contact.direction)
    opposite = name_direction(-gauge.contact.direction)
    place = " ".join(
        f"{letter}{_number(v / MM, 1)}" for letter, v in zip("XYZ", gauge.coordinates, strict=True)
    )
    contact = ""
    if gauge.rod is not None and gauge.leg is not None:
        target = f"rod {gauge.rod.name} of leg {gauge.leg.name}"
        reach = gauge.hinge_distances / MM
        contact = (
            f"Its {name_tip(gauge.tip)} touches {_across(gauge)}, {reach[gauge.aligned]:.1f} mm "
            "from the hinge on the slide. Then the rod slides past the tip: during the setup the "
            f"distance becomes {reach.min():.0f} to {reach.max():.0f} mm. "
        )
        if gauge.tip is not None and gauge.tip.edge is None:
            contact += "Align the ball by eye: half a millimetre is good enough. "
    elif gauge.leg is not None:
        target = f"leg {gauge.leg.name}"
        contact = (
            "The calculation assumes that it reads the line between the rods. If its tip touches a "
            "rod, state `touches` and `tip` in session.yaml. "
        )
    else:
        target = " ".join(gauge.setup.sensor.place).strip()
    return (
        f"Mount the gauge on the base, on the {side} side of {target}. Point its plunger to "
        f"{opposite}. {contact}In coordinates, from {gauge.origin_name} in this posture, "
        f"the contact point is at {place} mm.",
        f"Push the plunger in with a finger, towards {side}. The reading must grow. If it falls, "
        "enter every reading of this setup with the opposite sign.",
    )


def _around_ball(session: Session, setup: Setup, begin: Stop) -> str:
    """Way to the alignment posture past a fixed ball, which may stand at the mechanical zero."""
    if not isinstance(setup.sensor, BallBar) or begin.point is None:
        return ""
    at = ", ".join(_short(v) for v in shown_tool(session, begin.point[None])[0])
    return (
        " If the fixed ball is in place already, jog around ball and post to this posture (tool at "
        f"{at} mm) before you start."
    )


def _across(gauge: GaugePosition) -> str:
    """Lateral position of the tip on the rod in the alignment posture."""
    offset = float(np.linalg.norm(gauge.lateral_offset))
    if offset <= VISIBLE:
        return "the rod on its centre line"
    return (
        f"the rod with its centre {offset / MM:.1f} mm off the centre line, towards "
        f"{name_direction(gauge.lateral_offset, cosine=ABOUT_ALONG)}"
    )


def _gauge_zero(session: Session, setup: Setup, first: Stop) -> str:
    """Instruction for setting the gauge zero."""
    if setup.zero == "known" or not has_dial(setup.sensor):
        return set_dial(session, setup.name)
    again = " Set it again where the table says so." * (first.role == "subtracted")
    return (
        f"{set_dial(session, setup.name)} This is the gauge zero: set it here only.{again} Push "
        "the stand lightly and release it: the hand must return to "
        f"{dial_zero(session.gauges[setup.gauge])} within one step."
    )


def _warnings(session: Session, motion: SetupMotion, gauge: GaugePosition) -> str:
    texts = []
    if gauge.near_hinge is not None:
        texts.append(
            f"The tip comes within {gauge.near_hinge / MM:.1f} mm of the middle of a hinge. Check "
            "that it clears the bearing before you set the gauge zero."
        )
    low, high = range_of_expected(
        session.gauges[session.setups[motion.setup].gauge],
        differences=motion.stops[0].role == "subtracted",
    )
    beyond = [s for s in motion.stops if s.role == "reading" and not low <= s.expected <= high]
    if beyond:
        texts.append(
            "Even a perfect machine shows "
            f"{_number(beyond[0].expected / MM, 1, sign=True)} mm in {beyond[0].label}, "
            "beyond the range of the dial. Choose another posture or another dial."
        )
    if motion.lifting:
        texts.append(motion.lifting)
    return "".join(paragraph(text, kind="warn") for text in texts)


def _boxes(session: Session, motion: SetupMotion) -> str:
    """Table of the readings: line, posture, tool, joints, and a box to write into.

    The firmware of a printer does not show its carriages.
    """
    robot = session.robot
    joints = robot.drives if session.firmware is None else ()
    tool = motion.stops[0].point is not None
    approaches = any(r.approach for r in session.readings)
    to_note = _asked_for_each(session)
    letters = [] if robot.tcp is None or not tool else ["xyz"[c] for c in robot.tcp.coordinates]
    sensor = session.setups[motion.setup].sensor
    boxes = AXES if isinstance(sensor, Points) else ("reading",)
    expected = any(abs(s.expected) > VISIBLE for s in motion.stops)
    headers = [
        ("line", "number"),
        ("posture", ""),
        *([("approach", "")] if approaches else []),
        *([(f"tool {', '.join(letters)} [mm]", "")] if letters else []),
        *((f"{d.name} [{DRIVE_UNITS[d.unit][0]}]", "number") for d in joints),
        *([("perfect machine shows [mm]", "number")] if expected else []),
        *((f"{box} [mm]", "") for box in boxes),
        *((text, "") for text in to_note),
        ("remarks", ""),
    ]
    head = "".join(f'<th class="{kind}">{escape(text)}</th>' for text, kind in headers)
    rows = []
    for stop in motion.stops:
        cells = [("" if stop.line is None else str(stop.line), "number"), (_posture(stop), "")]
        if approaches:
            cells.append((describe_approach(robot, stop.approach), ""))
        if tool and stop.point is not None:
            shown = shown_tool(session, stop.point[None])[0]
            cells.append((", ".join(map(_short, shown)), ""))
        if joints:
            cells += [(text, "number") for text in _joint_values(robot, stop.drives)]
        if expected:
            cells.append((_number(stop.expected / MM, 2, sign=True), "number"))
        body = "".join(f'<td class="{kind}">{escape(text)}</td>' for text, kind in cells)
        box = '<td class="box"></td>' * len(boxes)
        box = "<td>set to 0</td>" if stop.role == "subtracted" else box
        box += '<td class="box condition"></td>' * len(to_note)
        remark = escape(motion.closing(stop, sensor))
        rows.append(f'<tr>{body}{box}<td class="note">{remark}</td></tr>')
    kind, body = "boxes wide" if approaches or to_note else "boxes", "".join(rows)
    return f'<table class="{kind}"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'


def _asked_once(session: Session) -> tuple[str, ...]:
    """Conditions that the operator writes down at the start and at the end of the session."""
    if "temperature" in needed_conditions(session.robot):
        return ()
    return ("Temperature at the start, at the end",)


def _asked_for_each(session: Session) -> tuple[str, ...]:
    """Headings of boxes for the conditions of each reading."""
    words = {"temperature": "temperature [°C]", "time": "time"}
    needed = needed_conditions(session.robot)
    return tuple(text for condition, text in words.items() if condition in needed)


def _posture(stop: Stop) -> str:
    if stop.repeats is not None:
        return f"{stop.posture}, again"
    if stop.cycle == 1 or stop.role == "subtracted":
        return stop.posture
    return f"{stop.posture}, cycle {stop.cycle}"


def _afterwards(session: Session, command: str) -> str:
    points = [isinstance(s.sensor, Points) for s in session.setups.values()]
    columns = ["reading_mm"] * (not all(points)) + ["x_mm, y_mm and z_mm"] * any(points)
    steps = [
        "Enter the readings with `orthocal record`, which checks each one at once. Or type them "
        f"into readings.csv, column {' or '.join(columns)}, each into its line. Delete the "
        "line of a reading that you could not take. `orthocal import` reads a spreadsheet.",
        "Run:",
    ]
    return (
        f"<section class='last'>{heading('Afterwards')}{_numbered(steps)}"
        f"<p><code>{escape(command)}</code></p></section>"
    )


def _numbered(texts: list[str]) -> str:
    return "<ol>" + "".join(f"<li>{prose(t)}</li>" for t in texts) + "</ol>"


def _gauge(name: str, gauge: Gauge) -> str:
    """Name, range and resolution of a gauge."""
    parts = [name] if name else []
    if gauge.range is not None:
        low, high = (_short(v) for v in gauge.range)
        parts.append(f"{low} … {high} mm")
    if gauge.resolution is not None:
        parts.append(f"read to {gauge.resolution / MM:g} mm")
    return ", ".join(parts) or "any dial"


def _active_offsets(session: Session) -> str:
    """The offsets that must be active in the controller."""
    drives = session.robot.drives
    if session.controller_offsets is None:
        keys = drive_keys("offsets", drives)
        return (
            "session.yaml does not state the offsets of the controller. Before the first "
            f"calibration write `controller: {{{keys}}}` into it, afterwards the offsets that you "
            "entered. They are not HOME_OFFSET."
        )
    if not _is_corrected(session):
        return (
            "session.yaml states that the controller has no offsets of a calibration yet. If it "
            "has, state them there (`controller`). Do not change the controller's zeros until all "
            "readings are taken."
        )
    active = ", ".join(name_coordinates(drives, session.active_offsets, _number))
    return (
        f"Check that these offsets of a calibration are entered, as session.yaml states: {active}. "
        f"{OFFSETS_IN_LINUXCNC} Do not change them until all readings are taken."
    )


def _compensation(session: Session) -> str:
    """The backlash that the controller must compensate; empty where that does not matter."""
    stated = describe_trims(session.robot, session.compensation)
    if stated:
        return (
            f"Check that the controller compensates backlash, as session.yaml states: {stated} "
            "(LinuxCNC: BACKLASH, COMP_FILE)."
        )
    if "approach" not in needed_conditions(session.robot):
        return ""
    if session.compensation:
        return (
            "Check that the controller compensates no backlash, as session.yaml states (LinuxCNC: "
            "BACKLASH is 0 or missing, no COMP_FILE)."
        )
    return (
        "session.yaml does not state which backlash the controller compensates (LinuxCNC: "
        "BACKLASH, COMP_FILE). Write it into session.yaml, 0 for none, in the order "
        f"{', '.join(d.name for d in session.robot.drives)}: controller: "
        f"{{{drive_keys('backlash', session.robot.drives)}}}."
    )


def _zero_by_eye(robot: Robot) -> str:
    """The mechanical zero as the operator sees it."""
    if robot.tcp is None or all(leg.follows_slide for leg in robot.legs.values()):
        return "each leg parallel to its axis"
    at = zip(robot.tcp.coordinates, tool_at_zero(robot), strict=True)
    words = ", ".join(f"{'xyz'[c]} {round(v / MM, 3) + 0.0:g}" for c, v in at)
    return f"the tool at {words} mm"


def _growing(robot: Robot) -> str:
    """Direction in which the slides move as the coordinates of the drives grow."""
    legs = robot.legs.values()
    upwards = legs and all(leg.root_motion[2] > 1.0 - PARALLEL_SINE for leg in legs)
    return "upwards" if upwards else "outwards"


def _count_outwards(robot: Robot) -> str:
    """Direction in which the joint numbers change if the coordinates of the drives grow."""
    verbs = {1: "grow", -1: "fall"}
    if len({d.direction for d in robot.drives}) == 1:
        return verbs[robot.drives[0].direction]
    return ", ".join(f"{verbs[d.direction]} for {d.name}" for d in robot.drives)


def _reading_rules(session: Session, motions: Sequence[SetupMotion]) -> list[str]:
    """Rules for all readings; those about contact and bezel only where an indicator reads."""
    approach = _approach_rule(session, motions)
    empty = "If you could not take a reading, leave the box empty."
    if not any(has_dial(setup.sensor) for setup in session.setups.values()):
        return [approach, f"Write down what the instrument shows, with its sign. {empty}"]
    untouched = "During a setup, do not touch the bezel of the gauge or what holds it."
    if any(setup.zero == "free" for setup in session.setups.values()):
        untouched = (
            "After you have set the gauge zero, do not touch the bezel, the stand or the arm of "
            "the gauge."
        )
    return [
        approach,
        _contact_rule(session, motions),
        f"{untouched} If the gauge was bumped, start that setup again.",
        f"Write down what the dial shows, with its sign, to the nearest step of its scale. {empty}",
    ]


def _contact_rule(session: Session, motions: Sequence[SetupMotion]) -> str:
    """Rule for the tip between the readings of a setup."""
    on_legs = all(s.sensor.place[0] == "leg" for s in session.setups.values())
    kept = "the tip on its rod" if on_legs else "each gauge in contact"
    rule = f"Keep {kept} from the first reading of a setup to the last"
    if not any(stop.lift for m in motions for stop in m.stops):
        return f"{rule}."
    return (
        f"{rule}, except during the motions that the setup names. Hold the plunger up during these "
        "motions, then lower it onto the rod. Do not touch the stand or the bezel."
    )


def _approach_rule(session: Session, motions: Sequence[SetupMotion]) -> str:
    """Rule for the last motion to a posture, in joint numbers."""
    robot, length = session.robot, approach_length(session)
    guided = [n for n, s in session.setups.items() if tool_path(s.sensor) is not None]
    probed = [n for n, s in session.setups.items() if probing_direction(s.sensor) is not None]
    if session.firmware is not None:
        return " ".join([LINES_APPROACH, *[PROBED_BY_HAND] * bool(probed)])
    motions = [m for m in motions if m.setup not in probed]
    others = [PROBING] if probed else []
    if guided and not any(r.approach for r in session.readings if r.setup in guided):
        motions = [m for m in motions if m.setup not in guided]
        others.append(
            "Around a fixed ball the programs move along arcs. If you jog, stay near the sphere."
        )
    if not motions:
        return " ".join(others)
    arrows = {describe_approach(robot, s.approach) for m in motions for s in m.stops}
    if len(arrows) > 1:
        rule = (
            f"{AS_ARROWS_SHOW.format(length)}{_order_of_arrows(robot, arrows)} The programs do "
            f"this. If you jog, first move each joint to a number {length} smaller (↑) or larger "
            "(↓) than that of the posture. Then move all joints to the posture, one after the "
            "other or together. If a joint went too far, begin the approach again."
        )
        return " ".join([rule, *others])
    (arrow,) = arrows
    rule = (
        f"Approach every posture from the same side: in the last {length} "
        f"{_describe_arrow(robot, arrow)}. The programs do this. If you jog, begin {length} "
        f"before the posture with every joint and move each joint to it in one motion."
    )
    return " ".join([rule, *others])


def _order_of_arrows(robot: Robot, arrows: Collection[str]) -> str:
    """Meaning of several arrows side by side."""
    if all(len(arrow) == 1 for arrow in arrows):
        return ""
    return f" Several arrows are in the order {', '.join(d.name for d in robot.drives)}."


def _describe_arrow(robot: Robot, arrow: str) -> str:
    """Direction of an approach in words."""
    verbs = {"↑": "grow", "↓": "fall"}
    if len(arrow) == 1:
        return f"the numbers of all joints {verbs[arrow]}"
    ways = zip(arrow, robot.drives, strict=True)
    return ", ".join(f"the number of {d.name} {verbs[a]}s" for a, d in ways)


def _is_corrected(session: Session) -> bool:
    """True if the controller has offsets of a calibration."""
    return session.controller_offsets is not None and bool(np.any(session.controller_offsets))


def _travel(session: Session) -> list[str]:
    """Limits of the joints, with the active offsets."""
    texts = []
    for drive, active in zip(session.robot.drives, session.active_offsets, strict=True):
        unit, size = DRIVE_UNITS[drive.unit]
        low, high = ((v + drive.direction * active) / size for v in drive.joint_limits)
        if np.isfinite([low, high]).all():
            texts.append(f"{drive.name} {_number(low, 1)} to {_number(high, 1)} {unit}")
    return texts or ["no limits"]


def _place(session: Session, drives: Array) -> str:
    """Place of a posture as the controller displays it: its joints, or the nozzle of a printer."""
    if session.firmware is None:
        return _joint_list(session.robot, drives)
    nozzle = session.firmware.forward(drives)[0]
    return " ".join(f"{letter}{_short(v)}" for letter, v in zip("XYZ", nozzle, strict=True))


def _joint_list(robot: Robot, drives: Array) -> str:
    """Every joint with its number in the controller."""
    return ", ".join(name_coordinates(robot.drives, shown_joints(robot, drives), _number))


def _joint_values(robot: Robot, drives: Array) -> list[str]:
    """Numbers that the controller shows for its joints."""
    return [
        _number(float(v) / DRIVE_UNITS[d.unit][1])
        for d, v in zip(robot.drives, shown_joints(robot, drives), strict=True)
    ]


def _number(value: float, decimals: int = 3, *, sign: bool = False) -> str:
    """A number with a true minus and no negative zero."""
    return true_minus(format_fixed(value, decimals, sign=sign))


def _short(value: float) -> str:
    """A length in mm without trailing zeros."""
    return _number(value / MM, 3).rstrip("0").rstrip(".")
