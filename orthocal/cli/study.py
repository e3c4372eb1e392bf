"""The commands `orthocal study accuracy|linearisation|sensitivity|bootstrap`."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orthocal.cli.options import Json, Tolerances, app, read_workspace, split_globs
from orthocal.cli.printing import put_note, put_out
from orthocal.errors import ParameterError

if TYPE_CHECKING:
    from orthocal.robot.model import Robot
    from orthocal.session.session import Session
    from orthocal.study.runner import Progress
    from orthocal.study.study import Study

studies = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Simulate many machines, or resample readings.",
)
app.add_typer(studies, name="study")

FILES = ("study.json", "results.parquet", "study.svg")
"""Files that a finished study writes beside its results.jsonl."""

PROGRESS_STEP = 0.1
"""Share of a study between two lines of progress."""

LEG_MM = 310.25
"""Leg length for which the paper's displacements are 60 and -100 mm."""

MOST_MM = 1e4

Out = Annotated[
    Path | None,
    typer.Option(help="Directory for the results. A stopped study is resumed from there."),
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the random numbers.")]
Workers = Annotated[
    int | None, typer.Option(min=1, max=1024, help="Number of processes. Default: all cores.")
]
Dask = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Run on a Dask cluster; address of its scheduler."),
]
Force = Annotated[bool, typer.Option("--force", help="Discard earlier results and start again.")]
AllRows = Annotated[bool, typer.Option("--all", help="List all parameters.")]
Model = Annotated[
    str | None, typer.Option(help="Identified errors: a model. Default: the session's choice.")
]
Free = Annotated[
    list[str] | None,
    typer.Option(metavar="GLOBS", help="Identified errors: names or globs, added to the model."),
]
Subject = Annotated[
    str,
    typer.Argument(
        metavar="ROBOT|SESSION",
        help="An Orthoglide-type robot, measured by the paper's plan; or a session.",
    ),
]
LegMm = Annotated[
    float | None,
    typer.Option("--leg-mm", help="Leg length of an Orthoglide of other dimensions, mm."),
]


@studies.command()
def accuracy(
    plan: Annotated[
        Path,
        typer.Argument(metavar="PLAN", help="session.yaml; its readings are not used."),
    ],
    model: Model = None,
    free: Free = None,
    machines: Annotated[int, typer.Option(min=2, max=1_000_000, help="Number of machines.")] = 1000,
    draw: Annotated[
        list[str] | None,
        typer.Option(
            metavar="MODEL|GLOBS",
            help="Errors that are random, within their tolerances. Default: all.",
        ),
    ] = None,
    error: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="An error that all machines have."),
    ] = None,
    errors: Annotated[
        Path | None, typer.Option(help="YAML file of errors that all machines have (truth.yaml).")
    ] = None,
    tolerance: Tolerances = None,
    half_side_mm: Annotated[
        float | None,
        typer.Option("--half-side-mm", help="Half side of the cube for the tool error, mm."),
    ] = None,
    seed: Seed = 0,
    out: Out = None,
    workers: Workers = None,
    dask: Dask = None,
    json: Json = False,
    all_rows: AllRows = False,
    force: Force = False,
) -> None:
    """Tool error after calibration of many simulated machines."""
    from orthocal.estimation.choice import Choice
    from orthocal.io.files import exists
    from orthocal.measurement.files.session_file import load_plan
    from orthocal.observation.simulate import collect_errors
    from orthocal.robot.loading import packaged_robots
    from orthocal.study.accuracy import build_accuracy_study
    from orthocal.units import MM

    if not exists(plan) and str(plan) in packaged_robots():
        raise ParameterError(
            f"is a robot; expected a session.yaml, which `orthocal plan {plan} --out ...` writes",
            where=str(plan),
        )
    session = load_plan(plan)
    fixed: dict[str, float] = {}
    if error or errors is not None:
        fixed = collect_errors(session.robot, file=errors, single=error or [])
    tolerances = _tolerances(tolerance, session.robot)
    if half_side_mm is not None:
        read_workspace(f"{half_side_mm:g}", session.robot, where="--half-side-mm")
    study = build_accuracy_study(
        session,
        Choice(model, free=split_globs(free), tolerances=tolerances),
        drawn=_parameter_globs(draw, session.robot),
        fixed=fixed,
        machines=machines,
        seed=seed,
        half_side=None if half_side_mm is None else half_side_mm * MM,
    )
    _run(study, out, workers, dask, json=json, all_rows=all_rows, force=force)


