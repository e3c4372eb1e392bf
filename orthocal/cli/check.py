"""The command `check`."""

from __future__ import annotations

from functools import partial

from orthocal.cli.files import load_each_once
from orthocal.cli.options import Json, SessionPaths, app
from orthocal.cli.printing import deliver


@app.command()
def check(sessions: SessionPaths, json: Json = False) -> None:
    """Check readings for mistakes: signs, units, rows, the gauge.

    The verdict is that of `calibrate` on the same readings.

    Exit code 0: no anomaly. 3: check the readings before you continue.
    """
    from orthocal.assessment.assess import check_session
    from orthocal.measurement.joining import join_sessions
    from orthocal.output.text.answer import print_decision
    from orthocal.output.text.summary import result_json

    assessment = check_session(join_sessions(load_each_once(sessions)))
    deliver(
        partial(result_json, assessment),
        partial(print_decision, assessment),
        json=json,
        decision=assessment.decision,
    )
