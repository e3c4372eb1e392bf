"""Fit of a problem: linearised start, noise, exact solution, information at the solution."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array, Mask
from orthocal.errors import ClosureError, SolverError
from orthocal.estimation.linear import LinearProblem, linearise_problem
from orthocal.estimation.loss import Loss
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.solvers.program import Program, Solution, advise
from orthocal.estimation.weighting import (
    GaugeReadings,
    NoiseEstimate,
    Scatter,
    first_sigma,
    initial_sigmas,
    leverages,
    split_by_gauge,
    with_initial_noise,
    with_repeatability,
)
from orthocal.observation.gauge_noise import SMALLEST_SIGMA, assumed_sigma
from orthocal.statistics.chance import COVERAGE, coverage_factor
from orthocal.statistics.information import (
    Information,
    Posterior,
    assume_others_known,
    decompose,
    marginalise,
    require_identifiable,
)
from orthocal.statistics.noise import Noise, estimate_repeatability
from orthocal.statistics.zeros import project_out_zeros

SIGMA_TOLERANCE = 0.03
"""Relative change of sigma at which it has converged: with a prior it changes no parameter by more
than a twentieth of its standard deviation."""

MAX_SIGMA_ROUNDS = 24
"""Largest number of solutions until sigma and the noise ratios converge. Otherwise, as when sigma
alternates between cycles and residuals, the last solution is returned, marked as not converged."""

SMALL_DOF = 20.0
"""Residual degrees of freedom below which the initial sigma does not come from residuals."""

MAX_LINEARISATION_RATIO = 10.0
"""RMS of the linearised residuals over the initial sigma above which the latter is rejected.
Nonlinearity alone remains below."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Solved problem."""

    problem: CalibrationProblem
    """The problem, with the noise ratios of the solution."""
    program: Program
    """Program that solved it."""
    iterations: int
    """Iterations of the solver in all solutions."""
    noise_converged: bool
    """False if sigma or a noise ratio still changed in the last solution."""
    linearisation: LinearProblem
    """Problem linearised about the active offsets of the controller."""
    linearised_theta: Array
    """Linearised solution, shape (n_free,), [SI]."""
    solution: Solution
    """Exact solution."""
    noises: NoiseEstimate
    """Noise of a reading of each gauge."""
    prediction: Array
    """Predicted readings h at the solution, gauge zeros at 0, shape (n_entries,), [noise-scaled m]
    (see `CalibrationProblem`)."""
    jacobian: Array
    """dh/dθ̂ at the solution, shape (n_entries, n_free), [noise-scaled m per prior std]."""
    information: Information
    """Information of the Jacobian."""
    seconds_build: float = 0.0
    """Time to build the functions and the program, [s]."""
    seconds_solve: float = 0.0
    """Time of all solutions, [s]."""

    @property
    def groups(self) -> tuple[GaugeReadings, ...]:
        """Entries of each gauge."""
        return split_by_gauge(self.problem.session, self.problem.observations)

    @property
    def noise(self) -> Noise:
        """Noise of a reading of the first gauge (`NoiseEstimate.common`)."""
        return self.noises.common

    @property
    def sigma(self) -> float:
        """Standard deviation of a reading of the first gauge, [m]; the assumed one if unknown."""
        if math.isfinite(self.noise.sigma):
            return floored_sigma(self.noise)
        return assumed_sigma(self.groups[0].gauge)

    @property
    def loss(self) -> Loss:
        """Cost of a residual."""
        return self.program.options.loss

    @property
    def residual(self) -> Array:
        """Readings minus predictions and zeros, shape (n_entries,), [noise-scaled m]."""
        return _residual(self.program, self.solution, self.prediction)

    @property
    def robust_weights(self) -> Array:
        """Robust weights ρ'(r)/r of the residuals, shape (n_entries,): 1 for squares."""
        return self.loss.weight(self.residual / self.sigma)

    @property
    def machine_information(self) -> Information:
        """Information about the machine, with nuisance parameters marginalised."""
        return marginalise(self.information, self.problem.n_machine, sigma=self.sigma)

    @property
    def independent_readings(self) -> int:
        """Number of independent readings: repeated ones once, minus gauge zeros."""
        o = self.problem.observations
        _, repeated = estimate_repeatability(self.problem.values, o)
        return o.size - o.n_free_zeros - repeated

    @property
    def at_bound(self) -> Mask:
        """Mask of the parameters at a bound, shape (n_free,); see `Selection.held_at_bound`."""
        return self.problem.selection.held_at_bound(self.solution.at_bound)

    def covariance(self, *, noise: float | None = None) -> Array:
        """Covariance of the free parameters by noise and priors, shape (n_free, n_free), [SI].

        It is NaN if nothing determines the noise.

        Args:
            noise: Standard deviation of a reading, [noise-scaled m]; by default `sigma`, with
                which the parameters were estimated.
        """
        return self._to_si(self._posterior(noise).covariance)

    def noise_covariance(self, *, noise: float | None = None) -> Array:
        """Part of `covariance` that is due to noise, shape (n_free, n_free), [SI]."""
        return self._to_si(self._posterior(noise).noise_covariance)

    def noise_coverage(self, *, separate: bool) -> float:
        """Coverage factor of the part of uncertainties that is due to noise, k_σ.

        Each gauge has the factor k_g of its noise, and causes the share w_gi of the noise variance
        of error i. Then k_i² = Σ_g w_gi k_g² covers at least 95 % (Banerjee, Sankhya 22, 1960). The
        result is the largest k_i of the errors of the machine. It is NaN if a noise is unknown.

        Args:
            separate: True if the noise is estimated without residuals, as a `noise` that is passed
                to `covariance`.
        """
        groups, problem = self.groups, self.problem
        dofs = [noise.dof for noise in self.noises.gauges]
        if separate:
            gauges = zip((g.gauge for g in groups), self.noises.gauges, strict=True)
            dofs = [n.without_residuals(g.sigma, g.resolution)[1] for g, n in gauges]
        factors = np.array([coverage_factor(dof) for dof in dofs])
        if len(groups) == 1:
            return float(factors[0])
        jacobian = project_out_zeros(self.jacobian, problem.observations)
        gain = self._posterior().inverse_normal[: problem.n_machine] @ jacobian.T
        shares = np.array([np.square(gain[:, g.entries]).sum(axis=1) for g in groups])
        shares = shares[:, shares.sum(axis=0) > 0.0]
        mean_squares = (factors**2 @ shares) / shares.sum(axis=0)
        return float(np.sqrt(mean_squares.max(initial=COVERAGE**2)))

    def inverse_normal(self) -> Array:
        """Inverse curvature of the objective, shape (n_free, n_free), [SI]."""
        return self._to_si(self._posterior().inverse_normal)

    def scaled_covariance(self) -> Array:
        """Part of `covariance` that is due to priors which the tolerance scale multiplies.

        Shape (n_free, n_free), [SI].
        """
        return self._to_si(self._posterior().prior_covariance(self.problem.selection.scaled))

    def _posterior(self, noise: float | None = None) -> Posterior:
        """Posterior of θ̂, for the argument `noise` of `covariance`."""
        gain, noise_factor = 1.0, 1.0
        if self.loss.robust:
            used = self.problem.observations.size - self.noise.residual_dof
            gain = self.loss.gain(self.residual / self.sigma, used=used)
            noise_factor = self.loss.normal_square
        if noise is not None:
            noise_factor *= (noise / self.sigma) ** 2
        return self.information.posterior(
            sigma=self.sigma,  # above 0, also for readings without scatter
            precision=self.problem.prior_precision,
            at_bound=self.at_bound,
            loss=(gain, noise_factor),
        )

    def _to_si(self, covariance: Array) -> Array:
        """Covariance of the free parameters, (n_free, n_free), [SI], from that of θ̂."""
        scale = np.outer(self.problem.theta_scale, self.problem.theta_scale)
        if not math.isfinite(self.noise.sigma):
            return np.full_like(scale, np.nan)
        return scale * covariance

    @property
    def mounting_covariance(self) -> Array:
        """Part of the covariance due to mounting errors, shape (n_machine, n_machine), [SI].

        It is that of squares even for a robust loss (see `find_mounting_covariance`).
        """
        return find_mounting_covariance(
            self.problem, self.information, sigma=self.sigma, at_bound=self.at_bound
        )


