"""A machine of one's own: new."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orthocal.cli.options import Tolerances, app, require_no_readings
from orthocal.cli.printing import put_note, put_out
from orthocal.errors import OrthocalError, ParameterError, RobotError

if TYPE_CHECKING:
    from orthocal.planning.equipment import Means
    from orthocal.planning.plan import MeasuringPlan
    from orthocal.robot.model import Robot
    from orthocal.session.session import Session

FIRST = "first"
"""Folder of the first session, in that of the machine."""


@app.command()
def new(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Of the machine; it is made.")],
    leg_mm: Annotated[
        str | None, typer.Option("--leg-mm", help="Length of a leg, from hinge to hinge of a rod.")
    ] = None,
    travel_mm: Annotated[
        str | None,
        typer.Option(
            "--travel-mm",
            metavar="LEAST:LARGEST",
            help="Of a slider: the leg's length where legs are parallel to their axes, more "
            "further out.",
        ),
    ] = None,
    attachment_mm: Annotated[
        str | None,
        typer.Option("--attachment-mm", help="From slider to hinge, and from hinge to tool."),
    ] = None,
    rods_apart_mm: Annotated[
        str | None, typer.Option("--rods-apart-mm", help="The two rods of a leg, axis to axis.")
    ] = None,
    rod_radius_mm: Annotated[str | None, typer.Option("--rod-radius-mm", help="Of a rod.")] = None,
    counts: Annotated[
        str | None,
        typer.Option(
            metavar="up|down[,...]",
            help="How a joint's number goes as its slider moves outwards; for all, or x,y,z.",
        ),
    ] = None,
    at_zero_mm: Annotated[
        str | None,
        typer.Option(
            "--at-zero-mm",
            metavar="MM[,...]",
            help="What a joint shows where legs are parallel to their axes; for all, or x,y,z.",
        ),
    ] = None,
    paper: Annotated[
        bool, typer.Option("--paper", help="The paper's seven postures and six setups, no search.")
    ] = False,
    hours: Annotated[
        float | None, typer.Option(help="How long there is to measure; 6 setups by default.")
    ] = None,
    gauge: Annotated[
        Path | None,
        typer.Option(help="dial.yaml: what the dial is like; else ±5 mm, 10 µm, a ball of 3 mm."),
    ] = None,
    model: Annotated[str, typer.Option(help="What will be identified.")] = "full",
    tolerance: Tolerances = None,
    again: Annotated[
        bool,
        typer.Option("--again", help="Make URDF, YAML and sheets again from FOLDER/machine.yaml."),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Write over what is there.")] = False,
) -> None:
    """A machine of your own size, a plan for it, a measuring sheet and G-code.

    What is not given is asked for at a terminal.
    """
    given = {
        "--leg-mm": leg_mm,
        "--travel-mm": travel_mm,
        "--attachment-mm": attachment_mm,
        "--rods-apart-mm": rods_apart_mm,
        "--rod-radius-mm": rod_radius_mm,
        "--counts": counts,
        "--at-zero-mm": at_zero_mm,
    }
    if again:
        found = next((option for option, value in given.items() if value is not None), None)
        if found:
            raise ParameterError("found with --again, which takes machine.yaml's", where=found)
        _make_again(folder)
        return
    if paper and hours is not None:
        raise ParameterError("found with --paper, whose setups are given", where="--hours")
    from orthocal.cli.dialogue import ask_tolerance, find_answers
    from orthocal.io.files import write_files
    from orthocal.robot.builder.build import describe_machine
    from orthocal.robot.loading import load_robot

    name = _require_new(folder, force=force)
    means = _means(gauge)
    answers = find_answers(given)
    if tolerance is None and None in given.values():
        tolerance = ask_tolerance()
    files = describe_machine(answers.sizes, name=name, counting=answers.counting, where=str(folder))
    with tempfile.TemporaryDirectory(prefix="orthocal-") as trial:
        write_files(Path(trial) / name, files)
        robot = load_robot(Path(trial) / name)
        plan, session = _plan(robot, means, paper=paper, hours=hours, model=model, given=tolerance)
        extra = _extra(plan, session)
    stated = session.robot.parameters.stated
    files = describe_machine(
        answers.sizes,
        name=name,
        counting=answers.counting,
        where=str(folder),
        tolerances=stated,
    )
    write_files(folder, files)
    own = load_robot(folder).with_tolerances(stated)
    session = replace(session, robot=own, robot_reference=str(folder.resolve()))
    _write(session, folder / FIRST, extra)
    _tell(folder, answers.sizes.words, plan, session, extra)


def _require_new(folder: Path, *, force: bool) -> str:
    """Refuse a folder that holds such a machine, or cannot; its name."""
    from orthocal.io.files import exists, require_plain_name, require_writable
    from orthocal.robot.builder.machine_file import MACHINE
    from orthocal.robot.loading import packaged_robots

    name = folder.resolve().name
    if not name:
        raise RobotError("has no name; expected a folder", where=str(folder))
    require_plain_name(folder.resolve(), error=RobotError)
    if name in packaged_robots():
        raise RobotError(
            f"'{name}' is a robot that comes with orthocal; name yours otherwise", where=str(folder)
        )
    require_writable(folder)
    require_writable(folder / FIRST)
    there = [MACHINE, f"{name}.yaml", f"{name}.urdf"]
    there += [f"{FIRST}/{file}" for file in ("session.yaml", "readings.csv", "sheet.html")]
    for file in there:
        if exists(folder / file) and not force:
            raise RobotError("is there already; --force writes over it", where=str(folder / file))
    require_no_readings(folder / FIRST)
    return name


def _means(gauge: Path | None) -> Means:
    from orthocal.planning.equipment import Means
    from orthocal.planning.gauge_range import load_dial

    return Means() if gauge is None else load_dial(gauge, Means())


def _plan(
    robot: Robot,
    means: Means,
    *,
    paper: bool,
    hours: float | None,
    model: str,
    given: list[str] | None,
) -> tuple[MeasuringPlan | None, Session]:
    """The plan, and its session with no offsets active; no plan where it is the paper's."""
    from orthocal.estimation.choice import Choice
    from orthocal.estimation.selection import read_tolerances
    from orthocal.planning.first_plan import first_means, paper_plan
    from orthocal.planning.plan import plan_readings
    from orthocal.session.session import Purpose

    tolerances = read_tolerances(given or [], robot.parameters, where="--tolerance")
    choice = Choice(model, tolerances=tolerances)
    choice.select(robot.parameters)
    zeros = [0.0] * len(robot.drives)
    if paper:
        session = paper_plan(robot, means).with_tolerances(tolerances).with_controller(zeros)
        return None, replace(session, purpose=Purpose(model))
    found = plan_readings(
        robot,
        choice,
        hours=hours,
        means=first_means(robot, means),
        report=lambda text: put_note(f"orthocal: {text}"),
    )
    return found, found.session.with_controller(zeros)


