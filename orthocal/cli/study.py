"""What if: study."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orthocal.cli.options import Json, Tolerances, app, read_workspace, split_globs
from orthocal.cli.printing import put_note, put_out
from orthocal.cli.progress import told
from orthocal.errors import ParameterError

if TYPE_CHECKING:
    from orthocal.robot.model import Robot
    from orthocal.session.session import Session
    from orthocal.study.study import Study

studies = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="What many machines, larger errors or other readings would do.",
)
app.add_typer(studies, name="study")

FILES = ("study.json", "results.parquet", "study.svg")
"""What a study writes when it has ended, beside its results as they come."""

LEG_MM = 310.25
"""Of the machine for which the paper's displacements are 60 and -100 mm."""

MOST_MM = 1e4

Out = Annotated[
    Path | None,
    typer.Option(help="Folder for the results; there a study goes on where it was stopped."),
]
Seed = Annotated[int, typer.Option(min=0, help="Of all that is drawn.")]
Workers = Annotated[
    int | None, typer.Option(min=1, max=1024, help="Processes; by default all cores.")
]
Dask = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Of a Dask scheduler, to run it there.")
]
Force = Annotated[bool, typer.Option("--force", help="Begin anew, whatever is there.")]
AllRows = Annotated[bool, typer.Option("--all", help="List every parameter.")]
Model = Annotated[
    str | None, typer.Option(help="What is identified; by default what the session says.")
]
Free = Annotated[
    list[str] | None,
    typer.Option(metavar="GLOBS", help="Names or globs, on top of the model or instead of one."),
]
Subject = Annotated[
    str,
    typer.Argument(
        metavar="ROBOT|SESSION",
        help="A robot of the Orthoglide's kind, read as in the paper; or a session.",
    ),
]
LegMm = Annotated[
    float | None,
    typer.Option("--leg-mm", help="Leg length of a machine of the Orthoglide's kind."),
]


@studies.command()
def accuracy(
    plan: Annotated[
        Path, typer.Argument(metavar="PLAN", help="A session.yaml, with readings or without.")
    ],
    model: Model = None,
    free: Free = None,
    machines: Annotated[int, typer.Option(min=2, max=1_000_000, help="How many.")] = 1000,
    draw: Annotated[
        list[str] | None,
        typer.Option(
            metavar="MODEL|GLOBS",
            help="Errors that machines have, from their tolerances: all by default.",
        ),
    ] = None,
    error: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="An error that all of them have."),
    ] = None,
    errors: Annotated[
        Path | None, typer.Option(help="YAML file with such errors (see a truth.yaml).")
    ] = None,
    tolerance: Tolerances = None,
    half_side_mm: Annotated[
        float | None,
        typer.Option("--half-side-mm", help="Half the side of the cube that counts."),
    ] = None,
    seed: Seed = 0,
    out: Out = None,
    workers: Workers = None,
    dask: Dask = None,
    json: Json = False,
    all_rows: AllRows = False,
    force: Force = False,
) -> None:
    """How good a plan's readings leave machines: many are drawn, read and calibrated."""
    from orthocal.estimation.choice import Choice
    from orthocal.estimation.selection import read_tolerances
    from orthocal.io.files import exists
    from orthocal.measurement.files.session_file import load_plan
    from orthocal.observation.simulate import collect_errors
    from orthocal.robot.loading import packaged_robots
    from orthocal.study.accuracy_options import build_accuracy_study
    from orthocal.units import MM

    if not exists(plan) and str(plan) in packaged_robots():
        raise ParameterError(
            f"is a robot; expected a session.yaml: `orthocal plan {plan} --out ...` makes one",
            where=str(plan),
        )
    session = load_plan(plan)
    parameters = session.robot.parameters
    given: dict[str, float] = {}
    if error or errors is not None:
        given = collect_errors(session.robot, file=errors, single=error or [])
    read_tolerances(tolerance or [], parameters, where="--tolerance")
    tolerances = _quantities(tolerance)
    if half_side_mm is not None:
        read_workspace(f"{half_side_mm:g}", session.robot, where="--half-side-mm")
    study = build_accuracy_study(
        session,
        Choice(model, free=split_globs(free), tolerances=tolerances),
        drawn=_drawn(draw, session.robot),
        given=given,
        machines=machines,
        seed=seed,
        half_side=None if half_side_mm is None else half_side_mm * MM,
    )
    _finish(study, out, workers, dask, json=json, all_rows=all_rows, force=force)


