"""The measuring sheet: a page to print, with a picture, steps and boxes for each setup."""

from __future__ import annotations

from importlib import resources

import numpy as np
from numpy.typing import NDArray

from orthocal.io.html import escape, heading, paragraph, table
from orthocal.kinematics.loop_closure import nominal_assembly
from orthocal.measurement.motion.motion import SetupMotion, Stop, plan_motion
from orthocal.measurement.motion.motion_program import ProgramOptions, program_name, write_program
from orthocal.observation.contacts import locate_contacts
from orthocal.output.sheet.drawing import draw_cut, draw_machine
from orthocal.output.sheet.gauge_position import Standing, direction_words, find_standing, tip_words
from orthocal.output.sheet.words import (
    active_words,
    approach_words,
    counting_words,
    gauge_words,
    joint_list,
    joint_numbers,
    limit_words,
    number,
)
from orthocal.output.text.layout import counted
from orthocal.session.session import Gauge, Session
from orthocal.units import DRIVE_UNITS, MM
from orthocal.viewer.visuals import load_visuals

Array = NDArray[np.float64]

SHEET = "sheet.html"

NOTICED = 5e-5
"""What a perfect machine shows is told from there on, [m]: a dial's hand moves."""

_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


def sheet_files(session: Session, *, options: ProgramOptions | None = None) -> dict[str, str]:
    """The sheet of a plan and a program for each of its setups: name of a file to text.

    Args:
        session: The plan, or a session.
        options: How programs are written.

    Raises:
        SessionError: If the machine cannot go through the plan.
        ParameterError: If a feed or a shift is nothing that can be meant.
        RobotError: If the robot cannot be drawn.
    """
    motions = plan_motion(session)
    programs: dict[str, str] = {}
    if all(stop.point is not None for motion in motions for stop in motion.stops):
        programs = {program_name(m): write_program(session, m, options) for m in motions}
    visuals = load_visuals(session.robot)
    links = tuple(dict.fromkeys(v.link for v in visuals))
    contacts, passive = locate_contacts(session), _close(session)
    setups = []
    for motion in motions:
        standing = find_standing(session, motion, contacts, passive, links)
        pictures = draw_machine(session.robot, visuals, standing) + draw_cut(standing)
        setups.append(_setup(session, motion, standing, pictures, with_program=bool(programs)))
    front = _front(session, motions, with_programs=bool(programs), options=options)
    title = f"Measuring sheet: {session.robot.name}, {session.title}"
    style = (resources.files("orthocal.output.sheet") / "sheet.css").read_text(encoding="utf-8")
    page = (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        f'<title>{escape(title)}</title>\n<link rel="icon" href="data:,">\n'
        f"<style>\n{style}</style>\n</head>\n<body>\n{front}\n"
        f"{''.join(setups)}\n{_afterwards()}\n</body>\n</html>\n"
    )
    return {SHEET: page, **programs}


def _close(session: Session) -> dict[str, Array]:
    """Posture to passive coordinates of the nominal machine."""
    names = list(session.postures)
    drives = np.array([session.postures[n].drives + session.active_offsets for n in names])
    passive = nominal_assembly(session.robot).close(drives, names=names)
    return dict(zip(names, passive, strict=True))


