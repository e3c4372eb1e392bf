"""Refit of a calibration with another session, or with its recorded readings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from orthocal.arrays import Array, Indices, Mask
from orthocal.calibration.build_record import assemble_calibration
from orthocal.calibration.calibration import Calibration, require_calibration
from orthocal.estimation.fit import Fit, find_mounting_covariance, fit_problem
from orthocal.estimation.loss import Loss
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.selection import Selection
from orthocal.estimation.tolerance_scale import ToleranceScale
from orthocal.io.fields import read_only
from orthocal.measurement.joining import Given, gather_sessions, join_sessions
from orthocal.observation.gauge_noise import SMALLEST_SIGMA
from orthocal.observation.sensor_groups import fixed_parameters
from orthocal.session.session import Gauge, Reading, Session, Setup
from orthocal.statistics.information import Information, decompose


def repeat_calibration(calibration: Calibration, sessions: Given | Sequence[Given]) -> Calibration:
    """Fit the same parameters with the same priors and bounds to another session.

    Nominal readings of the result are those of the calibrated machine.

    Args:
        calibration: Calibration that states parameters, priors and bounds.
        sessions: The other session, or several, or paths to them.

    Raises:
        NotIdentifiableError: If neither readings nor a prior determine a parameter.
        SolverError: If the solver does not converge.
        ClosureError: If the machine cannot reach a posture.
    """
    fit = repeat_fit(calibration, join_sessions(gather_sessions(sessions)))
    return assemble_calibration(fit, nominal=calibrated_theta(calibration, fit))


def calibrated_theta(calibration: Calibration, fit: Fit) -> Array:
    """Calibrated parameters with the mountings of a fit to new readings, shape (n_free,), [SI]."""
    theta = fit.solution.theta.copy()
    here, there = known_parameters(calibration, fit.problem)
    theta[here] = np.array([p.value for p in (*calibration.free, *calibration.sensors)])[there]
    return theta


def known_parameters(
    calibration: Calibration, problem: CalibrationProblem
) -> tuple[Indices, Indices]:
    """Parameters of new readings that a calibration of the same parameters has determined.

    They are those of the machine, and of a printer those of its bed. Mountings are new.

    Returns:
        Indices among the parameters of the problem, and among the free parameters and the nuisance
        parameters of the calibration.
    """
    n = problem.n_machine
    place = {p.name: n + i for i, p in enumerate(calibration.sensors)}
    fixed = fixed_parameters(problem.session) & place.keys()
    here = [*range(n), *(i for i in range(n, problem.n_free) if problem.free[i] in fixed)]
    return np.array(here), np.array([*range(n), *(place[problem.free[i]] for i in here[n:])])


def repeat_fit(
    calibration: Calibration, session: Session, *, tolerance_scale: ToleranceScale | None = None
) -> Fit:
    """Fit of `repeat_calibration`.

    Args:
        calibration: Calibration that states parameters, priors and bounds.
        session: The other session.
        tolerance_scale: Tolerance scale; by default that of the calibration.
    """
    solver = calibration.solver
    options = SolverOptions(solver=solver.name, loss=Loss(solver.loss, solver.loss_width))
    problem = _repeat_problem(calibration, session, tolerance_scale or calibration.tolerance_scale)
    return fit_problem(problem, options=options)


def restore_mounting_covariance(calibration: Calibration) -> Array:
    """Covariance of the estimate from the mountings, computed from the record.

    See `find_mounting_covariance`. Shape (n_machine, n_machine), [SI]; 0 if the noise is unknown.
    """
    problem = _recorded_problem(calibration)
    if not math.isfinite(calibration.noise.sigma):
        return np.zeros((problem.n_machine, problem.n_machine))
    return find_mounting_covariance(
        problem,
        _recorded_information(calibration, problem)[1],
        sigma=max(calibration.noise.sigma, SMALLEST_SIGMA),
        at_bound=_at_bound(calibration),
    )


def restore_covariances(calibration: Calibration) -> tuple[Array, Array, Array]:
    """Covariance of the free errors of the machine and the nuisance parameters, from the record.

    Returns:
        The covariance, its part from noise and its part from priors that the tolerance scale
        multiplies, shape (n, n), [SI]; NaN if the noise is unknown.
    """
    problem = _recorded_problem(calibration)
    scale = np.outer(problem.theta_scale, problem.theta_scale)
    if not math.isfinite(calibration.noise.sigma):
        unknown = np.full_like(scale, np.nan)
        return unknown, unknown, unknown
    sigma = max(calibration.noise.sigma, SMALLEST_SIGMA)
    prediction, information = _recorded_information(calibration, problem)
    loss, o = Loss(calibration.solver.loss, calibration.solver.loss_width), problem.observations
    deviation = (problem.values - prediction) / sigma
    zeros = loss.centres(deviation, o.zero, o.n_zeros, weights=np.ones(o.size))
    zeros[o.zero_known] = 0.0
    used = o.size - calibration.noise.residual_dof
    posterior = information.posterior(
        sigma=sigma,
        precision=problem.prior_precision,
        at_bound=_at_bound(calibration),
        loss=(loss.gain(deviation - zeros[o.zero], used=used), loss.normal_square),
    )
    return (
        scale * posterior.covariance,
        scale * posterior.noise_covariance,
        scale * posterior.prior_covariance(problem.selection.scaled),
    )


def _recorded_problem(calibration: Calibration) -> CalibrationProblem:
    """The solved problem, with the noise of each gauge."""
    session = restore_session(calibration)
    problem = _repeat_problem(calibration, session, calibration.tolerance_scale)
    if not math.isfinite(calibration.noise.sigma):
        return problem
    ratio_of_gauge = {g.name: g.noise.sigma / calibration.noise.sigma for g in calibration.gauges}
    ratios = np.array([ratio_of_gauge[s.gauge] for s in problem.session.setups.values()])
    return problem.with_noise_ratio(ratios[problem.observations.setup])


def _recorded_information(
    calibration: Calibration, problem: CalibrationProblem
) -> tuple[Array, Information]:
    """Predictions, shape (n_entries,), [noise-scaled m], and information at the estimate."""
    theta = np.array([p.value for p in (*calibration.free, *calibration.sensors)])
    prediction, jacobian = problem.predict_and_jacobian(theta)
    return prediction, decompose(jacobian, problem.observations)


def _at_bound(calibration: Calibration) -> Mask:
    """Mask of the parameters at a bound, shape (n,)."""
    bounds = [p.at_bound for p in (*calibration.free, *calibration.sensors)]
    return np.array(bounds, dtype=bool)


def _repeat_problem(
    calibration: Calibration, session: Session, scale: ToleranceScale
) -> CalibrationProblem:
    """Problem with the parameters, priors and bounds of a calibration for another session."""
    free = calibration.free
    parameters = session.robot.parameters
    names = tuple(p.name for p in free)
    scaled = np.array([p.scaled for p in free])
    change = scale.factor / calibration.tolerance_scale.factor
    stds = np.array([p.prior_std for p in free]) * np.where(scaled, change, 1.0)
    selection = Selection(
        label=calibration.model,
        parameters=tuple(
            replace(parameters[n], prior_std=std)
            for n, std in zip(names, stds.tolist(), strict=True)
        ),
        prior=np.array([p.prior for p in free]),
        scaled=scaled,
        mean=read_only([p.mean for p in free]),
        lower=read_only([-np.inf if p.lower is None else p.lower for p in free]),
        upper=read_only([np.inf if p.upper is None else p.upper for p in free]),
        fixed={p.name: p.value for p in calibration.parameters if not p.free},
        tolerance_scale=scale,
    )
    return CalibrationProblem(session, selection)


def restore_session(calibration: Calibration) -> Session:
    """Session of a calibration, rebuilt from its record.

    `repeat_calibration(calibration, restore_session(calibration))` reproduces the calibration.
    """
    require_calibration(calibration)
    record, robot = calibration.session, calibration.robot
    offsets = record.controller_offsets
    gauges = {g.name: Gauge(g.sigma, g.resolution, g.range) for g in calibration.gauges}
    unread = {s.gauge: Gauge() for s in calibration.setups if s.gauge not in gauges}
    return Session(
        robot=robot,
        robot_reference=calibration.robot_record.reference,
        title=record.title,
        source=record.source,
        gauges=gauges | unread,
        postures={p.name: p for p in calibration.postures},
        setups={
            s.name: Setup(
                s.name,
                s.sensor,
                s.gauge,
                None if s.active is None else np.array(s.active),
                s.aligned_at,
                s.zero_kind,
                s.payload,
                None if s.adjusted is None else dict(s.adjusted),
                s.compensation,
            )
            for s in calibration.setups
        },
        readings=tuple(
            Reading(
                r.setup,
                r.posture,
                r.minus,
                r.cycle,
                r.measured,
                r.line,
                None if r.file is None else Path(r.file),
                r.conditions,
            )
            for r in calibration.residuals
        ),
        controller_offsets=None if offsets is None else read_only(offsets),
        controller_origin=record.controller_origin,
        compensation=record.compensation,
        firmware=record.firmware,
        adjusted=dict(record.adjusted),
        path=None if record.path is None else Path(record.path),
        readings_path=None if record.readings_path is None else Path(record.readings_path),
        sha256=record.sha256,
        joined=bool(record.parts),
        purpose=record.purpose,
        seed=record.seed,
    )
