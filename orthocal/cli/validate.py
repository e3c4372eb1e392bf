"""The command `validate`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

from typer import Argument

from orthocal.cli.calibrate import judgement_on_failure
from orthocal.cli.files import load_each_once
from orthocal.cli.options import AllRows, CalibrationPath, Json, app
from orthocal.cli.printing import deliver


@app.command()
def validate(
    calibration: CalibrationPath,
    sessions: Annotated[
        list[Path],
        Argument(
            metavar="NEW_SESSION...", help="Measured with the identified offsets in the controller."
        ),
    ],
    json: Json = False,
    all_rows: AllRows = False,
) -> None:
    """Compare new readings with the predictions of a calibration.

    Exit code 0: the calibration is confirmed. 3: it is not, or review or reject the new readings.
    """
    from orthocal.assessment.validation import validate_calibration
    from orthocal.calibration.file import load_calibration
    from orthocal.measurement.joining import join_sessions
    from orthocal.output.text.summary import print_summary, result_json

    before, loaded = load_calibration(calibration), load_each_once(sessions)
    with judgement_on_failure(join_sessions(loaded), json=json):
        validation = validate_calibration(before, loaded)
    deliver(
        partial(result_json, validation),
        partial(print_summary, validation, all_rows=all_rows),
        json=json,
        decision=validation.assessment.decision,
    )
