"""Motions cut so that chords stay near the corrected path.

A chord's distance is measured where a curve leaves it most, in its middle, and beside that; pieces
are short beside whatever bends a correction.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from orthocal.gcode.path import Paths

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

LONGEST_PIECE = 10e-3
"""Of any motion, [m]."""

MOST_TURNED = math.pi / 4.0
"""Of a piece of an arc, [rad]."""

MOST_PIECES = 50_000
"""Of one motion."""

POINTS_AT_ONCE = 40_000
"""Points that are corrected together."""

SEEN = 0.97
"""Part of the tolerance that the distances looked at may have, for those between them."""

BETWEEN = np.array([0.25, 0.5, 0.75])
"""Where the distance of a chord is looked at."""


class Correct(Protocol):
    """Where a controller is to be sent for points."""

    @property
    def bound(self) -> float:
        """No point is farther off what is right, [m]."""

    def __call__(self, points: Array) -> tuple[Array, Mapping[int, str]]:
        """Corrected points.

        Args:
            points: Where the tool is to be, shape (k, 3), [m].

        Returns:
            Shape (k, 3), [m]; and index to why the machine cannot be there, for the first of those;
            some after it may be refused unseen.
        """


class Cut(NamedTuple):
    """A motion as a polyline."""

    points: list[list[float]]
    """Ends of the pieces, without the motion's start, corrected: x, y, z of each, [m]."""
    stretch: list[float]
    """Length of each piece over that of its part of the motion."""
    chord: float
    """Largest distance of the corrected motion from the pieces that was seen, [m]."""
    correction: float
    """Largest correction, [m]."""


@dataclass(frozen=True, slots=True)
class Refused:
    """A motion that cannot be cut."""

    reason: str


def cut(paths: Paths, correct: Correct, *, tolerance: float) -> list[Cut | Refused]:
    """Cut motions.

    Args:
        paths: The motions.
        correct: The correction.
        tolerance: Largest distance of the corrected motion from its pieces, [m].
    """
    lengths, radii = paths.lengths, paths.largest_radii
    # sagitta s²/8r
    shortest = np.where(radii > 0.0, np.sqrt(8.0 * radii * SEEN * tolerance), np.inf)
    counts = lengths / np.minimum(shortest, LONGEST_PIECE)
    counts = np.maximum(counts, np.abs(paths.angle[:, 1]) / MOST_TURNED)
    counts = np.maximum(np.ceil(counts), 1.0)
    found: list[Cut | Refused | None] = [None] * len(lengths)
    pending = np.arange(len(lengths))
    while pending.size:
        for i in pending[counts[pending] > MOST_PIECES]:
            found[i] = Refused(
                f"needs more than {MOST_PIECES} pieces; expected a shorter motion or a larger "
                "tolerance"
            )
        again: list[int] = []
        for group in _groups(pending[counts[pending] <= MOST_PIECES], counts):
            for i, more in _cut_group(paths, group, counts, correct, tolerance, lengths, found):
                counts[i] = more
                again.append(i)
        pending = np.array(again, dtype=np.int64)
    return [c for c in found if c is not None]


def _groups(pending: Indices, counts: Array) -> Iterator[Indices]:
    """Motions whose points are corrected together, at least one a group."""
    load = np.cumsum(4.0 * counts[pending] + 1.0)
    first = 0
    while first < pending.size:
        before = load[first - 1] if first else 0.0
        last = max(int(np.searchsorted(load, before + POINTS_AT_ONCE, side="right")), first + 1)
        yield pending[first:last]
        first = last


def _cut_group(
    paths: Paths,
    group: Indices,
    counts: Array,
    correct: Correct,
    tolerance: float,
    lengths: Array,
    found: list[Cut | Refused | None],
) -> Iterator[tuple[int, float]]:
    """Cut some motions with the counts given; yields those that need more pieces, and how many."""
    n = counts[group].astype(np.int64)
    size = 4 * n + 1
    first = np.cumsum(size) - size
    own = np.repeat(np.arange(group.size), size)
    step = np.arange(own.size) - first[own]
    points = paths.points(group[own], step / (4.0 * n[own]))
    sent, refused = correct(points)
    away = np.linalg.norm(sent - points, axis=1)
    reasons: dict[int, str] = {}
    for k, reason in refused.items():
        reasons.setdefault(int(own[k]), reason)
    starts = np.flatnonzero((step % 4 == 0) & (step < 4 * n[own]))
    piece = own[starts]
    a, b = sent[starts], sent[starts + 4]
    off = np.zeros(starts.size)
    for k, share in enumerate(BETWEEN):
        chord = (1.0 - share) * a + share * b
        np.maximum(off, np.linalg.norm(sent[starts + 1 + k] - chord, axis=1), out=off)
    worst = np.maximum.reduceat(off, np.cumsum(n) - n)
    largest = np.maximum.reduceat(away, first)
    part = lengths[group[piece]] / n[piece]
    with np.errstate(divide="ignore", invalid="ignore"):
        stretch = np.where(part > 0.0, np.linalg.norm(b - a, axis=1) / part, 1.0)
    ends, stretches = b.tolist(), stretch.tolist()
    last = 0
    results = zip(group.tolist(), n.tolist(), worst.tolist(), largest.tolist(), strict=True)
    for k, (i, count, chord, correction) in enumerate(results):
        at = slice(last, last + count)
        last += count
        if k in reasons:
            found[i] = Refused(reasons[k])
        elif chord > SEEN * tolerance:
            # a chord's distance goes with the square of its length
            yield i, max(count + 1.0, math.ceil(count * math.sqrt(chord / tolerance) * 1.05))
        else:
            found[i] = Cut(ends[at], stretches[at], chord, correction)
