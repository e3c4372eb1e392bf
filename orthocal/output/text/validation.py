"""A validation as tables and sentences."""

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
    section,
    signed,
    table_of,
)
from orthocal.units import MM


def render_validation(validation: Validation, *, all_rows: bool = False) -> RenderableType:
    """A validation as rich renderables."""
    refit = validation.refit
    table = table_of("", "expected", "achieved", "further fit")
    rms = (validation.expected_rms, refit.rms_before, refit.rms_after)
    largest = (validation.expected_largest, refit.largest_before, refit.largest_after)
    for name, values in (("RMS [mm]", rms), ("largest [mm]", largest)):
        add_row(table, name, *(mm(v) for v in values))
    parts = [
        Text("Validation of a calibration", style="bold"),
        Text(refit.session.title),
        section("What it means", bullets(explain_validation(validation))),
    ]
    if validation.mistake is not None and validation.enter:
        parts.append(section("What belongs into the controller", _enter_next(validation)))
    parts.append(section("Deviations with the calibrated offsets in the controller", table))
    if assessment_of(refit).entries:
        parts.append(section("Offsets by a further fit", short_entry_table(refit)))
    parts.append(section("Readings of the new session", _validation_rows(validation, all_rows)))
    return Group(*parts)


def explain_validation(validation: Validation) -> list[str]:
    """The verdict of a validation and its reasons."""
    judged = validation.assessment
    decision = judged.decision
    verdict = f"{decision.headline} {decision.reason} {decision.action}".strip()
    return [verdict, *(f.words for f in judged.findings if f.text not in decision.reason)]


def _validation_rows(validation: Validation, all_rows: bool) -> RenderableType:
    residuals = validation.refit.residuals
    rows, note = choose_rows(residuals, all_rows, key=lambda r: abs(r.deviation))
    cycles = any(r.cycle != 1 for r in residuals)
    table = table_of(
        "setup",
        "posture",
        *(["cycle"] if cycles else []),
        "deviation [mm]",
        "after a further fit [mm]",
        left=2,
    )
    for r in rows:
        add_row(
            table,
            r.setup,
            r.postures,
            *([str(r.cycle)] if cycles else []),
            signed(r.deviation / MM),
            signed(r.residual / MM),
        )
    return Group(table, Text(note)) if note else table


def _enter_next(validation: Validation) -> RenderableType:
    """What belongs into the controller where something else is in it."""
    table = table_of("drive", "enter", "unit")
    for entry in validation.enter:
        add_row(table, entry.drive, signed(entry.enter * entry.edge_factor), entry.edge_unit)
    return table
