"""Plausibility of a session: units, dimensions, steps and noise of gauges."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.arrays import Array, Indices
from orthocal.assessment.words import plausibility as words
from orthocal.assessment.words.anomalies import MAX_PLACES, place_of
from orthocal.calibration.assessment_record import Finding, Place
from orthocal.errors import OrthocalError
from orthocal.estimation.fit import Fit, fit_problem
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem, build_problem
from orthocal.hypotheses.families.unit_and_sign import decimal_steps
from orthocal.hypotheses.hypothesis import group_rows
from orthocal.measurement.joining import split_sessions
from orthocal.observation.gauge_noise import noise_floor
from orthocal.robot.model import Robot
from orthocal.sensors.protocol import states_readings
from orthocal.session.session import Gauge, Session
from orthocal.statistics.zeros import project_out_zeros
from orthocal.units import INCH, MM

STEP_TOLERANCE = 1e-3
"""Rounding error of a reading, in steps of the gauge."""

WRONG_MACHINE_RATIO = 3.0
"""Ratio of deviation to measured motion above which the postures belong to another machine. Errors
of the right machine increase the measured motion, too."""

MIN_WRONG_MACHINE = 1e-3
"""Deviation below which the postures are not doubted, [m]."""

MIN_DOF = 5.0
"""Degrees of freedom below which a scatter is too uncertain to be judged."""

WRONG_UNIT_RATIO = 30.0
"""Ratio above which one of two lengths of a gauge is in a wrong unit: of the stated noise to the
scatter or to the resolution, and of the resolution to the stated noise."""

MIN_RANGE_STEPS = 10
"""Steps in the range of a gauge below which its resolution is in a wrong unit."""

MIN_EXCESS = 1.5
"""Ratio of noise with and without an unstated rounding above which the rounding matters."""

MIN_SPANNED_STEPS = 3
"""Steps between the extreme readings below which the resolution contradicts them."""

MIN_DIAL_SCATTER = 1e-7
"""Scatter below which readings were computed, not read from a dial, [m]."""

SAME_POSTURE_RATIO = 2e-3
"""Distance of a posture from the nearest one and from the mechanical zero, relative to the largest
distance of postures, below which its coordinates seem to be in metres."""

DOMINANT_SHARE = 0.5**0.5
"""Ratio of one deviation to the norm of all above which it dominates: half the sum of squares."""

MANY_POSTURES = 500
"""Number of postures above which a tree finds the nearest neighbours."""

SAME_LENGTH = 5.0
"""Largest difference of lengths of equal legs, in prior standard deviations of a translation."""

MM_PER_INCH = INCH / MM

MISTAKE_PROBABILITY = 1e-6
"""Probability by chance below which readings on steps of an inch are a mistake."""


def find_implausible(session: Session, *, explained: bool = False) -> tuple[Finding, ...]:
    """Findings about units, dimensions, steps and noise.

    They depend on the readings and the robot alone, not on the calibrated model. Residuals are
    those of a fit of offsets. A larger model leaves residuals of at most this size.

    Args:
        session: The session.
        explained: Whether a mistake was found. It explains residuals and readings between the steps
            of a gauge, so these are not judged.
    """
    findings: list[Finding | None] = [_legs(session.robot)]
    for part in split_sessions(session):
        findings += [_check_distances(part), *(() if explained else find_finer(part))]
        if "offsets" in part.robot.parameters.models and part.readings:
            findings += _by_model(part, fit=not explained)
    return tuple(f for f in findings if f is not None)


def find_impossible_gauges(session: Session) -> Iterator[Finding]:
    """Findings about gauges with an impossible noise or resolution, on which all evidence depends.

    Gauges without readings are not judged: no evidence depends on them.
    A noise of many times the resolution is in a wrong unit, and so is a resolution if the range has
    only a few steps. If readings are between steps, the resolution is wrong if it is many times the
    noise or, without a stated noise, if the readings span only a few steps. If all readings are
    multiples of ten steps, it is wrong if such a rounding is larger than the stated noise.
    """
    for name, gauge in session.gauges_with_readings.items():
        step, sigma = gauge.resolution, gauge.sigma
        if not step:
            continue
        keys = _keys_of(session, name)
        if sigma and sigma > WRONG_UNIT_RATIO * step:
            yield words.sigma_too_large(sigma, keys, step=step)
        if gauge.range and np.ptp(gauge.range) < MIN_RANGE_STEPS * step:
            yield words.coarser_than_range(step, gauge.range, keys)
            continue
        rows = _rows_of(session, name)
        coarser = _coarser_step(session.values[rows], step)
        if noise_floor(sigma, coarser) > MIN_EXCESS * noise_floor(sigma, step):
            yield words.finer_than_readings(
                len(rows), step, coarser, keys, noise_stated=bool(sigma)
            )
        finer = _finer_rows(session, rows, gauge)
        if len(finer) * 2 >= len(rows) and (
            step > WRONG_UNIT_RATIO * sigma
            if sigma
            else np.ptp(session.values[rows]) < MIN_SPANNED_STEPS * step
        ):
            evidence = _evidence(session, finer)
            yield words.coarser_than_readings(len(finer), len(rows), step, *evidence, keys=keys)


def _coarser_step(values: Array, step: float) -> float:
    """Largest power of ten times the stated step of which all readings are multiples, [m].

    The stated step if a reading is no multiple of ten steps, or if all are multiples by chance.
    """
    nonzero = np.abs(values[values != 0.0]) / step
    while 10.0 ** -len(nonzero) < MISTAKE_PROBABILITY:
        coarser = nonzero / 10.0
        integers = np.round(coarser)
        if (integers == 0.0).any() or (np.abs(coarser - integers) > STEP_TOLERANCE).any():
            break
        nonzero, step = coarser, 10.0 * step
    return step


def find_finer(session: Session) -> Iterator[Finding]:
    """Findings about gauges with readings between the steps.

    They are notes about fewer than half of the readings, unless these are all of a setup and one
    is finer than the eye divides a step.
    """
    for name, gauge in session.gauges_with_readings.items():
        rows = _rows_of(session, name)
        if finer := _finer_rows(session, rows, gauge):
            step = gauge.resolution or 0.0
            inches = _are_inches(session.values[rows], step)
            evidence = _evidence(session, finer)
            finest = _finer_rows(session, rows, replace(gauge, resolution=step / 10.0))
            by_setup = group_rows(session.readings[i].setup for i in rows)
            rows_of = {setup: {rows[k] for k in places} for setup, places in by_setup.items()}
            complete = [s for s, r in rows_of.items() if r <= set(finer) and r & set(finest)]
            yield words.finer_than_gauge(
                len(finer),
                len(rows),
                step,
                *evidence,
                setups=complete,
                inches=inches,
                keys=_keys_of(session, name),
            )


def _are_inches(values: Array, step: float) -> bool:
    """True if the readings, taken as inches, are multiples of the step, and this is not chance.

    Args:
        values: Readings, taken as mm, shape (n,), [m].
        step: Step of their gauge, [m].
    """
    values = values[values != 0.0]
    half_width = 0.5 * MM_PER_INCH * decimal_steps(values).min() / step + STEP_TOLERANCE
    steps = MM_PER_INCH * values / step
    by_chance = (2.0 * half_width) ** len(values)
    fit = np.abs(steps - np.round(steps)) <= half_width
    return bool(fit.all()) and by_chance < MISTAKE_PROBABILITY


def _keys_of(session: Session, name: str) -> words.GaugeKeys:
    """Name of a gauge for a finding, and the place of its keys."""
    return words.GaugeKeys(
        session.distinguish_gauge(name),
        resolution=session.locate_gauge_key(name, "resolution_mm"),
        sigma=session.locate_gauge_key(name, "sigma_mm"),
    )


def _rows_of(session: Session, gauge_name: str) -> list[int]:
    """Rows that a gauge reads."""
    return [
        i for i, r in enumerate(session.readings) if session.setups[r.setup].gauge == gauge_name
    ]


def _finer_rows(session: Session, rows: list[int], gauge: Gauge) -> list[int]:
    """Rows with readings between the steps of a gauge."""
    return [rows[i] for i in np.flatnonzero(are_finer(session.values[rows], gauge)).tolist()]


def _evidence(session: Session, rows: Sequence[int]) -> tuple[str, float, list[Place]]:
    """File and line of the first row, its reading in m, and the first MAX_PLACES places."""
    first = session.readings[rows[0]]
    return session.where(first), first.value, [place_of(session, i) for i in rows[:MAX_PLACES]]


def are_finer(values: ArrayLike, gauge: Gauge) -> NDArray[np.bool_]:
    """Mask of readings between the steps of their gauge, shape (n,).

    Args:
        values: Readings, shape (n,), [m].
        gauge: Their gauge.
    """
    steps = np.asarray(values) / (gauge.resolution or np.inf)
    return np.asarray(np.abs(steps - np.round(steps)) > STEP_TOLERANCE)


def _by_model(session: Session, *, fit: bool) -> Iterator[Finding | None]:
    """Findings about deviations before a fit, and about residuals of a fit of offsets."""
    problem = build_problem(session, model="offsets")
    try:
        yield _dimensions(session, problem)
        if not fit or len(session.gauges_with_readings) > 1:
            return
        # one solution: if its residuals are below the stated noise, sigma is the stated one
        options = SolverOptions(solver="variable-projection")
        fitted = fit_problem(problem, options=options, rounds=1)
    except (OrthocalError, np.linalg.LinAlgError):
        return  # other findings report readings that no machine can cause
    yield _residuals_too_small(session, fitted)
    yield _sigma_too_large(session, fitted)


def _dimensions(session: Session, problem: CalibrationProblem) -> Finding | None:
    """Finding about postures in which the nominal machine would have moved the gauge far more.

    Prescribed readings, such as those of a probe, do not show how far the gauge moved. If the
    others agree with the machine, one reading is wrong, such as one of another setup.
    """
    if any(states_readings(s.sensor) for s in session.setups.values()):
        return None
    observations = problem.observations
    values = problem.values * problem.noise_ratio
    expected = problem.predict(problem.active_theta) * problem.noise_ratio
    readings, predictions, deviations = (
        observations.rows(project_out_zeros(v, observations))
        for v in (values, expected, values - expected)
    )
    measured, deviation = _rms(readings), _rms(deviations)
    if deviation < MIN_WRONG_MACHINE or deviation < WRONG_MACHINE_RATIO * measured:
        return None
    worst = int(np.argmax(np.abs(deviations)))
    others = [r for i, r in enumerate(session.readings) if i != worst]
    if np.abs(deviations[worst]) > DOMINANT_SHARE * np.linalg.norm(deviations) and others:
        without_worst = session.select(others)
        return _dimensions(without_worst, build_problem(without_worst, model="offsets"))
    return words.wrong_dimensions(describe_legs(session.robot), _rms(predictions), measured)


def _residuals_too_small(session: Session, fit: Fit) -> Finding | None:
    """Finding about residuals that are smaller than the rounding to steps of the only gauge."""
    step, noise = session.gauge.resolution, fit.noise
    if not step:
        return None
    observations = fit.problem.observations
    parameters_used = observations.size - observations.n_free_zeros - noise.residual_dof
    # repeated readings may have the same rounding error: each counts once
    dof = fit.independent_readings - parameters_used
    rounding_std = step / math.sqrt(12.0)
    if not noise.is_finer_than(rounding_std, dof=dof):
        return None
    return words.residuals_too_small(noise.residual_sigma, rounding_std, step)


def _sigma_too_large(session: Session, fit: Fit) -> Finding | None:
    """Finding about a stated noise of the only gauge far above the scatter of repeated readings.

    Without repetitions it is compared with the residuals.
    """
    stated, noise = session.gauge.sigma, fit.noise
    if stated is None:
        return None
    repeated = noise.cycles_dof >= MIN_DOF
    scatter = noise.cycles_sigma if repeated else noise.residual_sigma
    dof = noise.cycles_dof if repeated else noise.residual_dof
    if dof < MIN_DOF or scatter < MIN_DIAL_SCATTER or stated <= WRONG_UNIT_RATIO * scatter:
        return None
    (name,) = session.gauges_with_readings
    return words.sigma_too_large(stated, _keys_of(session, name), scatter=scatter)


def _check_distances(session: Session) -> Finding | None:
    """Finding about a posture close to another one and to the mechanical zero: stated in metres."""
    session = session.select(session.readings)  # without postures of the other sessions
    drives = np.array([p.drives for p in session.postures.values()])
    coordinates, first = np.unique(drives, axis=0, return_index=True)
    if len(coordinates) < 3:
        return None
    units = [d.unit for d in session.robot.drives]
    columns = {u: [unit == u for unit in units] for u in units}
    # diagonals of the box around the postures
    spans = {
        u: float(np.linalg.norm(np.ptp(coordinates[:, c], axis=0))) for u, c in columns.items()
    }
    scale = np.array([spans[u] or 1.0 for u in units])  # drives in mm and in deg are comparable
    neighbours, distances = _nearest(coordinates / scale)
    zero = session.robot.drive_zero - session.active_offsets
    distances_from_zero = np.linalg.norm((coordinates - zero) / scale, axis=1)
    too_near = np.flatnonzero(np.maximum(distances, distances_from_zero) < SAME_POSTURE_RATIO)
    if not too_near.size:
        return None
    last = too_near[first[too_near].argmax()]
    name = list(session.postures)[int(first[last])]
    gap = coordinates[last] - coordinates[neighbours[last]]
    gaps = {u: (float(np.linalg.norm(gap[c])), spans[u]) for u, c in columns.items()}
    return words.postures_too_near(name, gaps)


def _nearest(points: Array) -> tuple[Indices, Array]:
    """Nearest neighbour of each point and its distance, shapes (n,) of points (n, n_drives)."""
    if len(points) > MANY_POSTURES:
        from scipy.spatial import KDTree

        distances, neighbours = KDTree(points).query(points, k=2)
        return np.asarray(neighbours)[:, 1], np.asarray(distances)[:, 1]
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    return distances.argmin(axis=1), distances.min(axis=1)


def _legs(robot: Robot) -> Finding | None:
    """Finding about legs of different nominal lengths on a machine with equal drives."""
    lengths = {name: leg.length for name, leg in robot.legs.items()}
    drives = {(d.unit, d.zero, d.lower, d.upper) for d in robot.drives}
    if len(lengths) < 2 or len(drives) > 1:
        return None
    errors = [e.name for e in robot.parameters.elementary.values() if e.kind == "translation"]
    tolerance = max((robot.parameters[n].prior_std for n in errors), default=0.0)
    if max(lengths.values()) - min(lengths.values()) <= SAME_LENGTH * tolerance:
        return None
    return words.legs_differ(describe_legs(robot), lengths)


def describe_legs(robot: Robot) -> str:
    """Lengths of legs in words, such as "legs of 310.25 mm"; "rods of ..." on a linear delta."""
    shown = {name: f"{leg.length / MM:g}" for name, leg in robot.legs.items()}
    if len(set(shown.values())) == 1:
        return f"{robot.leg_noun} of {next(iter(shown.values()))} mm"
    return f"{robot.leg_noun} of {', '.join(f'{n} {v}' for n, v in shown.items())} mm"


def _rms(values: Array | Sequence[float]) -> float:
    """RMS of values; 0 if there are none."""
    v = np.asarray(values)
    return float(np.sqrt(np.mean(v**2))) if v.size else 0.0
