"""Many sets of readings of one plan, calibrated at once: the optimum of each, as alone.

Where few parameters are free the readings are polynomials of them (`surrogate`), and Gauss-Newton
is a product of small matrices for all sets together. Otherwise all machines are looked at together
(`fleet`): the gradient of each is exact, the Hessian one for all (the chord method), and each step
makes use of what the last ones changed (Anderson 1965). Sets that do not settle, or that a bound
may hold, are solved one by one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.identification.options import SolverOptions
from orthocal.identification.problem import CalibrationProblem
from orthocal.identification.solvers.eliminated import EliminatedProgram
from orthocal.identification.solvers.fleet import POSTURES_AT_ONCE, Fleet
from orthocal.identification.solvers.surrogate import MOST_PARAMETERS, Surrogate, find_surrogate

Array = NDArray[np.float64]

SETTLED = 1e-8
"""Last step, [tolerances]."""

MOST_STEPS = 30
REMEMBERED = 4
"""Steps that the next one makes use of."""

SETS_AT_ONCE = 4096
"""Solved together by polynomials."""

MARGIN = 1.3
"""Sides of the box of polynomials, beside what the linearised solutions need."""

SMALLEST_HALF = 0.05
"""Half a side of that box at least, [tolerances]."""

FEWEST_SETS = 50
"""Sets from which on polynomials are worth finding."""


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

    def solve(self, values: ArrayLike, *, sigma: float) -> BatchSolution:
        """Solve for each set of readings.

        Args:
            values: Readings as single ones, shape (n_sets, n_entries), or rows of the session,
                shape (n_sets, n_rows), where these are differences, [m].
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
        if self._few(start):
            for first in range(0, len(y), SETS_AT_ONCE):
                part = slice(first, first + SETS_AT_ONCE)
                self._by_polynomials(about, y[part], start[part], found.part(part))
        else:
            size = max(1, POSTURES_AT_ONCE // self.problem.n_postures)
            for first in range(0, len(y), size):
                part = slice(first, first + size)
                self._by_chord(about, y[part], start[part], found.part(part))
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
            return np.array([o.values(rows) for rows in given])
        raise ValueError(f"found the shape {given.shape}; expected (n_sets, {o.size})")

    def _few(self, start: Array) -> bool:
        """Whether there are polynomials for these sets; finds them."""
        if start.shape[1] > MOST_PARAMETERS or len(start) < FEWEST_SETS:
            return False
        low, high = (np.quantile(start, p, axis=0) for p in (0.001, 0.999))
        known = self._surrogate
        if known is not None and known.inside(np.array([low, high])).all():
            return True
        half = np.maximum(MARGIN * 0.5 * (high - low), SMALLEST_HALF)
        self._surrogate = find_surrogate(self.problem, 0.5 * (low + high), half)
        return self._surrogate is not None

    def _by_polynomials(self, about: _Shared, y: Array, theta: Array, found: _Found) -> None:
        """Gauss-Newton of all sets, their readings by polynomials."""
        surrogate = self._surrogate
        assert surrogate is not None
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

    def _by_chord(self, about: _Shared, y: Array, theta: Array, found: _Found) -> None:
        """The chord method, all machines looked at together."""
        fleet = Fleet(self.problem, np.array(theta))
        closed = fleet.close()
        fleet.passive[~closed] = self.problem.reference_passive
        memory = _Anderson()
        done = np.zeros(len(y), dtype=np.bool_)
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            for _ in range(MOST_STEPS):
                at = fleet.expand()
                residual, _, _ = about.residual((y - at.reading) / about.sigma)
                pull = fleet.pull(at, about.loss.influence(residual)) / about.sigma
                plain = about.chord(fleet.theta, pull)
                size = np.abs(plain).max(axis=1)
                done = closed & (size <= SETTLED)
                if done.all():
                    break
                step = np.where(done[:, None], 0.0, memory.step(fleet.theta, plain))
                lost = ~np.isfinite(step).all(axis=1)
                closed &= ~lost
                step[lost] = 0.0
                fleet.follow(at, step)
                broken = ~np.isfinite(fleet.passive).all(axis=(1, 2))
                fleet.passive[broken] = self.problem.reference_passive
                closed &= ~broken
        about.finish(y, fleet.theta, at.reading, done, found)

    def _alone(self, y: Array, sigma: float, found: _Found) -> None:
        """The sets that are left, one by one."""
        program = EliminatedProgram(self.problem, options=self.options)
        for i in np.flatnonzero(found.alone).tolist():
            solution = program.solve(sigma=sigma, values=y[i])
            found.theta[i], found.zeros[i] = solution.theta, solution.zeros
            found.objective[i], found.at_bound[i] = solution.objective, solution.at_bound


def _settled(sizes: Array) -> NDArray[np.bool_]:
    """Whether the step after the last would change nothing; sizes of the last three, (3, n)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        shrinking = np.fmax(sizes[0] / sizes[1], sizes[1] / sizes[2])
    return np.asarray((sizes[0] <= SETTLED) | (sizes[0] * shrinking <= 0.1 * SETTLED))


class _Anderson:
    """Steps of a fixed-point iteration θ ← θ + f(θ), by those before (Anderson 1965)."""

    def __init__(self) -> None:
        self._thetas: list[Array] = []
        self._steps: list[Array] = []

    def step(self, theta: Array, plain: Array) -> Array:
        """The step to take, shape (n_sets, n_free), of the plain one."""
        self._thetas = [*self._thetas[-REMEMBERED:], np.array(theta)]
        self._steps = [*self._steps[-REMEMBERED:], plain]
        if len(self._steps) == 1:
            return plain
        changes = np.stack([b - a for a, b in _pairs(self._steps)], axis=1)
        moves = np.stack([b - a for a, b in _pairs(self._thetas)], axis=1)
        square = changes @ np.swapaxes(changes, 1, 2)
        scale = np.trace(square, axis1=1, axis2=2)[:, None, None]
        square = square + (1e-12 * scale + 1e-300) * np.eye(square.shape[1])
        right = changes @ plain[..., None]
        shares = np.linalg.solve(square, right)
        return np.asarray(plain - ((moves + changes) * shares).sum(axis=1))


def _pairs(items: list[Array]) -> list[tuple[Array, Array]]:
    return list(zip(items, items[1:], strict=False))


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
            *(v[part] for v in (self.theta, self.zeros, self.objective)),
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
        weights = self.loss.weight(residual)[..., None]
        sums = np.swapaxes(self._zeros.T @ weights, 1, 2)
        means = np.swapaxes(np.swapaxes(weights * jacobian, 1, 2) @ self._zeros / sums, 1, 2)
        centred = jacobian - means[:, self.problem.observations.zero]
        square = np.swapaxes(centred, 1, 2) @ (weights * centred) + np.diag(self._precision)
        pull = (self.loss.influence(residual)[:, None] @ jacobian)[:, 0]
        pull = pull - self._precision * (theta - self._mean)
        return np.asarray(np.linalg.solve(square, pull[..., None])[..., 0])

    def chord(self, theta: Array, pull: Array) -> Array:
        """Steps by the Hessian at the reference, of the pull of the residuals."""
        return np.asarray((pull - self._precision * (theta - self._mean)) @ self._inverse)

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
