"""Whether readings are in order, before anything is made of them: check."""

from __future__ import annotations

from typing import Annotated

import typer

from orthocal.cli.options import Json, SessionPaths, app, load_each_once
from orthocal.cli.printing import put_out


@app.command()
def check(
    sessions: SessionPaths,
    model: Annotated[
        str | None,
        typer.Option(
            help="Errors that the machine may have, as a model of the robot; all by default."
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Look for mistakes in readings: units, signs, rows, steps, a stuck dial, a bumped stand.

    Exit code 0: nothing odd. 3: look at the readings before measuring on, or calibrating.
    """
    from orthocal.assessment.findings.session import decide_session
    from orthocal.measurement.joining import join_sessions
    from orthocal.output.text.check import print_check
    from orthocal.output.text.printed_json import printed_decision

    decision = decide_session(join_sessions(load_each_once(sessions)), model)
    if json:
        put_out(printed_decision(decision).rstrip("\n"))
    else:
        print_check(decision)
    if code := decision.exit_code:
        raise typer.Exit(code)
