"""Linearised identification, as in the paper: one step from the active offsets."""

from __future__ import annotations

from dataclasses import replace

from orthocal.estimation.solvers.program import Program, Solution, SolverInput
from orthocal.estimation.solvers.subproblem import Task


class LinearisedProgram(Program):
    """Calibration problem with readings linearised about the active offsets.

    The loss is its only option. The start values are not used.

    Raises:
        ClosureError: If the solution cannot reach a posture.
    """

    kind = "linearised"

    def _solve(self, data: SolverInput) -> Solution:
        """Solve the linearised problem for one set of readings."""
        problem = self.problem
        task = Task(problem, self.options.loss, data)
        active = task.at(problem.active_theta / problem.theta_scale, data.start_passive)
        _, jacobian = problem.predict_and_jacobian(problem.active_theta, active.passive)
        jacobian /= task.sigma
        start = task.clip(problem.active_theta)
        first = task.linearised_at(active, jacobian, start - active.theta)
        state = task.linearised_at(first, jacobian, task.step(first, jacobian))
        state = replace(state, theta=state.theta.clip(task.low, task.high))
        theta = state.theta * problem.theta_scale
        passive = problem.close(theta, start=active.passive)
        return task.solution(state, jacobian, passive=passive, iterations=1)
