"""Where a nominal controller is to be sent for a point, at the speed of a program's lines.

A controller that is nominal but for its offsets o sends the drives to ρ(p) − o for a point p; they
belong at c(p), where the calibrated machine's tip is right (`tool_tip.py`). So it is to be sent to
f(c(p) + o), with f the nominal forward kinematics (`corrections.py`). That takes up to a
millisecond a point. What is added to p is smooth: in boxes of space, made as points fall into
them, it is a polynomial between Chebyshev's points, held against the machine itself at others. A
box that is not known well enough, or not reached as a whole, is divided; what is left at the border
of the workspace is the machine.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from orthocal.calibration.calibration import Calibration
from orthocal.errors import ExportError
from orthocal.export.tool_tip import ToolTip
from orthocal.kinematics.loop_closure import Failures, nominal_assembly
from orthocal.robot.model import Robot, Tcp

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SHARE = 0.1
"""Part of what is asked for that the polynomials may be off."""

SAFETY = 2.0
"""By which the largest error that was seen at other points is taken for the largest there is."""

EXACT = 1e-11
"""What the machine itself is known to, with loops closed to 1e-12 m twice, [m]."""

BOX = 0.2
"""Side of a box over the robot's characteristic length."""

NODES = 5
"""Of a polynomial along each axis; its degree and one."""

BEYOND = 0.05
"""Part of its side by which a box is known beyond each of its faces: where all its nodes are
reached all within is, though limits are curved."""

MOST_DIVISIONS = 3
"""Boxes are halved so often; then the machine itself is asked, as where the middle of one that
was halved is not reached."""

FIRST_ASKED = 8
"""Points of which the machine itself is asked at first, then twice as many."""

MOST_BOXES = 2000

CHECKS = 16
"""Points in a box, besides those between its nodes, at which it is held against the machine."""

POINTS_AT_ONCE = 2048

Key = tuple[int, ...]
"""How often a box was halved, and which one of those it is."""


class Unknown(Enum):
    """What is done where no polynomial serves a box."""

    DIVIDED = "divided"
    ASKED = "asked"
    """The machine itself, point by point."""


@dataclass(frozen=True, slots=True, eq=False)
class _Box:
    """What is added to points of a box."""

    middle: Array
    half: float
    """Half the side of where it is known, [m]."""
    coefficients: Array
    """Of Chebyshev polynomials, shape (NODES, ..., n_axes), [m]."""
    error: float
    """[m]"""

    def __call__(self, points: Array) -> Array:
        """Shape (k, n_axes), [m]."""
        at = (points - self.middle) / self.half
        result = self.coefficients
        for k in range(at.shape[1]):
            basis = chebyshev.chebvander(at[:, k], NODES - 1)
            if k == 0:
                flat = basis @ result.reshape(NODES, -1)
                result = flat.reshape(len(at), *result.shape[1:])
            else:
                result = np.einsum("ni,ni...->n...", basis, result)
        return result