def fit_problem(
    problem: CalibrationProblem,
    *,
    options: SolverOptions | None = None,
    start: ArrayLike | None = None,
    program: Program | None = None,
    rounds: int = MAX_SIGMA_ROUNDS,
) -> Fit:
    """Solve a problem and estimate sigma, the standard deviation of a reading of the first gauge.

    Args:
        problem: The problem.
        options: Choice and options of the solver.
        start: Start values of the free parameters, shape (n_free,), [SI]; the only start that is
            tried. By default the linearised solution, then the active offsets.
        program: Program of the same problem with other readings, instead of `options`.
        rounds: Largest number of solutions until sigma and the noise ratios agree with the
            residuals.

    Raises:
        NotIdentifiableError: If neither readings nor a prior determine a parameter.
        SessionError: If a predicted reading is not finite at the active offsets.
        OrthocalError: If the solver does not accept an option.
        SolverError: If the solver does not converge, or its solution cannot reach a posture.
        ClosureError: If the machine cannot reach a posture.
    """
    began = time.perf_counter()
    groups = split_by_gauge(problem.session, problem.observations)
    groups = with_repeatability(groups, problem)
    if (problem.noise_ratio == 1.0).all():
        problem = with_initial_noise(problem)
    linear = linearise_problem(problem)
    require_determined(problem, linear.information)
    program = build_program(problem, options) if program is None else program.with_problem(problem)
    built = time.perf_counter()
    fit = _solve_with_noise(program, linear, groups, start, rounds=rounds)
    require_reachable(fit.problem, fit.solution, options=program.options)
    seconds = built - began, time.perf_counter() - built
    return replace(fit, seconds_build=seconds[0], seconds_solve=seconds[1])


