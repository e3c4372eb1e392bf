"""Reversals of drives along motions: where the backlash of a drive has to be taken up."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from orthocal.arrays import Array, Indices, Mask
from orthocal.gcode.path import Paths

LARGEST_ANGLE = math.pi / 8.0
"""Largest angle of a part of an arc, in which a drive reverses at most once, [rad]."""

STEP = 1e-4
"""Step of the parameter of a part for the direction of a drive."""

BISECTIONS = 24

SMALLEST_MOVE = 1e-7
"""Change of a drive's coordinate along a part below which the drive rests, [m, rad]."""


class Sides(Protocol):
    """Sides from which drives with backlash come, and the points to command on each side.

    A side is 1 where the drive's coordinate grew in its last motion, -1 where it fell, and 0 if
    that is unknown.
    """

    last: Array
    """Sides after the last motion, shape (n_drives,)."""

    def drives(self, points: Array) -> Array:
        """Drive coordinates at points of the tool, to see in which direction drives move.

        Args:
            points: Shape (k, 3), [m].

        Returns:
            Shape (k, n_drives), [m, rad]; NaN out of reach.
        """

    def command(self, points: Array, sides: Array) -> Array:
        """Points to command on sides.

        Args:
            points: Points to command in the middle of both sides, shape (k, 3), [m].
            sides: Shape (k, n_drives).

        Returns:
            Shape (k, 3), [m].
        """


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """Motions divided where a drive reverses."""

    of: Indices
    """Motion of each part, shape (k,)."""
    first: Array
    last: Array
    """Parameters of its ends on the motion, shape (k,)."""
    sides: Array
    """Sides on it, shape (k, n_drives)."""
    turned: Mask
    """True where a side differs from that of the part before, shape (k,)."""
    starts: list[int]
    ends: list[int]
    """First part of each motion, and the one after its last."""


def split_at_reversals(paths: Paths, sides: Sides) -> Parts:
    """Divide motions where a drive reverses; `sides.last` becomes that after the last motion."""
    counts = np.maximum(np.ceil(np.abs(paths.angle[:, 1]) / LARGEST_ANGLE), 1.0).astype(np.int64)
    of = np.repeat(np.arange(len(counts)), counts)
    number = np.arange(of.size) - np.repeat(np.cumsum(counts) - counts, counts)
    first, last = number / counts[of], (number + 1.0) / counts[of]
    at = np.column_stack([of, first])
    at = np.unique(np.vstack([at, _find_cuts(paths, sides, of, first, last)]), axis=0)
    of, first = at[:, 0].astype(np.int64), at[:, 1]
    last = np.where(np.append(of[1:] == of[:-1], False), np.append(first[1:], 1.0), 1.0)
    moved = sides.drives(paths.points(of, last)) - sides.drives(paths.points(of, first))
    moving = np.abs(np.nan_to_num(moved)) > SMALLEST_MOVE
    taken = np.vstack([sides.last[None], np.where(moving, np.sign(moved), 0.0)])
    # a drive that rests stays on its side
    index = np.where(taken != 0.0, np.arange(len(taken))[:, None], 0)
    filled = np.take_along_axis(taken, np.maximum.accumulate(index, axis=0), axis=0)
    turned = (filled[1:] != filled[:-1]).any(axis=1)
    sides.last = filled[-1]
    unchanged = (first == 0.0) | turned
    of, first = of[unchanged], first[unchanged]
    last = np.where(np.append(of[1:] == of[:-1], False), np.append(first[1:], 1.0), 1.0)
    ends = np.cumsum(np.bincount(of, minlength=len(counts))).tolist()
    return Parts(of, first, last, filled[1:][unchanged], turned[unchanged], [0, *ends[:-1]], ends)


def _find_cuts(paths: Paths, sides: Sides, of: Indices, first: Array, last: Array) -> Array:
    """Motions and parameters at which a drive reverses within short parts, shape (k, 2)."""

    def direction(part: Indices, t: Array) -> Array:
        """Signs of the drives' velocities, shape (k, n_drives)."""
        low, high = np.clip(t - STEP, 0.0, 1.0), np.clip(t + STEP, 0.0, 1.0)
        at = sides.drives(paths.points(part, high)) - sides.drives(paths.points(part, low))
        return np.asarray(np.nan_to_num(at))

    begins, ends = direction(of, first), direction(of, last)
    parts, drives = np.nonzero(begins * ends < 0.0)
    low, high = first[parts], last[parts]
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        before = direction(of[parts], middle)[np.arange(parts.size), drives]
        same = before * begins[parts, drives] > 0.0
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    middle = 0.5 * (low + high)
    inside = (middle > STEP) & (middle < 1.0 - STEP)
    return np.column_stack([of[parts[inside]], middle[inside]])
