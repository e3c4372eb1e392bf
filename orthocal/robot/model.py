"""Robot: Pinocchio model, loop closures as constraint models, drives, legs and tool."""

from __future__ import annotations

import copyreg
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from orthocal.arrays import Array, Indices, Mask
from orthocal.errors import ClosureError, ParameterError, RobotError
from orthocal.io.fields import read_only
from orthocal.robot.closing import Closing, close_loops, describe_opening
from orthocal.robot.description import OrthocalKeys
from orthocal.robot.frames import Placement, find_frame, place_frames
from orthocal.robot.parameters import ElementaryError, ParameterSet
from orthocal.units import DRIVE_UNITS, InUnit, Unit, format_fixed

PARALLEL_SINE = 0.02
"""Sine of the largest angle between a slide and a leg that counts as parallel to it."""

LIMIT_TOLERANCE = 1e-9
"""Rounding error by which a coordinate may exceed the limits of its joint, [m, rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class Drive(InUnit):
    """Actuated joint."""

    name: str
    """Name of the joint."""
    unit: Unit
    """m for a prismatic, rad for a revolute drive."""
    zero: float
    """Commanded coordinate at the mechanical zero, [unit]."""
    lower: float
    """Lower limit, [unit]; -inf without a limit in the URDF."""
    upper: float
    """Upper limit, [unit]; inf without a limit in the URDF."""
    zero_computed: bool = False
    """True if the zero was computed by closing the loops; False if the YAML states it."""
    direction: int = 1
    """1 if the controller's joint coordinate grows with the drive coordinate, else -1."""
    joint_zero: float | None = None
    """Joint coordinate of the controller at the mechanical zero, [unit]; None for `zero`."""

    @property
    def joint_unit(self) -> str:
        """Unit in which users read coordinates: mm or deg."""
        return DRIVE_UNITS[self.unit][0]

    @property
    def joint_size(self) -> float:
        """Size of this unit in SI."""
        return DRIVE_UNITS[self.unit][1]

    def show(self, value: float, form: str = ".3f") -> str:
        """Coordinate or length, [unit], as text with the unit that users read."""
        return f"{value / self.joint_size:{form}} {self.joint_unit}"

    def to_joint(self, coordinate: ArrayLike) -> Array:
        """Joint coordinates of the controller from drive coordinates, any shape, [unit]."""
        return self._displayed_zero + self.direction * (
            np.asarray(coordinate, dtype=np.float64) - self.zero
        )

    def from_joint(self, joint: ArrayLike) -> Array:
        """Drive coordinates from joint coordinates of the controller, any shape, [unit]."""
        displacement = np.asarray(joint, dtype=np.float64) - self._displayed_zero
        return self.zero + self.direction * displacement

    @property
    def _displayed_zero(self) -> float:
        """Joint coordinate at the mechanical zero, [unit]."""
        return self.zero if self.joint_zero is None else self.joint_zero

    @property
    def joint_limits(self) -> tuple[float, float]:
        """Lower and upper limit of the controller's joint coordinate, [unit]."""
        ends = (float(self.to_joint(self.lower)), float(self.to_joint(self.upper)))
        return min(ends), max(ends)

    def is_beyond(self, coordinate: ArrayLike) -> Mask:
        """True where drive coordinates, any shape, [unit], exceed the travel."""
        values = np.asarray(coordinate, dtype=np.float64)
        return np.asarray(
            (values < self.lower - LIMIT_TOLERANCE) | (values > self.upper + LIMIT_TOLERANCE)
        )

    def describe_beyond(self, coordinate: float) -> str:
        """Description of a position, [unit], and of the limits, in joint coordinates."""
        low, high = self.joint_limits
        value = self.show(float(self.to_joint(coordinate)), ".4g")
        return (
            f"at {value}, outside its limits {low / self.joint_size:g} ... {self.show(high, 'g')}"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Closure:
    """Pair of frames that coincide, and the constrained rows of their pose error."""

    name: str
    """Name of the closure."""
    frame_a: str
    """Name of the first frame."""
    frame_b: str
    """Name of the second frame."""
    kind: str
    """'3d': position of b in a, 3 rows; '6d': log6 of the pose of b in a, 6 rows."""
    rows: tuple[int, ...]
    """Constrained rows, 0 to 5 for x, y, z, rx, ry, rz."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Line:
    """Line of a leg, or axis of one of its rods, from root to tip."""

    name: str
    """Name of the leg or rod."""
    root: str
    """Frame at the drive's end."""
    tip: str
    """Frame at the platform's end."""
    length: float
    """Nominal distance from root to tip, [m]."""
    reference_root: Array
    """Root in the nominal reference posture, shape (3,), [m]."""
    reference_tip: Array
    """Tip in the nominal reference posture, shape (3,), [m]."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Rod(Line):
    """Round rod of a leg."""

    radius: float
    """Radius, [m]."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Leg(Line):
    """Leg: the line from root to tip, and its rods."""

    axis: Array
    """Unit vector from root to tip in the nominal reference posture, shape (3,)."""
    root_driven: bool
    """True if no passive joint moves the root."""
    root_motion: Array
    """Direction in which the root moves in the nominal reference posture if all drive coordinates
    grow, shape (3,); 0 if it does not move."""
    rods: Mapping[str, Rod]
    """Round rods that a gauge can touch, by name."""

    @property
    def follows_slide(self) -> bool:
        """True if the leg is parallel to the motion of its root in the reference posture."""
        across = np.cross(self.root_motion, self.axis)
        return bool(self.root_motion.any() and np.abs(across).max() < PARALLEL_SINE)


@dataclass(frozen=True, slots=True, eq=False)
class Tcp:
    """Tool centre point."""

    frame: str
    """Frame whose origin it is."""
    coordinates: tuple[int, ...]
    """Commanded world coordinates: 0, 1, 2 for x, y, z."""


@dataclass(frozen=True, slots=True)
class Use:
    """Conditions under which a machine is used, over which tool errors are averaged."""

    approach: str
    """Sides of approach, a letter for each drive: p if its coordinate grows in the last motion, n
    if it falls, u for both sides."""
    temperature: tuple[float, float] | None = None
    """Lowest and highest temperature, [°C]; the reference of the effects by default."""
    payload: tuple[float, float] = (0.0, 0.0)
    """Lightest and heaviest mass on the tool in addition to the platform, [kg]."""


def _read_only_mapping(content: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    """Read-only mapping from its pickled content."""
    return MappingProxyType(content)


# pickle and deepcopy do not support the read-only mappings of a robot by themselves
copyreg.pickle(MappingProxyType, lambda mapping: (_read_only_mapping, (dict(mapping),)))


@dataclass(frozen=True, slots=True, eq=False)
class Robot:
    """Robot with closed loops.

    Joint coordinates are one number per degree of freedom, in the order of Pinocchio's velocities.
    Unbounded revolute joints have one angle.
    """

    name: str
    """Name of the robot."""
    folder: Path | None
    """Directory of its files; None for a robot that is embedded in another file."""
    urdf: Path
    """Path of the URDF, for messages."""
    yaml: Path
    """Path of the YAML, for messages."""
    content: Mapping[str, bytes]
    """Content of its files by name: URDF and YAML, and the meshes of an embedded robot."""
    sha256: str
    """Digest of the URDF and the YAML."""
    model: pin.Model
    """Pinocchio model. Robots share it: modify a copy, `model.copy()`."""
    constraints: tuple[pin.PointAnchorConstraintModel | pin.FrameAnchorConstraintModel, ...]
    """Closures as constraint models of Pinocchio, with all rows."""
    drives: tuple[Drive, ...]
    """Actuated joints, in the order of the YAML."""
    closures: tuple[Closure, ...]
    """Loop closures."""
    legs: Mapping[str, Leg]
    """Legs by name."""
    tcp: Tcp | None
    """Tool centre point; None without one."""
    workspace: Array | None
    """Box in the YAML over which tool errors are reported, relative to the mechanical zero, shape
    (n_coordinates, 2), [m]; None without one."""
    bed: float | None
    """Lowest coordinate z of the tool centre point, relative to the mechanical zero, [m]; None for
    a machine without a bed."""
    use: Use
    """Conditions under which the machine is used."""
    declared: OrthocalKeys
    """Keys of the YAML, among them the errors that `orthocal.effects` reads."""
    parameters: ParameterSet
    """Error parameters, from `orthocal.effects.loading`."""
    drive_index: Indices
    """Indices of the actuated coordinates, shape (n_drives,)."""
    passive_index: Indices
    """Indices of the passive coordinates, shape (n_passive,)."""
    reference_posture: Array
    """Joint coordinates with the drives at their mechanical zero, shape (nv,), [m, rad]."""
    drive_gain: Array
    """1 + scale error of each drive, shape (n_drives,); 1 for the nominal machine."""
    chosen_effects: tuple[str, ...] | None = None
    """Chosen effects in addition to geometry and drives; None for those of the YAML."""
    adjusted: bool = False
    """True if placements depend on the mechanical adjustments of each session."""

    def __repr__(self) -> str:
        drives = ", ".join(d.name for d in self.drives)
        return f"<Robot {self.name}: drives {drives}; {len(self.parameters)} error parameters>"

    def __getstate__(self) -> dict[str, Any]:
        """State for pickle, without the constraint models, which Pinocchio does not pickle."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "constraints"}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        """Restore a pickled robot, and build its constraint models."""
        for name, value in state.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "constraints", build_constraints(self.model, self.closures))

    @property
    def leg_noun(self) -> str:
        """Noun for the legs in messages: legs if they are parallel to their slides, else rods."""
        return "legs" if all(leg.follows_slide for leg in self.legs.values()) else "rods"

    @property
    def driven_noun(self) -> str:
        """Noun for the parts that the drives move, and to which the rods are hinged."""
        return "slide" if all(d.unit == "m" for d in self.drives) else "crank"

    @property
    def effect_names(self) -> tuple[str, ...]:
        """Effects of the machine in addition to those of geometry and drives."""
        return tuple(self.declared.effects) if self.chosen_effects is None else self.chosen_effects

    @property
    def rods(self) -> dict[tuple[str, str], Rod]:
        """Rods of all legs by the names of leg and rod, in order."""
        legs = self.legs.values()
        return {(leg.name, rod.name): rod for leg in legs for rod in leg.rods.values()}

    @property
    def closure_rows(self) -> int:
        """Number of constrained closure rows."""
        return sum(len(c.rows) for c in self.closures)

    @property
    def drive_zero(self) -> Array:
        """Mechanical zero: commanded drive coordinates, shape (n_drives,), [m, rad]."""
        return np.array([d.zero for d in self.drives])

    @property
    def commands_tool(self) -> bool:
        """True if the tool centre point has as many commanded coordinates as there are drives."""
        return self.tcp is not None and len(self.tcp.coordinates) == len(self.drives)

    @property
    def reference_passive(self) -> Array:
        """Passive coordinates of the reference posture, shape (n_passive,), [m, rad]."""
        return np.asarray(self.reference_posture[self.passive_index])

    @property
    def characteristic_length(self) -> float:
        """Length that scales rotations to displacements, [m].

        It is the mean nominal leg length, or without legs the mean distance between joints.
        """
        if self.legs:
            return float(np.mean([leg.length for leg in self.legs.values()]))
        spans = [float(np.linalg.norm(p.translation)) for p in self.model.jointPlacements]
        spans = [s for s in spans if s > 0.0]
        return float(np.mean(spans)) if spans else 1.0

    def frame_id(self, name: str) -> int:
        """Index of a frame in the Pinocchio model by its name.

        Raises:
            RobotError: If there is no such frame.
        """
        return find_frame(self.model, name, where=str(self.yaml))

    def reference_pose(self, name: str) -> pin.SE3:
        """Pose of a frame in the reference posture, in the world frame.

        Raises:
            RobotError: If there is no such frame.
        """
        data = self.model.createData()
        pin.forwardKinematics(self.model, data, self.configuration(self.reference_posture))
        return pin.updateFramePlacement(self.model, data, self.frame_id(name))

    def placement_of(self, error: ElementaryError) -> Placement:
        """Placement that an error of a joint or frame displaces."""
        if error.of_frame:
            return Placement(self.frame_id(error.owner), True)
        return Placement(int(self.model.getJointId(error.owner)), False)

    @property
    def frames(self) -> tuple[str, ...]:
        """Frames of closures, legs and tool, in this order."""
        frames = [f for c in self.closures for f in (c.frame_a, c.frame_b)]
        frames += [f for leg in self.legs.values() for f in (leg.root, leg.tip)]
        frames += [self.tcp.frame] if self.tcp else []
        return tuple(dict.fromkeys(frames))

    def configuration(self, coordinates: ArrayLike) -> Array:
        """Pinocchio configuration of joint coordinates.

        Args:
            coordinates: Joint coordinates, shape (nv,), [m, rad].

        Returns:
            Shape (nq,), with cosine and sine of unbounded revolute joints.
        """
        v = np.asarray(coordinates, dtype=np.float64)
        return np.asarray(pin.integrate(self.model, pin.neutral(self.model), v))

    def joint_coordinates(self, drives: ArrayLike, passive: ArrayLike) -> Array:
        """Joint coordinates of commanded drive and passive coordinates, without drive offsets.

        Args:
            drives: Shape (..., n_drives), [m, rad].
            passive: Shape (..., n_passive), [m, rad].

        Returns:
            Shape (..., nv).
        """
        commanded = np.asarray(drives, dtype=np.float64)
        result = np.zeros((*commanded.shape[:-1], self.model.nv))
        result[..., self.drive_index] = commanded * self.drive_gain
        result[..., self.passive_index] = np.asarray(passive, dtype=np.float64)
        return result

    def close_with_pinocchio(self, drives: ArrayLike, start: ArrayLike) -> Array:
        """Solve the loop closures of one posture by damped least squares on Pinocchio models.

        The start values must be near a solution. This is the reference for `LoopClosure`, which
        closes batches of postures from the reference posture.

        Args:
            drives: Commanded drive coordinates, shape (n_drives,), [m, rad].
            start: Start values of the passive coordinates, shape (n_passive,), [m, rad].

        Returns:
            Shape (n_passive,), [m, rad].

        Raises:
            ClosureError: If the loops do not close.
        """
        coordinates = self.joint_coordinates(drives, start)
        closing = self.close_coordinates(coordinates, self.passive_index, limited=False)
        if not closing.closed:
            opening = describe_opening(closing.residual, closure_turns(self))
            raise ClosureError(
                f"does not close: open by {opening}",
                posture="posture",
                residual=float(np.abs(closure_row_units(self) * closing.residual).max()),
            )
        return np.asarray(closing.coordinates[self.passive_index])

    def close_coordinates(self, start: Array, free: Indices, *, limited: bool = True) -> Closing:
        """Close the loops by some of the joint coordinates, within their limits by default.

        Args:
            start: Start values of the joint coordinates, shape (nv,), [m, rad].
            free: Indices of the coordinates that may change.
            limited: Keep these coordinates within their limits.

        Returns:
            All joint coordinates, and the residual.
        """
        lower, upper = coordinate_limits(self.model)
        data = self.model.createData()

        def complete(values: Array) -> Array:
            coordinates = np.array(start)
            coordinates[free] = values
            return coordinates

        def evaluate(values: Array) -> tuple[Array, Array]:
            residual, jacobian = self.evaluate_constraints_at(complete(values), data=data)
            return residual, jacobian[:, free]

        closing = close_loops(
            evaluate,
            start[free],
            row_units=closure_row_units(self),
            units=coordinate_units(self)[free],
            bounds=(lower[free], upper[free]) if limited else (-np.inf, np.inf),
        )
        return Closing(complete(closing.coordinates), closing.residual)

    def evaluate_constraints(self, drives: ArrayLike, passive: ArrayLike) -> tuple[Array, Array]:
        """Constrained rows of the closure residual and of its Jacobian, from Pinocchio.

        Args:
            drives: Commanded drive coordinates, shape (n_drives,), [m, rad].
            passive: Passive coordinates, shape (n_passive,), [m, rad].

        Returns:
            Residual, shape (closure_rows,), [m, rad], and its derivative with respect to the joint
            coordinates, shape (closure_rows, nv).
        """
        return self.evaluate_constraints_at(self.joint_coordinates(drives, passive))

    def evaluate_constraints_at(
        self, coordinates: ArrayLike, *, data: pin.Data | None = None
    ) -> tuple[Array, Array]:
        """Closure residual and Jacobian at joint coordinates (see `evaluate_constraints`).

        Args:
            coordinates: Joint coordinates, shape (nv,), [m, rad].
            data: Pinocchio data to reuse in repeated calls; created by default.
        """
        data = self.model.createData() if data is None else data
        pin.computeJointJacobians(self.model, data, self.configuration(coordinates))
        residuals, jacobians = [np.zeros(0)], [np.zeros((0, self.model.nv))]
        for closure, constraint in zip(self.closures, self.constraints, strict=True):
            cdata = constraint.createData()
            constraint.calc(self.model, data, cdata)
            error = np.array(cdata.constraint_position_error)
            jacobian = constraint.jacobian(self.model, data, cdata)
            jacobian = jacobian.reshape(error.size, self.model.nv)  # a vector for one joint
            if closure.kind == "6d":  # Pinocchio differentiates the pose, not its logarithm
                c1mc2 = cdata.c1Mc2
                jacobian = pin.Jlog6(c1mc2) @ c1mc2.toActionMatrixInverse() @ jacobian
            rows = list(closure.rows)
            residuals.append(error[rows])
            jacobians.append(jacobian[rows])
        return np.concatenate(residuals), np.vstack(jacobians)

    def with_tolerances(self, tolerances: Mapping[str, float]) -> Robot:
        """Robot with other tolerances of its errors (see `ParameterSet.with_tolerances`).

        Raises:
            ParameterError: If a name or unit is unknown, or a number is implausible.
            TypeError: If `tolerances` does not map names to numbers.
        """
        parameters = self.parameters.with_tolerances(tolerances)
        return self if parameters is self.parameters else replace(self, parameters=parameters)

    def with_errors(self, values: Mapping[str, float]) -> Robot:
        """Robot with errors written into its Pinocchio placements.

        Placements of joints and frames become placement · exp6(δ). An offset moves the placement of
        a drive along or about the drive's axis. A scale error is added to `drive_gain`.

        Args:
            values: Names of parameters, mapped to values, [unit of the parameter].

        Raises:
            ParameterError: If a name is unknown, a value is not finite, or an error cannot be
                expressed by placements.
            TypeError: If `values` does not map names to numbers.
        """
        gain = np.array(self.drive_gain)
        twists: dict[Placement, Array] = {}
        offsets: dict[Placement, Array] = {}
        for name, value in self.parameters.expand(values).items():
            e = self.parameters.elementary[name]
            if e.kind == "scale":
                gain[[d.name for d in self.drives].index(e.owner)] += value
                continue
            if e.kind != "offset" and e.axis < 0:
                raise ParameterError(f"'{name}' cannot be written into placements")
            placement = self.placement_of(e)
            if e.kind == "offset":
                offsets[placement] = value * joint_axis(self.model, placement.index)
            else:
                twists.setdefault(placement, np.zeros(6))[e.axis] += value
        displaced = self.displaced(twists).displaced(offsets)  # offsets act in displaced axes
        return replace(displaced, drive_gain=read_only(gain))

    def displaced(self, twists: Mapping[Placement, ArrayLike]) -> Robot:
        """Robot with displaced placements of joints and frames: placement · exp6(δ).

        Args:
            twists: Placements, mapped to their twists δ, shape (6,), [m, rad].
        """
        model = self.model.copy()
        frames: dict[int, Array] = {}
        for placement, twist in twists.items():
            delta = np.asarray(twist, dtype=np.float64)
            if placement.of_frame:
                frames[placement.index] = delta
            else:
                i = placement.index
                model.jointPlacements[i] = model.jointPlacements[i] * pin.exp6(delta)
        place_frames(model, self.model, frames)
        return replace(self, model=model, constraints=build_constraints(model, self.closures))


def require_tcp(robot: Robot) -> Tcp:
    """Tool centre point of a robot.

    Raises:
        RobotError: If the robot has no tool centre point.
    """
    if robot.tcp is None:
        raise RobotError("has no tool centre point; add orthocal.tcp", where=str(robot.yaml))
    return robot.tcp


def require_commanded_tool(robot: Robot) -> tuple[int, ...]:
    """Commanded world coordinates of the tool, one per drive.

    Raises:
        RobotError: If the drives do not command the tool.
    """
    coordinates = require_tcp(robot).coordinates
    if len(coordinates) != len(robot.drives):
        raise RobotError(
            f"orthocal.tcp.coordinates names {len(coordinates)} coordinates for "
            f"{len(robot.drives)} drives: they do not command the tool",
            where=str(robot.yaml),
        )
    return coordinates


def coordinate_names(model: pin.Model) -> list[str]:
    """Names of the joints in the order of the joint coordinates; every joint has one."""
    return [str(name) for name in model.names][1:]


def joint_axis(model: pin.Model, joint: int) -> Array:
    """Twist of a joint with one degree of freedom per unit of its coordinate, shape (6,)."""
    joint_model = model.joints[joint]
    joint_data = joint_model.createData()
    joint_model.calc(joint_data, pin.neutral(model))
    return np.asarray(joint_data.S, dtype=np.float64).reshape(-1)


def joint_unit(model: pin.Model, joint: int) -> Unit:
    """SI unit of the coordinate of a joint with one degree of freedom: rad if it turns, else m."""
    return "rad" if joint_axis(model, joint)[3:].any() else "m"


def closure_turns(robot: Robot) -> Mask:
    """Mask of the closure rows that are rotations, shape (closure_rows,)."""
    return np.array([row >= 3 for c in robot.closures for row in c.rows], dtype=np.bool_)


def drive_keys(
    quantity: str, drives: Sequence[Drive], values: Sequence[float] | None = None
) -> str:
    """Keys of a session with a value of each drive, such as "offsets_mm: [0, 0]".

    Drives with different units have a key for each unit.

    Args:
        quantity: First part of the keys: offsets, backlash or home_offset.
        drives: The drives.
        values: Value of each drive, [m, rad]; 0 by default.
    """
    texts: dict[str, list[str]] = {}
    for drive, value in zip(drives, values or [0.0] * len(drives), strict=True):
        texts.setdefault(drive.joint_unit, []).append(f"{value / drive.joint_size:.8g}")
    return ", ".join(f"{quantity}_{unit}: [{', '.join(v)}]" for unit, v in texts.items())


def name_coordinates(
    drives: Sequence[Drive],
    values: Iterable[float],
    show: Callable[[float], str] = format_fixed,
) -> list[str]:
    """Name of each drive with its coordinate and unit, such as "x 1.500 mm".

    Args:
        drives: The drives.
        values: Coordinate of each drive, [m, rad].
        show: Function that formats numbers in the units that users read.
    """
    return [
        f"{drive.name} {show(float(value) / drive.joint_size)} {drive.joint_unit}"
        for drive, value in zip(drives, values, strict=True)
    ]


def closure_row_units(robot: Robot) -> Array:
    """Metres per unit of each closure row, shape (closure_rows,), [1 or m/rad].

    It is 1 for translations and the characteristic length for rotations.
    """
    return np.where(closure_turns(robot), robot.characteristic_length, 1.0)


def coordinate_turns(model: pin.Model) -> Mask:
    """Mask of the joint coordinates that are rotations, shape (nv,)."""
    turns = [joint_unit(model, i) == "rad" for i in range(1, model.njoints)]
    return np.array(turns, dtype=np.bool_)


def coordinate_units(robot: Robot) -> Array:
    """Metres per unit of each joint coordinate, shape (nv,), [1 or m/rad]."""
    return np.where(coordinate_turns(robot.model), robot.characteristic_length, 1.0)


def coordinate_limits(model: pin.Model) -> tuple[Array, Array]:
    """Lower and upper bounds of the joint coordinates, shape (nv,) each; infinite if unbounded."""
    lower, upper = np.full(model.nv, -np.inf), np.full(model.nv, np.inf)
    single = np.flatnonzero(np.array(model.nqs) == 1)
    in_q, in_v = np.array(model.idx_qs)[single], np.array(model.idx_vs)[single]
    lower[in_v], upper[in_v] = model.lowerPositionLimit[in_q], model.upperPositionLimit[in_q]
    return lower, upper


def build_constraints(
    model: pin.Model, closures: Sequence[Closure]
) -> tuple[pin.PointAnchorConstraintModel | pin.FrameAnchorConstraintModel, ...]:
    """Build the constraint models of closures with the placements of a Pinocchio model."""
    result = []
    for closure in closures:
        a, b = (
            model.frames[find_frame(model, name, where="closure")]
            for name in (closure.frame_a, closure.frame_b)
        )
        kind = (
            pin.PointAnchorConstraintModel
            if closure.kind == "3d"
            else pin.FrameAnchorConstraintModel
        )
        constraint = kind(model, a.parentJoint, a.placement, b.parentJoint, b.placement)
        constraint.name = closure.name
        result.append(constraint)
    return tuple(result)
