"""A validation as tables and sentences."""

from __future__ import annotations

from collections.abc import Sequence

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
from orthocal.study.mistakes import EnteringMistake, Mistake
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
        *(
            [section("What belongs into the controller", _enter_next(validation))]
            if validation.mistake is not None
            else []
        ),
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
    elif validation.mistake is not None:
        sentences.append(
            "The calibration is not confirmed, though the deviations are no larger than expected. "
            + _explain_change(validation)
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
            f"What remains does not repeat beyond chance (correlation "
            f"{repetition.correlation:.3f} over {repetition.matched} rows; chance "
            f"{repetition.chance:.0%}): {reason}."
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


_MISTAKES: dict[Mistake, str] = {
    "not entered": "were not entered: what was active before still is",
    "wrong sign": "were entered with the wrong sign",
    "entered twice": "were entered twice, or on top of what was active",
    "identified": "are those of the column 'identified', not of the column 'enter'",
    "interchanged": "were interchanged",
}


def _explain_change(validation: Validation) -> str:
    """What may have happened where more was found than expected, and what to do."""
    mistake = validation.mistake
    if mistake is not None and mistake.kind == "one differs":
        return _explain_one(validation, mistake)
    if mistake is not None:
        whose = "The offsets" if mistake.all_drives else f"The offsets of {_and(mistake.drives)}"
        return (
            f"{whose} seem not to be in the controller as identified: they "
            f"{_MISTAKES[mistake.kind]}. That leaves r.m.s. {mm(mistake.rms)} mm of these readings "
            "unexplained. Enter what stands below, whole and in place of what is active, and "
            "measure again."
        )
    if validation.refit_rms < REMOVED * validation.achieved_rms:
        largest = sorted(validation.changes, key=lambda c: -abs(c.change) / max(c.std, 1e-300))
        names = ", ".join(c.name for c in largest[:3])
        told = "" if any(c.significant for c in largest) else " No single parameter is told apart."
        return (
            f"A further fit would take it to {mm(validation.refit_rms)} mm, and no mistake in "
            "entering the offsets explains it: the geometry has changed, or the gauge stood "
            f"elsewhere than the session says.{told} Most would change, in their σ: {names}. "
            "Calibrate again from this session."
        )
    return (
        "Other offsets would not help, so those entered are not to blame: the readings scatter "
        "more than before, or something else has moved."
    )


def _explain_one(validation: Validation, mistake: EnteringMistake) -> str:
    """One drive's offset explains it: another was entered, or its zero has moved."""
    entry = next(e for e in validation.enter if e.drive == mistake.drives[0])
    return (
        f"The offset of {entry.drive} alone explains it: what is in the controller seems to be "
        f"{signed(mistake.by[0] * entry.edge_factor)} {entry.edge_unit} from what the session "
        f"says. That leaves r.m.s. {mm(mistake.rms)} mm of these readings unexplained. "
        "Look there first, for a slip of the pen. If the controller holds what the session says, "
        "the zero of this drive has moved: then enter what stands below."
    )


def _and(names: Sequence[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


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
