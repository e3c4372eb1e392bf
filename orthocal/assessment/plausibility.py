"""Plausibility of a session: units, dimensions, steps and noise of gauges."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.arrays import Array
from orthocal.assessment.wording import signed
from orthocal.assessment.words import plausibility as words
from orthocal.assessment.words.anomalies import MOST_PLACES, place_of
from orthocal.calibration.assessment_record import Finding, Place
from orthocal.errors import OrthocalError
from orthocal.estimation.fit import Fit, fit_problem
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem, build_problem
from orthocal.hypotheses.hypothesis import Rows
from orthocal.measurement.joining import split_sessions
from orthocal.robot.model import Robot
from orthocal.sensors.protocol import states_readings
from orthocal.session.session import Gauge, Session
from orthocal.statistics.chance import chance_of_excess
from orthocal.statistics.noise import noise_floor
from orthocal.statistics.zeros import project_out_zeros
from orthocal.units import MM

FINER = 1e-3
"""Part of a step of the gauge by which a reading may miss it: rounding of numbers."""

UNSUITED = 3.0
"""Ratio of nominal to measured deviation above which the postures are another machine's. Errors of
the machine add to what the gauge sees, they do not take it away."""

LEAST_UNSUITED = 1e-3
"""Deviations below this are those of a machine, [m]."""

FEWEST = 5.0
"""Degrees of freedom below which a scatter says little."""

TOO_COARSE = 30.0
"""Ratio of stated noise to scatter that no gauge has in the right unit."""

FEWEST_STEPS = 10
"""Steps within a gauge's range below which its resolution is in another unit."""

FEW_STEPS = 3
"""Steps that readings span below which they are not of such a gauge."""

COMPUTED = 1e-7
"""Scatter below which no dial showed the readings, [m]."""

TINY = 2e-3
"""Ratio to the largest distance of postures below which two are taken for a typing error."""

MANY_PLACES = 500
"""Postures above which their distances are found by a tree."""

DIFFERENT = 5.0
"""Tolerances of a length by which legs of one machine may differ by intent."""

NO_CHANCE = 1e-6
"""Probability below which repeated readings that differ are a mistake."""


def find_implausible(session: Session, *, explained: bool = False) -> tuple[Finding, ...]:
    """Findings about units, dimensions, steps and noise.

    They depend on the readings and the robot alone, not on the model that is calibrated: residuals
    are those of a fit of offsets, which leaves more than any larger model does.

    Args:
        session: The session.
        explained: Whether a mistake is named. It explains residuals and readings between the steps
            of a gauge, which are not judged then.
    """
    findings: list[Finding | None] = [_legs(session.robot)]
    for part in split_sessions(session):
        problem = build_problem(part, model="offsets") if _has_offsets(part.robot) else None
        findings += [_near(part), *(() if explained else find_finer(part))]
        if problem is not None and part.readings:
            findings += _by_model(part, problem, fit=not explained)
    return tuple(f for f in findings if f is not None)


def find_scattered(session: Session) -> tuple[Finding, ...]:
    """Gauges whose repeated readings differ by far more than their noise.

    Where many readings are wrong no single mistake stands out; that they do not repeat does.
    """
    findings = (_scattered(part, g) for part in split_sessions(session) for g in part.gauges)
    return tuple(f for f in findings if f is not None)


def find_impossible_gauges(session: Session) -> Iterator[Finding]:
    """Gauges whose stated noise or resolution is impossible, which all evidence rests on.

    A noise of many times the resolution is in another unit. So is a resolution of which the range
    has only a few steps; or of many times the noise, or of which the readings span only a few
    steps, with readings between the steps.
    """
    for name, gauge in session.gauges.items():
        step, sigma = gauge.resolution, gauge.sigma
        if not step:
            continue
        if sigma and sigma > TOO_COARSE * step:
            yield words.sigma_too_large(sigma, step=step)
        if gauge.range and np.ptp(gauge.range) < FEWEST_STEPS * step:
            yield words.coarser_than_range(step, gauge.range)
            continue
        rows = _rows_of(session, name)
        finer = _finer_rows(session, rows, gauge)
        if finer and (
            step > TOO_COARSE * sigma if sigma else np.ptp(session.values[rows]) < FEW_STEPS * step
        ):
            yield words.coarser_than_readings(len(finer), len(rows), step, *_first(session, finer))


