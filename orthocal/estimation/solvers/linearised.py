"""The identification to first order, as the paper's: one step from what the controller corrects."""

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
    """A calibration problem with its readings taken to first order.

    Args:
        problem: The problem.
        options: The loss; the rest is that of other solvers.
    """

    def __init__(
        self, problem: CalibrationProblem, *, options: SolverOptions | None = None
    ) -> None:
        self.problem = problem
        self.options = options or SolverOptions(solver="linearised")

    def with_problem(self, problem: CalibrationProblem) -> LinearisedProgram:
        """The same for another problem: nothing is built."""
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

        The readings are taken to first order about what the controller already corrects, wherever
        the start is.

        Raises:
            ClosureError: If the machine found cannot reach a posture.
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
        within = task.moved(about, jacobian, task.start(None) - about.theta)
        found = task.moved(within, jacobian, task.step(within, jacobian))
        theta = np.clip(found.theta, task.low, task.high) * problem.theta_scale
        return Solution(
            theta=theta,
            zeros=found.zeros * sigma,
            passive=problem.close(theta, start=about.passive),
            objective=found.objective,
            status="Solve_Succeeded",
            iterations=1,
            hessian="gauss-newton",
            seconds_build=0.0,
            seconds_solve=time.perf_counter() - began,
            closure=0.0,
            at_bound=task.held_by_bounds(found, jacobian, held),
        )