def _extra(plan: MeasuringPlan | None, session: Session) -> dict[str, str]:
    """Files beside session.yaml and readings.csv."""
    from orthocal.output.sheet.page import sheet_files
    from orthocal.output.text.plan import draw_plan, plan_json

    drawn = {} if plan is None else {"plan.json": plan_json(plan), "plan.svg": draw_plan(plan)}
    return {**sheet_files(session), **drawn}


def _write(session: Session, folder: Path, extra: dict[str, str]) -> None:
    from orthocal.measurement.files.write_session import write_session

    comment = (
        "A plan: print sheet.html and measure; `orthocal record .` in this folder leads through "
        "it, or\nfill in readings.csv in its order. Then\n"
        "orthocal calibrate .\n"
        "offsets_mm: those that are active in the controller while it is measured."
    )
    write_session(session, folder, comment=comment, extra=extra, blank=True)


def _tell(
    folder: Path,
    sizes: str,
    plan: MeasuringPlan | None,
    session: Session,
    extra: dict[str, str],
) -> None:
    """What was made, what it is worth, and what to do with it."""
    from orthocal.output.text.layout import counted
    from orthocal.output.text.plan import first_round_words
    from orthocal.units import UM

    readings = counted(len(session.readings), "reading")
    setups = counted(len(session.setups), "setup")
    worth = early = ""
    if plan is not None:
        after, before = (
            f"{float(f'{e.headline.rms / UM:.3g}'):g}" for e in (plan.expected, plan.known)
        )
        worth = (
            f", about {plan.minutes:.0f} min: {after} µm at the tool are to be expected, instead "
            f"of {before} µm without them"
        )
        early = f"{first_round_words(plan)}\n" if first_round_words(plan) else ""
    programs = sum(name.endswith(".ngc") for name in extra)
    put_out(
        f"{folder.resolve().name}: {sizes}.\n"
        f"Plan: {readings} in {setups}{worth}.\n{early}"
        f"Wrote {folder}: machine.yaml holds every size; after a change there run\n"
        f"  orthocal new {folder} --again\n"
        f"Wrote {folder / FIRST}: session.yaml, readings.csv to fill in, sheet.html to print, and\n"
        f"{counted(programs, 'program')} in G-code, one a setup. Next: look at the machine, print "
        "the sheet, measure\n(`record` leads through it and keeps the readings), and calibrate:\n"
        f"  orthocal view {folder}\n"
        f"  orthocal record {folder / FIRST}\n"
        f"  orthocal calibrate {folder / FIRST}"
    )


def _make_again(folder: Path) -> None:
    """Robot and sheets of a machine, from its machine.yaml."""
    from orthocal.io.files import exists, write_files
    from orthocal.measurement.files.session_file import load_plan
    from orthocal.output.sheet.page import SHEET, sheet_files
    from orthocal.robot.builder.build import remake_robot

    robot = remake_robot(folder)
    put_out(f"Made {robot.yaml.name} and {robot.urdf.name} again from {folder / 'machine.yaml'}.")
    refused = False
    for sheet in sorted(folder.glob(f"*/{SHEET}")):
        if not exists(sheet.parent / "session.yaml"):
            continue
        try:
            session = load_plan(sheet.parent)
            if any(r.value for r in session.readings):
                put_note(
                    f"orthocal: {sheet.parent}: has readings, whose postures were other joint "
                    "coordinates before; they belong to the sizes of that day"
                )
                continue
            write_files(sheet.parent, sheet_files(session))
            put_out(f"Made {sheet} and its programs again.")
        except OrthocalError as e:
            refused = True
            put_note(f"orthocal: {e}")
            put_note(f"orthocal: {sheet} is not for these sizes any more; plan again")
    if refused:
        raise typer.Exit(3)
