"""Judgement of sessions: decides whether readings can be trusted.

It depends on the readings and the robot alone. Therefore all commands and calibrations have the
same verdict for the same readings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.arguments import require_kind
from orthocal.arrays import Array
from orthocal.assessment.effect_separability import find_unshown_effects
from orthocal.assessment.exchanged_sides import weigh_exchanged_sides
from orthocal.assessment.plausibility import (
    are_finer,
    find_finer,
    find_implausible,
    find_impossible_gauges,
)
from orthocal.assessment.repeated_readings import find_scattered
from orthocal.assessment.words import plausibility as words
from orthocal.assessment.words.anomalies import (
    Correction,
    describe_anomalies,
    describe_no_change,
    describe_wrong_order,
    describe_wrong_time,
    place_of,
)
from orthocal.calibration.assessment_record import Finding, Severity, Verdict
from orthocal.estimation.tolerance_scale import AS_STATED, ToleranceScale, trial_scales
from orthocal.hypotheses.anomaly import Anomaly
from orthocal.hypotheses.families.sessions import detectable_changes
from orthocal.hypotheses.linear_model import LinearModel, linear_model
from orthocal.hypotheses.linearisation import ModelLinearisation
from orthocal.hypotheses.search import find_anomalies, find_suspected_rows
from orthocal.measurement.joining import split_sessions
from orthocal.robot.parameters import Parameter
from orthocal.session.completeness import require_complete
from orthocal.session.session import Session
from orthocal.statistics.chance import chance_of_excess
from orthocal.statistics.noise import estimate_repeatability

FALSE_ALARM_RATE = 1e-3
"""Probability that a machine within its tolerances is judged to exceed them."""

LARGEST_SCALE = 4.0
"""Tolerance scale above which the readings are rejected: no machine in working order has it."""

OUTSTANDING_ERROR = 5.0
"""Error of a parameter, in prior standard deviations, that may alone make readings implausible."""

OUTSTANDING_SHARE = 0.6
"""Share of the sum of squared errors, in prior standard deviations, that such an error has."""

MAX_SUSPECTED = 6
"""Most readings that are named as the likeliest to be wrong."""

RESOLVED = 1e-3
"""Effect of one prior standard deviation of an offset on the readings, relative to the noise, below
which the offset is not resolved."""

TRIAL_SCALES = trial_scales(1.0, 30.0)
"""Tolerance scales whose likelihoods are compared."""

LARGEST_DEVIATION = 3.0
"""Standard deviations between a reading and its prediction above which it is doubtful."""

_GRAVITY: dict[Severity, int] = {"reject": 0, "review": 1, "note": 2}


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """Judgement of readings, independent of what is calibrated from them."""

    findings: tuple[Finding, ...]
    """Findings, the gravest first."""
    tolerance_scale: ToleranceScale
    """Factor by which the machine's errors exceed their tolerances; 1 if they do not."""
    values: Array | None = None
    """Readings that were judged, shape (n_readings,), [m]; None for any readings."""
    anomalies: tuple[Anomaly, ...] = ()
    """Anomalies behind the findings."""

    @property
    def verdict(self) -> Verdict:
        """Verdict of the gravest finding."""
        return verdict_of(self.findings)


def judgement_of(session: Session, judgement: Judgement | None) -> Judgement:
    """Judgement of a session: the one that was computed already, or a new one.

    Raises:
        TypeError: If the argument is of another kind.
        ValueError: If the judgement is of other readings.
        OrthocalError: As for `judge_session`.
    """
    if judgement is None:
        return judge_session(session)
    require_kind(judgement, Judgement, expected="a Judgement, as judge_session returns")
    values = judgement.values
    if values is not None and not np.array_equal(values, session.values, equal_nan=True):
        raise ValueError("judgement: found one of other readings; expected that of the session")
    return judgement


def verdict_of(findings: Sequence[Finding]) -> Verdict:
    """Verdict of the gravest of some findings."""
    severities = {f.severity for f in findings}
    return "reject" if "reject" in severities else "review" if "review" in severities else "enter"


