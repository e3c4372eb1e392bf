"""The problem in its free parameters alone, for one set of readings, and its Gauss-Newton step.

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
from orthocal.estimation.solvers.program import Solution, SolverInput, scaled_bounds
from orthocal.observation.model import ReadingLinearisation

SETTLED_WITHIN = 1e-11
"""Last step of a subproblem with a robust loss, [prior std]."""

MOST_STEPS_WITHIN = 100
"""Largest number of steps of a subproblem with a robust loss."""

RANK_TOLERANCE = 1e-13
"""Eigenvalues of the normal matrix below this part of the largest count as zero."""

FAR = 8.0
"""Deviation of a parameter from the mean of its prior at which an optimum is doubted, [prior std].
Machines within their tolerances have none: it is a local minimum, or readings are wrong."""

FEW = 50
"""Size of systems that NumPy solves faster than SciPy's triangular solver is imported."""


@dataclass(frozen=True, slots=True, eq=False)
class Iterate:
    """The problem at some θ̂, or to first order near it."""

    theta: Array
    """θ̂, shape (n_free,)."""
    passive: Array
    """Passive coordinates, not updated by first-order changes, (n_states, n_passive), [m, rad]."""
    deviation: Array
    """Readings minus predictions, with gauge zeros, shape (n_entries,), [σ]."""
    zeros: Array
    """Gauge zeros, shape (n_zeros,), [σ]."""
    objective: float
    """Objective as in `Solution`."""


class Task:
    """One set of readings, with their weights and the bounds of θ̂.

    Args:
        problem: The problem.
        loss: Cost of a residual.
        given: Readings, weights, start and prescribed values.

    Attributes:
        sigma: Standard deviation of one reading, [m].
        weights: Weights of the entries, shape (n_entries,).
        low: Lower bounds of θ̂, shape (n_free,).
        high: Upper bounds of θ̂, shape (n_free,).
    """

    def __init__(self, problem: CalibrationProblem, loss: Loss, given: SolverInput) -> None:
        self.problem, self.loss, self.given = problem, loss, given
        self.sigma, self.weights = given.sigma, given.weights
        self.low, self.high = scaled_bounds(problem, given.prescribed)

    def clip(self, theta: Array) -> Array:
        """θ̂ within the bounds, shape (n_free,) of free parameters in SI."""
        return np.clip(theta / self.problem.theta_scale, self.low, self.high)

    def solution(
        self, state: Iterate, jacobian: Array, *, passive: Array, iterations: int
    ) -> Solution:
        """Solution of the task.

        Args:
            state: The optimum.
            jacobian: dh/dθ̂ there, shape (n_entries, n_free), [σ per prior std].
            passive: Passive coordinates, shape (n_states, n_passive), [m, rad].
            iterations: Number of iterations.
        """
        gradient = self.gradient(state, jacobian)
        at_bound = np.zeros(state.theta.size, dtype=np.int8)
        at_bound[(state.theta <= self.low) & (gradient > 0.0)] = -1
        at_bound[(state.theta >= self.high) & (gradient < 0.0)] = 1
        at_bound[list(self.given.prescribed)] = 0
        return Solution(
            theta=state.theta * self.problem.theta_scale,
            zeros=state.zeros * self.sigma,
            passive=passive,
            objective=state.objective,
            status="Solve_Succeeded",
            iterations=iterations,
            hessian="gauss-newton",
            closure=0.0,
            at_bound=at_bound,
        )

    def at(self, theta: Array, passive: Array | None) -> Iterate:
        """The problem at some θ̂, shape (n_free,).

        Raises:
            ClosureError: If the machine cannot reach a posture there.
        """
        problem = self.problem
        si = theta * problem.theta_scale
        closed = problem.close(si, start=passive)
        return self._state(
            theta, closed, (self.given.values - problem.predict(si, closed)) / self.sigma
        )

    def begin(self) -> tuple[Iterate, ReadingLinearisation]:
        """The problem at the start of a solver.

        Raises:
            ClosureError: If the machine cannot reach a posture there.
            SolverError: If a sensor has no reading there.
        """
        problem, at, passive = (
            self.problem,
            self.clip(self.given.start),
            self.given.start_passive,
        )
        at_active = np.array_equal(at * problem.theta_scale, problem.active_theta)
        if passive is None and at_active:
            passive = problem.active_passive
        else:
            first = problem.active_passive if passive is None else passive
            passive = problem.close(at * problem.theta_scale, start=first)
        linear = self.linearise(at, passive)
        if not np.isfinite(linear.jacobian).all():
            raise SolverError(
                "cannot begin: on the machine that the readings lead to a tip passes what it "
                "touched, or a sensor shows nothing; look for a wrong sign, row or setup",
                status="Invalid_Number_Detected",
                iterations=0,
            )
        return self.near(at, passive, linear), linear

    def linearise(self, theta: Array, passive: Array) -> ReadingLinearisation:
        """Readings to first order about some θ̂ and passive coordinates near closed loops."""
        return self.problem.linearise(theta * self.problem.theta_scale, passive)

    def near(self, theta: Array, passive: Array, linear: ReadingLinearisation) -> Iterate:
        """The problem at some θ̂, with loops closed to first order."""
        predicted = linear.reading + linear.opening
        return self._state(theta, passive, (self.given.values - predicted) / self.sigma)

    def moved(self, state: Iterate, jacobian: Array, change: Array) -> Iterate:
        """The problem to first order at another θ̂; arguments as for `step`."""
        return self._state(state.theta + change, state.passive, state.deviation - jacobian @ change)

    def step(self, state: Iterate, jacobian: Array) -> Array:
        """Change of θ̂ that solves the problem with readings to first order, shape (n_free,).

        Least squares take one solve. A robust loss takes Newton's method with weights ρ''; where
        that does not decrease the objective, with the secant ρ'/r, which always does.

        Args:
            state: The point of linearisation.
            jacobian: dh/dθ̂ there, shape (n_entries, n_free), [σ per prior std].
        """
        at = state
        if not self.loss.robust:
            return self._change(at, jacobian, self.weights)
        for _ in range(MOST_STEPS_WITHIN):
            residual = at.deviation - at.zeros[self.problem.observations.zero]
            for weights in (self.loss.curvature(residual), self.loss.weight(residual)):
                change = self._change(at, jacobian, self.weights * weights)
                trial = self.moved(at, jacobian, change)
                if trial.objective <= at.objective:
                    break
            settled = float(np.abs(change).max(initial=0.0)) < SETTLED_WITHIN
            if settled or trial.objective > at.objective:
                break
            at = trial
        return np.asarray(at.theta - state.theta)

    def _change(self, at: Iterate, jacobian: Array, weights: Array) -> Array:
        """Newton step with weights of the entries, within the bounds, shape (n_free,)."""
        square = self._square(jacobian, weights)
        square[np.diag_indices_from(square)] += self.problem.prior_precision
        limits = self.low - at.theta, self.high - at.theta
        return bounded_step(square, -self.gradient(at, jacobian), *limits)

    def gradient(self, state: Iterate, jacobian: Array) -> Array:
        """Gradient of the objective by θ̂, shape (n_free,)."""
        residual = state.deviation - state.zeros[self.problem.observations.zero]
        prior = self.problem.prior_precision * self._off(state.theta)
        return np.asarray(prior - jacobian.T @ (self.weights * self.loss.influence(residual)))

    def _state(self, theta: Array, passive: Array, deviation: Array) -> Iterate:
        o, off = self.problem.observations, self._off(theta)
        zeros = self.loss.centres(deviation, o.zero, o.n_zeros, weights=self.weights)
        zeros[o.zero_known] = 0.0
        prior = 0.5 * float(off @ (self.problem.prior_precision * off))
        cost = float(self.weights @ self.loss.value(deviation - zeros[o.zero]))
        return Iterate(theta, passive, deviation, zeros, cost + prior)

    def _off(self, theta: Array) -> Array:
        """Deviation of θ̂ from the mean of its prior, shape (n_free,)."""
        return np.asarray(theta - self.problem.prior_mean / self.problem.theta_scale)

    def _square(self, jacobian: Array, weights: Array) -> Array:
        """Jᵀ W J of rows minus the weighted mean of those with the same free zero."""
        o = self.problem.observations
        sums = o.sum_by_zero(jacobian, weights)
        sums[o.zero_known] = 0.0
        counts = np.bincount(o.zero, weights, minlength=o.n_zeros)
        weighted = jacobian if (weights == 1.0).all() else jacobian * weights[:, None]
        return np.asarray(jacobian.T @ weighted - sums.T @ (sums / counts[:, None]))


