"""Wording of findings about a validation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from orthocal.assessment.predictive import FEWEST, Repetition
from orthocal.assessment.wording import joined, mm, named, note, review, signed
from orthocal.calibration.assessment_record import ControllerEntry, Finding, Place

CONFIRMED = "The calibration is confirmed."
NOT_CONFIRMED = "The calibration is not confirmed."
UNKNOWN = "Whether the calibration is confirmed is unknown."

LEAST_SHARE = 1e-4
"""Probability of a repetition by chance below which no smaller one is printed."""

AGAIN = "To use this, calibrate from this session."

TOGETHER = "To use this, calibrate the sessions together."


def nothing_predicted(numbers: Mapping[str, float]) -> Finding:
    """The calibration had no redundancy, so it predicts nothing."""
    return review(
        "nothing predicted",
        "The calibration had no redundant readings, so it predicts no deviations to compare with.",
        "Calibrate from more readings, then measure again.",
        **numbers,
    )


def larger_than_predicted(
    achieved: float,
    limit: float,
    refit: float | None,
    *,
    removed: bool,
    numbers: Mapping[str, float],
    place: Place,
) -> Finding:
    """Deviations are larger than the calibration predicts.

    Args:
        achieved: RMS of the deviations, [m].
        limit: RMS of deviations of the same pattern from which the calibration does not explain
            them, [m]. The expected RMS is a mean over all patterns and may be larger.
        refit: RMS residual of a fit of the new readings, [m]; None if an anomaly explains them.
        removed: Whether that fit removes the deviations.
        numbers: Numbers of the finding.
        place: Reading with the largest deviation.
    """
    text = (
        f"The new readings deviate from the predictions by {mm(achieved)} mm RMS, more than their "
        f"uncertainty (limit for deviations of this pattern: {mm(limit)} mm)."
    )
    action = ""
    if refit is not None:
        reason, action = (
            ("the machine has changed, or a gauge was mounted elsewhere than stated", AGAIN)
            if removed
            else (
                "the readings scatter more than before, or something moved during the session",
                "Check the mounting of the gauge, then read again.",
            )
        )
        text += f" A fit of the new readings leaves {mm(refit)} mm RMS: {reason}."
    return review("larger than predicted", text, action, (place,), **numbers)


def as_predicted(achieved: float, limit: float, numbers: Mapping[str, float]) -> Finding:
    """Deviations are as the calibration predicts; arguments as for `larger_than_predicted`."""
    return note(
        "as predicted",
        f"The new readings agree with the predictions: they deviate by {mm(achieved)} mm RMS, "
        f"within their uncertainty (limit for deviations of this pattern: {mm(limit)} mm).",
        **numbers,
    )


def further_change(entries: Sequence[ControllerEntry]) -> Finding:
    """All readings together improve what to enter.

    Args:
        entries: Offsets that change by more than their uncertainty; none if only all of them
            together change the tool error.
    """
    changes = [
        f"{e.drive} from {signed(e.active * e.edge_factor)} to {signed(e.enter * e.edge_factor)} "
        f"{e.edge_unit}"
        for e in entries
        if e.active is not None
    ]
    noun = "an offset" if len(changes) == 1 else "offsets"
    return note(
        "further change",
        f"The new readings still improve {noun}: {joined(changes)}."
        if changes
        else "The new readings still improve the offsets together.",
        TOGETHER,
        named(*(e.drive for e in entries)),
    )


def describe_repetition(repetition: Repetition, *, new: bool = False, title: str = "") -> Finding:
    """Correlation of the residuals of two sessions.

    Args:
        repetition: The correlation.
        new: Whether deviations are larger than predicted, so that other residuals are new.
        title: Title of the other session, where it is named.
    """
    r, where = repetition, f" in '{title}'" if title else ""
    numbers = {"rows": float(r.matched), "correlation": r.correlation, "chance": r.chance}
    share = (
        f"{100.0 * r.chance:.2g} %"
        if r.chance >= LEAST_SHARE
        else f"less than {100.0 * LEAST_SHARE:g} %"
    )
    size = f"(correlation {r.correlation:.3f} over {r.matched} lines; chance gives as much in "
    size += f"{share} of cases)"
    if r.repeats is None:
        why = f"the fit absorbs nearly all of the {r.matched} shared lines"
        why = "too few lines are shared" if r.matched < FEWEST else why
        text = f"Whether the residuals repeat{where} is unknown: {why}."
        return note("repetition unknown", text, **numbers)
    if r.repeats:
        text = (
            f"The residuals repeat{where} {size}: they are unmodelled errors, which more readings "
            "of the same kind do not reduce."
        )
        return note("residuals repeat", text, **numbers)
    meaning = "they are new in this session" if new else "they look like noise"
    text = f"The residuals do not repeat{where} {size}: {meaning}."
    return note("residuals differ", text, **numbers)


def controller_assumed() -> Finding:
    """Finding that the active offsets are not stated, and those to enter are assumed."""
    return note(
        "controller not stated",
        "The session does not state the active offsets; the offsets to enter are assumed.",
    )
