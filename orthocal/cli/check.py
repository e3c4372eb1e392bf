"""The command `check`."""

from __future__ import annotations

from pathlib import Path

import orthocal
from orthocal.cli.files import load_each_once
from orthocal.cli.options import command
from orthocal.cli.printing import deliver_judged


@command()
def check(
    sessions: list[Path],
    effects: str | None = None,
    tolerance: list[str] | None = None,
    json: bool = False,
    details: bool = False,
) -> None:
    """Check readings for mistakes: signs, units, lines, the gauge.

    The verdict is that of `calibrate` on the same readings. Readings that are missing are counted.

    Exit code 0: no anomaly. 3: check the readings before you continue.
    """
    loaded = load_each_once(sessions, effects=effects, tolerance=tolerance, partial=True)
    assessment = orthocal.check_session(orthocal.join_sessions(loaded))
    deliver_judged(assessment, json=json, details=details)
