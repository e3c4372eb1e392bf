"""Workspace of a robot: the region over which errors at the tool are reported.

The workspace is a box relative to the mechanical zero, represented by points with quadrature
weights. Errors over it are reported in three ways: absolute, with the mean translation removed, or
aligned. Aligned errors have the best-fit translation and rotation removed, because a workpiece is
aligned on the machine. `reachable_box` finds the box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.errors import ClosureError
from orthocal.io.fields import read_only
from orthocal.kinematics.continuation import Failures, label_postures
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.robot.model import Robot, require_tcp
from orthocal.units import MM

DEFAULT_HALF_SIDE = 0.06
"""Half the side of the largest default cube, [m]."""

POINTS_PER_SIDE = 5
"""Number of nodes per side of a quadrature grid."""

CELLS_PER_SIDE = 12
"""Number of cells per side of the uniform grid from which percentiles are computed."""

BED_SLACK = 1e-6
"""Rounding error by which the tool may be below a bed, [m]."""

FEWEST_ALIGNED = 4
"""Smallest number of points for which a rotation is removed. With fewer points it would absorb most
of the errors."""


@dataclass(frozen=True, slots=True, eq=False)
class Workspace:
    """Points that represent a region, with the weights of a quadrature rule."""

    points: Array
    """Tool positions in the commanded coordinates, shape (K, n_coordinates), [m]."""
    weights: Array
    """Quadrature weights with the sum 1, shape (K,)."""
    box: Array | None = None
    """Limits relative to the mechanical zero, shape (n_coordinates, 2), [m]; None if the points
    represent no box."""
    nodes: Array | None = None
    """Nodes along each side, from -1 to 1, shape (n,); None unless the points form a grid."""
    letters: str = "xyz"
    """Names of the coordinates."""
    requested: Array | None = None
    """Box in the robot's YAML if the machine does not reach all of it, [m]."""
    n_conditions: int = 1
    """Number of conditions of use for which the points are repeated."""

    @classmethod
    def even(cls, points: ArrayLike) -> Workspace:
        """Region of points with equal weights.

        Args:
            points: Tool positions, shape (K, n_coordinates), [m].

        Raises:
            ValueError: If there is no point.
        """
        p = read_only(np.atleast_2d(np.asarray(points, dtype=np.float64)))
        if p.ndim != 2 or not p.size:
            raise ValueError(f"found the shape {p.shape}; expected points, (K, n_coordinates)")
        return cls(p, read_only(np.full(len(p), 1.0 / len(p))))

    def repeat(self, count: int) -> Workspace:
        """Repeat the points for several equally likely conditions of use.

        Tool errors over them have a common alignment: a workpiece is aligned once.
        """
        if count == 1:
            return self
        points, weights = np.tile(self.points, (count, 1)), np.tile(self.weights, count) / count
        return replace(
            self,
            points=read_only(points),
            weights=read_only(weights),
            n_conditions=self.n_conditions * count,
        )

    def once(self, count: int) -> Workspace:
        """Workspace before `repeat`, by which its points were repeated `count` times."""
        first = len(self.points) // count
        return replace(
            self,
            points=self.points[:first],
            weights=read_only(self.weights[:first] * count),
            n_conditions=self.n_conditions // count,
        )

    @property
    def limits(self) -> Array:
        """Limits of the box, shape (n_coordinates, 2), [m].

        Raises:
            ValueError: If the points represent no box.
        """
        if self.box is None:
            raise ValueError(f"found {self.words}; expected a box")
        return self.box

    @property
    def half_side(self) -> float | None:
        """Half the side of a cube around the mechanical zero, [m]; None for other regions."""
        return None if self.box is None else _cube_half_side(self.box)

    @property
    def words(self) -> str:
        """Description of the region, such as "the workspace ±60 mm"."""
        if self.box is None:
            return f"{len(self.points) // self.n_conditions} points"
        text = f"the workspace {describe_box(self.box, self.letters)}"
        if self.requested is not None:
            text += f" (the machine does not reach {describe_box(self.requested, self.letters)})"
        return text

    def interpolate_to_cells(self, field: Array) -> tuple[Array, Array]:
        """Interpolate a field by polynomials to the centres of equal cells of the box.

        Args:
            field: Values at the points, shape (K, ...).

        Returns:
            Values at the centres, shape (M, ...), and their equal weights, shape (M,). If the
            points form no grid, these are the field itself and the weights of its points.
        """
        if self.nodes is None:
            return field, self.weights
        n, count = self.nodes.size, self.points.shape[1]
        cells = (2.0 * np.arange(CELLS_PER_SIDE) + 1.0) / CELLS_PER_SIDE - 1.0
        at_nodes, at_cells = (
            np.polynomial.legendre.legvander(x, n - 1) for x in (self.nodes, cells)
        )
        interpolation = at_cells @ np.linalg.inv(at_nodes)
        # shapes: (n_conditions, n^count, components), then (n, ..., n, n_conditions components)
        by_condition = field.reshape(self.n_conditions, n**count, -1)
        values = np.moveaxis(by_condition, 0, 1).reshape(*[n] * count, -1)
        for _ in range(count):  # interpolate along the first axis, then make it the last one
            values = np.moveaxis(np.tensordot(interpolation, values, axes=1), 0, count - 1)
        size = CELLS_PER_SIDE**count * self.n_conditions
        return values.reshape(size, *field.shape[1:]), np.full(size, 1.0 / size)

    def remove_translation(self, field: Array) -> Array:
        """Position errors with the mean translation removed.

        Args:
            field: Position errors, shape (K, 3, ...), [m].
        """
        return np.asarray(field - np.tensordot(self.weights, field, axes=1))

    def align(self, field: Array, positions: Array) -> Array:
        """Position errors after aligning a workpiece: translation and rotation removed.

        With fewer than FEWEST_ALIGNED points only the translation is removed.

        Args:
            field: Position errors, shape (K, 3, ...), [m].
            positions: Positions of the points in space, shape (K, 3), [m].
        """
        if len(positions) < FEWEST_ALIGNED:
            return self.remove_translation(field)
        return self.remove_motion(field, positions)

    def remove_motion(self, field: Array, positions: Array) -> Array:
        """Position errors with the best-fit translation and rotation removed.

        To first order: d − a − b × p, with a and b from weighted least squares.

        Args:
            field: Position errors d, shape (K, 3, ...), [m].
            positions: Positions of the points in space, shape (K, 3), [m].
        """
        lever_arms = positions - self.weights @ positions
        motions = np.zeros((len(lever_arms), 3, 6))
        motions[:, :, :3] = np.eye(3)
        for k in range(3):
            motions[:, :, 3 + k] = np.cross(np.eye(3)[k], lever_arms)
        length = max(float(np.abs(lever_arms).max()), 1e-300)  # makes rotations lengths
        basis = motions.reshape(-1, 6) / np.array([1.0] * 3 + [length] * 3)
        root = np.sqrt(np.repeat(self.weights, 3))[:, None]
        flat = field.reshape(3 * len(field), -1)
        motion = np.linalg.pinv(root * basis, rcond=1e-9) @ (root * flat)
        return np.asarray((flat - basis @ motion).reshape(field.shape))


