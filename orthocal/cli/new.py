"""The command `new`."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import typer

import orthocal
from orthocal.cli.options import (
    ControllerOptions,
    command,
    read_pairs,
    read_temperatures,
    read_tolerances,
    read_workspace,
    split_effects,
)
from orthocal.cli.overwriting import READINGS, count_numbers, require_new_session, write_plan
from orthocal.cli.printing import put_note, put_out
from orthocal.cli.sheet import following_command, note_contradictions
from orthocal.errors import (
    ClosureError,
    ParameterError,
    RobotError,
    UnreachablePathError,
    UnreachablePostureError,
)
from orthocal.io.files import exists, require_plain_name, write_files
from orthocal.text import quote_path

if TYPE_CHECKING:
    from orthocal.builder.build import EffectKeyValues
    from orthocal.builder.dimensions import Dimensions
    from orthocal.builder.machine_file import Counting
    from orthocal.cli.dialogue import Stated
    from orthocal.planning.first_plan import FixedPlan

USUAL_OFFSET = 4.0
"""Tolerance of the zeros of a new machine, whose home switches were never measured, [mm]."""

EFFECTS = "backlash"
"""Default effects of a new machine."""

FIRST = "first"
"""Name of the directory of the first session, in the directory of the machine."""

BED_WORDS = (
    "All slides together move the tool without turning a rod, so that readings of the rods say "
    "little about this machine. The plan measures the bed with the dial at the tool. The bed is "
    "assumed to be flat to 0.02 mm (session.yaml). Name other sensors, such as a ball bar, by "
    "--with FILE. For the log of a printer's probe use orthocal import."
)
"""Note about the plan of a machine whose rods do not determine its offsets."""

COMMENT = (
    "A plan. Print sheet.html and measure: run `orthocal record .` in this directory, or fill\n"
    "in readings.csv in its order. Then\n"
    "{calibrating}\n"
    "offsets_mm: those that are active in the controller during the measurement.\n"
    "backlash_mm: the backlash that it compensates, 0 for none."
)
"""Comment at the top of the first session's session.yaml."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DimensionOptions:
    """Kind and dimensions of a machine; `find_answers` reads them.

    Args:
        kind (KIND): orthoglide (the default), inclined-orthoglide, linear-delta or biglide.
        dimension (KEY=VALUE): Dimension of the kind by its key in machine.yaml, such as rod_mm=280.
            inclined-orthoglide: elevation_deg; linear-delta: rod_mm, radius_mm, angles_deg,
            platform_mm; and those below.
        leg_mm (MM): Length of a leg, from hinge to hinge of a rod; not of a linear-delta.
        travel_mm (LEAST:LARGEST): Lowest and highest coordinate of a slide. It is the leg length
            where the legs are parallel to their axes, and grows outwards. Of a linear-delta: height
            of its hinges above those of the platform on the bed.
        attachment_mm (MM): Distance from the tool centre point to the hinges on the platform, along
            the axis; not of a linear-delta.
        rods_apart_mm (MM): Distance between the axes of the two rods of a leg; 0 for a biglide with
            one rod in each leg.
        rod_radius_mm (MM): Radius of a rod.
        counts (up|down[,...]): Direction in which a joint of the controller counts as its slide
            moves outwards or upwards: one for all, or x,y,z.
        at_zero_mm (MM[,...]): Coordinate that the controller shows where the legs are parallel to
            their axes, or the tool is in the middle of the bed: one for all, or x,y,z.
    """

    kind: str | None = None
    dimension: list[str] | None = None
    leg_mm: str | None = None
    travel_mm: str | None = None
    attachment_mm: str | None = None
    rods_apart_mm: str | None = None
    rod_radius_mm: str | None = None
    counts: str | None = None
    at_zero_mm: str | None = None

    def by_key(self) -> dict[str, Stated]:
        """Stated values by key of machine.yaml, counts or at_zero_mm.

        Raises:
            ParameterError: If an option is malformed, or states a dimension twice.
        """
        from orthocal.cli.dialogue import OPTIONS, Stated

        stated = {
            key: Stated(option, text)
            for key, option in OPTIONS.items()
            if (text := getattr(self, key)) is not None
        }
        form = "KEY=VALUE, such as rod_mm=280"
        for key, value in read_pairs(self.dimension, "--dimension", form).items():
            if key in stated:
                raise ParameterError(f"states {key} twice", where="--dimension")
            stated[key] = Stated(f"--dimension {key}", value)
        return stated

    def read_kind(self) -> type[Dimensions]:
        """Kind of the machine.

        Raises:
            ParameterError: If there is no such kind.
        """
        from orthocal.builder.machine_file import KINDS, USUAL

        kind = KINDS.get(self.kind or USUAL)
        if kind is None:
            raise ParameterError(
                f"found '{self.kind}'; expected {', '.join(KINDS)}", where="--kind"
            )
        return kind


