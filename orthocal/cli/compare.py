"""The command `compare`."""

from __future__ import annotations

from pathlib import Path

import orthocal
from orthocal.cli.files import load_each_once
from orthocal.cli.options import command, split_globs
from orthocal.cli.printing import deliver_judged, judgement_on_failure, put_note


@command()
def compare(
    sessions: list[Path],
    models: str | None = None,
    repeat: list[Path] | None = None,
    effects: str | None = None,
    tolerance: list[str] | None = None,
    json: bool = False,
    details: bool = False,
    all_: bool = False,
) -> None:
    """Compare models, and recommend the one that readings support.

    Exit code 3: the verdict, that of `calibrate`, is not `enter`; the reason is printed.

    Args:
        models (MODELS): Models, separated by commas; default: all of the robot.
        repeat (SESSION): Another session, to see which residuals repeat. May be stated several
            times.
    """
    loaded = load_each_once(sessions, effects=effects, tolerance=tolerance)
    others = load_each_once(repeat, effects=effects, tolerance=tolerance) if repeat else None
    session = orthocal.join_sessions(loaded)
    with judgement_on_failure(session, json=json, details=details):
        comparison = orthocal.compare_models(
            loaded,
            models=split_globs([models] if models else None),
            repeat=others,
            report=lambda text: put_note(f"orthocal: {text}"),
        )
    deliver_judged(comparison, json=json, details=details, all_rows=all_)
