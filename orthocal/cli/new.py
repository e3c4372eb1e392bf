"""A machine of given dimensions, its first plan and its measuring sheet: new."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orthocal.cli.options import Tolerances, app, read_workspace, require_no_readings
from orthocal.cli.printing import put_note, put_out
from orthocal.errors import OrthocalError, ParameterError, RobotError

if TYPE_CHECKING:
    from orthocal.planning.equipment import Equipment
    from orthocal.planning.plan import MeasuringPlan
    from orthocal.robot.builder.machine_file import Counting, Dimensions
    from orthocal.robot.model import Robot
    from orthocal.session.session import Session

FIRST = "first"
"""Directory of the first session, in that of the machine."""


@app.command()
def new(
    folder: Annotated[
        Path, typer.Argument(metavar="DIRECTORY", help="Directory of the machine; it is created.")
    ],
    leg_mm: Annotated[
        str | None, typer.Option("--leg-mm", help="Length of a leg, from hinge to hinge of a rod.")
    ] = None,
    travel_mm: Annotated[
        str | None,
        typer.Option(
            "--travel-mm",
            metavar="LEAST:LARGEST",
            help="Travel of a slider. Its coordinate is the leg length where the legs are parallel "
            "to their axes, and more further out.",
        ),
    ] = None,
    attachment_mm: Annotated[
        str | None,
        typer.Option(
            "--attachment-mm", help="Distance from slider to hinge, and from hinge to tool."
        ),
    ] = None,
    rods_apart_mm: Annotated[
        str | None,
        typer.Option("--rods-apart-mm", help="Distance of the axes of a leg's two rods."),
    ] = None,
    rod_radius_mm: Annotated[
        str | None, typer.Option("--rod-radius-mm", help="Radius of a rod.")
    ] = None,
    counts: Annotated[
        str | None,
        typer.Option(
            metavar="up|down[,...]",
            help="Direction in which a joint of the controller counts as its slider moves "
            "outwards: one for all, or x,y,z.",
        ),
    ] = None,
    at_zero_mm: Annotated[
        str | None,
        typer.Option(
            "--at-zero-mm",
            metavar="MM[,...]",
            help="Coordinate that the controller shows where the legs are parallel to their axes: "
            "one for all, or x,y,z.",
        ),
    ] = None,
    workspace_mm: Annotated[
        str | None,
        typer.Option(
            "--workspace-mm",
            metavar="HALF|LOW:HIGH,...",
            help="Workspace around the mechanical zero: half the side of a cube, or a range for "
            "each of x,y,z; by default the largest cube of at most ±60 mm in reach.",
        ),
    ] = None,
    paper: Annotated[
        bool,
        typer.Option("--paper", help="Use the paper's seven postures and six setups; no search."),
    ] = False,
    hours: Annotated[
        float | None, typer.Option(help="Time available for measuring; 6 setups by default.")
    ] = None,
    gauge: Annotated[
        Path | None,
        typer.Option(help="dial.yaml, data of the gauge; by default ±5 mm, 10 µm, ball of 3 mm."),
    ] = None,
    model: Annotated[str | None, typer.Option(help="Model to identify; full by default.")] = None,
    tolerance: Tolerances = None,
    again: Annotated[
        bool,
        typer.Option(
            "--again", help="Make URDF, YAML and sheets again from DIRECTORY/machine.yaml."
        ),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Overwrite existing files.")] = False,
) -> None:
    """Make a machine of your dimensions, a plan, a measuring sheet and G-code.

    Missing dimensions are asked for at a terminal. Exit code 3 with --again: a plan is old.
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
        options = {**given, "--workspace-mm": workspace_mm}
        found = next((option for option, value in options.items() if value is not None), None)
        if found:
            raise ParameterError("found with --again, which reads machine.yaml", where=found)
        _make_again(folder)
        return
    if paper and hours is not None:
        raise ParameterError("found with --paper, whose setups are fixed", where="--hours")
    from orthocal.cli.dialogue import ask_tolerance, find_answers
    from orthocal.io.files import write_files
    from orthocal.robot.builder.build import describe_machine
    from orthocal.robot.loading import load_robot

    name = _require_new(folder, force=force)
    equipment = _equipment(gauge)
    answers = find_answers(given)
    dimensions = _with_workspace(
        answers.dimensions, answers.counting, workspace_mm, asked=None in given.values()
    )
    if tolerance is None and None in given.values():
        tolerance = ask_tolerance()

    def describe(tolerances: Mapping[str, float] | None = None) -> dict[str, str]:
        return describe_machine(
            dimensions,
            name=name,
            counting=answers.counting,
            where=str(folder),
            tolerances=tolerances,
        )

    with tempfile.TemporaryDirectory(prefix="orthocal-") as trial:
        write_files(Path(trial) / name, describe())
        robot = load_robot(Path(trial) / name)
        plan, session = _plan(
            robot, equipment, paper=paper, hours=hours, model=model, given=tolerance
        )
        put_note("orthocal: drawing the measuring sheet")
        extra = _extra(plan, session)
    stated = session.robot.parameters.stated
    write_files(folder, describe(stated))
    own = load_robot(folder).with_tolerances(stated)
    session = replace(session, robot=own, robot_reference=str(folder.resolve()))
    _write(session, folder / FIRST, extra)
    _report(folder, dimensions.words, plan, session, extra)


