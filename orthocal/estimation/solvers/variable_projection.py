"""Variable projection: the exact identification by the Gauss-Newton method on θ̂ alone.

θ̂ are the free parameters in prior standard deviations. Passive joints and gauge zeros are functions
of θ̂ and are eliminated (variable projection: Golub and Pereyra, SIAM J. Numer. Anal. 1973). About
the present θ̂ the problem is linear except for a robust loss. This subproblem is solved completely,
within the bounds. The passive joints follow the step to first order. If the loops remain nearly
closed and the objective decreases, their opening is corrected in the next step. Otherwise the loops
are closed and the step is halved until the objective decreases. Steps are accelerated by Anderson's
method (`_Acceleration`). The optimum is that of the complete program, which Ipopt solves.

From start values far from the optimum, the first steps can be so long that they end in a local
minimum. If the result is far from its prior, or the solver does not converge, the problem is solved
again. Readings then have lower weights first, which shortens the steps. The better optimum is
returned.

Some parameters change readings only to second order. Then a machine on the other side of a
stationary point has almost the same readings and may be a better optimum: a mirror image
(`mirrored_starts`). The solver starts from it again.
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

STEP_TOLERANCE = 1e-8
"""Next step below which the solver has converged, [prior std]. It is extrapolated from the ratio of
the last steps."""

MAX_CORRECTION = 1e-3
"""Largest correction of a passive coordinate that readings follow to first order: an angle, [rad],
or the ratio of a length to the characteristic length of the robot. Its square changes a reading by
less than a micrometre."""

RELAXATIONS = (16.0, 4.0, 1.0)
"""Factors on the standard deviation of the readings; each solution is the start of the next."""

MAX_HALVINGS = 12
"""Largest number of halvings of a step."""

MEMORY = 4
"""Number of earlier steps from which the acceleration of a step is computed."""

MAX_MIRRORED_ITERATIONS = 30
"""Largest number of iterations from a mirror image. Descents that need more rarely converge."""

SAME_OBJECTIVE = 1e-9
"""Relative difference of objectives below which two starts have the same optimum."""

OBJECTIVE_TOLERANCE = 1e-12
"""Relative growth of the objective that counts as a rounding error."""


class VariableProjection(Program):
    """Solver of a calibration problem in its free parameters alone.

    Of its options it uses `max_iterations` for each descent, and `loss`. Solutions state the number
    of iterations without those of descents that failed.
    """

    kind = "variable-projection"

    def _solve(self, data: SolverInput) -> Solution:
        """Best optimum from the start values and, if there are mirror images, from these."""
        best = self._solve_from_start(data)
        directions = self.problem.mirrored.of_task(data.sigma, data.prescribed)
        if not (data.mirrored and len(directions)):
            return best
        iterations, passive = best.iterations, best.passive
        limit = min(MAX_MIRRORED_ITERATIONS, self.options.max_iterations)
        starts = self.problem.mirrored_starts(best.theta[None], passive[None], directions)
        for start in starts[:, 0]:
            image = replace(data, start=start, start_passive=passive)
            task = Task(self.problem, self.options.loss, image)
            try:
                state, jacobian, count = self._descend(task, task.begin(), limit, open_loops=True)
            except (ClosureError, SolverError):
                continue
            iterations += count
            if state.objective < best.objective * (1.0 - SAME_OBJECTIVE):
                best = task.solution(state, jacobian, passive=state.passive, iterations=count)
        return replace(best, iterations=iterations)

    def _solve_from_start(self, data: SolverInput) -> Solution:
        """Solve directly, then with increasing weights if this fails or ends far from the prior."""
        try:
            direct = self._run(data)
        except (ClosureError, SolverError):
            try:
                return self._solve_relaxed(data)
            except (ClosureError, SolverError):
                pass
            raise
        if not are_far(self.problem, direct.theta / self.problem.theta_scale):
            return direct
        try:
            relaxed = self._solve_relaxed(data)
        except (ClosureError, SolverError):
            return direct
        iterations = direct.iterations + relaxed.iterations
        return replace(min(direct, relaxed, key=lambda s: s.objective), iterations=iterations)

    def _solve_relaxed(self, data: SolverInput) -> Solution:
        """Solve with weights of the readings that increase step by step.

        Raises:
            SolverError: If the solver does not converge.
            ClosureError: If a solution cannot reach a posture.
        """
        step, iterations = data, 0
        for factor in RELAXATIONS:
            solution = self._run(replace(step, sigma=factor * data.sigma))
            step = replace(step, start=solution.theta, start_passive=solution.passive)
            iterations += solution.iterations
        return replace(solution, iterations=iterations)

    def _run(self, data: SolverInput) -> Solution:
        """Descend once from the start values with open loops; if that fails, with closed loops.

        Raises:
            SolverError: If the solver does not converge.
            ClosureError: If the solution cannot reach a posture.
        """
        task = Task(self.problem, self.options.loss, data)
        limit = self.options.max_iterations
        start = task.begin()
        try:
            state, jacobian, iterations = self._descend(task, start, limit, open_loops=True)
        except (ClosureError, SolverError):
            # the start anew: the first descent has overwritten its Jacobian
            state, jacobian, iterations = self._descend(task, task.begin(), limit, open_loops=False)
        return task.solution(state, jacobian, passive=state.passive, iterations=iterations)

    def _descend(
        self,
        task: Task,
        start: tuple[Iterate, ReadingLinearisation],
        max_iterations: int,
        *,
        open_loops: bool,
    ) -> tuple[Iterate, Array, int]:
        """Gauss-Newton iterations: the optimum, the last Jacobian and the number of iterations.

        Args:
            task: The task.
            start: Problem and linearisation at the start values, with closed loops.
            max_iterations: Largest number of iterations.
            open_loops: Accept steps after which the loops are closed to first order only.

        Raises:
            SolverError: If the solver does not converge.
            ClosureError: If the solution cannot reach a posture.
        """
        sizes, acceleration = np.full(3, np.inf), _Acceleration()
        state, linear = start
        for iterations in range(1, max_iterations + 1):
            jacobian = linear.jacobian
            jacobian /= task.sigma  # in place: it may be large, and is not used again
            step = task.step(state, jacobian)
            sizes = np.r_[np.abs(step).max(initial=0.0), sizes[:2]]
            accelerated = acceleration.accelerate(state.theta, step)
            if open_loops and have_converged(sizes):
                theta = np.clip(state.theta + accelerated, task.low, task.high)
                passive = state.passive + linear.follow(theta - state.theta)
                return task.at(theta, passive), jacobian, iterations
            trials = [step] if accelerated is step else [accelerated, step]
            reached = None
            for trial in trials if open_loops else []:
                reached = self._move_open(task, state, linear, trial)
                if reached is not None:
                    break
            if reached is not None:
                state, linear = reached
                continue
            closed = self._move_closed(task, state, step, iterations=iterations)
            if closed is None or have_converged(sizes):
                return closed or state, jacobian, iterations
            state = closed
            linear = task.linearise(state.theta, state.passive)
        raise SolverError(
            f"did not converge: the step is still {sizes[0]:.2g} prior standard deviations "
            f"after {max_iterations} iterations; there is no result. {advise(self.options)}",
            status="Maximum_Iterations_Exceeded",
            iterations=max_iterations,
        )

    def _move_open(
        self, task: Task, state: Iterate, linear: ReadingLinearisation, step: Array
    ) -> tuple[Iterate, ReadingLinearisation] | None:
        """State after a full step, with loops closed to first order only.

        None if the loops open too far, the objective increases or a posture is singular.
        """
        theta = np.clip(state.theta + step, task.low, task.high)
        passive = state.passive + linear.follow(theta - state.theta)
        try:
            linear = task.linearise(theta, passive)
        except np.linalg.LinAlgError:
            return None
        correction = np.abs(linear.correction / task.problem.passive_scale).max(initial=0.0)
        if (
            not correction * LENGTH_SCALE
            < MAX_CORRECTION * task.problem.robot.characteristic_length
        ):
            return None
        trial = task.near(theta, passive, linear)
        return (trial, linear) if _is_not_worse(trial, state) else None

    def _move_closed(
        self, task: Task, state: Iterate, step: Array, *, iterations: int
    ) -> Iterate | None:
        """State with closed loops after a step that is halved until the objective decreases.

        None if even a negligible part of the step increases the objective: rounding errors remain.

        Raises:
            SolverError: If no part of the step decreases the objective.
            ClosureError: If the machine cannot reach a posture after any part of the step.
        """
        unreachable, reached = None, False
        for halving in range(MAX_HALVINGS):
            part = step * 0.5**halving
            try:
                trial = task.at(np.clip(state.theta + part, task.low, task.high), state.passive)
            except ClosureError as e:  # a shorter step may be possible
                unreachable = e
                continue
            reached = True
            if _is_not_worse(trial, state):
                return trial
            if np.abs(part).max(initial=0.0) < STEP_TOLERANCE:
                return None
        if unreachable is not None and not reached:
            raise unreachable
        raise SolverError(
            "did not converge: no step improves the fit; there is no result. "
            f"{advise(self.options)}",
            status="Restoration_Failed",
            iterations=iterations,
        )


def have_converged(sizes: Array) -> Mask:
    """Mask of the solutions whose next step is negligible, extrapolated from the last three.

    Args:
        sizes: Sizes of the last three steps, the last one first, infinite for none, shape (3, ...).
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.where(np.isfinite(sizes[1]), sizes[0] / sizes[1], np.inf)
        earlier = np.where(np.isfinite(sizes[2]), sizes[1] / sizes[2], 0.0)
        return np.asarray(
            (sizes[0] <= STEP_TOLERANCE) | (sizes[0] * np.maximum(ratio, earlier) <= STEP_TOLERANCE)
        )


