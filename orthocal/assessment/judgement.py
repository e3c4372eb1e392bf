"""Judgement of sessions: the one place that decides whether readings can be trusted.

It depends on the readings and the robot alone. Every command that takes sessions, and every
calibration made from them, has the same verdict for the same readings by construction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array
from orthocal.assessment.effect_separability import find_unshown_effects
from orthocal.assessment.plausibility import (
    are_finer,
    find_finer,
    find_implausible,
    find_impossible_gauges,
    find_scattered,
)
from orthocal.assessment.words import plausibility as words
from orthocal.assessment.words.anomalies import describe_anomalies, describe_no_change
from orthocal.calibration.assessment_record import Finding, Severity, Verdict
from orthocal.estimation.tolerance_scale import AS_STATED, ToleranceScale
from orthocal.hypotheses.anomaly import Anomalies
from orthocal.hypotheses.families.sessions import detectable_changes
from orthocal.hypotheses.linear_model import LinearModel, ModelLinearisation, linear_model
from orthocal.hypotheses.search import find_anomalies
from orthocal.measurement.joining import split_sessions
from orthocal.session.session import Session
from orthocal.statistics.chance import chance_of_excess
from orthocal.statistics.noise import estimate_repeatability

RARE = 1e-3
"""Share of the machines within their tolerances that are called worse."""

LARGEST_SCALE = 4.0
"""Factor of the tolerances beyond which no machine in working order is."""

RESOLVED = 1e-3
"""Part of the noise by which one prior standard deviation of an offset must move the readings."""

SCALES = np.geomspace(1.0, 30.0, 86)
"""Factors of the tolerances that are tried."""

LARGEST_DEVIATION = 3.0
"""Standard deviations from its prediction beyond which a reading is doubtful."""

_GRAVITY: dict[Severity, int] = {"reject": 0, "review": 1, "note": 2}


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """Judgement of readings, independent of what is calibrated from them."""

    findings: tuple[Finding, ...]
    """The gravest first."""
    tolerance_scale: ToleranceScale
    """Factor by which the machine's errors exceed their tolerances; 1 if they do not."""

    @property
    def verdict(self) -> Verdict:
        """Verdict of the gravest finding."""
        return verdict_of(self.findings)


def verdict_of(findings: Sequence[Finding]) -> Verdict:
    """The verdict that findings amount to: that of the gravest."""
    severities = {f.severity for f in findings}
    return "reject" if "reject" in severities else "review" if "review" in severities else "enter"


