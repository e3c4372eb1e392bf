"""Measuring plan: plan."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orthocal.cli.options import (
    Json,
    Tolerances,
    app,
    read_box,
    read_workspace,
    require_no_readings,
    split_globs,
)
from orthocal.cli.printing import put_note, put_out
from orthocal.cli.sheet import sheet_or_problem
from orthocal.errors import ParameterError, SessionError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from orthocal.planning.equipment import Equipment
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
            help="A robot, or a measured session that the plan complements.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="Directory for session.yaml, an empty readings.csv and a sheet."),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(help="Model to identify; by default full, or that of the session."),
    ] = None,
    setups: Annotated[
        int | None, typer.Option(min=1, help="Number of setups; 6 by default.")
    ] = None,
    readings: Annotated[
        int | None,
        typer.Option(min=2, help="Number of readings in all setups; 3 per setup by default."),
    ] = None,
    hours: Annotated[
        float | None, typer.Option(help="Available time, instead of both numbers.")
    ] = None,
    add: Annotated[
        int | None, typer.Option(min=1, help="Number of further setups for a session.")
    ] = None,
    gauge: Annotated[
        Path | None,
        typer.Option(help="dial.yaml, data of the gauge; by default ±5 mm, 10 µm, ball of 3 mm."),
    ] = None,
    touches: Annotated[
        str | None,
        typer.Option(metavar="RODS", help="Rods that the gauge can touch, with commas between."),
    ] = None,
    sections: Annotated[
        str | None,
        typer.Option(
            metavar="FRACTIONS",
            help="Sections as fractions of a leg's length from its root; 0.25,0.5,0.75 by default.",
        ),
    ] = None,
    box: Annotated[
        str | None,
        typer.Option(
            metavar="LOW:HIGH,...",
            help="Region of the postures, mm, one range for all coordinates or one for each; up "
            "to 100 mm from the mechanical zero by default.",
        ),
    ] = None,
    along: Annotated[
        int, typer.Option(min=2, max=50, help="Number of positions along a leg's direction.")
    ] = 9,
    across_mm: Annotated[
        float,
        typer.Option("--across-mm", help="Displacement across that direction, to either side."),
    ] = 20.0,
    minutes_a_setup: Annotated[float, typer.Option(help="Duration of a setup.")] = 10.0,
    minutes_a_reading: Annotated[float, typer.Option(help="Duration of a reading.")] = 0.5,
    workspace_mm: Annotated[
        str | None,
        typer.Option(
            "--workspace-mm",
            metavar="HALF|LOW:HIGH,...",
            help="Workspace instead of the robot's: half the side of a cube around the mechanical "
            "zero, or a range for each coordinate.",
        ),
    ] = None,
    criterion: Annotated[
        str,
        typer.Option(
            metavar="aligned|relative|absolute|worst|A|D|E", help="Criterion to minimise."
        ),
    ] = "aligned",
    tolerance: Tolerances = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the search's random starts.")] = 0,
    starts: Annotated[
        int | None, typer.Option(min=1, max=100, help="Number of starts of the search.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Number of processes; all cores by default.")
    ] = None,
    json: Json = False,
    details: Annotated[
        bool, typer.Option("--details", help="List the largest remaining errors, too.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Overwrite a session without readings.")
    ] = False,
) -> None:
    """Choose setups and readings for the smallest expected tool error, before measuring."""
    from orthocal.estimation.choice import Choice
    from orthocal.estimation.selection import read_tolerances
    from orthocal.io.files import exists, require_writable
    from orthocal.kinematics.workspace import box_workspace
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
                raise SessionError("exists already; --force overwrites it", where=str(out / name))
        require_no_readings(out)
    robot, measured, reference = _load(subject)
    if add is not None and measured is None:
        raise ParameterError("needs a session; found a robot", where="--add")
    if add is not None and setups is not None:
        raise ParameterError("found with --setups; expected one", where="--add")
    equipment = _equipment(
        gauge,
        measured,
        rods=tuple(split_globs([touches] if touches else None)),
        sections=_numbers(sections, "--sections"),
        box=_region(box, robot),
        along=along,
        across=across_mm * MM,
        minutes=(minutes_a_setup, minutes_a_reading),
    )
    tolerances = read_tolerances(tolerance or [], robot.parameters, where="--tolerance")
    workspace = None
    if workspace_mm is not None:
        workspace = box_workspace(robot, read_workspace(workspace_mm, robot))
    count = workers or available_cores()
    found = plan_readings(
        robot,
        Choice(model, tolerances=tolerances),
        setups=setups if add is None else add,
        readings=readings,
        hours=hours,
        equipment=equipment,
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
    if gauge is not None and equipment.tip is None:
        put_note(
            f"orthocal: {gauge} states no tip: the plan is for the line between the rods, which "
            "no dial touches; for a ball add tip: {ball: {radius_mm: 1.5}}"
        )
    if out is not None:
        comment = (
            "A plan: run `orthocal record .` in this directory, or fill in readings.csv; then\n"
            "orthocal calibrate .\n"
            "State the offsets that are active in the controller during the measurement, such as\n"
            "controller: {offsets_mm: [0, 0, 0]}, one number for each drive.\n"
            "Approach every posture from the same side. The last reading of a setup is its first\n"
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
        put_note(f"Wrote {path}, an empty readings.csv, plan.json, plan.svg{paper}")


def _load(subject: str) -> tuple[Robot, Session | None, str]:
    """Robot, measured session, and the name of the robot in a session."""
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


def _equipment(
    gauge: Path | None,
    measured: Session | None,
    *,
    rods: tuple[str, ...],
    sections: tuple[float, ...] | None,
    box: NDArray[np.float64] | None,
    along: int,
    across: float,
    minutes: tuple[float, float],
) -> Equipment:
    from orthocal.planning.equipment import SECTIONS, Equipment, equipment_of, load_dial

    for name, value in (("--minutes-a-setup", minutes[0]), ("--minutes-a-reading", minutes[1])):
        if not 0.0 < value < 1e4:
            raise ParameterError(f"found {value:g}; expected a number above 0", where=name)
    if not 0.0 <= across < 1.0:
        raise ParameterError("expected 0 or more, and less than 1000 mm", where="--across-mm")
    own = Equipment(
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
    return own if measured is None else equipment_of(measured, own)


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


def _region(text: str | None, robot: Robot) -> NDArray[np.float64] | None:
    """Region of the postures: limits of the tool's coordinates, shape (n_coordinates, 2), [m]."""
    if text is None:
        return None
    from orthocal.kinematics.workspace import coordinate_letters

    return read_box(text, coordinate_letters(robot), where="--box")
