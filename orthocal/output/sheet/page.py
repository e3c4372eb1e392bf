"""The measuring sheet: a page to print, with a picture, steps and boxes for each setup."""

from __future__ import annotations

from importlib import resources

import numpy as np

from orthocal.assessment.wording import counted
from orthocal.io.html import escape, heading, page, paragraph, prose, table
from orthocal.measurement.motion.approach import describe_approach
from orthocal.measurement.motion.guidance import describe_mounting, guide, shown_tool
from orthocal.measurement.motion.motion import plan_motion
from orthocal.measurement.motion.motion_program import (
    ProgramOptions,
    program_name,
    write_lines,
    write_program,
)
from orthocal.measurement.motion.stops import SetupMotion, Stop
from orthocal.observation.conditions import needed_conditions
from orthocal.output.sheet.coordinates import joint_values, show_length, show_number
from orthocal.output.sheet.gauge_position import GaugePosition
from orthocal.output.sheet.pictures import draw_machine, draw_section, draw_tool
from orthocal.output.sheet.rules import (
    CHECKS_OF_PRINTER,
    checks_of_machine,
    is_corrected,
    reading_rules,
)
from orthocal.output.sheet.steps import VISIBLE, compare_closing, list_steps, setup_warnings
from orthocal.sensors.ball_bar import BallBar
from orthocal.sensors.points import AXES, Points
from orthocal.session.points import one_row_per_point
from orthocal.session.session import Gauge, Session
from orthocal.units import DRIVE_UNITS, MM
from orthocal.viewer.visuals import load_visuals

SHEET = "sheet.html"
"""Name of the sheet's file."""


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
        gauge = GaugePosition(session, motion, guidance, links)
        pictures = draw_machine(session.robot, visuals, gauge)
        pictures += draw_section(gauge) if gauge.leg is not None else draw_tool(gauge)
        setups.append(_setup(session, motion, gauge, pictures, with_program=bool(programs)))
    title = f"Measuring sheet: {session.robot.name}, {session.title}"
    style = (resources.files("orthocal.output.sheet") / "sheet.css").read_text(encoding="utf-8")
    front = _front(session, motions, options, with_programs=bool(programs))
    usual = "validate CALIBRATION ." if is_corrected(session) else "calibrate . --out DIRECTORY"
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
    on_leg = any(setup.sensor.place[0] == "leg" for setup in session.setups.values())
    measures = "measures" + " (section: at the mechanical zero)" * on_leg
    headers = (
        *("", "setup", measures, *(["gauge"] if several else []), "readings"),
        *(["program" if session.firmware is None else "lines to send"] if with_programs else []),
    )
    rows, aligned_at = [], session.alignment_postures
    for m in motions:
        count = str(sum(s.role == "reading" for s in m.stops))
        setup = session.setups[m.setup]
        gauge = (setup.gauge,) if several else ()
        program = (program_name(session, m),) if with_programs else ()
        measured = describe_mounting(robot, setup.sensor, aligned_at[m.setup], brief=True)
        rows.append((str(m.number), m.setup, measured, *gauge, count, *program))
    checks = checks_of_machine(session) if session.firmware is None else CHECKS_OF_PRINTER
    programs = with_programs and session.firmware is None
    once = "temperature" not in needed_conditions(robot)  # otherwise with each reading
    blanks = "".join(
        f"<p>{escape(text)}: <span class='fill'>&nbsp;</span></p>"
        for text in ("Date, name", *(["Temperature at the start, at the end"] if once else []))
    )
    with_bar = any(isinstance(s.sensor, BallBar) for s in session.setups.values())
    return (
        f"<header>{heading('Measuring sheet', level=1)}"
        f"{paragraph(f'{robot.name}: {session.title}' if session.title else robot.name)}"
        f"{paragraph(lead, kind='lead')}{blanks}</header>"
        + heading("Before the first reading", level=3)
        + _numbered(checks)
        + heading("Rules for all readings", level=3)
        + _numbered(reading_rules(session, motions))
        + heading("Setups, in this order", level=3)
        + table(headers, rows, left=3 + several)
        + (_programs(session, options, with_bar=with_bar) if programs else "")
    )


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
    program = f" {noun}: `{program_name(session, motion)}`." if with_program else ""
    sensor, name = session.setups[motion.setup].sensor, session.setups[motion.setup].gauge
    measured = describe_mounting(session.robot, sensor, gauge.alignment)
    if session.distinguish_gauge(name):
        measured += f". Gauge: {_gauge(name, session.gauges[name])}"
    end = compare_closing(session, motion)
    remove = REMOVE_BAR if isinstance(sensor, BallBar) else REMOVE
    end += REMOVE_FROM_PRINTER if printer else remove
    return (
        f'<section id="setup-{motion.number}">{heading(title)}'
        f"{paragraph(f'{measured}.{program}', kind='lead')}"
        f'<div class="pictures">{pictures}</div>'
        f"{_numbered(list_steps(session, motion, gauge))}"
        f"{setup_warnings(session, motion, gauge)}{_boxes(session, motion)}{paragraph(end)}"
        "</section>"
    )


