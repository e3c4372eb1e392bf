"""A validation as tables and sentences."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.assessment.validation import FurtherChange, Validation
from orthocal.output.text.layout import (
    add_row,
    bullets,
    choose_rows,
    mm,
    plain,
    section,
    signed,
    table_of,
)
from orthocal.units import MM

MANY_CHANGES = 12
"""Parameters above which only those that change most are listed."""


def render_validation(validation: Validation, *, all_rows: bool = False) -> RenderableType:
    """A validation as rich renderables."""
    table = table_of("", "expected", "achieved", "further fit")
    rows = (
        ("r.m.s. [mm]", validation.expected_rms, validation.achieved_rms, validation.refit_rms),
        (
            "largest [mm]",
            validation.expected_largest,
            validation.achieved_largest,
            validation.refit_largest,
        ),
    )
    for name, *values in rows:
        add_row(table, name, *(mm(v) for v in values))
    changes = table_of("parameter", "change", "± σ", "unit", "beyond chance (95 % for all)?")
    for c in _listed(validation, all_rows):
        add_row(
            changes,
            c.name,
            signed(c.change * c.edge_factor),
            plain(c.std * c.edge_factor),
            c.edge_unit,
            "yes" if c.significant else "no",
        )
    return Group(
        Text("Validation of a calibration", style="bold"),
        Text(validation.title),
        section("What it means", bullets(explain_validation(validation))),
        *(
            [section("What belongs into the controller", _enter_next(validation))]
            if validation.mistake is not None
            else []
        ),
        section("Deviations with the identified offsets in the controller", table),
        section("What a further fit would still change", changes),
        section("Readings of the new session", _validation_rows(validation, all_rows)),
    )


def explain_validation(validation: Validation) -> list[str]:
    """The verdict of a validation and its reasons."""
    found = validation.assessment
    decision = found.decision
    verdict = f"{decision.headline} {decision.reason} {decision.action}".strip()
    others = [f for f in found.findings if f.severity == "note" and f.text not in decision.reason]
    return [verdict, *(f.words for f in others)]


def _validation_rows(validation: Validation, all_rows: bool) -> RenderableType:
    rows, note = choose_rows(validation.rows, all_rows, key=lambda r: abs(r.deviation))
    cycles = any(r.cycle != 1 for r in validation.rows)
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


def _listed(validation: Validation, all_rows: bool) -> list[FurtherChange]:
    """Changes that are listed: all of few, else offsets, what is beyond chance, and the largest."""
    if all_rows or len(validation.changes) <= MANY_CHANGES:
        return list(validation.changes)
    by_size = sorted(validation.changes, key=lambda c: -abs(c.change) / max(c.std, 1e-300))
    named = {c.name for c in by_size[:5]}
    return [
        c
        for c in validation.changes
        if c.significant or c.name in named or c.name.endswith(".offset")
    ]
