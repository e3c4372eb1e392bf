"""Closed-form kinematics of the Orthoglide: equations (1) to (6) of Pashkevich and others (2006).

R = ρ + Δρ are the actual positions of the slides; points and joints have the shape (..., 3), [m].
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.errors import UnreachableError
from orthocal.estimation.linear import displacement_angle
from orthocal.units import MM


def constraint_residual(
    points: ArrayLike, joints: ArrayLike, *, length: float, offsets: ArrayLike = (0.0, 0.0, 0.0)
) -> Array:
    """Residual of equation (1): (p_i − R_i)² + Σ_{j≠i} p_j² − L², shape (..., 3), [m²]."""
    p = np.asarray(points, dtype=np.float64)
    slides = np.asarray(joints, dtype=np.float64) + np.asarray(offsets, dtype=np.float64)
    return np.asarray((p - slides) ** 2 + _others(p) - length**2)


def inverse(
    points: ArrayLike,
    *,
    length: float,
    offsets: ArrayLike = (0.0, 0.0, 0.0),
    configuration: Sequence[int] = (1, 1, 1),
) -> Array:
    """Equation (2): ρ_i = p_i + s_i √(L² − Σ_{j≠i} p_j²) − Δρ_i.

    The machine is built with signs s_i = 1. A point out of reach is an UnreachableError.
    """
    p = np.asarray(points, dtype=np.float64)
    signs = np.asarray(configuration)
    if signs.shape != (3,) or not np.all(np.isin(signs, (-1, 1))):
        raise UnreachableError(f"configuration is {configuration}; expected three signs, 1 or -1")
    radicand = length**2 - _others(p)
    if not np.all(radicand >= 0.0):
        bad = np.argwhere(~np.atleast_2d(radicand >= 0.0))[0]
        point = np.atleast_2d(p.reshape(-1, 3))[int(bad[0]) if p.ndim == 2 else 0]
        raise UnreachableError(
            f"point {np.round(point / MM, 3).tolist()} mm is out of reach of leg "
            f"{'xyz'[bad[-1]]} (length {length / MM:g} mm)"
        )
    return np.asarray(p + signs * np.sqrt(radicand) - np.asarray(offsets, dtype=np.float64))


def direct(
    joints: ArrayLike,
    *,
    length: float,
    offsets: ArrayLike = (0.0, 0.0, 0.0),
    root: int = -1,
) -> Array:
    """Equation (3): p_i = R_i/2 + t/R_i with t = (−b + m √(b² − 4 a c)) / (2 a).

    a = Σ_{i<j} R_i² R_j², where the paper prints a product, b = Π R_i² and
    c = (Σ R_i²/4 − L²) Π R_i², which the paper prints without its factor. The machine is built with
    m = −1. Legs that do not meet, and a slide at the origin, are an UnreachableError.
    """
    if root not in (-1, 1):
        raise UnreachableError(f"root is {root}; expected 1 or -1")
    slides = np.asarray(joints, dtype=np.float64) + np.asarray(offsets, dtype=np.float64)
    square = slides**2
    product = square.prod(axis=-1)
    a = (
        square[..., 0] * square[..., 1]
        + square[..., 1] * square[..., 2]
        + square[..., 2] * square[..., 0]
    )
    c = (square.sum(axis=-1) / 4.0 - length**2) * product
    discriminant = product**2 - 4.0 * a * c
    reachable = (discriminant >= 0.0) & np.all(square > 0.0, axis=-1)
    if not np.all(reachable):
        worst = np.atleast_2d(slides)[int(np.flatnonzero(~np.atleast_1d(reachable).ravel())[0])]
        raise UnreachableError(
            f"the legs do not meet with the slides at {np.round(worst / MM, 3).tolist()} mm "
            f"(length {length / MM:g} mm)"
        )
    t = (-product + root * np.sqrt(discriminant)) / (2.0 * a)
    return np.asarray(slides / 2.0 + t[..., None] / slides)


def inverse_jacobian(
    points: ArrayLike, joints: ArrayLike, *, offsets: ArrayLike = (0.0, 0.0, 0.0)
) -> Array:
    """Equation (4) with R instead of ρ (corrected), shape (..., 3, 3).

    J⁻¹_ij = ∂ρ_i/∂p_j = p_j / (p_i − R_i) for j ≠ i, 1 on the diagonal.
    """
    p = np.asarray(points, dtype=np.float64)
    slides = np.asarray(joints, dtype=np.float64) + np.asarray(offsets, dtype=np.float64)
    result = p[..., None, :] / (p - slides)[..., :, None]
    diagonal = np.arange(3)
    result[..., diagonal, diagonal] = 1.0
    return np.asarray(result)


def jacobian(
    points: ArrayLike, joints: ArrayLike, *, offsets: ArrayLike = (0.0, 0.0, 0.0)
) -> Array:
    """J = ∂p/∂ρ = ∂p/∂Δρ, the inverse of (4); a singular posture is an UnreachableError."""
    try:
        return np.asarray(np.linalg.inv(inverse_jacobian(points, joints, offsets=offsets)))
    except np.linalg.LinAlgError:
        raise UnreachableError("a posture is singular: the legs lie in one plane") from None


def displacement_jacobian(axis: int, displacement: float, *, length: float) -> Array:
    """Equation (5), ∂p/∂Δρ at a displacement along an axis; the paper calls it J⁻¹ (corrected).

    The column of the moving axis is 1 on the diagonal and T_α = tan α elsewhere.
    """
    result = np.eye(3)
    others = [i for i in range(3) if i != axis]
    result[others, axis] = np.tan(displacement_angle(displacement, length=length))
    return result


def _others(p: Array) -> Array:
    """Sums Σ_{j≠i} p_j², shape (..., 3)."""
    square = p**2
    return np.asarray(square.sum(axis=-1, keepdims=True) - square)
