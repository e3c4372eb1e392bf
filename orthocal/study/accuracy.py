"""How well the tool's position is known: the number that users decide by.

A machine with errors θ, commanded to a posture, has its tool at p(θ). What is not known of θ
becomes a position error J dθ with J = ∂p/∂θ (`sensitivity`).

A shift that is common to the whole workspace is a choice of origin, not an error of the machine: a
workpiece is set up where the tool finds it. So every figure is given twice, absolute and with the
common shift taken out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.arguments import require_kind
from orthocal.identification.calibration import Calibration
from orthocal.robot.assembly import nominal_assembly
from orthocal.robot.model import Robot, read_only
from orthocal.study.sensitivity import ToolSensitivity

Array = NDArray[np.float64]

HALF_SIDE = 0.06
"""Half the side of the cube around the mechanical zero that is looked at by default, [m]."""

POINTS_A_SIDE = 7
NOTABLE = 0.1
"""Tolerances by which a parameter must be off to be named in a combination."""

ROUNDING = 1e-9
"""Residuals below which there are none: as many parameters as readings leave that, [m]."""

EXCESS = 1.5
"""Residuals by which errors must exceed their tolerances for the machine to be called worse."""

MOST_POINTS = 5_000
"""Points that are assessed together; each takes 40 kB. `rows.accuracy_rows` takes any number."""

DRAWS = 500
"""Errors drawn to find how large 95 % of the position errors are at most."""


@dataclass(frozen=True, slots=True, eq=False)
class ErrorSize:
    """Size of position errors over a workspace, [m]."""

    rms: float
    """Root mean square over the points, and over what is not known."""
    percentile_95: float
    """What 95 % of the errors, at any point, stay below."""
    largest: float
    """At the worst point; of what is not known, root mean square there."""


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


@dataclass(frozen=True, slots=True, eq=False)
class Workspace:
    """Points that stand for a region, with weights that make their mean the region's."""

    points: Array
    """Tool positions in the coordinates that the drives control, shape (K, n_coordinates), [m]."""
    weights: Array
    """Shape (K,), sum 1."""

    @classmethod
    def even(cls, points: ArrayLike) -> Workspace:
        """Points that all count alike, shape (K, n_coordinates), [m]."""
        p = read_only(np.atleast_2d(np.asarray(points, dtype=np.float64)))
        if p.ndim != 2 or not p.size:
            raise ValueError(f"found the shape {p.shape}; expected points, (K, n_coordinates)")
        return cls(p, read_only(np.full(len(p), 1.0 / len(p))))


@dataclass(frozen=True, slots=True, eq=False)
class ToolAccuracy:
    """Where the tool is and how well that is known, before and after a calibration."""

    workspace: Workspace
    targets: Array
    """Commanded tool positions, shape (K, 3), [m]."""
    names: tuple[str, ...]
    """Free, then unmodelled parameters."""
    jacobian: Array
    """∂p/∂θ at every point, shape (K, 3, n), [m per parameter unit]."""
    deviation: Array
    """Where the calibrated machine's tool is now, less where it is commanded, (K, 3), [m]."""
    left: Array
    """The same once the identified offsets are in a controller that is nominal otherwise."""
    before: ToolUncertainty
    """With all errors within their tolerances and nothing known."""
    after: ToolUncertainty | None
    """With the machine as calibrated; None where nothing tells the noise."""

    @property
    def relative_deviation(self) -> Array:
        """The deviation with the common shift taken out, shape (K, 3), [m]."""
        return np.asarray(self.deviation - self.workspace.weights @ self.deviation)

    @property
    def relative_left(self) -> Array:
        """What is left, with the common shift taken out, shape (K, 3), [m]."""
        return np.asarray(self.left - self.workspace.weights @ self.left)


@dataclass(frozen=True, slots=True, eq=False)
class RemainingError:
    """A combination of parameters that is not well known, and what it does at the tool."""

    rms: float
    """Over the workspace, the common shift taken out, [m]."""
    parts: tuple[tuple[str, float], ...]
    """Parameters and by how many tolerances each is off, the largest first."""


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
    relative = jacobian - np.tensordot(workspace.weights, jacobian, axes=1)
    covariances = [j @ covariance @ j.transpose(0, 2, 1) for j in (jacobian, relative)]
    sizes = [_spread_size(c, workspace.weights) for c in covariances]
    return ToolUncertainty(workspace.points, covariances[0], covariances[1], sizes[0], sizes[1])