def find_finer(session: Session) -> Iterator[Finding]:
    """Gauges of which at least half of the readings lie between the steps."""
    for name, gauge in session.gauges.items():
        rows = _rows_of(session, name)
        if finer := _finer_rows(session, rows, gauge):
            yield words.finer_than_gauge(
                len(finer), len(rows), gauge.resolution or 0.0, *_first(session, finer)
            )


def _rows_of(session: Session, gauge: str) -> list[int]:
    """Rows that a gauge reads."""
    return [i for i, r in enumerate(session.readings) if session.setups[r.setup].gauge == gauge]


def _finer_rows(session: Session, rows: list[int], gauge: Gauge) -> list[int]:
    """Rows between the steps of a gauge, if they are at least half of its rows; else none."""
    finer = np.flatnonzero(are_finer(session.values[rows], gauge)).tolist()
    return [rows[i] for i in finer] if finer and len(finer) * 2 >= len(rows) else []


def _first(session: Session, rows: Sequence[int]) -> tuple[str, float, list[Place]]:
    """File and line of the first of some rows, its value [m], and the places of the rows."""
    first = session.readings[rows[0]]
    return session.where(first), first.value, [place_of(session, i) for i in rows[:MOST_PLACES]]


def are_finer(values: ArrayLike, gauge: Gauge) -> NDArray[np.bool_]:
    """Mask of readings between the steps of their gauge, shape (n,) of values (n,), [m]."""
    steps = np.asarray(values) / (gauge.resolution or np.inf)
    return np.asarray(np.abs(steps - np.round(steps)) > FINER)


def _has_offsets(robot: Robot) -> bool:
    return "offsets" in robot.parameters.models


def _by_model(
    session: Session, problem: CalibrationProblem, *, fit: bool
) -> Iterator[Finding | None]:
    """Findings from residuals: before any fit, and of a fit of offsets."""
    try:
        yield _dimensions(session, problem)
        if not fit:
            return
        fitted = fit_problem(problem, options=SolverOptions(solver="variable-projection"))
    except (OrthocalError, np.linalg.LinAlgError):
        return  # readings that are no machine's are found otherwise
    yield _too_small(session, fitted)
    yield _coarse(session, fitted)


def _dimensions(session: Session, problem: CalibrationProblem) -> Finding | None:
    """Postures in which the nominal machine would have moved the gauge far more than it did.

    A sensor whose readings are stated does not move.
    """
    if any(states_readings(s.sensor) for s in session.setups.values()):
        return None
    o = problem.observations
    values = problem.values * problem.noise_ratio
    measured, deviation = (
        _rms(o.rows(project_out_zeros(v, o)))
        for v in (values, values - problem.predict(problem.active_theta) * problem.noise_ratio)
    )
    if deviation < LEAST_UNSUITED or deviation < UNSUITED * measured:
        return None
    return words.wrong_dimensions(describe_legs(_lengths(session.robot)), deviation, measured)


def _too_small(session: Session, fit: Fit) -> Finding | None:
    """Residuals that are smaller than rounding to the gauge's steps leaves."""
    step, noise = session.gauge.resolution, fit.noise
    if not step or len(session.gauges) > 1:
        return None
    o = fit.problem.observations
    used = o.size - o.n_zeros - noise.residual_dof
    # repeated readings may have been rounded alike: each counts once
    dof = fit.independent_readings - used
    least = step / math.sqrt(12.0)
    if not noise.is_finer_than(least, dof=dof):
        return None
    return words.residuals_too_small(noise.residual_sigma, least, step)


