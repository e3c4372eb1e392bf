"""What readings say: calibrate, compare, validate."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orthocal.cli.options import (
    AllRows,
    CalibrationPath,
    Json,
    SessionPaths,
    Tolerances,
    app,
    load_each_once,
    split_globs,
)
from orthocal.cli.printing import put_note, put_out
from orthocal.errors import ClosureError, OrthocalError, SolverError

if TYPE_CHECKING:
    from orthocal.session.session import Session


@contextmanager
def _judge_on_failure(session: Session, *, json: bool) -> Iterator[None]:
    """Print the judgement of the readings in place of a solver's failure that they explain."""
    try:
        yield
    except (SolverError, ClosureError) as failure:
        from orthocal.assessment.assess import check_session
        from orthocal.output.text.answer import print_decision
        from orthocal.output.text.printed_json import printed_assessment

        try:
            found = check_session(session)
        except OrthocalError:
            raise failure from None
        if not found.decision.exit_code:
            raise
        if json:
            put_out(printed_assessment(found).rstrip("\n"))
        else:
            print_decision(found)
        put_note(f"orthocal: {failure}")
        raise typer.Exit(found.decision.exit_code) from None


@app.command()
def calibrate(
    sessions: SessionPaths,
    model: Annotated[
        str | None,
        typer.Option(
            help="Which errors are free: full (all, with priors), offsets, lengths, or one of the "
            "robot's own; by default what the session states, otherwise full.",
        ),
    ] = None,
    free: Annotated[
        list[str] | None,
        typer.Option(
            metavar="GLOBS",
            help="Names or globs, with commas, that are free too, or instead where no --model is "
            "given; '!' takes out: --model full --free '!*_fork.*'.",
        ),
    ] = None,
    prior: Annotated[
        bool | None,
        typer.Option(
            "--prior/--no-prior",
            help="Whether tolerances act as a prior; by default not for offsets, else yes.",
        ),
    ] = None,
    known: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE[±TOL]",
            help="A value known from elsewhere: held, or with a tolerance a prior, such as "
            "x_leg.length_mm=0.12±0.02 (or +-).",
        ),
    ] = None,
    tolerance: Tolerances = None,
    bound: Annotated[
        list[str] | None,
        typer.Option(
            metavar="GLOB=LOW:HIGH", help="Bounds, such as 'x_slide.offset_mm=-2:2'; open: '=-2:'."
        ),
    ] = None,
    base: Annotated[
        bool,
        typer.Option(
            "--base",
            help="Base parameters, without any prior: of what cannot be told apart one stays.",
        ),
    ] = False,
    loss: Annotated[
        str,
        typer.Option(
            metavar="squares|huber",
            help="What residuals cost; with huber single wrong readings pull less.",
        ),
    ] = "squares",
    solver: Annotated[
        str,
        typer.Option(
            metavar="ipopt|eliminated|linearised",
            help="The reference; the same optimum sooner; to first order, as the paper.",
        ),
    ] = "ipopt",
    profile: Annotated[
        list[str] | None,
        typer.Option(
            metavar="GLOBS", help="Profile-likelihood intervals of these parameters, slowly."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for calibration.json and report.html; made if need be."),
    ] = None,
    json: Json = False,
    details: Annotated[
        bool, typer.Option("--details", help="Print all that is known, not the answer alone.")
    ] = False,
    all_rows: Annotated[
        bool,
        typer.Option(
            "--all", help="--details with every reading, parameter and group, however many."
        ),
    ] = False,
) -> None:
    """Identify the errors of a machine from sessions of readings: what to enter, and whether.

    Exit code 3: the readings are to be reviewed or rejected, for the reason that is printed; all
    outputs are written nevertheless, unless the solver fails.
    """
    from orthocal.assessment.assess import assessment_of
    from orthocal.assessment.assess import calibrate as run
    from orthocal.estimation.choice import Choice
    from orthocal.estimation.selection import read_bounds, read_known, read_tolerances
    from orthocal.io.files import require_writable, write_files
    from orthocal.measurement.joining import join_sessions
    from orthocal.output.text.summary import print_summary

    if out is not None:
        require_writable(out, ("calibration.json", "report.html"))
    loaded = join_sessions(load_each_once(sessions))
    parameters = loaded.robot.parameters
    with _judge_on_failure(loaded, json=json):
        result = run(
            loaded,
            Choice(
                model=model,
                free=split_globs(free),
                prior=prior,
                known=read_known(known or [], parameters, where="--known"),
                tolerances=read_tolerances(tolerance or [], parameters, where="--tolerance"),
                bounds=read_bounds(bound or [], parameters, where="--bound"),
                base=base,
            ),
            loss=loss,  # type: ignore[arg-type] # checked there
            solver=solver,  # type: ignore[arg-type] # likewise
            profile=split_globs(profile),
        )
    if json:
        from orthocal.output.text.printed_json import printed_calibration

        put_out(printed_calibration(result).rstrip("\n"))
    else:
        print_summary(result, details=details, all_rows=all_rows, saved=out)
    if out is not None:
        from orthocal.calibration.file import calibration_json
        from orthocal.output.report.page import build_report

        files = {"calibration.json": calibration_json(result), "report.html": build_report(result)}
        write_files(out, files)
        put_note(f"Wrote {out / 'calibration.json'} and {out / 'report.html'}")
    if code := assessment_of(result).decision.exit_code:
        raise typer.Exit(code)


