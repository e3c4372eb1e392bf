"""Closed form of a robot's nominal inverse kinematics, identified from points of its model.

A slide along a unit vector u holds the tool by a rod or a parallelogram of length L. Its coordinate
is

    r = u · d + s √(L² − |d|² + (u · d)²),  d = p − a,  s = ±1,

where a is the tool position at which rod and slide coordinate are zero. The Orthoglide (u an axis
and a = 0, equation 2), linear deltas and biglides have this form. Squared, it is linear in the
unknowns,

    2 a · p + 2 r (u · p) − 2 m r + k = |p|² + r²,  m = u · a, k = L² − |a|².

So a few points of the model identify them. For any other robot the nominal form is the tangent at
the middle of the region.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import ClosureError
from orthocal.io.fields import read_only
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.robot.model import Robot

TOLERANCE = 1e-9
"""Largest difference of the closed form from the model, [m]."""

DECIMALS = 12
"""Decimals of the identified numbers; further decimals are rounding errors."""

POINTS = 60
"""Number of points for the identification."""

TANGENT_STEP = 1e-3
"""Step of the finite differences, relative to half the side of the region."""


@dataclass(frozen=True, slots=True, eq=False)
class SlidesWithRods:
    """Inverse kinematics of slides that hold the tool by rods."""

    axes: Array
    """Unit vectors u of the slides, shape (n, n)."""
    anchors: Array
    """Tool positions a, shape (n, n), [m]."""
    lengths: Array
    """Lengths L of the rods, shape (n,), [m]."""
    signs: Array
    """Signs s of the roots, shape (n,)."""

    def __call__(self, points: Array) -> Array:
        """Drive coordinates, shape (k, n), [m]; NaN out of reach."""
        d = points[:, None, :] - self.anchors
        along = np.einsum("kij,ij->ki", d, self.axes)
        across = d - along[..., None] * self.axes
        with np.errstate(invalid="ignore"):
            root = self.signs * np.sqrt(self.lengths**2 - (across**2).sum(axis=-1))
        return np.asarray(along + root)


@dataclass(frozen=True, slots=True, eq=False)
class Tangent:
    """Inverse kinematics linearised at the middle of a region."""

    middle: Array
    """Middle of the region, shape (n,), [m]."""
    values: Array
    """Drive coordinates at the middle, shape (n,), [m, rad]."""
    jacobian: Array
    """Jacobian of the drive coordinates, shape (n, n), [1 or rad/m]."""

    def __call__(self, points: Array) -> Array:
        """Drive coordinates, shape (k, n), [m, rad]."""
        return np.asarray(self.values + (points - self.middle) @ self.jacobian.T)


NominalForm = SlidesWithRods | Tangent


def find_nominal_form(robot: Robot, middle: Array, half: Array) -> NominalForm:
    """Closed form of a robot's nominal inverse kinematics, or its tangent.

    Args:
        robot: Robot whose drives command the tool.
        middle: Middle of the region, shape (n,), [m].
        half: Half the sides of the region, shape (n,), [m].
    """
    n = middle.size
    points = middle + half * np.random.default_rng(0).uniform(-1.0, 1.0, (POINTS, n))
    inverse = nominal_closure(robot).inverse
    try:
        drives = inverse(points)
    except ClosureError:  # the region of the calibrated machine may be out of nominal reach
        drives = None
    if drives is not None and all(d.unit == "m" for d in robot.drives):
        slides = _identify_slides(points, drives)
        if slides is not None:
            return slides
    step = TANGENT_STEP * half
    around = middle + np.concatenate([np.zeros((1, n)), np.diag(step), -np.diag(step)])
    values = inverse(around)
    columns = (values[1 : 1 + n] - values[1 + n :]) / (2.0 * step[:, None])
    return Tangent(read_only(middle), read_only(values[0]), read_only(columns.T))


def _identify_slides(points: Array, drives: Array) -> SlidesWithRods | None:
    """Closed form of slides with rods that fits points of the model; None if none does."""
    n = points.shape[1]
    slides_of_drives = []
    for r in drives.T:
        columns = [2.0 * points, 2.0 * r[:, None] * points, -2.0 * r[:, None], np.ones((len(r), 1))]
        rows, right = np.concatenate(columns, axis=1), (points**2).sum(axis=1) + r**2
        scale = np.abs(rows).max(axis=0)
        x = np.linalg.lstsq(rows / scale, right, rcond=None)[0] / scale
        anchor, axis, square = x[:n], x[n : 2 * n], x[-1] + float(x[:n] @ x[:n])
        if abs(np.linalg.norm(axis) - 1.0) > TOLERANCE or square <= 0.0:
            return None
        sign = np.sign(r - (points - anchor) @ axis)
        slides_of_drives.append((axis, anchor, np.sqrt(square), sign[0]))
    axes, anchors, lengths, signs = (
        read_only(np.round(np.array(values), DECIMALS) + 0.0)
        for values in zip(*slides_of_drives, strict=True)
    )
    slides = SlidesWithRods(axes, anchors, lengths, signs)
    return slides if np.abs(slides(points) - drives).max() < TOLERANCE else None
