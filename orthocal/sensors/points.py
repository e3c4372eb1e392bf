"""Points: coordinates of a target at the tool, from a tracker, an arm, a camera or a microscope.

The instrument shows the position of the target in the frame of the station. The reading along a
unit vector a of the station is

    h = (1 + s) aᵀ Rᵀ (Eᵀ (q − e) − t)

q is the target in the world frame, t and R are position and rotation of the station, and s is the
error of its scale. E and e are the rotation and displacement errors of the station about the world
origin, which is near the machine.

A reading is one number, so a setup of points is read as three sensors with orthogonal a. These are
the axes of the station, or the principal axes of the covariance of a point, along which its errors
are independent. The sensors share the station. The errors of its pose are nuisance parameters. If
the frame is unknown, the nominal pose is the best fit of the points to the nominal machine.
Otherwise it is the world frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import casadi as ca
import numpy as np
import pinocchio as pin
from pydantic import Field

from orthocal.arrays import Array, Indices, Triple, triple
from orthocal.errors import SessionError
from orthocal.io.documents import Keys, Name, Number
from orthocal.robot.model import Robot
from orthocal.sensors.mounting import ScaleTolerance, rotate
from orthocal.sensors.protocol import (
    Contact,
    GaugeZero,
    NuisanceParameter,
    SetupKeys,
    ToolSensor,
    View,
    place_point,
)
from orthocal.units import MM, MRAD, UM, read_tolerance, show_mm, show_tolerance, tidy, to_mm

LARGEST_MM = 100_000.0
"""Largest coordinate, [mm]: the reach of a laser tracker."""

ABOUT_FIT = 20 * MM, 50 * MRAD
"""Prior standard deviations of an unknown frame about the best fit, [m] and [rad]: ten times the
changes of the fit by errors of the machine."""

GROSS_RESIDUAL = 1 * MM
"""RMS residual of a station's fit, [m], up to which no point is excluded. Linearising about such a
fit errs by micrometres."""

GROSS_RATIO = 0.1
"""RMS residual without the excluded points, relative to that with them, below which an exclusion
applies."""

FEWEST_CONSISTENT = 4
"""Fewest points that remain after exclusions, because three points fit almost any other three."""

AXES = "xyz"
"""Axes of the station's frame."""

Coordinate = Annotated[Number, Field(ge=-LARGEST_MM, le=LARGEST_MM)]
Vector3 = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
Covariance = Annotated[
    list[Annotated[list[Number], Field(min_length=3, max_length=3)]],
    Field(min_length=3, max_length=3),
]


class FrameKeys(Keys):
    """Tolerances of a station whose frame is nominally the world frame."""

    tolerance_mm: Annotated[Number, Field(ge=0.0, le=1000.0)] = 0.0
    tolerance_mrad: Annotated[Number, Field(ge=0.0, le=400.0)] = 0.0


class AxisKeys(Keys):
    """Coordinate axis of one of the three sensors of a setup, in the record of a calibration."""

    along: Annotated[list[Number], Field(min_length=3, max_length=3)]
    """Unit vector in the frame of the station."""
    station_mm: Vector3
    """Position of the station's origin in the world frame."""
    station_rad: Annotated[list[Number], Field(min_length=3, max_length=3)]
    """Rotation vector of the station."""


class PointKeys(SetupKeys):
    """Keys of a setup of points, as in a session.yaml."""

    target_mm: Vector3 = Field(default_factory=lambda: [0.0, 0.0, 0.0])
    """Position of the target, from the tool centre point, in the tool's frame."""
    frame: Literal["unknown"] | FrameKeys = "unknown"
    """Frame of the station: unknown, or nominally the world frame with tolerances."""
    station: Name | None = None
    """Name of the station, if several setups share its pose."""
    scale_tolerance: ScaleTolerance = 0.0
    covariance_um2: Covariance | None = None
    """Covariance of the coordinates of a point in the frame of the station; by default independent
    coordinates with the gauge's sigma_mm."""
    axis: AxisKeys | None = None
    """Axis of a recorded sensor; a session.yaml has none."""


