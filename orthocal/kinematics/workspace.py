"""Regions of the tool: points that stand for a volume, and what of an error a workpiece sees.

A field of position errors over a region is told three ways: absolute; with the shift that is
common to the region taken out; and with shift and rotation taken out. The last is what matters: a
workpiece is aligned on the machine, and nothing in readings of its legs knows the world's axes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.errors import ClosureError
from orthocal.io.fields import read_only
from orthocal.kinematics.loop_closure import nominal_assembly
from orthocal.robot.model import Robot
from orthocal.units import MM

Array = NDArray[np.float64]

LARGEST_HALF_SIDE = 0.06
"""Half the side of the cube around the mechanical zero that is looked at, at most, [m]."""

SMALLEST_HALF_SIDE = 1e-3
"""A machine whose tool cannot move that far has no region, [m]."""

POINTS_A_SIDE = 5

CELLS_A_SIDE = 12
"""Of a cube, where parts of it that are alike are asked for."""

FEWEST_ALIGNED = 4
"""Points below which a rigid motion leaves nothing of their errors, whatever they are."""


@dataclass(frozen=True, slots=True, eq=False)
class Workspace:
    """Points that stand for a region, with weights that make their mean the region's."""

    points: Array
    """Tool positions in the coordinates that the drives control, shape (K, n_coordinates), [m]."""
    weights: Array
    """Shape (K,), sum 1."""
    half_side: float | None = None
    """Of a cube around the mechanical zero, [m]; None for other points."""
    line: Array | None = None
    """Points of a side, shape (n,), from -1 to 1, where the points are the grid of a cube."""

    @classmethod
    def even(cls, points: ArrayLike) -> Workspace:
        """Points that all count alike, shape (K, n_coordinates), [m]."""
        p = read_only(np.atleast_2d(np.asarray(points, dtype=np.float64)))
        if p.ndim != 2 or not p.size:
            raise ValueError(f"found the shape {p.shape}; expected points, (K, n_coordinates)")
        return cls(p, read_only(np.full(len(p), 1.0 / len(p))))

    @property
    def box(self) -> tuple[tuple[float, float], ...]:
        """Lowest and highest coordinate: about the mechanical zero for a cube, [m]."""
        if self.half_side is not None:
            return ((-self.half_side, self.half_side),) * int(self.points.shape[1])
        ends = zip(self.points.min(axis=0), self.points.max(axis=0), strict=True)
        return tuple((float(low), float(high)) for low, high in ends)

    @property
    def words(self) -> str:
        """What it is: a cube of ±60 mm around the zero."""
        if self.half_side is None:
            return f"{len(self.points)} points"
        shape = {1: "line", 2: "square"}.get(self.points.shape[1], "cube")
        return f"a {shape} of ±{self.half_side / MM:.3g} mm around the zero"

    def spread(self, field: Array) -> tuple[Array, Array]:
        """A field where points stand for equal parts of a cube, by the polynomial through it.

        Args:
            field: Shape (K, ...).

        Returns:
            The field, shape (M, ...), and weights of its points, shape (M,); for points that are no
            grid of a cube as they are.
        """
        if self.line is None:
            return field, self.weights
        n, count = self.line.size, self.points.shape[1]
        cells = (2.0 * np.arange(CELLS_A_SIDE) + 1.0) / CELLS_A_SIDE - 1.0
        known, wanted = (np.polynomial.legendre.legvander(x, n - 1) for x in (self.line, cells))
        between = wanted @ np.linalg.inv(known)
        found = field.reshape(*[n] * count, -1)
        for _ in range(count):  # the side that comes first goes last before the field's own
            found = np.moveaxis(np.tensordot(between, found, axes=1), 0, count - 1)
        size = CELLS_A_SIDE**count
        return found.reshape(size, *field.shape[1:]), np.full(size, 1.0 / size)

    def remove_shift(self, field: Array) -> Array:
        """A field of position errors less its mean, shape (K, 3, ...)."""
        return np.asarray(field - np.tensordot(self.weights, field, axes=1))

    def remove_motion(self, field: Array, positions: Array) -> Array:
        """A field of position errors less the shift and rotation that take most out of it.

        To first order: d − a − b × p, with a and b from weighted least squares.

        Args:
            field: Position errors d, shape (K, 3, ...).
            positions: Of the points in space, shape (K, 3), [m].
        """
        arms = positions - self.weights @ positions
        motions = np.zeros((len(arms), 3, 6))
        motions[:, :, :3] = np.eye(3)
        for k in range(3):
            motions[:, :, 3 + k] = np.cross(np.eye(3)[k], arms)
        size = max(float(np.abs(arms).max()), 1e-300)
        basis = motions.reshape(-1, 6) / np.array([1.0] * 3 + [size] * 3)
        root = np.sqrt(np.repeat(self.weights, 3))[:, None]
        flat = field.reshape(3 * len(field), -1)
        motion = np.linalg.lstsq(root * basis, root * flat, rcond=1e-9)[0]
        return np.asarray((flat - basis @ motion).reshape(field.shape))


