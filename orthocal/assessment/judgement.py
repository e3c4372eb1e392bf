"""Judgement of sessions: the one place that decides whether readings can be trusted.

It depends on the readings and the robot alone. Every command that takes sessions, and every
calibration made from them, has the same verdict for the same readings by construction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.assessment.plausibility import find_implausible, find_scattered
from orthocal.assessment.words import plausibility as words
from orthocal.assessment.words.readings import describe_mistake
from orthocal.assessment.words.sessions import describe_changes
from orthocal.calibration.assessment_record import Finding, Severity, Verdict
from orthocal.errors import OrthocalError
from orthocal.estimation.diagnostics.unmodelled import find_other_errors, machine_errors
from orthocal.estimation.fit import fit_problem
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import build_problem
from orthocal.hypotheses.reading_model import ReadingModel
from orthocal.hypotheses.search import find_mistakes
from orthocal.hypotheses.sessions.changes import find_session_changes
from orthocal.measurement.joining import split_sessions
from orthocal.session.session import Session
from orthocal.statistics.chance import chance_of_excess

RARE = 0.01
"""Share of the machines within their tolerances that are called worse."""

LARGEST_SCALE = 4.0
"""Factor of the tolerances beyond which no machine in working order is."""

SCALES = np.geomspace(1.0, 30.0, 86)
"""Factors of the tolerances that are tried."""

EXPLAINED = ("finer than the gauge", "residuals too small", "scattered repeats", "sigma too large")
"""Kinds that an anomaly with a name explains."""

_GRAVITY: dict[Severity, int] = {"reject": 0, "review": 1, "note": 2}


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """What readings show, whatever is calibrated from them."""

    findings: tuple[Finding, ...]
    """The gravest first."""
    tolerance_scale: float
    """Factor by which the machine's errors exceed their tolerances; 1 if they do not."""

    @property
    def verdict(self) -> Verdict:
        """What the gravest finding asks for."""
        return verdict_of(self.findings)


def verdict_of(findings: Sequence[Finding]) -> Verdict:
    """The verdict that findings amount to: that of the gravest."""
    severities = {f.severity for f in findings}
    return "reject" if "reject" in severities else "review" if "review" in severities else "enter"


def rank(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Findings, the gravest first, otherwise in their order."""
    return tuple(sorted(findings, key=lambda f: _GRAVITY[f.severity]))


def judge_session(session: Session) -> Judgement:
    """Judge the readings of a session, or of several that were joined.

    Raises:
        ClosureError: If the machine cannot reach a posture.
        RobotError: If the closures of the robot depend on each other.
    """
    anomalies = [
        describe_mistake(part, mistake)
        for part in split_sessions(session)
        for mistake in find_mistakes(part)
    ]
    if not anomalies:
        anomalies = list(find_scattered(session))
    changes = _find_changes(session)
    implausible = [f for f in find_implausible(session) if not (anomalies and f.kind in EXPLAINED)]
    scale, beyond = 1.0, []
    if verdict_of([*anomalies, *changes, *implausible]) == "enter":
        scale = find_tolerance_scale(session)
        if scale > LARGEST_SCALE:
            beyond = [words.beyond_tolerances(scale, LARGEST_SCALE)]
        elif scale > 1.0:
            beyond = [words.above_tolerances(scale)]
    return Judgement(rank([*implausible, *anomalies, *changes, *beyond]), scale)


def find_tolerance_scale(session: Session) -> float:
    """Factor by which the machine's errors exceed their tolerances, by maximum likelihood.

    Readings are y ~ N(h, e² J P Jᵀ + σ²), gauge zeros free, with the stated noise. 1 where one in a
    hundred machines within tolerances shows as much, or nothing is stated of the noise.
    """
    scales = [1.0]
    for part in split_sessions(session):
        if any(g.sigma is None for g in part.gauges.values()) or len(part.readings) < 2:
            continue
        model = ReadingModel(part)
        about = model.most_likely(part.values)
        deviation = model.deviations(part.values[None], about)[0]
        directions, noise = about.likelihood.directions, about.likelihood.sigma**2
        along, variances = directions @ deviation, about.likelihood.variances
        rest = max(float(deviation @ deviation - along @ along), 0.0)
        square = float((along**2 / (variances + noise)).sum()) + rest / noise
        if model.dof < 1 or chance_of_excess(square, model.dof) >= RARE:
            continue
        spread = SCALES[:, None] ** 2 * variances + noise
        logs = (along**2 / spread + np.log(spread)).sum(axis=1)
        scales.append(float(SCALES[int(np.argmin(logs))]))
    return max(scales)


def _find_changes(session: Session) -> list[Finding]:
    """Changes of the machine between sessions that were joined."""
    if not session.joined:
        return []
    try:
        problem = build_problem(session, free=machine_errors(session.robot), prior=True)
        fit = fit_problem(problem, options=SolverOptions(solver="eliminated"))
        changes = find_session_changes(fit, find_other_errors(fit))
    except (OrthocalError, np.linalg.LinAlgError):
        return []
    return [] if changes is None else [describe_changes(session, changes)]
