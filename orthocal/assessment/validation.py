"""Validation of a calibration by a new session, as the paper's third experiment.

The new session is measured with the calibrated offsets active in the controller. The calibration
is confirmed if the new readings deviate as predicted, within the uncertainty of the calibration,
and no change between the sessions is found. A confirmed calibration can still be improved: then the
values to enter are those of a calibration from the readings of both.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from orthocal.arguments import require_kind
from orthocal.assessment.assess import (
    assess,
    assessment_of,
    expanded_uncertainty,
    is_significant,
)
from orthocal.assessment.controller_entries import find_entries
from orthocal.assessment.judgement import Judgement, judge_session, rank, verdict_of
from orthocal.assessment.predictive import (
    DeviationTest,
    Repetition,
    expect_rms,
    judge_deviations,
    measure_repetition,
)
from orthocal.assessment.words import validation as words
from orthocal.assessment.words.anomalies import describe_anomalies
from orthocal.calibration.adjusting import adjust_calibration
from orthocal.calibration.assessment_record import (
    Assessment,
    ControllerEntry,
    Decision,
    Finding,
    FindingKind,
    Place,
)
from orthocal.calibration.build_record import assemble_calibration
from orthocal.calibration.calibration import Calibration
from orthocal.calibration.recorded_robot import require_calibrated_robot
from orthocal.calibration.refit import repeat_fit, restore_session
from orthocal.effects.adjustment import subtract_amounts
from orthocal.errors import SessionError
from orthocal.estimation.fit import Fit
from orthocal.hypotheses.anomaly import WRONGLY_ENTERED, Anomalies, Anomaly
from orthocal.hypotheses.search import find_anomalies
from orthocal.io.fields import finite_or_none
from orthocal.measurement.joining import Given, gather_sessions, join_sessions
from orthocal.session.session import Session
from orthocal.statistics.chance import BY_CHANCE
from orthocal.units import MM

REMOVED = 0.7
"""Part of the deviations below which a fit of the new readings is said to remove them."""

ROUNDING = 0.02e-3
"""Difference of a stated offset from the calibrated one that is due to rounding, [m, rad]."""

ENTRY_KINDS: tuple[FindingKind, ...] = (
    "no offset",
    "no change needed",
    "must change",
    "not significant",
    "tool error",
    "out of reach",
)
"""Kinds of findings about the values to enter after the new readings."""


@dataclass(frozen=True, slots=True, eq=False)
class Validation:
    """Comparison of a new session with the predictions of a calibration."""

    confirmed: bool | None
    """Whether the calibration is confirmed; None if it predicts nothing, or if the new readings
    agree with it but contradict each other."""
    offsets_stated: bool
    """Whether the session states the active offsets; otherwise the calibrated ones are assumed."""
    expected_rms: float
    """RMS of the deviations as predicted, [m]."""
    expected_largest: float
    """Largest deviation as predicted, [m]."""
    excess_probability: float
    """Probability of deviations as large as those measured, or larger; NaN if the calibration
    predicts nothing."""
    refit: Calibration
    """The same fit to the new readings, with its assessment. Its deviations are those from the
    machine as it was calibrated."""
    joint: Calibration | None
    """Calibration from its readings and the new ones together, as `calibrate` assesses it; None if
    the calibration is not confirmed."""
    mistake: Anomaly | None
    """Change between the sessions: offsets that were entered wrongly, or a machine that changed."""
    enter: tuple[ControllerEntry, ...]
    """Values to enter: those of the calibration if they were entered wrongly or all readings
    together change none, otherwise those of `answer`."""
    repetition: Repetition
    """Correlation of the residuals of both fits."""
    assessment: Assessment
    """Decision whether the calibration is confirmed, with its findings."""

    @property
    def as_expected(self) -> bool | None:
        """True if the deviations are within the predictive distribution; None if unknown."""
        return _is_expected(self.excess_probability)

    @property
    def answer(self) -> Calibration:
        """Calibration whose values count: `joint`, or `refit` if that is None."""
        return self.joint or self.refit

    @property
    def nothing_to_change(self) -> bool:
        """True if a calibration from these readings keeps the active offsets."""
        return assessment_of(self.answer).keeps_offsets

    def to_json(self) -> str:
        """Document for JSON, SI units."""
        refit, answer = self.refit, self.answer
        changes = [
            {
                "drive": e.drive,
                "unit": e.unit,
                "change": e.best_change,
                "expanded_uncertainty": finite_or_none(expanded_uncertainty(answer, e)),
                "significant": is_significant(answer, e),
            }
            for e in assessment_of(answer).entries
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
            "nothing_to_change": self.nothing_to_change,
            "changes": changes,
            "mistake": None if self.mistake is None else _mistake_document(self.mistake),
            "enter": [{"drive": e.drive, "unit": e.unit, "value": e.enter} for e in self.enter],
            **self.repetition.to_document(),
        }
        return json.dumps(document, indent=1, allow_nan=False) + "\n"


def _mistake_document(mistake: Anomaly) -> dict[str, Any]:
    e = mistake.explanation
    return {
        "kind": e.kind,
        "session": e.sessions[0],
        "drives": list(e.drives),
        "parameters": list(e.parameters),
        "active": list(e.offsets) or None,
        "change": e.amount,
        "change_std": e.std,
        "log_evidence": mistake.log_evidence,
    }


def _is_expected(probability: float) -> bool | None:
    return None if math.isnan(probability) else probability >= BY_CHANCE


def validate_calibration(
    calibration: Calibration,
    sessions: Given | Sequence[Given],
    *,
    tolerances: Mapping[str, float] | None = None,
) -> Validation:
    """Compare a new session, or several, with the predictions of a calibration.

    Args:
        calibration: The calibration whose offsets were entered.
        sessions: Measured afterwards, with its offsets in the controller, as is assumed of those
            that state none. Adjustments that they state change the predicted readings.
        tolerances: As in `Choice`, for the judgement of the new sessions and of changes, not for
            the predictions.

    Raises:
        SessionError: If a session is of another robot, states offsets of another calibration, or is
            one that the calibration was made from.
        NotIdentifiableError: If the sessions do not determine the parameters.
        SolverError: If the fit of the new readings does not converge.
    """
    require_kind(calibration, Calibration, expected="a Calibration, such as load_calibration(...)")
    calibration, new_sessions = _restate(calibration, gather_sessions(sessions), tolerances or {})
    measured = [_with_active_offsets(calibration, one) for one in new_sessions]
    session = join_sessions(measured)
    judgement, fit = judge_session(session), repeat_fit(calibration, session)
    refit = _assess_refit(fit, calibration, judgement)
    every = join_sessions([restore_session(calibration), *measured])
    anomalies = find_anomalies(every)
    mistake, changes, wrongly_entered = _find_changes(every, anomalies, judgement)
    expected_rms, test = expect_rms(calibration, fit), judge_deviations(calibration, fit)
    lead = _agreement(refit, test, expected_rms, explained=bool(changes))
    confirmed = None if math.isnan(test.chance) else _is_confirmed(lead, changes, judgement)
    joint = _calibrate_jointly(calibration, every, anomalies) if confirmed else None
    further, assessed = _find_further_change(joint), assessment_of(joint or refit)
    keep = wrongly_entered or (confirmed is not False and not further)
    entries = find_entries(calibration) if keep else assessed.entries
    repetition = measure_repetition(calibration, refit)
    stated = all(one.controller_offsets is not None for one in new_sessions)
    notes = [*further, *([] if wrongly_entered else assessed.of_kind(*ENTRY_KINDS))]
    notes.append(words.describe_repetition(repetition, new=_is_expected(test.chance) is False))
    notes += [] if stated else [words.controller_assumed()]
    return Validation(
        confirmed=confirmed,
        offsets_stated=stated,
        expected_rms=expected_rms,
        expected_largest=_expect_largest(calibration, expected_rms),
        excess_probability=test.chance,
        refit=refit,
        joint=joint,
        mistake=mistake,
        enter=entries,
        repetition=repetition,
        assessment=replace(
            assessed,
            decision=_decide(confirmed, judgement, lead, changes),
            findings=rank([*judgement.findings, lead, *changes, *notes]),
            entries=entries,
        ),
    )


def _restate(
    calibration: Calibration, sessions: Sequence[Session], tolerances: Mapping[str, float]
) -> tuple[Calibration, list[Session]]:
    """Calibration and new sessions of the machine with stated tolerances and adjustments.

    Raises:
        SessionError: If the calibration was made from a session, or an adjustment does not fit.
    """
    restated = [session.with_tolerances(tolerances) for session in sessions]
    robot = calibration.robot.with_tolerances(tolerances)
    calibration = _as_adjusted(replace(calibration, robot=robot), restated)
    _require_new(calibration, restated)
    return calibration, restated


def _assess_refit(fit: Fit, calibration: Calibration, judgement: Judgement) -> Calibration:
    """Calibration of the new readings; its nominal readings are those that were predicted."""
    refit = assemble_calibration(fit, nominal=np.array([p.value for p in calibration.free]))
    return replace(refit, assessment=assess(refit, fit.problem.session, judgement=judgement))


def _is_confirmed(lead: Finding, changes: Sequence[Finding], judgement: Judgement) -> bool | None:
    """Confirmation of the predictions by new readings; None if these contradict each other."""
    agrees = lead.severity == "note" and not changes
    return None if agrees and judgement.verdict != "enter" else agrees


def _calibrate_jointly(
    calibration: Calibration, every: Session, anomalies: Anomalies
) -> Calibration:
    """Calibration from its readings and new ones, which are joined, assessed."""
    judgement = judge_session(every, anomalies=anomalies)
    fit = repeat_fit(calibration, every, tolerance_scale=judgement.tolerance_scale)
    joint = assemble_calibration(fit)
    return replace(joint, assessment=assess(joint, every, judgement=judgement))


def _require_new(calibration: Calibration, sessions: Sequence[Session]) -> None:
    """Refuse sessions that the calibration was made from: their readings confirm nothing.

    Raises:
        SessionError: Naming the session.
    """
    record = calibration.session
    used = {part.sha256 for part in (record, *record.parts)} - {""}
    for session in sessions:
        if session.sha256 in used:
            raise SessionError(
                "is a session that the calibration was made from, which is no validation; expected "
                "readings taken afterwards",
                where=str(session.path or "session"),
            )


def _as_adjusted(calibration: Calibration, sessions: Sequence[Session]) -> Calibration:
    """The calibration of the machine with the mechanical adjustments that new sessions state.

    Raises:
        SessionError: If a session is of another robot, or two sessions state other adjustments.
    """
    first = sessions[0]
    for session in sessions:
        require_calibrated_robot(calibration, session)
        if subtract_amounts(session.adjusted, first.adjusted):
            raise SessionError(
                "states other adjustments than the session before it; validate them separately",
                where=f"{session.path or 'session'}: adjusted_mm",
            )
    changes = subtract_amounts(first.adjusted, dict(calibration.session.adjusted))
    return adjust_calibration(calibration, changes)


def _with_active_offsets(calibration: Calibration, session: Session) -> Session:
    """The session with the offsets that were active: as stated, otherwise as calibrated.

    Raises:
        SessionError: If it states other offsets.
    """
    drives = [d.name for d in session.robot.drives]
    entries = {drives.index(e.drive): e for e in find_entries(calibration)}
    if session.controller_offsets is None:
        offsets = np.zeros(len(drives))
        offsets[list(entries)] = [e.enter for e in entries.values()]
        return session.with_controller(offsets) if entries else session
    others, where = [], ""
    for i, entry in entries.items():
        active = float(session.active_offsets[i])
        allowed = max(0.5 * entry.std_scatter, ROUNDING)
        if not math.isnan(allowed) and abs(active - entry.enter) > allowed:
            factor, unit = entry.edge_factor, entry.edge_unit
            where = f"{session.path or 'session'}: controller.offsets_{unit}"
            others.append(
                f"{entry.drive} has {active * factor:g} {unit} instead of "
                f"{entry.enter * factor:.3f} {unit}"
            )
    if others:
        raise SessionError(
            f"{'; '.join(others)}. The session was not measured with the offsets to enter: enter "
            "them, measure again, and validate that session",
            where=where,
        )
    return session


def _find_changes(
    every: Session, anomalies: Anomalies, judgement: Judgement
) -> tuple[Anomaly | None, list[Finding], bool]:
    """Changes between the sessions of a calibration and new ones.

    Args:
        every: The session of the calibration and the new ones, joined.
        anomalies: Of all their readings.
        judgement: Judgement of the new sessions by themselves.

    Returns:
        The most likely change, all findings, and whether the offsets of the calibration were
        entered wrongly.
    """
    changes = tuple(a for a in anomalies.found if a.between_sessions)
    if not changes and judgement.verdict != "enter":  # its findings explain the readings
        return None, [], False
    mistake = next((a for a in changes if a.explanation.sessions), None)
    findings = describe_anomalies(every, replace(anomalies, found=changes))
    if mistake is None:
        return None, findings, False
    new = {name.partition("/")[0] for name in list(every.setups)[len(every.parts[0].setups) :]}
    e = mistake.explanation
    return mistake, findings, e.kind in WRONGLY_ENTERED and e.sessions[0] in new


def _agreement(
    refit: Calibration, test: DeviationTest, expected: float, *, explained: bool
) -> Finding:
    """Agreement of the deviations with their prediction, and of the values to enter.

    Args:
        refit: Fit of the new readings, assessed.
        test: Test of the deviations.
        expected: RMS of the deviations as predicted, [m].
        explained: Whether a change between the sessions explains the deviations.
    """
    achieved = refit.rms_before
    numbers = {
        "expected_rms_mm": expected / MM,
        "achieved_rms_mm": achieved / MM,
        "refit_rms_mm": refit.rms_after / MM,
        "limit_of_pattern_mm": test.limit * achieved / MM,
        "chance": test.chance,
    }
    as_expected = _is_expected(test.chance)
    if as_expected is None:
        return words.nothing_predicted(numbers)
    if not as_expected:
        worst = max(refit.residuals, key=lambda r: abs(r.deviation))
        return words.larger_than_predicted(
            achieved,
            test.limit * achieved,
            None if explained else refit.rms_after,
            removed=refit.rms_after < REMOVED * achieved,
            numbers=numbers,
            place=Place(line=worst.line, setup=worst.setup, posture=worst.postures),
        )
    return words.as_predicted(achieved, test.limit * achieved, numbers)


def _find_further_change(joint: Calibration | None) -> list[Finding]:
    """Finding about offsets that a calibration from all readings changes; none without one."""
    if joint is None:
        return []
    judged = assessment_of(joint)
    if judged.keeps_offsets:
        return []
    return [words.further_change([e for e in judged.entries if is_significant(joint, e)])]


def _expect_largest(calibration: Calibration, expected_rms: float) -> float:
    """Largest deviation as predicted, [m]: that of the calibration, in proportion to the RMS."""
    if calibration.rms_after == 0.0:
        return expected_rms
    return expected_rms / calibration.rms_after * calibration.largest_after


def _decide(
    confirmed: bool | None, judgement: Judgement, lead: Finding, changes: Sequence[Finding]
) -> Decision:
    """The decision: readings that cannot be trusted come first, then the agreement, its causes."""
    anomalies = [f for f in judgement.findings if f.severity != "note"][:1]
    headlines = {True: words.CONFIRMED, False: words.NOT_CONFIRMED, None: words.UNKNOWN}
    return Decision(
        verdict_of([*judgement.findings, lead, *changes]),
        headlines[confirmed],
        " ".join(f.text for f in (*anomalies, lead, *changes)),
        next((f.action for f in (*anomalies, *changes, lead) if f.action), ""),
    )
