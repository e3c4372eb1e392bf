"""Judgement of sessions: the one place that decides whether readings can be trusted.

It depends on the readings and the robot alone. Every command that takes sessions, and every
calibration made from them, has the same verdict for the same readings by construction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
from orthocal.hypotheses.reading_model import Linearised, ReadingModel
from orthocal.hypotheses.search import find_mistakes
from orthocal.hypotheses.sessions.changes import find_session_changes
from orthocal.measurement.joining import split_sessions
from orthocal.session.session import Session
from orthocal.statistics.chance import chance_of_excess
from orthocal.statistics.noise import estimate_repeatability

Array = NDArray[np.float64]

RARE = 0.01
"""Share of the machines within their tolerances that are called worse."""

LARGEST_SCALE = 4.0
"""Factor of the tolerances beyond which no machine in working order is."""

RESOLVED = 1e-3
"""Part of the noise by which one prior standard deviation of an offset must move the readings."""

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

    Readings are y ~ N(h, e² J P Jᵀ + G + σ²) with P of all errors but offsets, G of how gauges are
    mounted. Offsets and gauge zeros are free: home switches are as far off as they are. σ is the
    stated noise, or the scatter of repeated readings if that is larger. 1 where one in a hundred
    machines within tolerances shows as much, or nothing is stated of the noise.
    """
    scales = [1.0]
    for part in split_sessions(session):
        if any(g.sigma is None for g in part.gauges.values()) or len(part.readings) < 2:
            continue
        model = ReadingModel(part)
        about = model.most_likely(part.values)
        deviation = model.deviations(part.values[None], about)[0]
        repeated, _ = estimate_repeatability(model.problem.values, model.problem.observations)
        noise = max(about.likelihood.sigma, repeated)
        within, excess, rest, dof = _parts(model, about, deviation, noise)
        square = float((within**2 / (1.0 + excess)).sum()) + rest
        if dof < 1 or chance_of_excess(square, dof) >= RARE:
            continue
        spread = 1.0 + SCALES[:, None] ** 2 * excess
        logs = (within**2 / spread + np.log(spread)).sum(axis=1)
        scales.append(float(SCALES[int(np.argmin(logs))]))
    return max(scales)


def _parts(
    model: ReadingModel, about: Linearised, deviation: Array, noise: float
) -> tuple[Array, Array, float, int]:
    """Independent parts of a deviation, offsets taken out.

    Returns:
        Parts over the standard deviation that noise and gauges leave, shape (n,); variances that
        the machine's errors at their tolerances add to the 1 of each, shape (n,); the sum of
        squares of what neither moves, over the noise; degrees of freedom of all.
    """
    directions, problem = about.likelihood.directions, model.problem
    along = directions @ deviation
    rest = max(float(deviation @ deviation - along @ along), 0.0) / noise**2
    slopes = about.sizes[:, None] * about.errors.T / noise  # along each direction, by each error
    known, n = problem.robot.parameters, problem.n_machine
    machine = slopes[:, :n]
    offset = np.array([known.are_offsets(name) for name in problem.free[:n]], dtype=bool)
    basis, sizes, _ = np.linalg.svd(machine[:, offset])
    rank = int((sizes > RESOLVED).sum())
    kept = basis[:, rank:].T
    gauges, errors = kept @ slopes[:, n:], kept @ machine[:, ~offset]
    root = np.linalg.cholesky(np.eye(len(kept)) + gauges @ gauges.T)
    white = np.linalg.solve(root, np.column_stack([kept @ along / noise, errors]))
    variances, turned = np.linalg.eigh(white[:, 1:] @ white[:, 1:].T)
    return turned.T @ white[:, 0], np.maximum(variances, 0.0), rest, model.dof - rank


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
