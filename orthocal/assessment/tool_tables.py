"""Evaluation of long tables on the calibrated machine, in chunks of rows.

Memory does not grow with the table. A row that cannot be reached does not affect the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
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

CHUNK_SIZE = 512
"""Rows of a chunk. A full model needs 20 kB per row."""

Block = tuple[Sequence[str], Array]
"""Names of some rows and their values, shape (n_rows, n_columns)."""

_Evaluate = Callable[[Array, Sequence[str], Failures], Array]
"""Function that returns the values of some rows and records those that fail."""


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """Evaluated rows of a table."""

    first: int
    """Index of the first row in the table."""
    values: Array
    """Values, shape (n_rows, n_columns), [SI]; NaN in refused rows."""
    refused: Mapping[int, ClosureError]
    """Index in the table to the reason why the machine cannot reach the row."""


def forward_blocks(
    calibration: Calibration, blocks: Iterable[Block], conditions: UseConditions | None = None
) -> Iterator[Chunk]:
    """Tool centre points of the calibrated machine for blocks of drive coordinates.

    Args:
        calibration: The calibration.
        blocks: Names and drive coordinates of encoders, without offsets of the controller, shape
            (n, n_drives), [m, rad].
        conditions: Conditions of use; by default the mean of both sides of approach, the reference
            temperature and no payload.

    Yields:
        Chunks of shape (n, 3), [m].
    """
    robot = calibration.robot
    use = conditions or UseConditions()
    closure = LoopClosure(robot, fixed=calibration.errors, conditions=use)

    def evaluate(rows: Array, names: Sequence[str], failures: Failures) -> Array:
        failures.update(find_beyond_travel(robot, rows, names))
        return closure.forward(rows, names=names, failures=failures)

    yield from _by_chunks(evaluate, blocks)


def inverse_blocks(
    calibration: Calibration, blocks: Iterable[Block], conditions: UseConditions | None = None
) -> Iterator[Chunk]:
    """Drive coordinates of the calibrated machine for blocks of tool positions.

    Args:
        calibration: The calibration.
        blocks: Names and coordinates of points, shape (n, n_drives), [m].
        conditions: As for `forward_blocks`.

    Yields:
        Chunks of drive coordinates of encoders, shape (n, n_drives), [m, rad].
    """
    use = conditions or UseConditions()
    closure = LoopClosure(calibration.robot, fixed=calibration.errors, conditions=use)
    yield from _by_chunks(
        lambda rows, names, failures: closure.inverse(rows, names=names, failures=failures), blocks
    )


def accuracy_rows(
    calibration: Calibration,
    points: ArrayLike,
    *,
    names: Sequence[str] | None = None,
    conditions: UseConditions | None = None,
) -> Iterator[Chunk]:
    """Deviation of the tool at commanded points with its absolute uncertainty.

    The values are those of `assess_tool`, computed point by point.

    Args:
        calibration: The calibration.
        points: Commanded coordinates, shape (K, n_coordinates), [m].
        names: Names of the points, for messages.
        conditions: As for `forward_blocks`.

    Yields:
        Chunks of shape (n, 9), [m]: commanded position, deviation of the tool and its standard
        deviation. The last is NaN if the noise is unknown.
    """
    robot, values = calibration.robot, calibration.errors
    free = [p.name for p in calibration.free]
    free += calibration.unmodelled.names
    use = conditions or UseConditions()
    tool = ToolSensitivity(robot, free=free, values=values, conditions=use)
    nominal = nominal_closure(robot)
    rows, _ = as_rows(points, len(robot.drives), "coordinates")
    noise_known = bool(np.isfinite(calibration.model_covariance).all())
    covariance = calibration.error_covariances[0] if noise_known else None

    def evaluate(rows: Array, names: Sequence[str], failures: Failures) -> Array:
        drives = nominal.inverse(rows, names=names, failures=failures)
        target = nominal.forward(drives, names=names, failures=failures)
        displacement = calibration.displacement(drives, use.approach)
        commanded = drives - calibration.active_offsets + displacement
        passive = tool.closure.close(commanded, names=names, failures=failures)
        result = np.full((len(rows), 9), np.nan)
        reached = np.array([i for i in range(len(rows)) if i not in failures], dtype=np.int64)
        if not reached.size:
            return result
        result[reached, :3] = target[reached]
        result[reached, 3:6] = (
            tool.closure.tcp(commanded[reached], passive[reached]) - target[reached]
        )
        if covariance is not None:
            jacobian = tool(commanded[reached], passive=passive[reached])
            variance = np.einsum("kin,nm,kim->ki", jacobian, covariance, jacobian, optimize=True)
            result[reached, 6:] = np.sqrt(variance)
        return result

    yield from _by_chunks(evaluate, row_blocks(rows, names))


def row_blocks(rows: Array, names: Sequence[str] | None = None) -> Iterator[Block]:
    """Blocks of rows with their names for messages."""
    names = names or [f"row {i + 1}" for i in range(len(rows))]
    for first in range(0, len(rows), CHUNK_SIZE):
        chunk = slice(first, first + CHUNK_SIZE)
        yield names[chunk], rows[chunk]


def _by_chunks(evaluate: _Evaluate, blocks: Iterable[Block]) -> Iterator[Chunk]:
    """Evaluate blocks of rows and number their rows."""
    first = 0
    for names, rows in blocks:
        failures: Failures = {}
        values = evaluate(rows, names, failures)
        values[list(failures)] = np.nan
        refused = {first + i: e for i, e in sorted(failures.items())}
        yield Chunk(first, read_only(values), refused)
        first += len(rows)