def rank(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Findings, the gravest first, otherwise in their order."""
    return tuple(sorted(findings, key=lambda f: _GRAVITY[f.severity]))


def judge_session(session: Session, *, anomalies: Anomalies | None = None) -> Judgement:
    """Judge the readings of a session, or of several that were joined.

    Several models are calibrated from one session with one judgement, which `calibrate`, `assess`,
    `compare_models` and `check_session` receive.

    Args:
        session: The session.
        anomalies: Of its readings, if they are known already.

    Raises:
        ClosureError: If the machine cannot reach a posture.
        RobotError: If the closures of the robot depend on each other.
    """
    mistakes = _find_mistakes(session, anomalies)
    implausible = find_implausible(session, explained=bool(mistakes))
    scale, beyond = AS_STATED, []
    if verdict_of([*mistakes, *implausible]) == "enter":
        scale = find_tolerance_scale(session)
        if scale.factor > LARGEST_SCALE:
            printer = session.firmware is not None
            beyond = [words.beyond_tolerances(scale.factor, LARGEST_SCALE, firmware=printer)]
        elif scale.factor > 1.0:
            beyond = [words.above_tolerances(scale.factor)]
    unchanged = [] if mistakes or not session.joined else [_describe_detectable(session)]
    unshown = find_unshown_effects(session)
    return Judgement(rank([*implausible, *mistakes, *unchanged, *beyond, *unshown]), scale)


def find_warnings(session: Session) -> tuple[Finding, ...]:
    """Findings that a reading may cause while a session is measured, the gravest first.

    They are among those of `judge_session` for the same readings. The others, which concern the
    robot, the postures and the stated noise, do not depend on a single reading.

    Raises:
        ClosureError: If the machine cannot reach a posture.
        RobotError: If the closures of the robot depend on each other.
    """
    mistakes = _find_mistakes(session)
    return rank([*mistakes, *(() if mistakes else find_finer(session))])


def is_doubtful(session: Session, row: int, mean: float, std: float) -> bool:
    """True if a reading calls for `find_warnings` before its setup is complete.

    Args:
        session: The readings so far.
        row: Place of the reading.
        mean: Prediction of the reading by all others, [m]; NaN without one.
        std: Its standard deviation, [m].
    """
    gauge = session.gauges[session.setups[session.readings[row].setup].gauge]
    value = session.values[row]
    return is_far(value, mean, std) or bool(are_finer(value, gauge))


def is_far(value: float, mean: float, std: float) -> bool:
    """True if a reading contradicts its prediction by the others.

    Args:
        value: Reading, [m].
        mean: Its prediction, [m]; NaN without one.
        std: Its standard deviation, [m].
    """
    return bool(abs(value - mean) > LARGEST_DEVIATION * std)


def _find_mistakes(session: Session, anomalies: Anomalies | None = None) -> list[Finding]:
    """Anomalies of a session; without any, gauges whose repeated readings scatter too much.

    Nothing is sought if a gauge is impossible as stated, or if the anomalies are known.
    """
    if impossible := list(find_impossible_gauges(session)):
        return impossible
    findings = describe_anomalies(session, anomalies or find_anomalies(session))
    return findings or list(find_scattered(session))


def find_tolerance_scale(session: Session) -> ToleranceScale:
    """Factor by which the machine's errors exceed their tolerances, by maximum likelihood.

    Readings are y ~ N(h, e² J P Jᵀ + G + σ²) with P of all errors of the geometry but offsets, G of
    how gauges are mounted and of other effects. Offsets and gauge zeros are free: home switches are
    as far off as they are. σ is the stated noise, or the scatter of repeated readings if that is
    larger. 1 where one in a thousand machines within tolerances shows as much, or nothing is stated
    of the noise. Each independent contrast of the readings counts by the share of its variance that
    the machine's errors have.
    """
    scales = [AS_STATED]
    for part in split_sessions(session):
        if any(g.sigma is None for g in part.gauges.values()) or len(part.readings) < 2:
            continue
        model = linear_model(part)
        about = model.most_likely(part.values)
        deviation = model.entries(part.values[None])[0] - about.expected
        repeated, _ = estimate_repeatability(model.problem.values, model.problem.observations)
        noise = max(about.likelihood.sigma, repeated)
        within, excess, remainder, dof = _parts(model, about, deviation, noise)
        square = float((within**2 / (1.0 + excess)).sum()) + remainder
        if dof < 1 or chance_of_excess(square, dof) >= RARE:
            continue
        spread = 1.0 + SCALES[:, None] ** 2 * excess
        logs = (within**2 / spread + np.log(spread)).sum(axis=1)
        factor = float(SCALES[int(np.argmin(logs))])
        share = factor**2 * excess / (1.0 + factor**2 * excess)
        scales.append(ToleranceScale(factor, float((share**2).sum())))
    return max(scales, key=lambda s: s.factor)


def _parts(
    model: LinearModel, about: ModelLinearisation, deviation: Array, noise: float
) -> tuple[Array, Array, float, int]:
    """Independent parts of a deviation, offsets projected out.

    Returns:
        Parts over the standard deviation that noise and gauges leave, shape (n,); variances that
        the machine's errors at their tolerances add to the 1 of each, shape (n,); the sum of
        squares of what neither moves, over the noise; degrees of freedom of all.
    """
    directions, problem = about.likelihood.directions, model.problem
    along = directions @ deviation
    square = max(float(deviation @ deviation - along @ along), 0.0) / noise**2
    # change along each direction per prior std of each error, relative to the noise
    slopes = about.singular_values[:, None] * about.error_directions.T / noise
    known, n = problem.robot.parameters, problem.n_machine
    machine = slopes[:, :n]
    names = problem.free[:n]
    offset = np.array([known.are_offsets(name) for name in names], dtype=bool)
    scaled = np.array([known.are_scaled(name) for name in names], dtype=bool)
    basis, sizes, _ = np.linalg.svd(machine[:, offset])
    rank = int((sizes > RESOLVED).sum())
    contrasts = basis[:, rank:].T
    unscaled = np.column_stack([slopes[:, n:], machine[:, ~(offset | scaled)]])
    gauges, errors = contrasts @ unscaled, contrasts @ machine[:, scaled]
    root = np.linalg.cholesky(np.eye(len(contrasts)) + gauges @ gauges.T)
    white = np.linalg.solve(root, np.column_stack([contrasts @ along / noise, errors]))
    variances, turned = np.linalg.eigh(white[:, 1:] @ white[:, 1:].T)
    return turned.T @ white[:, 0], np.maximum(variances, 0.0), square, model.dof - rank


def _describe_detectable(session: Session) -> Finding:
    """The change of an offset between joined sessions that would have been detected."""
    sizes: dict[str, float] = {}
    unseen = []
    detectable = detectable_changes(session)
    for drive in session.robot.drives:
        size = detectable.get(drive.name, math.inf)
        if math.isinf(size):
            unseen.append(drive.name)
            continue
        p = session.robot.parameters[f"{drive.name}.offset"]
        sizes[p.edge_unit] = max(sizes.get(p.edge_unit, 0.0), size * p.edge_factor)
    return describe_no_change(sizes, unseen)
