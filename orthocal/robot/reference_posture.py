"""Reference posture of a robot: closed loops with the drives at their mechanical zero.

The robot's YAML states the mechanical zero of a drive, which is 0 by default. If the loops cannot
be closed there, drives without a stated zero are moved by as little as possible. The smallest
motion that closes the loops ends in a singular posture, so that a margin to it is required.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array, Indices
from orthocal.errors import RobotError
from orthocal.io.fields import read_only
from orthocal.robot.closing import MAX_STEPS, Closing, describe_opening
from orthocal.robot.model import (
    LIMIT_TOLERANCE,
    Robot,
    closure_row_units,
    closure_turns,
    coordinate_limits,
    coordinate_names,
    coordinate_turns,
    coordinate_units,
)

MAX_STARTS = 6
"""Number of starts: the first from the YAML, the others random and reproducible around it."""

START_SPREAD = 0.3
"""Standard deviation of the random starts, [rad] or characteristic lengths."""

MAX_OPERATIONS = 2e8
"""Approximate number of multiplications of all starts; large robots get fewer starts."""

NULL_SPACE_TOLERANCE = 1e-9
"""Singular values below this fraction of the largest one count as zero."""

SNAP_DISTANCE = 1e-3
"""Distance from its zero at which a drive is set to its zero, [rad] or characteristic lengths."""

MAX_RETURN_STEPS = 60
"""Largest number of steps that move drives back towards their zeros."""

LARGEST_RETURN_STEP = 0.2
"""Largest motion in one of these steps, [rad] or characteristic lengths."""

MIN_REDUCTION = 1e-4
"""Smallest relative reduction of the drives' distance from their zeros in such a step."""

SINGULARITY_MARGIN = 0.5
"""Smallest singular value after such a step, relative to that before the first one."""


def find_reference_posture(
    robot: Robot, passive_start: ArrayLike, *, fixed_zeros: ArrayLike
) -> Robot:
    """Find the reference posture of a robot.

    Args:
        robot: The robot with the stated zeros of its drives, 0 for the others.
        passive_start: Start values of the passive coordinates, shape (n_passive,), [m, rad].
        fixed_zeros: Mask of the drives whose zero is stated, shape (n_drives,).

    Returns:
        The robot with its reference posture, and with the computed zeros of moved drives.

    Raises:
        RobotError: If no posture with closed loops is found; states the smallest opening.
    """
    lower, upper = coordinate_limits(robot.model)
    start = robot.joint_coordinates(robot.drive_zero, passive_start)
    movable = robot.drive_index[~np.asarray(fixed_zeros, dtype=np.bool_)]
    start[movable] = np.clip(start[movable], lower[movable], upper[movable])
    posture = _remove_full_turns(robot, _search(robot, start, movable))
    drives = tuple(
        replace(drive, zero=float(posture[i]), zero_computed=True)
        if i in movable and posture[i] != drive.zero
        else drive
        for drive, i in zip(robot.drives, robot.drive_index, strict=True)
    )
    return replace(robot, drives=drives, reference_posture=read_only(posture))


def count_free_motions(robot: Robot) -> int:
    """Number of free passive motions in the reference posture."""
    scaled = _scaled_jacobian(robot, robot.reference_posture)
    return int(_null_space(scaled[:, robot.passive_index]).shape[1])


def _search(robot: Robot, start: Array, movable: Indices) -> Array:
    """Joint coordinates with closed loops; movable drives are moved only if necessary.

    Raises:
        RobotError: If no posture with closed loops is found.
    """
    free = np.concatenate([movable, robot.passive_index])
    attempts: list[Closing] = []
    for drives_move in (False, True) if movable.size else (False,):
        variables = free if drives_move else robot.passive_index
        for trial in _starts(robot, start, variables):
            closing = robot.close_coordinates(trial, variables)
            if closing.closed:
                if drives_move:
                    closing = _return_drives(robot, closing, movable, start)
                return closing.coordinates
            attempts.append(closing)
    best = min(
        attempts, key=lambda c: float(np.square(closure_row_units(robot) * c.residual).sum())
    )
    outside = _find_joints_outside_limits(robot, start, free)
    raise RobotError(
        _explain_open_loops(robot, best, bool(movable.size), outside), where=str(robot.yaml)
    )


def _find_joints_outside_limits(robot: Robot, start: Array, free: Indices) -> list[str]:
    """Joints outside their limits in a posture that closes the loops if limits are ignored.

    The list is empty if no such posture is found.
    """
    lower, upper = coordinate_limits(robot.model)
    if not np.isfinite([lower[free], upper[free]]).any():
        return []
    closings = (
        robot.close_coordinates(s, free, limited=False) for s in _starts(robot, start, free)
    )
    x = next((c.coordinates for c in closings if c.closed), None)
    if x is None:
        return []
    outside = np.flatnonzero((x < lower - LIMIT_TOLERANCE) | (x > upper + LIMIT_TOLERANCE))
    names = coordinate_names(robot.model)
    return [names[k] for k in outside.tolist()]