def box_workspace(
    robot: Robot, box: ArrayLike, *, points_per_side: int = POINTS_PER_SIDE
) -> Workspace:
    """Workspace of a box with a Gauss-Lobatto grid, which includes faces and corners.

    Means of polynomials of degree 2 n − 3 in each coordinate are exact.

    Args:
        robot: The robot.
        box: Limits relative to the mechanical zero, shape (n_coordinates, 2), [m].
        points_per_side: n, an odd number of at least 3.
    """
    limits, nodes = read_only(box), _lobatto_points(points_per_side)
    legendre = np.polynomial.legendre.Legendre.basis(points_per_side - 1)
    node_weights = 1.0 / (points_per_side * (points_per_side - 1) * legendre(nodes) ** 2)
    points = grid_points(*[nodes] * len(limits))
    weights = grid_points(*[node_weights] * len(limits)).prod(axis=1)
    return Workspace(
        read_only(_scale_to(limits, points, robot)),
        read_only(weights),
        limits,
        read_only(nodes),
        coordinate_letters(robot),
    )


def cube(
    robot: Robot,
    *,
    half_side: float = DEFAULT_HALF_SIDE,
    points_per_side: int = POINTS_PER_SIDE,
) -> Workspace:
    """Workspace of a cube around the mechanical zero; of a square for a planar robot.

    Args:
        robot: The robot.
        half_side: Half the side, [m].
        points_per_side: Nodes per side, an odd number of at least 3.
    """
    return box_workspace(robot, cube_limits(robot, half_side), points_per_side=points_per_side)


def cube_limits(robot: Robot, half_side: float = DEFAULT_HALF_SIDE) -> Array:
    """Limits of a cube around the mechanical zero, shape (n_coordinates, 2), [m]."""
    return read_only(np.tile([-half_side, half_side], (tool_at_zero(robot).size, 1)))


def uniform_grid(robot: Robot, box: ArrayLike, *, points_per_side: int) -> Array:
    """Tool positions at equal distances over a box, [m].

    Args:
        robot: The robot.
        box: Limits relative to the mechanical zero, shape (n_coordinates, 2), [m].
        points_per_side: n, at least 2.

    Returns:
        Shape (n^n_coordinates, n_coordinates); the last coordinate varies fastest.
    """
    limits = np.asarray(box, dtype=np.float64)
    points = grid_points(*[np.linspace(-1.0, 1.0, points_per_side)] * len(limits))
    return _scale_to(limits, points, robot)


