"""Wording of findings about a validation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from orthocal.assessment.wording import joined, mm, signed
from orthocal.assessment.words.fit import named
from orthocal.calibration.assessment_record import ControllerEntry, Finding, FindingKind, Place
from orthocal.units import MM

CONFIRMED = "The calibration is confirmed."
NOT_CONFIRMED = "The calibration is not confirmed."
UNKNOWN = "Whether the calibration is confirmed is unknown."

AGAIN = "Calibrate again from this session."
ENTER_COMPLETE = (
    "Enter the values below, complete and in place of the active ones, and measure again."
)

_SLIPS: dict[str, tuple[FindingKind, str]] = {
    "not entered": ("not entered", "were not entered: the previous values are still active"),
    "wrong sign": ("wrong sign", "were entered with the wrong sign"),
    "entered twice": ("entered twice", "were entered twice, or added to the active ones"),
    "identified": (
        "wrong column",
        "are those of the column 'identified' instead of the column 'enter'",
    ),
    "interchanged": ("interchanged", "were interchanged"),
}


def nothing_predicted(numbers: Mapping[str, float]) -> Finding:
    """The calibration had no redundancy, so it predicts nothing."""
    return Finding(
        "nothing predicted",
        "review",
        "The calibration had no redundant readings, so it predicts no deviations to compare with.",
        "Calibrate from more readings, then measure again.",
        numbers,
    )


def larger_than_predicted(
    achieved: float, expected: float, numbers: Mapping[str, float], places: Sequence[Place]
) -> Finding:
    """Deviations are larger than the calibration predicts."""
    return Finding(
        "larger than predicted",
        "review",
        f"The deviations of the new readings are {mm(achieved)} mm RMS. The calibration predicts "
        f"{mm(expected)} mm.",
        numbers=numbers,
        places=tuple(places),
    )


def confirmed(achieved: float, expected: float, numbers: Mapping[str, float]) -> Finding:
    """Deviations are as the calibration predicts."""
    return Finding(
        "confirmed",
        "note",
        f"The deviations of the new readings are {mm(achieved)} mm RMS, as predicted "
        f"({mm(expected)} mm). No parameter changes by more than its uncertainty.",
        numbers=numbers,
    )


def further_change(
    names: Sequence[str], numbers: Mapping[str, float], *, explained: bool
) -> Finding:
    """Deviations are as predicted, but a fit of the new readings changes parameters."""
    return Finding(
        "further change",
        "review",
        "The deviations are as large as predicted, but the new readings change "
        f"{joined(names)} by more than the uncertainty.",
        "" if explained else AGAIN,
        numbers,
        named(*names),
    )


def slip(
    kind: str, drives: Sequence[str], rms: float, numbers: Mapping[str, float], *, all_drives: bool
) -> Finding:
    """A known mistake in entering offsets."""
    found, words = _SLIPS[kind]
    whose = "The offsets" if all_drives else f"The offsets of {joined(drives)}"
    return Finding(
        found,
        "review",
        f"{whose} in the controller seem to differ from the session's statement: they {words}. "
        f"This explains the readings to {mm(rms)} mm RMS.",
        ENTER_COMPLETE,
        numbers,
        named(*drives),
    )


def one_differs(
    entry: ControllerEntry, by: float, rms: float, numbers: Mapping[str, float]
) -> Finding:
    """The offset of one drive explains the readings."""
    return Finding(
        "one drive differs",
        "review",
        f"The offset of {entry.drive} alone explains the readings, to {mm(rms)} mm RMS: the "
        f"controller seems to hold {signed(by * entry.edge_factor)} {entry.edge_unit} more than "
        "the session states.",
        "Look for a typing mistake there first. If there is none, the zero of this drive has "
        "moved: enter the values below.",
        numbers,
        named(entry.drive),
    )


def geometry_changed(refit: float, names: Sequence[str], *, significant: bool) -> Finding:
    """A fit of the new readings removes the deviations, and no mistake in entering explains it."""
    single = "" if significant else " No single parameter stands out."
    return Finding(
        "geometry changed",
        "review",
        f"A fit of the new readings leaves {mm(refit)} mm RMS, and no mistake in entering the "
        "offsets explains the deviations: the geometry has changed, or the gauge was mounted "
        f"elsewhere than the session states.{single} Largest changes: {', '.join(names)}.",
        AGAIN,
        {"refit_rms_mm": refit / MM},
        named(*names),
    )


def not_the_offsets() -> Finding:
    """Other offsets would not help."""
    return Finding(
        "not the offsets",
        "review",
        "Other offsets would not reduce the deviations: the readings scatter more than before, or "
        "something else has moved.",
        "Read again, and check the stand of the gauge.",
    )


def repetition_unknown(why: str) -> Finding:
    """Whether residuals repeat is unknown."""
    return Finding("repetition unknown", "note", f"Whether the residuals repeat is unknown: {why}.")


def residuals_repeat(correlation: float, rows: int, chance: float, title: str = "") -> Finding:
    """Residuals of both sessions correlate: unmodelled errors."""
    where = f" in '{title}'" if title else ""
    return Finding(
        "residuals repeat",
        "note",
        f"The residuals repeat{where} (correlation {correlation:.3f} over {rows} rows, by chance "
        f"{chance:.2g}): they are unmodelled errors, which more readings of the same kind do not "
        "reduce.",
        numbers={"correlation": correlation, "rows": float(rows), "chance": chance},
    )


def residuals_differ(
    correlation: float, rows: int, chance: float, *, new: bool = False, title: str = ""
) -> Finding:
    """Residuals of both sessions do not correlate."""
    where = f" in '{title}'" if title else ""
    meaning = "they are new in this session" if new else "they look like noise"
    return Finding(
        "residuals differ",
        "note",
        f"The residuals do not repeat{where} (correlation {correlation:.3f} over {rows} rows, by "
        f"chance {chance:.2g}): {meaning}.",
        numbers={"correlation": correlation, "rows": float(rows), "chance": chance},
    )


def controller_assumed() -> Finding:
    """The session does not state the active offsets; the identified ones are assumed."""
    return Finding(
        "controller not stated",
        "note",
        "The session does not state which offsets were active; the values to enter are assumed.",
    )