def are_far(problem: CalibrationProblem, theta: Array) -> Mask:
    """Mask of the solutions with a parameter `FAR` from the mean of its prior.

    Args:
        problem: The problem.
        theta: θ̂, shape (..., n_free).
    """
    off = theta - problem.prior_mean / problem.theta_scale
    return np.asarray((np.abs(off * problem.prior_precision) > FAR).any(axis=-1))


def bounded_step(square: Array, gradient: Array, low: Array, high: Array) -> Array:
    """Step s that minimises ½ sᵀ A s − bᵀ s within bounds, shape (n_free,).

    Args:
        square: A, positive semidefinite, shape (n_free, n_free).
        gradient: b, shape (n_free,).
        low: Lower bounds of s, shape (n_free,).
        high: Upper bounds of s, shape (n_free,).
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(square), 1e-300))
    scaled, target = square * np.outer(scale, scale), gradient * scale
    limited = np.isfinite(low) | np.isfinite(high)
    order = np.argsort(limited, kind="stable")  # parameters with bounds come last
    if limited.any():
        scaled, target, scale = scaled[np.ix_(order, order)], target[order], scale[order]
    try:
        factor: Array = np.asarray(np.linalg.cholesky(scaled).T, dtype=np.float64)
    except np.linalg.LinAlgError:  # undetermined parameters: the smallest change
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
    """Solution s of R s = t, or Rᵀ s = t, R upper triangular, shape (n,)."""
    if len(factor) <= FEW:
        return np.asarray(np.linalg.solve(factor.T if transposed else factor, target))
    from scipy import linalg

    return np.asarray(linalg.solve_triangular(factor, target, trans="T" if transposed else "N"))


def _bounded(factor: Array, target: Array, low: Array, high: Array, *, n_limited: int) -> Array:
    """Vector s that minimises ‖R s − t‖ within bounds, R upper triangular, shape (n,).

    The last components alone have bounds. They minimise the last rows, in which no others appear;
    the others then solve their rows exactly.
    """
    open_solution = _solve_triangular(factor, target)
    if ((open_solution >= low) & (open_solution <= high)).all():
        return open_solution
    from scipy.optimize import lsq_linear

    n = len(target) - n_limited
    result = np.where(high > low, 0.0, low)
    movable = n + np.flatnonzero((high > low)[n:])
    corner = factor[n:]
    remainder = target[n:] - corner @ result
    limits = low[movable], high[movable]
    solution = lsq_linear(corner[:, movable], remainder, bounds=limits, method="bvls", tol=1e-15)
    result[movable] = solution.x
    result[:n] = _solve_triangular(factor[:n, :n], target[:n] - factor[:n, n:] @ result[n:])
    return result
