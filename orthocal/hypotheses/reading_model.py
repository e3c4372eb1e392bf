"""What a machine would show, linearised where the readings are: what edits are held to."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import ClosureError, SolverError
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.selection import select_parameters
from orthocal.estimation.solvers.choice import build_program
from orthocal.estimation.weighting import SIGMA_WITHOUT_WORD, first_noise
from orthocal.hypotheses.likelihood import Likelihood, likelihood_of
from orthocal.session.session import Session
from orthocal.statistics.noise import noise_floor
from orthocal.statistics.zeros import project_out_zeros

Array = NDArray[np.float64]

MOST_ROUNDS = 2
"""Linearisations until one is where the readings are."""

NEAR = 0.2
"""Change of the errors, in tolerances, below which a linearisation holds."""

MOST_STEPS = 8
"""Gauss-Newton steps to the most likely machine."""

SETTLED = 0.02
"""Change of the errors, in tolerances, below which the most likely machine is found."""

FURTHEST = 6.0
"""Tolerances beyond which no linearisation is sought."""


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """A machine near which readings are held against what errors make of it."""

    expected: Array
    """What the machine as expected would show, to first order, shape (n_entries,), [m]."""
    likelihood: Likelihood
    errors: Array
    """θ̂ per metre along each direction, shape (n_free, r): ∂h/∂θ̂ over its singular values."""
    sizes: Array
    """Singular values, shape (r,), [m]."""
    theta: Array
    """About which it is linearised, shape (n_free,), [SI]."""
    passive: Array
    """Passive coordinates there, shape (n_postures, n_passive), [m, rad]."""

    def errors_for(self, deviation: Array, excess: float, noise: float) -> Array:
        """Most likely errors, in tolerances, shape (n_free,)."""
        variance = excess**2 * self.sizes**2 + (noise * self.likelihood.sigma) ** 2
        along = self.likelihood.directions @ deviation
        return np.asarray(self.errors @ (excess**2 * self.sizes / variance * along))


class ReadingModel:
    """A session's readings as of a machine of which the tolerances alone are known.

    Args:
        session: The session.
        model: Errors that the machine may have; all that change something by default.

    Raises:
        RobotError: If the closures of the robot depend on each other.
        ParameterError: If the model is unknown.
    """

    def __init__(self, session: Session, model: str | None = None) -> None:
        parameters = session.robot.parameters
        names = machine_errors(session.robot) if model is None else parameters.select_model(model)
        selection = select_parameters(parameters, free=names, prior=True)
        problem = CalibrationProblem(session, selection)
        self.problem = problem.with_noise(first_noise(session, problem.observations))
        o = self.problem.observations
        self.stated = session.gauge.sigma is not None
        floor = noise_floor(session.gauge.sigma or SIGMA_WITHOUT_WORD, session.gauge.resolution)
        self.sigma = max(floor, 1e-9)
        self.dof = o.size - o.n_zeros
        self._raw = bool((o.minus < 0).all())
        self.reference = self.problem.reference

    def entries(self, rows: Array) -> Array:
        """Single readings, zeros eliminated, of edited rows, shape (h, n_entries), [m].

        Args:
            rows: Shape (h, n_rows), [m].
        """
        o = self.problem.observations
        if self._raw:
            taken = np.empty_like(rows)
            taken[:, o.plus] = rows
        else:
            taken = rows @ self._taken_apart
        taken = taken / self.problem.noise
        return np.asarray(project_out_zeros(np.ascontiguousarray(taken.T), o).T)

    @property
    def _taken_apart(self) -> Array:
        """Single readings of each row alone, shape (n_rows, n_entries)."""
        o = self.problem.observations
        return np.array([o.values(row) for row in np.eye(o.plus.size)])

    def reference_machine(self) -> Linearised:
        """Linearised about what the controller already corrects.

        Raises:
            ClosureError: If the machine cannot reach a posture.
        """
        return self._linearise(self.reference, None)

    def settle(self, rows: Array, wrong: Array | None, start: Linearised) -> Linearised:
        """Linearised where readings are; where they make no machine, where it was begun.

        Args:
            rows: Readings, shape (n_rows,), [m].
            wrong: What they may be wrong by, shape (n_rows,); None for nothing.
            start: Where to begin.
        """
        found, last = start, (start.theta - self.reference) / self.problem.theta_scale
        entries = self.entries(rows[None])[0]
        own = None if wrong is None else self.entries(wrong[None])[0]
        for _ in range(MOST_ROUNDS):
            deviation = entries - found.expected
            excess, noise, amount = found.likelihood.settle(deviation, own)
            left = deviation if own is None else deviation - amount * own
            errors = found.errors_for(left, excess, noise)
            change, last = float(np.abs(errors - last).max(initial=0.0)), errors
            if change < NEAR or not np.abs(errors).max(initial=0.0) < FURTHEST:
                break
            theta = self.reference + errors * self.problem.theta_scale
            try:
                found = self._linearise(theta, found.passive)
            except (ClosureError, np.linalg.LinAlgError):
                break
        return found

    def most_likely(self, rows: Array) -> Linearised:
        """Linearised about the most likely machine, errors at their tolerances as prior.

        Gauss-Newton steps until the errors change by less than SETTLED tolerances: offsets of some
        mm bend readings by more than other errors move them. Where no machine is reached, the last
        one that was.

        Args:
            rows: Readings, shape (n_rows,), [m].
        """
        entries = self.entries(rows[None])[0]
        found, last = self.reference_machine(), np.zeros(self.reference.size)
        for _ in range(MOST_STEPS):
            errors = found.errors_for(entries - found.expected, 1.0, 1.0)
            change, last = float(np.abs(errors - last).max(initial=0.0)), errors
            if not change > SETTLED:
                break
            theta = self.reference + errors * self.problem.theta_scale
            try:
                found = self._linearise(theta, found.passive)
            except (ClosureError, np.linalg.LinAlgError):
                break
        return found

    def deviations(self, rows: Array, about: Linearised) -> Array:
        """Readings less those of the machine as expected, shape (h, n_entries), [m]."""
        return np.asarray(self.entries(rows) - about.expected)

    def left_at_first(self, rows: Array, about: Linearised) -> float:
        """Root mean square of what a machine within its tolerances leaves of readings, [m].

        To first order: readings with a mistake in them may be of no machine at all.

        Args:
            rows: Readings, shape (n_rows,), [m].
            about: Where it is linearised.
        """
        deviation = self.deviations(rows[None], about)[0]
        errors = about.errors_for(deviation, 1.0, 1.0)
        along = about.sizes * (about.errors.T @ errors)
        left = (deviation - along @ about.likelihood.directions) * self.problem.noise
        return float(np.sqrt(np.mean(self.problem.observations.rows(left) ** 2)))

    def left_over(self, rows: Array, about: Linearised) -> float:
        """Root mean square of what a machine within its tolerances leaves of readings, [m].

        By the exact solution; infinite where there is none.

        Args:
            rows: Readings, shape (n_rows,), [m].
            about: Where to begin.
        """
        problem = self.problem.with_values(rows)
        try:
            program = build_program(problem, SolverOptions(solver="eliminated"))
            solution = program.solve(
                sigma=self.sigma, start=about.theta, start_passive=about.passive
            )
            prediction = problem.predict(solution.theta, solution.passive)
        except (ClosureError, SolverError):
            return math.inf
        o = problem.observations
        left = project_out_zeros(problem.values - prediction, o) * problem.noise
        return float(np.sqrt(np.mean(o.rows(left) ** 2)))

    def _linearise(self, theta: Array, start: Array | None) -> Linearised:
        o = self.problem.observations
        passive = self.problem.close(theta, start=start)
        prediction, jacobian = self.problem.linearise(theta, passive)
        slopes = project_out_zeros(jacobian, o)
        errors = (theta - self.reference) / self.problem.theta_scale
        expected = project_out_zeros(prediction, o) - slopes @ errors
        likelihood, vectors, sizes = likelihood_of(
            slopes, sigma=self.sigma, dof=self.dof, stated=self.stated
        )
        return Linearised(expected, likelihood, vectors, sizes, theta, passive)
