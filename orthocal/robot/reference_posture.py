"""The mechanical zero of a robot: the coordinates in which it stands with its loops closed.

Drives stand where the robot's YAML says, and at 0 where it says nothing. Where the loops cannot be
closed so, the drives whose zero nobody gave are moved too, no further than it takes to close them
clear of a singular posture: the least motion of all ends in one, at the edge of what closes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.errors import RobotError
from orthocal.io.fields import read_only
from orthocal.robot.closing import (
    MAX_STEPS,
    NOTHING,
    Closing,
    close_loops,
    describe_opening,
)
from orthocal.robot.model import (
    Robot,
    closure_row_units,
    closure_turns,
    coordinate_limits,
    coordinate_units,
    joint_turns,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

TRIES = 6
"""Starts from which loops are closed, at most: the first as given, the others drawn around it,
always alike."""

SPREAD = 0.3
"""How far apart these are, [rad] or characteristic lengths."""

WORK = 2e8
"""Products of numbers that the tries may take, roughly: large robots get fewer tries."""

RANK = 1e-9
"""Singular values below this share of the largest are none."""

NEAR = 1e-3
"""Drives that end as near to where they were wanted are put there, [rad] or characteristic
lengths."""

MAX_RETURNS = 60
"""Steps by which drives that were moved are brought back."""

LARGEST_RETURN = 0.2
"""Of a drive in one of these, [rad] or characteristic lengths."""

LEAST_GAIN = 1e-4
"""Share of what the drives have moved that such a step has to take off."""


CLEAR = 0.5
"""Share of the smallest singular value that such a step has to leave, or more."""


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
    zero = _without_turns(robot, _search(robot, start, movable))
    drives = tuple(
        replace(drive, zero=float(zero[i]), zero_found=True)
        if i in movable and zero[i] != drive.zero
        else drive
        for drive, i in zip(robot.drives, robot.drive_index, strict=True)
    )
    return replace(robot, drives=drives, zero=read_only(zero))


def count_free_motions(robot: Robot) -> int:
    """Number of passive motions that the loops leave free in the reference posture."""
    _, jacobian = robot.evaluate_constraints_at(robot.zero)
    scaled = closure_row_units(robot)[:, None] * jacobian / coordinate_units(robot)
    return int(_null_space(scaled[:, robot.passive_index]).shape[1])


def _search(robot: Robot, start: Array, movable: Indices) -> Array:
    """Coordinates with closed loops: drives where they are, or movable ones moved too."""
    free = np.concatenate([movable, robot.passive_index])
    tried: list[Closing] = []
    for moving in (robot.passive_index, free) if movable.size else (free,):
        for attempt in _starts(robot, start, moving):
            found = _close(robot, attempt, moving)
            if found.closed:
                if moving is free and movable.size:
                    found = _return_drives(robot, found, movable, start)
                return found.coordinates
            tried.append(found)
    best = min(tried, key=lambda c: float(np.square(closure_row_units(robot) * c.residual).sum()))
    beyond = _find_joints_beyond_limits(robot, start, free)
    problem = _explain_open_loops(robot, best, movable, beyond)
    raise RobotError(problem, where=str(robot.yaml))


def _find_joints_beyond_limits(robot: Robot, start: Array, free: Indices) -> list[str]:
    """Joints whose limits a posture breaks in which the loops close, where one is found."""
    lower, upper = coordinate_limits(robot)
    if not np.isfinite([lower[free], upper[free]]).any():
        return []
    tries = (_close(robot, a, free, limited=False) for a in _starts(robot, start, free))
    x = next((found.coordinates for found in tries if found.closed), np.clip(start, lower, upper))
    outside = np.flatnonzero((x < lower - NOTHING) | (x > upper + NOTHING))
    model = robot.model
    owners = {model.joints[i].idx_v: str(model.names[i]) for i in range(1, model.njoints)}
    return [owners[k] for k in outside.tolist() if k in owners]


def _explain_open_loops(robot: Robot, best: Closing, movable: Indices, beyond: list[str]) -> str:
    turns = closure_turns(robot)
    owners = [closure.name for closure in robot.closures for _ in closure.rows]
    worst = int(np.abs(closure_row_units(robot) * best.residual).argmax())
    own = np.array([owner == owners[worst] for owner in owners])
    # lengths of the two vectors, which are the same in the axes of any frame
    lengths = [float(np.linalg.norm(best.residual[own & part])) for part in (~turns, turns)]
    opening = describe_opening(lengths, [False, True])
    closure = robot.closures[list(dict.fromkeys(owners)).index(owners[worst])]
    moved = ", with its drives moved too," if movable.size else ""
    broken = f" (one closes beyond the limits of {', '.join(beyond)})" if beyond else ""
    return (
        f"its loops do not close in any posture that was found{moved} within the limits of its "
        f"joints: the best leaves '{closure.frame_a}' and '{closure.frame_b}' apart by {opening}"
        f"{broken}; "
        "set orthocal.drives.<motor>.zero_mm (or zero_deg) and orthocal.passive_start near a "
        "posture that closes"
    )


def _starts(robot: Robot, start: Array, free: Indices) -> Iterator[Array]:
    """The start itself, and others around it in which the free coordinates differ."""
    yield start
    draw = np.random.default_rng(0)
    spread = SPREAD * _reach(robot)
    effort = MAX_STEPS * robot.closure_rows * robot.model.nv**2
    for _ in range(min(TRIES - 1, int(WORK / max(effort, 1)))):
        shift = np.zeros(len(start))
        shift[free] = draw.normal(size=free.size)
        yield start + spread * shift


def _close(robot: Robot, start: Array, free: Indices, *, limited: bool = True) -> Closing:
    """Close by the free coordinates, within their limits or not; the result has all of them."""
    lower, upper = coordinate_limits(robot)
    if not limited:
        lower, upper = np.full(lower.shape, -np.inf), np.full(upper.shape, np.inf)
    data = robot.model.createData()

    def complete(part: Array) -> Array:
        coordinates = np.array(start)
        coordinates[free] = part
        return coordinates

    def evaluate(part: Array) -> tuple[Array, Array]:
        residual, jacobian = robot.evaluate_constraints_at(complete(part), data=data)
        return residual, jacobian[:, free]

    found = close_loops(
        evaluate,
        start[free],
        row_units=closure_row_units(robot),
        units=coordinate_units(robot)[free],
        bounds=(lower[free], upper[free]),
    )
    return Closing(complete(found.coordinates), found.residual)


def _return_drives(robot: Robot, found: Closing, movable: Indices, wanted: Array) -> Closing:
    """Bring moved drives back towards where they were wanted, with the loops closed.

    Each step goes along the motions that leave the loops closed to first order, as far as brings
    the drives nearest, and is closed again.
    """
    reach = _reach(robot)
    values = _singular_values(robot, found)
    last = int((values > RANK).sum()) - 1  # rows that repeat others have none anywhere
    clear = CLEAR * values[last]

    def is_clear(closing: Closing) -> bool:
        return bool(_singular_values(robot, closing)[last] >= clear)

    free = np.concatenate([movable, robot.passive_index])

    def missing(closing: Closing) -> Array:
        return np.asarray((wanted - closing.coordinates)[movable] / reach[movable])

    size = 1.0
    for _ in range(MAX_RETURNS):
        _, jacobian = robot.evaluate_constraints_at(found.coordinates)
        motions = _null_space(jacobian[:, free] * reach[free])
        share = np.linalg.lstsq(motions[: movable.size], missing(found), rcond=1e-6)[0]
        step = motions @ share
        step *= size * min(1.0, LARGEST_RETURN / max(float(np.abs(step).max()), 1e-300))
        trial = np.array(found.coordinates)
        trial[free] += step * reach[free]
        closed = _close(robot, trial, free)
        left, before = (float(np.linalg.norm(missing(c))) for c in (closed, found))
        nearer = closed.closed and left < (1.0 - LEAST_GAIN) * before
        if nearer and is_clear(closed):
            found, size = closed, min(1.0, 2.0 * size)
        elif size < 0.01:
            break
        else:
            size *= 0.25
    trial, near = np.array(found.coordinates), movable[np.abs(missing(found)) < NEAR]
    trial[near] = wanted[near]
    closed = _close(robot, trial, np.setdiff1d(free, near))
    return closed if closed.closed and is_clear(closed) else found


def _singular_values(robot: Robot, closing: Closing) -> Array:
    """Singular values of the closures by the passive motions, relative to the largest."""
    _, jacobian = robot.evaluate_constraints_at(closing.coordinates)
    scaled = closure_row_units(robot)[:, None] * jacobian / coordinate_units(robot)
    values = np.linalg.svd(scaled[:, robot.passive_index], compute_uv=False)
    return np.asarray(values / max(float(values.max(initial=0.0)), 1e-300))


def _reach(robot: Robot) -> Array:
    """Scale of each coordinate, shape (nv,): 1 rad or the characteristic length."""
    units = coordinate_units(robot)
    return np.where(units == 1.0, robot.characteristic_length, 1.0)


def _null_space(matrix: Array) -> Array:
    """Orthonormal columns that a matrix takes to 0."""
    _, values, right = np.linalg.svd(matrix)
    rank = int((values > RANK * values.max(initial=0.0)).sum())
    return np.asarray(right[rank:].T)


def _without_turns(robot: Robot, coordinates: Array) -> Array:
    """Without whole turns of passive joints that have no limits; at most half a turn is left."""
    lower, upper = coordinate_limits(robot)
    turned = np.array(coordinates)
    for i in range(1, robot.model.njoints):
        joint = robot.model.joints[i]
        k = joint.idx_v
        endless = joint.nv == 1 and lower[k] == -np.inf and upper[k] == np.inf
        if endless and joint_turns(robot.model, i) and k in robot.passive_index:
            turned[k] -= 2.0 * np.pi * np.round(turned[k] / (2.0 * np.pi))
    return turned