def measure_deviations(deviations: Array, weights: Array) -> ErrorSize:
    """Size of known position errors.

    Args:
        deviations: Shape (K, 3), [m].
        weights: Of the points in the mean, shape (K,), sum 1.
    """
    lengths = np.linalg.norm(deviations, axis=1)
    return ErrorSize(
        rms=float(np.sqrt(weights @ lengths**2)),
        percentile_95=_weighted_percentile(lengths, weights),
        largest=float(lengths.max()),
    )


def assess_tool(
    calibration: Calibration,
    workspace: Workspace | None = None,
    *,
    names: Sequence[str] | None = None,
) -> ToolAccuracy:
    """Where the tool is and how well that is known, before and after a calibration.

    Errors that were not free are taken at their tolerances, together with what the estimate has
    taken on of them: a calibration of offsets alone is only as good as legs and axes are.

    Args:
        calibration: The calibration.
        workspace: Tool positions that are commanded; the cube of ±60 mm by default.
        names: What to call the points in messages.

    Raises:
        RobotError: If the robot has no tool centre point.
        ClosureError: If the machine cannot reach a point.
    """
    require_kind(calibration, Calibration, expected="a Calibration, such as load_calibration(...)")
    robot, values = calibration.robot, calibration.errors
    space = cube(robot) if workspace is None else workspace
    unmodelled = calibration.unmodelled
    free = [p.name for p in calibration.free]
    tool = ToolSensitivity(robot, free=[*free, *unmodelled.names], values=values)
    nominal = nominal_assembly(robot)
    names = names or [f"point {i + 1}" for i in range(len(space.points))]
    target = nominal.inverse(space.points, names=names)
    active = calibration.session.controller_offsets
    commanded = target - (np.zeros(len(robot.drives)) if active is None else np.array(active))
    offsets = np.array([values.get(f"{d.name}.offset", 0.0) for d in robot.drives])
    where = nominal.forward(target, names=names)
    jacobian = tool(commanded, names=names)
    tolerances = np.r_[[p.tolerance for p in calibration.free], unmodelled.tolerances]
    after = None
    if np.isfinite(calibration.covariance).all():
        after = measure_uncertainty(jacobian, error_covariance(calibration), space)
    return ToolAccuracy(
        workspace=space,
        targets=read_only(where),
        names=tool.free,
        jacobian=read_only(jacobian),
        deviation=read_only(tool.assembly.forward(commanded, names=names) - where),
        left=read_only(tool.assembly.forward(target - offsets, names=names) - where),
        before=measure_uncertainty(jacobian, np.diag(tolerances**2), space),
        after=after,
    )


@lru_cache(maxsize=1)
def assess_cube(calibration: Calibration) -> ToolAccuracy:
    """The same over the default cube; summary, report and scene of a calibration all show it.

    Raises:
        RobotError: If the robot has no tool centre point.
        ClosureError: If the machine cannot reach a point.
    """
    return assess_tool(calibration)


def error_covariance(calibration: Calibration, *, excess: float = 1.0) -> Array:
    """Covariance of what the estimate has wrong, free and unmodelled parameters in turn, [SI].

    With e = θ − θ̂ it is −L θᵤ and the estimate's own scatter for the free ones, θᵤ for the others.

    Args:
        calibration: The calibration.
        excess: How many times their tolerances the unmodelled errors are taken to be.
    """
    unmodelled = calibration.unmodelled
    variance = (excess * unmodelled.tolerances) ** 2
    taken_on = unmodelled.leakage * variance
    return np.block(
        [
            [calibration.covariance + taken_on @ unmodelled.leakage.T, -taken_on],
            [-taken_on.T, np.diag(variance)],
        ]
    )


