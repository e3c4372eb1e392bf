"""The command `plan`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from typer import Option

import orthocal
from orthocal.cli.files import require_new_files, require_no_readings
from orthocal.cli.options import (
    Day,
    Details,
    Effects,
    Force,
    Gauge,
    Hours,
    Json,
    Model,
    OptionalOutDirectory,
    Positive,
    Seed,
    Tolerances,
    Workers,
    WorkspaceMm,
    command,
    load_robot_or_session,
    read_box,
    read_numbers,
    read_temperatures,
    read_tolerances,
    read_workspace,
    require_between,
    split_effects,
    split_globs,
)
from orthocal.cli.printing import deliver, put_note
from orthocal.cli.sheet import sheet_or_problem
from orthocal.errors import ParameterError
from orthocal.units import MM

FILES = ("session.yaml", "readings.csv", "plan.json", "plan.svg", "sheet.html")


@command()
def plan(
    subject: str,
    model: Model = None,
    setups: Positive = None,
    readings: Annotated[int | None, Option(min=2)] = None,
    hours: Hours = None,
    add: Positive = None,
    gauge: Gauge = None,
    touches: str | None = None,
    sections: str | None = None,
    box: str | None = None,
    along: Annotated[int, Option(min=2, max=50)] = 9,
    across_mm: float = 20.0,
    minutes_a_setup: float = 10.0,
    minutes_a_reading: float = 0.5,
    workspace_mm: WorkspaceMm = None,
    criterion: str = "aligned",
    effects: Effects = None,
    temperature: Day = None,
    tolerance: Tolerances = None,
    starts: Annotated[int | None, Option(min=1, max=100)] = None,
    seed: Seed = 0,
    workers: Workers = None,
    out: OptionalOutDirectory = None,
    json: Json = False,
    details: Details = False,
    force: Force = False,
) -> None:
    """Choose setups and postures for the smallest tool error.

    With --out the directory receives session.yaml, an empty readings.csv and a measuring sheet.

    Args:
        subject (ROBOT|SESSION): A robot, or a measured session that the plan complements.
        setups (N): Number of setups; default: 6.
        readings (N): Number of readings in all setups; default: 3 per setup, and 4 more in six
            setups with backlash.
        add (N): Number of further setups for a session.
        touches (RODS): Rods that the gauge can touch, separated by commas.
        sections (FRACTIONS): Sections as fractions of a leg's length from its slide; default:
            0.25,0.5,0.75.
        box (LOW:HIGH,...): Region of the postures, mm: one range for all coordinates or one for
            each; default: up to 100 mm from the mechanical zero.
        along (N): For research: number of positions along a leg's direction.
        across_mm (MM): Displacement across that direction, to either side.
        minutes_a_setup (MINUTES): Duration of a setup.
        minutes_a_reading (MINUTES): Duration of a reading.
        criterion (aligned|relative|absolute|worst|A|D|E): For research: figure to minimise.
            RMS tool error after aligning the workpiece, after shifting it, or absolute; worst tool
            error; or trace, determinant or largest eigenvalue of the covariance.
        starts (N): For research: number of starts of the search; default: 20000 divided by the
            number of candidate readings, at least 3 and at most 30.
    """
    from orthocal.effects.loading import with_effects
    from orthocal.kinematics.workspace import box_workspace, coordinate_letters
    from orthocal.output.text.plan import plan_json
    from orthocal.output.text.summary import print_summary
    from orthocal.planning.expected_error import CRITERIA
    from orthocal.robot.parameters import errors_at
    from orthocal.runtime.worker_pool import available_cores, worker_budget

    if criterion not in CRITERIA:
        raise ParameterError(
            f"found '{criterion}'; expected one of {', '.join(CRITERIA)}", where="--criterion"
        )
    if out is not None:
        require_new_files(out, FILES, force=force)
        require_no_readings(out)
    session, robot = load_robot_or_session(subject)
    measured = None if session is None else orthocal.load_session(subject)
    reference = subject if measured is None else measured.robot_reference
    if add is not None and measured is None:
        raise ParameterError("needs a session; found a robot", where="--add")
    if add is not None and setups is not None:
        raise ParameterError("found with --setups; expected one", where="--add")
    equipment = _equipment(
        gauge,
        measured,
        rods=split_globs([touches] if touches else None),
        sections=sections,
        box=None if box is None else read_box(box, coordinate_letters(robot), where="--box"),
        along=along,
        across_mm=across_mm,
        minutes_a_setup=minutes_a_setup,
        minutes_a_reading=minutes_a_reading,
        temperatures=read_temperatures(temperature),
    )
    workspace = None
    if workspace_mm is not None:
        workspace = box_workspace(robot, read_workspace(workspace_mm, robot))
    count = workers or available_cores()
    names = split_effects(effects)
    with errors_at("--effects"):
        robot = robot if names is None else with_effects(robot, names)
    chosen = orthocal.plan_readings(
        robot,
        orthocal.Choice(model, tolerances=read_tolerances(tolerance, robot), effects=names),
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
    deliver(lambda: plan_json(chosen), lambda: print_summary(chosen, details=details), json=json)
    if gauge is not None and equipment.tip is None:
        put_note(
            f"orthocal: {gauge} states no tip: the plan is for the line between the rods, which "
            "no dial touches; for a ball add tip: {ball: {radius_mm: 1.5}}"
        )
    if out is not None:
        with worker_budget(count):
            _write(chosen, out)
    elif not json:
        put_note("Nothing was written; --out DIRECTORY writes session, sheet and programs.")


def _write(plan: orthocal.MeasuringPlan, directory: Path) -> None:
    """Write a plan as a session with its sheet and its figure."""
    from orthocal.output.text.plan import draw_plan, plan_json
    from orthocal.runtime.worker_pool import call_in_parallel

    stated = any(r.approach for r in plan.session.readings)
    approach = "as the column approach states" if stated else "from the same side"
    approach = f"Approach every posture {approach}"
    comment = (
        "A plan: run `orthocal record .` in this directory, or fill in readings.csv; then\n"
        "orthocal calibrate .\n"
        "State the offsets that are active in the controller during the measurement, such as\n"
        "controller: {offsets_mm: [0, 0, 0]}, one number for each drive.\n"
        f"{approach}. The last reading of a setup is its first\n"
        "posture again."
    )
    (sheet, problem), figure = call_in_parallel(
        [lambda: sheet_or_problem(plan.session), lambda: draw_plan(plan)],
        killed="a process that drew the plan was killed",
    )
    if problem:
        put_note(problem)
    files = {"plan.json": plan_json(plan), "plan.svg": figure, **sheet}
    path = orthocal.write_session(plan.session, directory, comment=comment, extra=files, blank=True)
    paper = ", sheet.html and its programs" if sheet else ""
    put_note(f"Wrote {path}, an empty readings.csv, plan.json, plan.svg{paper}")


def _equipment(
    gauge: Path | None,
    measured: orthocal.Session | None,
    *,
    rods: list[str],
    sections: str | None,
    across_mm: float,
    **others: Any,  # noqa: ANN401 - fields of the equipment
) -> orthocal.Equipment:
    """Equipment of the options, with the gauge of a file or of a measured session."""
    from orthocal.planning.equipment import SECTIONS, equipment_of, load_dial

    for name in ("minutes_a_setup", "minutes_a_reading"):
        require_between(others[name], 0.0, 1e4, f"--{name.replace('_', '-')}")
    if not 0.0 <= across_mm < 1000.0:
        raise ParameterError("expected 0 or more, and less than 1000 mm", where="--across-mm")
    fractions = SECTIONS if sections is None else read_numbers(sections, "--sections")
    for value in fractions:
        if not 0.0 <= value <= 1.0:
            raise ParameterError(
                f"found {value:g}; expected 0 (root) to 1 (tip)", where="--sections"
            )
    equipment = orthocal.Equipment(
        rods=tuple(rods), sections=fractions, across=across_mm * MM, **others
    )
    if gauge is not None:
        return load_dial(gauge, equipment)
    return equipment if measured is None else equipment_of(measured, equipment)
