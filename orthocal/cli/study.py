"""The commands `study accuracy`, `study linearisation`, `study sensitivity`, `study bootstrap`."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

import orthocal
from orthocal.cli.files import load_stated_plan
from orthocal.cli.options import (
    LARGEST_MM,
    Seed,
    Workers,
    app,
    command,
    load_robot_or_session,
    make_group,
    read_numbers,
    read_tolerances,
    read_workspace,
    require_between,
    split_effects,
    split_globs,
)
from orthocal.cli.overwriting import require_replaceable_results
from orthocal.cli.printing import deliver, put_note
from orthocal.errors import ParameterError
from orthocal.io.files import Content, require_writable
from orthocal.units import MM

if TYPE_CHECKING:
    from orthocal.planning.first_plan import Displacements
    from orthocal.study.runner import Progress

studies = make_group("Simulate many machines, or resample readings.")
app.add_typer(studies, name="study")

FILES = ("study.json", "results.parquet", "study.svg")
"""Files that a finished study writes beside its results.jsonl."""

PROGRESS_STEP = 0.1
"""Progress between two printed lines, as a share of the study."""

Count = Annotated[int, Option(min=2, max=1_000_000)]
Size = Annotated[int, Option(min=1, max=10_000)]
Subject = Annotated[str, Argument()]


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """Options about the run of a study and its results."""

    workers: Workers = None
    dask: str | None = None
    out: Path | None = None
    json: bool = False
    all_: bool = False
    force: bool = False


@command(studies)
def accuracy(
    plan: Path,
    *,
    model: str | None = None,
    free: list[str] | None = None,
    machines: Count = 1000,
    draw: list[str] | None = None,
    error: list[str] | None = None,
    errors: Path | None = None,
    effects: str | None = None,
    ignore: str | None = None,
    temperature: str | None = None,
    tolerance: list[str] | None = None,
    half_side_mm: float | None = None,
    seed: Seed = 0,
    run: RunOptions,
) -> None:
    """Predict the tool error of many machines after calibration.

    A stopped study is resumed from its directory; --force starts again.

    Args:
        machines (N): Number of machines.
        draw (MODEL|PATTERNS): Errors that are random, by their tolerances; default: all.
        effects (EFFECTS): Effects that the machines have, such as backlash,thermal, or none;
            default: those of the plan.
        ignore (EFFECTS): Effects of the machines that the calibration ignores; the answer states
            the increase of the tool error.
    """
    from orthocal.observation.simulate import collect_errors

    session = load_stated_plan(plan, effects=effects, temperature=temperature)
    robot, machine_effects = session.robot, session.robot.effect_names
    fixed = {}
    if error or errors is not None:
        fixed = collect_errors(robot, file=errors, single=error or [], adjusted=session.adjusted)
    tolerances = read_tolerances(tolerance, robot)
    if half_side_mm is not None:
        read_workspace(f"{half_side_mm:g}", robot, where="--half-side-mm")
    study = orthocal.build_accuracy_study(
        session,
        orthocal.Choice(
            model,
            free=split_globs(free),
            tolerances=tolerances,
            effects=_without(machine_effects, ignore) if ignore else None,
        ),
        effects=machine_effects,
        drawn=_parameter_globs(draw, robot),
        fixed=fixed,
        machines=machines,
        seed=seed,
        half_side=None if half_side_mm is None else half_side_mm * MM,
    )
    _run(study, run)


def _without(effects: Sequence[str], ignored: str) -> list[str]:
    """Effects of the machines that the calibration does not ignore.

    Raises:
        ParameterError: If the machines lack an ignored effect.
    """
    names = split_effects(ignored) or []
    for name in names:
        if name not in effects:
            listed = ", ".join(effects) or "none"
            raise ParameterError(
                f"found '{name}'; expected effects of the machines ({listed}), which --effects "
                "chooses",
                where="--ignore",
            )
    return [name for name in effects if name not in names]


@command(studies)
def linearisation(
    subject: Subject = "orthoglide",
    free: list[str] | None = None,
    largest_mm: float = 50.0,
    sizes: Size = 40,
    directions: Annotated[int | None, Option(min=1, max=10_000)] = None,
    along: str | None = None,
    max_mm: float | None = None,
    min_mm: float | None = None,
    leg_mm: float | None = None,
    sigma_mm: float | None = None,
    resolution_mm: float | None = None,
    seed: Seed = 0,
    workers: Workers = None,
    dask: str | None = None,
    out: Path | None = None,
    json: bool = False,
    force: bool = False,
) -> None:
    """Compare linearised with exact identification as errors grow.

    Args:
        free (GLOBS): Errors that grow; default: offsets.
        largest_mm (SIZE): Largest size of the errors, mm or mrad.
        sizes (N): Number of sizes, from 0.1 mm on.
        directions (N): Number of random directions of the errors; default: 25.
        along (A,B,...): One direction in place of random ones, such as 1,-0.6,0.3.
        max_mm (MM): Displacement of the paper's maximum postures; default: 60 mm, scaled with legs.
        min_mm (MM): Displacement of the minimum postures; default: -100 mm, scaled with legs.
        sigma_mm (MM): Standard deviation of a reading, mm; default: 0.02, as in the paper.
        resolution_mm (MM): Resolution of a reading, mm; default: 0.01, as in the paper.
    """
    from orthocal.planning.first_plan import PAPER_GAUGE

    require_between(largest_mm, 0.0, LARGEST_MM, "--largest-mm")
    displacements = _read_displacements(leg_mm, max_mm, min_mm)
    for name, value in (("--sigma-mm", sigma_mm), ("--resolution-mm", resolution_mm)):
        if value is not None:
            require_between(value, 0.0, 1e3, name)
    with _read_subject(subject, leg_mm) as (session, robot):
        for name, value in (("--max-mm", max_mm), ("--min-mm", min_mm)):
            if session is not None and value is not None:
                raise ParameterError("is for a robot; found a session with postures", where=name)
        gauge = PAPER_GAUGE if session is None else session.gauge
        study = orthocal.build_linearisation_study(
            session or robot,
            free=split_globs(free) or ("*.offset",),
            largest=largest_mm,
            count=sizes,
            directions=directions or 25,
            along=_read_along(along, directions),
            displacements=displacements,
            gauge=orthocal.Gauge(
                gauge.sigma if sigma_mm is None else sigma_mm * MM,
                gauge.resolution if resolution_mm is None else resolution_mm * MM,
                None,
            ),
            seed=seed,
        )
    _run(study, RunOptions(workers=workers, dask=dask, out=out, json=json, force=force))


def _read_along(along: str | None, directions: int | None) -> Sequence[float] | None:
    """The stated direction of the errors; None for random ones."""
    if along is None:
        return None
    if directions is not None:
        raise ParameterError("cannot be combined with --along", where="--directions")
    return read_numbers(along, "--along")


def _read_displacements(
    leg_mm: float | None, max_mm: float | None, min_mm: float | None
) -> Displacements:
    """Displacements of the paper's postures, by default scaled with the legs."""
    from orthocal.planning.first_plan import Displacements

    scale = _scale_of(leg_mm) if leg_mm is not None and leg_mm > 0.0 else 1.0
    usual = Displacements()
    maximum = scale * usual.maximum / MM if max_mm is None else max_mm
    minimum = scale * usual.minimum / MM if min_mm is None else min_mm
    require_between(maximum, 0.0, LARGEST_MM, "--max-mm")
    require_between(minimum, -LARGEST_MM, 0.0, "--min-mm")
    return Displacements(maximum * MM, minimum * MM)


