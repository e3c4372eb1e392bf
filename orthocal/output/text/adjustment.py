"""Plan of mechanical adjustments as text and JSON."""

from __future__ import annotations

from pathlib import Path

from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.assessment.adjustment_plan import AdjustmentPlan, plan_adjustments
from orthocal.assessment.assess import assessment_of
from orthocal.assessment.wording import plain, signed
from orthocal.assessment.words.adjustment import (
    HEADLINES,
    describe_gain,
    describe_limits,
    describe_setting,
)
from orthocal.assessment.words.entries import describe_region
from orthocal.calibration.assessment_record import ControllerEntry, ToolErrorSummary
from orthocal.calibration.calibration import Calibration
from orthocal.errors import OrthocalError
from orthocal.io.documents import format_json, write_plain
from orthocal.io.fields import finite_or_none
from orthocal.output.text.answer import render_next
from orthocal.output.text.layout import bullets, indented, table_of
from orthocal.text import quote_path
from orthocal.units import MM

SCHEMA = "orthocal/adjustment/1"

TOGETHER = "No tool error: this adjustment lowers it only together with the next one."

MORE = "--details lists these adjustments."


def render_adjustments(calibration: Calibration, *, saved: Path | None = None) -> RenderableType:
    """The plan of adjustments of a calibration, or why there is none.

    Args:
        calibration: The calibration.
        saved: Its directory, for the next command.
    """
    decision = assessment_of(calibration).decision
    if decision.verdict != "enter":
        return Text(f"Not planned: {decision.headline}")
    try:
        return render_plan(plan_adjustments(calibration), saved=saved)
    except OrthocalError as e:
        return Text(f"The adjustments cannot be planned: {e}.")


def render_titled_plan(
    calibration: Calibration, plan: AdjustmentPlan, *, saved: Path, details: bool
) -> RenderableType:
    """A plan of adjustments with a title; arguments as for `render_plan`."""
    head = f"Mechanical adjustment of {calibration.robot_record.name}, model '{calibration.model}'"
    return Group(Text(head), Text(), render_plan(plan, saved=saved, details=details))


def render_plan(
    plan: AdjustmentPlan, *, saved: Path | None, details: bool = False
) -> RenderableType:
    """A plan of adjustments.

    Args:
        plan: The plan of a calibration.
        saved: Directory of the calibration, for the next command.
        details: Whether to list adjustments that are not worth doing.
    """
    parts: list[RenderableType] = [Text(HEADLINES[plan.judgement]), Text()]
    worthwhile = plan.judgement == "worthwhile"
    listed = bool(plan.adjustments) and (worthwhile or details)
    notes = describe_limits(plan) if listed else []
    if listed:
        rows = [
            (
                str(i),
                p.adjustment.name,
                describe_setting(p),
                signed(p.amount / MM),
                plain(p.uncertainty / MM),
                "" if p.tool_error is None else plain(p.tool_error / MM),
            )
            for i, p in enumerate(plan.adjustments, start=1)
        ]
        headers = ("", "adjustment", "set", "amount", "±", "tool error")
        parts += [indented(table_of(headers, rows, left=3)), Text()]
        notes = [
            "Amount, ± and tool error are in mm. The tool error is that after this adjustment and "
            "those before it, with the offsets entered again.",
            *([TOGETHER] if any(p.tool_error is None for p in plan.adjustments) else []),
            "±: in 19 of 20 cases the best amount lies within it.",
            *notes,
        ]
    parts += [Text(line) for line in describe_gain(plan)]
    parts.append(Text(describe_region(plan.before)))
    if plan.adjustments and worthwhile:
        offsets = ", ".join(
            f"{e.drive} {signed(e.enter * e.edge_factor)} {e.edge_unit}" for e in plan.entries
        )
        parts.append(Text(f"Offsets to enter afterwards: {offsets}."))
    parts.append(bullets(notes))
    if plan.adjustments and not listed:
        parts.append(Text(MORE))
    if plan.adjustments and saved is not None and worthwhile:
        new = quote_path(f"{saved}-adjusted")
        parts.append(
            render_next(
                "adjust the machine, then measure again:",
                (
                    f"orthocal again {quote_path(saved)} --adjusted plan --out {new}",
                    f"orthocal record {new}",
                    f"orthocal validate {quote_path(saved)} {new}",
                ),
            )
        )
    return Group(*parts)


def plan_json(calibration: Calibration, plan: AdjustmentPlan) -> str:
    """A plan of adjustments as JSON, SI units."""
    document = {
        "schema": SCHEMA,
        "robot": calibration.robot_record.name,
        "model": calibration.model,
        "judgement": plan.judgement,
        "worthwhile": plan.judgement == "worthwhile",
        "gain": plan.gain,
        "adjustments": [
            {
                "name": p.adjustment.name,
                "amount": p.amount,
                "expanded_uncertainty": finite_or_none(p.uncertainty),
                "turns": p.turns,
                "step": p.adjustment.step,
                "largest": p.adjustment.largest,
                "tool_error": p.tool_error,
                "set": describe_setting(p),
            }
            for p in plan.adjustments
        ],
        "enter": [write_plain(e, ControllerEntry) for e in plan.entries],
        "before": write_plain(plan.before, ToolErrorSummary),
        "after": write_plain(plan.after, ToolErrorSummary),
    }
    return format_json(document)