def _solve_with_noise(
    program: Program,
    linear: LinearProblem,
    groups: Sequence[GaugeReadings],
    start: ArrayLike | None,
    *,
    rounds: int,
) -> Fit:
    """Solve repeatedly until sigma and the noise ratios of the gauges agree with the residuals."""
    problem = program.problem
    initial = initial_sigmas(problem.session, problem.observations)
    several = len(groups) > 1
    solution, sigma = _solve_first(program, linear, groups, start)
    iterations, mirrored = solution.iterations, True
    for remaining in reversed(range(rounds)):
        evaluation = _evaluate(program, solution, sigma, groups, initial)
        estimated, ratio = floored_sigma(evaluation.noises.common), evaluation.noises.ratio
        change = estimated / sigma * (ratio / problem.noise_ratio)  # of each entry's sigma
        converged = not math.isfinite(estimated) or _agrees(change)
        converged = converged or not (several or _depends_on_sigma(program))
        if (converged and mirrored) or not remaining:
            break
        if not converged:
            sigma = estimated
        if not converged and several:
            problem = problem.with_noise_ratio(ratio)
            program, linear = program.with_problem(problem), linearise_problem(problem)
        # the better sides of mirrored directions may depend on sigma: compare them again at the end
        mirrored = converged or not len(problem.mirrored)
        solution = program.solve(
            sigma=sigma, start=solution.theta, start_passive=solution.passive, mirrored=mirrored
        )
        iterations += solution.iterations
    noises = evaluation.noises
    if not math.isfinite(estimated) and _depends_on_sigma(program):
        # the last sigma was that of residuals with too few degrees of freedom
        sigma = float(initial[groups[0].entries][0])
        solution = program.solve(sigma=sigma, start=solution.theta, start_passive=solution.passive)
        iterations += solution.iterations
        evaluation = _evaluate(program, solution, sigma, groups, initial)
    if several:  # the noise of each gauge is that of the solution
        noises = noises.with_sigmas(groups, sigma * problem.noise_ratio)
    known = floored_sigma(noises.common)
    return Fit(
        problem=program.problem,
        program=program,
        iterations=iterations,
        noise_converged=converged,
        linearisation=linear,
        linearised_theta=linear.solve(sigma=known if math.isfinite(known) else sigma),
        solution=solution,
        noises=noises,
        prediction=evaluation.prediction,
        jacobian=evaluation.jacobian,
        information=evaluation.information,
    )


