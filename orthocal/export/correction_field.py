"""Correction of commanded points, fast enough for the lines of a program.

A nominal controller with offsets o sends the drives to ρ(p) − o for a point p. The tip of the
calibrated machine is at p if the drives are at c(p) (`tool_tip.py`). The point to command is
therefore f(c(p) + o), with f the nominal forward kinematics. Displacements of the drives by the
controller (tables of trims) are subtracted before.

A work zero is touched off by motions without correction, whose errors contain a common shift and
rotation. Without them the corrected program would not meet the touched-off workpiece. So the
desired points are first moved by the translation and rotation that best map commanded points to
the tips of the machine without correction.

This exact correction takes up to a millisecond per point, and it is smooth. So it is interpolated
by a polynomial in each box of a grid. The polynomial is computed for the first point in the box and
checked against the exact correction at other points. A box that is not accurate enough, or not
completely reachable, is halved. In the smallest boxes at the border of the workspace each point is
corrected exactly.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import Literal

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.calibration.calibration import Calibration
from orthocal.export.polynomial import Polynomial, PolynomialFit, chebyshev_line
from orthocal.export.tool_tip import ToolTip
from orthocal.kinematics.conditions import UseConditions
from orthocal.kinematics.continuation import Failures
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.kinematics.workspace import Workspace, grid_points

POLYNOMIAL_TOLERANCE = 0.1
"""Largest error of the polynomials, relative to the tolerance of the path."""

SAFETY_FACTOR = 2.0
"""Assumed ratio of the largest error to the largest error at the checked points."""

EXACT_ERROR = 1e-11
"""Error of the exact correction, which closes loops twice to 1e-12 m, [m]."""

BOX_SIDE = 0.2
"""Side of a box, relative to the robot's characteristic length."""

NODES_PER_AXIS = 5
"""Number of interpolation nodes along each axis, the degree plus one."""

MARGIN = 0.05
"""Extension of a box beyond each face, relative to its side. It makes a box reachable if all nodes
are, although the limits of the reach are curved."""

MAX_HALVINGS = 3
"""Largest number of halvings of a box. In a smallest box, and in a halved box whose middle is out
of reach, points are corrected exactly."""

FIRST_BATCH = 8
"""Number of points that are corrected exactly at first; each further batch is twice as large."""

MAX_BOXES = 2000
"""Largest number of boxes in memory."""

RANDOM_CHECKS = 16
"""Number of random points at which a box is checked, in addition to points between its nodes."""

BATCH_SIZE = 2048
"""Number of points that are corrected exactly in one call."""

Key = tuple[int, ...]
"""Number of halvings, and the indices of a box."""

Fallback = Literal["divided", "exact"]
"""Treatment of a box without a polynomial."""