def _front(
    session: Session,
    motions: tuple[SetupMotion, ...],
    *,
    with_programs: bool,
    options: ProgramOptions | None,
) -> str:
    """The first page: what there is to do, and what to look at before."""
    robot = session.robot
    stops = [s for m in motions for s in m.stops if s.role == "reading"]
    lead = (
        f"{counted(len(stops), 'reading')} in {counted(len(motions), 'setup')}. "
        f"Gauge: {gauge_words(session)}."
    )
    headers = ("", "setup", "what is read", "readings", *(("program",) if with_programs else ()))
    rows = []
    for m in motions:
        read = str(sum(s.role == "reading" for s in m.stops))
        what = session.setups[m.setup].sensor.describe()
        rows.append(
            (str(m.number), m.setup, what, read, *((program_name(m),) if with_programs else ()))
        )
    zero = joint_list(robot, robot.drive_zero)
    limits = "; ".join(limit_words(robot))
    active = session.controller_offsets
    shifted = "" if active is None or not any(active) else ", shifted by what was entered"
    before = [
        "Let the machine run until it is warm. Then home it once, and not again until all is read.",
        "In the mechanical zero (legs parallel to their axes, by eye) the controller must show "
        f"about {zero}: zeros may be off by a few mm, which the calibration finds. Its joints may "
        f"go: {limits}{shifted}. If a number is another altogether, mend the robot's files first.",
        "Move each slider by hand a little outwards, away from the middle: its number must "
        f"{counting_words(robot)}.",
        active_words(session),
        "Lay a hand on each rod and turn each hinge: play that you feel is not calibrated away.",
    ]
    rules = [
        "Every posture is approached from the same side: the last millimetres are towards "
        f"{approach_words(robot, motions[0].side)}. The programs do it; by hand do it, too.",
        "The dial stays on its rod from the first reading of a setup to the last, except where "
        "the sheet says to hold the plunger up.",
        "Once the first reading is set, touch nothing of the gauge: not its bezel, not its stand, "
        "not its arm. If it was bumped, begin that setup again.",
        "Write what the dial shows, with its sign; guess the last digit. Write nothing where "
        "nothing was read.",
    ]
    how = ""
    if with_programs:
        shift = (options or ProgramOptions()).shift_mm
        added = (
            "no work offset"
            if not any(shift)
            else f"the world moved by {', '.join(f'{v:g}' for v in shift)} mm"
        )
        how = paragraph(
            f"Programs: G-code in mm, {added}, no tool length; they pause (M0) at each reading and "
            "go on by cycle start. Run the first one without a gauge, at a slow override. Keep "
            "the machine clear: they start from the mechanical zero."
        )
    blanks = "".join(
        f"<p>{escape(words)}: <span class='fill'>&nbsp;</span></p>"
        for words in ("Date, name", "Temperature at the beginning, at the end")
    )
    return (
        f"<header>{heading('Measuring sheet', level=1)}"
        f"{paragraph(f'{robot.name}: {session.title}' if session.title else robot.name)}"
        f"{paragraph(lead, kind='lead')}{blanks}</header>"
        + heading("Before the first reading", level=3)
        + _numbered(before)
        + heading("What holds all the time", level=3)
        + _numbered(rules)
        + heading("Setups, in this order", level=3)
        + table(headers, rows, left=3)
        + how
    )


def _setup(
    session: Session,
    motion: SetupMotion,
    standing: Standing,
    pictures: str,
    *,
    with_program: bool,
) -> str:
    title = f"Setup {motion.number} of {motion.count}: {motion.setup}"
    words = session.setups[motion.setup].sensor.describe()
    program = f" Program: {program_name(motion)}." if with_program else ""
    return (
        f'<section id="setup-{motion.number}">{heading(title)}'
        f"{paragraph(f'{words}.{program}', kind='lead')}"
        f'<div class="pictures">{pictures}</div>'
        f"{_numbered(_steps(session, motion, standing))}"
        f"{_warnings(session, motion, standing)}{_boxes(session, motion)}</section>"
    )


def _steps(session: Session, motion: SetupMotion, standing: Standing) -> list[str]:
    robot, first = session.robot, motion.stops[0]
    grows = direction_words(standing.contact.direction)
    gauge = session.gauges[session.setups[motion.setup].gauge]
    place = ", ".join(number(v / MM, 1) for v in standing.point)
    where = f"in the world at ({place}) mm"
    if standing.rod is not None and standing.leg is not None:
        what = f"rod {standing.rod.name} of leg {standing.leg.name}"
        reach = standing.from_root / MM
        where = (
            f"its {tip_words(standing.tip)} touches {_beside(standing)}, "
            f"{reach[standing.first]:.1f} mm from its hinge at the drive ({reach.min():.0f} to "
            f"{reach.max():.0f} mm as the leg moves); {where}"
        )
    elif standing.leg is not None:
        what = f"leg {standing.leg.name}"
        where = f"it touches the line between the rods; {where}"
    else:
        what = " ".join(standing.setup.sensor.place).strip()
        where = f"it touches {where}"
    opposite = direction_words(-standing.contact.direction)
    return [
        f"Go to the first posture, {first.posture}: joints {joint_list(robot, first.drives)}.",
        f"Stand the gauge on the base, on the {grows} side of {what}, its plunger pointing to "
        f"{opposite}: {where}.",
        f"Push the plunger in by hand, towards {grows}: does the dial grow? If it falls, write "
        "every reading of this setup with the opposite sign.",
        _set_zero(gauge, first),
        "Then read in the order below. Lines are those of readings.csv.",
    ]


def _beside(standing: Standing) -> str:
    """Where across the rod the tip touches in the first posture."""
    if np.linalg.norm(standing.aside) <= NOTICED:
        return "over the middle of the rod"
    return (
        f"{np.linalg.norm(standing.aside) / MM:.1f} mm beside the middle of the rod, towards "
        f"{direction_words(standing.aside)}"
    )


