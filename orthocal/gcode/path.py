"""Curves of lines, arcs and helices, vectorised, and arcs from a centre or a radius.

Every motion is p(t) = base + slope t + r(t) (cos φ(t) e₁ + sin φ(t) e₂), with r and φ linear in t
from 0 to 1. A line has r = 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthocal.arrays import Array, Indices
from orthocal.errors import GcodeError

Vector = tuple[float, float, float]

PLANES: dict[int, tuple[int, int, int]] = {17: (0, 1, 2), 18: (2, 0, 1), 19: (1, 2, 0)}
"""Indices of the first and second axis of a plane and of its normal, by G17, G18 and G19.
Counterclockwise is from the first to the second axis."""

AXES = "XYZ"
CENTERS = "IJK"
"""Letters of an arc's centre, in the order of the axes."""

RADIUS_TOLERANCE = 5e-6
"""Allowed difference of an arc's radii at its ends, [m]: centres have three or four decimals."""

RELATIVE_RADIUS_TOLERANCE = 1e-3
"""Allowed difference of an arc's radii, relative to the radius."""

LARGEST_RADIUS_TOLERANCE = 127e-6
"""Upper limit of the relative tolerance, as in controllers, [m]."""

FULL_TURN = 1e-6
"""Angle between start and end below which an arc is a full circle, as for LinuxCNC, [rad]. Both
points may have been computed differently, such as in G91 and G90."""

SMALLEST_RADIUS = 1e-7
"""Smallest radius of an arc, [m]."""

ARC_POINTS = 64
"""Number of points of an arc at which a region is checked."""

BORDER = 1e-6
"""Distance beyond a region that counts as inside, [m]: coordinates have three decimals."""

RADIUS_SHORTFALL = 5e-6
"""Allowed shortfall of R compared with half the distance of the ends, [m], for a half circle."""


class Arc(NamedTuple):
    """Geometry of an arc or a helix."""

    plane: int
    """Number of the G-word, 17, 18 or 19."""
    centre: tuple[float, float]
    """Coordinates of the centre in the plane, [m]."""
    radii: tuple[float, float]
    """Radius at the start and at the end, [m]."""
    angle: float
    """Angle at the start, [rad]."""
    sweep: float
    """Angle of rotation, positive counterclockwise, [rad]."""


class Motion(NamedTuple):
    """Motion between two points, [m]; a line without an arc."""

    start: Vector
    end: Vector
    arc: Arc | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Paths:
    """Curves of n motions; symbols as in the equation of the module."""

    base: Array
    """Base points, shape (n, 3), [m]."""
    slope: Array
    """Slopes, shape (n, 3), [m]."""
    radius: Array
    """Radius at the start and its change, shape (n, 2), [m]."""
    angle: Array
    """Angle at the start and its change, shape (n, 2), [rad]."""
    axes: Indices
    """Indices of e₁ and e₂, shape (n, 2)."""

    @classmethod
    def from_motions(cls, motions: Sequence[Motion]) -> Paths:
        """Curves of a list of motions."""
        base = np.array([m.start for m in motions], dtype=np.float64).reshape(-1, 3)
        slope = np.array([m.end for m in motions], dtype=np.float64).reshape(-1, 3) - base
        radius, angle = np.zeros((len(base), 2)), np.zeros((len(base), 2))
        axes = np.zeros((len(base), 2), dtype=np.int64)
        for i, motion in enumerate(motions):
            if motion.arc is not None:
                arc, (first, second, _) = motion.arc, PLANES[motion.arc.plane]
                base[i, [first, second]] = arc.centre
                slope[i, [first, second]] = 0.0
                radius[i] = arc.radii[0], arc.radii[1] - arc.radii[0]
                angle[i] = arc.angle, arc.sweep
                axes[i] = first, second
        return cls(base, slope, radius, angle, axes)

    @property
    def lengths(self) -> Array:
        """Lengths of the curves, shape (n,), [m]."""
        mean_radius = self.radius[:, 0] + 0.5 * self.radius[:, 1]
        in_plane = np.hypot(mean_radius * self.angle[:, 1], self.radius[:, 1])
        return np.asarray(np.hypot(np.linalg.norm(self.slope, axis=1), in_plane))

    @property
    def largest_radii(self) -> Array:
        """Largest radius of each curve, 0 for lines, shape (n,), [m]."""
        return np.asarray(np.maximum(self.radius[:, 0], self.radius.sum(axis=1)))

    def leaves_region(self, region: Array) -> NDArray[np.bool_]:
        """Mask of the curves that end outside a box, or leave it on an arc, shape (n,).

        Args:
            region: Limits of x, y and z, shape (3, 2), [m].
        """
        parameters = np.linspace(0.0, 1.0, ARC_POINTS + 1)[1:]
        n = len(self.base)
        arcs = np.flatnonzero(self.angle[:, 1])
        curve = np.concatenate([np.arange(n), np.repeat(arcs, len(parameters))])
        points = self.points(curve, np.concatenate([np.ones(n), np.tile(parameters, len(arcs))]))
        outside = (points < region[:, 0] - BORDER) | (points > region[:, 1] + BORDER)
        return np.asarray(np.bincount(curve, weights=outside.any(axis=1), minlength=n) > 0.0)

    def parts(self, curve: Indices, first: Array, last: Array) -> Paths:
        """Parts of the curves.

        Args:
            curve: Index of the curve of each part, shape (k,).
            first: Parameter of the start of each part, 0 to 1, shape (k,).
            last: Parameter of the end of each part, shape (k,).
        """
        c, share = curve, (last - first)[:, None]
        begin = first[:, None]

        def part(line: Array) -> Array:
            """Value at the start of each part, and its change."""
            return np.hstack([line[c, :1] + begin * line[c, 1:], share * line[c, 1:]])

        return Paths(
            self.base[c] + begin * self.slope[c],
            share * self.slope[c],
            part(self.radius),
            part(self.angle),
            self.axes[c],
        )

    def points(self, curve: Indices, t: Array) -> Array:
        """Points on the curves, shape (k, 3), [m].

        Args:
            curve: Index of the curve of each point, shape (k,).
            t: Parameter of each point, 0 to 1, shape (k,).
        """
        points = self.base[curve] + t[:, None] * self.slope[curve]
        radius = self.radius[curve, 0] + t * self.radius[curve, 1]
        on_arc = np.flatnonzero(radius)
        if on_arc.size:
            arcs, r = curve[on_arc], radius[on_arc]
            angle = self.angle[arcs, 0] + t[on_arc] * self.angle[arcs, 1]
            points[on_arc, self.axes[arcs, 0]] += r * np.cos(angle)
            points[on_arc, self.axes[arcs, 1]] += r * np.sin(angle)
        return np.asarray(points)


