"""Exponential of SE(3) and its Jacobian, for NumPy arrays and CasADi expressions.

The logarithm and its Jacobian exist for expressions only.

A twist is (translation v, rotation ω), as in Pinocchio. All coefficients belong to one family,

    α_n(θ²) = Σ_k (−θ²)^k/(n + 2k)!,  α_1 = sin θ/θ,  α_2 = (1 − cos θ)/θ²,  θ = |ω|,

whose series near 0 makes every function differentiable there. Arrays may have any leading
batch dimensions. Sources: Chirikjian, Stochastic Models, Information Theory, and Lie Groups,
volume 2, 2012, section 10.8; Barfoot, State Estimation for Robotics, 2017, section 7.1.5.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple, TypeAlias, overload

import casadi as ca
import numpy as np

from orthocal.arrays import Array

Operand: TypeAlias = Any
"""A NumPy array or a CasADi expression."""

SERIES_BELOW = 0.25
"""Squared angle below which coefficients come from their series, [rad²]."""

SERIES_TERMS = 9
"""Terms of a series: the first omitted one is below 1e-21 at SERIES_BELOW."""

_INVERSE_FACTORIALS = tuple(1.0 / math.factorial(n) for n in range(5 + 2 * SERIES_TERMS))
"""1/n!, for the series of five coefficients."""

LOGARITHM_SERIES_ABOVE = 0.995
"""Cosine above which the coefficients of the logarithm come from their series, whose relative error
is below 1e-15 there."""

_ARCSINE = (1.0, 1 / 6, 3 / 40, 15 / 336, 105 / 3456, 945 / 42240, 10395 / 599040)
"""Coefficients of the series of θ/sin θ in sin² θ."""

_BERNOULLI = (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160)
"""Coefficients of the series of β = 1/θ² − (1 + cos θ)/(2 θ sin θ) in θ²."""

_BERNOULLI_SLOPE = tuple(2.0 * k * c for k, c in enumerate(_BERNOULLI))[1:]
"""Coefficients of the series of (dβ/dθ)/θ in θ²."""


class _Operations(NamedTuple):
    """Library of a type, and its operations with other names; vectors are columns."""

    library: ModuleType
    where: Callable[[Any, Any, Any], Any]
    skew: Callable[[Any], Any]


@overload
def exp6(twist: Array) -> tuple[Array, Array]: ...
@overload
def exp6(twist: ca.SX) -> tuple[ca.SX, ca.SX]: ...
def exp6(twist: Operand) -> tuple[Operand, Operand]:
    """Exponential of a twist.

        R = I + α₁ [ω] + α₂ [ω]²,  p = v + α₂ ω × v + α₃ ω × (ω × v)

    Args:
        twist: Shape (..., 6), [m, rad]; an expression of shape (6,).

    Returns:
        Rotation, shape (..., 3, 3), and position, shape (..., 3), [m].
    """
    m, v, w, square = _split(twist)
    if m is _CASADI and w.is_zero():
        return ca.SX.eye(3), v
    a, b, c = _coefficients(m, square, 3)
    hat = m.skew(w)
    cross = hat @ v
    rotation = np.eye(3) + a * hat + b * (hat @ hat)
    position = v + b * cross + c * (hat @ cross)
    return (rotation, position) if m is _CASADI else (rotation, position[..., 0])


def log6(rotation: ca.SX, position: ca.SX) -> ca.SX:
    """Logarithm of a pose, for rotation angles below π.

        ω = (θ/sin θ) ½ vee(R − Rᵀ)
        v = p − ½ ω × p + (1/θ² − (1 + cos θ)/(2 θ sin θ)) ω × (ω × p)

    Args:
        rotation: Shape (3, 3).
        position: Shape (3,), [m].

    Returns:
        Twist, shape (6,), [m, rad].
    """
    w, beta, _ = _rotation_log(rotation)
    hat = ca.skew(w)
    cross = hat @ position
    return ca.vertcat(position - 0.5 * cross + beta * (hat @ cross), w)


def _rotation_log(rotation: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Logarithm ω of a rotation, β = 1/θ² − (1 + cos θ)/(2 θ sin θ), and (dβ/dθ)/θ."""
    half = 0.5 * ca.inv_skew(rotation - rotation.T)
    cosine = 0.5 * (ca.trace(rotation) - 1.0)
    sine2 = half.T @ half
    near = cosine > LOGARITHM_SERIES_ABOVE
    sine = ca.sqrt(ca.if_else(near, 1.0, sine2))
    safe_cosine = ca.if_else(near, 0.0, cosine)
    angle = ca.atan2(sine, safe_cosine)
    w = ca.if_else(near, _polynomial(sine2, _ARCSINE), angle / sine) * half
    square, angle2 = w.T @ w, angle**2
    far = 1.0 / angle2 - (1.0 + safe_cosine) / (2.0 * angle * sine)
    beta = ca.if_else(near, _polynomial(square, _BERNOULLI), far)
    far_slope = (0.5 * (1.0 + sine / angle) / (1.0 - safe_cosine) - 2.0 / angle2) / angle2
    return w, beta, ca.if_else(near, _polynomial(square, _BERNOULLI_SLOPE), far_slope)