def _solve_first(
    program: Program,
    linear: LinearProblem,
    groups: Sequence[GaugeReadings],
    start: ArrayLike | None,
) -> tuple[Solution, float]:
    """First solution and its sigma, [m].

    Without a start, the linearised solutions are tried, then the active offsets.
    """
    sigma, residual_sigma = _linearised_sigma(program, linear, groups)
    if start is not None:
        return program.solve(sigma=sigma, start=np.asarray(start)), sigma
    sigmas = [sigma]
    if residual_sigma > sigma:  # unmodelled errors may be too large for the initial sigma
        sigmas.append(residual_sigma)
    for trial in sigmas:
        try:
            return program.solve(sigma=trial, start=linear.solve(sigma=trial)), trial
        except ClosureError:  # the linearised machine cannot reach a posture
            break
        except SolverError:
            continue
    return program.solve(sigma=sigma), sigma


@dataclass(frozen=True, slots=True, eq=False)
class _Evaluation:
    """Predictions and noise of a solution, with the fields of `Fit`."""

    prediction: Array
    jacobian: Array
    information: Information
    noises: NoiseEstimate


def _evaluate(
    program: Program,
    solution: Solution,
    sigma: float,
    groups: Sequence[GaugeReadings],
    initial: Array,
) -> _Evaluation:
    """Predictions, Jacobian and noise at a solution."""
    problem = program.problem
    at_bound = problem.selection.held_at_bound(solution.at_bound)
    prediction, jacobian = problem.predict_and_jacobian(solution.theta, solution.passive)
    information = decompose(jacobian, problem.observations)
    residual = _residual(program, solution, prediction)
    scatter = _scatter(program, (jacobian, information), residual, sigma, groups, at_bound)
    return _Evaluation(prediction, jacobian, information, scatter.estimate(initial))


def floored_sigma(noise: Noise) -> float:
    """Sigma of the noise, at least `SMALLEST_SIGMA`, [m]; NaN if unknown."""
    return max(noise.sigma, SMALLEST_SIGMA) if math.isfinite(noise.sigma) else math.nan


def require_reachable(
    problem: CalibrationProblem, solution: Solution, *, options: SolverOptions
) -> None:
    """Refuse a solution that cannot reach a posture. Wrong readings can lead to one.

    Args:
        problem: The problem.
        solution: Solution of the problem.
        options: Options of the solver.

    Raises:
        SolverError: If the machine cannot reach a posture; names it.
    """
    try:
        problem.close(solution.theta, start=solution.passive)
    except ClosureError as e:
        raise SolverError(
            f"the errors that fit these readings best are impossible: {e}. {advise(options)}",
            status=solution.status,
            iterations=solution.iterations,
        ) from None


def _depends_on_sigma(program: Program) -> bool:
    """True if the estimate depends on sigma: with a prior or a robust loss."""
    return program.problem.has_prior or program.options.loss.robust


def _agrees(change: ArrayLike) -> bool:
    """True if all ratios of new to previous standard deviations are near 1."""
    return bool(np.abs(np.asarray(change) - 1.0).max() < SIGMA_TOLERANCE)


def _linearised_sigma(
    program: Program, linearisation: LinearProblem, groups: Sequence[GaugeReadings]
) -> tuple[float, float]:
    """Sigma of the linearised problem, [m], which the exact solution usually confirms.

    With few residual degrees of freedom a stated initial sigma is used, unless the residuals reject
    it. An estimate from the residuals would count nonlinearity as noise.

    Returns:
        Sigma of the first solution, and sigma from the linearised residuals. They differ only if
        the initial sigma is used because of few degrees of freedom.
    """
    problem, linear = program.problem, (linearisation.jacobian, linearisation.information)
    sigma = initial = first_sigma(problem, groups)
    at_active = _scatter(program, linear, linearisation.residual, sigma, groups).common()
    small_dof = at_active.residual_dof < SMALL_DOF
    use_initial = all(g.gauge.sigma is not None for g in groups) and small_dof
    for i in range(MAX_SIGMA_ROUNDS if _depends_on_sigma(program) else 0):
        change = (linearisation.solve(sigma=sigma) - problem.active_theta) / problem.theta_scale
        residual = linearisation.residual - linearisation.jacobian @ change
        if i == 0:
            rejected = residual @ residual > residual.size * (MAX_LINEARISATION_RATIO * sigma) ** 2
            use_initial = use_initial and not rejected
        estimated = floored_sigma(_scatter(program, linear, residual, sigma, groups).common())
        if not math.isfinite(estimated) or _agrees(estimated / sigma):
            break
        sigma = estimated
    return (initial, sigma) if use_initial else (sigma, sigma)


