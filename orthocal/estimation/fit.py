"""Fit of a problem: linearised start, noise, exact solution, information at the solution."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array, Mask
from orthocal.errors import ClosureError, SolverError
from orthocal.estimation.linear import Linearisation, linearise_at_reference
from orthocal.estimation.loss import Loss
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.solvers.program import Program, Solution
from orthocal.estimation.weighting import (
    SMALLEST_SIGMA,
    GaugeReadings,
    first_noise,
    leverages,
    split_by_gauge,
    stated_sigma,
    weigh_gauges,
)
from orthocal.statistics.information import (
    Information,
    decompose,
    marginalise,
    require_identifiable,
    take_for_known,
)
from orthocal.statistics.noise import Noise, estimate_noise, estimate_repeatability
from orthocal.statistics.zeros import project_out_zeros

SIGMA_SETTLED = 0.03
"""Relative change of sigma below which no further solution is needed: with a prior it changes no
parameter by more than a twentieth of its standard deviation."""

MAX_SIGMA_ROUNDS = 8

SMALL_DOF = 20.0
"""Residual degrees of freedom below which the first sigma is the stated one."""

MAX_LINEARISATION_RATIO = 10.0
"""Residuals of the linearised problem over the stated sigma that nonlinearity never reaches."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A solved problem."""

    problem: CalibrationProblem
    program: Program
    seconds_build: float
    """Time to build the functions and the program, [s]."""
    seconds_solve: float
    """Time to solve until sigma converged, [s]."""
    iterations: int
    """Iterations of the solver in all solutions."""
    linearisation: Linearisation
    """Linearisation about the active offsets of the controller."""
    linear: Array
    """Linearised solution, shape (n_free,), [SI]."""
    solution: Solution
    noise: Noise
    prediction: Array
    """h at the solution, gauge zeros at 0, shape (n_entries,), [m]."""
    jacobian: Array
    """dh/dθ̂ at the solution, shape (n_entries, n_free), [m per prior std]."""
    information: Information
    """Information of that Jacobian."""

    @property
    def sigma(self) -> float:
        """Standard deviation of a reading in the weights of the solution, [m].

        With several gauges, it belongs to the first.
        """
        if math.isfinite(self.noise.sigma):
            return max(self.noise.sigma, SMALLEST_SIGMA)
        return stated_sigma(self.problem.session.gauge, (math.nan, 0))

    @property
    def loss(self) -> Loss:
        """Cost of a residual."""
        return self.program.options.loss

    @property
    def residual(self) -> Array:
        """Readings less predictions and gauge zeros, shape (n_entries,), [m]."""
        return _residual(self.program, self.solution, self.prediction)

    @property
    def weights(self) -> Array:
        """Weights of the squared residuals, shape (n_entries,): 1 without a robust loss."""
        return self.loss.weight(self.residual / self.sigma)

    @property
    def machine_information(self) -> Information:
        """Information about the machine, nuisance parameters marginalised over their priors."""
        return marginalise(self.information, self.problem.n_machine, sigma=self.sigma)

    @property
    def independent_readings(self) -> int:
        """Number of independent readings: repeated ones once, minus gauge zeros."""
        o = self.problem.observations
        _, repeated = estimate_repeatability(self.problem.values, o)
        return o.size - o.n_free_zeros - repeated

    @property
    def held(self) -> Mask:
        """Mask of the parameters at a bound, shape (n_free,)."""
        return np.asarray(self.solution.at_bound != 0)

    def covariance(self) -> Array:
        """Covariance of the free parameters by noise and priors, (n_free, n_free), [SI].

        NaN where nothing determines the noise.
        """
        return self._scaled(self.information.covariance)

    def noise_covariance(self) -> Array:
        """Part of `covariance` that is due to noise, shape (n_free, n_free), [SI]."""
        return self._scaled(self.information.noise_covariance)

    def _scaled(self, covariance: Callable[..., Array]) -> Array:
        """Covariance of the scaled parameters with the weights of this fit, in SI units."""
        scale = np.outer(self.problem.theta_scale, self.problem.theta_scale)
        if not math.isfinite(self.noise.sigma):
            return np.full_like(scale, np.nan)
        factors = (1.0, 1.0)
        if self.loss.robust:
            used = self.problem.observations.size - self.noise.residual_dof
            gain = self.loss.gain(self.residual / self.sigma, used=used)
            factors = (gain, self.loss.normal_square)
        return scale * covariance(
            sigma=self.sigma,  # above 0, also for readings without scatter
            precision=self.problem.prior_precision,
            held=self.held,
            loss=factors,
        )

    @property
    def gauge_covariance(self) -> Array:
        """Part of the covariance that is due to mounting errors; see `find_gauge_covariance`."""
        return find_gauge_covariance(
            self.problem, self.information, sigma=self.sigma, held=self.held
        )


