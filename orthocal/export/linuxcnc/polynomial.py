"""Polynomials of the tool's position that correct the drives: how they are fitted and evaluated.

    q(p) = nominal(p) + Σ_t c_t Π_k x_k^e_tk,  x = clamp((p − middle)/half, −1, 1)

of a total degree Σ_k e_tk. Beyond the region the argument stays on its faces, so that what is added
stays what it is there.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from orthocal.export.linuxcnc.nominal_form import NominalForm
from orthocal.io.fields import read_only

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedInverse:
    """Drive coordinates of points of the tool: a nominal form and a polynomial correction."""

    nominal: NominalForm
    middle: Array
    """Of the region, shape (n,), [m]."""
    half: Array
    """Half its sides, shape (n,), [m]."""
    exponents: NDArray[np.int64]
    """Shape (terms, n)."""
    coefficients: Array
    """Shape (n_drives, terms), [m, rad]."""

    @property
    def degree(self) -> int:
        """Total degree."""
        return int(self.exponents.sum(axis=1).max())

    def __call__(self, points: Array) -> Array:
        """Drive coordinates, shape (K, n_drives), [m, rad], of points, shape (K, n), [m]."""
        return np.asarray(self.nominal(points)[0] + self._terms(points) @ self.coefficients.T)

    def slopes(self, points: Array) -> Array:
        """∂q/∂p within the region, shape (K, n_drives, n)."""
        result = np.array(self.nominal(points)[1])
        for k in range(self.middle.size):
            lowered = np.array(self.exponents)
            lowered[:, k] = np.maximum(lowered[:, k] - 1, 0)
            terms = self.exponents[:, k] * design(self._scaled(points), lowered) / self.half[k]
            result[:, :, k] += terms @ self.coefficients.T
        return result

    def _scaled(self, points: Array) -> Array:
        return np.asarray(np.clip((points - self.middle) / self.half, -1.0, 1.0))

    def _terms(self, points: Array) -> Array:
        return design(self._scaled(points), self.exponents)


def exponents_of(n: int, degree: int) -> NDArray[np.int64]:
    """Exponents of all terms of n variables up to a total degree, shape (terms, n)."""
    found = [e for e in product(range(degree + 1), repeat=n) if sum(e) <= degree]
    return np.array(sorted(found, key=lambda e: (sum(e), e)), dtype=np.int64)


def design(scaled: Array, exponents: NDArray[np.int64]) -> Array:
    """Terms of scaled points, shape (K, n), each the product of its powers, shape (K, terms)."""
    result = np.ones((len(scaled), len(exponents)))
    for k, column in enumerate(exponents.T):
        result *= scaled[:, k, None] ** np.arange(column.max() + 1)[column]
    return result


def chebyshev_lattice(n: int, count: int) -> Array:
    """Nodes of Chebyshev's in a cube of ±1, faces included, shape (count^n, n)."""
    line = -np.cos(np.pi * np.arange(count) / (count - 1))
    grid = np.meshgrid(*[line] * n, indexing="ij")
    return np.stack(grid, axis=-1).reshape(-1, n)


def fit_correction(
    nominal: NominalForm, middle: Array, half: Array, scaled: Array, drives: Array, *, degree: int
) -> CorrectedInverse:
    """The correction of a degree that comes closest, by least squares.

    Args:
        nominal: What is corrected.
        middle: Of the region, shape (n,), [m].
        half: Half its sides, shape (n,), [m].
        scaled: Points of the region, of ±1, shape (K, n).
        drives: Where the drives belong there, shape (K, n_drives), [m, rad].
        degree: Total degree.
    """
    exponents = exponents_of(middle.size, degree)
    wanted = drives - nominal(middle + half * scaled)[0]
    found = np.linalg.lstsq(design(scaled, exponents), wanted, rcond=None)[0]
    return CorrectedInverse(nominal, middle, half, exponents, read_only(found.T))