def _require_new(folder: Path, *, force: bool) -> str:
    """Name of a directory; refuse one that is in use or cannot be written."""
    from orthocal.io.files import exists, require_plain_name, require_writable
    from orthocal.robot.builder.machine_file import MACHINE
    from orthocal.robot.loading import packaged_robots

    name = folder.resolve().name
    if not name:
        raise RobotError("has no name; expected a directory", where=str(folder))
    require_plain_name(folder.resolve(), error=RobotError)
    if f"{name}.yaml" == MACHINE:
        raise RobotError(
            f"'{name}' would name its YAML {MACHINE}, which holds the dimensions; choose another "
            "name",
            where=str(folder),
        )
    if name in packaged_robots():
        raise RobotError(
            f"'{name}' is a robot that comes with orthocal; choose another name", where=str(folder)
        )
    require_writable(folder)
    require_writable(folder / FIRST)
    files = [MACHINE, f"{name}.yaml", f"{name}.urdf"]
    files += [f"{FIRST}/{file}" for file in ("session.yaml", "readings.csv", "sheet.html")]
    for file in files:
        if exists(folder / file) and not force:
            raise RobotError("exists already; --force overwrites it", where=str(folder / file))
    require_no_readings(folder / FIRST)
    return name


def _equipment(gauge: Path | None) -> Equipment:
    from orthocal.planning.equipment import Equipment, load_dial

    return Equipment() if gauge is None else load_dial(gauge, Equipment())


def _with_workspace(
    dimensions: Dimensions,
    counting: tuple[Counting, Counting, Counting],
    option: str | None,
    *,
    asked: bool,
) -> Dimensions:
    """Dimensions with the workspace of the option or of an answer; unchanged for the default.

    Raises:
        ParameterError: If the machine does not reach the workspace.
    """
    if option is None and not asked:
        return dimensions
    from orthocal.cli.dialogue import Box, ask_workspace
    from orthocal.kinematics.workspace import describe_box, find_workspace
    from orthocal.robot.builder.build import make_robot

    with tempfile.TemporaryDirectory(prefix="orthocal-") as trial:
        robot = make_robot(dimensions, Path(trial) / "trial", counting=counting)

        def read(text: str) -> Box:
            low_high = read_workspace(text, robot).tolist()
            return tuple((low, high) for low, high in low_high)

        if option is not None:
            return replace(dimensions, workspace=read(option))
        usual = describe_box(find_workspace(robot).limits)
        return replace(dimensions, workspace=ask_workspace(usual, read))


def _plan(
    robot: Robot,
    equipment: Equipment,
    *,
    paper: bool,
    hours: float | None,
    model: str | None,
    given: list[str] | None,
) -> tuple[MeasuringPlan | None, Session]:
    """Plan, and its session with no active offsets; no plan for the paper's readings."""
    from orthocal.estimation.choice import Choice
    from orthocal.estimation.selection import read_tolerances
    from orthocal.planning.first_plan import first_equipment, paper_plan
    from orthocal.planning.plan import MODEL, plan_readings
    from orthocal.session.session import Purpose

    tolerances = read_tolerances(given or [], robot.parameters, where="--tolerance")
    model = model or MODEL
    choice = Choice(model, tolerances=tolerances)
    choice.select(robot.parameters)
    zeros = [0.0] * len(robot.drives)
    if paper:
        session = paper_plan(robot, equipment).with_tolerances(tolerances).with_controller(zeros)
        return None, replace(session, purpose=Purpose(model))
    found = plan_readings(
        robot,
        choice,
        hours=hours,
        equipment=first_equipment(robot, equipment),
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
        "A plan. Print sheet.html and measure: run `orthocal record .` in this directory, or fill\n"
        "in readings.csv in its order. Then\n"
        "orthocal calibrate .\n"
        "offsets_mm: those that are active in the controller during the measurement."
    )
    write_session(session, folder, comment=comment, extra=extra, blank=True)