@studies.command()
def linearisation(
    subject: Subject = "orthoglide",
    free: Annotated[
        list[str] | None,
        typer.Option(metavar="GLOBS", help="Errors that grow; by default offsets."),
    ] = None,
    largest_mm: Annotated[
        float, typer.Option("--largest-mm", help="Of the errors; mrad of angles.")
    ] = 50.0,
    sizes: Annotated[int, typer.Option(min=1, max=10_000, help="Of errors, from 0.1 mm on.")] = 40,
    directions: Annotated[
        int, typer.Option(min=1, max=10_000, help="Of errors, drawn at random.")
    ] = 25,
    along: Annotated[
        str | None,
        typer.Option(metavar="A,B,...", help="One direction instead, such as 1,-0.6,0.3."),
    ] = None,
    max_mm: Annotated[
        float | None,
        typer.Option(
            "--max-mm", help="How far the tool goes out, in the paper's plan: 60, or as legs are."
        ),
    ] = None,
    min_mm: Annotated[float | None, typer.Option("--min-mm", help="And in: -100.")] = None,
    leg_mm: LegMm = None,
    sigma_mm: Annotated[
        float | None, typer.Option("--sigma-mm", help="Noise of a reading; the paper's 0.02.")
    ] = None,
    resolution_mm: Annotated[
        float | None, typer.Option("--resolution-mm", help="Of a reading; the paper's 0.01.")
    ] = None,
    seed: Seed = 0,
    out: Out = None,
    workers: Workers = None,
    dask: Dask = None,
    json: Json = False,
    force: Force = False,
) -> None:
    """What linearising costs as errors grow, against the exact solution."""
    from orthocal.robot.model import Robot
    from orthocal.session.session import Gauge
    from orthocal.study.linearisation import build_linearisation_study
    from orthocal.study.paper import PAPER_GAUGE, Displacements
    from orthocal.units import MM

    share = leg_mm / LEG_MM if leg_mm is not None and leg_mm > 0.0 else 1.0
    out_mm, in_mm = (
        share * usual if given is None else given
        for usual, given in ((60.0, max_mm), (-100.0, min_mm))
    )
    for name, value in (("--largest-mm", largest_mm), ("--max-mm", out_mm)):
        if not 0.0 < value < MOST_MM:
            raise ParameterError(
                f"found {value:g}; expected a number above 0, and below {MOST_MM:g}", where=name
            )
    if not -MOST_MM < in_mm < 0.0:
        raise ParameterError(
            f"found {in_mm:g}; expected a number below 0, and above {-MOST_MM:g}", where="--min-mm"
        )
    for name, noise in (("--sigma-mm", sigma_mm), ("--resolution-mm", resolution_mm)):
        if noise is not None and not 0.0 < noise < 1e3:
            raise ParameterError(f"found {noise:g}; expected a number above 0", where=name)
    with _subject(subject, leg_mm) as source:
        known = PAPER_GAUGE if isinstance(source, Robot) else source.gauge
        gauge = Gauge(
            known.sigma if sigma_mm is None else sigma_mm * MM,
            known.resolution if resolution_mm is None else resolution_mm * MM,
            None,
        )
        study = build_linearisation_study(
            source,
            free=split_globs(free) or ("*.offset",),
            largest=largest_mm,
            count=sizes,
            directions=directions,
            along=None if along is None else _numbers(along, "--along"),
            displacements=Displacements(out_mm * MM, in_mm * MM),
            gauge=gauge,
            seed=seed,
        )
    _finish(study, out, workers, dask, json=json, all_rows=False, force=force)


@studies.command()
def sensitivity(
    subject: Subject = "orthoglide",
    free: Annotated[
        list[str] | None,
        typer.Option(metavar="MODEL|GLOBS", help="Errors; by default all that change something."),
    ] = None,
    at: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y,Z", help="Where the tool stands, mm, in every setup; may be repeated."
        ),
    ] = None,
    leg_mm: LegMm = None,
    out: Out = None,
    json: Json = False,
    all_rows: AllRows = False,
    force: Force = False,
) -> None:
    """What each reading, and the tool, answers to each error in any posture."""
    from orthocal.robot.model import Robot
    from orthocal.study.sensitivity import build_sensitivity_study
    from orthocal.units import MM

    with _subject(subject, leg_mm) as source:
        robot = source if isinstance(source, Robot) else source.robot
        count = 0 if robot.tcp is None else len(robot.tcp.coordinates)
        points = [[v * MM for v in _numbers(text, "--at")] for text in at or []]
        for text, point in zip(at or [], points, strict=True):
            if len(point) != count:
                raise ParameterError(
                    f"'{text}' has {len(point)} numbers; expected {count}", where="--at"
                )
        study = build_sensitivity_study(source, _drawn(free, robot), points=points or None)
    _finish(study, out, 1, None, json=json, all_rows=all_rows, force=force)