class CorrectionField:
    """Points to command for desired points of the tool.

    Args:
        calibration: The calibration.
        offsets: Offsets in the controller, shape (n_drives,), [m, rad].
        within: Tolerance of the corrected path, [m]; the field uses a part of it.
        tool: Tip in the frame of the robot's tool centre point, [m].
        conditions: Conditions of use; defaults as for `ToolTip`.
        aligned_over: Commanded points over which the desired points are aligned with the machine
            without correction; by default they are not aligned.

    Raises:
        ClosureError: If a point of `aligned_over` is out of reach.
        ExportError: If the robot's drives do not command the tool.
        ParameterError: If the tip is out of range.
    """

    def __init__(
        self,
        calibration: Calibration,
        offsets: Array,
        *,
        within: float,
        tool: tuple[float, float, float] = (0.0, 0.0, 0.0),
        conditions: UseConditions | None = None,
        aligned_over: Workspace | None = None,
    ) -> None:
        robot = calibration.robot
        self._tip = ToolTip(calibration, tool, conditions=conditions)
        self.axes = tuple(self._tip.coordinates)
        """Indices of the axes that the drives command."""
        self.bound = POLYNOMIAL_TOLERANCE * within
        """Largest error of a point, [m]."""
        self._offsets = np.array(offsets, dtype=np.float64)
        self._rotation, self._translation = np.eye(3), np.zeros(3)
        if aligned_over is not None:
            self._rotation, self._translation = self._align(aligned_over)
        self._side = BOX_SIDE * robot.characteristic_length
        self._boxes: dict[Key, Polynomial | Fallback] = {}
        self.error = EXACT_ERROR
        """Largest estimated error of the polynomials in use, [m]."""
        n = len(self.axes)
        line = chebyshev_line(NODES_PER_AXIS)
        self._nodes = grid_points(*[line] * n)
        self._fit = PolynomialFit(
            self._nodes, np.array(list(product(range(NODES_PER_AXIS), repeat=n)))
        )
        # interpolation errors are largest between the nodes
        between = np.cos(
            np.pi
            * np.array([0.5, 0.5 * (NODES_PER_AXIS - 1), NODES_PER_AXIS - 1.5])
            / (NODES_PER_AXIS - 1)
        )
        random = np.random.default_rng(0).uniform(-1.0, 1.0, (RANDOM_CHECKS, n))
        self._checks = np.vstack([grid_points(*[between] * n), random])

    def __call__(self, points: Array) -> tuple[Array, Mapping[int, str]]:
        """Points to command.

        Args:
            points: Desired points of the tool, shape (k, 3), [m].

        Returns:
            Points to command, shape (k, 3), [m]; and indices of refused points with the reasons:
            the first one out of reach and all later ones. Refused points are NaN.
        """
        axes = np.array(self.axes, dtype=np.int64)
        desired = np.array(points, dtype=np.float64)[:, axes]
        commanded, exact, refused = np.full(desired.shape, np.nan), list[int](), dict[int, str]()
        end = len(points)
        boxes = _group(_cells(desired, self._side))
        for group, cell in sorted(boxes, key=lambda box: box[0][0]):
            if exact and (0, *cell) not in self._boxes:  # a new box beyond the reach takes long
                end = self._correct_exactly(desired, commanded, exact, refused)
            group = group[group < end]
            if group.size:
                corrections = self._corrections(desired[group], group, 0, exact)
                commanded[group] = desired[group] + corrections
        end = self._correct_exactly(desired, commanded, exact, refused)
        for i in range(end, len(points)):
            refused.setdefault(i, "follows a point that is not reached")
        commanded[end:] = np.nan
        corrected = np.array(points, dtype=np.float64)
        corrected[:, axes] = commanded
        return corrected, refused

    def exactly(self, points: Array) -> tuple[Array, Mapping[int, str]]:
        """Exact points to command, and refused points with the reasons; see `command_points`."""
        return command_points(self._tip, self._offsets, self._move(points))

    def _align(self, workspace: Workspace) -> tuple[Array, Array]:
        """Rotation and translation that best map commanded points to uncorrected tips.

        Returns:
            Rotation R, shape (3, 3), and translation t, shape (3,), [m]: R p + t.
        """
        from scipy.spatial.transform import Rotation

        calibration = self._tip.calibration
        drives = nominal_closure(calibration.robot).inverse(workspace.points)
        motors = drives + calibration.displacement(drives)
        desired, actual = (
            self._in_space(points)
            for points in (
                self._tip.targets(workspace.points),
                self._tip.place(motors - self._offsets),
            )
        )
        middles = [workspace.weights @ points for points in (desired, actual)]
        fitted, _ = Rotation.align_vectors(
            actual - middles[1], desired - middles[0], weights=workspace.weights
        )
        rotation = np.asarray(fitted.as_matrix())
        return rotation, np.asarray(middles[1] - rotation @ middles[0])

    def _move(self, points: Array) -> Array:
        """Commanded points moved by the rotation and translation at their tips, shape (k, n)."""
        tips = self._in_space(self._tip.targets(points))
        moved = tips @ self._rotation.T + self._translation
        return np.asarray(points + (moved - tips)[:, list(self.axes)])

    def _in_space(self, points: Array) -> Array:
        """Points with all three coordinates, those without a drive at 0, shape (k, 3), [m]."""
        result = np.zeros((len(points), 3))
        result[:, list(self.axes)] = points
        return result

    def _correct_exactly(
        self, desired: Array, commanded: Array, indices: list[int], refused: dict[int, str]
    ) -> int:
        """Correct points exactly up to the first one out of reach.

        Args:
            desired: Desired points, shape (k, n_axes), [m].
            commanded: Filled with the corrected points, shape (k, n_axes), [m].
            indices: Indices of the points; this list is emptied.
            refused: Filled with the points out of reach and the reasons.

        Returns:
            Index of the first point out of reach; k if all are reached.
        """
        end = min(refused, default=len(desired))
        pending, count = np.sort(np.array(indices, dtype=np.int64)), FIRST_BATCH
        while pending.size and pending[0] < end:
            batch, pending, count = pending[:count], pending[count:], 2 * count
            commanded[batch], reasons = self.exactly(desired[batch])
            refused.update({int(batch[i]): reason for i, reason in reasons.items()})
            end = min(refused, default=end)
        indices.clear()
        return end

    def _corrections(
        self, points: Array, indices: Indices, halvings: int, exact: list[int]
    ) -> Array:
        """Corrections of points by the polynomials of their boxes, shape (k, n_axes), [m].

        Args:
            points: Desired points, shape (k, n_axes), [m].
            indices: Indices of the points, shape (k,).
            halvings: Number of halvings of the boxes.
            exact: List to which indices of points without a polynomial are added.
        """
        corrections = np.empty_like(points)
        for group, cell in _group(_cells(points, self._side / 2**halvings)):
            box = self._box((halvings, *cell))
            if box == "divided":
                corrections[group] = self._corrections(
                    points[group], indices[group], halvings + 1, exact
                )
            elif box == "exact":
                exact.extend(indices[group].tolist())
                corrections[group] = np.nan
            else:
                corrections[group] = box(points[group])
        return corrections

    def _box(self, key: Key) -> Polynomial | Fallback:
        """Polynomial of the corrections in a box, or its fallback, cached."""
        if key not in self._boxes:
            if len(self._boxes) >= MAX_BOXES:
                self._boxes.pop(next(iter(self._boxes)))
            self._boxes[key] = self._make(key)
        return self._boxes[key]

    def _make(self, key: Key) -> Polynomial | Fallback:
        """Compute the polynomial of a box and count its error, or decide its fallback."""
        fallback: Fallback = "divided" if key[0] < MAX_HALVINGS else "exact"
        side = self._side / 2 ** key[0]
        middle = (np.array(key[1:]) + 0.5) * side
        half = np.full(middle.size, (0.5 + MARGIN) * side)
        nodes = middle + half * self._nodes
        corners = np.flatnonzero((np.abs(self._nodes) > 1.0 - 1e-12).all(axis=1))
        if self.exactly(middle[None])[1]:
            return "exact" if key[0] else fallback
        if self.exactly(nodes[corners])[1]:
            return fallback
        commanded, refused = self.exactly(nodes)
        if refused:
            return fallback
        correction = self._fit(middle, half, commanded - nodes)
        checks = middle + half * self._checks
        expected, refused = self.exactly(checks)
        if refused:
            return fallback
        largest = float(np.linalg.norm(correction(checks) + checks - expected, axis=1).max())
        error = SAFETY_FACTOR * largest + EXACT_ERROR
        if error > self.bound:
            return fallback
        self.error = max(self.error, error)
        return correction


