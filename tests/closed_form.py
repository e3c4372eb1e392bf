"""Closed-form kinematics of the Orthoglide, vectorised over postures.

Equations (1) to (6) of Pashkevich, Chablat and Wenger (2006) check the closed-loop model; the
identification does not use them. R = ρ + Δρ are the actual positions of the slides. Docstrings
mark the formulas that are corrected here.
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
    """Residual of equation (1): squared leg lengths minus L².

        (p_i − R_i)² + Σ_{j≠i} p_j² − L²

    Args:
        points: Tool centre points, shape (..., 3), [m].
        joints: Commanded joint coordinates ρ, shape (..., 3), [m].
        length: Leg length L, [m].
        offsets: Joint offsets Δρ, shape (3,), [m].

    Returns:
        Shape (..., 3), [m²].
    """
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
    """Inverse kinematics, equation (2).

        ρ_i = p_i + s_i √(L² − Σ_{j≠i} p_j²) − Δρ_i

    Args:
        points: Tool centre points, shape (..., 3), [m].
        length: Leg length L, [m].
        offsets: Joint offsets Δρ, shape (3,), [m].
        configuration: Signs s_i, each 1 or −1; the machine is built with (1, 1, 1).

    Returns:
        Joint coordinates ρ, shape (..., 3), [m].

    Raises:
        UnreachableError: If a point is out of reach of a leg; names the first one.
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
    """Direct kinematics, equation (3).

        p_i = R_i/2 + t/R_i,  t = (−b + m √(b² − 4 a c)) / (2 a)
        a = Σ_{i<j} R_i² R_j²,  b = Π R_i²,  c = (Σ R_i²/4 − L²) Π R_i²

    a and c are corrected: the paper prints a product for a, and c without its factor. The machine
    is built with m = −1, which the paper does not state.

    Args:
        joints: Commanded joint coordinates ρ, shape (..., 3), [m].
        length: Leg length L, [m].
        offsets: Joint offsets Δρ, shape (3,), [m].
        root: m, 1 or −1.

    Returns:
        Tool centre points, shape (..., 3), [m].

    Raises:
        UnreachableError: If the legs do not meet, or a slide is at the origin.
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
    """Inverse Jacobian J⁻¹ = ∂ρ/∂p, equation (4), with R instead of ρ (corrected).

        J⁻¹_ij = p_j / (p_i − R_i) for j ≠ i, 1 on the diagonal

    Args:
        points: Tool centre points, shape (..., 3), [m].
        joints: Commanded joint coordinates ρ, shape (..., 3), [m].
        offsets: Joint offsets Δρ, shape (3,), [m].

    Returns:
        Shape (..., 3, 3).
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
    """Jacobian J = ∂p/∂ρ = ∂p/∂Δρ, the inverse of equation (4).

    Args:
        points: Tool centre points, shape (..., 3), [m].
        joints: Commanded joint coordinates ρ, shape (..., 3), [m].
        offsets: Joint offsets Δρ, shape (3,), [m].

    Returns:
        Shape (..., 3, 3).

    Raises:
        UnreachableError: If a posture is singular.
    """
    try:
        return np.asarray(np.linalg.inv(inverse_jacobian(points, joints, offsets=offsets)))
    except np.linalg.LinAlgError:
        raise UnreachableError("a posture is singular: the legs lie in one plane") from None


def displacement_jacobian(axis: int, displacement: float, *, length: float) -> Array:
    """Jacobian at a displacement along one axis, equation (5), for sensitivities, equation (6).

    Equation (5) is J, not J⁻¹ as the paper states (corrected). The column of the moving axis is 1
    on the diagonal and T_α = tan α elsewhere.

    Args:
        axis: 0, 1, 2 for a motion along x, y, z.
        displacement: Signed displacement of the tool from the mechanical zero, [m].
        length: Leg length L, [m].

    Returns:
        Shape (3, 3): ∂p/∂Δρ.
    """
    result = np.eye(3)
    others = [i for i in range(3) if i != axis]
    result[others, axis] = np.tan(displacement_angle(displacement, length=length))
    return result


def _others(p: Array) -> Array:
    """Sums Σ_{j≠i} p_j², shape (..., 3)."""
    square = p**2
    return np.asarray(square.sum(axis=-1, keepdims=True) - square)
