"""The mechanical zero of a robot: the coordinates in which it stands with its loops closed.

Drives stand where the robot's YAML says, and at 0 where it says nothing. Where the loops cannot be
closed so, the drives whose zero nobody gave are moved too, no further than it takes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.errors import RobotError
from orthocal.robot.closing import Closing, close_loops, describe_opening
from orthocal.robot.model import (
    Robot,
    closure_row_units,
    closure_turns,
    coordinate_limits,
    coordinate_units,
    read_only,
)

Array = NDArray[np.float64]

TRIES = 6
"""Starts from which the loops are tried to be closed; all but the first are drawn, always alike."""

SPREAD = 0.3
"""How far apart these are, [rad] or characteristic lengths."""

MAX_RETURNS = 60
"""Steps by which moved drives are brought back towards 0."""

LARGEST_RETURN = 0.2
"""Of a drive in one of these, [rad] or characteristic lengths."""

LEAST_GAIN = 1e-4
"""Share of what the drives have moved that such a step has to take off."""


def stand_at_zero(robot: Robot, passive_start: ArrayLike, *, given: ArrayLike) -> Robot:
    """The robot in its mechanical zero.

    Args:
        robot: The robot with its drives' zeros as given, 0 for the others.
        passive_start: Passive coordinates to start from, shape (n_passive,), [m, rad].
        given: Which drives' zeros are given, shape (n_drives,).

    Raises:
        RobotError: If no such posture is found; says by how much the loops stay open.
    """
    lower, upper = coordinate_limits(robot)
    start = robot.joint_coordinates(robot.drive_zero, passive_start)
    movable = robot.drive_index[~np.asarray(given, dtype=np.bool_)]
    start[movable] = np.clip(start[movable], lower[movable], upper[movable])
    found = _search(robot, start, movable)
    coordinates = found.coordinates
    drives = tuple(
        replace(d, zero=float(coordinates[i]), zero_found=True)
        if i in movable and coordinates[i] != d.zero
        else d
        for d, i in zip(robot.drives, robot.drive_index, strict=True)
    )
    return replace(robot, drives=drives, zero=read_only(coordinates))


def _search(robot: Robot, start: Array, movable: NDArray[np.int64]) -> Closing:
    """Close with the drives where they are; if that fails, with movable drives moved as little."""
    best = _close(robot, start, robot.passive_index)
    if best.closed:
        return best
    free = np.concatenate([movable, robot.passive_index])
    for attempt in _starts(robot, start, free, first=bool(movable.size)):
        found = _close(robot, attempt, free)
        if found.closed:
            return _return_drives(robot, found, movable, start[movable])
        best = min(best, found, key=lambda c: _size(robot, c))
    turns, stretches = closure_turns(robot), closure_row_units(robot)
    worst = int(np.abs(stretches * best.residual).argmax())
    owners = [c.name for c in robot.closures for _ in c.rows]
    moved = ", drives moved too" if movable.size else ""
    advice = (
        "orthocal.passive_start"
        if not movable.size
        else "orthocal.drives.<motor>.zero_mm (or zero_deg) and orthocal.passive_start"
    )
    raise RobotError(
        "its loops do not close in any posture that was found: the best, within the joints' limits"
        f"{moved}, leaves them open by {describe_opening(best.residual, turns)}, most of all "
        f"'{owners[worst]}'; set {advice} near a posture that closes",
        where=str(robot.yaml),
    )


def _starts(robot: Robot, start: Array, free: NDArray[np.int64], *, first: bool) -> Iterator[Array]:
    """The start itself if it was not tried yet with these free, and others around it."""
    if first:
        yield start
    draw = np.random.default_rng(0)
    lengths = np.where(coordinate_units(robot) == 1.0, robot.characteristic_length, 1.0)
    for _ in range(TRIES - 1):
        shift = np.zeros(len(start))
        shift[free] = SPREAD * draw.normal(size=free.size)
        yield start + shift * lengths


def _close(robot: Robot, start: Array, free: NDArray[np.int64]) -> Closing:
    """Close by the free coordinates; the result has all of them."""
    lower, upper = coordinate_limits(robot)

    def complete(part: Array) -> Array:
        coordinates = np.array(start)
        coordinates[free] = part
        return coordinates

    def evaluate(part: Array) -> tuple[Array, Array]:
        residual, jacobian = robot.evaluate_constraints_at(complete(part))
        return residual, jacobian[:, free]

    found = close_loops(
        evaluate,
        start[free],
        row_units=closure_row_units(robot),
        units=coordinate_units(robot)[free],
        bounds=(lower[free], upper[free]),
    )
    return Closing(complete(found.coordinates), found.residual)


def _size(robot: Robot, closing: Closing) -> float:
    """Of what stays open, [m²]."""
    return float(np.square(closure_row_units(robot) * closing.residual).sum())


def _return_drives(
    robot: Robot, found: Closing, movable: NDArray[np.int64], wanted: Array
) -> Closing:
    """Bring moved drives back towards where they were wanted, with the loops closed.

    Each step goes along the motions that leave the loops closed to first order, as far as brings
    the drives nearest, and is closed again.
    """
    units = coordinate_units(robot)
    units = np.where(units == 1.0, 1.0 / robot.characteristic_length, 1.0)
    free = np.concatenate([movable, robot.passive_index])
    count = movable.size

    def distance(closing: Closing) -> float:
        return float(np.linalg.norm((closing.coordinates[movable] - wanted) * units[movable]))

    size = 1.0
    for _ in range(MAX_RETURNS):
        _, jacobian = robot.evaluate_constraints_at(found.coordinates)
        motions = _null_space(jacobian[:, free] / units[free])
        missing = (wanted - found.coordinates[movable]) * units[movable]
        share = np.linalg.lstsq(motions[:count], missing, rcond=1e-6)[0]
        step = motions @ share
        step *= size * min(1.0, LARGEST_RETURN / max(float(np.abs(step).max()), 1e-300))
        trial = np.array(found.coordinates)
        trial[free] += step / units[free]
        closed = _close(robot, trial, free)
        if closed.closed and distance(closed) < (1.0 - LEAST_GAIN) * distance(found):
            found, size = closed, min(1.0, 2.0 * size)
        else:
            size *= 0.25
        if size < 1e-2:
            break
    return found


def _null_space(matrix: Array) -> Array:
    """Orthonormal columns that a matrix takes to 0."""
    _, values, right = np.linalg.svd(matrix)
    rank = int((values > 1e-9 * values.max(initial=0.0)).sum())
    return np.asarray(right[rank:].T)
