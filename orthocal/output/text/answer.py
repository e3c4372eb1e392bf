"""Short answer of a calibration: the decision, what to enter, the tool error, the next step."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.text import Text

from orthocal.assessment.assess import assessment_of
from orthocal.assessment.wording import joined
from orthocal.assessment.words.entries import describe_compensated
from orthocal.calibration.assessment_record import (
    Assessment,
    Decision,
    Finding,
    FindingKind,
    Verdict,
)
from orthocal.calibration.calibration import Calibration
from orthocal.output.text.entries import short_entry_table
from orthocal.output.text.heading import render_subject
from orthocal.output.text.layout import bullets, print_rich

MOST_LISTED = 4
"""Further findings that the short answer lists."""

LISTED: tuple[FindingKind, ...] = (
    "no change",
    "change unknown",
    "above tolerances",
    "no redundancy",
    "held by a bound",
    "not significant",
    "line assumed",
)
"""Kinds of notes that the short answer lists."""

STYLES: dict[Verdict, str] = {"enter": "bold green", "review": "bold yellow", "reject": "bold red"}

MORE = "--details prints all readings, residuals, parameters and tool errors."


def render_answer(
    calibration: Calibration, *, heading: bool = True, saved: Path | None = None
) -> RenderableType:
    """The short answer.

    Args:
        calibration: The calibration.
        heading: Whether to begin with the machine and its readings.
        saved: Directory in which the calibration was written, for the next step.
    """
    assessment = assessment_of(calibration)
    parts: list[RenderableType] = [render_subject(calibration), Text()] if heading else []
    parts += [_decision(assessment.decision), Text()]
    if assessment.entries and assessment.decision.verdict != "reject":
        parts += [
            _indented(short_entry_table(calibration)),
            *_entry_notes(calibration, assessment),
            Text(),
        ]
    parts += _tool(calibration, assessment)
    parts.append(bullets([f.words for f in _listed(calibration, assessment)]))
    parts.append(Text.assemble(("Next: ", "bold"), _next_step(assessment, saved)))
    return Group(*parts)


def render_decision(assessment: Assessment) -> RenderableType:
    """A decision about readings, all findings, and the next step."""
    decision = assessment.decision
    parts: list[RenderableType] = [_decision(decision)]
    further = [f.words for f in assessment.findings if f.text != decision.reason]
    if further:
        parts += [Text(), bullets(further)]
    if decision.action:
        parts.append(Text.assemble(("Next: ", "bold"), decision.action))
    return Group(*parts)


def print_decision(assessment: Assessment) -> None:
    """Print a decision about readings: in colour on a terminal."""
    print_rich(render_decision(assessment))


def _decision(decision: Decision) -> Text:
    headline = (decision.headline, STYLES[decision.verdict])
    return Text.assemble(headline, f" {decision.reason}".rstrip())


def _entry_notes(calibration: Calibration, assessment: Assessment) -> list[RenderableType]:
    """Notes on entering the values."""
    unstated = assessment.of_kind("controller not stated")
    if unstated:
        return [_indented(Text(unstated[0].words))]
    down = [d.name for d in calibration.robot.drives if d.direction < 0]
    if not down or assessment.of_kind("no change needed"):
        return []
    verb = "counts" if len(down) == 1 else "count"
    return [
        _indented(
            Text(
                f"{joined(down)} {verb} down in the controller: subtract the value there "
                "instead of adding it (`orthocal export --to linuxcnc --offsets` writes the lines)."
            )
        )
    ]


def _tool(calibration: Calibration, assessment: Assessment) -> list[RenderableType]:
    """The expected tool error."""
    if assessment.tool is None:
        unreached = assessment.of_kind("out of reach")
        return [Text(unreached[0].text if unreached else "The tool error is unknown.")]
    lines = [Text(f.text) for f in assessment.of_kind("tool error")]
    if not calibration.only_offsets:
        lines.append(Text(describe_compensated(assessment.tool.compensated)))
    return [*lines]


def _listed(calibration: Calibration, assessment: Assessment) -> Sequence[Finding]:
    """Further findings that matter before anything is entered, the gravest first."""
    listed = [
        f
        for f in assessment.findings
        if (f.severity != "note" or f.kind in LISTED) and f.text != assessment.decision.reason
    ]
    if assessment.of_kind("no change needed"):
        listed = [f for f in listed if f.kind != "not significant"]
    if calibration.only_offsets:  # legs and axes are left out, which matters more
        listed = [f for f in listed if f.kind != "line assumed"]
    return listed[:MOST_LISTED]


def _next_step(assessment: Assessment, saved: Path | None) -> str:
    """The next command or action."""
    decision = assessment.decision
    if decision.verdict != "enter" or assessment.keeps_offsets:
        return decision.action or "none."
    if saved is None:
        return "keep the result with --out DIRECTORY; then `orthocal again DIRECTORY`."
    return f"orthocal again {saved} --out SESSION; measure; orthocal validate {saved} SESSION"


def _indented(part: RenderableType) -> RenderableType:
    return Padding(part, (0, 0, 0, 2))