class CorrectionField:
    """Where a nominal controller is to be sent for points of the tool.

    Args:
        calibration: The calibration.
        offsets: In the controller, shape (n_drives,), [m, rad].
        within: By how much what follows may be off in all, of which this takes a part, [m].
        tool: The tip in the frame of the robot's tool centre point, [m].

    Raises:
        ExportError: If the robot's drives command no tool.
    """

    def __init__(
        self,
        calibration: Calibration,
        offsets: Array,
        *,
        within: float,
        tool: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        robot = calibration.robot
        tcp = _require_commanded(robot)
        self.axes = tuple(tcp.coordinates)
        """Indices of the axes that the drives command."""
        self.bound = SHARE * within
        """No point is farther off, [m]."""
        self._offsets = np.array(offsets, dtype=np.float64)
        self._nominal = nominal_assembly(robot)
        self._tip = ToolTip(calibration, tool)
        self._side = BOX * robot.characteristic_length
        self._boxes: dict[Key, _Box | Unknown] = {}
        self._worst = EXACT
        grid = np.cos(np.pi * np.arange(NODES) / (NODES - 1))
        self._nodes = _tensor([grid] * len(self.axes))
        self._fit = np.linalg.inv(chebyshev.chebvander(grid, NODES - 1))
        self._checks = _check_points(len(self.axes))

    @property
    def error(self) -> float:
        """Largest error that is expected of the polynomials in use, [m]."""
        return self._worst

    def __call__(self, points: Array) -> tuple[Array, Mapping[int, str]]:
        """Points to send the controller to.

        Args:
            points: Where the tool is to be, shape (k, 3), [m].

        Returns:
            Shape (k, 3), [m]; and index to why the machine cannot be there, for the first of those;
            all after it are refused, too, some of them unseen.
        """
        axes = np.array(self.axes, dtype=np.int64)
        wanted = np.array(points, dtype=np.float64)[:, axes]
        sent, asked, refused = np.full(wanted.shape, np.nan), list[int](), dict[int, str]()
        end = len(points)
        for group, key in self._boxes_of(wanted):
            if asked and key not in self._boxes:  # what is not reached takes long to find out
                end = self._ask(wanted, sent, asked, refused)
            own = group[group < end]
            if own.size:
                sent[own] = wanted[own] + self._add(wanted[own], own, 0, asked)
        end = self._ask(wanted, sent, asked, refused)
        for i in range(end, len(points)):
            refused.setdefault(i, "comes after one that is not reached")
        sent[end:] = np.nan
        result = np.array(points, dtype=np.float64)
        result[:, axes] = sent
        return result, refused

    def _ask(self, wanted: Array, sent: Array, asked: list[int], refused: dict[int, str]) -> int:
        """Ask the machine itself for points up to the first that it refuses.

        Args:
            wanted: Shape (k, n_axes), [m].
            sent: Filled with what it says, shape (k, n_axes), [m].
            asked: Indices of the points; emptied.
            refused: Filled with those that it refuses.

        Returns:
            The first index that is refused; k where none is.
        """
        end = min(refused, default=len(wanted))
        rest, count = np.sort(np.array(asked, dtype=np.int64)), FIRST_ASKED
        while rest.size and rest[0] < end:
            own, rest, count = rest[:count], rest[count:], 2 * count
            sent[own], odd = self.exactly(wanted[own])
            refused.update({int(own[i]): reason for i, reason in odd.items()})
            end = min(refused, default=end)
        asked.clear()
        return end

    def _boxes_of(self, wanted: Array) -> list[tuple[Indices, Key]]:
        """Points by the box that they are in, undivided, in the order in which they come."""
        with np.errstate(invalid="ignore"):
            cells = np.floor(wanted / self._side).astype(np.int64)
        groups = np.split(*_group(cells)) if len(cells) else []
        return [(own, (0, *cells[own[0]].tolist())) for own in sorted(groups, key=lambda g: g[0])]

    def exactly(self, points: Array) -> tuple[Array, Mapping[int, str]]:
        """The same by the machine itself; coordinates that the drives command, (k, n_axes), [m]."""
        result = np.full(points.shape, np.nan)
        refused: dict[int, str] = {}
        for first in range(0, len(points), POINTS_AT_ONCE):
            part = points[first : first + POINTS_AT_ONCE]
            failures: Failures = {}
            drives = self._tip.reach(part, failures=failures)[0] + self._offsets
            good = np.array([i for i in range(len(part)) if i not in failures], dtype=np.int64)
            beyond: Failures = {}
            sent = self._nominal.forward(drives[good], failures=beyond)
            result[first + good] = sent[:, list(self.axes)]
            failures.update({int(good[i]): e for i, e in beyond.items()})
            for i, e in failures.items():
                refused[first + i] = e.reason
                result[first + i] = np.nan
        return result, refused

    def _add(self, points: Array, of: Indices, halved: int, asked: list[int]) -> Array:
        """What is added to points; where the machine is to be asked, `of` goes into `asked`."""
        side = self._side / 2**halved
        with np.errstate(invalid="ignore"):
            cells = np.floor(points / side).astype(np.int64)
        result = np.empty_like(points)
        order, starts = _group(cells)
        for own in np.split(order, starts):
            box = self._box((halved, *cells[own[0]].tolist()))
            if isinstance(box, _Box):
                result[own] = box(points[own])
            elif box is Unknown.DIVIDED:
                result[own] = self._add(points[own], of[own], halved + 1, asked)
            else:
                asked.extend(of[own].tolist())
                result[own] = np.nan
        return result

    def _box(self, key: Key) -> _Box | Unknown:
        """The box of a key, or what is to be done instead."""
        if key not in self._boxes:
            if len(self._boxes) >= MOST_BOXES:
                self._boxes.pop(next(iter(self._boxes)))
            box = self._boxes[key] = self._make(key)
            if isinstance(box, _Box):
                self._worst = max(self._worst, box.error)
        return self._boxes[key]

    def _make(self, key: Key) -> _Box | Unknown:
        instead = Unknown.DIVIDED if key[0] < MOST_DIVISIONS else Unknown.ASKED
        side = self._side / 2 ** key[0]
        middle = (np.array(key[1:]) + 0.5) * side
        half = (0.5 + BEYOND) * side
        nodes = middle + half * self._nodes
        corners = np.flatnonzero((np.abs(self._nodes) > 1.0 - 1e-12).all(axis=1))
        if self.exactly(middle[None])[1]:
            return Unknown.ASKED if key[0] else instead
        if any(self.exactly(nodes[[i]])[1] for i in corners.tolist()):
            return instead
        sent, refused = self.exactly(nodes)
        if refused:
            return instead
        count = len(self.axes)
        coefficients = (sent - nodes).reshape([NODES] * count + [count])
        for k in range(count):
            coefficients = np.moveaxis(np.tensordot(self._fit, coefficients, axes=(1, k)), 0, k)
        checks = middle + half * self._checks
        expected, refused = self.exactly(checks)
        box = _Box(middle, half, np.ascontiguousarray(coefficients), 0.0)
        if refused:
            return instead
        seen = float(np.linalg.norm(box(checks) + checks - expected, axis=1).max())
        error = SAFETY * seen + EXACT
        return instead if error > self.bound else _Box(middle, half, box.coefficients, error)


def _require_commanded(robot: Robot) -> Tcp:
    if robot.tcp is None or len(robot.tcp.coordinates) != len(robot.drives):
        raise ExportError("the machine has no tool that its drives command")
    return robot.tcp


def _tensor(lines: list[Array]) -> Array:
    """All points of a grid, shape (k, n)."""
    return np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, len(lines))


def _check_points(count: int) -> Array:
    """Points between nodes, where polynomials are off most, and others, shape (k, count)."""
    between = np.cos(np.pi * (np.array([0.5, 0.5 * (NODES - 1), NODES - 1.5])) / (NODES - 1))
    others = np.random.default_rng(0).uniform(-1.0, 1.0, (CHECKS, count))
    return np.vstack([_tensor([between] * count), others])


def _group(cells: Indices) -> tuple[Indices, Indices]:
    """Order that puts equal rows together, and where each group but the first begins."""
    changed = (cells[1:] != cells[:-1]).any(axis=1)
    if not changed.any():
        return np.arange(len(cells)), np.zeros(0, dtype=np.int64)
    order = np.lexsort(cells.T)
    ordered = cells[order]
    starts = np.flatnonzero((ordered[1:] != ordered[:-1]).any(axis=1)) + 1
    return order, starts
