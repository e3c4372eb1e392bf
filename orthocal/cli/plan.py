"""The command `plan`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from typer import Option

import orthocal
from orthocal.cli.options import (
    ControllerOptions,
    Positive,
    Seed,
    Workers,
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
from orthocal.cli.overwriting import require_new_session, write_plan
from orthocal.cli.printing import deliver, put_note
from orthocal.cli.sheet import note_contradictions, sheet_or_problem
from orthocal.errors import ParameterError, errors_at
from orthocal.text import quote_path
from orthocal.units import MM

FILES = ("session.yaml", "readings.csv", "plan.json", "plan.svg", "sheet.html")


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanOptions:
    """Options about readings, equipment and search.

    Args:
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
        minutes_per_setup (MINUTES): Duration of a setup.
        minutes_per_reading (MINUTES): Duration of a reading.
        criterion (aligned|relative|absolute|worst|A|D): For research: figure to minimise.
            RMS tool error after aligning the workpiece, after shifting it, or absolute; worst tool
            error; or trace (A) or determinant (D) of the covariance.
        starts (N): For research: number of starts of the search; default: 20000 divided by the
            number of candidate readings, at least 3 and at most 30.
    """

    model: str | None = None
    setups: Positive = None
    readings: Annotated[int | None, Option(min=2)] = None
    hours: float | None = None
    add: Positive = None
    gauge: Path | None = None
    with_: list[Path] | None = None
    touches: str | None = None
    sections: str | None = None
    box: str | None = None
    along: Annotated[int, Option(min=2, max=50)] = 9
    across_mm: float = 20.0
    minutes_per_setup: float = 10.0
    minutes_per_reading: float = 0.5
    workspace_mm: str | None = None
    criterion: str = "aligned"
    effects: str | None = None
    temperature: str | None = None
    tolerance: list[str] | None = None
    starts: Annotated[int | None, Option(min=1, max=100)] = None
    seed: Seed = 0
    workers: Workers = None


@command()
def plan(
    subject: str,
    *,
    options: PlanOptions,
    controller: ControllerOptions,
    out: Path | None = None,
    json: bool = False,
    details: bool = False,
    force: bool = False,
) -> None:
    """Choose setups and postures for the smallest tool error.

    With --out the directory receives session.yaml, an empty readings.csv and a measuring sheet.

    Args:
        subject (ROBOT|SESSION): A robot, or a measured session that the plan complements.
    """
    from orthocal.output.text.answer import calibrate_command
    from orthocal.output.text.plan import describe_assumed_tip, plan_json, render_plan
    from orthocal.runtime.worker_pool import available_cores, worker_budget

    if out is not None:
        require_new_session(out, FILES, force=force)
    workers = options.workers or available_cores()
    chosen = _choose(subject, options, controller, workers=workers)
    deliver(lambda: plan_json(chosen), lambda: render_plan(chosen, details=details), json=json)
    put_note(describe_assumed_tip(chosen.equipment, chosen.session))
    if out is not None:
        sessions = [Path(subject), out] if chosen.complements_session else [out]
        stated = options.tolerance and chosen.complements_session
        tolerances = chosen.session.robot.parameters.stated if stated else {}
        with worker_budget(workers):
            _write(chosen, out, calibrate_command(sessions, tolerances, folder=out))
        note_contradictions(chosen.session, controller.ini)
        calibrating = calibrate_command(sessions, tolerances)
        put_note(f"Next:\n  orthocal record {quote_path(out)}\n  {calibrating}")
    elif not json:
        put_note("Nothing was written; --out DIRECTORY writes session, sheet and programs.")


def _choose(
    subject: str, options: PlanOptions, controller: ControllerOptions, *, workers: int
) -> orthocal.MeasuringPlan:
    """Plan readings for a robot, or further readings for a session.

    Raises:
        OrthocalError: If an option is invalid, or the subject does not load.
    """
    from orthocal.effects.compensation import home_positions, with_homes
    from orthocal.effects.loading import with_effects
    from orthocal.kinematics.workspace import box_workspace

    session, robot = load_robot_or_session(subject)
    measured = None if session is None else orthocal.load_session(subject)
    if options.add is not None and measured is None:
        raise ParameterError("needs a session; found a robot", where="--add")
    if options.add is not None and options.setups is not None:
        raise ParameterError("found with --setups; expected one", where="--add")
    equipment, compensation = _read_equipment(options, robot, measured), controller.read(robot)
    origin = (0.0, 0.0, 0.0) if measured is None else measured.controller_origin
    workspace = None
    if options.workspace_mm is not None:
        workspace = box_workspace(robot, read_workspace(options.workspace_mm, robot))
    equipment = controller.limit(equipment, robot, origin, workspace)
    names = split_effects(options.effects)
    with errors_at("--effects"):
        robot = robot if names is None else with_effects(robot, names)
    tolerances = read_tolerances(options.tolerance, robot)
    plan = orthocal.plan_readings(
        robot,
        orthocal.Choice(options.model, tolerances=tolerances, effects=names),
        setups=options.setups if options.add is None else options.add,
        readings=options.readings,
        hours=options.hours,
        equipment=equipment,
        measured=measured,
        workspace=workspace,
        criterion=options.criterion,  # type: ignore[arg-type] # checked by `plan_readings`
        seed=options.seed,
        starts=options.starts,
        reference=subject if measured is None else measured.robot_reference,
        workers=workers,
        report=lambda text: put_note(f"orthocal: {text}"),
    )
    if compensation is None:
        return plan
    if homes := home_positions(plan.session.compensation):  # they belong to its offsets
        compensation = with_homes(compensation, homes)
    return replace(plan, session=replace(plan.session, compensation=compensation))


def _missing_controller(session: orthocal.Session) -> str:
    """Lines about keys of the controller that a session does not state; "" if it states all."""
    from orthocal.robot.model import drive_keys

    drives, offsets = session.robot.drives, session.controller_offsets
    stated = {"offsets": offsets is not None, "backlash": bool(session.compensation)}
    keys = [drive_keys(key, drives) for key, is_stated in stated.items() if not is_stated]
    if not keys:
        return ""
    head = "State what the controller corrects during the measurement, one number for each drive"
    if len(keys) == 1:
        return f"{head}.\nAdd to `controller` below, such as {keys[0]}\n"
    return f"{head}:\ncontroller: {{{', '.join(keys)}}}\n"


def _write(plan: orthocal.MeasuringPlan, directory: Path, calibrating: str) -> None:
    """Write a plan as a session with its sheet and its figure.

    Args:
        plan: The plan.
        directory: The directory.
        calibrating: Command that calibrates from the readings, in this directory.
    """
    from orthocal.output.text.plan import draw_plan, plan_json
    from orthocal.runtime.worker_pool import call_in_parallel
    from orthocal.sensors.protocol import tool_path

    stated = any(r.approach for r in plan.session.readings)
    arcs = all(tool_path(setup.sensor) for setup in plan.session.setups.values())
    side = "along its arc" if arcs else "from the same side"
    side = "as the column approach states" if stated else side
    comment = (
        "A plan: run `orthocal record .` in this directory, or fill in readings.csv; then\n"
        f"{calibrating}\n"
        f"{_missing_controller(plan.session)}"
        f"Approach every posture {side}. The last reading of a setup is its first\n"
        "posture again."
    )
    (sheet, problem), figure = call_in_parallel(
        [lambda: sheet_or_problem(plan.session, following=calibrating), lambda: draw_plan(plan)],
        killed="a process that drew the plan was killed",
    )
    put_note(problem)
    files = {"plan.json": plan_json(plan), "plan.svg": figure, **sheet}
    path = write_plan(plan.session, directory, comment=comment, files=files)
    programs = "programs" if plan.session.firmware is None else "lines to send"
    sheet_names = f", sheet.html and its {programs}" if sheet else ""
    put_note(f"Wrote {path}, an empty readings.csv, plan.json, plan.svg{sheet_names}")


def _read_equipment(
    options: PlanOptions, robot: orthocal.Robot, measured: orthocal.Session | None
) -> orthocal.Equipment:
    """Equipment of the options, with the gauge of a file or of a measured session."""
    from orthocal.kinematics.workspace import coordinate_letters
    from orthocal.planning.equipment import SECTIONS, equipment_of, load_dial
    from orthocal.planning.owned_sensors import load_owned_sensor

    box = options.box
    limits = None if box is None else read_box(box, coordinate_letters(robot), where="--box")
    temperatures = read_temperatures(options.temperature)
    require_between(options.minutes_per_setup, 0.0, 1e4, "--minutes-per-setup")
    require_between(options.minutes_per_reading, 0.0, 1e4, "--minutes-per-reading")
    if not 0.0 <= options.across_mm < 1000.0:
        raise ParameterError("expected 0 or more, and less than 1000 mm", where="--across-mm")
    sections = options.sections
    fractions = SECTIONS if sections is None else read_numbers(sections, "--sections")
    for value in fractions:
        if not 0.0 <= value <= 1.0:
            raise ParameterError(
                f"found {value:g}; expected 0 (root) to 1 (tip)", where="--sections"
            )
    equipment = orthocal.Equipment(
        rods=tuple(split_globs([options.touches] if options.touches else None)),
        sections=fractions,
        box=limits,
        along=options.along,
        across=options.across_mm * MM,
        minutes_per_setup=options.minutes_per_setup,
        minutes_per_reading=options.minutes_per_reading,
        temperatures=temperatures,
        owned=tuple(load_owned_sensor(path) for path in options.with_ or ()),
    )
    if options.gauge is not None:
        return load_dial(options.gauge, equipment)
    return equipment if measured is None else equipment_of(measured, equipment)
