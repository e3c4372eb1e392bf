"""The command `compare`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

from typer import Option

from orthocal.cli.calibrate import judgement_on_failure
from orthocal.cli.files import load_each_once
from orthocal.cli.options import AllRows, Json, SessionPaths, Tolerances, app, split_globs
from orthocal.cli.printing import deliver


@app.command()
def compare(
    sessions: SessionPaths,
    models: Annotated[
        str | None,
        Option(metavar="MODELS", help="Models, separated by commas; default: all of the robot."),
    ] = None,
    repeat: Annotated[
        list[Path] | None,
        Option(
            metavar="SESSION",
            help="Another session, to see which residuals repeat. Can be repeated.",
        ),
    ] = None,
    tolerance: Tolerances = None,
    json: Json = False,
    all_rows: AllRows = False,
) -> None:
    """Compare models, and recommend the one that readings support.

    Exit code 3: review or reject the readings; the verdict is that of `calibrate`.
    """
    from orthocal.assessment.comparison import compare_models
    from orthocal.estimation.selection import read_tolerances
    from orthocal.measurement.joining import join_sessions
    from orthocal.output.text.summary import print_summary, result_json

    loaded = load_each_once(sessions)
    parameters = loaded[0].robot.parameters
    with judgement_on_failure(join_sessions(loaded), json=json):
        comparison = compare_models(
            loaded,
            models=split_globs([models] if models else None),
            tolerances=read_tolerances(tolerance or [], parameters, where="--tolerance"),
            repeat=load_each_once(repeat) if repeat else None,
        )
    deliver(
        partial(result_json, comparison),
        partial(print_summary, comparison, all_rows=all_rows),
        json=json,
        decision=comparison.assessment.decision,
    )
