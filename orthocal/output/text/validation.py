"""Validation of a calibration, as tables and sentences."""

from __future__ import annotations

from pathlib import Path

from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.assessment.assess import assessment_of, gains_from_correction
from orthocal.assessment.validation import Validation
from orthocal.assessment.wording import mm, plain, signed
from orthocal.assessment.words.anomalies import describe_evidence
from orthocal.assessment.words.entries import describe_tool_error
from orthocal.calibration.assessment_record import FindingKind
from orthocal.io.files import exists
from orthocal.output.text.answer import (
    CONVERTED,
    PRINT,
    calibrate_command,
    describe_columns,
    describe_conditions,
    entry_table,
    render_backlash,
    render_headline,
    render_next,
)
from orthocal.output.text.layout import bullets, noted, residual_table, section, table_of
from orthocal.units import MM

DETAILS: tuple[FindingKind, ...] = (
    "common approach",
    "as predicted",
    "larger than predicted",
    "must change",
    "not significant",
    "no change",
    "change unknown",
    "repetition unknown",
    "residuals differ",
)
"""Kinds of findings that are printed only with all readings, unless they decide."""

EXPECTED_NOTE = (
    "expected: average of all deviations within the uncertainty. The limit belongs to these "
    "deviations: those of well-predicted readings count more."
)
"""Meaning of the column `expected`, and why the limit can be smaller."""

MORE = "--details prints deviations and all readings."


def render_validation(
    validation: Validation, *, details: bool = False, all_rows: bool = False
) -> RenderableType:
    """A validation as rich renderables: the short answer, and on demand the details."""
    answer, judged = validation.final_calibration, validation.assessment
    complete = details or all_rows
    hidden = ("tool error",) if all_rows else ("tool error", *DETAILS)
    findings = [
        f.words
        for f in judged.findings
        if f.text not in judged.decision.reason and f.kind not in hidden
    ]
    tool, final = [f.text for f in judged.of_kind("tool error")], assessment_of(answer)
    if judged.tool is not None and tool:
        if final.entries:
            tool = [describe_tool_error(judged.tool, keep=final.keeps_offsets, joint=True)]
        tool += describe_conditions(answer)
    parts: list[RenderableType] = [
        Text("Validation of a calibration", style="bold"),
        Text(validation.refit.session.title),
        Text(),
        render_headline(judged.decision),
        *([Text()] if tool or findings else []),
        *map(Text, tool),
        bullets(findings),
    ]
    if validation.mistake is not None and validation.enter:
        rows = [(e.drive, signed(e.enter * e.edge_factor), e.edge_unit) for e in validation.enter]
        rows += [
            (f"{e.drive} backlash", plain(e.enter * e.edge_factor), e.edge_unit)
            for e in validation.enter_backlash
            if e.change
        ]
        table = table_of(("drive", "new", "unit"), rows)
        note = f"new: total offset. {CONVERTED}"
        parts.append(section("Values to enter", noted(table, note)))
    further = bool(judged.of_kind("further change"))
    backlash = judged.backlash
    if validation.confirmed and final.entries and (further or complete):
        shown = [Text(), render_backlash(answer)] if backlash else []
        values = Group(entry_table(answer), *map(Text, describe_columns(answer)), *shown)
        parts.append(section("Offsets from all readings", values))
    elif tool and any(e.change for e in backlash):
        parts.append(section("Backlash from all readings", render_backlash(answer)))
    if complete:
        parts += _details(validation, all_rows=all_rows)
    parts += _next_step(validation, further=further)
    if not complete:
        parts += [Text(MORE)]
    return Group(*parts)


def _next_step(validation: Validation, *, further: bool) -> list[RenderableType]:
    """The next action: that of the decision, or the command that calibrates from all readings."""
    action = validation.assessment.decision.action
    if action:
        return [Text(), render_next(action)]
    joint = validation.joint is not None and validation.assessment.decision.verdict == "enter"
    firmware = validation.refit.session.firmware is not None
    if firmware and not further:
        return [Text(), render_next(PRINT)] if joint else []
    paths = [part.path for part in validation.final_calibration.session.parts]
    if not paths or None in paths:
        return []
    if further:
        words = f"to use the better {'settings' if firmware else 'offsets'}:"
    elif joint and gains_from_correction(validation.final_calibration, validation.assessment.tool):
        words = "to correct the other identified errors, too, calibrate from all readings:"
    else:
        return []
    stated = validation.final_calibration.robot.parameters.stated
    sessions = [Path(path).parent for path in paths if path is not None]
    if not all(exists(path) for path in sessions):  # recorded as seen from another directory
        text = (
            f"{words.removesuffix(':')}, validate in the directory in which the calibration was "
            "made: its sessions are not found from here."
        )
        return [Text(), render_next(text)]
    command = calibrate_command(sessions, stated, calibration=validation.final_calibration)
    return [Text(), render_next(words, [command])]


def _details(validation: Validation, *, all_rows: bool) -> list[RenderableType]:
    """Deviations from the predictions: their size, and those of the readings."""
    refit = validation.refit
    evidence = [e for f in validation.assessment.findings if (e := describe_evidence(f))]
    rms = (validation.expected_rms, refit.rms_before, refit.rms_after)
    largest = (validation.expected_largest, refit.largest_before, refit.largest_after)
    deviations = table_of(
        ("", "expected", "measured", "after a new fit"),
        [("RMS [mm]", *map(mm, rms)), ("largest [mm]", *map(mm, largest))],
    )
    readings = residual_table(
        refit.residuals,
        {
            "measured − predicted [mm]": lambda r: signed(r.deviation / MM),
            "after a new fit [mm]": lambda r: signed(r.residual / MM),
        },
        all_rows=all_rows,
        key=lambda r: abs(r.deviation),
    )
    return [
        section("Measured less predicted", noted(deviations, EXPECTED_NOTE)),
        section("Readings of the new session", readings),
        *([section("Evidence", bullets(evidence))] if evidence else []),
    ]
