"""Batch solver: the optimum of each of many sets of readings of one problem.

The Gauss-Newton method runs on all sets at once, from the linearised solutions, with the Jacobian
of each set. An active-set method keeps the steps within the bounds. Sets that do not converge, or
that end far from their prior, are solved one by one by variable projection. All sets of a problem
with mirrored directions are solved in this way. Every set therefore has the same optimum as if it
was solved alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.arrays import Array, Mask
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.solvers.subproblem import RANK_TOLERANCE, are_far, bounded_step
from orthocal.estimation.solvers.variable_projection import VariableProjection, have_converged
from orthocal.statistics.zeros import project_out_zeros

MAX_STEPS = 30
"""Largest number of common iterations."""

MAX_STEP_SIZE = 100.0
"""Largest step of a parameter, [prior std]; sets with longer steps are solved one by one."""

MAX_JACOBIAN_NUMBERS = 2**21
"""Largest number of elements of all Jacobians of the sets that are solved together."""

MAX_BATCH_STATES = 4096
"""Largest number of states of the sets that are solved together."""


@dataclass(frozen=True, slots=True, eq=False)
class BatchSolution:
    """Solutions of S sets of readings."""

    theta: Array
    """Free parameters, shape (S, n_free), [SI]."""
    zeros: Array
    """Gauge zeros, shape (S, n_zeros), [noise-scaled m]."""
    objective: Array
    """Objectives (see `Solution`), shape (S,)."""
    at_bound: NDArray[np.int8]
    """-1, 0 or 1 (see `Solution`), shape (S, n_free)."""
    solved_alone: Mask
    """Mask of the sets that were solved one by one, shape (S,)."""


class BatchSolver:
    """Solver of a calibration problem for many independent sets of readings.

    Args:
        problem: The problem; the values of its readings are not used.
        options: Loss, and `max_iterations` of the sets that are solved one by one.
    """

    def __init__(
        self, problem: CalibrationProblem, *, options: SolverOptions | None = None
    ) -> None:
        self.problem = problem
        self.options = options or SolverOptions(solver="variable-projection")

    def solve(self, values: ArrayLike, *, sigma: float) -> BatchSolution:
        """Solve the problem for each set of readings.

        Args:
            values: Readings of the entries, shape (S, n_entries), [noise-scaled m].
            sigma: Standard deviation of one reading, [m].

        Raises:
            SolverError: If a set does not converge.
            ClosureError: If the machine cannot reach a posture with the start values.
        """
        problem, y = self.problem, np.asarray(values, dtype=np.float64)
        shared = _BatchTask(problem, self.options, sigma)
        n_sets, n = len(y), problem.n_free
        solution = BatchSolution(
            np.empty((n_sets, n)),
            np.empty((n_sets, problem.observations.n_zeros)),
            np.empty(n_sets),
            np.zeros((n_sets, n), dtype=np.int8),
            np.zeros(n_sets, dtype=np.bool_),
        )
        numbers = max(problem.observations.size * n, 1)
        size = max(
            1, min(MAX_JACOBIAN_NUMBERS // numbers, MAX_BATCH_STATES // max(problem.n_states, 1))
        )
        if len(problem.mirrored.of_task(sigma, ())):  # their sides are compared one by one
            solution.solved_alone[:] = True
        for first in range(0, 0 if solution.solved_alone.all() else n_sets, size):
            part = slice(first, first + size)
            self._solve_part(shared, y[part], solution, part)
        program = VariableProjection(problem, options=self.options)
        for i in np.flatnonzero(solution.solved_alone).tolist():
            single = program.solve(sigma=sigma, values=y[i])
            solution.theta[i], solution.zeros[i] = single.theta, single.zeros
            solution.objective[i], solution.at_bound[i] = single.objective, single.at_bound
        return solution

    def _solve_part(
        self, shared: _BatchTask, y: Array, solution: BatchSolution, part: slice
    ) -> None:
        """Solve some sets by common Gauss-Newton steps, and fill their part of the solution.

        Sets that do not converge are marked as `solved_alone`.
        """
        problem, sigma = self.problem, shared.sigma
        theta = shared.linearised_solutions(y)
        passive = problem.active_passive + shared.linear.follow(theta - shared.start)
        active, converged = np.arange(len(y)), np.zeros(len(y), dtype=np.bool_)
        sizes, reading = np.full((3, len(y)), np.inf), np.empty_like(y)
        at_bound = solution.at_bound[part]
        for _ in range(MAX_STEPS):
            try:
                linear = problem.linearise(theta[active] * problem.theta_scale, passive[active])
            except np.linalg.LinAlgError:  # a singular posture: active sets are solved one by one
                break
            closed = linear.reading + linear.opening
            residual, _, _ = shared.residual((y[active] - closed) / sigma)
            step, at_bound[active] = shared.step(theta[active], residual, linear.jacobian)
            reading[active] = closed + (linear.jacobian @ step[..., None])[..., 0]
            theta[active] = np.clip(theta[active] + step, shared.low, shared.high)
            passive[active] += linear.follow(step)
            sizes = np.roll(sizes, 1, axis=0)
            sizes[0, active] = np.abs(step).max(axis=1)
            done = have_converged(sizes[:, active])
            converged[active] = done
            active = active[~done & (sizes[0, active] < MAX_STEP_SIZE)]
            if not active.size:
                break
        zeros, objective, good = shared.evaluate(y, theta, reading)
        solution.theta[part], solution.zeros[part] = theta * problem.theta_scale, zeros
        solution.objective[part], solution.solved_alone[part] = objective, ~(good & converged)


class _BatchTask:
    """Vectorised `Task` (module `subproblem`) for many sets of readings.

    Attributes:
        sigma: Standard deviation of one reading, [m].
        low: Lower bounds of θ̂, shape (n_free,).
        high: Upper bounds of θ̂, shape (n_free,).
        start: θ̂ at the active offsets, shape (n_free,).
        linear: Readings linearised about the active offsets.
    """

    def __init__(self, problem: CalibrationProblem, options: SolverOptions, sigma: float) -> None:
        self.problem, self.loss, self.sigma = problem, options.loss, sigma
        o, scale = problem.observations, problem.theta_scale
        self.low, self.high = problem.selection.lower / scale, problem.selection.upper / scale
        self._mean = problem.prior_mean / scale
        self._precision = problem.prior_precision
        self.start = problem.active_theta / scale
        self._counts = np.bincount(o.zero, minlength=o.n_zeros).astype(np.float64)
        self._incidence = problem.zero_incidence
        self._free_incidence = problem.zero_incidence * ~o.zero_known
        self.linear = problem.linearisation_at_active
        self._jacobian = project_out_zeros(self.linear.jacobian / sigma, o)
        normal = self._jacobian.T @ self._jacobian + np.diag(self._precision)
        self._inverse = np.linalg.pinv(normal, rcond=RANK_TOLERANCE, hermitian=True)

    def linearised_solutions(self, y: Array) -> Array:
        """Linearised solutions, clipped to the bounds, as start values θ̂, shape (S, n_free)."""
        deviation = ((y - self.linear.reading) / self.sigma).T
        residual = project_out_zeros(deviation, self.problem.observations).T
        gradient = residual @ self._jacobian - self._precision * (self.start - self._mean)
        return np.asarray(np.clip(self.start + gradient @ self._inverse, self.low, self.high))

    def residual(self, deviation: Array) -> tuple[Array, Array, Array]:
        """Residuals with optimal zeros.

        Args:
            deviation: Readings minus predictions, shape (S, n_entries), [σ].

        Returns:
            Residuals, shape (S, n_entries), [σ]; gauge zeros, shape (S, n_zeros), [σ]; and Σ ρ,
            shape (S,).
        """
        n, o = len(deviation), self.problem.observations
        if self.loss.robust:
            group = (np.arange(n)[:, None] * o.n_zeros + o.zero).reshape(-1)
            flat = deviation.reshape(-1)
            zeros = self.loss.centres(flat, group, n * o.n_zeros, weights=np.ones(flat.size))
            zeros = zeros.reshape(n, -1)
        else:
            zeros = deviation @ self._incidence / self._counts
        zeros = np.where(o.zero_known, 0.0, zeros)
        residual = deviation - zeros[:, o.zero]
        return residual, zeros, self.loss.value(residual).sum(axis=1)

    def step(
        self, theta: Array, residual: Array, jacobian: Array
    ) -> tuple[Array, NDArray[np.int8]]:
        """Gauss-Newton steps s = (JᵀWJ + P⁻¹)⁻¹ (Jᵀρ' − P⁻¹ (θ̂ − mean)) within the bounds.

        W are the weights ρ'(r)/r and P⁻¹ is the prior precision. J is dh/dθ̂ in σ; from each row
        the weighted mean of the rows with the same free zero is subtracted.

        Args:
            theta: θ̂, shape (S, n_free).
            residual: Residuals r, shape (S, n_entries), [σ].
            jacobian: dh/dθ̂, shape (S, n_entries, n_free), [noise-scaled m per prior std].

        Returns:
            Steps, shape (S, n_free), and the bounds at which they end (see `Solution.at_bound`).
        """
        rows = jacobian / self.sigma
        gradient = (self.loss.influence(residual)[:, None] @ rows)[:, 0]
        gradient -= self._precision * (theta - self._mean)
        weighted, sums = rows, self._counts[None, :, None]
        if self.loss.robust:
            weights = self.loss.weight(residual)[..., None]
            weighted, sums = weights * rows, self._incidence.T @ weights
        by_zero = self._free_incidence.T @ weighted
        normal = np.swapaxes(rows, 1, 2) @ weighted + np.diag(self._precision)
        normal -= np.swapaxes(by_zero, 1, 2) @ (by_zero / sums)
        try:
            steps = np.linalg.solve(normal, gradient[..., None])
        except np.linalg.LinAlgError:
            inverses = np.linalg.pinv(normal, rcond=RANK_TOLERANCE, hermitian=True)
            steps = inverses @ gradient[..., None]
        result: Array = np.asarray(steps[..., 0])
        low, high = self.low - theta, self.high - theta
        at_bound: NDArray[np.int8] = np.zeros(theta.shape, dtype=np.int8)
        for i in np.flatnonzero(((result < low) | (result > high)).any(axis=1)):
            result[i] = bounded_step(normal[i], gradient[i], low[i], high[i])
            slope = normal[i] @ result[i] - gradient[i]
            at_bound[i, (result[i] <= low[i]) & (slope > 0.0)] = -1
            at_bound[i, (result[i] >= high[i]) & (slope < 0.0)] = 1
        return result, at_bound

    def evaluate(self, y: Array, theta: Array, reading: Array) -> tuple[Array, Array, Mask]:
        """Evaluate solutions of sets of readings.

        Args:
            y: Readings, shape (S, n_entries), [noise-scaled m].
            theta: θ̂, shape (S, n_free).
            reading: Predicted readings, shape (S, n_entries), [noise-scaled m].

        Returns:
            Zeros, shape (S, n_zeros), [noise-scaled m]; objectives, shape (S,); and a mask of
            the sets that are finite and not far from their prior, shape (S,).
        """
        _, zeros, cost = self.residual((y - reading) / self.sigma)
        objective = cost + 0.5 * (self._precision * (theta - self._mean) ** 2).sum(axis=1)
        good = np.isfinite(objective) & ~are_far(self.problem, theta)
        return zeros * self.sigma, objective, good