def rank(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Sort findings, the gravest first; others keep their order."""
    return tuple(sorted(findings, key=lambda f: _GRAVITY[f.severity]))


def judge_session(session: Session) -> Judgement:
    """Judge the readings of a session, or of several that were joined.

    The judgement does not depend on the model. `calibrate`, `assess`, `compare_models` and
    `check_session` accept it to save time.

    Args:
        session: The session.

    Raises:
        ClosureError: If the machine cannot reach a posture.
        RobotError: If the closures of the robot depend on each other.
        SessionError: If the session cannot be calibrated; see `require_complete`.
    """
    require_kind(session, Session, expected="a Session, as load_session returns")
    require_complete(session)
    mistakes, anomalies = _find_mistakes(session)
    implausible = find_implausible(session, explained=bool(mistakes))
    if any(f.kind == "wrong dimensions" for f in implausible):
        implausible = _explain_dimensions(session, implausible, anomalies)
    scale, scale_findings = AS_STATED, []
    if verdict_of([*mistakes, *implausible]) == "enter":
        scale = find_tolerance_scale(session)
        if scale.factor > LARGEST_SCALE:
            scale_findings = [_describe_beyond(session, scale.factor)]
        elif scale.factor > 1.0:
            scale_findings = [words.above_tolerances(scale.factor)]
    sound = verdict_of([*mistakes, *implausible, *scale_findings]) == "enter"
    no_change = [_describe_detectable(session)] if session.joined and sound else []
    order = _describe_order(session) if session.joined else []
    unshown_effects = find_unshown_effects(session)
    return Judgement(
        rank([*implausible, *mistakes, *order, *no_change, *scale_findings, *unshown_effects]),
        scale,
        session.values,
        anomalies,
    )


def find_warnings(session: Session) -> tuple[Finding, ...]:
    """Findings that a single reading can cause while a session is measured, the gravest first.

    They are a part of those of `judge_session`. The others concern the robot, the postures and the
    stated noise.

    Raises:
        ClosureError: If the machine cannot reach a posture.
        RobotError: If the closures of the robot depend on each other.
    """
    mistakes, _ = _find_mistakes(session)
    finer = [] if mistakes else [f for f in find_finer(session) if f.severity != "note"]
    return rank([*mistakes, *finer])


def is_doubtful(session: Session, row: int, mean: float, std: float) -> bool:
    """True if `find_warnings` is needed after a reading, before its setup is complete.

    Args:
        session: The readings so far.
        row: Index of the reading.
        mean: Prediction of the reading by all others, [m]; NaN if there is none.
        std: Standard deviation of the prediction, [m].
    """
    gauge = session.gauges[session.setups[session.readings[row].setup].gauge]
    value = session.values[row]
    return is_far(value, mean, std) or bool(are_finer(value, gauge))


def is_far(value: float, mean: float, std: float) -> bool:
    """True if a reading contradicts its prediction by the other readings.

    Args:
        value: Reading, [m].
        mean: Prediction of the reading, [m]; NaN if there is none.
        std: Standard deviation of the prediction, [m].
    """
    return bool(abs(value - mean) > LARGEST_DEVIATION * std)


def _find_mistakes(session: Session) -> tuple[list[Finding], tuple[Anomaly, ...]]:
    """Findings about anomalies and exchanged sides of approach, and the anomalies.

    Without anomalies the findings are about readings that do not repeat. If a gauge is impossible
    as stated, they are about gauges alone. But readings in another unit are multiples of a coarser
    step, too.
    """
    impossible = list(find_impossible_gauges(session))
    if any(f.kind != "resolution too fine" for f in impossible):
        return impossible, ()
    result, exchanged = weigh_exchanged_sides(session, find_anomalies(session))
    findings = describe_anomalies(session, result)
    if impossible and not any(f.kind in ("decimal point", "wrong unit") for f in findings):
        return impossible, ()
    return [*(findings or find_scattered(session)), *exchanged], result.found


def find_tolerance_scale(session: Session) -> ToleranceScale:
    """Tolerance scale of a machine by maximum likelihood.

    Readings are y ~ N(h, s² J P Jᵀ + G + σ² I) with the tolerance scale s, the prior covariance P
    of errors of the geometry except offsets, and the covariance G from mountings and other effects.
    Offsets and gauge zeros have no prior: their errors may have any size. σ is the stated noise, or
    the scatter of repeated readings if that is larger.

    s is 1 if the noise is not stated, or if the deviation is not significant
    (FALSE_ALARM_RATE). Degrees of freedom are the sum of squared shares of the machine's errors in
    the variances of the independent contrasts. Of several sessions the largest s counts.
    """
    scales = [AS_STATED]
    for part in split_sessions(session):
        if len(part.readings) < 2:
            continue
        model = linear_model(part)
        if not model.stated:
            continue
        linearisation = model.most_likely(part.values)
        deviation = model.entries(part.values[None])[0] - linearisation.expected
        values = model.problem.observations.values(part.values) / model.problem.noise_ratio
        scatter, _ = estimate_repeatability(values, model.problem.observations)
        noise = max(linearisation.likelihood.sigma, scatter)
        contrasts, machine_variances, rest_square, dof = _independent_contrasts(
            model, linearisation, deviation, noise
        )
        square = float((contrasts**2 / (1.0 + machine_variances)).sum()) + rest_square
        if dof < 1 or chance_of_excess(square, dof) >= FALSE_ALARM_RATE:
            continue
        variances = 1.0 + TRIAL_SCALES[:, None] ** 2 * machine_variances
        costs = (contrasts**2 / variances + np.log(variances)).sum(axis=1)
        factor = float(TRIAL_SCALES[int(np.argmin(costs))])
        share = factor**2 * machine_variances / (1.0 + factor**2 * machine_variances)
        scales.append(ToleranceScale(factor, float((share**2).sum())))
    return max(scales, key=lambda s: s.factor)


def _explain_dimensions(
    session: Session, findings: Sequence[Finding], anomalies: Sequence[Anomaly]
) -> tuple[Finding, ...]:
    """Findings without wrong dimensions if a mistake in all readings explains them.

    Otherwise they are replaced by a mounting that alone explains the readings, if there is one.
    """
    explanations = [a.explanation for a in anomalies if a.explanation.scope == "session"]
    for factor in (e.factor for e in explanations if e.factor is not None):
        corrected = session.with_values(session.values * factor)
        others = find_implausible(corrected, explained=True)
        if not any(f.kind == "wrong dimensions" for f in others):
            return tuple(f for f in findings if f.kind != "wrong dimensions")
    outstanding = _find_outstanding_error(session)
    if outstanding is None or outstanding[0].name in session.robot.parameters:
        return tuple(findings)
    described = words.outstanding_error(*outstanding)
    return tuple(described if f.kind == "wrong dimensions" else f for f in findings)


def _describe_beyond(session: Session, scale: float) -> Finding:
    """Finding about errors far beyond the tolerances, with what may explain them."""
    outstanding = _find_outstanding_error(session)
    if outstanding is not None:
        return words.outstanding_error(*outstanding)
    suspected = find_suspected_rows(session)
    return words.beyond_tolerances(
        scale,
        LARGEST_SCALE,
        [place_of(session, i) for i in suspected] if len(suspected) <= MAX_SUSPECTED else [],
        firmware=session.firmware is not None,
    )


def _find_outstanding_error(session: Session) -> tuple[Parameter, float] | None:
    """Error of a part or mounting that alone makes readings implausible, [SI].

    An artefact or a setup counts with all its parameters, such as the centre of a ball; the largest
    is returned. None if several parts share the errors. Offsets may have any size.
    """
    for part in split_sessions(session):
        model = linear_model(part)
        problem, theta = model.problem, model.most_likely(part.values).theta
        squares = theta**2
        squares[list(model.offsets.values())] = 0.0
        places = np.array(
            [
                name if i < problem.n_machine else _owner_of(name, part.labels[0])
                for i, name in enumerate(problem.free)
            ]
        )
        largest = int(np.argmax(squares))
        share = squares[places == places[largest]].sum() / max(squares.sum(), 1e-300)
        if squares[largest] > OUTSTANDING_ERROR**2 and share > OUTSTANDING_SHARE:
            parameter = problem.selection.parameters[largest]
            return parameter, float(theta[largest] * parameter.prior_std)
    return None


def _owner_of(name: str, label: str) -> str:
    """Setup, artefact or gauge of a nuisance parameter in a session with a label, or without ""."""
    within = name.replace(f"{label}/", "", 1) if label else name
    if within.startswith("setup."):
        return within.rpartition(".")[0]
    return ".".join(within.split(".")[:2])


def _independent_contrasts(
    model: LinearModel, linearisation: ModelLinearisation, deviation: Array, noise: float
) -> tuple[Array, Array, float, int]:
    """Independent contrasts of a deviation from which offsets are projected out.

    Returns:
        The contrasts, scaled to variance 1 from noise and mountings, shape (n,); the variances that
        errors of the machine at their tolerances add, shape (n,); the sum of squares of components
        that no error affects, relative to the noise; the degrees of freedom of both together.
    """
    likelihood, problem = linearisation.likelihood, model.problem
    components = likelihood.directions @ deviation
    rest_square = max(float(deviation @ deviation - components @ components), 0.0) / noise**2
    # derivatives of the components with respect to the errors, in prior standard deviations
    slopes = likelihood.singular_values[:, None] * likelihood.errors.T / noise
    parameters, n = problem.robot.parameters, problem.n_machine
    machine = slopes[:, :n]
    names = problem.free[:n]
    offset = np.array([parameters.are_offsets(name) for name in names], dtype=bool)
    scaled = np.array([parameters.are_scaled(name) for name in names], dtype=bool)
    basis, singular_values, _ = np.linalg.svd(machine[:, offset])
    rank = int((singular_values > RESOLVED).sum())
    contrasts = basis[:, rank:].T
    unscaled = np.column_stack([slopes[:, n:], machine[:, ~(offset | scaled)]])
    nuisance_slopes, scaled_slopes = contrasts @ unscaled, contrasts @ machine[:, scaled]
    factor = np.linalg.cholesky(np.eye(len(contrasts)) + nuisance_slopes @ nuisance_slopes.T)
    whitened = np.linalg.solve(
        factor, np.column_stack([contrasts @ components / noise, scaled_slopes])
    )
    variances, rotation = np.linalg.eigh(whitened[:, 1:] @ whitened[:, 1:].T)
    return rotation.T @ whitened[:, 0], np.maximum(variances, 0.0), rest_square, model.dof - rank


def _describe_order(session: Session) -> list[Finding]:
    """Finding about joined sessions that were not given in the order of measuring."""
    sessions = linear_model(session).sessions
    listed_last, last, times = sessions.labels[-1], sessions.ordered_labels[-1], sessions.times
    if last == listed_last:
        return []
    if times and times[last] > times[listed_last]:
        return [describe_wrong_time(listed_last, last)]
    corrections = dict(zip(sessions.labels, sessions.corrections, strict=True))
    kind: Correction = (
        "compensation" if corrections[listed_last][0] == corrections[last][0] else "offsets"
    )
    if kind == "offsets" and session.firmware is not None:
        kind = "settings"
    return [describe_wrong_order(listed_last, last, kind)]


def _describe_detectable(session: Session) -> Finding:
    """Finding with the smallest detectable change of an offset between joined sessions."""
    largest_sizes: dict[str, float] = {}
    undetectable = []
    detectable = detectable_changes(session)
    for drive in session.robot.drives:
        size = detectable.get(drive.name, math.inf)
        if not size < drive.upper - drive.lower:
            undetectable.append(drive.name)
            continue
        p = session.robot.parameters[f"{drive.name}.offset"]
        largest_sizes[p.edge_unit] = max(largest_sizes.get(p.edge_unit, 0.0), size * p.edge_factor)
    return describe_no_change(largest_sizes, undetectable)
