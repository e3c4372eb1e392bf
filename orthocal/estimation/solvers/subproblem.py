"""Problem in its free parameters alone, for one set of readings, and its Gauss-Newton step.

The passive coordinates follow the parameters by the implicit function theorem, ∂q/∂θ = −g_q⁻¹ g_θ.
Free gauge zeros have their optimal values. The remaining problem is small and dense.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array, Mask
from orthocal.errors import SolverError
from orthocal.estimation.loss import Loss
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.solvers.program import CONVERGED, Solution, SolverInput, scaled_bounds
from orthocal.observation.model import ReadingLinearisation

SUBPROBLEM_TOLERANCE = 1e-11
"""Step of a subproblem with a robust loss below which it has converged, [prior std]."""

MAX_SUBPROBLEM_STEPS = 100
"""Largest number of steps of a subproblem with a robust loss."""

RANK_TOLERANCE = 1e-13
"""Eigenvalues of the normal matrix below this fraction of the largest one count as zero."""

MAX_PRIOR_DEVIATION = 8.0
"""Deviation of a parameter from the mean of its prior above which an optimum is doubtful,
[prior std]: it is a local minimum, or readings are wrong."""

MAX_NUMPY_SIZE = 50
"""Largest number of unknowns for which NumPy takes less time than the import of SciPy."""


@dataclass(frozen=True, slots=True, eq=False)
class Iterate:
    """Problem at a point θ̂."""

    theta: Array
    """θ̂, shape (n_free,)."""
    passive: Array
    """Passive coordinates, shape (n_states, n_passive), [m, rad]; of the linearised problem, those
    at the point of linearisation."""
    deviation: Array
    """Readings minus predictions without gauge zeros, shape (n_entries,), [σ]."""
    zeros: Array
    """Gauge zeros, shape (n_zeros,), [σ]."""
    objective: float
    """Objective (see `Solution`)."""


class Task:
    """Problem for one set of readings, with their weights and the bounds of θ̂.

    Args:
        problem: The problem.
        loss: Cost of a residual.
        data: Readings, weights, start and prescribed values.

    Attributes:
        problem: The problem.
        loss: The loss function.
        data: The input of the solver.
        sigma: Standard deviation of one reading, [m].
        weights: Weights of the entries, shape (n_entries,).
        low: Lower bounds of θ̂, shape (n_free,).
        high: Upper bounds of θ̂, shape (n_free,).
    """

    def __init__(self, problem: CalibrationProblem, loss: Loss, data: SolverInput) -> None:
        self.problem, self.loss, self.data = problem, loss, data
        self.sigma, self.weights = data.sigma, data.weights
        self.low, self.high = scaled_bounds(problem, data.prescribed)

    def clip(self, theta: Array) -> Array:
        """θ̂ within the bounds, shape (n_free,).

        Args:
            theta: Free parameters, shape (n_free,), [SI].
        """
        return np.clip(theta / self.problem.theta_scale, self.low, self.high)

    def solution(
        self, state: Iterate, jacobian: Array, *, passive: Array, iterations: int
    ) -> Solution:
        """Solution of the task.

        Args:
            state: The optimum.
            jacobian: dh/dθ̂ at the optimum, shape (n_entries, n_free), [σ per prior std].
            passive: Passive coordinates, shape (n_states, n_passive), [m, rad].
            iterations: Number of iterations.
        """
        gradient = self.gradient(state, jacobian)
        at_bound = np.zeros(state.theta.size, dtype=np.int8)
        at_bound[(state.theta <= self.low) & (gradient > 0.0)] = -1
        at_bound[(state.theta >= self.high) & (gradient < 0.0)] = 1
        at_bound[list(self.data.prescribed)] = 0
        return Solution(
            theta=state.theta * self.problem.theta_scale,
            zeros=state.zeros * self.sigma,
            passive=passive,
            objective=state.objective,
            status=CONVERGED,
            iterations=iterations,
            hessian="gauss-newton",
            closure=0.0,
            at_bound=at_bound,
        )

    def at(self, theta: Array, passive: Array | None) -> Iterate:
        """Problem at a point with closed loops.

        Args:
            theta: θ̂, shape (n_free,).
            passive: Start values of the passive coordinates, shape (n_states, n_passive), [m, rad].

        Raises:
            ClosureError: If the machine cannot reach a posture.
        """
        problem = self.problem
        theta_si = theta * problem.theta_scale
        closed = problem.close(theta_si, start=passive)
        deviation = (self.data.values - problem.predict(theta_si, closed)) / self.sigma
        return self._state(theta, closed, deviation)

    def begin(self) -> tuple[Iterate, ReadingLinearisation]:
        """Problem and its linearisation at the start values.

        Raises:
            ClosureError: If the machine cannot reach a posture.
            SolverError: If a sensor has no reading.
        """
        problem, passive = self.problem, self.data.start_passive
        theta = self.clip(self.data.start)
        at_active = np.array_equal(theta * problem.theta_scale, problem.active_theta)
        if passive is None and at_active:
            passive = problem.active_passive
        else:
            first = problem.active_passive if passive is None else passive
            passive = problem.close(theta * problem.theta_scale, start=first)
        linear = self.linearise(theta, passive)
        if not np.isfinite(linear.jacobian).all():
            raise SolverError(
                "cannot start: with the start values of the errors a tip misses its target, or a "
                "sensor has no reading; look for a wrong sign, row or setup",
                status="Invalid_Number_Detected",
                iterations=0,
            )
        return self.near(theta, passive, linear), linear

    def linearise(self, theta: Array, passive: Array) -> ReadingLinearisation:
        """Linearise readings about θ̂ and passive coordinates near closed loops."""
        return self.problem.linearise(theta * self.problem.theta_scale, passive)

    def near(self, theta: Array, passive: Array, linear: ReadingLinearisation) -> Iterate:
        """Problem at θ̂, with loops closed to first order."""
        predicted = linear.reading + linear.opening
        return self._state(theta, passive, (self.data.values - predicted) / self.sigma)

    def linearised_at(self, state: Iterate, jacobian: Array, change: Array) -> Iterate:
        """Linearised problem at another θ̂.

        Args:
            state: The point of linearisation.
            jacobian: dh/dθ̂ at this point, shape (n_entries, n_free), [σ per prior std].
            change: Change of θ̂, shape (n_free,).
        """
        return self._state(state.theta + change, state.passive, state.deviation - jacobian @ change)

    def step(self, state: Iterate, jacobian: Array) -> Array:
        """Change of θ̂ that solves the linearised problem, shape (n_free,).

        Squares need one linear solution. A robust loss needs Newton's method with weights ρ''. If
        this does not decrease the objective, the weights are those of the secant ρ'/r, which always
        decrease it.

        Args:
            state: The point of linearisation.
            jacobian: dh/dθ̂ at this point, shape (n_entries, n_free), [σ per prior std].
        """
        present = state
        if not self.loss.robust:
            return self._newton_step(present, jacobian, self.weights)
        for _ in range(MAX_SUBPROBLEM_STEPS):
            residual = present.deviation - present.zeros[self.problem.observations.zero]
            for weights in (self.loss.curvature(residual), self.loss.weight(residual)):
                change = self._newton_step(present, jacobian, self.weights * weights)
                trial = self.linearised_at(present, jacobian, change)
                if trial.objective <= present.objective:
                    break
            converged = float(np.abs(change).max(initial=0.0)) < SUBPROBLEM_TOLERANCE
            if converged or trial.objective > present.objective:
                break
            present = trial
        return np.asarray(present.theta - state.theta)

    def _newton_step(self, state: Iterate, jacobian: Array, weights: Array) -> Array:
        """Newton step with weights of the entries, within the bounds, shape (n_free,)."""
        normal = self._normal_matrix(jacobian, weights)
        normal[np.diag_indices_from(normal)] += self.problem.prior_precision
        limits = self.low - state.theta, self.high - state.theta
        return bounded_step(normal, -self.gradient(state, jacobian), *limits)

    def gradient(self, state: Iterate, jacobian: Array) -> Array:
        """Gradient of the objective with respect to θ̂, shape (n_free,)."""
        residual = state.deviation - state.zeros[self.problem.observations.zero]
        prior = self.problem.prior_precision * self._from_mean(state.theta)
        return np.asarray(prior - jacobian.T @ (self.weights * self.loss.influence(residual)))

    def _state(self, theta: Array, passive: Array, deviation: Array) -> Iterate:
        """Problem with optimal gauge zeros for deviations, shape (n_entries,), [σ]."""
        o, from_mean = self.problem.observations, self._from_mean(theta)
        zeros = self.loss.centres(deviation, o.zero, o.n_zeros, weights=self.weights)
        zeros[o.zero_known] = 0.0
        prior = 0.5 * float(from_mean @ (self.problem.prior_precision * from_mean))
        cost = float(self.weights @ self.loss.value(deviation - zeros[o.zero]))
        return Iterate(theta, passive, deviation, zeros, cost + prior)

    def _from_mean(self, theta: Array) -> Array:
        """Deviation of θ̂ from the mean of its prior, shape (n_free,)."""
        return np.asarray(theta - self.problem.prior_mean / self.problem.theta_scale)

    def _normal_matrix(self, jacobian: Array, weights: Array) -> Array:
        """Normal matrix Jᵀ W J with free zeros eliminated, shape (n_free, n_free)."""
        o = self.problem.observations
        sums = o.sum_by_zero(jacobian, weights)
        sums[o.zero_known] = 0.0
        counts = np.bincount(o.zero, weights, minlength=o.n_zeros)
        weighted = jacobian if (weights == 1.0).all() else jacobian * weights[:, None]
        return np.asarray(jacobian.T @ weighted - sums.T @ (sums / counts[:, None]))


def are_far(problem: CalibrationProblem, theta: Array) -> Mask:
    """Mask of the solutions with a parameter far from the mean of its prior.

    Args:
        problem: The problem.
        theta: θ̂, shape (..., n_free).
    """
    deviation = theta - problem.prior_mean / problem.theta_scale
    return np.asarray(
        (np.abs(deviation * problem.prior_precision) > MAX_PRIOR_DEVIATION).any(axis=-1)
    )


def bounded_step(square: Array, gradient: Array, low: Array, high: Array) -> Array:
    """Step s that minimises ½ sᵀ A s − bᵀ s within bounds, shape (n_free,).

    If A is singular, it is the shortest step without bounds, clipped to the bounds.

    Args:
        square: A, positive semidefinite, shape (n_free, n_free).
        gradient: b, shape (n_free,).
        low: Lower bounds of s, shape (n_free,).
        high: Upper bounds of s, shape (n_free,).
    """
    # columns of unit norm; a parameter that changes nothing has a zero on the diagonal
    scale = 1.0 / np.sqrt(np.maximum(np.diag(square), 1e-300))
    scaled, target = square * np.outer(scale, scale), gradient * scale
    limited = np.isfinite(low) | np.isfinite(high)
    order = np.argsort(limited, kind="stable")  # parameters with bounds come last
    if limited.any():
        scaled, target, scale = scaled[np.ix_(order, order)], target[order], scale[order]
    try:
        factor: Array = np.asarray(np.linalg.cholesky(scaled).T, dtype=np.float64)
    except np.linalg.LinAlgError:  # undetermined parameters
        values, vectors = np.linalg.eigh(scaled)
        large = values > RANK_TOLERANCE * values.max(initial=0.0)
        step = vectors[:, large] @ ((vectors[:, large].T @ target) / values[large])
    else:
        target = _solve_triangular(factor, target, transposed=True)
        limits = low[order] / scale, high[order] / scale
        step = _bounded(factor, target, *limits, n_limited=int(limited.sum()))
    result = np.empty_like(step)
    result[order] = step * scale
    return np.asarray(np.clip(result, low, high))


def _solve_triangular(factor: Array, target: Array, *, transposed: bool = False) -> Array:
    """Solution s of R s = t, or of Rᵀ s = t, for an upper triangular R, shape (n,)."""
    if len(factor) <= MAX_NUMPY_SIZE:
        return np.asarray(np.linalg.solve(factor.T if transposed else factor, target))
    from scipy import linalg

    return np.asarray(linalg.solve_triangular(factor, target, trans="T" if transposed else "N"))


def _bounded(factor: Array, target: Array, low: Array, high: Array, *, n_limited: int) -> Array:
    """Vector s that minimises ‖R s − t‖ within bounds, for an upper triangular R, shape (n,).

    Only the last n_limited components have bounds. They minimise the residuals of the last rows, in
    which no other component appears. The other components then solve the first rows exactly.
    """
    unbounded = _solve_triangular(factor, target)
    if ((unbounded >= low) & (unbounded <= high)).all():
        return unbounded
    from scipy.optimize import lsq_linear

    n = len(target) - n_limited
    result = np.where(high > low, 0.0, low)
    movable = n + np.flatnonzero((high > low)[n:])
    corner = factor[n:]
    right_side = target[n:] - corner @ result
    limits = low[movable], high[movable]
    solution = lsq_linear(corner[:, movable], right_side, bounds=limits, method="bvls", tol=1e-15)
    result[movable] = solution.x
    result[:n] = _solve_triangular(factor[:n, :n], target[:n] - factor[:n, n:] @ result[n:])
    return result
