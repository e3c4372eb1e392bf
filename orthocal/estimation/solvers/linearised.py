"""The identification to first order, as in the paper: one step from the active offsets."""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.solvers.program import Solution
from orthocal.estimation.solvers.subproblem import Task

Array = NDArray[np.float64]


class LinearisedProgram:
    """A calibration problem with readings to first order.

    Args:
        problem: The problem.
        options: The loss; other options do not apply.
    """

    def __init__(
        self, problem: CalibrationProblem, *, options: SolverOptions | None = None
    ) -> None:
        self.problem = problem
        self.options = options or SolverOptions(solver="linearised")

    def with_problem(self, problem: CalibrationProblem) -> LinearisedProgram:
        """The same solver for another problem; nothing is built."""
        return LinearisedProgram(problem, options=self.options)

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

        The point of linearisation is the reference, whatever the start.

        Raises:
            ClosureError: If the solution cannot reach a posture.
        """
        del start
        began = time.perf_counter()
        problem = self.problem
        task = Task.of(
            problem,
            self.options.loss,
            sigma=sigma,
            values=values,
            left_out=left_out,
            held=held,
        )
        about = task.at(problem.reference / problem.theta_scale, start_passive)
        _, jacobian = problem.linearise(problem.reference, about.passive)
        jacobian /= sigma
        begin = task.moved(about, jacobian, task.start(None) - about.theta)
        final = task.moved(begin, jacobian, task.step(begin, jacobian))
        theta = np.clip(final.theta, task.low, task.high) * problem.theta_scale
        return Solution(
            theta=theta,
            zeros=final.zeros * sigma,
            passive=problem.close(theta, start=about.passive),
            objective=final.objective,
            status="Solve_Succeeded",
            iterations=1,
            hessian="gauss-newton",
            seconds_build=0.0,
            seconds_solve=time.perf_counter() - began,
            closure=0.0,
            at_bound=task.held_by_bounds(final, jacobian, held),
        )
