"""Validation of a calibration, as tables and sentences."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.assessment.assess import assessment_of
from orthocal.assessment.validation import Validation
from orthocal.output.text.entries import short_entry_table
from orthocal.output.text.layout import (
    add_row,
    bullets,
    choose_rows,
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
        enter = table_of("drive", "enter", "unit")
        for entry in validation.enter:
            add_row(enter, entry.drive, signed(entry.enter * entry.edge_factor), entry.edge_unit)
        parts.append(section("Values to enter", enter))
    table = table_of("", "predicted", "measured", "after a refit")
    rms = (validation.expected_rms, refit.rms_before, refit.rms_after)
    largest = (validation.expected_largest, refit.largest_before, refit.largest_after)
    for name, values in (("RMS [mm]", rms), ("largest [mm]", largest)):
        add_row(table, name, *(mm(v) for v in values))
    parts.append(section("Deviations with the calibrated offsets active", table))
    if assessment_of(refit).entries:
        parts.append(section("Offsets of a refit", short_entry_table(refit)))
    rows, note = choose_rows(refit.residuals, all_rows, key=lambda r: abs(r.deviation))
    readings = residual_table(
        rows,
        {
            "deviation [mm]": lambda r: signed(r.deviation / MM),
            "after a refit [mm]": lambda r: signed(r.residual / MM),
        },
        cycles=any(r.cycle != 1 for r in refit.residuals),
    )
    listed = Group(readings, Text(note)) if note else readings
    parts.append(section("Readings of the new session", listed))
    return Group(*parts)
