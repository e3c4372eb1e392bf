"""Tables of many rows on the calibrated machine: a chunk at a time, each row for itself.

Memory does not grow with the table, and a row that cannot be reached stops no other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.assessment.calibrated_tool import error_covariance
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ClosureError
from orthocal.io.fields import read_only
from orthocal.kinematics.conditions import UseConditions
from orthocal.kinematics.continuation import Failures
from orthocal.kinematics.loop_closure import (
    LoopClosure,
    as_rows,
    find_beyond_travel,
    nominal_closure,
)
from orthocal.kinematics.sensitivity import ToolSensitivity

ROWS_AT_ONCE = 512
"""Rows of a chunk: a full model takes 20 kB a row while it is evaluated."""

Block = tuple[Sequence[str], Array]
"""Names of some rows, and their values."""

_Evaluate = Callable[[Array, Sequence[str], Failures], Array]
"""Values of some rows, by name; fills in which fail, whose values are of no account."""


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """Some rows of a table, evaluated."""

    first: int
    """Index of the first of them in the table."""
    values: Array
    """Shape (n_rows, n_columns), [SI]; NaN in rows that are refused."""
    refused: Mapping[int, ClosureError]
    """Index in the table to why the machine cannot be there."""


def forward_blocks(
    calibration: Calibration, blocks: Iterable[Block], conditions: UseConditions | None = None
) -> Iterator[Chunk]:
    """Tool centre points of the calibrated machine, of rows as they come.

    Args:
        calibration: The calibration.
        blocks: Names and drive coordinates of some rows as the encoders give them, without any
            offset of the controller, shape (n, n_drives), [m, rad].
        conditions: Conditions of use; by default the middle of both sides of each drive, the
            reference temperature and no payload.

    Yields:
        Chunks of shape (n, 3), [m].
    """
    robot = calibration.robot
    closure = _closure(calibration, conditions)

    def evaluate(rows: Array, names: Sequence[str], failures: Failures) -> Array:
        failures.update(find_beyond_travel(robot, rows, names))
        return closure.forward(rows, names=names, failures=failures)

    yield from _by_chunks(evaluate, blocks)


def inverse_blocks(
    calibration: Calibration, blocks: Iterable[Block], conditions: UseConditions | None = None
) -> Iterator[Chunk]:
    """Drive coordinates that bring the calibrated machine's tool to points as they come.

    Args:
        calibration: The calibration.
        blocks: Names and coordinates of some points, shape (n, n_drives), [m].
        conditions: As for `forward_blocks`.

    Yields:
        Chunks of shape (n, n_drives), as the encoders give them, [m, rad].
    """
    closure = _closure(calibration, conditions)

    def evaluate(rows: Array, names: Sequence[str], failures: Failures) -> Array:
        return closure.inverse(rows, names=names, failures=failures)

    yield from _by_chunks(evaluate, blocks)


def _closure(calibration: Calibration, conditions: UseConditions | None) -> LoopClosure:
    use = conditions or UseConditions()
    return LoopClosure(calibration.robot, fixed=calibration.errors, conditions=use)


def accuracy_rows(
    calibration: Calibration,
    points: ArrayLike,
    *,
    names: Sequence[str] | None = None,
    conditions: UseConditions | None = None,
) -> Iterator[Chunk]:
    """Actual tool positions for commanded points, with absolute uncertainty.

    As `assess_tool` has it, point by point.

    Args:
        calibration: The calibration.
        points: In the coordinates that the drives control, shape (K, n_coordinates), [m].
        names: What to call the rows in messages.
        conditions: As for `forward_blocks`.

    Yields:
        Chunks of shape (n, 9): the commanded position, by how much the tool is off it, and one
        standard deviation of that, NaN where nothing tells the noise, [m].
    """
    robot, values = calibration.robot, calibration.errors
    free = [p.name for p in calibration.free]
    free += calibration.unmodelled.names
    use = conditions or UseConditions()
    tool = ToolSensitivity(robot, free=free, values=values, conditions=use)
    nominal = nominal_closure(robot)
    rows, _ = as_rows(points, len(robot.drives), "coordinates")
    active = calibration.session.controller_offsets
    offsets = np.zeros(len(robot.drives)) if active is None else np.array(active)
    known = bool(np.isfinite(calibration.model_covariance).all())
    covariance = error_covariance(calibration) if known else None

    def evaluate(rows: Array, names: Sequence[str], failures: Failures) -> Array:
        drives = nominal.inverse(rows, names=names, failures=failures)
        target = nominal.forward(drives, names=names, failures=failures)
        commanded = drives - offsets
        passive = tool.closure.close(commanded, names=names, failures=failures)
        result = np.full((len(rows), 9), np.nan)
        at = np.array([i for i in range(len(rows)) if i not in failures], dtype=np.int64)
        if not at.size:
            return result
        result[at, :3] = target[at]
        result[at, 3:6] = tool.closure.tcp(commanded[at], passive[at]) - target[at]
        if covariance is not None:
            jacobian = tool(commanded[at], passive=passive[at])
            variance = np.einsum("kin,nm,kim->ki", jacobian, covariance, jacobian, optimize=True)
            result[at, 6:] = np.sqrt(variance)
        return result

    yield from _by_chunks(evaluate, row_blocks(rows, names))


def row_blocks(rows: Array, names: Sequence[str] | None = None) -> Iterator[Block]:
    """Rows some at a time, with what to call them in messages."""
    names = names or [f"row {i + 1}" for i in range(len(rows))]
    for first in range(0, len(rows), ROWS_AT_ONCE):
        part = slice(first, first + ROWS_AT_ONCE)
        yield names[part], rows[part]


def _by_chunks(evaluate: _Evaluate, blocks: Iterable[Block]) -> Iterator[Chunk]:
    first = 0
    for names, rows in blocks:
        failures: Failures = {}
        values = evaluate(rows, names, failures)
        values[list(failures)] = np.nan
        refused = {first + i: e for i, e in sorted(failures.items())}
        yield Chunk(first, read_only(values), refused)
        first += len(rows)