def command_points(tip: ToolTip, offsets: Array, points: Array) -> tuple[Array, Mapping[int, str]]:
    """Exact points to command, and refused points with the reasons.

        f(c(p) + o − s)

    f is the nominal forward kinematics and c the inverse kinematics of the calibrated machine. s is
    the displacement of the drives by the controller's compensation, as while measuring. Two
    fixed-point steps solve s, which depends on the commanded coordinates.

    Args:
        tip: Tip of the tool on the calibrated machine.
        offsets: Offsets o in the controller, shape (n_drives,), [m, rad].
        points: Desired coordinates p that the drives command, shape (k, n_axes), [m].
    """
    displacement = tip.calibration.displacement
    nominal = nominal_closure(tip.calibration.robot)
    corrected = np.full(points.shape, np.nan)
    refused: dict[int, str] = {}
    for first in range(0, len(points), BATCH_SIZE):
        batch = points[first : first + BATCH_SIZE]
        failures: Failures = {}
        motors = tip.reach(batch, failures=failures)[0] + offsets
        drives = motors - displacement(motors)
        drives = motors - displacement(drives)
        reached = np.array([i for i in range(len(batch)) if i not in failures], dtype=np.int64)
        nominal_failures: Failures = {}
        commanded = nominal.forward(drives[reached], failures=nominal_failures)
        corrected[first + reached] = commanded[:, tip.coordinates]
        failures.update({int(reached[i]): e for i, e in nominal_failures.items()})
        for i, e in failures.items():
            refused[first + i] = e.reason
            corrected[first + i] = np.nan
    return corrected, refused


def _cells(points: Array, side: float) -> Indices:
    """Indices of the cells of points, shape (k, n)."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.floor(points / side).astype(np.int64))


def _group(cells: Indices) -> list[tuple[Indices, Key]]:
    """Groups of equal rows: their indices and the row."""
    if not len(cells):
        return []
    order = np.arange(len(cells))
    if (cells[1:] != cells[:-1]).any():
        order = np.lexsort(cells.T)
    ordered = cells[order]
    starts = np.flatnonzero((ordered[1:] != ordered[:-1]).any(axis=1)) + 1
    return [(group, tuple(cells[group[0]].tolist())) for group in np.split(order, starts)]
