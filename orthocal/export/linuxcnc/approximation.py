"""Inverse kinematics of a calibrated machine in few numbers: a closed form and a polynomial.

    q(p) = nominal(p) + f(clamp(p))

f is a polynomial of the lowest total degree that meets the tolerance. Beyond the region its
argument is clamped to the faces. The error is evaluated at points that are not fitted: inside the
region and on its faces, edges and corners. There the calibrated machine, with its loops closed, is
compared with the commanded point.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.assessment.calibrated_tool import find_tool
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ClosureError, ExportError
from orthocal.export.linuxcnc.drive_compensation import without_periodic_errors
from orthocal.export.linuxcnc.nominal_form import NominalForm, Tangent, find_nominal_form
from orthocal.export.polynomial import Polynomial, PolynomialFit, chebyshev_line, total_degree
from orthocal.export.tool_tip import ToolTip
from orthocal.kinematics.loop_closure import find_beyond_travel
from orthocal.kinematics.workspace import cube_limits, describe_box, grid_points, tool_at_zero
from orthocal.units import MM, UM

LETTERS = "XYZABC"
"""Coordinates of LinuxCNC in its order."""

MOST_DEGREE = {1: 14, 2: 14, 3: 10}
"""Number of coordinates to the highest degree; higher ones gain less than they cost."""

EXTRA_NODES = 3
"""Nodes a side beyond the highest degree."""

CHECKED = 1000
"""Number of checked points inside the region, and on its faces, edges and corners."""

RESERVE = 1.1
"""Factor on the largest error at the checked points."""

BEYOND = 5e-3
"""Distance beyond a face at which the error is stated, [m]."""

LONGER = 10e-3
"""Change of the tool's length of which the effect is stated, [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedInverse:
    """Drive coordinates for points of the tool."""

    nominal: NominalForm
    correction: Polynomial
    """Correction of the drive coordinates over the region, [m, rad]."""

    @property
    def lower(self) -> Array:
        """Smallest coordinates of the region, shape (n,), [m]."""
        return np.asarray(self.correction.middle - self.correction.half)

    @property
    def upper(self) -> Array:
        """Largest coordinates of the region, shape (n,), [m]."""
        return np.asarray(self.correction.middle + self.correction.half)

    def __call__(self, points: Array) -> Array:
        """Drive coordinates, shape (k, n_drives), [m, rad], for points, shape (k, n), [m]."""
        clamped = np.clip(points, self.lower, self.upper)
        return np.asarray(self.nominal(points) + self.correction(clamped))


@dataclass(frozen=True, slots=True, eq=False)
class Approximation:
    """Approximate inverse kinematics with their errors."""

    inverse: CorrectedInverse
    """Points of the tool to drive coordinates of the encoders, without offsets."""
    tool: Array
    """Tip in the frame of the robot's tool centre point, shape (3,), [m]."""
    coordinates: tuple[int, ...]
    """World coordinates that the drives control."""
    achieved: float
    """Largest error of the tip at the checked points, with the reserve, [m]."""
    checked: int
    """Number of checked points."""
    nominal: float | None
    """Largest error with nominal kinematics and the offsets active during the measurement, [m];
    None for a robot without a closed form."""
    beyond: float | None
    """Largest error 5 mm beyond the faces, [m]; None if the machine does not reach that far."""
    longer: float
    """Largest error for a tip 10 mm farther in any direction, [m]."""

    @property
    def region(self) -> str:
        """Limits of the region, mm: X -60 to 60, Y -60 to 60."""
        limits = zip(self.coordinates, self.inverse.lower, self.inverse.upper, strict=True)
        return ", ".join(
            f"{LETTERS[k]} {millimetres([low])} to {millimetres([high])}" for k, low, high in limits
        )


def millimetres(values: Iterable[float]) -> str:
    """Lengths in mm to 1 nm, separated by commas."""
    return ", ".join(f"{round(float(v) / MM, 6) + 0.0:g}" for v in values)


def rounded_up(value: float) -> str:
    """Number with two digits, rounded up."""
    if not math.isfinite(value) or value <= 0.0:
        return f"{value:g}"
    decimals = 1 - math.floor(math.log10(value))
    return f"{math.ceil(value * 10.0**decimals) / 10.0**decimals:.2g}"


