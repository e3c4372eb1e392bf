"""Reversals of drives along motions, at which their backlash is taken up."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from orthocal.arrays import Array, Indices, Mask
from orthocal.gcode.path import Paths

LARGEST_ANGLE = math.pi / 8.0
"""Largest angle of a part of an arc, [rad]. A drive reverses about once in half a turn of an arc,
so that the ends of a part of a sixteenth of a turn show each reversal."""

STEP = 1e-4
"""Step of the parameter of a motion for the direction of a drive. Reversals nearer to its ends are
those between motions."""

BISECTIONS = 24
"""Number of bisections for the parameter of a reversal."""

SMALLEST_MOVE = 1e-7
"""Motion back from its farthest coordinate below which a drive has not reversed, [m, rad]."""


class Sides(Protocol):
    """Sides of approach of drives with backlash, and the points to command on each side.

    A side is 1 if the drive's coordinate grew in its last motion, -1 if it fell, and 0 if this is
    unknown.
    """

    current: Array
    """Sides after the last motion, shape (n_drives,)."""
    farthest: Array
    """Farthest coordinates of the drives on these sides, shape (n_drives,), [m, rad]; NaN before
    the first motion."""

    def drives(self, points: Array) -> Array:
        """Drive coordinates at tool positions, which show the direction of the drives.

        Args:
            points: Tool positions, shape (k, 3), [m].

        Returns:
            Drive coordinates, shape (k, n_drives), [m, rad]; NaN out of reach.
        """

    def command(self, points: Array, sides: Array) -> Array:
        """Points to command on sides.

        Args:
            points: Points to command in the middle of both sides, shape (k, 3), [m].
            sides: Sides of the drives, shape (k, n_drives).

        Returns:
            Points to command, shape (k, 3), [m]; NaN at the border of the workspace.
        """


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """Motions divided where a drive reverses."""

    motion: Indices
    """Motion of each part, shape (k,)."""
    start: Array
    """Parameter of the start of each part on its motion, from 0 to 1, shape (k,)."""
    end: Array
    """Parameter of the end of each part on its motion, shape (k,)."""
    sides: Array
    """Sides of the drives on each part, shape (k, n_drives)."""
    takes_up: Mask
    """True if backlash is taken up at the start of a part: a side changes or becomes known, shape
    (k,)."""
    bounds: list[int]
    """First part of each motion, and the number of all parts."""


def split_at_reversals(paths: Paths, sides: Sides) -> Parts:
    """Divide motions where a drive reverses; updates `sides` to the end of the last motion."""
    counts = np.maximum(np.ceil(np.abs(paths.angle[:, 1]) / LARGEST_ANGLE), 1.0).astype(np.int64)
    motion = np.repeat(np.arange(len(counts)), counts)
    number = np.arange(motion.size) - np.repeat(np.cumsum(counts) - counts, counts)
    start, end = number / counts[motion], (number + 1.0) / counts[motion]
    reversals = _find_reversals(paths, sides, motion, start, end)
    divisions = np.unique(np.vstack([np.column_stack([motion, start]), reversals]), axis=0)
    motion, start = divisions[:, 0].astype(np.int64), divisions[:, 1]
    begins, ends = (sides.drives(paths.points(motion, t)) for t in (start, _ends(motion, start)))
    followed = [
        _follow_drive(*of_drive)
        for of_drive in zip(begins.T, ends.T, sides.current, sides.farthest, strict=True)
    ]
    part_sides = np.column_stack([of_parts for of_parts, _ in followed])
    reverses = (part_sides != np.vstack([sides.current, part_sides[:-1]])).any(axis=1)
    sides.current, sides.farthest = part_sides[-1], np.array([far for _, far in followed])
    is_start = (start == 0.0) | reverses  # parts without a reversal belong to the previous part
    motion, start = motion[is_start], start[is_start]
    bounds = np.cumsum(np.bincount(motion, minlength=len(counts))).tolist()
    return Parts(
        motion,
        start,
        _ends(motion, start),
        part_sides[is_start],
        reverses[is_start],
        [0, *bounds],
    )


def _follow_drive(begins: Array, ends: Array, side: float, farthest: float) -> tuple[Array, float]:
    """Sides of a drive on parts, also if it moves by less than SMALLEST_MOVE in each.

    A point out of reach leaves the side unchanged: such motions are refused.

    Args:
        begins: Coordinates at the starts of the parts, shape (k,), [m, rad]; NaN out of reach.
        ends: Those at the ends.
        side: Side before the first part.
        farthest: Farthest coordinate on this side, [m, rad]; NaN if unknown.

    Returns:
        Sides, shape (k,), and the farthest coordinate on the last one.
    """
    part_sides = np.empty(len(ends))
    for i, (begin, end) in enumerate(zip(begins.tolist(), ends.tolist(), strict=True)):
        if not abs(begin - farthest) <= SMALLEST_MOVE:  # unknown, or other motions led to the start
            farthest = begin
        change = end - farthest
        if abs(change) > SMALLEST_MOVE:
            side = math.copysign(1.0, change)
        if side * change > 0.0:
            farthest = end
        part_sides[i] = side
    return part_sides, farthest


def _ends(motion: Indices, start: Array) -> Array:
    """Parameters of the ends of parts: the start of the next part of the motion, or 1."""
    is_followed = np.append(motion[1:] == motion[:-1], False)
    return np.where(is_followed, np.append(start[1:], 1.0), 1.0)


def _find_reversals(paths: Paths, sides: Sides, motion: Indices, start: Array, end: Array) -> Array:
    """Motions and parameters at which a drive reverses within short parts, shape (k, 2).

    Args:
        paths: Curves of the motions.
        sides: Sides of the drives.
        motion: Motion of each part, shape (n,).
        start: Parameter of the start of each part, shape (n,).
        end: Parameter of the end of each part, shape (n,).
    """

    def direction(curve: Indices, t: Array) -> Array:
        """Changes of the drive coordinates about parameters, shape (n, n_drives)."""
        low, high = np.clip(t - STEP, 0.0, 1.0), np.clip(t + STEP, 0.0, 1.0)
        change = sides.drives(paths.points(curve, high)) - sides.drives(paths.points(curve, low))
        return np.asarray(np.nan_to_num(change))  # out of reach: no reversal; it is refused later

    begins, ends = direction(motion, start), direction(motion, end)
    parts, drives = np.nonzero(begins * ends < 0.0)
    low, high = start[parts], end[parts]
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        change = direction(motion[parts], middle)[np.arange(parts.size), drives]
        is_before = change * begins[parts, drives] > 0.0
        low, high = np.where(is_before, middle, low), np.where(is_before, high, middle)
    middle = 0.5 * (low + high)
    inside = (middle > STEP) & (middle < 1.0 - STEP)
    return np.column_stack([motion[parts[inside]], middle[inside]])