@studies.command()
def linearisation(
    subject: Subject = "orthoglide",
    free: Annotated[
        list[str] | None,
        typer.Option(metavar="GLOBS", help="Errors that grow. Default: offsets."),
    ] = None,
    largest_mm: Annotated[
        float, typer.Option("--largest-mm", help="Largest size of the errors, mm or mrad.")
    ] = 50.0,
    sizes: Annotated[
        int, typer.Option(min=1, max=10_000, help="Number of sizes, from 0.1 mm on.")
    ] = 40,
    directions: Annotated[
        int, typer.Option(min=1, max=10_000, help="Number of random directions of the errors.")
    ] = 25,
    along: Annotated[
        str | None,
        typer.Option(metavar="A,B,...", help="One direction instead, such as 1,-0.6,0.3."),
    ] = None,
    max_mm: Annotated[
        float | None,
        typer.Option(
            "--max-mm",
            help="Displacement of the paper's maximum postures. Default: 60 mm, scaled with legs.",
        ),
    ] = None,
    min_mm: Annotated[
        float | None,
        typer.Option(
            "--min-mm",
            help="Displacement of its minimum postures. Default: -100 mm, scaled with legs.",
        ),
    ] = None,
    leg_mm: LegMm = None,
    sigma_mm: Annotated[
        float | None,
        typer.Option("--sigma-mm", help="Standard deviation of a reading. The paper's: 0.02."),
    ] = None,
    resolution_mm: Annotated[
        float | None,
        typer.Option("--resolution-mm", help="Resolution of a reading. The paper's: 0.01."),
    ] = None,
    seed: Seed = 0,
    out: Out = None,
    workers: Workers = None,
    dask: Dask = None,
    json: Json = False,
    force: Force = False,
) -> None:
    """Error of linearised identification as errors grow."""
    from orthocal.robot.model import Robot
    from orthocal.session.session import Gauge
    from orthocal.study.linearisation import build_linearisation_study
    from orthocal.study.paper_plan import PAPER_GAUGE, Displacements
    from orthocal.units import MM

    scale = leg_mm / LEG_MM if leg_mm is not None and leg_mm > 0.0 else 1.0
    maximum = scale * 60.0 if max_mm is None else max_mm
    minimum = scale * -100.0 if min_mm is None else min_mm
    _require_between(largest_mm, 0.0, MOST_MM, "--largest-mm")
    _require_between(maximum, 0.0, MOST_MM, "--max-mm")
    _require_between(minimum, -MOST_MM, 0.0, "--min-mm")
    for name, value in (("--sigma-mm", sigma_mm), ("--resolution-mm", resolution_mm)):
        if value is not None:
            _require_between(value, 0.0, 1e3, name)
    with _robot_or_session(subject, leg_mm) as source:
        usual = PAPER_GAUGE if isinstance(source, Robot) else source.gauge
        gauge = Gauge(
            usual.sigma if sigma_mm is None else sigma_mm * MM,
            usual.resolution if resolution_mm is None else resolution_mm * MM,
            None,
        )
        study = build_linearisation_study(
            source,
            free=split_globs(free) or ("*.offset",),
            largest=largest_mm,
            count=sizes,
            directions=directions,
            along=None if along is None else _numbers(along, "--along"),
            displacements=Displacements(maximum * MM, minimum * MM),
            gauge=gauge,
            seed=seed,
        )
    _run(study, out, workers, dask, json=json, all_rows=False, force=force)


