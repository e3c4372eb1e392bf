"""How well the tool's position is known: the number that users decide by.

A machine with errors θ, commanded to a posture, has its tool at p(θ). What is not known of θ
becomes a position error J dθ with J = ∂p/∂θ, passive joints following the loops:

    J = p_θ − p_q g_q⁻¹ g_θ

A shift that is common to the whole workspace is a choice of origin, not an error of the machine: a
workpiece is set up where the tool finds it. So every figure is given twice, absolute and with the
common shift taken out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.errors import RobotError
from orthocal.robot.assembly import Assembly
from orthocal.robot.batch import BatchFunction
from orthocal.robot.model import Robot
from orthocal.robot.slopes import SharedPlacements

Array = NDArray[np.float64]

HALF_SIDE = 0.06
"""Half the side of the cube around the mechanical zero that is looked at by default, [m]."""

POINTS_A_SIDE = 7
DRAWS = 2000
"""Errors drawn to find how large 95 % of the position errors are at most."""


@dataclass(frozen=True, slots=True, eq=False)
class ErrorSize:
    """Size of position errors over a workspace, [m]."""

    rms: float
    """Root mean square over points and over what is not known."""
    percentile_95: float
    """What 95 % of the errors, at any point, stay below."""
    largest: float
    """Root mean square at the worst point."""


@dataclass(frozen=True, slots=True, eq=False)
class ToolUncertainty:
    """Uncertainty of the tool's position over a set of points."""

    points: Array
    """Nominal tool positions, shape (K, 3), [m]."""
    covariance: Array
    """Of the position at each point, shape (K, 3, 3), [m²]."""
    relative_covariance: Array
    """The same with the common shift taken out."""
    absolute: ErrorSize
    relative: ErrorSize
    """With the common shift taken out."""


class ToolSensitivity:
    """∂p/∂θ of the tool at commanded postures.

    Args:
        robot: The nominal robot.
        free: Names of the parameters.
        values: Values of all parameters about which to differentiate, [SI]; 0 where absent.

    Raises:
        RobotError: If the robot has no tool centre point.
    """

    def __init__(
        self, robot: Robot, *, free: Sequence[str], values: Mapping[str, float] | None = None
    ) -> None:
        if robot.tcp is None:
            raise RobotError("has no tool centre point; add orthocal.tcp", where=str(robot.yaml))
        at = dict(values or {})
        self.robot = robot
        self.free = tuple(free)
        self.theta = np.array([at.get(name, 0.0) for name in self.free])
        self.assembly = Assembly(robot, fixed=at)
        theta = ca.SX.sym("theta", len(self.free))
        errors: dict[str, ca.SX | float] = {k: v for k, v in at.items() if k not in self.free}
        errors.update({name: theta[i] for i, name in enumerate(self.free)})
        shared = SharedPlacements(robot, theta, errors)
        drives = ca.SX.sym("drives", len(robot.drives))
        passive = ca.SX.sym("passive", robot.passive_index.size)
        machine = shared.machine(drives=drives, passive=passive)
        frame = robot.frame_id(robot.tcp.frame)
        rows = [shared.position_slopes(machine, frame, ca.SX(np.eye(3)[i]).T) for i in range(3)]
        by_joints, by_theta = (ca.vertcat(*(r[k] for r in rows)) for k in (0, 1))
        g_joints, g_theta = shared.closure_slopes(machine)
        index = robot.passive_index.tolist()
        function = ca.Function(
            "tool_sensitivity",
            [drives, passive, theta, shared.values, shared.slope_nonzeros],
            [by_joints[:, index], by_theta, g_joints[:, index], g_theta],
            ["drives", "passive", "theta", "placements", "slopes"],
            ["p_q", "p_theta", "g_q", "g_theta"],
        )
        self._function = BatchFunction(function, shared=["theta", "placements", "slopes"])
        self._shared = [np.asarray(v.full()).reshape(-1) for v in shared.function(self.theta)]

    def __call__(self, drives: ArrayLike) -> Array:
        """∂p/∂θ at commanded drive coordinates.

        Args:
            drives: Shape (K, n_drives), [m, rad].

        Returns:
            Shape (K, 3, n_free), [m per parameter unit].

        Raises:
            ClosureError: If a posture cannot be reached.
        """
        d = np.atleast_2d(np.asarray(drives, dtype=np.float64))
        passive = self.assembly.close(d)
        p_q, p_theta, g_q, g_theta = self._function(d, passive, self.theta, *self._shared)
        if g_q.shape[1] == g_q.shape[2]:
            slopes = np.linalg.solve(g_q, g_theta)
        else:
            slopes = np.linalg.pinv(g_q, rcond=1e-10) @ g_theta
        return np.asarray(p_theta - p_q @ slopes)


