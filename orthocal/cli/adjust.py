"""The command `adjust`."""

from __future__ import annotations

from pathlib import Path

import orthocal
from orthocal.cli.options import command, split_globs
from orthocal.cli.printing import deliver
from orthocal.errors import ParameterError


@command()
def adjust(
    calibration: Path,
    among: str | None = None,
    json: bool = False,
    details: bool = False,
    anyway: bool = False,
) -> None:
    """Plan mechanical adjustments of feet, shims and threads.

    Prints which adjustments to set, by how much and in which order. The robot's YAML declares them
    under orthocal.adjustments.

    Exit code 3: the verdict is not `enter`; the reason is printed.

    Args:
        among (NAMES): Adjustments that may be used, separated by commas; default: all.
    """
    from orthocal.effects.adjustment import require_adjustment
    from orthocal.export.formats import require_entering
    from orthocal.output.text import adjustment as text

    result = orthocal.load_calibration(calibration)
    names = None if among is None else split_globs([among]) or [among]
    for name in names or ():
        require_adjustment(result.robot, name, where="--among", error=ParameterError)
    if not anyway:
        require_entering(result)
    plan = orthocal.plan_adjustments(result, among=names)
    deliver(
        lambda: text.plan_json(result, plan),
        lambda: text.render_titled_plan(result, plan, saved=calibration, details=details),
        json=json,
    )