def fit_problem(
    problem: CalibrationProblem,
    *,
    options: SolverOptions | None = None,
    start: ArrayLike | None = None,
    program: Program | None = None,
) -> Fit:
    """Solve a problem exactly, with sigma from the readings if they determine it.

    Args:
        problem: The problem.
        options: Choice and options of the solver.
        start: Free parameters to start from, shape (n_free,), [SI]; by default the linearised
            solution.
        program: Program of the same problem with other readings; it replaces `options`.

    Raises:
        NotIdentifiableError: If neither readings nor a prior determine a parameter.
        SolverError: If the solver does not converge.
        ClosureError: If the machine cannot reach a posture.
    """
    began = time.perf_counter()
    groups = split_by_gauge(problem.session, problem.observations)
    if len(groups) > 1 and (problem.noise == 1.0).all():
        problem = problem.with_noise(first_noise(problem.session, problem.observations))
    linearisation = linearise_at_reference(problem)
    require_determined(problem, linearisation.information)
    repeatability = estimate_repeatability(problem.values, problem.observations)
    if program is None:
        program = build_program(problem, options)
    else:
        program = program.with_problem(problem)
    built = time.perf_counter()
    iterations = 0
    sigma, larger = _linearised_sigma(program, linearisation, repeatability)
    first = linearisation.solve(sigma=sigma) if start is None else np.asarray(start)
    passive: Array | None = None
    for _ in range(MAX_SIGMA_ROUNDS):
        try:
            solution = program.solve(sigma=sigma, start=first, start_passive=passive)
        except ClosureError:
            if start is not None or passive is not None:
                raise
            solution = program.solve(sigma=sigma)  # the linearised machine cannot reach a posture
        except SolverError:
            if start is not None or passive is not None or not larger > sigma:
                raise
            # the unmodelled errors may be too large for the stated sigma
            sigma, first = larger, linearisation.solve(sigma=larger)
            solution = program.solve(sigma=sigma, start=first)
        iterations += solution.iterations
        prediction, jacobian = problem.linearise(solution.theta, solution.passive)
        information = decompose(jacobian, problem.observations)
        residual = _residual(program, solution, prediction)
        held = solution.at_bound != 0
        noise = _noise(program, residual, information, sigma, repeatability, held=held)
        estimated = max(noise.sigma, SMALLEST_SIGMA)
        weights = problem.noise
        if len(groups) > 1:
            weights = _weigh(problem, groups, residual, jacobian, information, sigma, held)
        balanced = bool(np.abs(weights / problem.noise - 1.0).max() < SIGMA_SETTLED)
        if balanced and (not _matters(program) or _settled(estimated, sigma)):
            break
        first, passive = solution.theta, solution.passive
        if balanced:
            sigma = estimated
            continue
        problem = problem.with_noise(weights)
        program, linearisation = program.with_problem(problem), linearise_at_reference(problem)
    require_assembly(problem, solution, robust=program.options.loss.robust)
    weight = max(noise.sigma, SMALLEST_SIGMA) if math.isfinite(noise.sigma) else sigma
    return Fit(
        problem=problem,
        program=program,
        seconds_build=built - began,
        seconds_solve=time.perf_counter() - built,
        iterations=iterations,
        linearisation=linearisation,
        linear=linearisation.solve(sigma=weight),
        solution=solution,
        noise=noise,
        prediction=prediction,
        jacobian=jacobian,
        information=information,
    )


def _weigh(
    problem: CalibrationProblem,
    groups: Sequence[GaugeReadings],
    residual: Array,
    jacobian: Array,
    information: Information,
    sigma: float,
    held: Mask,
) -> Array:
    """Noise of each entry relative to the first gauge, from the residuals, (n_entries,)."""
    covariance = information.covariance(sigma=sigma, precision=problem.prior_precision, held=held)
    std = weigh_gauges(
        groups,
        problem.observations,
        residual=residual * problem.noise,
        leverage=leverages(jacobian, problem.observations, covariance, sigma),
        values=problem.values * problem.noise,
        sigma=sigma * problem.noise,
    )
    return np.asarray(std / std[groups[0].entries][0])


def require_assembly(problem: CalibrationProblem, solution: Solution, *, robust: bool) -> None:
    """Refuse a solution that cannot reach a posture: wrong readings can lead to impossible errors.

    Args:
        problem: The problem.
        solution: Its solution.
        robust: True if the loss was robust.

    Raises:
        SolverError: Naming the posture that the machine cannot reach.
    """
    try:
        problem.close(solution.theta, start=solution.passive)
    except ClosureError as e:
        hint = "" if robust else "; with the loss 'huber' it may be named"
        raise SolverError(
            f"the errors that fit these readings best are impossible: {e}. Look for a reading "
            f"with a wrong sign or in a wrong row{hint}",
            status=solution.status,
            iterations=solution.iterations,
        ) from None


def _matters(program: Program) -> bool:
    """True if the estimate depends on sigma: with a prior or a robust loss."""
    return program.problem.prior or program.options.loss.robust