def cube(
    robot: Robot,
    *,
    half_side: float = LARGEST_HALF_SIDE,
    points_a_side: int = POINTS_A_SIDE,
) -> Workspace:
    """A cube around the mechanical zero: a grid by Lobatto's rule, faces and corners included.

    Means of polynomials of a degree of 2 n - 3 along each side are exact.

    Args:
        robot: The robot; a planar one has a square.
        half_side: Half the side, [m].
        points_a_side: n, an odd number of at least 3.
    """
    middle, line = tool_at_zero(robot), _lobatto_points(points_a_side)
    legendre = np.polynomial.legendre.Legendre.basis(points_a_side - 1)
    own = 1.0 / (points_a_side * (points_a_side - 1) * legendre(line) ** 2)
    points, weights = _grid(line, middle.size), _grid(own, middle.size).prod(axis=1)
    return Workspace(
        read_only(middle + half_side * points), read_only(weights), half_side, read_only(line)
    )


def even_grid(robot: Robot, *, half_side: float, points_a_side: int) -> Array:
    """Tool positions at even distances over a cube around the mechanical zero, [m].

    Args:
        robot: The robot; a planar one has a square.
        half_side: Half the side, [m].
        points_a_side: n, at least 2.

    Returns:
        Shape (n^n_coordinates, n_coordinates), the last coordinate changing first.
    """
    middle = tool_at_zero(robot)
    line = np.linspace(-half_side, half_side, points_a_side)
    return np.asarray(middle + _grid(line, middle.size))


def _lobatto_points(count: int) -> Array:
    """Nodes of Lobatto's rule: ±1 and the roots of the Jacobi polynomial P(1,1) of degree n-2."""
    from scipy.special import roots_jacobi

    inner = roots_jacobi(count - 2, 1.0, 1.0)[0] if count > 2 else np.zeros(0)
    points = np.r_[-1.0, inner, 1.0]
    return np.asarray(0.5 * (points - points[::-1]))  # the same on both sides, without rounding


def _grid(line: Array, count: int) -> Array:
    """All points with coordinates in a line, shape (n^count, count), the last changing first."""
    return np.stack(np.meshgrid(*[line] * count, indexing="ij"), axis=-1).reshape(-1, count)


def gauss_cube(robot: Robot, *, half_side: float) -> Workspace:
    """A cube around the mechanical zero by few points: three Gauss points a side, and its corners.

    Mean squares of fields that bend as parabolas are exact; corners count nothing in a mean, but
    are where errors are largest.

    Args:
        robot: The robot; a planar one has a square.
        half_side: Half the side, [m].
    """
    middle = tool_at_zero(robot)
    count = middle.size
    nodes, own = np.polynomial.legendre.leggauss(3)
    weights = _grid(own, count).prod(axis=1)
    points = np.vstack([_grid(nodes, count), _grid(np.array([-1.0, 1.0]), count)])
    counted = np.append(weights / weights.sum(), np.zeros(2**count))
    return Workspace(read_only(middle + half_side * points), read_only(counted), half_side)


def tool_at_zero(robot: Robot) -> Array:
    """Coordinates of the tool that the drives control, in the nominal mechanical zero, [m].

    Raises:
        RobotError: If the robot has no tool centre point.
    """
    passive = robot.zero[robot.passive_index]
    position = nominal_assembly(robot).tcp(robot.drive_zero, passive)
    coordinates = () if robot.tcp is None else robot.tcp.coordinates
    return np.asarray(np.round(position[list(coordinates)], 12) + 0.0)  # the zero without rounding


def largest_cube(robot: Robot, reach: Callable[[Array], object]) -> Workspace | None:
    """The largest cube around the mechanical zero that a machine reaches, at most ±60 mm.

    Args:
        robot: The robot.
        reach: Raises ClosureError where points, shape (K, n_coordinates), are out of reach.

    Returns:
        None for a machine whose tool hardly moves. Sizes are whole millimetres, small ones of two
        digits.
    """

    def fits(half_side: float, points_a_side: int) -> bool:
        try:
            reach(cube(robot, half_side=half_side, points_a_side=points_a_side).points)
        except ClosureError:
            return False
        return True

    if fits(LARGEST_HALF_SIDE, POINTS_A_SIDE):
        return cube(robot)
    low, high = 0.0, LARGEST_HALF_SIDE
    while high - low > 0.004 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle, 3) else (low, middle)
        if high < SMALLEST_HALF_SIDE:
            return None
    half_side = _round_down(high)
    while not fits(half_side, POINTS_A_SIDE):
        half_side = _round_down(half_side - 1e-6)
        if half_side < SMALLEST_HALF_SIDE:
            return None
    return cube(robot, half_side=half_side)


def _round_down(length: float) -> float:
    """To whole millimetres, or to tenths below ten, [m]."""
    step = 1e-3 if length >= 10e-3 else 1e-4
    return round(math.floor(length / step + 1e-9) * step, 6)
