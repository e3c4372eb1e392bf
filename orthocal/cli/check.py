"""The command `check`."""

from __future__ import annotations

from pathlib import Path

import orthocal
from orthocal.cli.files import load_joined
from orthocal.cli.options import command, split_effects
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
    session = load_joined(
        sessions, effects=split_effects(effects), tolerance=tolerance, partial=True
    )
    deliver_judged(orthocal.check_session(session), json=json, details=details)
