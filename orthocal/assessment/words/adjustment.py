"""Wording of a plan of mechanical adjustments."""

from __future__ import annotations

import math

import numpy as np

from orthocal.assessment.adjustment_plan import (
    WORTHWHILE,
    AdjustmentPlan,
    Judgement,
    PlannedAdjustment,
)
from orthocal.assessment.wording import joined, name_direction, tool_mm
from orthocal.assessment.words.entries import describe_compensated
from orthocal.text import percent
from orthocal.units import MM, format_fixed

HEADLINES: dict[Judgement, str] = {
    "worthwhile": "Adjust the machine in this order, then enter the offsets and measure again.",
    "small gain": "Do not adjust the machine: adjusting it reduces the expected tool error by "
    f"less than {percent(WORTHWHILE)}.",
    "uncertain gain": "Do not adjust the machine: adjusting it moves the tool by less than the "
    "uncertainty of this calibration. Measure more, then plan again.",
}


def describe_setting(planned: PlannedAdjustment) -> str:
    """Instruction for one adjustment: amount and direction, without a sign."""
    keys, amount = planned.adjustment.keys, planned.amount
    turns = planned.turns
    amount_text = f"{format_fixed(abs(amount) / MM, 3)} mm"
    if turns is not None:
        amount_text = f"{format_fixed(abs(turns), 2)} turns ({abs(turns) * 360.0:.0f}°)"
    if keys.lengthens is not None:
        return f"{'lengthen' if amount > 0.0 else 'shorten'} rod {keys.lengthens} by {amount_text}"
    direction = np.array(keys.direction) * math.copysign(1.0, amount)
    return (
        f"{'shim' if turns is None else 'turn'} {amount_text} towards {name_direction(direction)}"
    )


def describe_gain(plan: AdjustmentPlan) -> list[str]:
    """Expected tool error before and after adjustments, and its lower limit."""
    expected = f"Expected tool error with the offsets alone: {tool_mm(plan.before.entered)} RMS."
    if plan.adjustments:
        these = "these" if plan.judgement == "worthwhile" else "the best"
        expected = (
            f"Expected tool error with {these} adjustments and offsets: "
            f"{tool_mm(plan.after.entered)} RMS (offsets alone: {tool_mm(plan.before.entered)})."
        )
    limit = (
        f"{describe_compensated(plan.before.compensated)} No adjustment reaches less, because of "
        "the uncertainty of this calibration."
    )
    return [expected, limit]


def describe_limits(plan: AdjustmentPlan) -> list[str]:
    """Adjustments at their largest amount, and adjustments smaller than their uncertainty."""
    at_limit = [
        p.adjustment.name
        for p in plan.adjustments
        if abs(p.amount) > p.adjustment.largest - 0.5 * p.adjustment.step
    ]
    small = [p.adjustment.name for p in plan.adjustments if not abs(p.amount) > p.uncertainty]
    notes = []
    if at_limit:
        notes.append(f"At the largest amount (largest_mm): {joined(at_limit)}.")
    if small:
        notes.append(f"Less than the uncertainty: {joined(small)}.")
    return notes