@dataclass(frozen=True, slots=True)
class Points(ToolSensor):
    """Coordinates of a target at the tool, or the coordinate along one axis of the station."""

    target: Triple = (0.0, 0.0, 0.0)
    """Position of the target, from the tool centre point, in the tool's frame, [m]."""
    frame_std: tuple[float, float] = ABOUT_FIT
    """Prior standard deviations of the station's position and rotation, [m] and [rad]."""
    station: str | None = None
    """Name of the station that several setups share."""
    scale_std: float = 0.0
    """Prior standard deviation of the scale, [1]."""
    covariance: tuple[Triple, Triple, Triple] | None = None
    """Covariance of the coordinates of a point, [m²]; None for the standard deviation of the
    gauge."""
    along: Triple | None = None
    """Unit vector of the coordinate in the frame of the station; None for all three coordinates."""
    position: Triple = (0.0, 0.0, 0.0)
    """Position of the station in the world frame, [m]."""
    rotation: Triple = (0.0, 0.0, 0.0)
    """Rotation vector of the station, [rad]."""

    kind: ClassVar[str] = "points"
    noun: ClassVar[str] = "a target"
    instrument: ClassVar[str] = "instrument"
    keys: ClassVar[type[SetupKeys]] = PointKeys
    ideal: ClassVar[str] = "its nominal position"
    zero: ClassVar[GaugeZero] = "known"
    largest_reading: ClassVar[float] = LARGEST_MM * MM

    @classmethod
    def from_keys(cls, keys: PointKeys) -> Points:
        """Build from the keys of a session.yaml.

        Raises:
            SessionError: If the covariance is not symmetric and positive definite.
        """
        frame_std = ABOUT_FIT
        if isinstance(keys.frame, FrameKeys):
            frame_std = (
                read_tolerance(keys.frame.tolerance_mm, MM),
                read_tolerance(keys.frame.tolerance_mrad, MRAD),
            )
        points = cls(
            target=triple(keys.target_mm, MM),
            frame_std=frame_std,
            station=keys.station,
            scale_std=read_tolerance(keys.scale_tolerance),
            covariance=None
            if keys.covariance_um2 is None
            else read_covariance(keys.covariance_um2),
        )
        if keys.axis is None:
            return points
        return replace(
            points,
            along=triple(keys.axis.along),
            position=triple(keys.axis.station_mm, MM),
            rotation=triple(keys.axis.station_rad),
        )

    def to_keys(self) -> dict[str, Any]:
        """Keys for a session.yaml; with `axis` for one of the three sensors of a setup."""
        keys: dict[str, Any] = {"target_mm": [to_mm(v) for v in self.target]}
        if self.frame_std != ABOUT_FIT:
            units = zip(self.frame_std, (MM, MRAD), strict=True)
            limits = [show_tolerance(std, unit) for std, unit in units]
            keys["frame"] = {"tolerance_mm": limits[0], "tolerance_mrad": limits[1]}
        if self.station is not None:
            keys["station"] = self.station
        if self.scale_std:
            keys["scale_tolerance"] = show_tolerance(self.scale_std)
        if self.covariance is not None:
            keys["covariance_um2"] = [[tidy(v / UM**2) for v in row] for row in self.covariance]
        if self.along is not None:
            keys["axis"] = {
                "along": list(self.along),
                "station_mm": [v / MM for v in self.position],
                "station_rad": list(self.rotation),
            }
        return keys

    @property
    def in_file(self) -> Points:
        """Sensor of all three coordinates, as a session.yaml states it."""
        zeros = (0.0, 0.0, 0.0)
        return replace(self, along=None, position=zeros, rotation=zeros)

    def split(self) -> dict[str, tuple[Points, float | None]]:
        """The three sensors by label, each with the standard deviation of its reading, [m].

        It is None without a covariance: then the standard deviation of the gauge applies. Without
        correlation the sensors read x, y and z of the station, otherwise its principal axes.
        """
        if self.covariance is None:
            return {k: (replace(self, along=_unit(i)), None) for i, k in enumerate(AXES)}
        covariance = np.array(self.covariance)
        if not np.any(covariance - np.diag(np.diag(covariance))):
            stds, axes, labels = np.sqrt(np.diag(covariance)), np.eye(3), AXES
        else:
            variances, axes = np.linalg.eigh(covariance)
            stds, labels = np.sqrt(variances), "123"
        return {
            label: (replace(self, along=triple(axes[:, i].tolist())), float(stds[i]))
            for i, label in enumerate(labels)
        }

    def describe(self) -> str:
        """Short description with coordinate and target."""
        position = ", ".join(map(show_mm, self.target))
        target = f"target at ({position}) mm" if any(self.target) else "target at the tool"
        if self.along is None:
            return f"position of a {target}"
        axis = next((k for i, k in enumerate(AXES) if self.along == _unit(i)), None)
        if axis is not None:
            return f"{axis} coordinate of a {target}"
        return f"coordinate of a {target} along ({', '.join(f'{v:.3g}' for v in self.along)})"

    @property
    def mounting_steps(self) -> tuple[str, ...]:
        """Instructions for mounting the target."""
        target = ", ".join(map(show_mm, self.target))
        return (
            "Set up the instrument. It must not move until all points of its setups are measured.",
            f"Mount the target at the tool, ({target}) mm from the tool centre point.",
            "Export the points with posture, x, y and z as a table for `orthocal import`, or type "
            "them into `orthocal record`.",
        )

    def constants(self, robot: Robot) -> Array:
        """Coordinate axis in the world frame (3), positions of station (3) and target (3), [m]."""
        del robot
        along = pin.exp3(np.array(self.rotation)) @ np.array(self.along or (0.0, 0.0, 0.0))
        return np.array([*along, *self.position, *self.target])

    @property
    def nuisance_parameters(self) -> tuple[NuisanceParameter, ...]:
        """Pose and scale of the station, if their standard deviation is above 0."""
        owner = f"station.{self.station}" if self.station else None
        length, angle = self.frame_std
        parameters = (
            *(NuisanceParameter(k, "m", length, owner) for k in AXES),
            *(NuisanceParameter(f"r{k}", "rad", angle, owner) for k in AXES),
            NuisanceParameter("scale", "1", self.scale_std, owner),
        )
        return tuple(p for p in parameters if p.prior_std > 0.0)

    def expression(self, view: View, robot: Robot) -> ca.SX:
        """Coordinate of the target along the sensor's axis, [m]."""
        del robot
        errors = {p.name: view.nuisance[i] for i, p in enumerate(self.nuisance_parameters)}
        along, station, target = (view.constants[i : i + 3] for i in (0, 3, 6))
        displacement = ca.vertcat(*(errors.get(k, 0.0) for k in AXES))
        (tool,) = view.frames
        seen = tool.position + tool.rotation @ target - displacement
        for i in (2, 1, 0):
            seen = rotate(seen, ca.SX(np.eye(3)[i]), -ca.SX(errors.get(f"r{AXES[i]}", 0.0)))
        return ca.SX((1.0 + errors.get("scale", 0.0)) * ca.dot(along, seen - station))

    def contact(self, frames: Sequence[Array], at_zero: Sequence[Array], robot: Robot) -> Contact:
        """Positions of the target in K postures."""
        del at_zero
        targets = place_point(frames[0], self.target)
        direction = self.constants(robot)[:3]
        across = np.linalg.svd(direction[None])[2][-1]
        problems = [""] * len(targets)
        return Contact(targets, direction, across, problems, "target_mm", at_tool=True)


