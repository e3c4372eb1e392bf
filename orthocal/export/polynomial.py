"""Polynomials of points in a box, fitted by least squares.

f(p) = Σ_t c_t Π_k x_k^e_tk,  x = (p − middle)/half
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from orthocal.arrays import Array, Indices


@dataclass(frozen=True, slots=True, eq=False)
class Polynomial:
    """Vector-valued polynomial of n coordinates."""

    middle: Array
    """Middle of the box, shape (n,), [m]."""
    half: Array
    """Half the sides of the box, shape (n,), [m]."""
    exponents: Indices
    """Exponents of the terms, shape (n_terms, n)."""
    tensor: Array
    """Coefficients by exponents, shape (d_1 + 1, ..., d_n + 1, n_values)."""

    @property
    def coefficients(self) -> Array:
        """Coefficients of the terms, shape (n_values, n_terms)."""
        return np.asarray(self.tensor[tuple(self.exponents.T)].T)

    @property
    def degree(self) -> int:
        """Total degree."""
        return int(self.exponents.sum(axis=1).max())

    def __call__(self, points: Array) -> Array:
        """Values at points (k, n), inside or outside the box, shape (k, n_values).

        The coefficient tensor is contracted with the powers of one coordinate after the other.
        """
        scaled, values = (points - self.middle) / self.half, self.tensor
        for k in range(scaled.shape[1]):
            powers = np.vander(scaled[:, k], self.tensor.shape[k], increasing=True)
            if k == 0:
                flat = powers @ values.reshape(len(values), -1)
                values = flat.reshape(len(scaled), *values.shape[1:])
            else:
                values = np.einsum("ni,ni...->n...", powers, values)
        return np.asarray(values)


class PolynomialFit:
    """Least-squares fit of polynomials to values at the same points of different boxes.

    Args:
        scaled: Points of a box of ±1, shape (k, n).
        exponents: Exponents of the terms, shape (n_terms, n).
    """

    def __init__(self, scaled: Array, exponents: Indices) -> None:
        self._exponents = exponents
        self._shape = tuple(exponents.max(axis=0) + 1)
        terms = np.ones((len(scaled), len(exponents)))
        for k, column in enumerate(exponents.T):
            terms *= np.vander(scaled[:, k], self._shape[k], increasing=True)[:, column]
        self._inverse = np.linalg.pinv(terms)

    def __call__(self, middle: Array, half: Array, values: Array) -> Polynomial:
        """Polynomial of a box.

        Args:
            middle: Middle of the box, shape (n,), [m].
            half: Half the sides of the box, shape (n,), [m].
            values: Values at the points, shape (k, n_values).
        """
        tensor = np.zeros((*self._shape, values.shape[1]))
        tensor[tuple(self._exponents.T)] = self._inverse @ values
        return Polynomial(middle, half, self._exponents, tensor)


def total_degree(n: int, degree: int) -> Indices:
    """Exponents of all terms of n coordinates up to a total degree, shape (n_terms, n)."""
    exponents = [e for e in product(range(degree + 1), repeat=n) if sum(e) <= degree]
    return np.array(sorted(exponents, key=lambda e: (sum(e), e)), dtype=np.int64)


def chebyshev_line(count: int) -> Array:
    """Chebyshev nodes of [−1, 1] including both ends, shape (count,)."""
    return np.asarray(-np.cos(np.pi * np.arange(count) / (count - 1)))
