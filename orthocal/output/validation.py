"""A validation as tables and sentences."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.text import Text

from orthocal.output.layout import (
    add_row,
    bullets,
    choose_rows,
    mm,
    plain,
    section,
    signed,
    table_of,
)
from orthocal.study.validation import FurtherChange, Validation

REMOVED = 0.7
"""Part of the deviations below which a further fit is said to remove them."""

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
        section("Deviations with the identified offsets in the controller", table),
        section("What a further fit would still change", changes),
        section("Readings of the new session", _validation_rows(validation, all_rows)),
        section("What it means", bullets(explain_validation(validation))),
    )


def explain_validation(validation: Validation) -> list[str]:
    """The verdict of a validation and its reasons."""
    sentences = []
    achieved, expected = mm(validation.achieved_rms), mm(validation.expected_rms)
    if validation.as_expected is None:
        sentences.append(
            "Whether this is as expected cannot be told: the calibration had no readings to spare "
            "that would say what to expect."
        )
    elif validation.as_expected and validation.nothing_to_change:
        sentences.append(
            f"The calibration is confirmed: r.m.s. {achieved} mm was achieved where {expected} mm "
            "was expected, and a further fit would change no parameter beyond chance."
        )
    elif not validation.as_expected:
        sentences.append(
            f"The calibration is not confirmed: r.m.s. {achieved} mm was achieved where {expected} "
            "mm was expected, more than chance explains. " + _explain_change(validation)
        )
    else:
        names = ", ".join(c.name for c in validation.changes if c.significant)
        sentences.append(
            f"The deviations are as expected, but a further fit would change {names} beyond the "
            "standard error: calibrate again from this session."
        )
    repetition = validation.repetition
    if repetition.repeats is None:
        sentences.append("Whether what remains repeats cannot be told: too few rows are shared.")
    elif repetition.repeats:
        sentences.append(
            f"What remains repeats (correlation {repetition.correlation:.3f} over "
            f"{repetition.matched} rows; chance {repetition.chance:.1%}): it is error of the "
            "model, which more readings of the same kind will not remove."
        )
    else:
        reason = (
            "it is nothing that the calibration has left, but new"
            if validation.as_expected is False
            else "it looks like noise"
        )
        sentences.append(
            f"What remains does not repeat (correlation {repetition.correlation:.3f} over "
            f"{repetition.matched} rows): {reason}."
        )
    if not validation.offsets_stated:
        sentences.append(
            "The session does not state which offsets were active; the identified ones are taken."
        )
    return sentences


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
            signed(r.deviation * 1e3),
            signed(r.residual * 1e3),
        )
    return Group(table, Text(note)) if note else table


def _explain_change(validation: Validation) -> str:
    """What may have happened where more was found than expected."""
    if not validation.nothing_to_change:
        return "Check the signs of the offsets in the controller first."
    if validation.refit_rms < REMOVED * validation.achieved_rms:
        largest = sorted(validation.changes, key=lambda c: -abs(c.change) / max(c.std, 1e-300))
        names = ", ".join(c.name for c in largest[:3])
        return (
            f"A further fit would take it to {mm(validation.refit_rms)} mm: the geometry has "
            f"changed, or the offsets were not entered as identified. No single parameter is told "
            f"apart; most would change, in their σ: {names}."
        )
    return (
        "No parameter would change, so the offsets are not to blame: the readings scatter more "
        "than before, or something has moved."
    )


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