@overload
def right_jacobian(twist: Array) -> Array: ...
@overload
def right_jacobian(twist: ca.SX) -> ca.SX: ...
def right_jacobian(twist: Operand) -> Operand:
    """Right Jacobian T of the exponential: exp6(ξ + dξ) = exp6(ξ) exp6(T dξ) to first order.

        T = [[A, Q], [0, A]],  A = I − α₂ W + α₃ W²,  W = [ω],  V = [v]
        Q = −½ V + α₃ (W V + V W − W V W) − α₄ (W² V + V W² − 3 W V W)
            + ½ (α₄ − 3 α₅) (W V W² + W² V W)

    Args:
        twist: ξ, shape (..., 6), [m, rad]; an expression of shape (6,).

    Returns:
        Shape (..., 6, 6).
    """
    m, v, w, square = _split(twist)
    _, a2, a3, a4, a5 = _coefficients(m, square, 5)
    hat_v, hat_w = m.skew(v), m.skew(w)
    wv, vw, ww = hat_w @ hat_v, hat_v @ hat_w, hat_w @ hat_w
    wvw = wv @ hat_w
    rotation = np.eye(3) - a2 * hat_w + a3 * ww
    coupling = (
        -0.5 * hat_v
        + a3 * (wv + vw - wvw)
        - a4 * (hat_w @ wv + vw @ hat_w - 3.0 * wvw)
        + 0.5 * (a4 - 3.0 * a5) * (wvw @ hat_w + hat_w @ wvw)
    )
    if m is _CASADI:
        return ca.blockcat([[rotation, coupling], [ca.SX(3, 3), rotation]])
    result = np.zeros((*twist.shape, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = rotation
    result[..., :3, 3:] = coupling
    return result


def log6_jacobian(rotation: ca.SX, position: ca.SX) -> ca.SX:
    """Derivative of log6(M exp6(ξ)) with respect to ξ at 0: the inverse of the right Jacobian.

        T⁻¹ = [[A, C A], [0, A]],  A = I + ½ W + β W²,  W = [ω]
        C = (δ (ω·p) ω − (θ² δ + 2 β) p) ωᵀ + β (ω pᵀ + (ω·p) I) + ½ [p],  δ = (dβ/dθ)/θ

    This is Jlog6 of Pinocchio.

    Args:
        rotation: Shape (3, 3), a rotation.
        position: p, shape (3,), [m].

    Returns:
        Shape (6, 6).
    """
    w, beta, slope = _rotation_log(rotation)
    hat, along = ca.skew(w), w.T @ position
    inverse = ca.SX.eye(3) + 0.5 * hat + beta * (hat @ hat)
    column = slope * along * w - (slope * (w.T @ w) + 2.0 * beta) * position
    coupling = column @ w.T + beta * (w @ position.T + along * ca.SX.eye(3))
    coupling += 0.5 * ca.skew(position)
    return ca.blockcat([[inverse, coupling @ inverse], [ca.SX(3, 3), inverse]])


def skew(vectors: Array) -> Array:
    """Cross-product matrices [v], shape (..., 3, 3), of vectors v, shape (..., 3)."""
    result = np.zeros((*vectors.shape, 3))
    x, y, z = (vectors[..., i] for i in range(3))
    result[..., 0, 1], result[..., 0, 2] = -z, y
    result[..., 1, 0], result[..., 1, 2] = z, -x
    result[..., 2, 0], result[..., 2, 1] = -y, x
    return result


def _coefficients(m: _Operations, square: Operand, count: int) -> list[Operand]:
    """Coefficients α_1 to α_count of a squared angle, [rad²]."""
    near = square < SERIES_BELOW
    safe = m.where(near, 1.0, square)
    angle = m.library.sqrt(safe)
    sine, cosine = m.library.sin(angle), m.library.cos(angle)
    far = (
        sine / angle,
        (1.0 - cosine) / safe,
        (angle - sine) / (safe * angle),
        (0.5 * safe - 1.0 + cosine) / (safe * safe),
        (safe * angle / 6.0 - angle + sine) / (safe * safe * angle),
    )
    return [m.where(near, _series(square, n), far[n - 1]) for n in range(1, count + 1)]


def _series(square: Operand, first: int) -> Operand:
    """Series Σ (−θ²)^k/(first + 2k)! of a squared angle θ²."""
    return _polynomial(-square, _INVERSE_FACTORIALS[first : first + 2 * SERIES_TERMS : 2])


def _polynomial(x: Operand, coefficients: tuple[float, ...]) -> Operand:
    """Polynomial Σ c_k x^k by Horner's rule."""
    total = 0.0 * x  # 0 of the type and shape of x
    for coefficient in reversed(coefficients):
        total = total * x + coefficient
    return total


def _split(twist: Operand) -> tuple[_Operations, Operand, Operand, Operand]:
    """Operations for the type of a twist, its translation v and rotation ω as columns, and ωᵀω."""
    if isinstance(twist, ca.SX):
        return _CASADI, twist[:3], twist[3:], twist[3:].T @ twist[3:]
    columns = np.asarray(twist, dtype=np.float64)[..., None]
    w = columns[..., 3:, :]
    return _NUMPY, columns[..., :3, :], w, np.swapaxes(w, -1, -2) @ w


_NUMPY = _Operations(np, np.where, lambda column: skew(column[..., 0]))
_CASADI = _Operations(ca, ca.if_else, ca.skew)
