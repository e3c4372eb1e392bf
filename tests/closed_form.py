"""Closed-form kinematics of the Orthoglide: equations (2) and (3) of Pashkevich and others (2006).

R = ρ + Δρ are the actual positions of the slides; points and joints have the shape (..., 3), [m].
"""

from __future__ import annotations

import numpy as np


def inverse(points, *, length, offsets=0.0, configuration=(1, 1, 1)):
    """Equation (2): ρ_i = p_i + s_i √(L² − Σ_{j≠i} p_j²) − Δρ_i; the machine has signs s_i = 1."""
    p = np.asarray(points, dtype=float)
    others = (p**2).sum(axis=-1, keepdims=True) - p**2
    return p + configuration * np.sqrt(length**2 - others) - offsets


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