def _report(
    folder: Path,
    dimensions: str,
    plan: MeasuringPlan | None,
    session: Session,
    extra: dict[str, str],
) -> None:
    """Print the plan's value, the files and the next commands."""
    from orthocal.output.text.layout import counted
    from orthocal.output.text.plan import first_round_words, show_duration, show_um

    lines = []
    readings = counted(len(session.readings), "reading")
    setups = counted(len(session.setups), "setup")
    if plan is None:
        lines.append(f"Plan: {readings} in {setups}.")
    else:
        lines += [
            f"Plan: {readings} in {setups}, about {show_duration(plan.minutes)}.",
            f"Expected tool error: {show_um(plan.expected)} µm (now {show_um(plan.known)} µm), "
            f"{plan.forecast.workspace.words.removeprefix('the ')}, workpiece aligned on the "
            "machine.",
            *([first_round_words(plan)] if first_round_words(plan) else []),
        ]
    programs = sum(name.endswith(".ngc") for name in extra)
    put_out(
        "\n".join(
            [
                *lines,
                f"Wrote {folder}: {dimensions}.",
                f"To change a dimension, edit {folder / 'machine.yaml'}, then run",
                f"  orthocal new {folder} --again",
                f"Wrote {folder / FIRST}: session.yaml, readings.csv, sheet.html and "
                f"{counted(programs, 'program')} in G-code.",
                "Next: look at the machine, print the sheet, measure and calibrate:",
                f"  orthocal view {folder}",
                f"  orthocal record {folder / FIRST}",
                f"  orthocal calibrate {folder / FIRST}",
            ]
        )
    )


def _make_again(folder: Path) -> None:
    """Make robot and sheets of a machine again from its machine.yaml; name plans that are old."""
    from orthocal.io.files import exists, write_files
    from orthocal.kinematics.workspace import find_unreached
    from orthocal.measurement.files.session_file import load_plan
    from orthocal.output.sheet.page import SHEET, sheet_files
    from orthocal.robot.builder.build import remake_robot

    def check(robot: Robot) -> None:
        problem = "" if robot.workspace is None else find_unreached(robot, robot.workspace)
        if problem:
            raise RobotError(problem, where=f"{folder / 'machine.yaml'}: workspace_mm")

    robot = remake_robot(folder, check=check)
    put_out(f"Made {robot.yaml.name} and {robot.urdf.name} again from {folder / 'machine.yaml'}.")
    old = False
    for sheet in sorted(folder.glob(f"*/{SHEET}")):
        if not exists(sheet.parent / "session.yaml"):
            continue
        try:
            session = load_plan(sheet.parent)
            if any(r.value for r in session.readings):
                put_note(
                    f"orthocal: {sheet.parent}: has readings, which belong to the dimensions of "
                    "their day; its sheet is unchanged"
                )
                continue
            write_files(sheet.parent, sheet_files(session))
            put_out(f"Made {sheet} and its programs again.")
            changes = _changes_since(sheet.parent, robot)
        except OrthocalError as e:
            put_note(f"orthocal: {e}")
            changes = ["the machine does not reach its postures"]
        if changes:
            old = True
            put_note(
                f"orthocal: {sheet.parent}: the plan is old ({'; '.join(changes)}); plan again:\n"
                f"  orthocal plan {folder} --out {sheet.parent} --force"
            )
    if old:
        raise typer.Exit(3)


def _changes_since(folder: Path, robot: Robot) -> list[str]:
    """Differences of travel and workspace from those for which a plan was made.

    Raises:
        OrthocalError: If plan.json cannot be read.
    """
    from orthocal.io.files import exists, read_file
    from orthocal.output.text.plan import PLAN_BASIS, describe_basis

    file = folder / "plan.json"
    if not exists(file):  # the paper's plan depends on neither
        return []
    try:
        document = json.loads(read_file(file, error=RobotError))
    except ValueError:
        raise RobotError("is no JSON", where=str(file)) from None
    now = describe_basis(robot)
    before = {k: document[k] for k in PLAN_BASIS if k in document}
    return [f"{PLAN_BASIS[k]} changed" for k, value in before.items() if value != now[k]]