def gauss_box(robot: Robot, box: ArrayLike) -> Workspace:
    """Workspace of a box with three Gauss points per side, and its corners with weight 0.

    Mean squares of quadratic fields are exact. The largest errors are usually at the corners.

    Args:
        robot: The robot.
        box: Limits relative to the mechanical zero, shape (n_coordinates, 2), [m].
    """
    limits = read_only(box)
    count = len(limits)
    nodes, node_weights = np.polynomial.legendre.leggauss(3)
    weights = grid_points(*[node_weights] * count).prod(axis=1)
    points = np.vstack([grid_points(*[nodes] * count), grid_points(*[[-1.0, 1.0]] * count)])
    weighted = np.append(weights / weights.sum(), np.zeros(2**count))
    return Workspace(
        read_only(_scale_to(limits, points, robot)),
        read_only(weighted),
        limits,
        letters=coordinate_letters(robot),
    )


def tool_at_zero(robot: Robot) -> Array:
    """Commanded tool coordinates at the mechanical zero of the nominal machine, [m].

    Returns:
        Shape (n_coordinates,).

    Raises:
        RobotError: If the robot has no tool centre point.
    """
    return np.asarray(position_at_zero(robot)[list(require_tcp(robot).coordinates)])


def position_at_zero(robot: Robot) -> Array:
    """Tool centre point at the mechanical zero of the nominal machine, in the world frame, [m].

    Returns:
        Shape (3,).

    Raises:
        RobotError: If the robot has no tool centre point.
    """
    position = nominal_closure(robot).tcp(robot.drive_zero, robot.reference_passive)
    return np.asarray(np.round(position, 12) + 0.0)  # no rounding errors, no −0


def find_below_bed(robot: Robot, points: Array, names: Sequence[str] | None = None) -> Failures:
    """Indices of tool positions below the bed, mapped to the reason; empty without a bed.

    Args:
        robot: The robot.
        points: Tool coordinates, shape (K, n_coordinates), [m].
        names: Names of the postures, for messages; by default their numbers.
    """
    if robot.bed is None:
        return {}
    height = require_tcp(robot).coordinates.index(2)
    lowest, labels = tool_at_zero(robot)[height] + robot.bed, label_postures(names, len(points))
    return {
        i: ClosureError(
            f"moves the tool to z {points[i, height] / MM:.4g} mm, below the bed at "
            f"{lowest / MM:.4g} mm",
            posture=labels[i],
        )
        for i in np.flatnonzero(points[:, height] < lowest - BED_SLACK).tolist()
    }


def describe_box(box: Array, letters: str = "xyz") -> str:
    """Limits of a box in mm: "±60 mm" for a cube, else "x ±80, y ±80, z −100…60 mm"."""
    half_side = _cube_half_side(box)
    if half_side is not None:
        return f"±{half_side / MM:.4g} mm"
    return f"{', '.join(map(_describe_range, letters, box))} mm"


def _describe_range(letter: str, limits: Sequence[float]) -> str:
    """Limits of one coordinate in mm, without unit."""
    low, high = (round(v / MM, 6) + 0.0 for v in limits)
    if low == -high:
        return f"{letter} ±{high:.4g}"
    return f"{letter} {low:.4g}…{high:.4g}".replace("-", "−")


def _cube_half_side(box: Array) -> float | None:
    """Half the side of a cube around the mechanical zero, [m]; None for other boxes."""
    half = float(box[0, 1])
    return half if np.allclose(box, [-half, half], rtol=0.0, atol=1e-9) else None


def coordinate_letters(robot: Robot) -> str:
    """Names of the commanded world coordinates of the tool, such as xyz."""
    return "xyz" if robot.tcp is None else "".join("xyz"[c] for c in robot.tcp.coordinates)


def _scale_to(box: Array, points: Array, robot: Robot) -> Array:
    """Map points of [−1, 1]ⁿ to tool positions in a box around the mechanical zero, [m]."""
    centre, half = 0.5 * box.sum(axis=1), 0.5 * (box[:, 1] - box[:, 0])
    return np.asarray(tool_at_zero(robot) + centre + half * points)


def _lobatto_points(count: int) -> Array:
    """Nodes of Lobatto's rule: ±1 and the roots of the Jacobi polynomial P(1,1) of degree n − 2.

    n is the count. The roots are the eigenvalues of the Jacobi matrix, whose squared off-diagonal
    elements are k (k + 2)/((2 k + 1) (2 k + 3)). The import of scipy.special takes too long.
    """
    k = np.arange(1.0, count - 2)
    squares = k * (k + 2.0) / ((2.0 * k + 1.0) * (2.0 * k + 3.0))
    roots = np.linalg.eigvalsh(np.diag(np.sqrt(squares), -1)) if count > 2 else np.empty(0)
    points = np.r_[-1.0, roots, 1.0]
    return np.asarray(0.5 * (points - points[::-1]))  # symmetric, without rounding errors


def grid_points(*lines: ArrayLike) -> Array:
    """Tensor grid of the numbers along each coordinate: points as rows, the last varies fastest."""
    return np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, len(lines))
