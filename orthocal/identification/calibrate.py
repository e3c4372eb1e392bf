"""From a session to a calibration: linearised start, noise, exact solution, uncertainty."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal import __version__
from orthocal.identification.calibration import (
    Calibration,
    NoiseRecord,
    ParameterEstimate,
    PostureRecord,
    ResidualRow,
    RobotRecord,
    SessionRecord,
    SetupRecord,
    SolverRecord,
)
from orthocal.identification.linear import solve_linearised
from orthocal.identification.nlp import NonlinearProgram, Solution, SolverOptions
from orthocal.identification.problem import CalibrationProblem, build_problem
from orthocal.identification.uncertainty import (
    Information,
    Noise,
    decompose,
    estimate_noise,
    estimate_repeatability,
    project_out_zeros,
    require_identifiable,
)
from orthocal.measurement.session import Session
from orthocal.measurement.session_file import load_session
from orthocal.robot.loading import packaged_robots
from orthocal.robot.model import read_only

Array = NDArray[np.float64]

SIGMA_WITHOUT_WORD = 10e-6
"""Standard deviation of a reading assumed at first where nothing tells it, [m]."""

SMALLEST_SIGMA = 1e-9
"""Standard deviation of a reading below which readings count as perfect, [m]."""

SIGMA_SETTLED = 0.01
"""Relative change of sigma below which it needs no further solution."""

MAX_SIGMA_ROUNDS = 8


def calibrate(
    session: Session | str | Path,
    *,
    model: str = "offsets",
    prior: bool | None = None,
    fixed: Mapping[str, float] | None = None,
    options: SolverOptions | None = None,
    start: ArrayLike | None = None,
) -> Calibration:
    """Identify the errors of a machine from a session, exactly, with their uncertainty.

    Args:
        session: The session, or the path to one.
        model: A model of the robot's YAML: `offsets`, `lengths`, `full` or one's own.
        prior: Whether tolerances act as a prior; by default not for `offsets`, else yes.
        fixed: Known values of parameters, which are then not free, [SI].
        options: How Ipopt is run.
        start: Free parameters to start from, shape (n_free,), [SI].

    Raises:
        NotIdentifiableError: If the readings leave a parameter open and there is no prior.
        SolverError: If Ipopt does not converge.
        ClosureError: If the machine cannot reach a posture.
        ParameterError: If the model or a name is unknown.
    """
    if not isinstance(session, Session):
        session = load_session(session)
    problem = build_problem(session, model=model, prior=prior, fixed=fixed)
    _, reference_jacobian = problem.linearise(problem.reference)
    at_reference = decompose(reference_jacobian, problem.observations)
    if not problem.prior:
        where = session.readings_path or session.path
        require_identifiable(
            at_reference, problem.free, where=None if where is None else str(where)
        )

    repeatability = estimate_repeatability(problem.values, problem.observations)
    sigma = _first_sigma(session, repeatability)
    program = NonlinearProgram(problem, options=options)
    solution, noise, information = _solve_with_noise(
        program, sigma=sigma, repeatability=repeatability, start=start
    )
    weight = max(noise.sigma, SMALLEST_SIGMA) if math.isfinite(noise.sigma) else sigma
    linear = solve_linearised(problem, sigma=weight)
    return _assemble_result(problem, program, solution, noise, information, linear, model)


def _first_sigma(session: Session, repeatability: tuple[float, int]) -> float:
    cycles_sigma, cycles_dof = repeatability
    if cycles_dof > 0:
        return max(cycles_sigma, SMALLEST_SIGMA)
    return session.gauge.sigma or SIGMA_WITHOUT_WORD


def _solve_with_noise(
    program: NonlinearProgram,
    *,
    sigma: float,
    repeatability: tuple[float, int],
    start: ArrayLike | None,
) -> tuple[Solution, Noise, Information]:
    """Solve; beside a prior, again until sigma is what the residuals say it is.

    Without a prior sigma does not matter to the estimate, and one solution is enough.
    """
    problem = program.problem
    passive: Array | None = None
    for _ in range(MAX_SIGMA_ROUNDS):
        solution = program.solve(sigma=sigma, start=start, start_passive=passive)
        prediction, jacobian = problem.linearise(solution.theta, solution.passive)
        information = decompose(jacobian, problem.observations)
        residual = project_out_zeros(problem.values - prediction, problem.observations)
        used = information.effective_parameters(sigma=sigma, prior=problem.prior)
        noise = estimate_noise(
            repeatability=repeatability,
            residual_square=float(residual @ residual),
            residual_dof=problem.observations.size - problem.observations.n_zeros - used,
            gauge_sigma=problem.session.gauge.sigma,
        )
        found = max(noise.sigma, SMALLEST_SIGMA)
        settled = not math.isfinite(found) or abs(found / sigma - 1.0) < SIGMA_SETTLED
        if settled or not problem.prior:
            break
        sigma, start, passive = found, solution.theta, solution.passive
    return solution, noise, information


def _assemble_result(
    problem: CalibrationProblem,
    program: NonlinearProgram,
    solution: Solution,
    noise: Noise,
    information: Information,
    linear: Array,
    model: str,
) -> Calibration:
    session, robot = problem.session, problem.robot
    scale = problem.theta_scale
    if math.isfinite(noise.sigma) and noise.sigma > 0.0:
        covariance = information.covariance(sigma=noise.sigma, prior=problem.prior)
        covariance = covariance * np.outer(scale, scale)
    elif noise.sigma == 0.0:  # readings without any scatter
        covariance = np.zeros((problem.n_free, problem.n_free))
    else:
        covariance = np.full((problem.n_free, problem.n_free), np.nan)
    std = np.sqrt(np.diag(covariance))
    determined = information.determined(sigma=noise.sigma)
    estimates = [
        ParameterEstimate(
            name=p.name,
            unit=p.unit,
            value=float(solution.theta[i]),
            linear=float(linear[i]),
            std=float(std[i]),
            tolerance=p.tolerance,
            free=True,
            identifiable=bool(determined[i]),
        )
        for i, p in enumerate(problem.parameters)
    ]
    for name, value in problem.fixed.items():
        p = robot.parameters[name]
        estimates.append(
            ParameterEstimate(name, p.unit, value, value, 0.0, p.tolerance, False, False)
        )
    only_differences = session.only_differences
    packaged = packaged_robots().get(session.robot_reference)
    folder = None if packaged is not None else str(robot.folder.resolve())
    offsets = session.controller_offsets
    return Calibration(
        robot_record=RobotRecord(robot.name, session.robot_reference, folder, robot.sha256),
        session=SessionRecord(
            path=None if session.path is None else str(session.path),
            title=session.title,
            source=session.source,
            sha256=session.sha256,
            gauge_sigma=session.gauge.sigma,
            gauge_resolution=session.gauge.resolution,
            controller_offsets=None if offsets is None else tuple(offsets.tolist()),
        ),
        model=model,
        prior=problem.prior,
        solver=SolverRecord(
            name="ipopt",
            status=solution.status,
            iterations=solution.iterations,
            seconds=solution.seconds_build + solution.seconds_solve,
            hessian=program.options.hessian,
        ),
        parameters=tuple(estimates),
        covariance=read_only(covariance),
        noise=NoiseRecord(
            reading_sigma=noise.sigma,
            source=noise.source,
            cycles_sigma=noise.cycles_sigma,
            cycles_dof=noise.cycles_dof,
            residual_sigma=noise.residual_sigma,
            residual_dof=noise.residual_dof,
        ),
        sigma=noise.sigma * (math.sqrt(2.0) if only_differences else 1.0),
        dof=noise.dof,
        rows_are_differences=only_differences,
        residuals=_residual_rows(problem, solution, linear),
        postures=tuple(
            PostureRecord(name, tuple(p.drives.tolist()), tuple(solution.passive[i].tolist()))
            for i, (name, p) in enumerate(session.postures.items())
        ),
        setups=_setup_records(problem, solution),
        version=__version__,
    )


def _residual_rows(
    problem: CalibrationProblem, solution: Solution, linear: Array
) -> tuple[ResidualRow, ...]:
    """Readings beside what three machines would show, each with its best gauge zeros."""
    o, measured = problem.observations, problem.values

    def fitted(prediction: Array) -> Array:
        residual = project_out_zeros(measured - prediction, o)
        return problem.session.values - o.rows(residual)

    nominal = fitted(problem.predict(problem.reference))
    by_linear = fitted(problem.predict(linear))
    predicted = fitted(problem.predict(solution.theta, solution.passive))
    return tuple(
        ResidualRow(r.setup, r.posture, r.minus, r.cycle, r.value, float(a), float(b), float(c))
        for r, a, b, c in zip(problem.session.readings, nominal, by_linear, predicted, strict=True)
    )


def _setup_records(problem: CalibrationProblem, solution: Solution) -> tuple[SetupRecord, ...]:
    o = problem.observations
    zeros = {
        name: float(solution.zeros[i])
        for i, (name, real) in enumerate(zip(o.zero_setup, o.zero_real, strict=True))
        if real
    }
    return tuple(
        SetupRecord(s.name, s.leg, s.direction, s.section.form, s.section.value, zeros.get(s.name))
        for s in problem.session.setups.values()
    )
