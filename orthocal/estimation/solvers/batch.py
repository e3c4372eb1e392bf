"""Many sets of readings of one plan, calibrated at once: the optimum of each, as alone.

Where few parameters are free the readings are polynomials of them (`surrogate`), and Gauss-Newton
is a product of small matrices for all sets together. Where many are, the curvature that all
machines share (`curved`) gives each its normal equations, and what pulls at it is exact
(`fleet_slopes`). Sets that do not settle, that leave the box of the polynomials, or that a bound
may hold, are solved one by one, as are all where there are only a few.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.estimation.options import SolverOptions
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.solvers.batch_adjoint import FleetSlopes
from orthocal.estimation.solvers.second_order import CurvedReadings, find_curvature
from orthocal.estimation.solvers.surrogate import MOST_PARAMETERS, Surrogate, find_surrogate
from orthocal.estimation.solvers.variable_projection import EliminatedProgram

Array = NDArray[np.float64]

SETTLED = 1e-8
"""Last step, [tolerances]."""

MOST_STEPS = 30
SETS_AT_ONCE = 4096
"""Solved together by polynomials."""

MARGIN = 1.3
"""Sides of the box of polynomials, beside what the linearised solutions need."""

SMALLEST_HALF = 0.05
"""Half a side of that box at least, [tolerances]."""

FEWEST_SETS = 50
"""Sets from which on polynomials are worth finding."""

FEWEST_SETS_A_PARAMETER = 0.7
"""Those from which on the curvature is, which takes an expansion a parameter."""

FAR = 100.0
"""A step of a set that is left to be solved alone, [tolerances]."""

MOST_NUMBERS = 2**21
"""Of the Jacobians that are held at a time."""


@dataclass(frozen=True, slots=True, eq=False)
class BatchSolution:
    """What was found for each set."""

    theta: Array
    """Free parameters, shape (n_sets, n_free), [SI]."""
    zeros: Array
    """Gauge zeros, shape (n_sets, n_zeros), [m]."""
    objective: Array
    """Shape (n_sets,)."""
    at_bound: NDArray[np.int8]
    """As of a `Solution`, shape (n_sets, n_free)."""
    alone: NDArray[np.bool_]
    """Sets that were solved one by one, shape (n_sets,)."""


class BatchProgram:
    """A calibration problem for many sets of readings.

    Args:
        problem: The problem; its own readings are of no account.
        options: Iterations and loss.
    """

    def __init__(
        self, problem: CalibrationProblem, *, options: SolverOptions | None = None
    ) -> None:
        self.problem = problem
        self.options = options or SolverOptions(solver="eliminated")
        self._surrogate: Surrogate | None = None
        self._curved: CurvedReadings | None = None
        self._fixed = False

    @property
    def takes_values(self) -> bool:
        """Whether what sets share depends on where they are: on polynomials about them."""
        return self.problem.n_free <= MOST_PARAMETERS

    def fixed_by(self, values: ArrayLike, *, sigma: float, count: int) -> BatchProgram:
        """The same with what many sets share found once: each is solved alike beside any others.

        Args:
            values: Some of the sets, as for `solve`; none need be there unless `takes_values`.
            sigma: Standard deviation of one reading, [m].
            count: How many sets there will be.
        """
        fixed = BatchProgram(self.problem, options=self.options)
        fixed._fixed = True
        if self.takes_values:
            start = _Shared(self.problem, self.options, sigma).linear(self._entries(values))
            fixed._surrogate = self._find_surrogate(start) if count >= FEWEST_SETS else None
        elif count >= FEWEST_SETS_A_PARAMETER * self.problem.n_free:
            fixed._curved = find_curvature(self.problem)
        return fixed

    def solve(self, values: ArrayLike, *, sigma: float) -> BatchSolution:
        """Solve for each set of readings.

        Args:
            values: Readings as single ones, shape (n_sets, n_entries), [m of the first gauge], or
                rows of the session, shape (n_sets, n_rows), where these are differences, [m].
            sigma: Standard deviation of one reading, [m].

        Raises:
            ValueError: If there are not so many readings a set.
            SolverError: If a set does not converge, alone either.
            ClosureError: If the machine cannot reach a posture with the start values.
        """
        y = self._entries(values)
        about = _Shared(self.problem, self.options, sigma)
        start = about.linear(y)
        found = _Found.empty(len(y), self.problem)
        if (surrogate := self._polynomials(start)) is not None:
            for part in _parts(len(y), SETS_AT_ONCE):
                self._by_polynomials(surrogate, about, y[part], start[part], found.part(part))
        elif (curved := self._curvature(start)) is not None:
            for part in _parts(len(y), max(1, MOST_NUMBERS // curved.jacobian.size)):
                self._by_curvature(curved, about, y[part], start[part], found.part(part))
        else:
            found.alone[:] = True
        self._alone(y, sigma, found)
        scale = self.problem.theta_scale
        theta = np.where(found.alone[:, None], found.theta, found.theta * scale)
        return BatchSolution(theta, found.zeros, found.objective, found.at_bound, found.alone)

    def _entries(self, values: ArrayLike) -> Array:
        o = self.problem.observations
        given = np.atleast_2d(np.asarray(values, dtype=np.float64))
        if given.ndim == 2 and given.shape[1] == o.size:
            return given
        if given.ndim == 2 and given.shape[1] == o.plus.size:
            return np.array([o.values(rows) for rows in given]) / self.problem.noise
        raise ValueError(f"found the shape {given.shape}; expected (n_sets, {o.size})")

    def _polynomials(self, start: Array) -> Surrogate | None:
        """Readings as polynomials where the sets are; None for many parameters, or few sets."""
        if self._fixed or start.shape[1] > MOST_PARAMETERS or len(start) < FEWEST_SETS:
            return self._surrogate if self._fixed else None
        known = self._surrogate
        if known is None or not known.inside(_ends(start)).all():
            self._surrogate = self._find_surrogate(start)
        return self._surrogate

    def _find_surrogate(self, start: Array) -> Surrogate | None:
        low, high = _ends(start)
        half = np.maximum(MARGIN * 0.5 * (high - low), SMALLEST_HALF)
        return find_surrogate(self.problem, 0.5 * (low + high), half)

    def _by_polynomials(
        self, surrogate: Surrogate, about: _Shared, y: Array, theta: Array, found: _Found
    ) -> None:
        """Gauss-Newton of all sets, their readings by polynomials."""
        theta, left = np.array(theta), np.arange(len(y))
        sizes = np.full((3, len(y)), np.inf)
        for _ in range(MOST_STEPS):
            reading, jacobian = surrogate(theta[left])
            residual, _, _ = about.residual((y[left] - reading) / about.sigma)
            step = about.newton(theta[left], residual, jacobian / about.sigma)
            theta[left] += step
            sizes = np.roll(sizes, 1, axis=0)
            sizes[0, left] = np.abs(step).max(axis=1)
            left = left[~_settled(sizes[:, left])]
            if not left.size:
                break
        done = np.ones(len(y), dtype=np.bool_)
        done[left] = False
        done &= surrogate.inside(theta)
        reading, _ = surrogate(np.where(done[:, None], theta, surrogate.centre))
        about.finish(y, theta, reading, done, found)

    def _curvature(self, start: Array) -> CurvedReadings | None:
        """Readings to second order; None for few parameters, few sets or singular machines."""
        n = start.shape[1]
        worth = n > MOST_PARAMETERS and len(start) >= FEWEST_SETS_A_PARAMETER * n
        if self._curved is None and worth and not self._fixed:
            self._curved = find_curvature(self.problem)
        return self._curved

    def _by_curvature(
        self, curved: CurvedReadings, about: _Shared, y: Array, theta: Array, found: _Found
    ) -> None:
        """All sets by normal equations to second order, and what exactly pulls at each."""
        problem, left, done = self.problem, np.arange(len(y)), np.zeros(len(y), dtype=np.bool_)
        sizes = np.full((3, len(y)), np.inf)
        reading, jacobian = curved(theta)
        residual, _, _ = about.residual((y - reading) / about.sigma)
        theta = theta + about.newton(theta, residual, jacobian / about.sigma)
        reading, jacobian = curved(theta)
        jacobian /= about.sigma
        passive = problem.reference_passive + curved.machine.follow(theta - curved.reference)
        inverses, before, last = None, None, np.zeros_like(theta)
        for _ in range(MOST_STEPS):
            try:
                exact = FleetSlopes(problem, theta[left], passive[left])
            except np.linalg.LinAlgError:  # one of them is far off: each by itself
                break
            residual, _, _ = about.residual((y[left] - exact.reading) / about.sigma)
            if inverses is None or about.loss.robust:
                inverses = np.asarray(np.linalg.inv(about.square(residual, jacobian[left])))
            pull = about.pull(theta[left], exact.pull(about.loss.influence(residual) / about.sigma))
            if before is not None:
                _learn(inverses, before[0], before[1] - pull)
            step = (inverses @ pull[..., None])[..., 0]
            theta[left] += step
            passive[left] += exact.follow(step)
            reading[left], last[left] = exact.reading, step
            sizes = np.roll(sizes, 1, axis=0)
            sizes[0, left] = np.abs(step).max(axis=1)
            settled = _settled(sizes[:, left])
            done[left] = settled
            on = ~settled & (sizes[0, left] < FAR)
            before = step[on], pull[on]
            if not on.all():
                left, inverses = left[on], inverses[on]
            if not left.size:
                break
        reading += about.sigma * (jacobian @ last[..., None])[..., 0]
        about.finish(y, theta, reading, done, found)

    def _alone(self, y: Array, sigma: float, found: _Found) -> None:
        """The sets that are left, one by one."""
        program = EliminatedProgram(self.problem, options=self.options)
        for i in np.flatnonzero(found.alone).tolist():
            solution = program.solve(sigma=sigma, values=y[i])
            found.theta[i], found.zeros[i] = solution.theta, solution.zeros
            found.objective[i], found.at_bound[i] = solution.objective, solution.at_bound


def _ends(start: Array) -> Array:
    """Where nearly all sets lie between, θ̂, shape (2, n_free)."""
    return np.quantile(start, [0.001, 0.999], axis=0)


def _settled(sizes: Array) -> NDArray[np.bool_]:
    """Whether the step after the last would change nothing; sizes of the last three, (3, n)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        last = np.where(np.isfinite(sizes[1]), sizes[0] / sizes[1], np.inf)
        before = np.where(np.isfinite(sizes[2]), sizes[1] / sizes[2], 0.0)
    return np.asarray((sizes[0] <= SETTLED) | (sizes[0] * np.maximum(last, before) <= SETTLED))


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Results to be filled."""

    theta: Array
    zeros: Array
    objective: Array
    at_bound: NDArray[np.int8]
    alone: NDArray[np.bool_]

    @staticmethod
    def empty(count: int, problem: CalibrationProblem) -> _Found:
        n = problem.n_free
        return _Found(
            np.empty((count, n)),
            np.empty((count, problem.observations.n_zeros)),
            np.empty(count),
            np.zeros((count, n), dtype=np.int8),
            np.zeros(count, dtype=np.bool_),
        )

    def part(self, part: slice) -> _Found:
        """Views of some sets."""
        return _Found(
            self.theta[part],
            self.zeros[part],
            self.objective[part],
            self.at_bound[part],
            self.alone[part],
        )


class _Shared:
    """What all sets share: the linearised problem at the reference, prior, bounds and loss."""

    def __init__(self, problem: CalibrationProblem, options: SolverOptions, sigma: float) -> None:
        self.problem, self.loss, self.sigma = problem, options.loss, sigma
        o, scale = problem.observations, problem.theta_scale
        self._low, self._high = problem.selection.lower / scale, problem.selection.upper / scale
        self._mean = problem.prior_mean / scale
        self._precision = problem.prior_precision
        self._reference = problem.reference / scale
        self._zeros = problem.zero_incidence
        self._counts = np.bincount(o.zero, minlength=o.n_zeros)
        found = problem.expand(problem.reference, problem.reference_passive)
        self._reading = found.reading
        self._jacobian = self._centre(found.jacobian / sigma)
        square = self._jacobian.T @ self._jacobian + np.diag(self._precision)
        self._inverse = np.linalg.pinv(square, rcond=1e-13, hermitian=True)

    def linear(self, y: Array) -> Array:
        """Linearised solutions, by squares, within the bounds, shape (n_sets, n_free)."""
        left = self._centre(((y - self._reading) / self.sigma).T).T
        pull = left @ self._jacobian - self._precision * (self._reference - self._mean)
        return np.asarray(np.clip(self._reference + pull @ self._inverse, self._low, self._high))

    def residual(self, deviation: Array) -> tuple[Array, Array, Array]:
        """Residuals, zeros and costs of deviations, shape (n_sets, n_entries), [σ]."""
        n, o = len(deviation), self.problem.observations
        if self.loss.robust:
            group = (np.arange(n)[:, None] * o.n_zeros + o.zero).reshape(-1)
            flat = deviation.reshape(-1)
            zeros = self.loss.centres(flat, group, n * o.n_zeros, weights=np.ones(flat.size))
            zeros = zeros.reshape(n, -1)
        else:
            zeros = deviation @ self._zeros / self._counts
        residual = deviation - zeros[:, o.zero]
        return residual, zeros, self.loss.value(residual).sum(axis=1)

    def newton(self, theta: Array, residual: Array, jacobian: Array) -> Array:
        """Gauss-Newton's steps with a Jacobian for each set, shape (n_sets, n_free)."""
        square = self.square(residual, jacobian)
        pull = self.pull(theta, (self.loss.influence(residual)[:, None] @ jacobian)[:, 0])
        return np.asarray(np.linalg.solve(square, pull[..., None])[..., 0])

    def square(self, residual: Array, jacobian: Array) -> Array:
        """Normal equations of each set, gauge zeros eliminated, shape (n_sets, n_free, n_free)."""
        if not self.loss.robust:
            weighted, sums = jacobian, self._counts.astype(np.float64)[None, :, None]
        else:
            weights = self.loss.weight(residual)[..., None]
            weighted, sums = weights * jacobian, self._zeros.T @ weights
        of_zeros = self._zeros.T @ weighted
        result = np.swapaxes(jacobian, 1, 2) @ weighted
        result -= np.swapaxes(of_zeros, 1, 2) @ (of_zeros / sums)
        result += np.diag(self._precision)
        return np.asarray(result)

    def pull(self, theta: Array, of_readings: Array) -> Array:
        """What pulls at θ̂, readings and prior, shape (n_sets, n_free)."""
        return np.asarray(of_readings - self._precision * (theta - self._mean))

    def finish(
        self, y: Array, theta: Array, reading: Array, done: NDArray[np.bool_], found: _Found
    ) -> None:
        """Fill in what was found; what is not done, or not within the bounds, is left over."""
        within = ((theta > self._low) & (theta < self._high)).all(axis=1)
        _, zeros, cost = self.residual((y - reading) / self.sigma)
        off = theta - self._mean
        found.theta[...], found.zeros[...] = theta, zeros * self.sigma
        found.objective[...] = cost + 0.5 * (self._precision * off**2).sum(axis=1)
        found.alone[...] = ~(done & within & np.isfinite(found.objective))

    def _centre(self, values: Array) -> Array:
        """Rows less the mean of those with the same zero, shape as given."""
        means = self._zeros.T @ values / self._counts[:, None]
        return np.asarray(values - means[self.problem.observations.zero])


def _parts(count: int, size: int) -> Iterator[slice]:
    for first in range(0, count, size):
        yield slice(first, first + size)


def _learn(inverses: Array, step: Array, answer: Array) -> None:
    """Make inverse normal equations give the step for its answer, in place (BFGS)."""
    along = (step * answer).sum(axis=1)
    with np.errstate(divide="ignore"):
        share = np.where(along > 0.0, 1.0 / along, 0.0)[:, None]
    turned = (inverses @ answer[..., None])[..., 0]
    own = share * (1.0 + share * (answer * turned).sum(axis=1, keepdims=True)) * step
    both = 0.5 * own - share * turned
    inverses += both[:, :, None] * step[:, None, :]
    inverses += step[:, :, None] * both[:, None, :]
