"""Validation of a calibration by a new session, as the paper's third experiment.

The new session is taken with the identified offsets active in the controller. If the calibration
is right, the deviations it shows are those that the calibration expected, and a further fit would
change nothing.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthocal.arguments import require_kind
from orthocal.assessment.controller_entries import find_entries
from orthocal.assessment.entry_mistakes import EnteringMistake, find_mistake
from orthocal.assessment.judgement import Judgement, judge_session, rank, verdict_of
from orthocal.assessment.predictive import Expectation, expect
from orthocal.assessment.repetition import Repetition, measure_repetition
from orthocal.assessment.words import validation as words
from orthocal.calibration.assessment_record import (
    Assessment,
    ControllerEntry,
    Decision,
    Finding,
    Place,
)
from orthocal.calibration.build_record import assemble_calibration
from orthocal.calibration.calibration import Calibration
from orthocal.calibration.refit import repeat_fit, restore_gauge_covariance
from orthocal.errors import SessionError
from orthocal.estimation.diagnostics.residual_rows import ResidualRow
from orthocal.estimation.fit import Fit
from orthocal.measurement.joining import Given, gather_sessions, join_sessions
from orthocal.session.session import Session
from orthocal.statistics.chance import BY_CHANCE, confidence_factor
from orthocal.statistics.distributions import f_tail
from orthocal.statistics.zeros import project_out_zeros
from orthocal.units import MM, InUnit, Unit

Array = NDArray[np.float64]

FEWEST = 5.0
"""Degrees of freedom below which what does not repeat of two sessions is not known."""

REMOVED = 0.7
"""Part of the deviations below which a fit of the new readings is said to remove them."""

MOST_NAMED = 3
"""Parameters that are named of those that change most."""

CHANGE_CHANCE = 0.05
"""Probability that any parameter of a calibration that is right is said to change."""


@dataclass(frozen=True, slots=True, eq=False)
class FurtherChange(InUnit):
    """What a further fit would still change in one parameter."""

    name: str
    unit: Unit
    change: float
    """[unit]."""
    std: float
    """Standard deviation of the change: both sessions know the parameter only so well, [unit]."""
    significant: bool
    """Whether it is outside the interval around 0 that holds all changes together with 95 %."""


@dataclass(frozen=True, slots=True, eq=False)
class Validation:
    """A new session held against what a calibration expected."""

    title: str
    offsets_stated: bool
    """Whether the session says which offsets were active; else the identified ones are taken."""
    expected_rms: float
    """Of the residuals of the calibration, with what readings are off for how gauges stood, [m]."""
    expected_largest: float
    achieved_rms: float
    """Of the deviations in the new session, [m]."""
    achieved_largest: float
    refit_rms: float
    """What a further fit would leave, [m]."""
    refit_largest: float
    excess_probability: float
    """Probability that the achieved sum of squares would be as large by chance (F test); NaN if
    the calibration had no readings to spare."""
    changes: tuple[FurtherChange, ...]
    mistake: EnteringMistake | None
    """What seems to have gone wrong in entering; None where nothing did, or nothing explains it."""
    enter: tuple[ControllerEntry, ...]
    """What belongs into the controller: as it was, where a mistake explains the readings or nothing
    is to change; else what the new readings say, with their session."""
    repetition: Repetition
    """Whether what both fits leave is the same."""
    rows: tuple[ResidualRow, ...]
    """Rows of the new session: nominal is the machine as the controller knows it."""
    judgement: Judgement
    """Of the new readings, whatever the calibration is."""

    @property
    def as_expected(self) -> bool | None:
        """Whether the achieved deviations are no larger than expected, but for chance.

        None if the calibration had no readings to spare: then it expected nothing.
        """
        if math.isnan(self.excess_probability):
            return None
        return self.excess_probability >= BY_CHANCE

    @property
    def confirmed(self) -> bool | None:
        """Whether the calibration is confirmed; None if it expected nothing."""
        if self.as_expected is None:
            return None
        return self.as_expected and self.nothing_to_change

    @property
    def nothing_to_change(self) -> bool:
        """Whether no parameter would change beyond its standard error."""
        return not any(c.significant for c in self.changes)

    @property
    def assessment(self) -> Assessment:
        """The decision: whether the calibration is confirmed, and what to do."""
        return _assess(self)

    def to_json(self) -> str:
        """As JSON, SI units."""

        def number(value: float) -> float | None:
            return value if math.isfinite(value) else None

        document = {
            "schema": "orthocal/validation/2",
            "title": self.title,
            "offsets_stated": self.offsets_stated,
            "expected_rms": self.expected_rms,
            "expected_largest": self.expected_largest,
            "achieved_rms": self.achieved_rms,
            "achieved_largest": self.achieved_largest,
            "refit_rms": self.refit_rms,
            "refit_largest": self.refit_largest,
            "as_expected": self.as_expected,
            "excess_probability": number(self.excess_probability),
            "nothing_to_change": self.nothing_to_change,
            "changes": [
                {
                    "name": c.name,
                    "unit": c.unit,
                    "change": c.change,
                    "std": number(c.std),
                    "significant": c.significant,
                }
                for c in self.changes
            ],
            "mistake": None
            if self.mistake is None
            else {
                "kind": self.mistake.kind,
                "drives": list(self.mistake.drives),
                "active": self.mistake.active.tolist(),
                "by": list(self.mistake.by),
                "rms": self.mistake.rms,
            },
            "enter": [{"drive": e.drive, "unit": e.unit, "value": e.enter} for e in self.enter],
            **self.repetition.to_document(),
        }
        return json.dumps(document, indent=1, allow_nan=False) + "\n"


def validate_calibration(calibration: Calibration, sessions: Given | Sequence[Given]) -> Validation:
    """Hold a new session, or several, against a calibration.

    Args:
        calibration: The calibration whose offsets were entered.
        sessions: Taken afterwards, with its offsets active in the controller. Where a session
            does not state its controller's offsets, they are taken to be the identified ones.

    Raises:
        SessionError: If the session is of another robot, or states offsets of another calibration.
        NotIdentifiableError: If the session does not determine the parameters.
        SolverError: If a further fit does not converge.
    """
    require_kind(calibration, Calibration, expected="a Calibration, such as load_calibration(...)")
    given = gather_sessions(sessions)
    session = join_sessions([_entered(calibration, one) for one in given])
    entries = find_entries(calibration)
    fit = repeat_fit(calibration, session)
    stood = restore_gauge_covariance(calibration), fit.gauge_covariance
    refit = assemble_calibration(fit, nominal=np.array([p.value for p in calibration.free]))
    differ = _gauges_differ(fit, refit, stood)
    more = math.hypot(calibration.rms_after, differ) / (calibration.rms_after or math.nan)
    repetition = measure_repetition(calibration, refit)
    expected = expect(calibration, fit, stood=stood[0])
    if calibration.prior:  # residuals beside a prior are few, and expect nothing
        excess = expected.chance(sigma_dof=calibration.noise.dof)
    else:
        excess = _excess_probability(calibration, fit, refit, stood)
    found = Validation(
        title=session.title,
        offsets_stated=all(one.controller_offsets is not None for one in given),
        expected_rms=math.hypot(calibration.rms_after, differ),
        expected_largest=more * calibration.largest_after if math.isfinite(more) else differ,
        achieved_rms=refit.rms_before,
        achieved_largest=refit.largest_before,
        refit_rms=refit.rms_after,
        refit_largest=refit.largest_after,
        excess_probability=excess,
        changes=_further_changes(calibration, refit, repetition, stood),
        mistake=None,
        enter=entries,
        repetition=repetition,
        rows=refit.residuals,
        judgement=judge_session(session),
    )
    if found.confirmed is not False:
        return found
    mistake = _find_mistake(calibration, expected, repetition)
    slip = mistake is not None and mistake.kind != "one differs"
    enter = entries if slip else find_entries(refit)
    return replace(found, mistake=mistake, enter=enter)


def _assess(validation: Validation) -> Assessment:
    """The judgement of the new readings, and what they say of the calibration."""
    lead = _agreement(validation)
    causes = _causes(validation)
    findings = rank(
        [
            *validation.judgement.findings,
            lead,
            *causes,
            _repetition(validation),
            *([] if validation.offsets_stated else [words.controller_assumed()]),
        ]
    )
    headlines = {True: words.CONFIRMED, False: words.NOT_CONFIRMED, None: words.UNKNOWN}
    verdict = verdict_of(findings)
    anomaly = next((f for f in validation.judgement.findings if f.severity != "note"), None)
    reason = " ".join(f.text for f in (lead, *causes))
    action = causes[0].action if causes else lead.action
    if anomaly is not None:
        reason, action = f"{anomaly.text} {reason}", anomaly.action
    return Assessment(
        decision=Decision(verdict, headlines[validation.confirmed], reason, action),
        findings=findings,
        entries=validation.enter,
        tool=None,
        tolerance_scale=validation.judgement.tolerance_scale,
    )


def _agreement(validation: Validation) -> Finding:
    """Whether the deviations are those that were predicted."""
    achieved, expected = validation.achieved_rms, validation.expected_rms
    numbers = {
        "expected_rms_mm": expected / MM,
        "achieved_rms_mm": achieved / MM,
        "refit_rms_mm": validation.refit_rms / MM,
        "chance": validation.excess_probability,
    }
    if validation.as_expected is None:
        return words.nothing_predicted(numbers)
    if not validation.as_expected:
        worst = max(validation.rows, key=lambda r: abs(r.deviation))
        place = Place(line=worst.line, setup=worst.setup, posture=worst.postures)
        return words.larger_than_predicted(achieved, expected, numbers, [place])
    if validation.nothing_to_change:
        return words.confirmed(achieved, expected, numbers)
    changed = [c.name for c in validation.changes if c.significant]
    return words.further_change(changed, numbers, explained=validation.mistake is not None)


def _causes(validation: Validation) -> list[Finding]:
    """What may have happened if the calibration is not confirmed."""
    if validation.confirmed is not False:
        return []
    mistake = validation.mistake
    if mistake is not None:
        numbers = _mistake_numbers(validation, mistake)
        if mistake.kind == "one differs":
            entry = next(e for e in validation.enter if e.drive == mistake.drives[0])
            return [words.one_differs(entry, mistake.by[0], mistake.rms, numbers)]
        return [
            words.slip(
                mistake.kind,
                mistake.drives,
                mistake.rms,
                numbers,
                all_drives=mistake.all_drives,
            )
        ]
    if validation.as_expected:
        return []
    if validation.refit_rms < REMOVED * validation.achieved_rms:
        largest = sorted(validation.changes, key=lambda c: -abs(c.change) / max(c.std, 1e-300))
        names = [c.name for c in largest[:MOST_NAMED]]
        significant = any(c.significant for c in largest)
        return [words.geometry_changed(validation.refit_rms, names, significant=significant)]
    return [words.not_the_offsets()]


def _mistake_numbers(validation: Validation, mistake: EnteringMistake) -> dict[str, float]:
    """Controller values less those to be entered, drive by drive, and the residual."""
    units = {e.drive: (e.edge_factor, e.edge_unit.replace("°", "deg")) for e in validation.enter}
    found = {"left_rms_mm": mistake.rms / MM}
    for drive, by in zip(mistake.drives, mistake.by, strict=True):
        factor, unit = units.get(drive, (1.0, "si"))
        found[f"{drive}_by_{unit}"] = by * factor
    return found


def _repetition(validation: Validation) -> Finding:
    """Whether the residuals are the same in both sessions."""
    found = validation.repetition
    if found.repeats is None:
        return words.repetition_unknown(found.untold)
    if found.repeats:
        return words.residuals_repeat(found.correlation, found.matched, found.chance)
    return words.residuals_differ(
        found.correlation, found.matched, found.chance, new=validation.as_expected is False
    )


def _entered(calibration: Calibration, session: Session) -> Session:
    """A new session with the offsets that were active: as it states, or as identified."""
    if session.robot.sha256 != calibration.robot_record.sha256:
        raise SessionError(
            f"is of robot '{session.robot.name}'; the calibration is of another, or of another "
            f"version of '{calibration.robot_record.name}'",
            where=None if session.path is None else str(session.path),
        )
    if session.controller_offsets is not None:
        _require_offsets(calibration, session)
        return session
    by_drive = {e.drive: e.enter for e in find_entries(calibration)}
    if not by_drive:
        return session
    offsets = [by_drive.get(d.name, 0.0) for d in session.robot.drives]
    return session.with_controller(np.array(offsets))


def _find_mistake(
    calibration: Calibration, expected: Expectation, repetition: Repetition
) -> EnteringMistake | None:
    """The mistake in entering offsets that explains a session, if one does."""
    if not expected.sigma > 0.0:
        return None
    problem = expected.fit.problem
    session, drives = problem.session, problem.robot.drives
    offsets = {i: f"{d.name}.offset" for i, d in enumerate(drives)}
    told = {i: name for i, name in offsets.items() if name in problem.free}
    slopes = np.zeros((problem.observations.size, len(drives)))
    for i, name in told.items():
        k = problem.free.index(name)
        slopes[:, i] = expected.slopes[:, k] / problem.theta_scale[k]
    entries = {e.drive: e for e in find_entries(calibration)}
    identified, scatter = (
        np.array([getattr(entries[d.name], key) if d.name in entries else 0.0 for d in drives])
        for key in ("identified", "std_scatter")
    )
    share = _share_that_is_new(calibration, repetition, expected.sigma)

    def deviate(active: Array) -> Array:
        missing = session.active_offsets - active
        return expected.deviations(more={name: missing[i] for i, name in told.items()})

    return find_mistake(
        deviate,
        slopes,
        spread=expected.spread(share=share),
        sigma=share * expected.sigma,
        model_sigma=expected.sigma,
        model_dof=calibration.noise.residual_dof,
        dof=expected.dof,
        before=calibration.active_offsets,
        identified=identified,
        entered=session.active_offsets,
        names=tuple(d.name for d in drives),
        rounding=np.nan_to_num(scatter),
    )


def _share_that_is_new(calibration: Calibration, repetition: Repetition, sigma: float) -> float:
    """Part of σ that differs from session to session: errors of the model repeat.

    1 where the readings do not tell.
    """
    if calibration.prior or not repetition.scatter_dof >= FEWEST:
        return 1.0
    return min(repetition.scatter / sigma, 1.0)


def _further_changes(
    calibration: Calibration, refit: Calibration, repetition: Repetition, stood: Sequence[Array]
) -> tuple[FurtherChange, ...]:
    """New less old estimates, against the standard error of the difference of the two.

    What repeats in both sessions, as errors of the model do, moves both estimates alike: where the
    readings tell how much does not repeat, only that counts, and how the gauges stood, each time
    otherwise.
    """
    pairs = list(zip(calibration.free, refit.free, strict=True))
    scale, dof = (1.0, 1.0), min(calibration.dof, refit.dof)
    if not calibration.prior and repetition.scatter_dof >= FEWEST:
        scatter = repetition.scatter
        scale = (min(scatter / calibration.sigma, 1.0), min(scatter / refit.sigma, 1.0))
        dof = repetition.scatter_dof
    # so many chances to be wrong by chance: each gets its share
    factor = confidence_factor(dof, 1.0 - CHANGE_CHANCE / len(pairs))
    changes = []
    variances = np.maximum([np.diag(g) for g in stood], 0.0).T
    for pair, by_gauges in zip(pairs, variances.tolist(), strict=True):
        old, new = pair
        change = new.value - old.value
        scattered = (
            share**2 * max(p.std**2 - g, 0.0)
            for p, g, share in zip(pair, by_gauges, scale, strict=True)
        )
        std = math.sqrt(sum(scattered) + sum(by_gauges))
        changes.append(FurtherChange(new.name, new.unit, change, std, abs(change) > factor * std))
    return tuple(changes)


def _require_offsets(calibration: Calibration, session: Session) -> None:
    """The offsets that a session states must be those of the calibration, up to rounding."""
    drives = [d.name for d in session.robot.drives]
    others, where = [], ""
    for entry in find_entries(calibration):
        stated = float(session.active_offsets[drives.index(entry.drive)])
        allowed = max(0.5 * entry.std_scatter, 0.02e-3)
        if not math.isnan(allowed) and abs(stated - entry.enter) > allowed:
            factor, unit = entry.edge_factor, entry.edge_unit
            where = f"{session.path or 'session'}: controller.offsets_{unit}"
            others.append(
                f"{entry.drive} has {stated * factor:g} {unit} where the calibration says to enter "
                f"{entry.enter * factor:.3f} {unit}"
            )
    if others:
        raise SessionError(
            f"{'; '.join(others)}. A validation needs a session that was measured with what the "
            "calibration says to enter",
            where=where,
        )


def _gauges_differ(fit: Fit, refit: Calibration, stood: Sequence[Array]) -> float:
    """What rows of the new session are off for how the gauges stood, then and now, r.m.s., [m]."""
    rows = refit.residuals
    gram = _gauge_gram(fit, stood)
    of_differences = sum(2.0 if r.minus else 1.0 for r in rows) / len(rows)
    return math.sqrt(of_differences * max(float(np.trace(gram)), 0.0) / len(rows))


def _gauge_gram(fit: Fit, stood: Sequence[Array]) -> Array:
    """Of readings, zeros eliminated, what parameters are off for how gauges stood: its Gram matrix.

    Shape (n_machine, n_machine); its trace is the sum of squares that it makes, [m²].
    """
    problem, n = fit.problem, fit.problem.n_machine
    scaled = fit.jacobian[:, :n] / problem.theta_scale[:n]
    slopes = project_out_zeros(scaled, problem.observations)
    return np.asarray(slopes.T @ slopes @ sum(stood))


def _excess_probability(
    calibration: Calibration, fit: Fit, refit: Calibration, stood: Sequence[Array]
) -> float:
    """Upper tail of the ratio of achieved to expected mean squares.

    Expected is what the calibration left, once more for what it did not know of its parameters,
    and what both are off for how the gauges stood; that is of a few directions, which counts for
    as few degrees of freedom (Satterthwaite).
    """
    expected = calibration.noise.residual_sigma
    dof = calibration.noise.residual_dof
    if not (expected > 0.0 and dof > 0.0):
        return math.nan
    rows = refit.residuals
    zeros = len({r.setup for r in rows if r.minus is None})
    achieved = sum(r.deviation**2 / (2.0 if r.minus else 1.0) for r in rows)
    count = len(rows) - zeros
    each = expected**2 * (1.0 + (count - refit.noise.residual_dof) / count)
    gram = _gauge_gram(fit, stood)
    mean = each + float(np.trace(gram)) / count
    square = count * each**2 + 2.0 * each * float(np.trace(gram)) + float(np.trace(gram @ gram))
    independent = (count * mean) ** 2 / square
    return f_tail(independent, dof, achieved / count / mean)