def arc_about(
    start: Vector,
    end: Vector,
    centre: tuple[float, float],
    *,
    plane: int,
    clockwise: bool,
    turns: int,
) -> Arc:
    """Arc around a centre.

    Args:
        start: First point, [m].
        end: Last point, [m].
        centre: Coordinates of the centre in the plane, [m].
        plane: Number of the G-word, 17, 18 or 19.
        clockwise: Whether the arc is clockwise (G2), seen from the positive end of the normal.
        turns: Number of times that the arc reaches its end.

    Raises:
        GcodeError: If the radii at the ends differ, or the centre is at an end.
    """
    i, j, _ = PLANES[plane]
    first = (start[i] - centre[0], start[j] - centre[1])
    last = (end[i] - centre[0], end[j] - centre[1])
    r0, r1 = math.hypot(*first), math.hypot(*last)
    if min(r0, r1) < SMALLEST_RADIUS:
        raise GcodeError("the centre of an arc is at one of its ends")
    tolerance = max(RADIUS_TOLERANCE, min(RELATIVE_RADIUS_TOLERANCE * r0, LARGEST_RADIUS_TOLERANCE))
    if abs(r0 - r1) > tolerance:
        raise GcodeError(
            f"an arc has a radius of {r0 * 1e3:.6g} mm at its start and {r1 * 1e3:.6g} mm at its "
            "end; expected equal radii"
        )
    angle = math.atan2(first[1], first[0])
    sweep = math.atan2(last[1], last[0]) - angle
    sweep %= 2.0 * math.pi
    if min(sweep, 2.0 * math.pi - sweep) < FULL_TURN:
        sweep = 0.0
    if clockwise:
        sweep -= 2.0 * math.pi
    elif sweep == 0.0:
        sweep = 2.0 * math.pi
    sweep += math.copysign(2.0 * math.pi * (turns - 1), sweep)
    return Arc(plane, centre, (r0, r1), angle, sweep)


def centre_of_radius(
    start: Vector, end: Vector, radius: float, *, plane: int, clockwise: bool
) -> tuple[float, float]:
    """Centre of an arc with a radius R, in the plane, [m].

    Args:
        start: First point, [m].
        end: Last point, [m].
        radius: R, [m]; a negative R selects the arc of more than 180°.
        plane: Number of the G-word, 17, 18 or 19.
        clockwise: Whether the arc is clockwise (G2).

    Raises:
        GcodeError: If there is no such arc, or the ends are equal.
    """
    i, j, _ = PLANES[plane]
    chord = (end[i] - start[i], end[j] - start[j])
    distance = math.hypot(*chord)
    if distance < SMALLEST_RADIUS:
        raise GcodeError(
            f"found R with both ends at the same {AXES[i]} and {AXES[j]}, which determines no "
            f"centre; expected {CENTERS[i]} and {CENTERS[j]}"
        )
    half = 0.5 * distance
    if abs(radius) < half - RADIUS_SHORTFALL:
        raise GcodeError(
            f"R is {abs(radius) * 1e3:.6g} mm, less than half the distance of the arc's ends, "
            f"{half * 1e3:.6g} mm"
        )
    height = math.sqrt(max(radius * radius - half * half, 0.0))
    if clockwise != (radius < 0.0):
        height = -height
    middle = (0.5 * (start[i] + end[i]), 0.5 * (start[j] + end[j]))
    return (
        middle[0] - height * chord[1] / distance,
        middle[1] + height * chord[0] / distance,
    )
