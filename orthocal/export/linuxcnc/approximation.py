"""A calibrated machine's inverse kinematics as few numbers, of the least degree that will do.

How good it is, is measured on points that were not fitted: within the region, on its faces, edges
and corners. What they show is where the calibrated machine, closed by its own loops, has its tool
when the drives are where these numbers send them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.assessment.calibrated_tool import find_tool
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ClosureError, ExportError
from orthocal.export.linuxcnc.nominal_form import Tangent, find_nominal_form
from orthocal.export.linuxcnc.polynomial import (
    CorrectedInverse,
    chebyshev_lattice,
    fit_correction,
)
from orthocal.export.linuxcnc.words import region_words, rounded_up
from orthocal.export.tool_tip import ToolTip
from orthocal.kinematics.loop_closure import find_beyond_travel
from orthocal.kinematics.workspace import cube_limits, describe_box, tool_at_zero
from orthocal.units import UM

Array = NDArray[np.float64]

MOST_DEGREE = {1: 14, 2: 14, 3: 10}
"""Coordinates of the tool to the highest degree: further ones cost more than they bring."""

SPARE = 3
"""Points a side that are fitted beyond the highest degree."""

CHECKED = 1000
"""Points within, and as many on faces, edges and corners."""

RESERVE = 1.1
"""Between the points that are looked at an error may be somewhat larger than at them."""

BEYOND = 5e-3
"""Beyond a face, where it is told what is left, [m]."""

LEVER = 10e-3
"""By which a tool is longer than said, where it is told what that does, [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Approximation:
    """Numbers that move a calibrated machine, and how well they do."""

    inverse: CorrectedInverse
    """Points of the tool to drive coordinates as the encoders give them, without offsets."""
    tool: Array
    """Tip in the frame of the robot's tool centre point, shape (3,), [m]."""
    coordinates: tuple[int, ...]
    """World coordinates that the drives control."""
    achieved: float
    """Largest distance of the tip from where it belongs, with the reserve between points, [m]."""
    checked: int
    """Points that it was measured at."""
    nominal: float | None
    """The same of nominal kinematics with the offsets active while measuring, [m]; None where
    the robot has no closed form."""
    beyond: float | None
    """The same 5 mm beyond the faces, [m]; None where the machine does not reach that far."""
    longer: float
    """Largest error where the tool is 10 mm longer than said, in whichever direction, [m]."""

    @property
    def lower(self) -> Array:
        """Least coordinates of the region, shape (n,), [m]."""
        return np.asarray(self.inverse.middle - self.inverse.half)

    @property
    def region(self) -> str:
        """Where it holds, in words, mm."""
        return region_words(self.coordinates, self.lower, self.upper)

    @property
    def upper(self) -> Array:
        """Largest coordinates of the region, shape (n,), [m]."""
        return np.asarray(self.inverse.middle + self.inverse.half)


def approximate(
    calibration: Calibration,
    *,
    within: float,
    tool: ArrayLike = (0.0, 0.0, 0.0),
    half_side: float | None = None,
) -> Approximation:
    """The inverse kinematics of least degree that keeps the tool as near as asked.

    Args:
        calibration: The calibration.
        within: Largest distance of the tip from where it belongs, [m].
        tool: The tip in the frame of the robot's tool centre point, shape (3,), [m].
        half_side: Half the side of a cube around the mechanical zero, [m]; by default the region
            is the workspace.

    Raises:
        ExportError: If no degree does, naming what is reached; if the machine has no tool, or
            does not reach the region.
    """
    tip = ToolTip(calibration, tool)
    robot = calibration.robot
    box = _find_box(calibration, half_side)
    middle, half = tool_at_zero(robot) + 0.5 * box.sum(axis=1), 0.5 * (box[:, 1] - box[:, 0])
    most = MOST_DEGREE[middle.size]
    fitted = chebyshev_lattice(middle.size, most + SPARE)
    checked = check_points(middle.size)
    try:
        tip.reach(middle + half * corners(middle.size))  # soon, where it cannot be
        drives, _ = tip.reach(middle + half * fitted)
        for error in find_beyond_travel(robot, drives, ["a point"] * len(drives)).values():
            raise error
        belong, passive = tip.reach(middle + half * checked)
    except ClosureError as e:
        raise ExportError(
            f"the machine does not reach {describe_box(box)} ({e.reason}); "
            "give a smaller --half-side-mm"
        ) from None
    form = find_nominal_form(robot, middle, half)
    points = middle + half * checked
    best = np.inf
    for degree in range(1, most + 1):
        found = fit_correction(form, middle, half, fitted, drives, degree=degree)
        reached = RESERVE * _estimate(found, points, belong)
        if reached <= within:
            reached = RESERVE * _miss(tip, points, found(points), passive)
        best = min(best, reached)
        if reached <= within:
            return Approximation(
                inverse=found,
                tool=tip.tool,
                coordinates=tuple(tip.chosen),
                achieved=reached,
                checked=len(points),
                nominal=None
                if isinstance(form, Tangent)
                else _miss_or_none(tip, points, form(points)[0] - calibration.active_offsets),
                beyond=_beyond(tip, found, calibration),
                longer=_longer(tip, belong, passive),
            )
    raise ExportError(
        f"no polynomial of a degree up to {most} keeps the tool within {within / UM:g} µm "
        f"over {describe_box(box)}; the best of them reaches {rounded_up(best / UM)} µm"
    )


def check_points(n: int, *, count: int = CHECKED, seed: int = 1) -> Array:
    """Points of a cube of ±1 within it, on its faces, edges and corners, shape (2 count + 2^n, n).

    No fitted one is among them but the corners.
    """
    generator = np.random.default_rng(seed)
    within, outside = generator.uniform(-1.0, 1.0, (2, count, n))
    pinned = generator.integers(0, n, count)
    outside[np.arange(count), pinned] = generator.choice([-1.0, 1.0], count)
    edges = generator.random((count, n)) < 0.3
    outside[edges] = generator.choice([-1.0, 1.0], int(edges.sum()))
    return np.concatenate([within, outside, corners(n)])


def corners(n: int) -> Array:
    """Of a cube of ±1, shape (2^n, n)."""
    return np.stack(np.meshgrid(*[[-1.0, 1.0]] * n, indexing="ij"), axis=-1).reshape(-1, n)


def _find_box(calibration: Calibration, half_side: float | None) -> Array:
    """Region relative to the mechanical zero, shape (n_coordinates, 2), [m]."""
    if half_side is not None:
        return cube_limits(calibration.robot, half_side)
    tool = find_tool(calibration)
    if tool is None:
        raise ExportError("the machine has no tool that its drives command over a region")
    return tool.workspace.limits


def _estimate(found: CorrectedInverse, points: Array, drives: Array) -> float:
    """Largest error at the tool, to first order in that of the drives, [m]."""
    off = np.linalg.solve(found.slopes(points), (found(points) - drives)[..., None])[..., 0]
    return float(np.linalg.norm(off, axis=1).max())


def _miss(tip: ToolTip, points: Array, drives: Array, start: Array | None) -> float:
    """Largest distance of the tip from where it belongs, drives being there, [m]."""
    off = tip.place(drives, start=start) - tip.targets(points)
    return float(np.linalg.norm(off, axis=1).max())


def _miss_or_none(tip: ToolTip, points: Array, drives: Array) -> float | None:
    try:
        return _miss(tip, points, drives, None)
    except ClosureError:
        return None


def _beyond(tip: ToolTip, found: CorrectedInverse, calibration: Calibration) -> float | None:
    """Largest error beyond the faces, [m]."""
    outside = check_points(found.middle.size, count=100, seed=2)[100:]
    points = found.middle + (found.half + BEYOND) * outside
    drives = found(points)
    if not np.isfinite(drives).all():
        return None
    if find_beyond_travel(calibration.robot, drives, [""] * len(drives)):
        return None
    return _miss_or_none(tip, points, drives)


def _longer(tip: ToolTip, drives: Array, passive: Array) -> float:
    """What a tilt makes of a longer tool, [m]."""
    tilt = (tip.poses(drives, start=passive)[:, :3, :3] - tip.level)[:, tip.chosen]
    return float(LEVER * np.linalg.svd(tilt, compute_uv=False).max())
