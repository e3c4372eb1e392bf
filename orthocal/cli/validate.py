"""The command `validate`."""

from __future__ import annotations

from pathlib import Path

import orthocal
from orthocal.cli.files import load_each_once, require_not_calibrated
from orthocal.cli.options import command, read_tolerances
from orthocal.cli.printing import deliver_judged, judgement_on_failure
from orthocal.io.files import exists
from orthocal.text import quote_path


@command()
def validate(
    calibration: Path,
    sessions: list[Path],
    tolerance: list[str] | None = None,
    json: bool = False,
    details: bool = False,
    all_: bool = False,
) -> None:
    """Compare new readings with the predictions of a calibration.

    Exit code 0: the calibration is confirmed. 3: it is not, or the readings have an anomaly; the
    reason is printed.

    Args:
        sessions (NEW_SESSION...): Measured with the entered offsets in the controller.
    """
    _require_order(calibration, sessions)
    before = orthocal.load_calibration(calibration)
    loaded = load_each_once(sessions, tolerance=tolerance)
    require_not_calibrated(loaded, before)
    tolerances = read_tolerances(tolerance, before.robot)
    with judgement_on_failure(orthocal.join_sessions(loaded), json=json, details=details):
        validation = orthocal.validate_calibration(before, loaded, tolerances=tolerances)
    deliver_judged(validation, json=json, details=details, all_rows=all_)


def _require_order(calibration: Path, sessions: list[Path]) -> None:
    """Refuse a session in place of the calibration if a calibration follows.

    Raises:
        SessionError: With the command in the right order.
    """
    results = [s for s in sessions if exists(s / "calibration.json")]
    if results and exists(calibration / "session.yaml"):
        others = [calibration, *(s for s in sessions if s not in results)]
        words = " ".join(quote_path(p) for p in (results[0], *others))
        raise orthocal.SessionError(
            "is a session; expected first the calibration, then its new sessions: "
            f"orthocal validate {words}",
            where=str(calibration),
        )
