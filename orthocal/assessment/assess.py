"""Assessment of a calibration: verdict, findings, values to enter and tool error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arguments import require_kind
from orthocal.assessment.calibrated_tool import CalibratedTool, find_tool
from orthocal.assessment.controller_entries import (
    WORTH_ENTERING,
    backlash_changes,
    compute_backlash,
    compute_entries,
    expanded_uncertainty,
    find_screws,
    is_worth_changing,
    lowers,
)
from orthocal.assessment.fit_findings import find_fit_findings
from orthocal.assessment.judgement import Judgement, judgement_of, rank, verdict_of
from orthocal.assessment.recommendation import Recommendation, recommend_model
from orthocal.assessment.tool_error import assess_placed, require_tool, summarise_tool
from orthocal.assessment.wording import describe_actions
from orthocal.assessment.words import entries as words
from orthocal.assessment.words.comparison import describe_recommendation
from orthocal.calibration.assessment_record import (
    Assessment,
    BacklashEntry,
    ControllerEntry,
    Decision,
    Finding,
    FindingKind,
    ToolErrorSummary,
    first_of,
)
from orthocal.calibration.calibration import Calibration, require_calibration
from orthocal.calibration.identify import identify
from orthocal.calibration.refit import restore_session
from orthocal.errors import ClosureError, ExportError, RobotError
from orthocal.estimation.choice import Choice
from orthocal.estimation.loss import Loss, LossKind
from orthocal.estimation.options import SolverKind, SolverOptions
from orthocal.estimation.tolerance_scale import ToleranceScale
from orthocal.measurement.files.readings_checks import require_read
from orthocal.measurement.joining import Given
from orthocal.runtime.threads import one_thread
from orthocal.session.points import count_readings
from orthocal.session.session import Session, split_label

EXPLANATIONS: tuple[FindingKind, ...] = (
    "no redundancy",
    "model error",
    "noise from residuals",
    "gauge overstated",
    "fits",
)
"""Kinds of findings that explain the decision to enter; the first that is found is quoted."""

KEEPING: dict[FindingKind, str] = {
    "no offset": words.NOTHING_HEADLINE,
    "no change needed": words.KEEP_HEADLINE,
    "settings unknown": words.FIRMWARE_KEEP_HEADLINE,
    "no sensitivity": words.KEEP_HEADLINE,
    "no deviation": words.KEEP_HEADLINE,
}
"""Kinds of notes without anything to enter, and the headlines of the decision."""


@one_thread()
def calibrate(
    sessions: Given | Sequence[Given],
    choice: Choice | str | None = None,
    *,
    loss: Loss | LossKind | None = None,
    solver: SolverOptions | SolverKind = "ipopt",
    profile: Sequence[str] = (),
    start: ArrayLike | None = None,
    judgement: Judgement | None = None,
) -> Calibration:
    """Identify the errors of a machine from sessions, and assess the result.

    Args:
        sessions: The session, or the path to one; or several, which are fitted together.
        choice: Free errors, known errors and priors; or the name of a model. By default the choice
            that the session states, otherwise the complete model with priors.
        loss: `squares` (the default), `huber` (pseudo-Huber), or a Loss with another width.
        solver: `ipopt` on the complete program, the reference; `variable-projection`, the same
            optimum in less time; `linearised`, one step about the active offsets; or
            SolverOptions.
        profile: Names or globs of free parameters whose profile-likelihood intervals are computed.
        start: Initial values of the free errors of the machine, shape (n_machine,), [SI]; nuisance
            parameters then start at 0. By default all parameters start at the linearised solution.
            Not used by the solver `linearised`, which needs none.
        judgement: Judgement of these sessions with these effects and tolerances, if it was computed
            already.

    Returns:
        The calibration with its assessment.

    Raises:
        NotIdentifiableError: If neither readings nor a prior determine a parameter.
        SolverError: If the solver does not converge.
        ClosureError: If the machine cannot reach a posture.
        ParameterError: If the model or a name is unknown.
        TypeError: If an argument is of another kind.
        ValueError: If `start` does not have one number for each free error of the machine.
    """
    judged: list[Judgement] = []

    def find_scale(session: Session) -> ToleranceScale:
        judged.append(judgement_of(session, judgement))
        return judged[0].tolerance_scale

    calibration, session = identify(
        sessions,
        choice,
        loss=loss,
        solver=solver,
        profile=profile,
        start=start,
        find_scale=find_scale,
    )
    return replace(calibration, assessment=assess(calibration, session, judgement=judged[0]))


def assess(
    calibration: Calibration,
    session: Session | None = None,
    *,
    judgement: Judgement | None = None,
    recommendation: Recommendation | None = None,
) -> Assessment:
    """Judge a calibration: verdict, findings, values to enter and tool error.

    Args:
        calibration: The calibration.
        session: The session, or the joined sessions, that it was made from; by default those
            recorded in the calibration.
        judgement: Judgement of that session, if it was computed already.
        recommendation: Recommended model for that session, if it was computed already.

    Raises:
        ClosureError: If the machine cannot reach a posture.
    """
    require_calibration(calibration)
    session_used = session or restore_session(calibration)
    judgement = judgement_of(session_used, judgement)
    chosen = _choose_values(calibration)
    entries, tool, keep = chosen.entries, chosen.tool, chosen.keep
    firmware = calibration.session.firmware is not None  # settings are written, no offsets entered
    entry_findings = (
        _setting_findings(calibration, tool)
        if firmware
        else _entry_findings(calibration, entries, tool, keep=keep)
    )
    fit_findings = find_fit_findings(calibration)
    if judgement.verdict != "enter":  # mistakes explain the residuals
        fit_findings = [f for f in fit_findings if f.kind != "model error"]
    notes = [
        *fit_findings,
        *([_no_change_needed(entries, chosen.best)] if keep else []),
        *entry_findings,
        *([] if firmware else _compensation_findings(calibration, chosen.backlash)),
        *chosen.unreached,
    ]
    if judgement.verdict == "enter":
        notes += describe_recommendation(
            recommendation or recommend_model(session_used),
            judged_scale=judgement.tolerance_scale.factor,
            identified=calibration.model,
        )
    findings = rank([*judgement.findings, *notes])
    return Assessment(
        decision=_decide(
            findings,
            firmware=firmware,
            backlash=any(e.change for e in chosen.backlash),
            choice=calibration.measured_again and gains_from_correction(calibration, tool),
        ),
        findings=findings,
        entries=() if firmware else entries,
        tool=tool,
        backlash=chosen.backlash,
    )


def assessment_of(calibration: Calibration) -> Assessment:
    """Assessment of a calibration, as recorded; computed if there is none."""
    require_calibration(calibration)
    return calibration.assessment or assess(calibration)


def changes_offsets(calibration: Calibration) -> bool:
    """True if offsets are to be entered and other identified errors then remain."""
    firmware = calibration.session.firmware is not None
    return not (calibration.only_offsets or firmware or assessment_of(calibration).keeps_offsets)


def gains_from_correction(calibration: Calibration, tool: ToolErrorSummary | None) -> bool:
    """True if correcting all identified errors lowers the tool error beyond entered offsets."""
    return (
        not calibration.only_offsets and tool is not None and lowers(tool.entered, tool.compensated)
    )


@one_thread()
def check_session(session: Session, *, judgement: Judgement | None = None) -> Assessment:
    """Assess readings before anything is calibrated from them.

    Args:
        session: The session. Missing readings (NaN) are counted; the others are judged.
        judgement: Judgement of its readings, if it was computed already.

    Raises:
        SessionError: If all readings are missing.
    """
    require_kind(session, Session, expected="a Session, such as load_session(...)")
    missing = [words.readings_missing(session)] if np.isnan(session.values).any() else []
    if missing:
        require_read(session, partial=True)
        session = session.select([r for r in session.readings if r.is_read])
    judgement = judgement_of(session, judgement)
    findings = rank([*judgement.findings, *missing])
    if judgement.verdict == "enter":
        within = judgement.tolerance_scale.factor == 1.0
        no_anomaly = words.no_anomaly(count_readings(session), within_tolerances=within)
        findings = rank([*findings, no_anomaly])
    lead = next((f for f in findings if f.severity != "note"), findings[-1])
    return assess_readings(findings, lead)


def assess_readings(
    findings: tuple[Finding, ...], lead: Finding, tool: ToolErrorSummary | None = None
) -> Assessment:
    """Assessment of readings, without values to enter.

    Args:
        findings: All findings.
        lead: Finding that the decision quotes.
        tool: Expected tool error; None if unknown.
    """
    verdict, action = verdict_of(findings), describe_actions(findings) or lead.action
    decision = Decision(verdict, words.SESSION_HEADLINES[verdict], lead.text, action)
    return Assessment(decision, findings, (), tool)


@dataclass(frozen=True, slots=True, eq=False)
class _ValuesToEnter:
    """Values to enter, and the tool error with them."""

    entries: tuple[ControllerEntry, ...]
    backlash: tuple[BacklashEntry, ...]
    keep: bool
    """True if the active offsets are kept."""
    tool: ToolErrorSummary | None
    """Tool error with these values; None if unknown."""
    best: ToolErrorSummary | None
    """Tool error with the best offsets; None if unknown."""
    unreached: list[Finding]
    """Reason why the tool error is unknown."""


def _choose_values(calibration: Calibration) -> _ValuesToEnter:
    """Offsets and backlash that are worth entering."""
    calibrated_tool = find_tool(calibration)
    backlash = compute_backlash(calibration, calibrated_tool)
    changes = backlash_changes(calibration, backlash)
    entries = compute_entries(
        calibration, calibrated_tool and calibrated_tool.compensating(changes)
    )
    best, unreached = _summarise_tool(calibration, calibrated_tool, entries, backlash)
    active_entries = tuple(e.kept for e in entries)
    error_now = None if best is None else best.now
    if changes.any() and best is not None:
        summary_of_active, _ = _summarise_tool(
            calibration, calibrated_tool, active_entries, backlash
        )
        error_now = None if summary_of_active is None else summary_of_active.entered
    firmware = calibration.session.firmware is not None  # settings correct more than offsets
    keep = not firmware and _keeps_offsets(calibration, entries, error_now, best)
    if entries and not keep:
        return _ValuesToEnter(entries, backlash, keep, best, best, unreached)
    if not is_worth_changing(calibration, backlash, None if best is None else best.now, error_now):
        backlash = tuple(e.kept for e in backlash)
    tool, _ = _summarise_tool(calibration, calibrated_tool, active_entries, backlash)
    return _ValuesToEnter(active_entries, backlash, keep, tool, best, unreached)


def _summarise_tool(
    calibration: Calibration,
    calibrated_tool: CalibratedTool | None,
    entries: Sequence[ControllerEntry],
    backlash: Sequence[BacklashEntry],
) -> tuple[ToolErrorSummary | None, list[Finding]]:
    """Expected tool error; None and the reason if it is unknown."""
    try:
        placed = require_tool(calibration, calibrated_tool)
        accuracy = assess_placed(calibration, placed, entries, backlash)
    except (ClosureError, RobotError) as e:
        return None, [words.out_of_reach(str(e))]
    return summarise_tool(calibration, accuracy), []


def _keeps_offsets(
    calibration: Calibration,
    entries: Sequence[ControllerEntry],
    now: float | None,
    best: ToolErrorSummary | None,
) -> bool:
    """True if the active offsets are kept, as others reduce the tool error too little.

    Args:
        calibration: The calibration.
        entries: Offsets with the least tool error.
        now: Tool error with the active offsets, [m]; None if unknown.
        best: Tool error with the best offsets. If it is None, significance decides.
    """
    if not entries:
        return False
    if best is not None and now is not None:
        return not lowers(now, best.entered)
    determined = _determined_by_readings(entries)
    return bool(determined) and not any(is_significant(calibration, e) for e in determined)


def _determined_by_readings(entries: Sequence[ControllerEntry]) -> list[ControllerEntry]:
    """Entries whose values and uncertainties the readings determine."""
    return [e for e in entries if e.held is None and math.isfinite(e.std)]


def _no_change_needed(entries: Sequence[ControllerEntry], best: ToolErrorSummary | None) -> Finding:
    """Finding that the offsets are kept; `best` is the tool error with the best ones."""
    ratios = [abs(e.best_change) / e.std for e in _determined_by_readings(entries) if e.std > 0.0]
    drives = [e.drive for e in entries]
    return words.no_change_needed(drives, max(ratios, default=0.0), best, share=WORTH_ENTERING)


def _setting_findings(calibration: Calibration, tool: ToolErrorSummary | None) -> list[Finding]:
    """Finding about the settings of a firmware: others are better, or hardly so, or unknown."""
    settings = calibration.session.firmware
    if settings is None:
        return []
    from orthocal.assessment.printer_settings import fit_firmware

    try:
        fit = fit_firmware(calibration, settings.firmware, tool=tool)
    except ExportError as e:  # as `orthocal export` says, too
        return [words.settings_unknown(e.problem)]
    return [
        words.settings_change(
            tool=tuple(fit.expect_tool(e) for e in (fit.now, fit.new)),
            layer=tuple(fit.expect_layer(e) for e in (fit.now, fit.new)),
            keep=not fit.worth_entering,
        )
    ]


def _entry_findings(
    calibration: Calibration,
    entries: Sequence[ControllerEntry],
    tool: ToolErrorSummary | None,
    *,
    keep: bool,
) -> list[Finding]:
    """Findings about the values to enter.

    Args:
        calibration: The calibration.
        entries: The offsets to enter.
        tool: Tool error with these offsets; None if unknown.
        keep: Whether the offsets to enter are the active ones.
    """
    findings = [] if tool is None else [words.tool_error(tool, keep=keep or not entries)]
    if not entries:
        return [words.no_offset(), *findings]
    if entries[0].active is None:
        name, joined = calibration.setups[-1].name, bool(calibration.session.parts)
        last = split_label(name, joined=joined)[0]
        drives = [e.drive for e in entries]
        findings.append(words.controller_not_stated(drives, keep=keep, last=last))
    elif not calibration.session.parts and any(e.active for e in entries):
        findings.append(words.earlier_readings())
    determined = _determined_by_readings(entries)
    significant = [e.drive for e in determined if is_significant(calibration, e)]
    insignificant = [e.drive for e in determined if e.drive not in significant]
    if significant:
        findings.append(words.must_change(significant))
    if insignificant:
        findings.append(words.not_significant(insignificant, keep=keep))
    return findings


def _compensation_findings(
    calibration: Calibration, backlash: Sequence[BacklashEntry]
) -> list[Finding]:
    """Findings about backlash and periodic errors that the controller compensates.

    Args:
        calibration: The calibration.
        backlash: The backlash to enter.
    """
    session, screws = calibration.session, find_screws(calibration)
    effects = [*(["backlash"] if backlash else []), *(["screw"] if screws else [])]
    findings = [words.periodic_errors(screws)] if any(e.change.any() for e in screws) else []
    unstated = {
        split_label(setup.name, joined=bool(session.parts))[0]: None
        for setup in calibration.setups
        if not (session.compensation if setup.compensation is None else setup.compensation)
    }
    if effects and unstated:
        drives = calibration.robot.drives
        findings.append(words.compensation_not_stated(list(unstated), effects, drives))
    return findings


def is_significant(calibration: Calibration, entry: ControllerEntry) -> bool:
    """True if the best value differs from the active one by more than its uncertainty."""
    return not abs(entry.best_change) <= expanded_uncertainty(calibration, entry)


def _decide(
    findings: Sequence[Finding], *, firmware: bool, backlash: bool, choice: bool
) -> Decision:
    """Decision by the gravest finding; to enter the values if no finding is against it.

    Args:
        findings: All findings, the gravest first.
        firmware: Whether settings of a printer's firmware are calibrated.
        backlash: Whether there is backlash to enter.
        choice: Whether all identified errors may be corrected in place of the offsets.
    """
    verdict, lead = verdict_of(findings), findings[0]
    headlines = words.FIRMWARE_HEADLINES if firmware else words.HEADLINES
    if verdict != "enter":
        return Decision(verdict, headlines[verdict], lead.text, describe_actions(findings))
    kept = next(filter(None, (first_of(findings, kind) for kind in KEEPING)), None)
    if kept is not None:
        headline = words.FIRMWARE_KEEP_HEADLINE if firmware else KEEPING[kept.kind]
        if backlash and not firmware:
            headline = f"{headline} {words.BACKLASH_HEADLINE}"
        return Decision(verdict, headline, kept.text, kept.action)
    explanation = first_of(findings, *EXPLANATIONS)
    reason, action = ("", "") if explanation is None else (explanation.text, explanation.action)
    if firmware:
        return Decision(verdict, headlines[verdict], reason, words.FIRMWARE_STEP)
    if choice:
        return Decision(verdict, words.CHOICE_HEADLINE, reason, words.CHOICE_STEP)
    return Decision(verdict, headlines[verdict], reason, f"{words.NEXT_STEP} {action}".strip())
