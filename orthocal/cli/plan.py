"""What to measure: plan."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orthocal.cli.options import (
    Json,
    Tolerances,
    app,
    require_cube,
    require_no_readings,
    split_globs,
)
from orthocal.cli.printing import put_note, put_out
from orthocal.cli.sheet import sheet_or_problem
from orthocal.errors import ParameterError, SessionError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from orthocal.planning.equipment import Means
    from orthocal.robot.model import Robot
    from orthocal.session.session import Session

KILLED = "a process that drew the plan was killed"

FILES = ("session.yaml", "readings.csv", "plan.json", "plan.svg", "sheet.html")


@app.command()
def plan(
    subject: Annotated[
        str,
        typer.Argument(
            metavar="ROBOT|SESSION",
            help="A robot; or a session that was measured, for readings on top of it.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for session.yaml, an empty readings.csv and a sheet."),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(help="What will be identified: full, or what the session is for."),
    ] = None,
    setups: Annotated[int | None, typer.Option(min=1, help="How many; 6 by default.")] = None,
    readings: Annotated[
        int | None, typer.Option(min=2, help="In all setups together; 3 a setup by default.")
    ] = None,
    hours: Annotated[
        float | None, typer.Option(help="How long there is, instead of both numbers.")
    ] = None,
    add: Annotated[
        int | None, typer.Option(min=1, help="How many further setups, of a session.")
    ] = None,
    gauge: Annotated[
        Path | None,
        typer.Option(help="dial.yaml: what the dial is like; else ±5 mm, 10 µm, a ball of 3 mm."),
    ] = None,
    touches: Annotated[
        str | None, typer.Option(metavar="RODS", help="That can be touched, with commas between.")
    ] = None,
    sections: Annotated[
        str | None,
        typer.Option(metavar="PARTS", help="Of a leg's length, from its root: 0.25,0.5,0.75."),
    ] = None,
    box: Annotated[
        str | None,
        typer.Option(
            metavar="LOW:HIGH,...",
            help="Where the tool may go, mm for each coordinate; by default up to 100 mm.",
        ),
    ] = None,
    along: Annotated[int, typer.Option(min=2, max=50, help="Places on a leg's own way.")] = 9,
    across_mm: Annotated[
        float, typer.Option("--across-mm", help="How far beside that way, mm to either side.")
    ] = 20.0,
    minutes_a_setup: Annotated[float, typer.Option(help="That a setup takes.")] = 10.0,
    minutes_a_reading: Annotated[float, typer.Option(help="That a reading takes.")] = 0.5,
    half_side_mm: Annotated[
        float | None,
        typer.Option("--half-side-mm", help="Half the side of the cube that counts."),
    ] = None,
    criterion: Annotated[
        str,
        typer.Option(
            metavar="aligned|relative|absolute|worst|A|D|E", help="What is to become small."
        ),
    ] = "aligned",
    tolerance: Tolerances = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the search's random starts.")] = 0,
    starts: Annotated[
        int | None, typer.Option(min=1, max=100, help="How often the search begins anew.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Processes; by default all cores.")
    ] = None,
    json: Json = False,
    details: Annotated[
        bool, typer.Option("--details", help="Say what it still cannot tell apart, too.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Write over a session that is there.")
    ] = False,
) -> None:
    """Which setups and readings tell most, and what they will be worth, before any is taken."""
    from orthocal.estimation.choice import Choice
    from orthocal.estimation.selection import read_tolerances
    from orthocal.io.files import exists, require_writable
    from orthocal.measurement.files.write_session import write_session
    from orthocal.output.text.plan import draw_plan, plan_json
    from orthocal.output.text.summary import print_summary
    from orthocal.planning.expected_error import CRITERIA
    from orthocal.planning.plan import plan_readings
    from orthocal.runtime.worker_pool import available_cores, call_in_parallel, worker_budget
    from orthocal.units import MM

    if criterion not in CRITERIA:
        raise ParameterError(
            f"found '{criterion}'; expected one of {', '.join(CRITERIA)}", where="--criterion"
        )
    if out is not None:
        require_writable(out)
        for name in FILES:
            if exists(out / name) and not force:
                raise SessionError(
                    "is there already; --force writes over it", where=str(out / name)
                )
        require_no_readings(out)
    robot, measured, reference = _load(subject)
    if add is not None and measured is None:
        raise ParameterError("is of a session; this is a robot", where="--add")
    if add is not None and setups is not None:
        raise ParameterError("found with --setups; expected one", where="--add")
    means = _means(
        gauge,
        measured,
        rods=tuple(split_globs([touches] if touches else None)),
        sections=_numbers(sections, "--sections"),
        box=_box(box, robot),
        along=along,
        across=across_mm * MM,
        minutes=(minutes_a_setup, minutes_a_reading),
    )
    tolerances = read_tolerances(tolerance or [], robot.parameters, where="--tolerance")
    workspace = None if half_side_mm is None else require_cube(robot, half_side_mm)
    count = workers or available_cores()
    found = plan_readings(
        robot,
        Choice(model, tolerances=tolerances),
        setups=setups if add is None else add,
        readings=readings,
        hours=hours,
        means=means,
        measured=measured,
        workspace=workspace,
        criterion=criterion,
        seed=seed,
        starts=starts,
        reference=reference,
        workers=count,
        report=lambda text: put_note(f"orthocal: {text}"),
    )
    document = plan_json(found)
    if json:
        put_out(document.rstrip("\n"))
    else:
        print_summary(found, details=details)
    if gauge is not None and means.tip is None:
        put_note(
            f"orthocal: {gauge} names no tip: readings are planned of the line between the rods, "
            "which no dial touches; with tip: {ball: {radius_mm: 1.5}} of what it touches"
        )
    if out is not None:
        comment = (
            "A plan: here `orthocal record .` leads through it, or fill in readings.csv; then\n"
            "orthocal calibrate .\n"
            "State the offsets that are active in the controller meanwhile, such as\n"
            "controller: {offsets_mm: [0, 0, 0]}, one number a drive.\n"
            "Approach every posture from the same side; the last reading of a setup is its first\n"
            "posture again."
        )
        calls = [lambda: sheet_or_problem(found.session), lambda: draw_plan(found)]
        with worker_budget(count):
            (sheet, problem), picture = call_in_parallel(calls, killed=KILLED)
        if problem:
            put_note(problem)
        extra = {"plan.json": document, "plan.svg": picture} | sheet
        path = write_session(found.session, out, comment=comment, extra=extra, blank=True)
        paper = ", sheet.html and its programs" if "sheet.html" in extra else ""
        put_note(f"Wrote {path}, readings.csv to fill in, plan.json, plan.svg{paper}")


def _load(subject: str) -> tuple[Robot, Session | None, str]:
    """A robot, the session that was measured on it, and how a session names the robot."""
    from orthocal.output.text.subject import load_subject
    from orthocal.robot.model import Robot
    from orthocal.session.session import Session

    found = load_subject(subject)
    if isinstance(found, Session):
        from orthocal.measurement.files.session_file import load_session

        measured = load_session(subject)
        return measured.robot, measured, measured.robot_reference
    if isinstance(found, Robot):
        return found, None, subject
    raise ParameterError("is a calibration; expected a robot or a session", where=subject)


def _means(
    gauge: Path | None,
    measured: Session | None,
    *,
    rods: tuple[str, ...],
    sections: tuple[float, ...] | None,
    box: NDArray[np.float64] | None,
    along: int,
    across: float,
    minutes: tuple[float, float],
) -> Means:
    from orthocal.planning.equipment import SECTIONS, Means
    from orthocal.planning.gauge_range import load_dial, means_of

    for name, value in (("--minutes-a-setup", minutes[0]), ("--minutes-a-reading", minutes[1])):
        if not 0.0 < value < 1e4:
            raise ParameterError(f"found {value:g}; expected a number above 0", where=name)
    if not 0.0 <= across < 1.0:
        raise ParameterError("expected 0 or more, and less than 1000 mm", where="--across-mm")
    own = Means(
        rods=rods,
        sections=sections or SECTIONS,
        box=box,
        along=along,
        across=across,
        minutes_a_setup=minutes[0],
        minutes_a_reading=minutes[1],
    )
    if gauge is not None:
        return load_dial(gauge, own)
    return own if measured is None else means_of(measured, own)


def _numbers(text: str | None, option: str) -> tuple[float, ...] | None:
    if text is None:
        return None
    from orthocal.io.documents import parse_number

    values = tuple(
        parse_number(part.strip(), where=option, name="part", error=ParameterError)
        for part in text.split(",")
    )
    for value in values:
        if not 0.0 <= value <= 1.0:
            raise ParameterError(f"found {value:g}; expected 0 (root) to 1 (tip)", where=option)
    return values


def _box(text: str | None, robot: Robot) -> NDArray[np.float64] | None:
    """Least and largest tool coordinates, [m]."""
    if text is None:
        return None
    import numpy as np

    from orthocal.io.documents import parse_number
    from orthocal.units import MM

    count = 0 if robot.tcp is None else len(robot.tcp.coordinates)
    rows = []
    for part in text.split(","):
        low, colon, high = part.partition(":")
        if not colon:
            raise ParameterError(f"found '{part}'; expected LOW:HIGH, in mm", where="--box")
        ends = [
            parse_number(v.strip(), where="--box", name="end", error=ParameterError) * MM
            for v in (low, high)
        ]
        if not ends[0] < ends[1]:
            raise ParameterError(f"found '{part}'; expected LOW:HIGH, in mm", where="--box")
        rows.append(ends)
    if len(rows) == 1:
        rows *= count
    if len(rows) != count:
        raise ParameterError(
            f"has {len(rows)} coordinates; expected 1 for all, or {count}", where="--box"
        )
    return np.array(rows)