def _set_zero(gauge: Gauge, first: Stop) -> str:
    if gauge.range is None:
        how = "Set the dial to the middle of its range"
    else:
        low, high = (v / MM for v in gauge.range)
        middle = 0.5 * (low + high)
        how = (
            f"Move the gauge in until half of its travel ({0.5 * (high - low):g} mm) is taken, "
            f"and turn the bezel until it shows {middle:g}"
        )
    again = " Set it to the same again where the table says so." * (first.role == "taken off")
    return f"{how}, here only. Tap the stand: the hand must come back.{again}"


def _warnings(session: Session, motion: SetupMotion, standing: Standing) -> str:
    found = []
    near = standing.near_hinge
    if near is not None:
        found.append(
            f"The tip comes within {near / MM:.1f} mm of the middle of a hinge: look whether it "
            "stays clear of the bearing before you set it."
        )
    gauge = session.gauges[session.setups[motion.setup].gauge]
    if gauge.range is not None:
        half = 0.5 * (gauge.range[1] - gauge.range[0])
        beyond = [s for s in motion.stops if s.role == "reading" and abs(s.expected) > half]
        if beyond:
            found.append(
                f"Even a perfect machine would show {number(beyond[0].expected / MM, 1, sign=True)}"
                f" mm in {_name(beyond[0])}, more than the dial has to either side: take another "
                "posture, or another dial."
            )
    lifted = [s for s in motion.stops if s.lift]
    if lifted:
        found.append(
            f"Hold the plunger up on the way to "
            f"{', '.join(dict.fromkeys(_name(s) for s in lifted))}: {lifted[0].lift} there."
        )
    return "".join(paragraph(text, kind="warn") for text in found)


def _boxes(session: Session, motion: SetupMotion) -> str:
    """Rows to write into: line, posture, joints to command, tool, and a box."""
    robot = session.robot
    tool = motion.stops[0].point is not None
    letters = [] if robot.tcp is None or not tool else ["xyz"[c] for c in robot.tcp.coordinates]
    told = any(abs(s.expected) > NOTICED for s in motion.stops)
    headers = [
        ("line", "number"),
        ("posture", ""),
        *([(f"tool {', '.join(letters)} [mm]", "")] if letters else []),
        *((f"{d.name} [{DRIVE_UNITS[d.unit][0]}]", "number") for d in robot.drives),
        *([("perfect machine shows [mm]", "number")] if told else []),
        ("reading [mm]", ""),
        ("remarks", ""),
    ]
    head = "".join(f'<th class="{kind}">{escape(text)}</th>' for text, kind in headers)
    rows = []
    for stop in motion.stops:
        cells = [("" if stop.line is None else str(stop.line), "number"), (_posture(stop), "")]
        if tool and stop.point is not None:
            cells.append((", ".join(_short(v) for v in stop.point), ""))
        cells += [(text, "number") for text in joint_numbers(robot, stop.drives)]
        if told:
            cells.append((number(stop.expected / MM, 2, sign=True), "number"))
        body = "".join(f'<td class="{kind}">{escape(text)}</td>' for text, kind in cells)
        read = stop.role != "taken off"
        box = '<td class="box"></td>' if read else "<td>set to 0</td>"
        asked = "as at first?" if stop.role == "return" else ""
        rows.append(f'<tr>{body}{box}<td class="note">{asked}</td></tr>')
    return (
        f'<table class="boxes"><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table>'
    )


def _posture(stop: Stop) -> str:
    if stop.role == "return":
        return f"{stop.posture}, again"
    if stop.cycle == 1 or stop.role == "taken off":
        return stop.posture
    return f"{stop.posture}, cycle {stop.cycle}"


def _short(value: float) -> str:
    """A coordinate in mm, without zeros at its end."""
    return number(value / MM, 3).rstrip("0").rstrip(".")


def _name(stop: Stop) -> str:
    return stop.posture if stop.line is None else f"line {stop.line}"


def _afterwards() -> str:
    steps = [
        "`orthocal record` takes the readings one after the other and says at once what is odd. Or "
        "type them into readings.csv, column reading_mm, in its order; leave out lines that were "
        "not read. `orthocal import` takes them from a spreadsheet.",
        "The last reading of a setup in its first posture should be the first one again, to the "
        "dial's scatter. If it is not, the stand or the machine has moved: read that setup again.",
        "Then run:",
    ]
    return (
        f"<section class='last'>{heading('Afterwards')}{_numbered(steps)}"
        "<p><code>orthocal calibrate .</code></p></section>"
    )


def _numbered(texts: list[str]) -> str:
    return "<ol>" + "".join(f"<li>{escape(t)}</li>" for t in texts) + "</ol>"
