"""Readings as polynomials of a few parameters: interpolants that are as good as the readings.

Readings are smooth functions of errors that are small beside the machine: the degree that leaves
nothing is found by trial, at points that were not used.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.solvers.machine_readings import Fleet

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MOST_PARAMETERS = 6
"""With more there are too many products of them."""

DEGREES = (3, 5, 7, 9)

MOST_TERMS = 500

EXACT = 2e-11
"""Largest error of a reading at points that were not used, [m]."""

POINTS_A_TERM = 3
CHECKED = 100
"""Points at which the error is looked at."""


@dataclass(frozen=True, slots=True, eq=False)
class Surrogate:
    """Readings over a box of θ̂."""

    centre: Array
    half: Array
    """Half of its sides, shape (n_free,), [tolerances]."""
    powers: Indices
    """Degree of each parameter in each term, shape (n_terms, n_free)."""
    coefficients: Array
    """Shape (n_terms, n_entries), [m]."""

    def inside(self, theta: Array) -> NDArray[np.bool_]:
        """Whether each θ̂ is in the box, shape (n_sets,)."""
        return np.asarray((np.abs(theta - self.centre) <= self.half).all(axis=1))

    def __call__(self, theta: Array) -> tuple[Array, Array]:
        """Readings and their derivatives.

        Args:
            theta: θ̂, shape (n_sets, n_free).

        Returns:
            Shape (n_sets, n_entries), [m], and (n_sets, n_entries, n_free), [m per tolerance].
        """
        values, slopes = _chebyshev((theta - self.centre) / self.half, int(self.powers.max()))
        n_free = theta.shape[1]
        jacobian = np.empty((len(theta), self.coefficients.shape[1], n_free))
        for i in range(n_free):
            terms = _products(values, self.powers, slopes=slopes, by=i) / self.half[i]
            jacobian[:, :, i] = terms @ self.coefficients
        return _products(values, self.powers) @ self.coefficients, jacobian


def find_surrogate(problem: CalibrationProblem, centre: Array, half: Array) -> Surrogate | None:
    """The surrogate over a box; None where no degree is enough, or a machine cannot be assembled.

    Args:
        problem: The problem.
        centre: Of the box, θ̂, shape (n_free,).
        half: Half of its sides, shape (n_free,).
    """
    rng = np.random.default_rng(0)
    checked = rng.uniform(-1.0, 1.0, (CHECKED, centre.size))
    expected = _readings(problem, centre + half * checked)
    if expected is None:
        return None
    for degree in DEGREES:
        powers = _powers(centre.size, degree)
        if len(powers) > MOST_TERMS:
            return None
        points = np.cos(rng.uniform(0.0, np.pi, (POINTS_A_TERM * len(powers), centre.size)))
        found = _readings(problem, centre + half * points)
        if found is None:
            return None
        terms = _products(_chebyshev(points, degree)[0], powers)
        coefficients = np.asarray(np.linalg.lstsq(terms, found, rcond=None)[0], dtype=np.float64)
        result = Surrogate(centre, half, powers, coefficients)
        if np.abs(result(centre + half * checked)[0] - expected).max() < EXACT:
            return result
    return None


def _readings(problem: CalibrationProblem, theta: Array) -> Array | None:
    fleet = Fleet(problem, theta)
    return fleet.predict() if fleet.close().all() else None


def _powers(n: int, degree: int) -> Indices:
    """Degrees of all products of at most a total degree, shape (n_terms, n)."""
    found = [p for p in itertools.product(range(degree + 1), repeat=n) if sum(p) <= degree]
    return np.array(sorted(found, key=sum), dtype=np.int64)


def _chebyshev(x: Array, degree: int) -> tuple[Array, Array]:
    """Chebyshev polynomials and their derivatives, shape (degree + 1, n_sets, n_free) each."""
    values, slopes = np.ones((degree + 1, *x.shape)), np.zeros((degree + 1, *x.shape))
    if degree:
        values[1], slopes[1] = x, 1.0
    for k in range(2, degree + 1):
        values[k] = 2.0 * x * values[k - 1] - values[k - 2]
        slopes[k] = 2.0 * values[k - 1] + 2.0 * x * slopes[k - 1] - slopes[k - 2]
    return values, slopes


def _products(
    values: Array, powers: Indices, *, slopes: Array | None = None, by: int = -1
) -> Array:
    """Products of polynomials, shape (n_sets, n_terms); of one parameter the derivative."""
    result = np.ones((len(powers), values.shape[1]))
    for i in range(values.shape[2]):
        of = slopes if i == by and slopes is not None else values
        result *= of[powers[:, i], :, i]
    return np.asarray(result.T)