@studies.command()
def sensitivity(
    subject: Subject = "orthoglide",
    free: Annotated[
        list[str] | None,
        typer.Option(
            metavar="MODEL|GLOBS", help="Errors. Default: all that move a reading or the tool."
        ),
    ] = None,
    at: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y,Z",
            help="Tool position, mm, at which every setup is read. Can be repeated.",
        ),
    ] = None,
    leg_mm: LegMm = None,
    out: Out = None,
    json: Json = False,
    all_rows: AllRows = False,
    force: Force = False,
) -> None:
    """Derivatives of readings and tool position by each error."""
    from orthocal.robot.model import Robot
    from orthocal.study.sensitivity import build_sensitivity_study
    from orthocal.units import MM

    with _robot_or_session(subject, leg_mm) as source:
        robot = source if isinstance(source, Robot) else source.robot
        count = 0 if robot.tcp is None else len(robot.tcp.coordinates)
        points = []
        for text in at or []:
            point = _numbers(text, "--at")
            if len(point) != count:
                raise ParameterError(
                    f"'{text}' has {len(point)} numbers; expected {count}", where="--at"
                )
            points.append([v * MM for v in point])
        study = build_sensitivity_study(
            source, _parameter_globs(free, robot), points=points or None
        )
    _run(study, out, 1, None, json=json, all_rows=all_rows, force=force)


@studies.command()
def bootstrap(
    session: Annotated[
        Path,
        typer.Argument(metavar="SESSION", help="session.yaml, or the directory that contains it."),
    ],
    model: Model = None,
    free: Free = None,
    by: Annotated[
        str,
        typer.Option(metavar="residuals|cycles", help="Resample residuals or cycles of setups."),
    ] = "residuals",
    draws: Annotated[int, typer.Option(min=2, max=1_000_000, help="Number of draws.")] = 1000,
    tolerance: Tolerances = None,
    seed: Seed = 0,
    out: Out = None,
    workers: Workers = None,
    dask: Dask = None,
    json: Json = False,
    all_rows: AllRows = False,
    force: Force = False,
) -> None:
    """Scatter of estimates implied by a session's readings."""
    from orthocal.estimation.choice import Choice
    from orthocal.measurement.files.session_file import load_session
    from orthocal.study.bootstrap import build_bootstrap_study

    if by not in ("residuals", "cycles"):
        raise ParameterError(f"found '{by}'; expected residuals or cycles", where="--by")
    measured = load_session(session)
    tolerances = _tolerances(tolerance, measured.robot)
    study = build_bootstrap_study(
        measured,
        Choice(model, free=split_globs(free), tolerances=tolerances),
        by="cycles" if by == "cycles" else "residuals",
        draws=draws,
        seed=seed,
    )
    _run(study, out, workers, dask, json=json, all_rows=all_rows, force=force)


def _run(
    study: Study,
    out: Path | None,
    workers: int | None,
    dask: str | None,
    *,
    json: bool,
    all_rows: bool,
    force: bool,
) -> None:
    """Run a study, print its report and write its files."""
    from orthocal.io.files import require_writable, write_files
    from orthocal.output.study.contents import report_study, study_json
    from orthocal.output.study.report import draw_figure, render_report
    from orthocal.output.text.layout import print_rich
    from orthocal.runtime.interrupts import message_at_interrupt
    from orthocal.runtime.worker_pool import available_cores, call_in_parallel, worker_budget
    from orthocal.study.runner import JOURNAL, run_study, to_parquet

    if dask is not None and workers is not None:
        raise ParameterError(
            "cannot be combined with --dask, whose workers are counted by the scheduler",
            where="--workers",
        )
    if out is not None:
        require_writable(out, [JOURNAL, *FILES])
    count = workers or available_cores()
    resume = "with --out it can be resumed" if out is None else "the same command resumes it"
    with message_at_interrupt(f"orthocal: stopped; {resume}"):
        table = run_study(
            study, folder=out, workers=count, dask=dask, anew=force, report=_progress_lines(study)
        )
    with worker_budget(1 if dask is not None else count):
        report = report_study(table, all_rows=all_rows)
        document = study_json(table, report)
        if json:
            put_out(document.rstrip("\n"))
        else:
            print_rich(render_report(report))
        if out is not None:
            files = call_in_parallel(
                [lambda: to_parquet(table), lambda: draw_figure(report.figure)]
            )
            write_files(out, dict(zip(FILES, (document, *files), strict=True)))
            put_note(f"Wrote {', '.join(str(out / name) for name in FILES)}")