@command(studies)
def sensitivity(
    subject: Subject = "orthoglide",
    free: list[str] | None = None,
    at: list[str] | None = None,
    leg_mm: float | None = None,
    out: Path | None = None,
    json: bool = False,
    all_: bool = False,
    force: bool = False,
) -> None:
    """Print how each error changes readings and tool position.

    Args:
        free (MODEL|GLOBS): Errors; default: all that change a reading or the tool.
        at (X,Y,Z): Tool position, mm, at which every setup is read. Can be repeated.
    """
    with _read_subject(subject, leg_mm) as (session, robot):
        count = 0 if robot.tcp is None else len(robot.tcp.coordinates)
        points = []
        for text in at or []:
            point = read_numbers(text, "--at")
            if len(point) != count:
                raise ParameterError(
                    f"'{text}' has {len(point)} numbers; expected {count}", where="--at"
                )
            points.append([v * MM for v in point])
        study = orthocal.build_sensitivity_study(
            session or robot, _parameter_globs(free, robot), points=points or None
        )
    _run(study, RunOptions(workers=1, out=out, json=json, all_=all_, force=force))


@command(studies)
def bootstrap(
    session: Path,
    *,
    model: str | None = None,
    free: list[str] | None = None,
    by: str = "residuals",
    draws: Count = 1000,
    tolerance: list[str] | None = None,
    seed: Seed = 0,
    run: RunOptions,
) -> None:
    """Estimate the scatter of errors by resampling a session.

    Args:
        session (SESSION): session.yaml, or the directory that contains it.
        by (residuals|cycles): Resample residuals or cycles of setups.
        draws (N): Number of draws.
    """
    if by not in ("residuals", "cycles"):
        raise ParameterError(f"found '{by}'; expected residuals or cycles", where="--by")
    measured = orthocal.load_session(session)
    tolerances = read_tolerances(tolerance, measured.robot)
    study = orthocal.build_bootstrap_study(
        measured,
        orthocal.Choice(model, free=split_globs(free), tolerances=tolerances),
        by="cycles" if by == "cycles" else "residuals",
        draws=draws,
        seed=seed,
    )
    _run(study, run)