@dataclass(frozen=True, slots=True, eq=False)
class Workspace:
    """Points that stand for a region, with weights that make their mean the region's."""

    points: Array
    """Tool positions in the coordinates that the drives control, shape (K, n_coordinates), [m]."""
    weights: Array
    """Shape (K,), sum 1."""


def cube(
    robot: Robot, *, half_side: float = HALF_SIDE, points_a_side: int = POINTS_A_SIDE
) -> Workspace:
    """A cube around the mechanical zero: a grid with Simpson's weights, faces and corners included.

    Args:
        robot: The robot; a planar one has a square.
        half_side: Half the side, [m].
        points_a_side: An odd number of at least 3.
    """
    count = 3 if robot.tcp is None else len(robot.tcp.coordinates)
    line = np.linspace(-half_side, half_side, points_a_side)
    simpson = np.where(np.arange(points_a_side) % 2 == 1, 4.0, 2.0)
    simpson[[0, -1]] = 1.0
    simpson /= simpson.sum()
    points = np.stack(np.meshgrid(*[line] * count, indexing="ij"), axis=-1).reshape(-1, count)
    weights = np.stack(np.meshgrid(*[simpson] * count, indexing="ij"), axis=-1)
    return Workspace(points, weights.prod(axis=-1).reshape(-1))


def measure_uncertainty(
    jacobian: Array, covariance: Array, workspace: Workspace
) -> ToolUncertainty:
    """Position uncertainty from sensitivities and the covariance of the parameters.

    Args:
        jacobian: ∂p/∂θ at every point, shape (K, 3, n), [m per parameter unit].
        covariance: Of θ, shape (n, n), [SI].
        workspace: The points, and the weights of their mean.
    """
    weights = workspace.weights
    relative = jacobian - np.tensordot(weights, jacobian, axes=1)
    root = _square_root(covariance)
    sizes, covariances = [], []
    for j in (jacobian, relative):
        spread = j @ root
        covariances.append(spread @ spread.transpose(0, 2, 1))
        sizes.append(_error_size(spread, weights))
    return ToolUncertainty(workspace.points, covariances[0], covariances[1], sizes[0], sizes[1])


def _error_size(spread: Array, weights: Array) -> ErrorSize:
    """Sizes of errors spread @ ε with ε standard normal, spread of shape (K, 3, n)."""
    at_point = (spread**2).sum(axis=(1, 2))
    rng = np.random.default_rng(0)
    draws = rng.normal(size=(spread.shape[2], DRAWS))
    lengths = np.linalg.norm(spread @ draws, axis=1)
    order = np.argsort(lengths, axis=None)
    share = np.cumsum(np.broadcast_to(weights[:, None] / DRAWS, lengths.shape).reshape(-1)[order])
    percentile = lengths.reshape(-1)[order][int(np.searchsorted(share, 0.95))]
    return ErrorSize(
        rms=float(np.sqrt(weights @ at_point)),
        percentile_95=float(percentile),
        largest=float(np.sqrt(at_point.max())),
    )


def _square_root(covariance: Array) -> Array:
    """A matrix whose product with its transpose is the covariance, which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
