"""Closed-form kinematics of the Orthoglide, vectorised over postures.

Equations (2) and (3) of Pashkevich, Chablat and Wenger (2006) check the closed-loop model; the
identification does not use them. R = ρ + Δρ are the actual positions of the slides.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array


def inverse(
    points: ArrayLike,
    *,
    length: float,
    offsets: ArrayLike = (0.0, 0.0, 0.0),
    configuration: Sequence[int] = (1, 1, 1),
) -> Array:
    """Joint coordinates ρ by equation (2), shape (..., 3), [m].

        ρ_i = p_i + s_i √(L² − Σ_{j≠i} p_j²) − Δρ_i

    The machine is built with the signs s of (1, 1, 1).
    """
    p = np.asarray(points, dtype=np.float64)
    square = p**2
    others = square.sum(axis=-1, keepdims=True) - square
    return np.asarray(p + np.asarray(configuration) * np.sqrt(length**2 - others) - offsets)


def direct(
    joints: ArrayLike, *, length: float, offsets: ArrayLike = (0.0, 0.0, 0.0), root: int = -1
) -> Array:
    """Tool centre points by equation (3), shape (..., 3), [m].

        p_i = R_i/2 + t/R_i,  t = (−b + m √(b² − 4 a c)) / (2 a)
        a = Σ_{i<j} R_i² R_j²,  b = Π R_i²,  c = (Σ R_i²/4 − L²) Π R_i²

    a and c are corrected: the paper prints a product for a, and c without its factor. The machine
    is built with m = −1, which the paper does not state.
    """
    slides = np.asarray(joints, dtype=np.float64) + np.asarray(offsets, dtype=np.float64)
    square = slides**2
    b = square.prod(axis=-1)
    a = (square * np.roll(square, 1, axis=-1)).sum(axis=-1)
    c = (square.sum(axis=-1) / 4.0 - length**2) * b
    t = (-b + root * np.sqrt(b**2 - 4.0 * a * c)) / (2.0 * a)
    return np.asarray(slides / 2.0 + t[..., None] / slides)
