"""Wording of findings about a validation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from orthocal.assessment.predictive import MIN_ROWS, Repetition
from orthocal.assessment.wording import (
    joined,
    mm,
    note,
    parameter_places,
    plain,
    review,
    signed,
    tool_mm,
)
from orthocal.calibration.assessment_record import ControllerEntry, Finding, Place
from orthocal.units import MM, UM

CONFIRMED = "The calibration is confirmed."
NOT_CONFIRMED = "The calibration is not confirmed."
INCONCLUSIVE = "The validation is inconclusive."

RECALIBRATE = "the machine has changed: calibrate this session alone."

RECALIBRATE_PRINTER = "the printer has changed: calibrate this log alone and export its settings."

FAR_LIMIT = 5.0
"""Factor by which a limit far above any machine's deviations exceeds the expected RMS."""

CALIBRATE_JOINTLY = "Calibrate the sessions together and enter these offsets."


def nothing_predicted(numbers: Mapping[str, float]) -> Finding:
    """Finding that the calibration predicts nothing, as it had no redundant readings."""
    return review(
        "nothing predicted",
        "The calibration had no redundant readings, so it predicts no deviations to compare with.",
        "Add readings to the calibration, calibrate again, then validate.",
        **numbers,
    )


def larger_than_predicted(
    achieved: float,
    limit: float,
    refit: float | None,
    *,
    explains: bool,
    firmware: bool,
    numbers: Mapping[str, float],
    place: Place,
    command: str,
) -> Finding:
    """Finding about deviations that are larger than predicted.

    Args:
        achieved: RMS of the deviations, [m].
        limit: RMS at which these deviations, scaled by a common factor, become significant, [m]. It
            depends on their distribution over the readings and may be below the predicted RMS.
        refit: RMS residual of a fit of the new readings, [m]; None if an anomaly explains them.
        explains: Whether that fit explains the deviations.
        firmware: Whether a printer with its settings is validated.
        numbers: Numbers of the finding.
        place: First reading of the setup without which the others agree best.
        command: Command that reads its setup again; empty if it is not in a file.
    """
    text = f"The new readings deviate from the predictions by {_with_limit(achieved, limit)}."
    action = ""
    if refit is not None:
        if explains:
            where = "a gauge was mounted elsewhere or other offsets were entered"
            where = "other settings were active" if firmware else where
            cause = f"a reading is wrong, {where} than stated, or the machine has changed"
            repeat = f"Read setup {place.setup} again, which agrees least with the others"
            repeat = "Probe again" if firmware else f"{repeat}: {command}" if command else repeat
            repeat = repeat if firmware else f"Check the entered offsets. {repeat}"
            action = f"{repeat}. Then validate again. If the deviations remain, "
            action += RECALIBRATE_PRINTER if firmware else RECALIBRATE
        else:
            cause = "the readings scatter more than before, or something moved during the session"
            action = f"Check the mounting of the {'probe' if firmware else 'gauge'}, then "
            action += "probe again." if firmware else "read again."
        text += f" A fit of the new readings alone leaves {mm(refit)} mm RMS. Possible: {cause}."
    return review("larger than predicted", text, action, (place,), **numbers)


def as_predicted(
    achieved: float, limit: float, expected: float, numbers: Mapping[str, float]
) -> Finding:
    """Finding about deviations as predicted.

    Args:
        achieved: RMS of the deviations, [m].
        limit: As for `larger_than_predicted`. Deviations in directions that the calibration hardly
            predicts have a limit far above any machine's; the expected RMS is stated instead.
        expected: Predicted RMS, [m].
        numbers: Numbers of the finding.
    """
    deviations = _with_limit(achieved, limit)
    if limit > FAR_LIMIT * max(achieved, expected):
        deviations = f"{mm(achieved)} mm RMS (expected {mm(expected)} mm)"
    return note(
        "as predicted",
        f"The new readings agree with the predictions: they deviate by {deviations}.",
        **numbers,
    )