@dataclass(frozen=True, slots=True, kw_only=True)
class FirstPlanOptions:
    """Options about the first plan of a machine.

    Args:
        effects (EFFECTS): Effects that the machine has, such as backlash,thermal, or none.
        screw_lead_mm (MM): Travel per turn of the screws, for a machine with periodic errors of the
            screws (effect screw).
        paper: Read each leg in the mechanical zero and at both ends of its axis, as in the paper;
            no search.
    """

    workspace_mm: str | None = None
    paper: bool = False
    hours: float | None = None
    gauge: Path | None = None
    with_: list[Path] | None = None
    model: str | None = None
    effects: str = EFFECTS
    screw_lead_mm: float | None = None
    temperature: str | None = None
    tolerance: list[str] | None = None

    def changed(self) -> dict[str, object]:
        """Values that differ from their defaults, by option."""
        return {
            f"--{f.name.strip('_').replace('_', '-')}": value
            for f in fields(self)
            if (value := getattr(self, f.name)) != f.default
        }

    def read_effects(self) -> dict[str, dict[str, float]]:
        """Effects of the machine, mapped to keys that replace their defaults."""
        effects = {name: dict[str, float]() for name in split_effects(self.effects) or []}
        if self.screw_lead_mm is not None:
            effects["screw"] = {"lead_mm": self.screw_lead_mm}
        return effects


@command()
def new(
    folder: Path,
    *,
    dimensions: DimensionOptions,
    options: FirstPlanOptions,
    controller: ControllerOptions,
    again: bool = False,
    force: bool = False,
) -> None:
    """Make a machine of your dimensions, a first plan and its sheet.

    --kind chooses the kind of machine. Missing dimensions are asked for at a terminal. Without
    --tolerance the zeros of the joints may be off by up to 4 mm.

    Exit code 3 with --again: an existing plan no longer fits the changed machine.

    Args:
        folder (DIRECTORY): Directory of the machine; it is created.
        again: Make URDF, YAML and sheets again from DIRECTORY/machine.yaml.
    """
    if again:
        stated: dict[str, object] = {o: text for o, text in dimensions.by_key().values()}
        stated |= {"--kind": dimensions.kind} | options.changed()
        stated |= {"--backlash": controller.backlash, "--ini": controller.ini}
        _require_none(stated | {"--force": force or None}, "--again, which reads machine.yaml")
        _make_again(folder)
        return
    if options.paper:
        free = {"--hours": options.hours, "--temperature": options.temperature}
        _require_none(free | {"--with": options.with_}, "--paper, whose setups are fixed")
    name = _require_new(folder, force=force)
    design = _Design(name, dimensions, options, controller)
    _write(folder, name, design)
    _report(folder, design)
    note_contradictions(design.session, controller.ini)
    put_note(design.assumed_tip)
    if not design.tolerance_stated:
        put_note(
            f"The zeros of the joints are assumed to be within ±{USUAL_OFFSET:g} mm. Otherwise: "
            "--tolerance '*.offset_mm=10'"
        )


