"""An Orthoglide under load by minimisation of its energy, in NumPy and SciPy alone.

Legs are chains of rotations with rods of any length: six springs, and a weight at the tool.
"""

from __future__ import annotations

import numpy as np
from derivatives import central_differences
from scipy.optimize import minimize

LENGTH, HALF_BAR, ARM = 0.31025, 0.04, 0.04
"""Of a rod, of the distance of two rods, and from a crossbar to the tool, [m]."""

AXES = [
    np.column_stack([x, np.cross(z, x), z])
    for x, z in zip(-np.eye(3), np.eye(3)[[2, 0, 1]], strict=True)
]
"""Frame of each leg: X from slide to tool, Z along e_z, e_x, e_y."""


def about_y(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def about_z(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def follow(axes, slide, angles, lengths):
    """End of a leg: position and rotation of the platform, and the opening of its parallelogram."""
    swivel, bar_a, bar_b, crossbar, wrist, fork = angles
    yoke = axes @ about_z(swivel)
    root = -slide * axes[:, 0] - ARM * axes[:, 0]
    (tip_a, tip_b) = (
        root + yoke @ (sign * HALF_BAR * np.eye(3)[2] + length * about_y(angle)[:, 0])
        for sign, angle, length in zip((1, -1), (bar_a, bar_b), lengths, strict=True)
    )
    bar = yoke @ about_y(crossbar)
    opening = yoke.T @ (tip_a - tip_b - 2.0 * HALF_BAR * bar[:, 2])
    foot = bar @ about_z(wrist) @ about_y(fork)
    tool = tip_a - HALF_BAR * bar[:, 2] + ARM * foot[:, 0]
    return tool, foot @ axes.T, opening[[0, 2]]


def close(drives, lengths, start):
    """All 18 angles, and the tool, of rods of given lengths, shape (6,)."""

    def open_by(angles):
        ends = [
            follow(AXES[k], drives[k], angles[6 * k : 6 * k + 6], lengths[2 * k : 2 * k + 2])
            for k in range(3)
        ]
        rows = [opening for *_, opening in ends]
        for tool, turned, _ in ends[1:]:
            relative = turned.T @ ends[0][1]
            rows += [tool - ends[0][0], (relative - relative.T)[[2, 0, 1], [1, 2, 0]]]
        return np.concatenate(rows)

    angles, opening = start, open_by(start)
    for step in range(15):
        if np.abs(opening).max() < 1e-14:
            break
        if step % 3 == 0:  # a Jacobian takes 36 evaluations, and changes little
            jacobian = central_differences(open_by, angles, step=1e-5)
        angles = angles - np.linalg.solve(jacobian, opening)
        opening = open_by(angles)
    assert np.abs(opening).max() < 1e-14
    return angles, follow(AXES[0], drives[0], angles[:6], lengths[:2])[0]


def settle(drives, *, stiffness, weight):
    """Where the tool comes to rest, shape (3,), and the changes of the rods' lengths, [m, N]."""
    nominal = np.full(6, LENGTH)
    start, at_rest = close(drives, nominal, np.zeros(18))
    unit = np.linalg.norm(weight) / stiffness

    def energy(changes):
        _, tool = close(drives, nominal + unit * changes, start)
        return 0.5 * changes @ changes - (weight @ (tool - at_rest)) / (stiffness * unit**2)

    def slope(changes):
        return central_differences(energy, changes, step=1e-2)

    changes = unit * minimize(energy, np.zeros(6), jac=slope, tol=1e-6).x
    return close(drives, nominal + changes, start)[1], changes