def read_covariance(rows: Sequence[Sequence[float]]) -> tuple[Triple, Triple, Triple]:
    """Covariance of a point, [m²], from rows in µm².

    Raises:
        SessionError: If the matrix is not symmetric and positive definite.
    """
    matrix = np.array(rows, dtype=np.float64)
    if not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0.0):
        raise SessionError("is not symmetric", where="covariance_um2")
    if not np.linalg.eigvalsh(matrix).min() > 0.0:
        raise SessionError(
            "is not positive definite; expected variances in µm² on its diagonal",
            where="covariance_um2",
        )
    a, b, c = (triple(row, UM**2) for row in matrix.tolist())
    return a, b, c


def fit_station(points: Array, targets: Array) -> tuple[Triple, Triple]:
    """Pose of a station with the best fit of points to targets (Kabsch, 1976).

    Points that contradict the others grossly are excluded; see `_consistent_points`.

    Args:
        points: Points in the frame of the station, shape (n, 3), [m].
        targets: Targets in the world frame, shape (n, 3), [m].

    Returns:
        Position [m] and rotation vector [rad] of the station.

    Raises:
        SessionError: If the points do not determine the pose.
    """
    if not _determine_pose(points):
        raise SessionError(
            "unknown, but the points lie on a line; expected three or more points that do not",
            where="frame",
        )
    if len(consistent := _consistent_points(points, targets)) < len(points):
        points, targets = points[consistent], targets[consistent]
    seen, true = points - points.mean(axis=0), targets - targets.mean(axis=0)
    u, _, vh = np.linalg.svd(seen.T @ true)
    rotation = vh.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(vh.T @ u.T))]) @ u.T
    position = targets.mean(axis=0) - rotation @ points.mean(axis=0)
    return triple(position.tolist()), triple(pin.log3(rotation).tolist())


