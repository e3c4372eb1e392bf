"""Identification of the errors of a machine from a session, without assessment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arguments import require_kind, require_names
from orthocal.arrays import Array
from orthocal.calibration.build_record import assemble_calibration
from orthocal.calibration.calibration import Calibration
from orthocal.errors import NotIdentifiableError, ParameterError
from orthocal.estimation.choice import Choice, resolve_choice
from orthocal.estimation.diagnostics.profile_likelihood import profile_interval
from orthocal.estimation.fit import Fit, fit_problem
from orthocal.estimation.linear import linearise_problem
from orthocal.estimation.loss import Loss, LossKind
from orthocal.estimation.options import SolverKind, SolverOptions
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.tolerance_scale import AS_STATED, ToleranceScale
from orthocal.estimation.weighting import first_sigma, split_by_gauge, with_initial_noise
from orthocal.kinematics.loop_closure import as_rows
from orthocal.measurement.joining import Given, gather_sessions, join_sessions
from orthocal.observation.observations import require_conditions
from orthocal.session.completeness import require_complete
from orthocal.session.session import Session
from orthocal.statistics.identifiability import find_base_parameters
from orthocal.statistics.information import marginalise

MAX_BASE_ROUNDS = 8
"""Largest number of fits until the base parameters do not change."""


def identify(
    sessions: Given | Sequence[Given],
    choice: Choice | str | None = None,
    *,
    loss: Loss | LossKind | None = None,
    solver: SolverOptions | SolverKind = "ipopt",
    profile: Sequence[str] = (),
    start: ArrayLike | None = None,
    find_scale: Callable[[Session], ToleranceScale] | None = None,
) -> tuple[Calibration, Session]:
    """Identify the errors of a machine from a session, with their uncertainty; not assessed.

    Args:
        sessions: The session, or the path to one; or several, which are fitted together.
        choice: Free errors, known errors and priors; or the name of a model. By default the choice
            that the session states.
        loss: `squares` (the default), `huber` (pseudo-Huber), or a Loss with another width.
        solver: `ipopt` on the complete program, the reference; `variable-projection`, the same
            optimum in less time; `linearised`, one step about the active offsets; or
            SolverOptions.
        profile: Names or globs of free parameters whose profile-likelihood intervals are computed.
        start: Initial values of the free errors of the machine, shape (n_machine,), [SI]; nuisance
            parameters then start at 0. By default all parameters start at the linearised solution.
        find_scale: Function that returns the tolerance scale of the session; by default the
            stated tolerances are used.

    Returns:
        The calibration and its session, or the joined sessions.

    Raises:
        NotIdentifiableError: If neither readings nor a prior determine a parameter.
        SolverError: If the solver does not converge.
        ClosureError: If the machine cannot reach a posture.
        ParameterError: If the model or a name is unknown.
        SessionError: If a reading lacks a condition that the effect of a free parameter needs.
        TypeError: If an argument is of another kind.
        ValueError: If `start` does not have one number for each free error of the machine.
    """
    gathered = gather_sessions(sessions)
    if isinstance(choice, Choice):
        gathered = [choice.applied_to(one) for one in gathered]
    session = join_sessions(gathered)
    require_complete(session)
    profile = require_names(profile, argument="profile")
    chosen = resolve_choice(choice, session)
    options = _solver_options(solver, loss)
    problem = CalibrationProblem(session, chosen.select(session.robot.parameters))
    require_conditions(session, problem.machine_selection.names)
    _match_profiled(problem, profile)  # refused before the fit
    start_values = None if start is None else _read_start(start, problem)
    scale = AS_STATED if find_scale is None else find_scale(session)
    if chosen.base:  # without priors
        scale = AS_STATED
    if scale.factor != 1.0:
        selection = chosen.select(session.robot.parameters, tolerance_scale=scale)
        problem = CalibrationProblem(session, selection)
    fit = (_fit_base if chosen.base else fit_problem)(problem, options=options, start=start_values)
    profiled = _match_profiled(fit.problem, profile)
    calibration = assemble_calibration(fit, full_problem=problem if chosen.base else None)
    return _with_intervals(calibration, fit, profiled), session


def _read_start(start: ArrayLike, problem: CalibrationProblem) -> Array:
    """Initial free parameters, shape (n_free,), [SI]; nuisance parameters are 0.

    Raises:
        ValueError: If there is not one finite number for each free error of the machine.
    """
    n = problem.n_machine
    rows, _ = as_rows(start, n, "start values")
    if rows.shape != (1, n) or not np.isfinite(rows).all():
        raise ValueError(f"expected {n} finite numbers to start from")
    return np.append(rows[0], np.zeros(problem.n_free - n))


def _solver_options(
    solver: SolverOptions | SolverKind, loss: Loss | LossKind | None
) -> SolverOptions:
    """Solver options with a loss, from names or objects."""
    require_kind(solver, (SolverOptions, str), expected="a solver's name, or SolverOptions(...)")
    require_kind(loss, (Loss, str, type(None)), expected="a loss's name, or Loss(...)")
    options = solver if isinstance(solver, SolverOptions) else SolverOptions(solver=solver)
    if loss is None:
        return options
    return replace(options, loss=loss if isinstance(loss, Loss) else Loss(loss))


def _fit_base(
    problem: CalibrationProblem, *, options: SolverOptions | None, start: Array | None
) -> Fit:
    """Solve a problem in base parameters: linear combinations of inseparable parameters.

    Their number depends on the noise, and the noise on the residuals. The fit is iterated until the
    base parameters do not change.
    """
    information = linearise_problem(with_initial_noise(problem)).information
    groups = split_by_gauge(problem.session, problem.observations)
    sigma = first_sigma(problem, groups)
    base_names: list[str] = []
    for _ in range(MAX_BASE_ROUNDS):
        factor = marginalise(information, problem.n_machine, sigma=sigma).factor
        machine = problem.machine_selection.parameters
        combinations = find_base_parameters(factor, machine, threshold=sigma)
        if not combinations:
            raise NotIdentifiableError(
                "the readings determine none of the free parameters",
                parameters=problem.machine_selection.names,
            )
        names = [c.terms[0][0] for c in combinations]  # one parameter for each combination
        if names == base_names:
            break
        base_names = names
        reduced = CalibrationProblem(problem.session, problem.machine_selection.keep(base_names))
        of_reduced = [problem.free.index(name) for name in reduced.free]
        reduced_start = None if start is None else start[of_reduced]
        fit = fit_problem(reduced, options=options, start=reduced_start)
        sigma = max(fit.sigma, sigma)  # no more parameters than before
        if len(groups) > 1:
            weighted = problem.with_noise_ratio(fit.problem.noise_ratio)
            information = linearise_problem(weighted).information
    return fit


def _with_intervals(calibration: Calibration, fit: Fit, names: Sequence[str]) -> Calibration:
    """Calibration of a fit with profile-likelihood intervals of some parameters."""
    estimates = list(calibration.parameters)
    totals, biases = calibration.expanded_uncertainties, calibration.expanded_biases
    parts = np.sqrt(np.maximum(totals**2 - biases**2, 0.0)).tolist()
    for i, (part, bias) in enumerate(zip(parts, biases.tolist(), strict=True)):
        if (p := estimates[i]).name in names:
            interval = profile_interval(fit, p.name, uncertainty=part, bias=bias)
            estimates[i] = replace(p, interval=interval)
    return replace(calibration, parameters=tuple(estimates))


def _match_profiled(problem: CalibrationProblem, patterns: Sequence[str]) -> list[str]:
    """Names of the free parameters that match patterns."""
    if not patterns:
        return []
    names = [n for n in problem.robot.parameters.select(patterns) if n in problem.free]
    if not names:
        raise ParameterError(f"{', '.join(patterns)}: no free parameter to find the interval of")
    return names
