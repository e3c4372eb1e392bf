"""Validation of a calibration, as tables and sentences."""

from __future__ import annotations

from pathlib import Path

from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.text import Text

from orthocal.assessment.assess import assessment_of
from orthocal.assessment.validation import Validation
from orthocal.calibration.assessment_record import FindingKind
from orthocal.output.text.answer import (
    describe_conditions,
    entry_table,
    quote_path,
    render_backlash,
    render_next,
)
from orthocal.output.text.layout import (
    bullets,
    mm,
    residual_table,
    section,
    signed,
    table_of,
)
from orthocal.units import MM

DETAILS: tuple[FindingKind, ...] = (
    "must change",
    "not significant",
    "repetition unknown",
    "residuals differ",
)
"""Kinds of findings that are printed only with all readings."""


def render_validation(validation: Validation, *, all_rows: bool = False) -> RenderableType:
    """A validation as rich renderables."""
    refit, judged = validation.refit, validation.assessment
    verdict = judged.decision.words
    findings = [
        f.words
        for f in judged.findings
        if f.text not in judged.decision.reason and (all_rows or f.kind not in DETAILS)
    ]
    answer = validation.answer
    if judged.tool is not None and judged.of_kind("tool error"):
        findings += describe_conditions(answer)
    parts = [
        Text("Validation of a calibration", style="bold"),
        Text(refit.session.title),
        section("Interpretation", bullets([verdict, *findings])),
    ]
    if validation.mistake is not None and validation.enter:
        rows = [(e.drive, signed(e.enter * e.edge_factor), e.edge_unit) for e in validation.enter]
        parts.append(section("Values to enter", table_of(("drive", "enter", "unit"), rows)))
    paths = [part.path for part in answer.session.parts]
    if judged.of_kind("further change") and paths and None not in paths:
        sessions = [quote_path(Path(path).parent) for path in paths if path is not None]
        command = f"orthocal calibrate {' '.join(sessions)} --out {sessions[-1]}-calibration"
        parts.append(Padding(render_next("to use the better offsets:", [command]), (0, 0, 0, 2)))
    rms = (validation.expected_rms, refit.rms_before, refit.rms_after)
    largest = (validation.expected_largest, refit.largest_before, refit.largest_after)
    deviations = table_of(
        ("", "expected", "measured", "after a new fit"),
        [("RMS [mm]", *map(mm, rms)), ("largest [mm]", *map(mm, largest))],
    )
    parts.append(section("Measured less predicted", deviations))
    if assessment_of(answer).entries:
        source = "the new readings" if validation.joint is None else "all readings"
        backlash = [Text(), render_backlash(answer)] if assessment_of(answer).backlash else []
        parts.append(section(f"Offsets from {source}", Group(entry_table(answer), *backlash)))
    readings = residual_table(
        refit.residuals,
        {
            "measured − predicted [mm]": lambda r: signed(r.deviation / MM),
            "after a new fit [mm]": lambda r: signed(r.residual / MM),
        },
        all_rows=all_rows,
        key=lambda r: abs(r.deviation),
    )
    parts.append(section("Readings of the new session", readings))
    return Group(*parts)