class _Acceleration:
    """Anderson's acceleration of fixed-point iterations (Walker and Ni, SIAM J. Numer. Anal. 2011).

    The Gauss-Newton method neglects the curvature of readings, so that its steps become shorter by
    a constant factor only. Along parameters that change readings to second order, such as the
    position of a fixed ball across the plane of motion, they may alternate.
    """

    def __init__(self) -> None:
        self._points: list[Array] = []
        self._steps: list[Array] = []

    def accelerate(self, theta: Array, step: Array) -> Array:
        """Step from θ̂ that leads to the point at which the steps vanish to first order.

        Args:
            theta: θ̂, shape (n_free,).
            step: Gauss-Newton step from there, shape (n_free,), [prior std].
        """
        self._points = [*self._points[-MEMORY:], theta]
        self._steps = [*self._steps[-MEMORY:], step]
        if len(self._steps) == 1:
            return step
        differences = (np.diff(np.array(a), axis=0).T for a in (self._steps, self._points))
        step_changes, point_changes = differences
        shares = np.linalg.lstsq(step_changes, step, rcond=None)[0]
        return np.asarray(step - (step_changes + point_changes) @ shares)


def _is_not_worse(trial: Iterate, state: Iterate) -> bool:
    """True if the objective of a trial does not exceed that of a state, except by rounding."""
    rounding = OBJECTIVE_TOLERANCE * max(abs(state.objective), 1.0)
    return trial.objective <= state.objective + rounding