def _coarse(session: Session, fit: Fit) -> Finding | None:
    """A stated noise far above the scatter of repeated readings, or the residuals: another unit."""
    stated, noise = session.gauge.sigma, fit.noise
    if stated is None or len(session.gauges) > 1:
        return None
    repeated = noise.cycles_dof >= FEWEST
    scatter = noise.cycles_sigma if repeated else noise.residual_sigma
    dof = noise.cycles_dof if repeated else noise.residual_dof
    if dof < FEWEST or not COMPUTED < TOO_COARSE * scatter < stated:
        return None  # readings without any scatter were computed
    return words.sigma_too_large(stated, scatter=scatter)


def _near(session: Session) -> Finding | None:
    """A posture hardly away from another one in the mechanical zero: given in metres."""
    session = session.select(session.readings)  # of several sessions its own postures
    drives = np.array([p.drives for p in session.postures.values()])
    places, first = np.unique(drives, axis=0, return_index=True)
    if len(places) < 3:
        return None
    gaps = _nearest(places)
    largest = float(np.linalg.norm(np.ptp(places, axis=0)))
    zero = session.robot.drive_zero - session.active_offsets
    from_zero = np.linalg.norm(places - zero, axis=1)
    near = np.flatnonzero(np.maximum(gaps, from_zero) < TINY * largest)
    if not near.size:
        return None
    worst = near[first[near].argmax()]
    name = list(session.postures)[int(first[worst])]
    return words.postures_too_near(name, float(gaps[worst]), largest)


def _nearest(places: Array) -> Array:
    """Distance of each place from the one next to it, shape (n,) of (n, 3)."""
    if len(places) > MANY_PLACES:
        from scipy.spatial import KDTree

        return np.asarray(KDTree(places).query(places, k=2)[0])[:, 1]
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    return np.asarray(apart.min(axis=1))


def _legs(robot: Robot) -> Finding | None:
    """Legs of different nominal lengths on a machine whose drives are all alike."""
    lengths = _lengths(robot)
    drives = {(d.unit, d.zero, d.lower, d.upper) for d in robot.drives}
    if len(lengths) < 2 or len(drives) > 1:
        return None
    errors = [e.name for e in robot.parameters.elementary.values() if e.kind == "translation"]
    tolerance = max((robot.parameters[n].prior_std for n in errors), default=0.0)
    if max(lengths.values()) - min(lengths.values()) < DIFFERENT * tolerance:
        return None
    return words.legs_differ(describe_legs(lengths), lengths)


def _scattered(session: Session, gauge: str) -> Finding | None:
    known = session.gauges[gauge]
    if known.sigma is None:
        return None
    sigma = noise_floor(known.sigma, known.resolution)
    repeated = [
        rows
        for (setup, *_), rows in Rows(session).repeated.items()
        if len(rows) > 1 and session.setups[setup].gauge == gauge
    ]
    if not repeated:
        return None
    values = session.values

    def scatter(rows: NDArray[np.int64]) -> float:
        single = 1.0 + session.is_difference(session.readings[rows[0]])
        return float(((values[rows] - values[rows].mean()) ** 2).sum()) / single

    square, dof = sum(map(scatter, repeated)), sum(len(rows) - 1 for rows in repeated)
    if chance_of_excess(square / sigma**2, dof) > NO_CHANCE:
        return None
    worst = max(repeated, key=scatter)
    shown = ", ".join(
        f"{signed(values[i] / MM)} in {session.where(session.readings[i])}" for i in worst[:4]
    )
    return words.scattered_repeats(
        math.sqrt(square / dof),
        sigma,
        session.readings[worst[0]].label,
        shown,
        [place_of(session, i) for i in worst[:MOST_PLACES]],
    )


def _lengths(robot: Robot) -> dict[str, float]:
    return {name: leg.length for name, leg in robot.legs.items()}


def describe_legs(lengths: dict[str, float]) -> str:
    """Lengths of legs in words: legs of 310.25 mm."""
    shown = {name: f"{length / MM:g}" for name, length in lengths.items()}
    if len(set(shown.values())) == 1:
        return f"legs of {next(iter(shown.values()))} mm"
    return f"legs of {', '.join(f'{n} {v}' for n, v in shown.items())} mm"


def _rms(values: Array | Sequence[float]) -> float:
    v = np.asarray(values)
    return float(np.sqrt(np.mean(v**2))) if v.size else 0.0
