"""Variable projection: the exact identification by Gauss-Newton on θ alone.

Passive joints and gauge zeros are eliminated. About the present θ the problem is linear except for
a robust loss; this subproblem is solved completely, within the bounds. The passive joints follow
the step to first order. If the loops stay nearly closed and the objective decreases, their opening
is corrected in the next step. Otherwise the loops are closed and the step is halved until the
objective decreases. Steps that take back the last one are relaxed. The optimum is that of the
complete program, which Ipopt solves.

About a start that is far off, the first steps can be so long that they end in a local minimum.
Where the result is far from its prior, or there is none, the problem is solved again with readings
of less weight first, which keep the steps short. The better optimum counts.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from orthocal.arrays import Array, Mask
from orthocal.errors import ClosureError, SolverError
from orthocal.estimation.problem import LENGTH_SCALE
from orthocal.estimation.solvers.program import Program, Solution, SolverInput, advise
from orthocal.estimation.solvers.subproblem import Iterate, Task, are_far
from orthocal.observation.model import ReadingLinearisation

SETTLED = 1e-8
"""Estimated next step at which the solver has converged, extrapolated from the ratio of the last
steps, [prior std]."""

NEARLY_CLOSED = 1e-3
"""Largest correction of a passive coordinate that readings are taken to follow to first order,
[rad] or characteristic lengths: its square moves a reading by less than a micrometre."""

RELAXATIONS = (16.0, 4.0, 1.0)
"""Factors on the standard deviation of the readings; each solution starts the next."""

MOST_HALVINGS = 12

OVERSHOOT = 0.5
"""Part of a step that the next one takes back from which on steps are relaxed."""

LEAST_SHARE = 0.1
"""Smallest part of a relaxed step."""

ROUNDING = 1e-12
"""Relative growth of the objective that counts as rounding."""


class VariableProjection(Program):
    """A calibration problem reduced to its free parameters.

    Its options are iterations and loss; other options do not apply.
    """

    kind = "variable-projection"

    def _solve(self, given: SolverInput) -> Solution:
        try:
            first = self._run(given)
        except (ClosureError, SolverError):
            try:
                return self._approach(given)
            except (ClosureError, SolverError):
                pass
            raise
        if not are_far(self.problem, first.theta / self.problem.theta_scale):
            return first
        try:
            other = self._approach(given)
        except (ClosureError, SolverError):
            return first
        iterations = first.iterations + other.iterations
        return replace(min(first, other, key=lambda s: s.objective), iterations=iterations)

    def _approach(self, given: SolverInput) -> Solution:
        """The solution with readings that gain weight step by step.

        Raises:
            SolverError, ClosureError: As `_run`.
        """
        at, iterations = given, 0
        for factor in RELAXATIONS:
            solution = self._run(replace(at, sigma=factor * given.sigma))
            at = replace(at, start=solution.theta, start_passive=solution.passive)
            iterations += solution.iterations
        return replace(solution, iterations=iterations)

    def _run(self, given: SolverInput) -> Solution:
        """One descent from the start, with open loops, or else with closed ones.

        Raises:
            SolverError: If it does not converge.
            ClosureError: If the solution cannot reach a posture.
        """
        task = Task(self.problem, self.options.loss, given)
        start = task.begin()
        try:
            state, jacobian, iterations = self._descend(task, start, follow=True)
        except (ClosureError, SolverError):
            state, jacobian, iterations = self._descend(task, task.begin(), follow=False)
        return task.solution(state, jacobian, passive=state.passive, iterations=iterations)

    def _descend(
        self, task: Task, begin: tuple[Iterate, ReadingLinearisation], *, follow: bool
    ) -> tuple[Iterate, Array, int]:
        """Gauss-Newton iterations: the optimum, the last Jacobian and the number of iterations.

        Args:
            task: The task.
            begin: The start, with closed loops.
            follow: Let passive joints follow a step to first order.

        Raises:
            SolverError: If it does not converge.
            ClosureError: If the solution cannot reach a posture.
        """
        most = self.options.max_iterations
        sizes, before, share = np.full(3, np.inf), None, 1.0
        state, linear = begin
        for iterations in range(1, most + 1):
            jacobian = linear.jacobian
            jacobian /= task.sigma  # in place: it may be large, and is not used again
            step = task.step(state, jacobian)
            sizes = np.r_[np.abs(step).max(initial=0.0), sizes[:2]]
            share = _relax(step, before, share)
            before, step = step, share * step
            if follow and are_settled(sizes):
                theta = np.clip(state.theta + step, task.low, task.high)
                passive = state.passive + linear.follow(theta - state.theta)
                return task.at(theta, passive), jacobian, iterations
            followed = self._follow(task, state, linear, step) if follow else None
            if followed is not None:
                state, linear = followed
                continue
            whole = np.abs(step).max(initial=0.0)
            state, step = self._move(task, state, step)
            sizes[0] = np.abs(step).max(initial=0.0)
            share *= sizes[0] / whole if whole else 1.0
            if are_settled(sizes):
                return state, jacobian, iterations
            linear = task.linearise(state.theta, state.passive)
        raise SolverError(
            f"did not converge: the step is still {sizes[0]:.2g} prior standard deviations "
            f"after {most} iterations; there is no result. {advise(self.options)}",
            status="Maximum_Iterations_Exceeded",
            iterations=most,
        )

    def _follow(
        self, task: Task, state: Iterate, linear: ReadingLinearisation, step: Array
    ) -> tuple[Iterate, ReadingLinearisation] | None:
        """A full step with passive joints that follow it; None if the loops open too far."""
        theta = np.clip(state.theta + step, task.low, task.high)
        passive = state.passive + linear.follow(theta - state.theta)
        try:
            following = task.linearise(theta, passive)
        except np.linalg.LinAlgError:
            return None
        motion = np.abs(following.correction / task.problem.passive_scale).max(initial=0.0)
        if not motion * LENGTH_SCALE < NEARLY_CLOSED * task.problem.robot.characteristic_length:
            return None
        after = task.near(theta, passive, following)
        return (after, following) if after.objective <= _no_more_than(state) else None

    def _move(self, task: Task, state: Iterate, step: Array) -> tuple[Iterate, Array]:
        """Halve a step until the objective decreases, with closed loops.

        Raises:
            SolverError: If it never does.
        """
        for halving in range(MOST_HALVINGS):
            part = step * 0.5**halving
            try:
                trial = task.at(np.clip(state.theta + part, task.low, task.high), state.passive)
            except ClosureError:  # the machine cannot reach a posture there
                continue
            if trial.objective <= _no_more_than(state):
                return trial, part
            if np.abs(part).max(initial=0.0) < SETTLED:
                return state, np.zeros_like(step)
        raise SolverError(
            "did not converge: no step makes it better; there is no result. "
            f"{advise(self.options)}",
            status="Restoration_Failed",
            iterations=MOST_HALVINGS,
        )


def are_settled(sizes: Array) -> Mask:
    """Mask of the solutions whose next step is negligible, extrapolated from the last three.

    Args:
        sizes: Sizes of the last three steps, the last one first, infinite for none, shape (3, ...).
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        last = np.where(np.isfinite(sizes[1]), sizes[0] / sizes[1], np.inf)
        before = np.where(np.isfinite(sizes[2]), sizes[1] / sizes[2], 0.0)
        return np.asarray((sizes[0] <= SETTLED) | (sizes[0] * np.maximum(last, before) <= SETTLED))


def _relax(step: Array, before: Array | None, share: float) -> float:
    """Share of a Gauss-Newton step to take, where the last one went too far (Aitken).

    Gauss-Newton neglects the curvature of readings. Along a parameter that changes them to second
    order only, such as a fixed ball across the plane of motion, steps alternate and may not shrink.

    Args:
        step: The step, shape (n_free,), [prior std].
        before: The one before, all of it.
        share: Share of it that was taken.
    """
    if before is None:
        return 1.0
    if share == 1.0 and not step @ before < -OVERSHOOT * (before @ before):
        return 1.0
    change = before - step
    return float(np.clip(share * (before @ change) / (change @ change), LEAST_SHARE, 1.0))


def _no_more_than(state: Iterate) -> float:
    return state.objective + ROUNDING * max(abs(state.objective), 1.0)