class _Design:
    """New machine and its first plan from options and answers, before they are written.

    Raises:
        OrthocalError: If an option or answer is invalid, or there is no suitable plan.
    """

    def __init__(
        self,
        name: str,
        dimensions: DimensionOptions,
        options: FirstPlanOptions,
        controller: ControllerOptions,
    ) -> None:
        from orthocal.cli.dialogue import ask_tolerance, find_answers
        from orthocal.output.text.plan import describe_assumed_tip
        from orthocal.planning.equipment import load_dial
        from orthocal.planning.owned_sensors import load_owned_sensor

        equipment = orthocal.Equipment(
            temperatures=read_temperatures(options.temperature),
            owned=tuple(load_owned_sensor(path) for path in options.with_ or ()),
        )
        if options.gauge is not None:
            equipment = load_dial(options.gauge, equipment)
        self.effects = options.read_effects()
        kind, tolerance = dimensions.read_kind(), options.tolerance
        reads_legs = kind.legs_determine_offsets or bool(equipment.owned)
        if not reads_legs:
            _require_bed(kind, options)
        self.machine, self.counting, asked = find_answers(kind, dimensions.by_key())
        with tempfile.TemporaryDirectory(prefix="orthocal-") as trial:
            folder = Path(trial) / name
            robot = _make_trial(self.machine, folder, self.counting, self.effects)
            robot = _with_workspace(robot, options.workspace_mm, asked=asked)
            if asked and tolerance is None:
                tolerance = ask_tolerance(USUAL_OFFSET)
            self.tolerance_stated = tolerance is not None
            """Whether the tolerance of the zeros of the joints was stated."""
            if robot.workspace is not None:
                box = tuple((low, high) for low, high in robot.workspace.tolist())
                self.machine = replace(self.machine, workspace=box)
            compensation = controller.read(robot)
            equipment = controller.limit(equipment, robot)
            tolerances = {"*.offset_mm": USUAL_OFFSET} | read_tolerances(tolerance, robot)
            make_plan = _plan if reads_legs else _plan_bed
            self.plan: orthocal.MeasuringPlan | FixedPlan | None
            self.plan, self.session = make_plan(robot, equipment, tolerances, options)
            if compensation is not None:
                self.session = replace(self.session, compensation=compensation)
            put_note("orthocal: drawing the measuring sheet")
            self.assumed_tip = describe_assumed_tip(equipment, self.session)
            """Note about a tip that the file of the gauge does not state."""
            self.files = _draw(self.plan, self.session)
            """Text of the files beside session.yaml and readings.csv, by name."""


def _write(folder: Path, name: str, design: _Design) -> None:
    """Write a machine, and its first session with the sheet."""
    from orthocal.builder.build import describe_machine

    stated = design.session.robot.parameters.stated
    machine_files = describe_machine(
        design.machine,
        name=name,
        counting=design.counting,
        tolerances=stated,
        effects=design.effects,
    )
    write_files(folder, machine_files)
    robot = orthocal.load_robot(folder).with_tolerances(stated)
    session = replace(design.session, robot=robot, robot_reference=str(folder.resolve()))
    comment = COMMENT.format(calibrating=_calibrating())
    write_plan(session, folder / FIRST, comment=comment, files=design.files)


def _calibrating() -> str:
    """Command that calibrates from the first session, in its directory."""
    from orthocal.output.text.answer import calibrate_command

    return calibrate_command([Path(FIRST)], {}, folder=Path(FIRST))


def _make_trial(
    machine: Dimensions, folder: Path, counting: Sequence[Counting], effects: EffectKeyValues
) -> orthocal.Robot:
    """Robot of the machine in a temporary directory.

    Raises:
        ParameterError: If an effect does not exist, or needs keys without a default.
    """
    try:
        return orthocal.make_robot(machine, folder, counting=counting, effects=effects)
    except RobotError as e:
        key = (e.where or "").partition("orthocal.effects.")[2]
        if not key and e.where != "effects":
            raise
        if key == "screw.lead_mm":
            raise ParameterError(e.problem, where="--screw-lead-mm") from None
        problem = e.problem
        if key:
            problem = f"{key}: {problem}; add the effect to the robot's YAML later"
        raise ParameterError(problem, where="--effects") from None


def _require_none(options: Mapping[str, object], other: str) -> None:
    """Refuse stated options, which have no effect together with another one.

    Raises:
        ParameterError: If an option has a value.
    """
    for option, value in options.items():
        if value is not None:
            raise ParameterError(f"found with {other}", where=option)


def _require_new(folder: Path, *, force: bool) -> str:
    """Name of a directory; refuse a directory that is in use or not writable."""
    from orthocal.builder.machine_file import MACHINE
    from orthocal.robot.loading import packaged_robots

    name = folder.resolve().name
    if not name:
        raise RobotError("has no name; expected a directory", where=str(folder))
    require_plain_name(folder.resolve(), error=RobotError)
    if f"{name}.yaml" == MACHINE:
        raise RobotError(
            f"'{name}' would name its YAML {MACHINE}, which contains the dimensions; choose "
            "another name",
            where=str(folder),
        )
    if name in packaged_robots():
        raise RobotError(
            f"'{name}' is a robot that comes with orthocal; choose another name", where=str(folder)
        )
    files = (MACHINE, f"{name}.yaml", f"{name}.urdf")
    require_new_session(folder, files, force=force, error=RobotError)
    files = ("session.yaml", "readings.csv", "sheet.html")
    require_new_session(folder / FIRST, files, force=force, error=RobotError)
    return name