def _settled(estimated: float, sigma: float) -> bool:
    return not math.isfinite(estimated) or abs(estimated / sigma - 1.0) < SIGMA_SETTLED


def _linearised_sigma(
    program: Program, linearisation: Linearisation, repeatability: tuple[float, int]
) -> tuple[float, float]:
    """Sigma of the linearised problem, [m]: usually close enough for one exact solution.

    With few residual degrees of freedom the stated sigma is used, unless the residuals exclude it:
    otherwise nonlinearity would count as noise, which would allow larger residuals, and so on.

    Returns:
        Sigma to start with, and sigma from the residuals, which is larger if the first one is
        stated.
    """
    problem = program.problem
    sigma = stated_sigma(problem.session.gauge, repeatability)
    stated = sigma
    few_are_free = _residual_dof(problem, linearisation.information, sigma) < SMALL_DOF
    use_stated = problem.session.gauge.sigma is not None and few_are_free
    for i in range(MAX_SIGMA_ROUNDS if _matters(program) else 0):
        change = (linearisation.solve(sigma=sigma) - problem.reference) / problem.theta_scale
        residual = linearisation.residual - linearisation.jacobian @ change
        if i == 0:
            excluded = residual @ residual > residual.size * (MAX_LINEARISATION_RATIO * sigma) ** 2
            use_stated = use_stated and not excluded
        noise = _noise(program, residual, linearisation.information, sigma, repeatability)
        estimated = max(noise.sigma, SMALLEST_SIGMA)
        if _settled(estimated, sigma):
            break
        sigma = estimated
    return (stated, sigma) if use_stated else (sigma, sigma)


def _residual_dof(
    problem: CalibrationProblem,
    information: Information,
    sigma: float,
    held: Mask | None = None,
) -> float:
    """Readings less free zeros and effective parameters."""
    o, precision = problem.observations, problem.prior_precision
    used = information.effective_parameters(sigma=sigma, precision=precision, held=held)
    return o.size - o.n_free_zeros - used


def require_determined(problem: CalibrationProblem, information: Information) -> None:
    """Refuse parameters that neither the readings nor a prior determine.

    Raises:
        NotIdentifiableError: Naming them.
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
    """Residuals with the optimal gauge zeros."""
    problem, o = program.problem, program.problem.observations
    deviation = problem.values - prediction
    if program.options.loss.robust:
        return np.asarray(deviation - solution.zeros[o.zero])
    return project_out_zeros(deviation, o)


def _noise(
    program: Program,
    residual: Array,
    information: Information,
    sigma: float,
    repeatability: tuple[float, int],
    *,
    held: Mask | None = None,
) -> Noise:
    """Noise from residuals with zeros eliminated, shape (n_entries,), [m]."""
    problem, loss = program.problem, program.options.loss
    dof = _residual_dof(problem, information, sigma, held)
    return estimate_noise(
        # a wrong reading in repeated cycles would increase the noise of all
        repeatability=(math.nan, 0) if loss.robust and dof > 1.0 else repeatability,
        residual_square=loss.robust_square(residual, dof=dof, start=sigma),
        residual_dof=dof,
        gauge_sigma=problem.session.gauge.sigma,
        resolution=problem.session.gauge.resolution,
    )


def build_program(problem: CalibrationProblem, options: SolverOptions | None = None) -> Program:
    """A problem prepared for the chosen solver; Ipopt by default."""
    chosen = options or SolverOptions()
    if chosen.solver == "variable-projection":
        from orthocal.estimation.solvers.variable_projection import VariableProjection

        return VariableProjection(problem, options=chosen)
    if chosen.solver == "linearised":
        from orthocal.estimation.solvers.linearised import LinearisedProgram

        return LinearisedProgram(problem, options=chosen)
    from orthocal.estimation.solvers.ipopt import NonlinearProgram

    return NonlinearProgram(problem, options=chosen)


def find_gauge_covariance(
    problem: CalibrationProblem,
    information: Information,
    *,
    sigma: float,
    held: Mask | None = None,
) -> Array:
    """Part of the covariance of the machine's parameters that is due to mounting errors.

    The covariance less that with known nuisance parameters. Other setups have other mounting
    errors, so this part is independent between sessions.

    Args:
        problem: The problem.
        information: Information about all its parameters.
        sigma: Standard deviation of a reading, [m].
        held: Mask of the parameters that a bound holds, shape (n_free,).

    Returns:
        Shape (n_machine, n_machine), [SI].
    """
    n, precision = problem.n_machine, problem.prior_precision
    held = np.zeros(problem.n_free, dtype=np.bool_) if held is None else held
    total = information.covariance(sigma=sigma, precision=precision, held=held)
    without_mounting = take_for_known(information, n).covariance(
        sigma=sigma, precision=precision[:n], held=held[:n]
    )
    scale = problem.theta_scale[:n]
    return np.asarray((total[:n, :n] - without_mounting) * np.outer(scale, scale))