@studies.command()
def bootstrap(
    session: Annotated[
        Path,
        typer.Argument(metavar="SESSION", help="session.yaml, or the folder that holds it."),
    ],
    model: Model = None,
    free: Free = None,
    by: Annotated[
        str, typer.Option(metavar="residuals|cycles", help="What is drawn anew.")
    ] = "residuals",
    draws: Annotated[int, typer.Option(min=2, max=1_000_000, help="How many.")] = 1000,
    tolerance: Tolerances = None,
    seed: Seed = 0,
    out: Out = None,
    workers: Workers = None,
    dask: Dask = None,
    json: Json = False,
    all_rows: AllRows = False,
    force: Force = False,
) -> None:
    """How far estimates scatter by what a session's own readings show."""
    from orthocal.estimation.choice import Choice
    from orthocal.estimation.selection import read_tolerances
    from orthocal.measurement.files.session_file import load_session
    from orthocal.study.bootstrap import build_bootstrap_study

    if by not in ("residuals", "cycles"):
        raise ParameterError(f"found '{by}'; expected residuals or cycles", where="--by")
    measured = load_session(session)
    read_tolerances(tolerance or [], measured.robot.parameters, where="--tolerance")
    study = build_bootstrap_study(
        measured,
        Choice(model, free=split_globs(free), tolerances=_quantities(tolerance)),
        how="cycles" if by == "cycles" else "residuals",
        draws=draws,
        seed=seed,
    )
    _finish(study, out, workers, dask, json=json, all_rows=all_rows, force=force)


def _finish(
    study: Study,
    out: Path | None,
    workers: int | None,
    dask: str | None,
    *,
    json: bool,
    all_rows: bool,
    force: bool,
) -> None:
    """Run a study, print its answer, and write what was asked for."""
    from orthocal.io.files import require_writable, write_files
    from orthocal.output.study.views import draw_study, render_study, study_json, summarise_study
    from orthocal.output.text.layout import print_rich
    from orthocal.runtime.interrupts import raised_interrupt
    from orthocal.runtime.worker_pool import available_cores, call_on_cores, lent
    from orthocal.study.parquet import to_parquet
    from orthocal.study.runner import JOURNAL, run_study

    if dask is not None and workers is not None:
        raise ParameterError(
            "found with --dask, which has its own; expected one", where="--workers"
        )
    if out is not None:
        require_writable(out, [JOURNAL, *FILES])
    count = workers or available_cores()
    try:
        with raised_interrupt(), told(study) as report:
            table = run_study(
                study,
                folder=out,
                workers=count,
                dask=dask,
                anew=force,
                report=report,
            )
    except KeyboardInterrupt:
        kept = "with --out it could go on later" if out is None else "the same command goes on"
        put_note(f"orthocal: stopped; {kept}")
        raise
    own = count if dask is None else 1
    with lent(own):
        summary = summarise_study(table)
    document = study_json(table, summary)
    if json:
        put_out(document.rstrip("\n"))
    else:
        print_rich(render_study(table, summary, all_rows=all_rows))
    if out is not None:
        with lent(own):
            rest = call_on_cores([lambda: to_parquet(table), lambda: draw_study(table, summary)])
        write_files(out, dict(zip(FILES, (document, *rest), strict=True)))
        put_note(f"Wrote {', '.join(str(out / name) for name in FILES)}")


@contextmanager
def _subject(subject: str, leg_mm: float | None) -> Iterator[Robot | Session]:
    """What is studied: a robot, as it is or with legs of another length; or a session."""
    from orthocal.output.text.subject import load_subject
    from orthocal.robot.model import Robot
    from orthocal.session.session import Session
    from orthocal.units import MM

    found = load_subject(subject)
    if not isinstance(found, Robot | Session):
        raise ParameterError("is a calibration; expected a robot or a session", where=subject)
    if leg_mm is None:
        yield found
        return
    if not isinstance(found, Robot) or found.name != "orthoglide":
        raise ParameterError("is of the robot orthoglide; this is another", where="--leg-mm")
    from orthocal.robot.builder.build import Dimensions, make_robot

    pattern, leg = Dimensions(), leg_mm * MM
    longer = leg / pattern.leg
    sizes = Dimensions(leg, longer * pattern.lower, longer * pattern.upper)
    problem = sizes.find_problem()
    if problem:
        raise ParameterError(problem[1], where="--leg-mm")
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        yield make_robot(sizes, folder / "orthoglide")


def _drawn(texts: list[str] | None, robot: Robot) -> tuple[str, ...] | None:
    """Patterns of names: those of a model, or as given."""
    if not texts:
        return None
    found: list[str] = []
    for glob in split_globs(texts):
        own = glob in robot.parameters.models
        found += robot.parameters.patterns(glob) if own else (glob,)
    return tuple(found)


def _quantities(texts: list[str] | None) -> dict[str, float]:
    """Numbers of options such as '*.offset_mm=2', by their names with units."""
    from orthocal.io.documents import parse_number

    found = {}
    for text in texts or []:
        key, _, number = text.partition("=")
        found[key] = parse_number(number, where="--tolerance", name=key, error=ParameterError)
    return found


def _numbers(text: str, option: str) -> list[float]:
    from orthocal.io.documents import parse_number

    return [
        parse_number(part.strip(), where=option, name="part", error=ParameterError)
        for part in text.split(",")
    ]