@app.command()
def compare(
    sessions: SessionPaths,
    models: Annotated[
        str | None,
        typer.Option(metavar="MODELS", help="With commas between; all of the robot's by default."),
    ] = None,
    repeat: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="SESSION",
            help="Another session: does what remains repeat? May be given several times.",
        ),
    ] = None,
    tolerance: Tolerances = None,
    json: Json = False,
    all_rows: AllRows = False,
) -> None:
    """Which model do the readings support: offsets, lengths, full, linearised and exact?

    Exit code 3: the readings are to be reviewed or rejected; the verdict is that of `calibrate`.
    """
    from orthocal.assessment.comparison import compare_models
    from orthocal.estimation.selection import read_tolerances
    from orthocal.measurement.joining import join_sessions
    from orthocal.output.text.printed_json import printed_comparison
    from orthocal.output.text.summary import print_summary

    loaded = load_each_once(sessions)
    parameters = loaded[0].robot.parameters
    with _judge_on_failure(join_sessions(loaded), json=json):
        result = compare_models(
            loaded,
            models=split_globs([models] if models else None),
            tolerances=read_tolerances(tolerance or [], parameters, where="--tolerance"),
            repeat=load_each_once(repeat) if repeat else None,
        )
    if json:
        put_out(printed_comparison(result).rstrip("\n"))
    else:
        print_summary(result, all_rows=all_rows)
    if code := result.assessment.decision.exit_code:
        raise typer.Exit(code)


@app.command()
def validate(
    calibration: CalibrationPath,
    sessions: Annotated[
        list[Path],
        typer.Argument(
            metavar="NEW_SESSION...", help="Taken with the identified offsets in the controller."
        ),
    ],
    json: Json = False,
    all_rows: AllRows = False,
) -> None:
    """Hold a new session against a calibration: is it confirmed?

    Exit code 0: it is. 3: it is not, or the new readings are to be reviewed or rejected.
    """
    from orthocal.assessment.validation import validate_calibration
    from orthocal.calibration.file import load_calibration
    from orthocal.output.text.printed_json import printed_validation
    from orthocal.output.text.summary import print_summary

    result = validate_calibration(load_calibration(calibration), load_each_once(sessions))
    if json:
        put_out(printed_validation(result).rstrip("\n"))
    else:
        print_summary(result, all_rows=all_rows)
    if code := result.assessment.decision.exit_code:
        raise typer.Exit(code)
