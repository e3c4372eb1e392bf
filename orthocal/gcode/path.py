"""Motions as curves: lines, arcs and helices, many at once.

Every motion is p(t) = base + slope t + r(t) (cos φ(t) e₁ + sin φ(t) e₂), with r and φ linear in t
from 0 to 1; a line has no radius.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Vector = tuple[float, float, float]

PLANES: dict[int, tuple[int, int, int]] = {17: (0, 1, 2), 18: (2, 0, 1), 19: (1, 2, 0)}
"""G17, G18, G19: indices of the plane's axes, from the first to the second of which a turn is
counterclockwise, and of the one square to them."""


class Arc(NamedTuple):
    """What makes an arc or a helix of a motion."""

    plane: int
    """17, 18 or 19."""
    center: tuple[float, float]
    """In the axes of the plane, [m]."""
    radii: tuple[float, float]
    """At its start and at its end, [m]."""
    angle: float
    """Where it starts, [rad]."""
    sweep: float
    """By how much it turns, counterclockwise above 0, [rad]."""


class Motion(NamedTuple):
    """A motion between two points, [m]."""

    start: Vector
    end: Vector
    arc: Arc | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Paths:
    """Many motions."""

    base: Array
    """Shape (n, 3), [m]."""
    slope: Array
    """Shape (n, 3), [m]."""
    radius: Array
    """r at 0 and its change, shape (n, 2), [m]."""
    angle: Array
    """φ at 0 and its change, shape (n, 2), [rad]."""
    axes: Indices
    """e₁ and e₂, shape (n, 2)."""

    @classmethod
    def of(cls, motions: Sequence[Motion]) -> Paths:
        """Those of a list."""
        base = np.array([m.start for m in motions], dtype=np.float64).reshape(-1, 3)
        slope = np.array([m.end for m in motions], dtype=np.float64).reshape(-1, 3) - base
        radius, angle = np.zeros((len(base), 2)), np.zeros((len(base), 2))
        axes = np.zeros((len(base), 2), dtype=np.int64)
        for i, motion in enumerate(motions):
            if motion.arc is not None:
                arc, (first, second, _) = motion.arc, PLANES[motion.arc.plane]
                base[i, [first, second]] = arc.center
                slope[i, [first, second]] = 0.0
                radius[i] = arc.radii[0], arc.radii[1] - arc.radii[0]
                angle[i] = arc.angle, arc.sweep
                axes[i] = first, second
        return cls(base, slope, radius, angle, axes)

    @property
    def lengths(self) -> Array:
        """Shape (n,), [m]."""
        middle = self.radius[:, 0] + 0.5 * self.radius[:, 1]
        turned = np.hypot(middle * self.angle[:, 1], self.radius[:, 1])
        return np.asarray(np.hypot(np.linalg.norm(self.slope, axis=1), turned))

    @property
    def largest_radii(self) -> Array:
        """Shape (n,), 0 for lines, [m]."""
        return np.asarray(np.maximum(self.radius[:, 0], self.radius.sum(axis=1)))

    def points(self, of: Indices, t: Array) -> Array:
        """Points of motions, shape (k, 3), [m].

        Args:
            of: Which motion, shape (k,).
            t: Where on it, 0 to 1, shape (k,).
        """
        found = self.base[of] + t[:, None] * self.slope[of]
        radius = self.radius[of, 0] + t * self.radius[of, 1]
        at = np.flatnonzero(radius)
        if at.size:
            own, r = of[at], radius[at]
            angle = self.angle[own, 0] + t[at] * self.angle[own, 1]
            found[at, self.axes[own, 0]] += r * np.cos(angle)
            found[at, self.axes[own, 1]] += r * np.sin(angle)
        return np.asarray(found)
