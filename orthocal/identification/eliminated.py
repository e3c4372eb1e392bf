"""The exact identification with passive joints and gauge zeros eliminated: Gauss-Newton on θ alone.

The passive coordinates follow the parameters by the implicit function theorem, ∂q/∂θ = −g_q⁻¹ g_θ;
a gauge's zero is where it leaves least. What remains is a least-squares problem in the free
parameters, small and dense. About the present θ it is linear but for a robust loss: that subproblem
is solved to its end, within the bounds, and the step is taken as far as it makes the whole better.
The optimum is that of the whole program which Ipopt solves; each checks the other.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from orthocal.errors import ClosureError, SolverError
from orthocal.identification.loss import Loss
from orthocal.identification.nlp import LEFT_OUT, Solution, SolverOptions
from orthocal.identification.problem import CalibrationProblem

Array = NDArray[np.float64]

SETTLED = 1e-5
"""Largest change of θ̂, in tolerances, that is the last one. Near the solution each step is smaller
than the one before by what errors change of the derivatives, a thousandth."""

SETTLED_WEIGHTS = 1e-10
"""The same of the subproblem with a robust loss, which converges more slowly."""

MOST_REWEIGHTINGS = 500
MOST_HALVINGS = 12

ROUNDING = 1e-12
"""Relative growth of the objective that is none."""


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """The problem at some θ."""

    theta: Array
    """θ̂, shape (n_free,)."""
    passive: Array
    deviation: Array
    """Readings less predictions, zeros still in them, shape (n_entries,), [σ]."""
    zeros: Array
    """Shape (n_zeros,), [σ]."""
    objective: float


class EliminatedProgram:
    """A calibration problem with nothing left but its free parameters.

    Args:
        problem: The problem.
        options: Iterations and loss; the rest is Ipopt's.
    """

    def __init__(
        self, problem: CalibrationProblem, *, options: SolverOptions | None = None
    ) -> None:
        began = time.perf_counter()
        self.problem = problem
        self.options = options or SolverOptions()
        self.seconds_build = time.perf_counter() - began

    def with_problem(self, problem: CalibrationProblem) -> EliminatedProgram:
        """The same for another problem: nothing is built."""
        return EliminatedProgram(problem, options=self.options)

    def solve(
        self,
        *,
        sigma: float,
        values: ArrayLike | None = None,
        start: ArrayLike | None = None,
        start_passive: Array | None = None,
        left_out: ArrayLike | None = None,
        held: Mapping[int, float] | None = None,
    ) -> Solution:
        """Solve for given readings; arguments as for `NonlinearProgram.solve`.

        Raises:
            SolverError: If it does not converge.
            ClosureError: If the machine cannot reach a posture with the start values.
        """
        began = time.perf_counter()
        problem = self.problem
        lower, upper = problem.selection.lower.copy(), problem.selection.upper.copy()
        for i, value in (held or {}).items():
            lower[i] = upper[i] = value
        scale = problem.theta_scale
        low, high = lower / scale, upper / scale
        theta = np.array(problem.reference if start is None else start, dtype=np.float64) / scale
        weights = np.ones(problem.observations.size)
        if left_out is not None:
            weights[np.asarray(left_out, dtype=np.int64)] = LEFT_OUT
        readings = problem.values if values is None else np.asarray(values, dtype=np.float64)
        task = _Task(problem, self.options.loss, readings, weights, sigma, low, high)

        state = task.at(np.clip(theta, low, high), start_passive)
        iterations, taken = 0, np.full(theta.size, np.inf)
        while iterations < self.options.max_iterations:
            iterations += 1
            _, jacobian = problem.linearise(state.theta * scale, state.passive)
            step = task.step(state, jacobian / sigma)
            state, taken = self._move(task, state, step)
            if np.abs(taken).max(initial=0.0) < SETTLED:
                break
        else:
            raise SolverError(
                f"did not converge: the step is still {np.abs(taken).max():.2g} tolerances after "
                f"{iterations} iterations; there is no result. Look for a reading with a wrong sign "
                "or in a wrong row first"
                + ("" if self.options.loss.robust else "; with the loss 'huber' it may be named"),
                status="Maximum_Iterations_Exceeded",
                iterations=iterations,
            )
        pull = task.pull(state, jacobian / sigma)
        at_bound = np.zeros(theta.size, dtype=np.int8)
        at_bound[(state.theta <= low) & (pull > 0.0)] = -1
        at_bound[(state.theta >= high) & (pull < 0.0)] = 1
        at_bound[list(held or {})] = 0
        return Solution(
            theta=state.theta * scale,
            zeros=state.zeros * sigma,
            passive=state.passive,
            objective=state.objective,
            status="Solve_Succeeded",
            iterations=iterations,
            hessian="gauss-newton",
            seconds_build=self.seconds_build,
            seconds_solve=time.perf_counter() - began,
            closure=0.0,
            at_bound=at_bound,
        )

    def _move(self, task: _Task, state: _State, step: Array) -> tuple[_State, Array]:
        """Take a step as far as it makes the objective smaller.

        Raises:
            SolverError: If no part of it does.
        """
        for halving in range(MOST_HALVINGS):
            part = step * 0.5**halving
            try:
                found = task.at(state.theta + part, state.passive)
            except ClosureError:  # there the machine cannot be assembled
                continue
            slack = ROUNDING * max(abs(state.objective), 1.0)
            if found.objective <= state.objective + slack:
                return found, part
            if np.abs(part).max(initial=0.0) < SETTLED:
                return state, np.zeros_like(step)
        raise SolverError(
            "did not converge: no step makes it better; there is no result. Look for a reading "
            "with a wrong sign or in a wrong row first",
            status="Restoration_Failed",
            iterations=MOST_HALVINGS,
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    """One set of readings, with their weights and the bounds of θ̂."""

    problem: CalibrationProblem
    loss: Loss
    values: Array
    weights: Array
    sigma: float
    low: Array
    high: Array

    def at(self, theta: Array, passive: Array | None) -> _State:
        """The problem at some θ̂.

        Raises:
            ClosureError: If the machine cannot reach a posture there.
        """
        problem = self.problem
        si = np.clip(theta, self.low, self.high) * problem.theta_scale
        closed = problem.close(si, start=passive)
        deviation = (self.values - problem.predict(si, closed)) / self.sigma
        zeros = self._zeros(deviation)
        objective = self._cost(deviation, zeros) + 0.5 * float(self._off(theta) @ self._off(theta))
        return _State(np.clip(theta, self.low, self.high), closed, deviation, zeros, objective)

    def step(self, state: _State, jacobian: Array) -> Array:
        """Change of θ̂ that solves the problem, its readings taken to first order, (n_free,).

        Args:
            state: Where.
            jacobian: dh/dθ̂ there, shape (n_entries, n_free), [σ per tolerance].
        """
        total = np.zeros_like(state.theta)
        deviation = state.deviation
        for _ in range(MOST_REWEIGHTINGS if self.loss.robust else 1):
            zeros = self._zeros(deviation)
            weights = self._reweighted(deviation, zeros)
            centred = self._centre(jacobian, weights)
            weighted = centred * weights[:, None]
            square = weighted.T @ centred
            square[np.diag_indices_from(square)] += self.problem.prior_precision
            residual = deviation - zeros[self.problem.observations.zero]
            pull = weighted.T @ residual - self._off(state.theta + total) * _root(self.problem)
            change = self._solve(square, pull, state.theta + total)
            total += change
            deviation = state.deviation - jacobian @ total
            if np.abs(change).max(initial=0.0) < SETTLED_WEIGHTS:
                break
        return total

    def pull(self, state: _State, jacobian: Array) -> Array:
        """Derivative of the objective by θ̂, shape (n_free,)."""
        weights = self._reweighted(state.deviation, state.zeros)
        residual = state.deviation - state.zeros[self.problem.observations.zero]
        own = self._off(state.theta) * _root(self.problem)
        return np.asarray(own - jacobian.T @ (weights * residual))

    def _solve(self, square: Array, pull: Array, theta: Array) -> Array:
        """S that minimises ½ sᵀ A s − bᵀ s within the bounds."""
        low, high = self.low - theta, self.high - theta
        scale = 1.0 / np.sqrt(np.maximum(np.diag(square), 1e-300))
        scaled = square * np.outer(scale, scale)
        try:
            factor = linalg.cholesky(scaled, lower=True)
        except linalg.LinAlgError:  # not told by anything: the least change
            values, vectors = np.linalg.eigh(scaled)
            kept = values > 1e-13 * values.max(initial=0.0)
            factor = None
            step = vectors[:, kept] @ ((vectors[:, kept].T @ (pull * scale)) / values[kept])
        else:
            step = linalg.cho_solve((factor, True), pull * scale)
        step = step * scale
        if factor is None or ((step >= low) & (step <= high)).all():
            return np.asarray(np.clip(step, low, high))
        from scipy.optimize import lsq_linear

        free = high > low
        target = linalg.solve_triangular(factor, pull * scale, lower=True)
        held = np.where(free, 0.0, low) / scale
        limits = (low[free] / scale[free], high[free] / scale[free])
        found = lsq_linear(
            factor.T[:, free], target - factor.T @ held, bounds=limits, method="bvls", tol=1e-14
        )
        result = np.where(free, 0.0, low)
        result[free] = np.clip(found.x * scale[free], low[free], high[free])
        return result

    def _off(self, theta: Array) -> Array:
        """How far θ̂ is from its prior's mean, in its weight, shape (n_free,)."""
        mean = self.problem.prior_mean / self.problem.theta_scale
        return np.asarray(_root(self.problem) * (theta - mean))

    def _cost(self, deviation: Array, zeros: Array) -> float:
        residual = deviation - zeros[self.problem.observations.zero]
        return float(self.weights @ self.loss.value(residual))

    def _reweighted(self, deviation: Array, zeros: Array) -> Array:
        if not self.loss.robust:
            return self.weights
        residual = deviation - zeros[self.problem.observations.zero]
        return np.asarray(self.weights * self.loss.weight(residual))

    def _zeros(self, deviation: Array) -> Array:
        """Zeros that leave least of deviations, shape (n_zeros,), [σ]."""
        o = self.problem.observations

        def means(weights: Array) -> Array:
            total = np.bincount(o.zero, weights * deviation, minlength=o.n_zeros)
            return np.asarray(total / np.bincount(o.zero, weights, minlength=o.n_zeros))

        zeros = means(self.weights)
        for _ in range(MOST_REWEIGHTINGS if self.loss.robust else 0):
            found = means(self._reweighted(deviation, zeros))
            change = float(np.abs(found - zeros).max(initial=0.0))
            zeros = found
            if change < SETTLED_WEIGHTS:
                break
        return zeros

    def _centre(self, values: Array, weights: Array) -> Array:
        """Rows less the weighted mean of those that share their zero, shape as given."""
        o = self.problem.observations
        order = np.argsort(o.zero, kind="stable")
        starts = np.searchsorted(o.zero[order], np.arange(o.n_zeros))
        totals = np.add.reduceat((values * weights[:, None])[order], starts, axis=0)
        sums = np.bincount(o.zero, weights, minlength=o.n_zeros)
        return np.asarray(values - (totals / sums[:, None])[o.zero])


def _root(problem: CalibrationProblem) -> Array:
    return np.sqrt(problem.prior_precision)