def _progress_lines(study: Study) -> Callable[[Progress], None] | None:
    """Function that prints a line on stderr after each tenth of a study of several tasks."""
    if len(study.task_sizes) < 2:
        return None
    next_share = 0.0

    def report(progress: Progress) -> None:
        nonlocal next_share
        if progress.seconds_left is None:
            if progress.kept:
                put_note(f"orthocal: resume at {progress.kept} of {progress.total} {study.counted}")
            return
        share = progress.done / progress.total
        if share < min(next_share, 1.0):
            return
        next_share = share + PROGRESS_STEP
        left = "" if share >= 1.0 else f", about {_duration(progress.seconds_left)} left"
        put_note(f"orthocal: {progress.done} of {progress.total} {study.counted}{left}")

    return report


def _duration(seconds: float) -> str:
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"


@contextmanager
def _robot_or_session(subject: str, leg_mm: float | None) -> Iterator[Robot | Session]:
    """The robot, if asked for with legs of another length, or the session to study."""
    from orthocal.output.text.subject import load_subject
    from orthocal.robot.builder.build import make_robot
    from orthocal.robot.builder.machine_file import Dimensions
    from orthocal.robot.model import Robot
    from orthocal.session.session import Session
    from orthocal.units import MM

    source = load_subject(subject)
    if not isinstance(source, Robot | Session):
        raise ParameterError("is a calibration; expected a robot or a session", where=subject)
    if leg_mm is None:
        yield source
        return
    if not isinstance(source, Robot) or source.name != "orthoglide":
        raise ParameterError("applies to the robot orthoglide alone", where="--leg-mm")
    usual, leg = Dimensions(), leg_mm * MM
    scale = leg / usual.leg
    dimensions = Dimensions(leg, scale * usual.lower, scale * usual.upper)
    problem = dimensions.find_problem()
    if problem:
        raise ParameterError(problem[1], where="--leg-mm")
    with tempfile.TemporaryDirectory() as directory:
        yield make_robot(dimensions, Path(directory) / "orthoglide")


def _parameter_globs(texts: list[str] | None, robot: Robot) -> tuple[str, ...] | None:
    """Globs of error parameters; the name of a model stands for those of the model."""
    models = robot.parameters.models
    globs = split_globs(texts)
    patterns = [robot.parameters.patterns(g) if g in models else (g,) for g in globs]
    return tuple(pattern for each in patterns for pattern in each) if texts else None


def _tolerances(texts: list[str] | None, robot: Robot) -> dict[str, float]:
    """Values of --tolerance such as '*.offset_mm=2', by name with unit."""
    from orthocal.estimation.selection import read_tolerances
    from orthocal.io.documents import parse_number

    read_tolerances(texts or [], robot.parameters, where="--tolerance")
    values = {}
    for text in texts or []:
        key, _, number = text.partition("=")
        values[key] = parse_number(number, where="--tolerance", name=key, error=ParameterError)
    return values


def _numbers(text: str, option: str) -> list[float]:
    from orthocal.io.documents import parse_number

    return [
        parse_number(part.strip(), where=option, name="part", error=ParameterError)
        for part in text.split(",")
    ]


def _require_between(value: float, low: float, high: float, option: str) -> None:
    if not low < value < high:
        raise ParameterError(
            f"found {value:g}; expected a number between {low:g} and {high:g}", where=option
        )
