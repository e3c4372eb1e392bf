"""The command `calibrate`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Annotated

from typer import Option

from orthocal.cli.files import load_each_once
from orthocal.cli.options import (
    AllRows,
    Details,
    Free,
    Json,
    Model,
    OptionalOutDirectory,
    SessionPaths,
    Tolerances,
    app,
    split_globs,
)
from orthocal.cli.printing import deliver, put_note
from orthocal.errors import ClosureError, OrthocalError, SolverError

if TYPE_CHECKING:
    from orthocal.session.session import Session

FILES = ("calibration.json", "report.html")


@contextmanager
def judgement_on_failure(session: Session, *, json: bool) -> Iterator[None]:
    """Print the judgement of the readings in place of a failure of the solver that it explains."""
    try:
        yield
    except (SolverError, ClosureError) as failure:
        from orthocal.assessment.assess import check_session
        from orthocal.output.text.answer import print_decision
        from orthocal.output.text.summary import result_json

        try:
            assessment = check_session(session)
        except OrthocalError:
            raise failure from None
        if not assessment.decision.exit_code:
            raise
        put_note(f"orthocal: {failure}")
        deliver(
            partial(result_json, assessment),
            partial(print_decision, assessment),
            json=json,
            decision=assessment.decision,
        )


@app.command()
def calibrate(
    sessions: SessionPaths,
    model: Model = None,
    free: Free = None,
    known: Annotated[
        list[str] | None,
        Option(
            metavar="NAME=VALUE[±TOL]",
            help="Known error, fixed or with a tolerance as prior: x_leg.length_mm=0.12±0.02 (or "
            "+-).",
        ),
    ] = None,
    tolerance: Tolerances = None,
    prior: Annotated[
        bool | None,
        Option(
            "--prior/--no-prior",
            help="Use tolerances as priors; default: unless only offsets are identified.",
        ),
    ] = None,
    bound: Annotated[
        list[str] | None,
        Option(
            metavar="GLOB=LOW:HIGH",
            help="Bounds such as 'x_slide.offset_mm=-2:2', or of one side '=-2:'.",
        ),
    ] = None,
    base: Annotated[
        bool,
        Option(
            "--base",
            help="Identify base parameters without priors: one of several redundant parameters.",
        ),
    ] = False,
    loss: Annotated[
        str,
        Option(
            metavar="squares|huber",
            help="Loss function of the residuals; huber reduces the weight of outliers.",
        ),
    ] = "squares",
    solver: Annotated[
        str,
        Option(
            metavar="ipopt|variable-projection|linearised",
            help="Reference, variable projection (faster), or first order as in the paper.",
        ),
    ] = "ipopt",
    profile: Annotated[
        list[str] | None,
        Option(
            metavar="GLOBS", help="Compute profile-likelihood intervals of these errors (slow)."
        ),
    ] = None,
    out: OptionalOutDirectory = None,
    json: Json = False,
    details: Details = False,
    all_rows: AllRows = False,
) -> None:
    """Identify the errors of a machine and the offsets to enter.

    With --out the directory receives calibration.json and report.html.

    Exit code 3: review or reject the readings, for the reason that is printed. All results are
    written nevertheless, unless the solver fails.
    """
    from orthocal.assessment.assess import assessment_of
    from orthocal.assessment.assess import calibrate as run
    from orthocal.estimation.choice import Choice
    from orthocal.estimation.selection import read_bounds, read_known, read_tolerances
    from orthocal.io.files import require_writable
    from orthocal.measurement.joining import join_sessions
    from orthocal.output.text.summary import print_summary, result_json

    def files() -> dict[str, str]:
        from orthocal.calibration.file import calibration_json
        from orthocal.output.report.page import build_report

        return dict(zip(FILES, (calibration_json(result), build_report(result)), strict=True))

    if out is not None:
        require_writable(out, FILES)
    session = join_sessions(load_each_once(sessions))
    parameters = session.robot.parameters
    with judgement_on_failure(session, json=json):
        result = run(
            session,
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
    deliver(
        partial(result_json, result),
        partial(print_summary, result, details=details, all_rows=all_rows, saved=out),
        json=json,
        out=out,
        files=files,
        decision=assessment_of(result).decision,
    )
