"""Validation of a calibration, as tables and sentences."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.assessment.assess import assessment_of
from orthocal.assessment.validation import Validation
from orthocal.output.text.answer import entry_table
from orthocal.output.text.layout import (
    bullets,
    mm,
    residual_table,
    section,
    signed,
    table_of,
)
from orthocal.units import MM


def render_validation(validation: Validation, *, all_rows: bool = False) -> RenderableType:
    """A validation as rich renderables."""
    refit, judged = validation.refit, validation.assessment
    verdict = judged.decision.words
    findings = [f.words for f in judged.findings if f.text not in judged.decision.reason]
    parts = [
        Text("Validation of a calibration", style="bold"),
        Text(refit.session.title),
        section("Interpretation", bullets([verdict, *findings])),
    ]
    if validation.mistake is not None and validation.enter:
        rows = [(e.drive, signed(e.enter * e.edge_factor), e.edge_unit) for e in validation.enter]
        parts.append(section("Values to enter", table_of(("drive", "enter", "unit"), rows)))
    rms = (validation.expected_rms, refit.rms_before, refit.rms_after)
    largest = (validation.expected_largest, refit.largest_before, refit.largest_after)
    deviations = table_of(
        ("", "predicted", "measured", "after a refit"),
        [("RMS [mm]", *map(mm, rms)), ("largest [mm]", *map(mm, largest))],
    )
    parts.append(section("Deviations with the calibrated offsets active", deviations))
    if assessment_of(refit).entries:
        parts.append(section("Offsets of a refit", entry_table(refit)))
    readings = residual_table(
        refit.residuals,
        {
            "deviation [mm]": lambda r: signed(r.deviation / MM),
            "after a refit [mm]": lambda r: signed(r.residual / MM),
        },
        all_rows=all_rows,
        key=lambda r: abs(r.deviation),
    )
    parts.append(section("Readings of the new session", readings))
    return Group(*parts)