def _run(study: orthocal.Study, options: RunOptions) -> None:
    """Run a study, print its report and write its files."""
    from orthocal.output.text.study import render_report, report_study, study_json
    from orthocal.runtime.interrupts import message_at_interrupt
    from orthocal.runtime.worker_pool import available_cores, call_in_parallel, worker_budget
    from orthocal.study.runner import JOURNAL, run_study, to_parquet

    def files() -> dict[str, Content]:
        calls = [lambda: to_parquet(table), report.draw]
        return dict(zip(FILES, (document, *call_in_parallel(calls)), strict=True))

    out, dask = options.out, options.dask
    if dask is not None and options.workers is not None:
        raise ParameterError(
            "cannot be combined with --dask, whose workers are counted by the scheduler",
            where="--workers",
        )
    if out is not None:
        require_writable(out, [JOURNAL])
        require_replaceable_results(out, dict.fromkeys(FILES, ""), force=options.force)
    count = options.workers or available_cores()
    resume = "with --out it can be resumed" if out is None else "the same command resumes it"
    with message_at_interrupt(f"orthocal: stopped; {resume}"):
        table = run_study(
            study,
            directory=out,
            workers=count,
            dask=dask,
            discard=options.force,
            report=_progress_lines(study),
        )
    with worker_budget(1 if dask is not None else count):
        report = report_study(table, all_rows=options.all_)
        document = study_json(table, report)
        deliver(
            lambda: document,
            lambda: render_report(report),
            json=options.json,
            out=out,
            files=files,
        )


def _progress_lines(study: orthocal.Study) -> Callable[[Progress], None] | None:
    """Function that prints a line on stderr after each tenth of a study; None for one task."""
    if len(study.task_sizes) < 2:
        return None
    next_share = 0.0

    def report(progress: Progress) -> None:
        nonlocal next_share
        if progress.seconds_left is None:
            if progress.resumed:
                put_note(
                    f"orthocal: resume at {progress.resumed} of {progress.total} {study.counted}"
                )
            return
        share = progress.done / progress.total
        if share < min(next_share, 1.0):
            return
        next_share = share + PROGRESS_STEP
        remaining = "" if share >= 1.0 else f", about {_duration(progress.seconds_left)} left"
        put_note(f"orthocal: {progress.done} of {progress.total} {study.counted}{remaining}")

    return report


def _duration(seconds: float) -> str:
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"


@contextmanager
def _read_subject(
    subject: str, leg_mm: float | None
) -> Iterator[tuple[orthocal.Session | None, orthocal.Robot]]:
    """Session to study (None for a robot alone) and its robot, with the stated leg length.

    Args:
        subject: Name or path of a robot or a session.
        leg_mm: Leg length of an Orthoglide, [mm]; None for that of the subject.

    Raises:
        ParameterError: If the leg length is invalid, or the subject is no Orthoglide.
    """
    session, robot = load_robot_or_session(subject)
    if leg_mm is None:
        yield session, robot
        return
    if session is not None or robot.name != "orthoglide":
        raise ParameterError("applies to the robot orthoglide alone", where="--leg-mm")
    scale = _scale_of(leg_mm)
    lower, upper = (scale * limit for limit in orthocal.Orthoglide().travel)
    dimensions = orthocal.Orthoglide(leg=leg_mm * MM, travel=(lower, upper))
    problem = dimensions.find_problem()
    if problem:
        raise ParameterError(problem[1], where="--leg-mm")
    with tempfile.TemporaryDirectory() as directory:
        yield None, orthocal.make_robot(dimensions, Path(directory) / "orthoglide")


def _scale_of(leg_mm: float) -> float:
    """Ratio of a leg length to that of the paper's machine."""
    return leg_mm * MM / orthocal.Orthoglide().leg


def _parameter_globs(texts: list[str] | None, robot: orthocal.Robot) -> tuple[str, ...] | None:
    """Globs of error parameters; the name of a model is replaced by the globs of the model."""
    models = robot.parameters.models
    globs = split_globs(texts)
    patterns = [robot.parameters.patterns(g) if g in models else (g,) for g in globs]
    return tuple(chain.from_iterable(patterns)) if texts else None