def _boxes(session: Session, motion: SetupMotion) -> str:
    """Table of the readings: line, posture, tool, joints, and a box to write into.

    The firmware of a printer does not show its carriages.
    """
    robot, stops = session.robot, motion.stops
    sensor, to_note = session.setups[motion.setup].sensor, _asked_for_each(session)
    boxes = AXES if isinstance(sensor, Points) else ("reading",)
    lines = ["" if s.line is None else str(s.line) for s in stops]
    columns = [("line", "number", lines), ("posture", "", [_posture(s) for s in stops])]
    approaches = any(r.approach for r in session.readings)
    if approaches:
        columns.append(("approach", "", [describe_approach(robot, s.approach) for s in stops]))
    points = [s.point for s in stops if s.point is not None]
    if robot.tcp is not None and points:
        shown = [", ".join(map(show_length, p)) for p in shown_tool(session, np.array(points))]
        letters = ", ".join("xyz"[c] for c in robot.tcp.coordinates)
        columns.append((f"tool {letters} [mm]", "" if to_note else "tool", shown))
    if session.firmware is None:
        headers = [f"{d.name} [{DRIVE_UNITS[d.unit][0]}]" for d in robot.drives]
        values = zip(*(joint_values(robot, s.drives) for s in stops), strict=True)
        columns += [(h, "number", list(v)) for h, v in zip(headers, values, strict=True)]
    if any(abs(s.expected) > VISIBLE for s in stops):
        readings = [show_number(s.expected / MM, 2, sign=True) for s in stops]
        columns.append(("perfect machine shows [mm]", "number", readings))
    empty = [*(f"{box} [mm]" for box in boxes), *to_note, "remarks"]
    headings = [*((text, kind) for text, kind, _ in columns), *((text, "") for text in empty)]
    head = "".join(f'<th class="{kind}">{escape(text)}</th>' for text, kind in headings)
    body = ""
    for i, stop in enumerate(stops):
        cells = (f'<td class="{kind}">{escape(texts[i])}</td>' for _, kind, texts in columns)
        box = '<td class="box"></td>' * len(boxes)
        box = "<td>set to 0</td>" if stop.role == "subtracted" else box
        box += '<td class="box condition"></td>' * len(to_note)
        remark = escape(motion.closing(stop, sensor))
        body += f'<tr>{"".join(cells)}{box}<td class="note">{remark}</td></tr>'
    kind = "boxes wide" if approaches or to_note else "boxes"
    return f'<table class="{kind}"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'


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
        low, high = (show_length(v) for v in gauge.range)
        parts.append(f"{low} … {high} mm")
    if gauge.resolution is not None:
        parts.append(f"read to {gauge.resolution / MM:g} mm")
    return ", ".join(parts) or "any dial"
