"""Construction of a calibration: from a fit, or after mechanical adjustments."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib.metadata import version
from typing import Literal

import numpy as np
import scipy

from orthocal import __version__
from orthocal.arrays import Array
from orthocal.calibration.calibration import Calibration
from orthocal.calibration.recorded_robot import record_robot
from orthocal.calibration.records import (
    GaugeRecord,
    ParameterEstimate,
    PostureRecord,
    SessionRecord,
    SetupRecord,
    SolverRecord,
    Versions,
)
from orthocal.effects.adjustment import find_adjustments
from orthocal.errors import ClosureError, SolverError
from orthocal.estimation.diagnostics.deletion import (
    Diagnostics,
    cross_validate_setups,
    diagnose_readings,
)
from orthocal.estimation.diagnostics.residual_rows import ResidualRow
from orthocal.estimation.diagnostics.unmodelled import (
    find_unmodelled_errors,
    propagate_unmodelled,
)
from orthocal.estimation.fit import Fit
from orthocal.estimation.linear import LinearProblem, linearise_problem
from orthocal.estimation.problem import CalibrationProblem
from orthocal.io.documents import LARGEST_NUMBER
from orthocal.io.fields import finite_or_none, read_only
from orthocal.robot.model import Robot
from orthocal.session.session import Session
from orthocal.statistics.identifiability import (
    Identifiability,
    analyse_identifiability,
)
from orthocal.statistics.information import Information, count_others, marginalise
from orthocal.statistics.zeros import project_out_zeros


def assemble_calibration(
    fit: Fit, *, full_problem: CalibrationProblem | None = None, nominal: Array | None = None
) -> Calibration:
    """Build the calibration of a solved problem.

    Args:
        fit: The solved problem.
        full_problem: The problem with all parameters, if base parameters were estimated.
        nominal: Parameters that predict the nominal readings, shape (n_free,), [SI]; by default
            those of the nominal machine with the active offsets and the estimated mountings.

    Raises:
        SolverError: If an estimate is not a plausible number.
    """
    problem = fit.problem
    session, n = problem.session, problem.n_machine
    # a base parameter represents all errors of its combination
    represented = () if full_problem is None else full_problem.machine_selection.names
    unmodelled_errors = find_unmodelled_errors(fit, represented=represented)
    unmodelled, bias_of_sensors = propagate_unmodelled(fit, unmodelled_errors)
    noise = _separate_noise(fit) if unmodelled_errors.names else None
    covariances = (
        fit.covariance(noise=noise),
        fit.noise_covariance(noise=noise),
        fit.scaled_covariance(),
    )
    bias = np.vstack([unmodelled.leakage * unmodelled.prior_stds, bias_of_sensors])
    variances = np.array([np.diag(c) for c in covariances])
    variances[0] += (bias**2).sum(axis=1)
    variances[2] += (bias[:, unmodelled_errors.scaled] ** 2).sum(axis=1)
    estimates = _estimates(fit, np.sqrt(variances))
    _require_possible(estimates, fit.iterations)
    known = [hold_parameter(session.robot, *value) for value in problem.fixed.items()]
    diagnostics = diagnose_readings(fit)
    return Calibration(
        robot_record=record_robot(session),
        session=_session_record(session),
        model=problem.selection.label,
        prior=bool(problem.machine_selection.prior.any()),
        solver=_solver_record(fit),
        parameters=(*estimates[:n], *known),
        sensors=estimates[n:],
        model_covariance=read_only(covariances[0][:n, :n]),
        noise_covariance=read_only(covariances[1][:n, :n]),
        scaled_covariance=read_only(covariances[2][:n, :n]),
        unmodelled=unmodelled,
        identifiability=_identifiability(fit, full_problem),
        base=full_problem is not None,
        noise=fit.noise,
        noise_coverage=fit.noise_coverage(separate=noise is not None),
        rows_are_differences=session.only_differences,
        residuals=_residual_rows(fit, diagnostics, nominal),
        critical=diagnostics.outlier_threshold,
        postures=_posture_records(fit),
        tolerance_scale=problem.machine_selection.tolerance_scale,
        setups=_setup_records(fit),
        gauges=_gauge_records(fit),
        versions=_versions(),
        robot=session.robot,
    )


def _separate_noise(fit: Fit) -> float | None:
    """Noise of a reading without unmodelled errors, [m]; None if the estimated noise is used.

    Scaled tolerances explain the residuals by unmodelled errors. Noise from the residuals would
    then count these errors twice.
    """
    scale = fit.problem.machine_selection.tolerance_scale
    if scale.factor == 1.0 or fit.noise.source != "residuals":
        return None
    relative = np.empty(fit.problem.observations.size)
    for g, noise in zip(fit.groups, fit.noises.gauges, strict=True):
        separate, _ = noise.without_residuals(g.gauge.sigma, g.gauge.resolution)
        relative[g.entries] = separate / noise.sigma
    return fit.noise.sigma * float(np.sqrt(np.mean(relative**2)))


def _require_possible(estimates: Sequence[ParameterEstimate], iterations: int) -> None:
    """Refuse estimates that are not plausible numbers.

    Raises:
        SolverError: If an estimate is not finite or too large; it names the parameter.
    """
    for p in estimates:
        if not max(abs(p.value), abs(p.linear)) <= LARGEST_NUMBER:
            raise absurd_result(f"{p.name} is {p.value:.3g} {p.unit}", iterations)


def absurd_result(problem: str, iterations: int) -> SolverError:
    """Error for a result with impossible numbers."""
    return SolverError(
        f"the result is implausible ({problem}); check readings, sigma_mm, tolerances and bounds",
        status="absurd result",
        iterations=iterations,
    )


def _solver_record(fit: Fit) -> SolverRecord:
    """Record of the solver, its settings and its result."""
    return SolverRecord(
        name=fit.program.options.solver,
        status=fit.solution.status,
        iterations=fit.iterations,
        seconds_build=fit.seconds_build,
        seconds_solve=fit.seconds_solve,
        hessian=fit.solution.hessian,
        loss=fit.loss.kind,
        loss_width=fit.loss.width,
        noise_converged=fit.noise_converged,
    )


def _posture_records(fit: Fit) -> tuple[PostureRecord, ...]:
    """Records of the postures with the passive coordinates of the calibrated machine."""
    states, postures = fit.problem.states, fit.problem.session.postures.values()
    return tuple(
        PostureRecord(p.name, p.form, p.values, p.drives, read_only(fit.solution.passive[i]))
        for i, p in zip(states.first_of_posture, postures, strict=True)
    )


def _identifiability(fit: Fit, full_problem: CalibrationProblem | None) -> Identifiability:
    """Identifiability of the free parameters, or of all if base parameters were estimated.

    Its unit is metres of the gauge with the least noise, whichever gauge is the first.
    """
    finest = float(fit.problem.noise_ratio.min())

    def analyse(linearisation: LinearProblem) -> Identifiability:
        machine, sigma = linearisation.problem.machine_selection, finest * fit.sigma
        information = Information(finest * linearisation.information.factor)
        n = len(machine.parameters)
        return analyse_identifiability(
            marginalise(information, n, sigma=sigma),
            machine.parameters,
            sigma=finest * fit.noise.sigma,
            n_postures=len(fit.problem.session.postures),
            n_readings=fit.independent_readings,
            n_nuisance=count_others(information, n, sigma=sigma),
        )

    solved = analyse(fit.linearisation)
    if full_problem is None:
        return solved
    combinations = analyse(
        linearise_problem(full_problem.with_noise_ratio(fit.problem.noise_ratio))
    )
    return replace(
        combinations,
        singular_values=solved.singular_values,
        rank=solved.structural_rank,
        n_nuisance=solved.n_nuisance,
    )


def _estimates(fit: Fit, stds: Array) -> tuple[ParameterEstimate, ...]:
    """Estimates of the free parameters: errors of the machine, then nuisance parameters.

    Args:
        fit: The solved problem.
        stds: `std`, `std_scatter` and `std_scaled` of each parameter, shape (3, n_free), [SI].
    """
    problem, solution = fit.problem, fit.solution
    selection = problem.selection
    determined = fit.machine_information.determined(sigma=fit.noise.sigma)
    determined = np.append(determined, np.zeros(problem.n_free - determined.size, dtype=bool))
    bounds: dict[int, Literal["lower", "upper"] | None] = {-1: "lower", 0: None, 1: "upper"}
    return tuple(
        ParameterEstimate(
            name=p.name,
            unit=p.unit,
            value=float(solution.theta[i]),
            linear=float(fit.linearised_theta[i]),
            std=float(stds[0, i]),
            std_scatter=float(stds[1, i]),
            std_scaled=float(stds[2, i]),
            prior_std=p.prior_std,
            scaled=bool(selection.scaled[i]),
            free=True,
            resolvable=bool(determined[i]),
            start=float(problem.active_theta[i]),
            prior=bool(selection.prior[i]),
            mean=float(problem.prior_mean[i]),
            lower=finite_or_none(selection.lower[i]),
            upper=finite_or_none(selection.upper[i]),
            at_bound=bounds[int(solution.at_bound[i] * fit.at_bound[i])],
            interval=None,
        )
        for i, p in enumerate(problem.parameters)
    )


def hold_parameter(robot: Robot, name: str, value: float) -> ParameterEstimate:
    """Record of a parameter with a known value, [SI]."""
    p = robot.parameters[name]
    return ParameterEstimate(
        name=name,
        unit=p.unit,
        value=value,
        linear=value,
        std=0.0,
        std_scatter=0.0,
        std_scaled=0.0,
        prior_std=p.prior_std,
        scaled=False,
        free=False,
        resolvable=False,
        start=value,
        prior=False,
        mean=0.0,
        lower=None,
        upper=None,
        at_bound=None,
        interval=None,
    )


def adjust_calibration(calibration: Calibration, amounts: Mapping[str, float]) -> Calibration:
    """Calibration of a machine after mechanical adjustments; not assessed.

    The amounts become known parameters. The errors with which they were set increase the covariance
    of the free errors of the geometry to C + T S Tᵀ. S is the covariance of the amounts, and T the
    coefficients of the amounts in the errors.

    Args:
        calibration: Calibration of the machine before the adjustments.
        amounts: Adjustment to its amount, [m].
    """
    if not amounts:
        return calibration
    robot = calibration.robot
    chosen = [a for a in find_adjustments(robot) if a.name in amounts]
    terms = robot.parameters.coefficients(
        [p.name for p in calibration.free], [a.parameter for a in chosen]
    )
    root = terms * [a.setting_std(amounts[a.name]) for a in chosen]
    known_values = {p.name: p.value for p in calibration.parameters if not p.free}
    held = {a.parameter: known_values.get(a.parameter, 0.0) + amounts[a.name] for a in chosen}
    covariance = calibration.model_covariance + root @ root.T
    variances = iter(np.diag(covariance + calibration.unmodelled.bias_covariance).tolist())

    def estimate(p: ParameterEstimate) -> ParameterEstimate:
        return replace(p, std=float(np.sqrt(next(variances)))) if p.free else p

    return replace(
        calibration,
        parameters=(
            *(estimate(p) for p in calibration.parameters if p.name not in held),
            *(hold_parameter(robot, name, value) for name, value in held.items()),
        ),
        model_covariance=read_only(covariance),
        assessment=None,
    )


@cache
def _versions() -> Versions:
    """Versions of the software."""
    libraries = (version("pin"), version("casadi"), np.__version__, scipy.__version__)
    return Versions(__version__, platform.python_version(), *libraries)


def _session_record(session: Session) -> SessionRecord:
    """Record of a session and of those that were joined into it."""
    offsets = session.controller_offsets
    return SessionRecord(
        path=None if session.path is None else str(session.path),
        readings_path=None if session.readings_path is None else str(session.readings_path),
        title=session.title,
        source=session.source,
        sha256=session.sha256,
        controller_offsets=None if offsets is None else tuple(offsets.tolist()),
        controller_origin=session.controller_origin,
        purpose=session.purpose,
        seed=session.seed,
        compensation=session.compensation,
        firmware=session.firmware,
        adjusted=tuple(session.adjusted.items()),
        parts=tuple(_session_record(part) for part in session.parts),
    )


def _residual_rows(
    fit: Fit, diagnostics: Diagnostics, nominal_theta: Array | None
) -> tuple[ResidualRow, ...]:
    """Readings with the predictions of the nominal, linearised and calibrated machine.

    Each prediction contains its best-fit gauge zeros.
    """
    problem, observations = fit.problem, fit.problem.observations
    measured, session = problem.values, problem.session
    row_noise = problem.noise_ratio[observations.plus]

    def fitted(prediction: Array) -> Array:
        residual = project_out_zeros(
            measured - prediction, observations, weights=fit.robust_weights
        )
        return session.values - row_noise * observations.rows(residual)

    if nominal_theta is None:
        nominal = fitted(problem.predict_nominal(fit.solution.theta[problem.n_machine :]))
    else:
        nominal = fitted(problem.predict(nominal_theta, None))
    try:
        passive = problem.close(fit.linearised_theta, start=fit.solution.passive)
        by_linear = fitted(problem.predict(fit.linearised_theta, passive))
    except ClosureError:  # the linearised machine cannot reach a posture
        by_linear = np.full(len(session.readings), np.nan)
    predicted = session.values - row_noise * observations.rows(fit.residual)
    prediction_error = row_noise * cross_validate_setups(fit)
    return tuple(
        ResidualRow(
            setup=r.setup,
            posture=r.posture,
            minus=r.minus,
            cycle=r.cycle,
            measured=r.value,
            nominal=float(nominal[i]),
            linear=float(by_linear[i]),
            predicted=float(predicted[i]),
            line=r.line,
            file=None if r.file is None else str(r.file),
            studentised=float(diagnostics.studentised[i]),
            influence=float(diagnostics.max_dfbetas[i]),
            influenced=problem.free[diagnostics.dfbetas_parameter[i]],
            prediction_error=float(prediction_error[i]),
            conditions=r.conditions,
        )
        for i, r in enumerate(session.readings)
    )


def _gauge_records(fit: Fit) -> tuple[GaugeRecord, ...]:
    """Records of the gauges with their estimated noise."""
    return tuple(
        GaugeRecord(
            name=g.name,
            sigma=g.gauge.sigma,
            resolution=g.gauge.resolution,
            range=g.gauge.range,
            noise=noise,
            readings=int(g.entries.sum()),
        )
        for g, noise in zip(fit.groups, fit.noises.gauges, strict=True)
    )


def _setup_records(fit: Fit) -> tuple[SetupRecord, ...]:
    """Records of the setups with their estimated gauge zeros."""
    observations = fit.problem.observations
    noise = np.ones(observations.n_zeros)
    noise[observations.zero] = fit.problem.noise_ratio
    zeros = {
        name: float(fit.solution.zeros[i] * noise[i])
        for i, (name, real) in enumerate(
            zip(observations.zero_setup, observations.zero_real, strict=True)
        )
        if real
    }
    aligned_at = fit.problem.session.alignment_postures
    return tuple(
        SetupRecord(
            s.name,
            s.sensor,
            gauge=s.gauge,
            active=None if s.active is None else tuple(s.active.tolist()),
            zero=zeros.get(s.name),
            aligned_at=aligned_at[s.name],
            zero_kind=s.zero,
            payload=s.payload,
            compensation=s.compensation,
            adjusted=None if s.adjusted is None else tuple(s.adjusted.items()),
        )
        for s in fit.problem.session.setups.values()
    )