def _determine_pose(points: Array) -> bool:
    """True for three or more points that do not lie on a line, shape (n, 3), [m]."""
    singular_values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return len(points) >= 3 and bool(singular_values[1] > 1e-3 * singular_values[0])


def _consistent_points(points: Array, targets: Array) -> Indices:
    """Indices of the points without those that contradict the others grossly.

    Points are removed one by one, each time the one without which the RMS residual is smallest.
    While the residual is above GROSS_RESIDUAL, removals apply if they reduce it below GROSS_RATIO
    of its value. Errors of the machine do not cause such reductions, because they change smoothly
    with the position. At most a third of the points is removed.

    Args:
        points: Points in the frame of the station, shape (n, 3), [m].
        targets: Targets in the world frame, shape (n, 3), [m].
    """
    consistent = remaining = np.arange(len(points))
    residuals = _rms_residuals(points, targets)
    residual = residuals[0]
    fewest = max(FEWEST_CONSISTENT, len(points) - len(points) // 3)
    while residual > GROSS_RESIDUAL and len(remaining) > fewest:
        remaining = np.delete(remaining, int(np.argmin(residuals[1:])))
        if not _determine_pose(points[remaining]):
            break
        residuals = _rms_residuals(points[remaining], targets[remaining])
        if residuals[0] < GROSS_RATIO * residual:
            consistent, residual = remaining, residuals[0]
    return consistent


def _rms_residuals(points: Array, targets: Array) -> Array:
    """RMS residuals of the best fits to all points, and to all without each of them.

    p and q are the centred points and targets, and σ the singular values of H = Σ p qᵀ. The squared
    residuals of the best fit sum to Σ |p|² + Σ |q|² − 2 (σ1 + σ2 + sign(det H) σ3). Without one of
    n points, whose centroid differs, each sum loses n / (n − 1) times the term of this point.

    Args:
        points: Points in the frame of the station, shape (n, 3), [m].
        targets: Targets in the world frame, shape (n, 3), [m].

    Returns:
        Residual with all points, then without each, shape (n + 1,), [m].
    """
    seen, true = points - points.mean(axis=0), targets - targets.mean(axis=0)
    terms = seen[:, :, None] * true[:, None, :]
    squares = np.sum(seen**2 + true**2, axis=1)
    count = np.full(len(points) + 1, len(points) - 1)
    count[0] += 1
    loss = len(points) / count
    loss[0] = 0.0  # the first residual is that of all points; the term beside it does not count
    products = terms.sum(axis=0) - loss[:, None, None] * np.concatenate([terms[:1], terms])
    sums = squares.sum() - loss * np.concatenate([squares[:1], squares])
    singular_values = np.linalg.svd(products, compute_uv=False)
    singular_values[:, 2] *= np.sign(np.linalg.det(products))
    squared = sums - 2.0 * singular_values.sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(squared, 0.0) / count))


def _unit(i: int) -> Triple:
    """Unit vector of axis i."""
    return triple(np.eye(3)[i].tolist())