def _explain_open_loops(robot: Robot, best: Closing, drives_moved: bool, outside: list[str]) -> str:
    """Message for loops that cannot be closed: the worst closure, its opening and a remedy."""
    names = [closure.name for closure in robot.closures for _ in closure.rows]
    worst = names[int(np.abs(closure_row_units(robot) * best.residual).argmax())]
    rows, turns = np.array(names) == worst, closure_turns(robot)
    # norms of both parts, which do not depend on the axes
    opening = [float(np.linalg.norm(best.residual[rows & kind])) for kind in (~turns, turns)]
    closure = next(c for c in robot.closures if c.name == worst)
    moved = ", with its drives moved too," if drives_moved else ""
    joints = f" (one closes outside the limits of {', '.join(outside)})" if outside else ""
    return (
        f"its loops do not close in any posture that was found{moved} within the limits of its "
        f"joints: the best leaves '{closure.frame_a}' and '{closure.frame_b}' apart by "
        f"{describe_opening(opening, [False, True])}{joints}; set orthocal.drives.<motor>.zero_mm "
        "(or zero_deg) and orthocal.passive_start near a posture that closes"
    )


def _starts(robot: Robot, start: Array, free: Indices) -> Iterator[Array]:
    """Start, then random starts around it that differ in the free coordinates."""
    yield start
    rng = np.random.default_rng(0)
    stds = START_SPREAD * (robot.characteristic_length / coordinate_units(robot))
    operations = MAX_STEPS * robot.closure_rows * robot.model.nv**2
    for _ in range(min(MAX_STARTS - 1, int(MAX_OPERATIONS / max(operations, 1)))):
        change = np.zeros(len(start))
        change[free] = rng.normal(size=free.size)
        yield start + stds * change


def _return_drives(robot: Robot, closing: Closing, movable: Indices, target: Array) -> Closing:
    """Move drives back towards their zeros with closed loops.

    Each step is the motion in the null space of the closure Jacobian that brings the drives
    nearest to their zeros. The loops are closed after each step.

    Args:
        robot: The robot.
        closing: A posture with closed loops.
        movable: Indices of the drives that may move.
        target: Joint coordinates with the drives at their zeros, shape (nv,), [m, rad].
    """
    scales = robot.characteristic_length / coordinate_units(robot)
    values = _singular_values(robot, closing)
    independent = values > NULL_SPACE_TOLERANCE  # others belong to dependent rows
    smallest = SINGULARITY_MARGIN * values[independent][-1:]  # none without passive joints

    def is_regular(candidate: Closing) -> bool:
        """True if the posture keeps the margin to singular ones."""
        return bool((_singular_values(robot, candidate)[independent][-1:] >= smallest).all())

    free = np.concatenate([movable, robot.passive_index])

    def distances(candidate: Closing) -> Array:
        """Distance of each movable drive from its zero, [rad] or characteristic lengths."""
        return np.asarray((target - candidate.coordinates)[movable] / scales[movable])

    factor = 1.0  # reduced after a failed step, doubled after a successful one
    for _ in range(MAX_RETURN_STEPS):
        _, jacobian = robot.evaluate_constraints_at(closing.coordinates)
        motions = _null_space(jacobian[:, free] * scales[free])
        # the cut-off excludes motions that hardly move the drives
        amounts = np.linalg.lstsq(motions[: movable.size], distances(closing), rcond=1e-6)[0]
        step = motions @ amounts
        step *= factor * min(1.0, LARGEST_RETURN_STEP / max(float(np.abs(step).max()), 1e-300))
        trial = np.array(closing.coordinates)
        trial[free] += step * scales[free]
        closed = robot.close_coordinates(trial, free)
        after, before = (float(np.linalg.norm(distances(c))) for c in (closed, closing))
        if closed.closed and after < (1.0 - MIN_REDUCTION) * before and is_regular(closed):
            closing, factor = closed, min(1.0, 2.0 * factor)
        elif factor < 0.01:
            break
        else:
            factor *= 0.25
    # drives near their zeros are set to them, and the loops are closed by the others
    trial = np.array(closing.coordinates)
    near = movable[np.abs(distances(closing)) < SNAP_DISTANCE]
    trial[near] = target[near]
    closed = robot.close_coordinates(trial, np.setdiff1d(free, near))
    return closed if closed.closed and is_regular(closed) else closing


def _scaled_jacobian(robot: Robot, coordinates: Array) -> Array:
    """Closure Jacobian with respect to joint coordinates, rows and columns scaled to metres."""
    _, jacobian = robot.evaluate_constraints_at(coordinates)
    return np.asarray(closure_row_units(robot)[:, None] * jacobian / coordinate_units(robot))


def _singular_values(robot: Robot, closing: Closing) -> Array:
    """Singular values of the closure Jacobian of passive motions, relative to the largest one."""
    scaled = _scaled_jacobian(robot, closing.coordinates)
    values = np.linalg.svd(scaled[:, robot.passive_index], compute_uv=False)
    return np.asarray(values / max(float(values.max(initial=0.0)), 1e-300))


def _null_space(matrix: Array) -> Array:
    """Orthonormal basis of the null space of a matrix, as columns."""
    _, values, right = np.linalg.svd(matrix)
    rank = int((values > NULL_SPACE_TOLERANCE * values.max(initial=0.0)).sum())
    return np.asarray(right[rank:].T)


def _remove_full_turns(robot: Robot, coordinates: Array) -> Array:
    """Coordinates with the angles of unlimited passive joints reduced to ±π."""
    unlimited = np.isinf(coordinate_limits(robot.model)).all(axis=0) & coordinate_turns(robot.model)
    unlimited[robot.drive_index] = False
    turns = np.round(coordinates / (2.0 * np.pi))
    return np.where(unlimited, coordinates - 2.0 * np.pi * turns, coordinates)
