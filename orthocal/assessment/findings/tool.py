"""What the tool is good for: the number that users decide by."""

from __future__ import annotations

import math

from orthocal.assessment.controller_entries import find_entries
from orthocal.assessment.findings.finding import Finding
from orthocal.assessment.tool_error import (
    ToolAccuracy,
    assess_remaining,
    assess_tool,
    expect_after_offsets,
)
from orthocal.assessment.wording import um
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ClosureError, RobotError
from orthocal.units import UM


def find_at_tool(calibration: Calibration) -> list[Finding]:
    """What the tool is good for once the offsets are entered, over the cube that it reaches."""
    try:
        accuracy = assess_tool(calibration)
    except (ClosureError, RobotError) as e:
        return [Finding("out of reach", "informs", f"Nothing can be said of the tool: {e}.")]
    return promise(calibration, accuracy)


def promise(calibration: Calibration, accuracy: ToolAccuracy) -> list[Finding]:
    """What the tool is good for over a region; nothing where that cannot be told.

    Args:
        calibration: The calibration.
        accuracy: Its errors at the tool.
    """
    expected = expect_after_offsets(calibration, accuracy)
    remaining, excess = assess_remaining(calibration, accuracy)
    if expected is None or remaining is None or not find_entries(calibration):
        return []
    known = remaining.sizes.headline.rms
    left = accuracy.measure(accuracy.error_after_offsets).absolute.rms
    off = accuracy.measure(accuracy.deviation).headline.rms
    text = (
        f"With the offsets entered the tool is good for {um(expected)} µm (r.m.s., shift and "
        "rotation out)"
    )
    if not calibration.only_offsets:
        text += f"; in a controller that knows all errors, for {um(known)} µm"
    return [
        Finding(
            "at the tool",
            "informs",
            f"{text}.",
            numbers={
                "expected_um": expected / UM,
                "expected_as_it_is_um": math.hypot(off, known) / UM,
                "known_to_be_off_um": off / UM,
                "all_errors_known_um": known / UM,
                "expected_absolute_um": math.hypot(left, remaining.sizes.absolute.rms) / UM,
                "times_tolerances": excess,
            },
        )
    ]
