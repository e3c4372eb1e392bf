"""The nominal inverse kinematics in closed form, where the robot has one: found by its numbers.

A slide along a unit vector u that holds the tool by a rod, or a parallelogram, of length L moves

    r = u · d + s √(L² − |d|² + (u · d)²),  d = p − a,  s = ±1,

with a the tool's place where rod and slide are at their zero. The Orthoglide, where u is an axis
and a is 0 (equation 2), linear deltas and biglides are such. Squared, this is linear in what is
unknown,

    2 a · p + 2 r (u · p) − 2 m r + k = |p|² + r²,  m = u · a, k = L² − |a|²,

so few points of the model tell whether a drive is such a slide. Where one is not, the nominal form
is the tangent in the middle of the region.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import ClosureError
from orthocal.io.fields import read_only
from orthocal.kinematics.loop_closure import nominal_assembly
from orthocal.robot.model import Robot

Array = NDArray[np.float64]

SAME = 1e-9
"""By which a closed form may differ from the model, [m]."""

ROUNDED = 12
"""Decimals of what is found: those after are rounding."""

POINTS = 60

TANGENT_STEP = 1e-3
"""Of the differences that make the tangent, in half sides of the region."""


@dataclass(frozen=True, slots=True, eq=False)
class SlidesWithRods:
    """Every drive a slide that holds the tool by a rod."""

    axes: Array
    """u, unit vectors, shape (n, n)."""
    anchors: Array
    """a, shape (n, n), [m]."""
    lengths: Array
    """L, shape (n,), [m]."""
    signs: Array
    """s, shape (n,)."""

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Drive coordinates, (K, n), [m], and their slopes by the tool, (K, n, n).

        NaN where a rod does not reach.
        """
        d = points[:, None, :] - self.anchors
        along = np.einsum("kij,ij->ki", d, self.axes)
        across = d - along[..., None] * self.axes
        with np.errstate(invalid="ignore"):
            root = self.signs * np.sqrt(self.lengths**2 - (across**2).sum(axis=-1))
        return along + root, self.axes - across / root[..., None]


@dataclass(frozen=True, slots=True, eq=False)
class Tangent:
    """What the drives do in the middle of a region, and everywhere by its slopes."""

    middle: Array
    """Shape (n,), [m]."""
    values: Array
    """Drive coordinates there, shape (n,), [m, rad]."""
    slopes: Array
    """Shape (n, n), [1 or rad/m]."""

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Drive coordinates, (K, n), [m, rad], and their slopes by the tool, (K, n, n)."""
        values = self.values + (points - self.middle) @ self.slopes.T
        return values, np.broadcast_to(self.slopes, (len(points), *self.slopes.shape))


NominalForm = SlidesWithRods | Tangent


def find_nominal_form(robot: Robot, middle: Array, half: Array) -> NominalForm:
    """Closed form of a robot's nominal inverse kinematics, or its tangent.

    Args:
        robot: With as many drives as coordinates of the tool that they control.
        middle: Of the region, shape (n,), [m].
        half: Half its sides, shape (n,), [m].
    """
    n = middle.size
    points = middle + half * np.random.default_rng(0).uniform(-1.0, 1.0, (POINTS, n))
    inverse = nominal_assembly(robot).inverse
    try:
        drives = inverse(points)
    except ClosureError:  # a nominal machine need not reach all that the calibrated one does
        drives = None
    if drives is not None and all(d.unit == "m" for d in robot.drives):
        found = _as_slides(points, drives)
        if found is not None:
            return found
    step = TANGENT_STEP * half
    around = middle + np.concatenate([np.zeros((1, n)), np.diag(step), -np.diag(step)])
    values = inverse(around)
    slopes = (values[1 : 1 + n] - values[1 + n :]) / (2.0 * step[:, None])
    return Tangent(read_only(middle), read_only(values[0]), read_only(slopes.T))


def _as_slides(points: Array, drives: Array) -> SlidesWithRods | None:
    """The closed form of which these are points; None if they are not."""
    n = points.shape[1]
    parts = []
    for r in drives.T:
        columns = [2.0 * points, 2.0 * r[:, None] * points, -2.0 * r[:, None], np.ones((len(r), 1))]
        rows, right = np.concatenate(columns, axis=1), (points**2).sum(axis=1) + r**2
        scale = np.abs(rows).max(axis=0)
        x = np.linalg.lstsq(rows / scale, right, rcond=None)[0] / scale
        anchor, axis, square = x[:n], x[n : 2 * n], x[-1] + float(x[:n] @ x[:n])
        if abs(np.linalg.norm(axis) - 1.0) > SAME or square <= 0.0:
            return None
        sign = np.sign(r - (points - anchor) @ axis)
        parts.append((axis, anchor, np.sqrt(square), sign[0]))
    axes, anchors, lengths, signs = (
        read_only(np.round(np.array(p), ROUNDED) + 0.0) for p in zip(*parts, strict=True)
    )
    found = SlidesWithRods(axes, anchors, lengths, signs)
    off = np.abs(found(points)[0] - drives).max()
    return found if off < SAME else None
