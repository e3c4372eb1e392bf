"""Displacement of tool points by the rotation of a tool that turns as it moves."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.kinematics.continuation import Failures
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.kinematics.robot_functions import robot_functions
from orthocal.robot.model import Robot, require_tcp

CONVERGED = 1e-10
"""Change of a position below which the iteration has converged, [m]."""

MAX_ITERATIONS = 60
"""Largest number of iterations. Each multiplies the change by about the distance of the point from
the tool centre point divided by the rod length."""


def rotation_shift(robot: Robot, points: Array, offset: ArrayLike) -> Array:
    """Displacement R t − t of a point of the tool by the rotation R of the tool's frame.

    Args:
        robot: The robot.
        points: Tool coordinates p, shape (n, n_coordinates), [m].
        offset: Position t of the point in the tool's frame, shape (3,), [m].

    Returns:
        Shape (n, n_coordinates), [m]; 0 where the nominal machine does not reach.
    """
    tcp, failures, closure = require_tcp(robot), Failures(), nominal_closure(robot)
    if not np.any(offset):
        return np.zeros_like(points)
    drives, passive = closure.reach(points, failures=failures)
    pose = robot_functions(robot).pose(tcp.frame)
    poses = pose(drives, passive, closure.geometry().placements)[0]
    shift = poses[:, :3, :3] @ np.array(offset) - np.array(offset)
    shift[list(failures)] = 0.0
    return np.asarray(shift[:, list(tcp.coordinates)].round(12))  # 0 without rotation


def place_turning(robot: Robot, points: Array, offset: ArrayLike) -> Array:
    """Tool coordinates p at which a point of the tool is where it would be without rotation.

    The equation p + R(p) t = x + t is solved for p by fixed-point iteration.

    Args:
        robot: The robot.
        points: Coordinates x of the tool without rotation, shape (n, n_coordinates), [m].
        offset: Position t of the point in the tool's frame, shape (3,), [m].

    Returns:
        Shape (n, n_coordinates), [m].
    """
    placed = points
    for _ in range(MAX_ITERATIONS):
        before, placed = placed, points - rotation_shift(robot, placed, offset)
        if np.abs(placed - before).max(initial=0.0) < CONVERGED:
            break
    return placed
