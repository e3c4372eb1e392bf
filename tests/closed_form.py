"""Closed-form kinematics of the Orthoglide: equations (1) to (6) of Pashkevich and others (2006).

R = ρ + Δρ are the actual positions of the slides; points and joints have the shape (..., 3), [m].
"""

from __future__ import annotations

import numpy as np

from orthocal.estimation.linear import displacement_angle


def constraint_residual(points, joints, *, length, offsets=0.0):
    """Residual of equation (1): (p_i − R_i)² + Σ_{j≠i} p_j² − L², shape (..., 3), [m²]."""
    p = np.asarray(points)
    return (p - joints - np.asarray(offsets)) ** 2 + _others(p) - length**2


def inverse(points, *, length, offsets=0.0, configuration=(1, 1, 1)):
    """Equation (2): ρ_i = p_i + s_i √(L² − Σ_{j≠i} p_j²) − Δρ_i; the machine has signs s_i = 1."""
    p = np.asarray(points, dtype=float)
    return p + configuration * np.sqrt(length**2 - _others(p)) - offsets


def direct(joints, *, length, offsets=0.0, root=-1):
    """Equation (3): p_i = R_i/2 + t/R_i with t = (−b + m √(b² − 4 a c)) / (2 a).

    a = Σ_{i<j} R_i² R_j², where the paper prints a product, b = Π R_i² and
    c = (Σ R_i²/4 − L²) Π R_i², which the paper prints without its factor. The machine has m = −1.
    """
    slides = np.asarray(joints) + offsets
    square = slides**2
    b = square.prod(axis=-1)
    a = (square * np.roll(square, 1, axis=-1)).sum(axis=-1)
    c = (square.sum(axis=-1) / 4.0 - length**2) * b
    t = (-b + root * np.sqrt(b**2 - 4.0 * a * c)) / (2.0 * a)
    return slides / 2.0 + t[..., None] / slides


def inverse_jacobian(points, joints, *, offsets=0.0):
    """Equation (4) with R instead of ρ (corrected), shape (..., 3, 3).

    J⁻¹_ij = ∂ρ_i/∂p_j = p_j / (p_i − R_i) for j ≠ i, 1 on the diagonal.
    """
    p = np.asarray(points)
    result = p[..., None, :] / (p - joints - offsets)[..., :, None]
    result[..., range(3), range(3)] = 1.0
    return result


def jacobian(points, joints, *, offsets=0.0):
    """J = ∂p/∂ρ = ∂p/∂Δρ, the inverse of equation (4)."""
    return np.linalg.inv(inverse_jacobian(points, joints, offsets=offsets))


def displacement_jacobian(axis, displacement, *, length):
    """Equation (5), ∂p/∂Δρ at a displacement along an axis; the paper calls it J⁻¹ (corrected).

    The column of the moving axis is 1 on the diagonal and T_α = tan α elsewhere.
    """
    result = np.eye(3)
    result[np.arange(3) != axis, axis] = np.tan(displacement_angle(displacement, length=length))
    return result


def _others(p):
    """Sums Σ_{j≠i} p_j², shape (..., 3)."""
    return (p**2).sum(axis=-1, keepdims=True) - p**2
