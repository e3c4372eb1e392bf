"""Validation of a calibration by a new session.

The new session is measured with the calibrated offsets active in the controller. The verdict is
that of all sessions together, as `check` and `calibrate` state it. The calibration is confirmed if
it is `enter`, and the new readings deviate as predicted, within the uncertainty of the calibration.
New readings can still improve a confirmed calibration. Then the values to enter come from a joint
calibration of all sessions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from orthocal.assessment.assess import assess, assessment_of, is_significant
from orthocal.assessment.controller_entries import (
    compensation_to_enter,
    entered_offsets,
    expanded_uncertainty,
    find_backlash,
    find_entries,
)
from orthocal.assessment.judgement import Judgement, judge_session, rank, verdict_of
from orthocal.assessment.predictive import (
    DeviationTest,
    Repetition,
    expect_deviations,
    judge_deviations,
    measure_repetition,
)
from orthocal.assessment.repeated_readings import find_scattered
from orthocal.assessment.wording import describe_actions, join_texts
from orthocal.assessment.words import validation as words
from orthocal.assessment.words.anomalies import place_of
from orthocal.assessment.words.remedies import command_to_restart
from orthocal.calibration.assessment_record import (
    EXIT_CODES,
    Assessment,
    BacklashEntry,
    ControllerEntry,
    Decision,
    Finding,
    FindingKind,
)
from orthocal.calibration.build_record import adjust_calibration, assemble_calibration
from orthocal.calibration.calibration import Calibration, require_calibration
from orthocal.calibration.recorded_robot import require_calibrated_robot
from orthocal.calibration.refit import calibrated_theta, repeat_fit, restore_session
from orthocal.effects.adjustment import subtract_amounts
from orthocal.errors import SessionError
from orthocal.estimation.fit import Fit
from orthocal.hypotheses.anomaly import WRONGLY_ENTERED, Anomaly
from orthocal.io.documents import format_json
from orthocal.io.fields import finite_or_none
from orthocal.measurement.files.session_keys import drive_value_keys
from orthocal.measurement.joining import (
    Given,
    gather_sessions,
    join_sessions,
    list_members,
    require_same_tolerances,
)
from orthocal.runtime.threads import one_thread
from orthocal.session.session import Session
from orthocal.statistics.chance import BY_CHANCE
from orthocal.units import MM

EXPLAINED_RATIO = 0.7
"""Ratio of RMS residuals to RMS deviations below which a fit explains the deviations."""

ALLOWED_STDS = 0.5
"""Allowed difference of a stated offset from the calibrated one, in standard deviations of its
scatter."""

ROUNDING = 0.02e-3
"""Difference of a stated offset from the calibrated one that is always allowed: 0.02 mm or
0.02 mrad, [m, rad]."""

LARGER_TOOL_ERROR = 1.2
"""Ratio of the expected tool errors after and before the new readings from which both are stated.
Smaller ones differ by the rounding of the printed numbers."""

ENTRY_KINDS: tuple[FindingKind, ...] = (
    "no offset",
    "no change needed",
    "must change",
    "not significant",
    "tool error",
    "out of reach",
)
"""Kinds of findings about the values to enter."""


@dataclass(frozen=True, slots=True, eq=False)
class ValidationDecision(Decision):
    """Decision about a validation: the verdict of all sessions, and whether it is confirmed."""

    confirmed: bool | None
    """See `Validation.confirmed`."""

    @property
    def exit_code(self) -> int:
        """0 if the calibration is confirmed, otherwise 3."""
        return EXIT_CODES["enter" if self.confirmed else "review"]


@dataclass(frozen=True, slots=True, eq=False)
class Validation:
    """Comparison of a new session with the predictions of a calibration."""

    confirmed: bool | None
    """True if the calibration is confirmed; None if it predicts nothing, if new readings are
    wrong, or if they agree with it but all readings together show an anomaly."""
    offsets_stated: bool
    """True if the session states the active offsets; otherwise the calibrated ones are assumed."""
    expected_rms: float
    """Predicted RMS of the deviations, [m]."""
    expected_largest: float
    """Predicted largest deviation, [m]."""
    excess_probability: float
    """Probability of deviations at least as large as the measured ones; NaN if the calibration
    predicts nothing."""
    refit: Calibration
    """Fit of the same parameters to the new readings, not assessed. Its deviations refer to the
    calibrated machine."""
    joint: Calibration | None
    """Joint calibration from all sessions with its assessment; None if the calibration is not
    confirmed."""
    mistake: Anomaly | None
    """Wrongly entered numbers, or another change between the sessions; None without any."""
    enter: tuple[ControllerEntry, ...]
    """Values to enter. Those of the calibration if they were entered wrongly, or if the joint
    calibration changes none of them; those of the joint calibration if it changes them. Empty if
    the calibration is not confirmed for another reason."""
    enter_backlash: tuple[BacklashEntry, ...]
    """Backlash of the calibration, if numbers were entered wrongly; otherwise empty."""
    repetition: Repetition
    """Correlation of the residuals of both fits."""
    assessment: Assessment
    """Decision whether the calibration is confirmed, with its findings."""

    @property
    def as_expected(self) -> bool | None:
        """True if the deviations are within the predictive distribution; None if unknown."""
        return _is_expected(self.excess_probability)

    @property
    def final_calibration(self) -> Calibration:
        """Calibration with the final values: `joint`, or `refit` if that is None."""
        return self.joint or self.refit

    @property
    def nothing_to_change(self) -> bool:
        """True if the final calibration keeps the active offsets."""
        return assessment_of(self.final_calibration).keeps_offsets

    def to_json(self) -> str:
        """Validation as a JSON document, SI units."""
        refit, final = self.refit, self.final_calibration
        changes = [
            {
                "drive": e.drive,
                "unit": e.unit,
                "change": e.best_change,
                "expanded_uncertainty": finite_or_none(expanded_uncertainty(final, e)),
                "significant": is_significant(final, e),
            }
            for e in (assessment_of(final).entries if self.confirmed else ())
        ]
        document = {
            "schema": "orthocal/validation/4",
            "title": refit.session.title,
            "offsets_stated": self.offsets_stated,
            "confirmed": self.confirmed,
            "expected_rms": self.expected_rms,
            "expected_largest": self.expected_largest,
            "achieved_rms": refit.rms_before,
            "achieved_largest": refit.largest_before,
            "refit_rms": refit.rms_after,
            "refit_largest": refit.largest_after,
            "as_expected": self.as_expected,
            "excess_probability": finite_or_none(self.excess_probability),
            "joint": self.joint is not None,
            "nothing_to_change": self.nothing_to_change if self.confirmed else None,
            "changes": changes,
            "mistake": None if self.mistake is None else _mistake_document(self.mistake),
            "enter": [{"drive": e.drive, "unit": e.unit, "value": e.enter} for e in self.enter],
            **self.repetition.to_document(),
        }
        return format_json(document)


def _mistake_document(mistake: Anomaly) -> dict[str, Any]:
    """Entries of the JSON document about a change between the sessions."""
    e = mistake.explanation
    return {
        "kind": e.kind,
        "session": e.sessions[0],
        "drives": list(e.drives),
        "parameters": list(e.parameters),
        "active": list(e.active) or None,
        "change": e.amount,
        "change_std": e.std,
        "log_evidence": mistake.log_evidence,
    }


def _is_expected(p_value: float) -> bool | None:
    """True if deviations with this p-value are as predicted; None if it is unknown."""
    return None if math.isnan(p_value) else p_value >= BY_CHANCE


@one_thread()
def validate_calibration(
    calibration: Calibration,
    sessions: Given | Sequence[Given],
    *,
    tolerances: Mapping[str, float] | None = None,
) -> Validation:
    """Compare a new session, or several, with the predictions of a calibration.

    Args:
        calibration: The calibration whose offsets were entered.
        sessions: Sessions measured with these offsets active, which is assumed if a session states
            none. Adjustments that they state change the predicted readings.
        tolerances: Tolerances as in `Choice`, for the judgement of new readings and changes alone.

    Raises:
        SessionError: If a session is of another robot, states other offsets, or belongs to the
            calibration itself.
        NotIdentifiableError: If the sessions do not determine the parameters.
        SolverError: If the fit of the new readings does not converge.
    """
    require_calibration(calibration)
    calibration, new = _apply_stated(calibration, gather_sessions(sessions), tolerances or {})
    measured = [_with_active_offsets(calibration, one) for one in new]
    fit = repeat_fit(calibration, join_sessions(measured))
    refit = assemble_calibration(fit, nominal=calibrated_theta(calibration, fit))
    before = restore_session(calibration)
    all_sessions = join_sessions([before, *measured])
    judgement = judge_session(all_sessions)
    mistake = next((a for a in judgement.anomalies if a.explanation.sessions), None)
    expected, test = expect_deviations(calibration, fit), judge_deviations(calibration, fit)
    explained = _explain_deviations(judgement, before, fit.problem.session)
    agreement = _describe_agreement(refit, fit, test, expected.rms, judgement, explained=explained)
    confirmed = _confirmation(agreement, judgement, changed=mistake is not None)
    joint, findings = _calibrate_jointly(calibration, all_sessions, judgement, confirmed)
    confirmed = confirmed and joint is not None
    agreement = _compare_tool_errors(agreement, calibration, joint)
    wrongly = joint is None and _is_wrongly_entered(all_sessions, mistake)
    entries, notes = _choose_entries(calibration, joint, new, wrongly=wrongly)
    repetition = measure_repetition(calibration, refit)
    notes += _describe_comparison(repetition, test, judgement) + _assumed(calibration, new)
    return Validation(
        confirmed=confirmed,
        offsets_stated=_state_offsets(new),
        expected_rms=expected.rms,
        expected_largest=expected.largest,
        excess_probability=test.p_value,
        refit=refit,
        joint=joint,
        mistake=mistake,
        enter=entries,
        enter_backlash=find_backlash(calibration) if wrongly else (),
        repetition=repetition,
        assessment=Assessment(
            _decide(confirmed, findings, agreement),
            rank([*findings, agreement, *notes]),
            entries,
            None if joint is None else assessment_of(joint).tool,
            () if joint is None else assessment_of(joint).backlash,
        ),
    )


def _describe_comparison(
    repetition: Repetition, test: DeviationTest, judgement: Judgement
) -> list[Finding]:
    """Finding about repeated residuals. That those of wrong readings repeat means nothing."""
    exceeded = _is_expected(test.p_value) is False
    repeated = words.describe_repetition(repetition, exceeded=exceeded)
    means_nothing = repeated.kind == "residuals repeat" and judgement.verdict != "enter"
    return [] if means_nothing else [repeated]


def _assumed(calibration: Calibration, new: Sequence[Session]) -> list[Finding]:
    """Finding about calibrated values that are assumed, unless the sessions state theirs."""
    backlash = bool(compensation_to_enter(calibration))
    return [] if _state_offsets(new) else [words.controller_assumed(backlash=backlash)]


def _state_offsets(sessions: Sequence[Session]) -> bool:
    """True if all sessions state the active offsets."""
    return all(one.controller_offsets is not None for one in sessions)


def _apply_stated(
    calibration: Calibration, sessions: Sequence[Session], tolerances: Mapping[str, float]
) -> tuple[Calibration, list[Session]]:
    """Calibration and new sessions with the stated tolerances and mechanical adjustments.

    A session that states no tolerances has those of the calibration.

    Raises:
        SessionError: If a session is of another robot or belongs to the calibration, an adjustment
            does not fit, or tolerances differ from those of the calibration.
    """
    robot, settings = calibration.robot.with_tolerances(tolerances), calibration.session.firmware
    placed = sessions
    if settings is not None:
        placed = [s.on_printer(calibration.robot, settings.homed) for s in sessions]
    for session in placed:
        require_calibrated_robot(calibration, session)
    restated = [
        session.with_tolerances(
            tolerances if session.robot.parameters.stated else robot.parameters.stated
        )
        for session in placed
    ]
    for session in restated:
        require_same_tolerances(robot, session, source="the calibration")
    calibration = _adjust_to_sessions(replace(calibration, robot=robot), restated)
    _require_new(calibration, restated)
    return calibration, restated


def _confirmation(agreement: Finding, judgement: Judgement, *, changed: bool) -> bool | None:
    """True if new readings confirm the predictions; None if that is unknown.

    Args:
        agreement: Finding about the agreement of the new readings.
        judgement: Judgement of all sessions.
        changed: Whether a change between the sessions was found.
    """
    if agreement.kind == "nothing predicted":
        return None
    if agreement.severity != "note" or changed:
        return False
    return True if judgement.verdict == "enter" else None


def _explain_deviations(judgement: Judgement, before: Session, new: Session) -> bool:
    """True if wrong new readings explain deviations.

    Each anomaly is then one of new rows, which follow those of the calibration. Without anomalies,
    only new readings do not repeat.
    """
    if not judgement.anomalies:
        return bool(find_scattered(new)) and not find_scattered(before)
    anomalies = judgement.anomalies
    explanations = [e for a in anomalies for e in (a.explanation, *a.causes, *a.alternatives)]
    return all(e.rows and min(e.rows) >= len(before.readings) for e in explanations)


def _calibrate_jointly(
    calibration: Calibration, all_sessions: Session, judgement: Judgement, confirmed: bool | None
) -> tuple[Calibration | None, tuple[Finding, ...]]:
    """Assessed calibration from all sessions, and the findings about them.

    The calibration is None if the earlier one is not confirmed, or if an offset is held by a bound.
    """
    if not confirmed:
        return None, judgement.findings
    fit = repeat_fit(calibration, all_sessions, tolerance_scale=judgement.tolerance_scale)
    joint = assemble_calibration(fit)
    assessment = assess(joint, all_sessions, judgement=judgement)
    if assessment.decision.verdict != "enter":
        return None, assessment.findings
    return replace(joint, assessment=assessment), judgement.findings


def _require_new(calibration: Calibration, sessions: Sequence[Session]) -> None:
    """Refuse sessions of the calibration itself, because their readings confirm nothing.

    Raises:
        SessionError: If a session belongs to the calibration; it names the session.
    """
    record = calibration.session
    for session in (member for one in sessions for member in list_members(one)):
        if any(session.was_read_from(part.sha256) for part in (record, *record.parts)):
            raise SessionError(
                "belongs to the calibration itself; expected a session measured afterwards",
                where=str(session.path or "session"),
            )


def _adjust_to_sessions(calibration: Calibration, sessions: Sequence[Session]) -> Calibration:
    """Calibration of the machine with the mechanical adjustments that new sessions state.

    Raises:
        SessionError: If sessions state different adjustments.
    """
    first = sessions[0]
    for session in sessions:
        if subtract_amounts(session.adjusted, first.adjusted):
            raise SessionError(
                "states other adjustments than the session before it; validate them separately",
                where=f"{session.path or 'session'}: adjusted_mm",
            )
    changes = subtract_amounts(first.adjusted, dict(calibration.session.adjusted))
    return adjust_calibration(calibration, changes)


def _with_active_offsets(calibration: Calibration, session: Session) -> Session:
    """Session with active offsets: as stated; otherwise with all values as calibrated.

    Raises:
        SessionError: If it states other offsets than the calibrated ones.
    """
    drives = [d.name for d in session.robot.drives]
    entries = {drives.index(e.drive): e for e in find_entries(calibration)}
    if session.controller_offsets is None:
        stated = entries or calibration.session.controller_offsets is not None
        assumed = session.compensation or compensation_to_enter(calibration)
        entered = replace(session, compensation=assumed)
        return entered.with_controller(entered_offsets(calibration)) if stated else entered
    differences, where = [], ""
    for i, entry in entries.items():
        active = float(session.active_offsets[i])
        if math.isnan(entry.std_scatter):  # the calibration does not determine the offset
            continue
        if abs(active - entry.enter) > max(ALLOWED_STDS * entry.std_scatter, ROUNDING):
            factor, unit = entry.edge_factor, entry.edge_unit
            keys = " or ".join(drive_value_keys("offsets", entry.unit))
            where = f"{session.path or 'session'}: controller.{keys}"
            differences.append(
                f"{entry.drive} has {active * factor:g} {unit} instead of "
                f"{entry.enter * factor:.3f} {unit}"
            )
    if differences:
        verdict = assessment_of(calibration).decision.verdict
        advice = (
            "The session was not measured with the offsets to enter: calibrate it together with "
            "the earlier ones, or enter these offsets, measure again, and validate that session"
            if verdict == "enter"
            else f"The verdict of the calibration is '{verdict}': its offsets are not to be "
            "entered, so no session validates it"
        )
        raise SessionError(f"{'; '.join(differences)}. {advice}", where=where)
    return session


def _is_wrongly_entered(all_sessions: Session, mistake: Anomaly | None) -> bool:
    """True if the mistake is that a new session has wrongly entered offsets or backlashes."""
    if mistake is None:
        return False
    new = all_sessions.labels[len(all_sessions.parts[0].setups) :]
    return mistake.explanation.kind in WRONGLY_ENTERED and mistake.explanation.sessions[0] in new


def _describe_agreement(
    refit: Calibration,
    fit: Fit,
    test: DeviationTest,
    expected: float,
    judgement: Judgement,
    *,
    explained: bool,
) -> Finding:
    """Finding about the agreement of the deviations with their prediction.

    Args:
        refit: Calibration of the new readings.
        fit: Its fit.
        test: Test of the deviations.
        expected: Predicted RMS of the deviations, [m].
        judgement: Judgement of all sessions.
        explained: Whether wrong new readings explain the deviations. These neither confirm nor
            contradict the calibration.
    """
    achieved = refit.rms_before
    limit = test.critical_factor * achieved
    numbers = {
        "expected_rms_mm": expected / MM,
        "achieved_rms_mm": achieved / MM,
        "refit_rms_mm": refit.rms_after / MM,
        "limit_of_pattern_mm": limit / MM,
        "chance": test.p_value,
    }
    as_expected = _is_expected(test.p_value)
    if as_expected is None:
        return words.nothing_predicted(numbers)
    if not as_expected:
        session = fit.problem.session
        worst = list(session.setups)[test.worst_setup]
        row = next(i for i, r in enumerate(session.readings) if r.setup == worst)
        finding = words.larger_than_predicted(
            achieved,
            limit,
            refit.rms_after if judgement.verdict == "enter" else None,
            explains=refit.rms_after < EXPLAINED_RATIO * achieved,
            firmware=refit.session.firmware is not None,
            numbers=numbers,
            place=place_of(session, row),
            command=command_to_restart(session, session.readings[row]),
        )
        return replace(finding, severity="note") if explained else finding
    return words.as_predicted(achieved, limit, expected, numbers)


def _compare_tool_errors(
    agreement: Finding, before: Calibration, joint: Calibration | None
) -> Finding:
    """Agreement of the readings, with both tool errors if new readings show a larger one.

    The expected tool error is a mean over all machines that agree with the readings. That of one
    machine, on which new readings agree with the predictions, may be larger.
    """
    if joint is None:
        return agreement
    promised, tool = assessment_of(before).tool, assessment_of(joint).tool
    if promised is None or tool is None or not tool.now > LARGER_TOOL_ERROR * promised.entered:
        return agreement
    return words.with_tool_errors(agreement, promised.entered, tool.now)


def _choose_entries(
    calibration: Calibration,
    joint: Calibration | None,
    new: Sequence[Session],
    *,
    wrongly: bool,
) -> tuple[tuple[ControllerEntry, ...], list[Finding]]:
    """Values to enter after the new readings, and findings about them.

    A calibration that is not confirmed has no values, unless it was entered wrongly.

    Args:
        calibration: The validated calibration.
        joint: Joint calibration; None if the calibration is not confirmed.
        new: The new sessions.
        wrongly: Whether the values of the calibration were entered wrongly.
    """
    if joint is None:
        return (find_entries(calibration) if wrongly else ()), []
    settings = calibration.session.firmware
    unchanged = settings is not None and all(settings.equals(one.firmware) for one in new)
    assessment, findings = assessment_of(joint), _find_further_change(joint, unchanged=unchanged)
    entries = assessment.entries if findings else find_entries(calibration)
    return entries, [*findings, *assessment.of_kind(*ENTRY_KINDS)]


def _find_further_change(joint: Calibration, *, unchanged: bool) -> list[Finding]:
    """Finding about offsets or settings that the joint calibration changes; empty without any.

    Args:
        joint: Joint calibration.
        unchanged: Whether the new sessions state the settings of the calibration's firmware.
    """
    assessment = assessment_of(joint)
    if assessment.keeps_offsets:
        return []
    if joint.session.firmware is not None:
        change = next(iter(assessment.of_kind("settings improve")), None)
        return [words.further_settings(change, unchanged=unchanged)]
    return [words.further_change([e for e in assessment.entries if is_significant(joint, e)])]


def _decide(
    confirmed: bool | None, findings: Sequence[Finding], agreement: Finding
) -> ValidationDecision:
    """Decision about a validation, with the verdict on all sessions.

    Its reason states what decides: deviations that are not as predicted, then the findings about
    the readings; if there is neither, the agreement. Its action is that of these findings,
    otherwise that of the agreement.

    Args:
        confirmed: Whether the calibration is confirmed; None if unknown.
        findings: Findings about all sessions.
        agreement: Finding about the agreement of the new readings.
    """
    against = [f for f in findings if f.severity != "note"]
    reasons = [f for f in (agreement, *against) if f.severity != "note"]
    headlines = {True: words.CONFIRMED, False: words.NOT_CONFIRMED, None: words.INCONCLUSIVE}
    action = describe_actions(against) or agreement.action
    if confirmed is None and against:
        separator = "\n" if "\n" in action else " "
        action = f"{action}{separator}Then validate again.".lstrip()
    return ValidationDecision(
        verdict_of(against),
        headlines[confirmed],
        join_texts([f.text for f in reasons or [agreement]]),
        action,
        confirmed,
    )
