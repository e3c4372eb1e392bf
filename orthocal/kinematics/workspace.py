"""Workspace of a robot: the region over which errors at the tool are reported.

The workspace is a box relative to the mechanical zero: the one in the robot's YAML, or the largest
cube of at most ±60 mm that the machine reaches. It is represented by points with quadrature
weights. Errors over it are reported in three ways: absolute; with the common translation removed;
with translation and rotation removed, because a workpiece is aligned on the machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.errors import ClosureError, RobotError
from orthocal.io.fields import read_only
from orthocal.kinematics.function_cache import cached_per_robot
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.kinematics.sensitivity import ToolSensitivity
from orthocal.robot.model import Robot, require_commanded_tool
from orthocal.units import MM

LARGEST_HALF_SIDE = 0.06
"""Half the side of the default cube, [m]; less where the machine does not reach it."""

SMALLEST_HALF_SIDE = 1e-3
"""A machine whose tool cannot move that far has no workspace, [m]."""

POINTS_A_SIDE = 5

CELLS_A_SIDE = 12
"""Cells per side of the regular grid from which percentiles are computed."""

FEWEST_ALIGNED = 4
"""Number of points below which removing a rigid motion removes all errors."""

ROOM = 1.08
"""Factor by which the nominal machine must reach further than the default cube."""

NEARLY_SINGULAR = 10.0
"""Largest condition number of the tool's Jacobian by the drives in a workspace."""