def _with_workspace(robot: orthocal.Robot, option: str | None, *, asked: bool) -> orthocal.Robot:
    """Robot with the workspace of the option, of an answer, or of its kind.

    Raises:
        ParameterError: If the machine does not reach the workspace.
    """
    from orthocal.cli.dialogue import ask_workspace
    from orthocal.kinematics.reachable_box import describe_unreachable_box, find_workspace
    from orthocal.kinematics.workspace import describe_box

    if option is not None:
        return replace(robot, workspace=read_workspace(option, robot))
    box = robot.workspace
    problem = "" if box is None else describe_unreachable_box(robot, box)
    if problem:
        raise ParameterError(
            f"by default {problem}; state a workspace, or other dimensions", where="--workspace-mm"
        )
    if not asked:
        return robot
    usual = describe_box(find_workspace(robot).limits)
    box = ask_workspace(usual, lambda text: read_workspace(text, robot))
    return robot if box is None else replace(robot, workspace=box)


def _plan(
    robot: orthocal.Robot,
    equipment: orthocal.Equipment,
    tolerances: Mapping[str, float],
    options: FirstPlanOptions,
) -> tuple[orthocal.MeasuringPlan | None, orthocal.Session]:
    """Plan of readings of the legs, and its session with active offsets of 0.

    The plan is None for the paper's readings.
    """
    from orthocal.planning.first_plan import first_equipment, paper_plan
    from orthocal.planning.plan import MODEL
    from orthocal.session.session import Purpose

    model = options.model or MODEL
    choice = orthocal.Choice(model, tolerances=tolerances)
    choice.select(robot.parameters)
    zeros = [0.0] * len(robot.drives)
    if options.paper:
        session = paper_plan(robot, equipment).with_tolerances(tolerances).with_controller(zeros)
        return None, replace(session, purpose=Purpose(model))
    plan = orthocal.plan_readings(
        robot,
        choice,
        hours=options.hours,
        equipment=first_equipment(robot, equipment),
        report=lambda text: put_note(f"orthocal: {text}"),
    )
    return plan, plan.session.with_controller(zeros)


def _plan_bed(
    robot: orthocal.Robot,
    equipment: orthocal.Equipment,
    tolerances: Mapping[str, float],
    options: FirstPlanOptions,
) -> tuple[FixedPlan, orthocal.Session]:
    """Plan of readings of the bed, for a machine whose legs do not determine its offsets."""
    from orthocal.planning.first_plan import bed_plan, expect_fixed
    from orthocal.planning.plan import MODEL
    from orthocal.session.session import Purpose

    choice = orthocal.Choice(options.model or MODEL)
    session = bed_plan(robot.with_tolerances(tolerances), equipment)
    session = replace(session, purpose=Purpose(choice.model))
    plan = expect_fixed(session, choice, equipment)
    return plan, session.with_controller([0.0] * len(robot.drives))


def _require_bed(kind: type[Dimensions], options: FirstPlanOptions) -> None:
    """Refuse options that apply to readings of the legs only.

    Raises:
        ParameterError: If such an option is stated.
    """
    for option, stated in (("--paper", options.paper), ("--hours", options.hours is not None)):
        if stated:
            raise ParameterError(
                f"readings of the rods say little about a {kind.kind}, and the readings of its bed "
                "are fixed; name other sensors by --with",
                where=option,
            )


def _draw(
    plan: orthocal.MeasuringPlan | FixedPlan | None, session: orthocal.Session
) -> dict[str, str]:
    """Text of the files beside session.yaml and readings.csv, by name."""
    from orthocal.output.sheet.page import sheet_files
    from orthocal.output.text.plan import draw_plan, plan_json

    drawn: dict[str, str] = {}
    if isinstance(plan, orthocal.MeasuringPlan):
        drawn = {"plan.json": plan_json(plan), "plan.svg": draw_plan(plan)}
    return {**sheet_files(session, following=_calibrating()), **drawn}


def _report(folder: Path, design: _Design) -> None:
    """Print the expected tool error, the files and the next commands."""
    from orthocal.assessment.wording import counted
    from orthocal.output.text.accuracy import describe_gains
    from orthocal.output.text.answer import calibrate_command
    from orthocal.output.text.plan import (
        describe_absent,
        describe_expected,
        describe_size,
        show_duration,
    )

    plan, size = design.plan, describe_size(design.session)
    if plan is None:
        lines = [f"Plan: {size}."]
    else:
        lines = [f"Plan: {size}, about {show_duration(plan.minutes)}.", *describe_expected(plan)]
    if isinstance(plan, orthocal.MeasuringPlan):
        lines += describe_absent(plan)
    elif plan is not None:
        lines += [BED_WORDS, *describe_gains(plan.find_sensor_gains(), plan.expected.reported.rms)]
    programs = sum(name.endswith(".ngc") for name in design.files)
    lines += [
        f"Wrote {folder}: {design.machine.summary}.",
        f"To change a dimension, edit {folder / 'machine.yaml'}, then run",
        f"  orthocal new {quote_path(folder)} --again",
        f"Wrote {folder / FIRST}: session.yaml, readings.csv, sheet.html and "
        f"{counted(programs, 'program')} in G-code.",
        "Next: look at the machine, print the sheet, measure and calibrate:",
        f"  orthocal view {quote_path(folder)}",
        f"  orthocal record {quote_path(folder / FIRST)}",
        f"  {calibrate_command([folder / FIRST], {})}",
    ]
    put_out("\n".join(lines))


