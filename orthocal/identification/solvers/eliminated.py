"""The exact identification with passive joints and gauge zeros eliminated: Gauss-Newton on θ alone.

About the present θ the problem is linear but for a robust loss: that subproblem is solved to its
end, within the bounds, and the step is taken as far as it makes the whole better. The optimum is
that of the whole program which Ipopt solves.
"""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.errors import ClosureError, SolverError
from orthocal.identification.options import SolverOptions
from orthocal.identification.problem import CalibrationProblem
from orthocal.identification.solvers.program import Solution, no_convergence
from orthocal.identification.solvers.subproblem import State, Task

Array = NDArray[np.float64]

SETTLED = 1e-8
"""Largest change of θ̂ that the next step would make, in tolerances, by how the last ones shrank:
each is smaller than the one before by what errors change of the derivatives."""

MOST_HALVINGS = 12

ROUNDING = 1e-12
"""Relative growth of the objective that is none."""


class EliminatedProgram:
    """A calibration problem with nothing left but its free parameters.

    Args:
        problem: The problem.
        options: Iterations and loss; the rest is Ipopt's.
    """

    def __init__(
        self, problem: CalibrationProblem, *, options: SolverOptions | None = None
    ) -> None:
        self.problem = problem
        self.options = options or SolverOptions(solver="eliminated")

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
        """Solve for given readings; arguments as for `Program.solve`.

        Raises:
            SolverError: If it does not converge.
            ClosureError: If the machine cannot reach a posture with the start values.
        """
        began = time.perf_counter()
        problem, most = self.problem, self.options.max_iterations
        task = Task.of(
            problem,
            self.options.loss,
            sigma=sigma,
            values=values,
            left_out=left_out,
            held=held,
        )
        state = task.at(task.start(start), start_passive)
        size = np.inf
        for iterations in range(1, most + 1):
            jacobian = self._jacobian(state) / sigma
            state, taken = self._move(task, state, task.step(state, jacobian))
            before, size = size, float(np.abs(taken).max(initial=0.0))
            if size <= SETTLED or (iterations > 1 and size**2 <= SETTLED * before):
                break
        else:
            raise SolverError(
                f"did not converge: the step is still {size:.2g} tolerances after {most} "
                f"iterations; {no_convergence(self.options)}",
                status="Maximum_Iterations_Exceeded",
                iterations=most,
            )
        return Solution(
            theta=state.theta * problem.theta_scale,
            zeros=state.zeros * sigma,
            passive=state.passive,
            objective=state.objective,
            status="Solve_Succeeded",
            iterations=iterations,
            hessian="gauss-newton",
            seconds_build=0.0,
            seconds_solve=time.perf_counter() - began,
            closure=0.0,
            at_bound=task.held_by_bounds(state, jacobian, held),
        )

    def _jacobian(self, state: State) -> Array:
        """dh/dθ̂, shape (n_entries, n_free), [m per tolerance]."""
        _, jacobian = self.problem.linearise(state.theta * self.problem.theta_scale, state.passive)
        return jacobian

    def _move(self, task: Task, state: State, step: Array) -> tuple[State, Array]:
        """Take a step as far as it makes the objective smaller.

        Raises:
            SolverError: If no part of it does.
        """
        for halving in range(MOST_HALVINGS):
            part = step * 0.5**halving
            try:
                found = task.at(np.clip(state.theta + part, task.low, task.high), state.passive)
            except ClosureError:  # there the machine cannot be assembled
                continue
            slack = ROUNDING * max(abs(state.objective), 1.0)
            if found.objective <= state.objective + slack:
                return found, part
            if np.abs(part).max(initial=0.0) < SETTLED:
                return state, np.zeros_like(step)
        raise SolverError(
            f"did not converge: no step makes it better; {no_convergence(self.options)}",
            status="Restoration_Failed",
            iterations=MOST_HALVINGS,
        )