@dataclass(frozen=True, slots=True, eq=False)
class Workspace:
    """Points that represent a region, with the weights of a quadrature rule."""

    points: Array
    """Tool positions in the coordinates that the drives control, shape (K, n_coordinates), [m]."""
    weights: Array
    """Shape (K,), sum 1."""
    box: Array | None = None
    """Limits relative to the mechanical zero, shape (n_coordinates, 2), [m]; None for points that
    represent no box."""
    line: Array | None = None
    """Nodes along each side, shape (n,), from -1 to 1; None for points that are no grid."""
    letters: str = "xyz"
    """Names of the coordinates."""
    requested: Array | None = None
    """Box in the robot's YAML where the machine does not reach all of it, [m]."""
    copies: int = 1
    """Number of times that the points are repeated: once for each of several conditions."""

    @classmethod
    def even(cls, points: ArrayLike) -> Workspace:
        """Points with equal weights, shape (K, n_coordinates), [m]."""
        p = read_only(np.atleast_2d(np.asarray(points, dtype=np.float64)))
        if p.ndim != 2 or not p.size:
            raise ValueError(f"found the shape {p.shape}; expected points, (K, n_coordinates)")
        return cls(p, read_only(np.full(len(p), 1.0 / len(p))))

    def repeat(self, count: int) -> Workspace:
        """The points once for each of several equally likely conditions.

        Tool errors over them have a common alignment: a workpiece is aligned once.
        """
        if count == 1:
            return self
        points, weights = np.tile(self.points, (count, 1)), np.tile(self.weights, count) / count
        return replace(
            self, points=read_only(points), weights=read_only(weights), copies=self.copies * count
        )

    def once(self, count: int) -> Workspace:
        """Inverse of `repeat`."""
        first = len(self.points) // count
        return replace(
            self,
            points=self.points[:first],
            weights=read_only(self.weights[:first] * count),
            copies=self.copies // count,
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
        return None if self.box is None else _find_half_side(self.box)

    @property
    def words(self) -> str:
        """Region in words: the workspace ±60 mm."""
        if self.box is None:
            return f"{len(self.points) // self.copies} points"
        text = f"the workspace {describe_box(self.box, self.letters)}"
        if self.requested is not None:
            text += f" (the machine does not reach {describe_box(self.requested, self.letters)})"
        return text

    def spread(self, field: Array) -> tuple[Array, Array]:
        """Interpolate a field by polynomials to the centres of equal cells of the box.

        Args:
            field: Shape (K, ...).

        Returns:
            The field, shape (M, ...), and the weights, shape (M,); for points that are no grid the
            field itself.
        """
        if self.line is None:
            return field, self.weights
        n, count, copies = self.line.size, self.points.shape[1], self.copies
        cells = (2.0 * np.arange(CELLS_A_SIDE) + 1.0) / CELLS_A_SIDE - 1.0
        at_nodes, at_cells = (
            np.polynomial.legendre.legvander(x, n - 1) for x in (self.line, cells)
        )
        interpolation = at_cells @ np.linalg.inv(at_nodes)
        fields = field.reshape(copies, n**count, -1)
        values = np.moveaxis(fields, 0, 1).reshape(*[n] * count, -1)
        for _ in range(count):  # interpolate along the first axis, then make it the last one
            values = np.moveaxis(np.tensordot(interpolation, values, axes=1), 0, count - 1)
        size = CELLS_A_SIDE**count * copies
        return values.reshape(size, *field.shape[1:]), np.full(size, 1.0 / size)

    def remove_shift(self, field: Array) -> Array:
        """Position errors with the mean translation removed, shape (K, 3, ...)."""
        return np.asarray(field - np.tensordot(self.weights, field, axes=1))

    def align(self, field: Array, positions: Array) -> Array:
        """Position errors after aligning a workpiece: translation and rotation removed.

        With few points only the translation is removed.

        Args:
            field: Position errors, shape (K, 3, ...), [m].
            positions: Positions of the points in space, shape (K, 3), [m].
        """
        if len(positions) < FEWEST_ALIGNED:
            return self.remove_shift(field)
        return self.remove_motion(field, positions)

    def remove_motion(self, field: Array, positions: Array) -> Array:
        """Position errors with the best-fit translation and rotation removed.

        To first order: d − a − b × p, with a and b from weighted least squares.

        Args:
            field: Position errors d, shape (K, 3, ...), [m].
            positions: Positions of the points in space, shape (K, 3), [m].
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
        motion = np.linalg.pinv(root * basis, rcond=1e-9) @ (root * flat)
        return np.asarray((flat - basis @ motion).reshape(field.shape))


def box_workspace(robot: Robot, box: ArrayLike, *, points_a_side: int = POINTS_A_SIDE) -> Workspace:
    """Box as a grid by Lobatto's rule, faces and corners included.

    Means of polynomials of degree 2 n - 3 along each side are exact.

    Args:
        robot: The robot.
        box: Limits relative to the mechanical zero, shape (n_coordinates, 2), [m].
        points_a_side: n, an odd number of at least 3.
    """
    limits, line = _limits(box), _lobatto_points(points_a_side)
    legendre = np.polynomial.legendre.Legendre.basis(points_a_side - 1)
    node_weights = 1.0 / (points_a_side * (points_a_side - 1) * legendre(line) ** 2)
    points = grid_points(line, len(limits))
    weights = grid_points(node_weights, len(limits)).prod(axis=1)
    return Workspace(
        read_only(_scale_to(limits, points, tool_at_zero(robot))),
        read_only(weights),
        limits,
        read_only(line),
        coordinate_letters(robot),
    )


def cube(
    robot: Robot,
    *,
    half_side: float = LARGEST_HALF_SIDE,
    points_a_side: int = POINTS_A_SIDE,
) -> Workspace:
    """Cube around the mechanical zero, as `box_workspace`; a square for a planar robot.

    Args:
        robot: The robot.
        half_side: Half the side, [m].
        points_a_side: Nodes per side, an odd number of at least 3.
    """
    return box_workspace(robot, cube_limits(robot, half_side), points_a_side=points_a_side)


def cube_limits(robot: Robot, half_side: float = LARGEST_HALF_SIDE) -> Array:
    """Limits of a cube around the mechanical zero, shape (n_coordinates, 2), [m]."""
    return read_only(np.tile([-half_side, half_side], (tool_at_zero(robot).size, 1)))


def even_grid(robot: Robot, box: ArrayLike, *, points_a_side: int) -> Array:
    """Tool positions at even distances over a box, [m].

    Args:
        robot: The robot.
        box: Limits relative to the mechanical zero, shape (n_coordinates, 2), [m].
        points_a_side: n, at least 2.

    Returns:
        Shape (n^n_coordinates, n_coordinates), the last coordinate changing first.
    """
    limits = np.asarray(box, dtype=np.float64)
    points = grid_points(np.linspace(-1.0, 1.0, points_a_side), len(limits))
    return _scale_to(limits, points, tool_at_zero(robot))


def gauss_box(robot: Robot, box: ArrayLike) -> Workspace:
    """Box by few points: three Gauss points per side, and its corners.

    Mean squares of fields of second degree are exact. Corners have no weight in a mean, but the
    largest errors are there.

    Args:
        robot: The robot.
        box: Limits relative to the mechanical zero, shape (n_coordinates, 2), [m].
    """
    limits = _limits(box)
    count = len(limits)
    nodes, node_weights = np.polynomial.legendre.leggauss(3)
    weights = grid_points(node_weights, count).prod(axis=1)
    points = np.vstack([grid_points(nodes, count), grid_points(np.array([-1.0, 1.0]), count)])
    weighted = np.append(weights / weights.sum(), np.zeros(2**count))
    return Workspace(
        read_only(_scale_to(limits, points, tool_at_zero(robot))),
        read_only(weighted),
        limits,
        letters=coordinate_letters(robot),
    )


def find_workspace(robot: Robot, reach: Callable[[Array], object] | None = None) -> Workspace:
    """Workspace of a robot, or of a machine that must reach it.

    The box in the robot's YAML, or the largest cube of at most ±60 mm that the nominal machine
    reaches; a smaller box of the same shape where the machine does not reach that one. Its largest
    side is a whole number of millimetres, or has two digits below 10 mm.

    Args:
        robot: The robot.
        reach: Raises ClosureError where the machine does not reach points, shape
            (K, n_coordinates), [m]. By default the nominal machine must reach them: a box in the
            YAML entirely, the default cube with 8 % to spare, because other machines of these
            dimensions reach less.

    Raises:
        RobotError: If the drives do not command the tool; by default also if the nominal machine
            does not reach the box in the YAML.
        ClosureError: If the tool hardly moves.
    """
    require_commanded_tool(robot)
    if reach is not None:
        box = _default_workspace(robot).limits if robot.workspace is None else robot.workspace
        reached = _largest_box(robot, box, reach)
        complete = robot.workspace is None or reached.box is robot.workspace
        return reached if complete else replace(reached, requested=robot.workspace)
    if robot.workspace is None:
        return _default_workspace(robot)
    problem = find_unreached(robot, robot.workspace)
    if problem:
        raise RobotError(problem, where=f"{robot.yaml}: orthocal.workspace.box_mm")
    return box_workspace(robot, robot.workspace)


@cached_per_robot(maxsize=8)
def _default_workspace(robot: Robot) -> Workspace:
    """Largest cube of at most ±60 mm that the nominal machine reaches with room to spare."""
    middle, reach = tool_at_zero(robot), nominal_reach(robot)
    return _largest_box(
        robot, cube_limits(robot), lambda points: reach(middle + ROOM * (points - middle))
    )


def find_unreached(robot: Robot, box: Array) -> str:
    """Reason why the nominal machine does not reach a box, with the largest one of its shape.

    Args:
        robot: The robot.
        box: Limits relative to the mechanical zero, shape (n_coordinates, 2), [m].

    Returns:
        "" where it reaches the box.
    """
    reach, letters = nominal_reach(robot), coordinate_letters(robot)
    try:
        reach(box_workspace(robot, box).points)
    except ClosureError as e:
        text = f"the machine does not reach the workspace {describe_box(box, letters)} ({e.reason})"
    else:
        return ""
    try:
        largest = _largest_box(robot, box, reach).limits
    except ClosureError:
        return f"{text}; it reaches none of this shape"
    return f"{text}; it reaches {describe_box(largest, letters)}"


def nominal_reach(robot: Robot) -> Callable[[Array], None]:
    """Check of tool positions on the nominal machine: it raises ClosureError out of reach.

    Positions must be within the travel of the drives and away from singularities.
    """
    lower = np.array([d.lower for d in robot.drives])
    upper = np.array([d.upper for d in robot.drives])
    moved = list(require_commanded_tool(robot))
    sensitivity = ToolSensitivity(robot, free=[f"{d.name}.offset" for d in robot.drives])

    def reach(points: Array) -> None:
        drives, passive = nominal_closure(robot).reach(points)
        if (drives < lower).any() or (drives > upper).any():
            raise ClosureError("is beyond the travel of a drive", posture="a corner")
        if (np.linalg.cond(sensitivity(drives, passive=passive)[:, moved]) > NEARLY_SINGULAR).any():
            raise ClosureError("is nearly singular", posture="a corner")

    return reach


def tool_at_zero(robot: Robot) -> Array:
    """Coordinates of the tool that the drives control, in the nominal mechanical zero, [m].

    Raises:
        RobotError: If the robot has no tool centre point.
    """
    coordinates = () if robot.tcp is None else robot.tcp.coordinates
    return np.asarray(position_at_zero(robot)[list(coordinates)])


def position_at_zero(robot: Robot) -> Array:
    """Tool centre point in the nominal mechanical zero, in the world, shape (3,), [m].

    Raises:
        RobotError: If the robot has no tool centre point.
    """
    position = nominal_closure(robot).tcp(robot.drive_zero, robot.reference_passive)
    return np.asarray(np.round(position, 12) + 0.0)  # the zero without rounding


def describe_box(box: Array, letters: str = "xyz") -> str:
    """Box in words, in mm: "±60 mm" for a cube, else "x ±80, y ±80, z −100…60 mm"."""
    half_side = _find_half_side(box)
    if half_side is not None:
        return f"±{half_side / MM:.4g} mm"
    return f"{', '.join(map(_describe_range, letters, box))} mm"


def _describe_range(letter: str, limits: Sequence[float]) -> str:
    low, high = (round(v / MM, 6) + 0.0 for v in limits)
    if low == -high:
        return f"{letter} ±{high:.4g}"
    return f"{letter} {low:.4g}…{high:.4g}".replace("-", "−")


def _find_half_side(box: Array) -> float | None:
    half = float(box[0, 1])
    return half if np.allclose(box, [-half, half], rtol=0.0, atol=1e-9) else None


def _largest_box(robot: Robot, box: Array, reach: Callable[[Array], object]) -> Workspace:
    """Largest box of the shape of another one, at most as large, that a machine reaches.

    It shrinks towards the mechanical zero, or towards the nearest point of the box to it.

    Raises:
        ClosureError: If the machine reaches none.
    """
    fixed = np.clip(0.0, box[:, 0], box[:, 1])[:, None]
    largest = float(np.abs(box - fixed).max())

    def scaled(size: float) -> Array:
        return box if size == largest else read_only(fixed + (box - fixed) * (size / largest))

    def fits(size: float, points_a_side: int) -> bool:
        try:
            reach(box_workspace(robot, scaled(size), points_a_side=points_a_side).points)
        except ClosureError:
            return False
        return True

    if fits(largest, POINTS_A_SIDE):
        return box_workspace(robot, box)
    low, high = 0.0, largest
    while high - low > 0.004 * high and high >= SMALLEST_HALF_SIDE:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle, 3) else (low, middle)
    size = _round_down(high)
    while size >= SMALLEST_HALF_SIDE and not fits(size, POINTS_A_SIDE):
        size = _round_down(size - 1e-6)
    if size < SMALLEST_HALF_SIDE:
        raise ClosureError(
            "cannot be reached: there is no region around it, not even of a millimetre, that the "
            "machine reaches within its limits",
            posture="mechanical zero",
        )
    return box_workspace(robot, scaled(size))


def coordinate_letters(robot: Robot) -> str:
    """Names of the world coordinates of the tool that the drives command, such as xyz."""
    return "xyz" if robot.tcp is None else "".join("xyz"[c] for c in robot.tcp.coordinates)


def _limits(box: ArrayLike) -> Array:
    """Read-only limits; the same array where they are read-only already."""
    limits = np.asarray(box, dtype=np.float64)
    return read_only(limits) if limits.flags.writeable else limits


def _scale_to(box: Array, points: Array, zero: Array) -> Array:
    """Tool positions of points of a box of ±1, [m]."""
    centre, half = 0.5 * box.sum(axis=1), 0.5 * (box[:, 1] - box[:, 0])
    return np.asarray(zero + centre + half * points)


def _lobatto_points(count: int) -> Array:
    """Nodes of Lobatto's rule: ±1 and the roots of the Jacobi polynomial P(1,1) of degree n-2.

    The roots are the eigenvalues of the Jacobi matrix, whose squared off-diagonal elements are
    k (k + 2) / ((2 k + 1) (2 k + 3)).
    """
    k = np.arange(1.0, count - 2)
    squares = k * (k + 2.0) / ((2.0 * k + 1.0) * (2.0 * k + 3.0))
    roots = np.linalg.eigvalsh(np.diag(np.sqrt(squares), -1)) if count > 2 else np.empty(0)
    points = np.r_[-1.0, roots, 1.0]
    return np.asarray(0.5 * (points - points[::-1]))  # symmetric, without rounding errors


def grid_points(line: Array, count: int) -> Array:
    """All points with coordinates in a line, shape (n^count, count), the last changing first."""
    return np.stack(np.meshgrid(*[line] * count, indexing="ij"), axis=-1).reshape(-1, count)


def _round_down(length: float) -> float:
    """Length rounded down to whole millimetres, or to tenths below ten, [m]."""
    step = 1e-3 if length >= 10e-3 else 1e-4
    return round(math.floor(length / step + 1e-9) * step, 6)