def require_determined(problem: CalibrationProblem, information: Information) -> None:
    """Refuse parameters that neither the readings nor a prior determine.

    Raises:
        NotIdentifiableError: If there are such parameters; lists them.
    """
    session = problem.session
    where = session.readings_path or session.path
    require_identifiable(
        information,
        problem.machine_selection.names,
        precision=problem.prior_precision,
        where=None if where is None else str(where),
    )


def _residual(program: Program, solution: Solution, prediction: Array) -> Array:
    """Residuals with the optimal gauge zeros, shape (n_entries,), [noise-scaled m]."""
    problem, o = program.problem, program.problem.observations
    deviation = problem.values - prediction
    if program.options.loss.robust:
        return np.asarray(deviation - solution.zeros[o.zero])
    return project_out_zeros(deviation, o)


def _scatter(
    program: Program,
    linear: tuple[Array, Information],
    residual: Array,
    sigma: float,
    groups: Sequence[GaugeReadings],
    at_bound: Mask | None = None,
) -> Scatter:
    """Readings and residuals from which the noise is estimated.

    Args:
        program: The program.
        linear: dh/dθ̂, shape (n_entries, n_free), [noise-scaled m per prior std], and its
            information.
        residual: Residuals, zeros eliminated, shape (n_entries,), [noise-scaled m].
        sigma: Standard deviation of a reading of the first gauge in the present solution, [m].
        groups: The gauges.
        at_bound: Mask of the parameters at a bound, shape (n_free,).
    """
    problem, (jacobian, information) = program.problem, linear
    o, ratio = problem.observations, problem.noise_ratio
    posterior = information.posterior(
        sigma=sigma, precision=problem.prior_precision, at_bound=at_bound
    )
    if len(groups) > 1:
        used = leverages(jacobian, o, posterior.covariance, sigma)
    else:  # for one gauge only the sum of the leverages counts
        used = np.full(o.size, posterior.effective_parameters / o.size)
    return Scatter(
        groups=groups,
        observations=o,
        loss=program.options.loss,
        residual=residual * ratio,
        used=used,
        sigma=sigma * ratio,
    )


def build_program(problem: CalibrationProblem, options: SolverOptions | None = None) -> Program:
    """Program of a problem for the chosen solver; Ipopt by default."""
    options = options or SolverOptions()
    if options.solver == "variable-projection":
        from orthocal.estimation.solvers.variable_projection import VariableProjection

        return VariableProjection(problem, options=options)
    if options.solver == "linearised":
        from orthocal.estimation.solvers.linearised import LinearisedProgram

        return LinearisedProgram(problem, options=options)
    from orthocal.estimation.solvers.ipopt import NonlinearProgram

    return NonlinearProgram(problem, options=options)


def find_mounting_covariance(
    problem: CalibrationProblem,
    information: Information,
    *,
    sigma: float,
    at_bound: Mask,
) -> Array:
    """Part of the covariance of the machine's parameters that is due to nuisance parameters.

    It is the covariance minus that for known nuisance parameters. Most of these are mounting
    errors, which are independent between setups. So this part counts as independent between
    sessions, although a gauge's scale may be common to them.

    Args:
        problem: The problem.
        information: Information about all its parameters.
        sigma: Standard deviation of a reading, [m].
        at_bound: Mask of the parameters at a bound, shape (n_free,).

    Returns:
        Shape (n_machine, n_machine), [SI].
    """
    n, precision = problem.n_machine, problem.prior_precision
    total = information.posterior(sigma=sigma, precision=precision, at_bound=at_bound).covariance
    without_mounting = assume_others_known(information, n).posterior(
        sigma=sigma, precision=precision[:n], at_bound=at_bound[:n]
    )
    scale = problem.theta_scale[:n]
    return np.asarray((total[:n, :n] - without_mounting.covariance) * np.outer(scale, scale))