def find_excess(calibration: Calibration) -> float:
    """How many times their tolerances unmodelled errors must be for what remains of the readings.

    Of the residuals only what the noise does not explain counts, r² = n² + e² u², with n from
    repeated cycles or the gauge's own σ and u what errors at their tolerances would leave.

    Returns:
        e; 1 where that is no more than EXCESS, where noise explains what remains (99 %), where
        nothing tells the noise but the residuals themselves, or where no errors were left out: the
        machine may be as good as its tolerances.
    """
    noise, gauge = calibration.noise, calibration.session.gauge_sigma
    known = noise.cycles_sigma if noise.cycles_dof > 0 else gauge
    foretold = calibration.unmodelled.residual_rms
    if known is None or foretold < ROUNDING or not calibration.has_model_error:
        return 1.0
    # residuals keep the noise that parameters and gauge zeros have not taken up
    kept = noise.residual_dof / len(calibration.residuals)
    variance = (known * calibration.row_factor) ** 2 * kept
    ratio = math.sqrt(max(calibration.rms_after**2 - variance, 0.0)) / foretold
    return ratio if ratio > EXCESS else 1.0


def assess_excess(
    calibration: Calibration, accuracy: ToolAccuracy, excess: float
) -> ToolUncertainty:
    """Uncertainty after a calibration with unmodelled errors beyond their tolerances."""
    covariance = error_covariance(calibration, excess=excess)
    return measure_uncertainty(accuracy.jacobian, covariance, accuracy.workspace)


def assess_remaining(
    calibration: Calibration, accuracy: ToolAccuracy
) -> tuple[ToolUncertainty | None, float]:
    """What is not known after a calibration, as far as the readings tell of the machine.

    Returns:
        Uncertainty, None where nothing tells the noise, and how many times their tolerances
        unmodelled errors are taken to be: `find_excess`.
    """
    if accuracy.after is None:
        return None, 1.0
    excess = find_excess(calibration)
    if excess == 1.0:
        return accuracy.after, excess
    return assess_excess(calibration, accuracy, excess), excess


def find_remaining_errors(
    calibration: Calibration, accuracy: ToolAccuracy, *, count: int = 3
) -> tuple[RemainingError, ...]:
    """The combinations of errors that matter most at the tool after a calibration.

    Principal directions of what is not known of the parameters, weighed by the mean square that it
    makes at the tool with the common shift taken out; the largest first.
    """
    weights = accuracy.workspace.weights
    relative = accuracy.jacobian - np.tensordot(weights, accuracy.jacobian, axes=1)
    root = _square_root(error_covariance(calibration))
    effect = relative @ root
    _, directions = np.linalg.eigh(np.einsum("k,kin,kim->nm", weights, effect, effect))
    tolerances = np.r_[[p.tolerance for p in calibration.free], calibration.unmodelled.tolerances]
    found = []
    for direction in directions.T[::-1][:count]:
        change = root @ direction
        moved = relative @ change
        in_tolerances = change / tolerances
        order = np.argsort(-np.abs(in_tolerances))
        lead = np.sign(in_tolerances[order[0]]) or 1.0
        found.append(
            RemainingError(
                rms=float(np.sqrt(weights @ (moved**2).sum(axis=1))),
                parts=tuple(
                    (accuracy.names[i], float(lead * in_tolerances[i]))
                    for i in order
                    if abs(in_tolerances[i]) > NOTABLE
                ),
            )
        )
    return tuple(found)


def _spread_size(covariances: Array, weights: Array) -> ErrorSize:
    """Sizes of normal errors with given covariances, shape (K, 3, 3), at the points."""
    mean_square = np.trace(covariances, axis1=1, axis2=2)
    values, vectors = np.linalg.eigh(covariances)
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    rng = np.random.default_rng(0)
    draws = rng.normal(size=(3, DRAWS))
    lengths = np.linalg.norm(roots @ draws, axis=1)
    shares = np.broadcast_to(weights[:, None] / DRAWS, lengths.shape)
    return ErrorSize(
        rms=float(np.sqrt(weights @ mean_square)),
        percentile_95=_weighted_percentile(lengths.reshape(-1), shares.reshape(-1)),
        largest=float(np.sqrt(mean_square.max())),
    )


def _weighted_percentile(lengths: Array, weights: Array) -> float:
    """What 95 % of the weight stays below."""
    order = np.argsort(lengths)
    share = np.cumsum(weights[order])
    return float(lengths[order][min(int(np.searchsorted(share, 0.95)), lengths.size - 1)])


def _square_root(covariance: Array) -> Array:
    """A matrix whose product with its transpose is the covariance, which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