def _make_again(folder: Path) -> None:
    """Make robot and sheets of a machine again from its machine.yaml; report outdated plans.

    Raises:
        RobotError: If the machine does not load or does not reach its workspace.
        typer.Exit: With code 3 if a plan is outdated.
    """
    from orthocal.builder.build import remake_robot
    from orthocal.kinematics.reachable_box import describe_unreachable_box
    from orthocal.output.sheet.page import SHEET

    def check(robot: orthocal.Robot) -> None:
        box = robot.workspace
        problem = "" if box is None else describe_unreachable_box(robot, box)
        if problem:
            raise RobotError(problem, where=f"{folder / 'machine.yaml'}: workspace_mm")

    robot = remake_robot(folder, check=check)
    put_out(f"Made {robot.yaml.name} and {robot.urdf.name} again from {folder / 'machine.yaml'}.")
    is_outdated = False
    for sheet in sorted(folder.glob(f"*/{SHEET}")):
        changes = _remake_sheet(sheet, robot) if exists(sheet.parent / "session.yaml") else []
        if changes:
            is_outdated = True
            advice = _advise_plan(folder, sheet.parent)
            if count_numbers(sheet.parent / READINGS):  # the session may not load
                advice = (
                    "it has readings, so check the dimensions: with longer legs, for instance, "
                    "travel_mm is larger, too. For other dimensions, plan into another directory"
                )
            put_note(f"orthocal: {sheet.parent}: the plan is old ({'; '.join(changes)}); {advice}")
    if is_outdated:
        raise typer.Exit(3)


def _advise_plan(folder: Path, session: Path) -> str:
    """Command that replaces an outdated plan of a machine."""
    from orthocal.builder.machine_file import MACHINE, read_machine

    reads_legs = read_machine(folder / MACHINE)[0].legs_determine_offsets
    if reads_legs or exists(session / "plan.json"):
        out = f"--out {quote_path(session)} --force"
        return f"plan again:\n  orthocal plan {quote_path(folder)} {out}"
    return (
        "make the machine with its plan again, by the options with which you made it:\n  "
        f"orthocal new {quote_path(folder)} --force …"
    )


def _remake_sheet(sheet: Path, robot: orthocal.Robot) -> list[str]:
    """Make the sheet of a plan without readings again; changes that make the plan outdated.

    Raises:
        OrthocalError: If the plan does not load for another reason than postures out of reach.
    """
    from orthocal.output.sheet.page import sheet_files

    try:
        session = orthocal.load_plan(sheet.parent)
        if any(r.is_read for r in session.readings):
            put_note(
                f"orthocal: {sheet.parent}: has readings, which belong to the dimensions at that "
                "time; its sheet is unchanged"
            )
            return []
        following = following_command(session, sheet.parent, sheet.parent)
        write_files(sheet.parent, sheet_files(session, following=following))
        put_out(f"Made {sheet} and its programs again.")
        return _changes_since(sheet.parent, robot)
    except (ClosureError, UnreachablePathError, UnreachablePostureError) as e:
        put_note(f"orthocal: {e}")
        return ["the machine does not reach its postures"]


def _changes_since(folder: Path, robot: orthocal.Robot) -> list[str]:
    """Changes of travel and workspace since a plan was made.

    Raises:
        RobotError: If plan.json is not readable.
    """
    from orthocal.io.documents import read_json
    from orthocal.output.text.plan import PLAN_BASIS, describe_basis

    file = folder / "plan.json"
    if not exists(file):  # the paper's plan does not depend on travel and workspace
        return []
    before = read_json(file, error=RobotError)
    if not isinstance(before, dict):
        raise RobotError("is not a file that orthocal plan wrote; plan again", where=str(file))
    now = describe_basis(robot)
    return [
        f"{words} changed"
        for key, words in PLAN_BASIS.items()
        if key in before and before[key] != now[key]
    ]
