"""The command `check`."""

from __future__ import annotations

import typer

from orthocal.cli.options import Json, SessionPaths, app, load_each_once
from orthocal.cli.printing import put_out


@app.command()
def check(
    sessions: SessionPaths,
    json: Json = False,
) -> None:
    """Check readings for mistakes: units, signs, rows, a stuck dial, a displaced stand.

    Exit code 0: no anomaly. 3: check the readings before you continue. The verdict is that of
    `calibrate` on the same readings.
    """
    from orthocal.assessment.assess import check_session
    from orthocal.measurement.joining import join_sessions
    from orthocal.output.text.answer import print_decision
    from orthocal.output.text.printed_json import printed_assessment

    found = check_session(join_sessions(load_each_once(sessions)))
    if json:
        put_out(printed_assessment(found).rstrip("\n"))
    else:
        print_decision(found)
    if code := found.decision.exit_code:
        raise typer.Exit(code)