def approximate(
    calibration: Calibration,
    *,
    within: float,
    tool: ArrayLike = (0.0, 0.0, 0.0),
    half_side: float | None = None,
) -> Approximation:
    """Inverse kinematics of the lowest degree that meets a tolerance.

    Periodic errors of the drives' screws are no part of it (`drive_compensation.py`).

    Args:
        calibration: The calibration.
        within: Largest distance of the tip from where it belongs, [m].
        tool: The tip in the frame of the robot's tool centre point, shape (3,), [m].
        half_side: Half the side of a cube around the mechanical zero, [m]; by default the region
            is the workspace.

    Raises:
        ExportError: If no degree meets the tolerance, with the best error; if the machine has no
            tool or does not reach the region.
    """
    robot = calibration.robot
    tip = ToolTip(calibration, tool, errors=without_periodic_errors(robot, calibration.errors))
    box = _find_box(calibration, half_side)
    middle, half = tool_at_zero(robot) + 0.5 * box.sum(axis=1), 0.5 * (box[:, 1] - box[:, 0])
    n = middle.size
    most = MOST_DEGREE[n]
    nodes = grid_points(chebyshev_line(most + EXTRA_NODES), n)
    checks = middle + half * check_points(n)
    with _reached(box):
        tip.reach(middle + half * corners(n))  # fails fast
        drives, _ = tip.reach(middle + half * nodes)
        for failure in find_beyond_travel(robot, drives, ["a point"] * len(drives)).values():
            raise failure
        expected, passive = tip.reach(checks)
    form = find_nominal_form(robot, middle, half)
    corrections = drives - form(middle + half * nodes)
    best = math.inf
    for degree in range(1, most + 1):
        fit = PolynomialFit(nodes, total_degree(n, degree))
        inverse = CorrectedInverse(form, fit(middle, half, corrections))
        error = _tip_error(tip, checks, inverse(checks), start=passive)
        error = math.inf if error is None else RESERVE * error
        best = min(best, error)
        if error <= within:
            return Approximation(
                inverse=inverse,
                tool=tip.tool,
                coordinates=tuple(tip.coordinates),
                achieved=error,
                checked=len(checks),
                nominal=_nominal_error(tip, form, checks, calibration.active_offsets),
                beyond=_error_beyond(tip, inverse, calibration),
                longer=_error_of_longer_tool(tip, expected, passive),
            )
    raise ExportError(
        f"no polynomial of a degree up to {most} keeps the tool within {within / UM:g} µm "
        f"over {describe_box(box)}; the best of them reaches {rounded_up(best / UM)} µm"
    )


def check_points(n: int, *, count: int = CHECKED, seed: int = 1) -> Array:
    """Points inside a cube of ±1 and on its faces, edges and corners, shape (2 count + 2^n, n).

    Only the corners are nodes of the fit.
    """
    generator = np.random.default_rng(seed)
    inside, outside = generator.uniform(-1.0, 1.0, (2, count, n))
    pinned = generator.integers(0, n, count)
    outside[np.arange(count), pinned] = generator.choice([-1.0, 1.0], count)
    edges = generator.random((count, n)) < 0.3
    outside[edges] = generator.choice([-1.0, 1.0], int(edges.sum()))
    return np.concatenate([inside, outside, corners(n)])


def corners(n: int) -> Array:
    """Corners of a cube of ±1, shape (2^n, n)."""
    return grid_points(np.array([-1.0, 1.0]), n)


def _find_box(calibration: Calibration, half_side: float | None) -> Array:
    """Region relative to the mechanical zero, shape (n_coordinates, 2), [m]."""
    if half_side is not None:
        return cube_limits(calibration.robot, half_side)
    tool = find_tool(calibration)
    if tool is None:
        raise ExportError("the machine has no tool that its drives command over a region")
    return tool.workspace.limits


@contextmanager
def _reached(box: Array) -> Iterator[None]:
    """Name the region if the machine does not reach it.

    Raises:
        ExportError: In place of `ClosureError`.
    """
    try:
        yield
    except ClosureError as e:
        reason = f"the machine does not reach {describe_box(box)} ({e.reason})"
        raise ExportError(f"{reason}; give a smaller --half-side-mm") from None


def _tip_error(
    tip: ToolTip, points: Array, drives: Array, *, start: Array | None = None
) -> float | None:
    """Largest distance of the tip from its target at drive coordinates, [m]; None out of reach."""
    try:
        off = tip.place(drives, start=start) - tip.targets(points)
    except ClosureError:
        return None
    return float(np.linalg.norm(off, axis=1).max())


def _nominal_error(tip: ToolTip, form: NominalForm, points: Array, offsets: Array) -> float | None:
    """Largest error with nominal kinematics and offsets, [m]; None without a closed form."""
    return None if isinstance(form, Tangent) else _tip_error(tip, points, form(points) - offsets)


def _error_beyond(
    tip: ToolTip, inverse: CorrectedInverse, calibration: Calibration
) -> float | None:
    """Largest error beyond the faces, [m]."""
    box = inverse.correction
    outside = check_points(box.middle.size, count=100, seed=2)[100:]
    points = box.middle + (box.half + BEYOND) * outside
    drives = inverse(points)
    if not np.isfinite(drives).all():
        return None
    if find_beyond_travel(calibration.robot, drives, [""] * len(drives)):
        return None
    return _tip_error(tip, points, drives)


def _error_of_longer_tool(tip: ToolTip, drives: Array, passive: Array) -> float:
    """Largest error for a tip farther from the platform, by its tilt, [m]."""
    tilt = (tip.poses(drives, start=passive)[:, :3, :3] - tip.level)[:, tip.coordinates]
    return float(LONGER * np.linalg.svd(tilt, compute_uv=False).max())