def with_tool_errors(agreement: Finding, before: float, now: float) -> Finding:
    """Finding about deviations as predicted, with a tool error that is larger than before.

    Args:
        agreement: The finding.
        before: Expected tool error with the present offsets before the new readings, [m].
        now: The same from all readings, [m].
    """
    text = (
        f"{agreement.text} This test compares readings, not tool errors. From all readings, the "
        f"expected tool error with the present offsets is {tool_mm(now)}, not {tool_mm(before)} as "
        "before."
    )
    numbers = {"before_um": before / UM, "now_um": now / UM}
    return replace(agreement, text=text, numbers={**agreement.numbers, **numbers})


def _with_limit(achieved: float, limit: float) -> str:
    """RMS of the deviations and its limit, with more decimals if they are nearly equal."""
    decimals = next(
        n for n in (3, 4, 5, 6) if n == 6 or plain(achieved / MM, n) != plain(limit / MM, n)
    )
    rms, largest = (plain(v / MM, decimals) for v in (achieved, limit))
    return f"{rms} mm RMS (limit {largest} mm)"


def further_change(entries: Sequence[ControllerEntry]) -> Finding:
    """Finding that the joint calibration improves offsets.

    Args:
        entries: Offsets that change by more than their uncertainty; empty if each change is smaller
            but all together are significant.
    """
    changes = [
        f"{e.drive} from {signed(e.active * e.edge_factor)} to {signed(e.enter * e.edge_factor)} "
        f"{e.edge_unit}"
        for e in entries
        if e.active is not None
    ]
    text = (
        "The new readings improve the offsets further: each by less than its uncertainty, but all "
        "together significantly."
    )
    if changes:
        noun = "an offset" if len(changes) == 1 else "offsets"
        text = f"The new readings still improve {noun}: {joined(changes)}."
    return note(
        "further change", text, CALIBRATE_JOINTLY, parameter_places(*(e.drive for e in entries))
    )


def further_settings(change: Finding | None, *, unchanged: bool) -> Finding:
    """Finding that the joint calibration improves the settings of a printer's firmware.

    Args:
        change: Finding about the errors with new settings; None if they are unknown.
        unchanged: Whether the new session states the settings of the calibration.
    """
    texts = ["Settings from all readings are still better."]
    if change is not None:
        texts.append(change.text)
    if unchanged:
        texts.append(
            "The new session states the settings of the earlier one: new ones are not active."
        )
    return note(
        "further change",
        " ".join(texts),
        "Calibrate the sessions together and export again.",
        **({} if change is None else change.numbers),
    )


def describe_repetition(
    repetition: Repetition, *, exceeded: bool = False, title: str = ""
) -> Finding:
    """Finding about the correlation of the residuals of two sessions.

    Args:
        repetition: The correlation.
        exceeded: Whether the deviations are larger than predicted.
        title: Title of the other session; "" not to name it.
    """
    r, where = repetition, f" in '{title}'" if title else ""
    numbers = {"rows": float(r.matched)}
    if r.repeats is None:
        reason = f"nearly all residuals of the calibration in the {r.matched} shared lines are 0"
        if r.matched < MIN_ROWS:
            reason = "too few lines are shared"
        text = f"It is unknown whether the same deviations remain{where}: {reason}."
        return note("repetition unknown", text, **numbers)
    numbers |= {"correlation": r.correlation, "chance": r.p_value}
    if r.repeats:
        text = (
            f"The same deviations remain as before{where}: they are errors that this model does "
            "not contain, and more readings of the same kind do not reduce them."
        )
        return note("residuals repeat", text, **numbers)
    meaning = "they did not occur in the calibration" if exceeded else "they look like noise"
    text = f"The remaining deviations do not repeat{where}: {meaning}."
    return note("residuals differ", text, **numbers)


def controller_assumed(*, backlash: bool) -> Finding:
    """Finding that the active offsets are not stated, so that the calibrated ones are assumed.

    Args:
        backlash: Whether the calibrated backlash is assumed, too.
    """
    assumed = "offsets and the backlash" if backlash else "offsets"
    return note(
        "controller assumed",
        f"The session does not state the active offsets. The {assumed} of the calibration are "
        "assumed to be active.",
        "State the active ones in its session.yaml (`controller`).",
    )
