"""Segmentation of motions into chords that stay near the corrected path.

The deviation of a chord is evaluated at a quarter, a half and three quarters of its length.
Segments are so short that the curvature of a correction hardly changes within one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, Protocol

import numpy as np

from orthocal.arrays import Array, Indices, Mask
from orthocal.gcode.path import Paths
from orthocal.gcode.reversals import Sides, split_at_reversals

LONGEST_SEGMENT = 10e-3
"""Largest length of a segment, [m]."""

LARGEST_ANGLE = math.pi / 4.0
"""Largest angle of a segment of an arc, [rad]."""

MOST_SEGMENTS = 50_000
"""Largest number of segments of one motion."""

POINTS_PER_BLOCK = 40_000
"""Number of points that are corrected together."""

EVALUATED_SHARE = 0.97
"""Limit of the evaluated deviations, relative to the tolerance; between the evaluated points
deviations may be slightly larger."""

FRACTIONS = np.array([0.25, 0.5, 0.75])
"""Positions on a chord at which its deviation is evaluated."""


class Correction(Protocol):
    """Correction of points for a controller."""

    @property
    def bound(self) -> float:
        """Largest error of a corrected point, [m]."""

    def __call__(self, points: Array) -> tuple[Array, Mapping[int, str]]:
        """Correct points.

        Args:
            points: Desired tool positions, shape (k, 3), [m].

        Returns:
            Points to command, shape (k, 3), [m], and reasons by the index of refused points. The
            first of them is out of reach; later points may be refused without a check.
        """


AT_BORDER = "is at the border of the workspace"
"""Reason to refuse a point on whose sides no points can be commanded."""

MotionCorrection = Callable[[Array, Indices], tuple[Array, Mapping[int, str]]]
"""Correction of points, with the motion of each point."""


class Segments(NamedTuple):
    """Polyline of a motion."""

    start: list[float]
    """Corrected x, y, z of the start of the motion, [m]."""
    points: list[list[float]]
    """Corrected x, y, z of the ends of the segments, [m]."""
    stretch: list[float]
    """Length of each segment, relative to the length of its part of the motion."""
    deviation: float
    """Largest evaluated distance of the corrected motion from its chords, [m]."""
    correction: float
    """Largest correction, [m]."""


@dataclass(frozen=True, slots=True)
class Refused:
    """Motion that cannot be divided, with the reason."""

    reason: str
    point: tuple[float, ...] | None = None
    """x, y, z of the first point out of reach, [m]; None for another reason."""


def segment_motions(
    paths: Paths, correct: Correction, *, tolerance: float, sides: Sides | None = None
) -> list[Segments | Refused]:
    """Divide motions into as few segments as the tolerance allows.

    Args:
        paths: Curves of the motions.
        correct: Correction of points.
        tolerance: Largest distance of the corrected motion from its chords, [m].
        sides: Sides of drives with backlash. Motions are then divided where a drive reverses, and
            an additional segment takes up its backlash there.
    """
    if sides is None or not len(paths.base):
        return _segment(paths, lambda points, _: correct(points), tolerance)
    reversals = split_at_reversals(paths, sides)
    parts = paths.parts(reversals.motion, reversals.start, reversals.end)

    def correct_on_sides(points: Array, part: Indices) -> tuple[Array, Mapping[int, str]]:
        corrected, refused = correct(points)
        commanded = sides.command(corrected, reversals.sides[part])
        at_border = np.flatnonzero(~np.isfinite(commanded).all(axis=1)).tolist()
        return commanded, {**dict.fromkeys(at_border, AT_BORDER), **refused}

    segments = _segment(parts, correct_on_sides, tolerance)
    return [
        _join([segments[k] for k in range(*ends)], reversals.takes_up[slice(*ends)])
        for ends in pairwise(reversals.bounds)
    ]


def _join(parts: list[Segments | Refused], reversed_drives: Mask) -> Segments | Refused:
    """Join the parts of a motion to one polyline, which takes up backlash at reversals."""
    points: list[list[float]] = []
    stretch: list[float] = []
    for part, reverses in zip(parts, reversed_drives.tolist(), strict=True):
        if isinstance(part, Refused):
            return part
        if reverses:
            points.append(part.start)
            stretch.append(1.0)
        points += part.points
        stretch += part.stretch
    joined = [part for part in parts if isinstance(part, Segments)]
    return Segments(
        joined[0].start,
        points,
        stretch,
        max(part.deviation for part in joined),
        max(part.correction for part in joined),
    )


def _segment(paths: Paths, correct: MotionCorrection, tolerance: float) -> list[Segments | Refused]:
    """Segments of each motion.

    Args:
        paths: Curves of the motions.
        correct: Correction of points.
        tolerance: Largest distance of the corrected motion from its chords, [m].
    """
    lengths, radii = paths.lengths, paths.largest_radii
    # sagitta of an arc: s²/8r
    longest = np.where(radii > 0.0, np.sqrt(8.0 * radii * EVALUATED_SHARE * tolerance), np.inf)
    counts = lengths / np.minimum(longest, LONGEST_SEGMENT)
    counts = np.maximum(counts, np.abs(paths.angle[:, 1]) / LARGEST_ANGLE)
    counts = np.maximum(np.ceil(counts), 1.0)
    results: list[Segments | Refused | None] = [None] * len(lengths)
    pending = np.arange(len(lengths))
    while pending.size:
        for i in pending[counts[pending] > MOST_SEGMENTS]:
            results[i] = Refused(
                f"needs more than {MOST_SEGMENTS} segments; expected a shorter motion or a larger "
                "tolerance"
            )
        refined: list[int] = []
        for group in _groups(pending[counts[pending] <= MOST_SEGMENTS], counts):
            for i, result in _segment_group(paths, group, counts, correct, tolerance):
                if isinstance(result, float):
                    counts[i] = result
                    refined.append(i)
                else:
                    results[i] = result
        pending = np.array(refined, dtype=np.int64)
    return [r for r in results if r is not None]


def _groups(pending: Indices, counts: Array) -> Iterator[Indices]:
    """Groups of motions whose points are corrected together, at least one motion each."""
    n_points = np.cumsum(4.0 * counts[pending] + 1.0)
    first = 0
    while first < pending.size:
        limit = (n_points[first - 1] if first else 0.0) + POINTS_PER_BLOCK
        last = max(int(np.searchsorted(n_points, limit, side="right")), first + 1)
        yield pending[first:last]
        first = last


def _segment_group(
    paths: Paths,
    group: Indices,
    counts: Array,
    correct: MotionCorrection,
    tolerance: float,
) -> Iterator[tuple[int, Segments | Refused | float]]:
    """Divide motions into stated numbers of segments.

    Args:
        paths: Curves of the motions.
        group: Indices of the motions to divide.
        counts: Number of segments of each motion.
        correct: Correction of points.
        tolerance: Largest distance of the corrected motion from its chords, [m].

    Yields:
        Each motion with its result, or with the next number to try if it needs more segments.
    """
    n = counts[group].astype(np.int64)
    size = 4 * n + 1
    first = np.cumsum(size) - size
    member = np.repeat(np.arange(group.size), size)
    step = np.arange(member.size) - first[member]
    points = paths.points(group[member], step / (4.0 * n[member]))
    corrected, refused = correct(points, group[member])
    corrections = np.maximum.reduceat(np.linalg.norm(corrected - points, axis=1), first)
    reasons: dict[int, Refused] = {}
    for k, reason in refused.items():
        reasons.setdefault(int(member[k]), Refused(reason, tuple(points[k].tolist())))
    starts = np.flatnonzero((step % 4 == 0) & (step < 4 * n[member]))
    a, b = corrected[starts], corrected[starts + 4]
    deviation = np.zeros(starts.size)
    for k, fraction in enumerate(FRACTIONS):
        chord = (1.0 - fraction) * a + fraction * b
        distance = np.linalg.norm(corrected[starts + 1 + k] - chord, axis=1)
        np.maximum(deviation, distance, out=deviation)
    deviations = np.maximum.reduceat(deviation, np.cumsum(n) - n)
    part = paths.lengths[group[member[starts]]] / n[member[starts]]
    with np.errstate(divide="ignore", invalid="ignore"):
        stretch = np.where(part > 0.0, np.linalg.norm(b - a, axis=1) / part, 1.0)
    begins, ends, stretches = corrected[first].tolist(), b.tolist(), stretch.tolist()
    position = 0
    columns = (group.tolist(), n.tolist(), deviations.tolist(), corrections.tolist())
    for k, (i, count, largest, correction) in enumerate(zip(*columns, strict=True)):
        segments = slice(position, position + count)
        position += count
        if k in reasons:
            yield i, reasons[k]
        elif largest > EVALUATED_SHARE * tolerance:
            # the deviation of a chord grows with the square of its length; 5 % more to be sure
            yield i, float(max(count + 1, math.ceil(count * math.sqrt(largest / tolerance) * 1.05)))
        else:
            yield i, Segments(begins[k], ends[segments], stretches[segments], largest, correction)
