"""Findings about a fit: residuals, noise and parameters.

All are notes, except that an offset at a stated bound must be reviewed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from orthocal.arrays import Array
from orthocal.assessment.words import fit as words
from orthocal.calibration.assessment_record import Finding, FindingKind
from orthocal.calibration.calibration import Calibration
from orthocal.calibration.records import GaugeRecord
from orthocal.calibration.refit import restore_session
from orthocal.errors import ClosureError, RobotError
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.estimation.problem import build_problem
from orthocal.observation.gauge_noise import SMALLEST_SIGMA, assumed_sigma, noise_floor
from orthocal.robot.model import Robot
from orthocal.sensors.leg_indicator import LegIndicator
from orthocal.sensors.protocol import Sensor
from orthocal.sensors.tips import Tip
from orthocal.session.session import Gauge, Session, split_label
from orthocal.statistics.zeros import project_out_zeros

STANDSTILL = 1e-6
"""Change of a parameter, in prior standard deviations, below which it did not change."""

UNUSUAL_ERROR = 3.0
"""Error of an effect above which it is reported, [prior std]; by chance 3 of 1000 are larger."""

NOTABLE_LINE_MODEL_ERROR = 1 / 3
"""Error of the line model, in standard deviations of a reading, above which it is reported."""

MAX_READINGS = 60
"""Largest number of compared readings, distributed over the session."""

BLADE = Tip("blade", 0.0, 1.0)
"""Tip for which the line model has the smallest discrepancy."""

STATED, REPEATED = "the stated noise of the gauge", "the scatter of repeated readings"
"""Sources of the noise, as noun phrases."""

LARGEST_OVERSTATED = 0.5
"""Ratio of the residuals to the stated noise below which the latter is reported as too large."""

WORST_FIRST: tuple[FindingKind, ...] = (
    "model error",
    "gauge overstated",
    "noise unknown",
    "noise from residuals",
    "fits",
    "noise as stated",
    "noise from cycles",
)
"""Findings about the residuals of a gauge; that of the worst gauge is reported."""


def find_fit_findings(calibration: Calibration) -> list[Finding]:
    """All findings about a fit."""
    return [
        *_redundancy(calibration),
        *_residuals(calibration),
        *_convergence(calibration),
        *_standstill(calibration),
        *find_held(calibration),
        *_above_tolerances(calibration),
        *_linearisation(calibration),
        *find_unresolved(calibration),
        *_line_model_error(calibration),
    ]


def _redundancy(calibration: Calibration) -> list[Finding]:
    """Finding about a fit without redundant readings."""
    if calibration.is_checked:
        return []
    readings, errors = calibration.identifiability.n_readings, len(calibration.free)
    mounting = readings > calibration.structural_rank
    again = calibration.measured_again
    return [words.no_redundancy(readings, errors, mounting=mounting, again=again)]


def _residuals(calibration: Calibration) -> list[Finding]:
    """Finding about the residuals in comparison with the noise, for the worst of the gauges."""
    findings = [_residuals_of(calibration, g) for g in calibration.gauges]
    return sorted(findings, key=lambda f: (WORST_FIRST.index(f.kind), -_mismatch(f)))[:1]


def _mismatch(finding: Finding) -> float:
    """Ratio of the residuals to the noise, inverse if they are too small."""
    ratio = finding.numbers.get("ratio", 1.0)
    return max(ratio, 1.0 / ratio) if ratio > 0.0 else math.inf


def describe_gauge(calibration: Calibration, name: str) -> str:
    """Phrase for readings of a gauge, such as " of the gauge 'dial'"; "" if it is the only one.

    A session with a single gauge, one of several sessions, is named instead of its gauge.
    """
    if len(calibration.gauges) < 2:
        return ""
    label, within = split_label(name, joined=bool(calibration.session.parts))
    if not within and label:
        return f" of session {label}"
    return f" of the gauge '{within}'" + (f" of session {label}" if label else "")


def _residuals_of(calibration: Calibration, gauge: GaugeRecord) -> Finding:
    """Finding about the residuals of one gauge."""
    noise, stated = gauge.noise, gauge.sigma
    of_gauge = describe_gauge(calibration, gauge.name)
    row_noun = "a difference" if calibration.rows_are_differences else "a reading"
    row_noun += of_gauge

    def model_error(reference: float, source: str) -> Finding:
        return words.model_error(
            noise.residual_sigma,
            reference,
            source=source,
            row_noun=row_noun,
            row_factor=calibration.row_factor,
            may_enlarge_model=calibration.only_offsets,
        )

    if (
        stated is not None
        and noise.source in ("gauge", "residuals")
        and noise.exceeds_residuals(stated)
        and noise.residual_sigma < LARGEST_OVERSTATED * stated
    ):
        return words.gauge_overstated(noise.residual_sigma, stated, of_gauge)
    if noise.source == "unknown":
        return words.noise_unknown(assumed_sigma(Gauge(stated, gauge.resolution)))
    if noise.source == "gauge":
        if calibration.is_checked:
            return words.fits(noise.sigma, STATED)
        return words.noise_as_stated(noise.sigma)
    if noise.source == "cycles":
        if calibration.is_checked:
            return words.fits(noise.cycles_sigma, REPEATED)
        return words.noise_from_cycles(noise.cycles_sigma)
    if noise.cycles_dof > 0:
        return model_error(noise.cycles_sigma, REPEATED)
    if stated is None:
        return words.noise_from_residuals(noise.sigma * calibration.row_factor)
    if noise.exceeded_by_residuals(noise_floor(stated, gauge.resolution)):
        noun = "a difference" if calibration.rows_are_differences else "the gauge"
        return model_error(stated, f"the stated scatter of {noun}")
    return words.fits(noise.residual_sigma, STATED)


def _convergence(calibration: Calibration) -> list[Finding]:
    """Finding about noise that did not converge."""
    if calibration.solver.noise_converged:
        return []
    gauges = len(calibration.gauges)
    return [words.noise_not_converged(calibration.noise.sigma, gauges=gauges)]


def _standstill(calibration: Calibration) -> list[Finding]:
    """Finding about a fit that changed no parameter."""
    if any(abs(p.value - p.start) > STANDSTILL * p.prior_std for p in calibration.free):
        return []
    if len(calibration.identifiability.below_noise) == len(calibration.free):
        return [words.no_sensitivity([p.name for p in calibration.free])]
    return [words.nothing_deviates(calibration.rms_before)]


def find_held(calibration: Calibration) -> list[Finding]:
    """Findings about parameters at a bound."""
    parameters = calibration.robot.parameters
    return [
        words.held_by_bound(p, offset=parameters.are_offsets(p.name))
        for p in calibration.free
        if p.at_bound is not None
    ]


def _above_tolerances(calibration: Calibration) -> list[Finding]:
    """Findings about errors of effects, such as a backlash, far above their tolerances.

    The tolerance scale of the machine allows for errors of legs and axes only.
    """
    parameters = calibration.robot.parameters
    return [
        words.effect_above_tolerance(p)
        for p in calibration.free
        if p.name in parameters.names
        and not parameters.are_rigid(p.name)
        and abs(p.value - p.mean) > UNUSUAL_ERROR * p.prior_std
    ]


def _linearisation(calibration: Calibration) -> list[Finding]:
    """Finding about the linearisation error, for the parameter with the largest part of its std."""
    uncertain = [p for p in calibration.free if p.std > 0.0]  # at no bound, with a known std
    if not (uncertain and calibration.solver.shows_linearisation_error):
        return []
    p = max(uncertain, key=lambda p: abs(p.value - p.linear) / p.std)
    return [words.linearisation_error(p, abs(p.value - p.linear), p.std)]


def find_unresolved(calibration: Calibration) -> list[Finding]:
    """Findings about parameters determined only in combination, and about those below the noise."""
    identifiability = calibration.identifiability
    findings = [words.inseparable(c) for c in identifiability.alike]
    if identifiability.below_noise:
        findings.append(words.below_noise(identifiability.below_noise))
    return findings


def _line_model_error(calibration: Calibration) -> list[Finding]:
    """Finding about gauges that may touch a rod but are modelled by the centre line of the leg."""
    sigmas = {g.name: g.noise.sigma for g in calibration.gauges}
    session = restore_session(calibration)
    try:
        error = find_line_model_error(session, sigmas)
    except (ClosureError, RobotError):  # reported by the finding about the tool error
        return []
    if error is None:
        return []
    sigma = sigmas[session.setups[error.setup].gauge]
    if not error.size > NOTABLE_LINE_MODEL_ERROR * sigma:
        return []
    return [words.line_assumed(error.size, error.setup, error.touches, sigma)]


@dataclass(frozen=True, slots=True, eq=False)
class LineModelError:
    """Largest difference between readings on the centre line and on a rod that the gauge may touch.

    Differences of gauges are compared in standard deviations of their readings.
    """

    setup: str
    """Setup with the largest difference."""
    touches: str
    """Name of the rod that the gauge may touch."""
    size: float
    """RMS difference of a reading over machines drawn from the priors, gauge zeros eliminated,
    [m]."""


def find_line_model_error(session: Session, sigmas: Mapping[str, float]) -> LineModelError | None:
    """Largest error of the line model for gauges that may touch a rod; None without such gauges.

    Args:
        session: The session.
        sigmas: Standard deviation of a reading of each gauge, [m]; NaN if unknown.
    """
    rod_sensors = {
        name: sensors
        for name, s in session.setups.items()
        if (sensors := _rod_sensors(s.sensor, session.robot))
    }
    if not rod_sensors:
        return None
    readings = [r for r in session.readings if r.setup in rod_sensors]
    readings = readings[:: max(-(-len(readings) // MAX_READINGS), 1)]
    if not readings:
        return None
    part = replace(session.select(tuple(readings)), parts=())
    line = _nominal_expansion(part)
    sigma = np.array([sigmas[session.setups[r.setup].gauge] for r in readings])
    candidates = []
    for k in range(max(len(rod_sensors[name]) for name in part.setups)):
        rods = {name: list(rod_sensors[name])[: k + 1][-1] for name in part.setups}
        setups = {n: replace(s, sensor=rod_sensors[n][rods[n]]) for n, s in part.setups.items()}
        difference = _nominal_expansion(replace(part, setups=setups)) - line
        sizes = np.linalg.norm(difference, axis=1)
        ratios = np.nan_to_num(sizes / np.maximum(sigma, SMALLEST_SIGMA))
        worst = int(ratios.argmax())
        setup = readings[worst].setup
        error = LineModelError(setup, rods[setup], float(sizes[worst]))
        candidates.append((float(ratios[worst]), error))
    return max(candidates, key=lambda c: c[0])[1]


def _nominal_expansion(session: Session) -> Array:
    """Nominal readings, and their changes by one prior standard deviation of each error.

    Returns:
        Gauge zeros eliminated, shape (n_readings, 1 + n_errors), [m].
    """
    problem = build_problem(session, free=machine_errors(session.robot), prior=True)
    h, jacobian = problem.predict_and_jacobian(np.zeros(problem.n_free))
    o = problem.observations
    columns = np.column_stack([h, jacobian[:, : problem.n_machine]])
    return np.asarray(o.rows(project_out_zeros(columns, o)))


def _rod_sensors(sensor: Sensor, robot: Robot) -> dict[str, Sensor]:
    """Sensors on the rods that a gauge of the line model may touch, by rod; else empty."""
    if not isinstance(sensor, LegIndicator) or sensor.rod is not None:
        return {}
    return {rod: sensor.on_rod(rod, BLADE) for rod in robot.legs[sensor.leg].rods}
