"""Symbolic kinematics (CasADi) of a Pinocchio model with errors of all placements.

    oM_i = oM_parent · placement_i · exp6(δ_i) · M_i(q)

A pose is a rotation R and a position p, as CasADi expressions. All functions can be differentiated
at zero errors and at closed loops (see `se3`).
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
import pinocchio as pin

from orthocal.arrays import Array
from orthocal.kinematics.se3 import log6
from orthocal.robot.frames import Placement, nearest_carrier
from orthocal.robot.model import Robot, joint_axis

ROUNDING_ERROR = 1e-15
"""Largest component of a nominal placement that is a rounding error, [1, m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Rigid-body pose, which maps coordinates of its frame to those of its parent."""

    rotation: ca.SX
    """Shape (3, 3)."""
    position: ca.SX
    """Shape (3,), [m]."""

    def __mul__(self, other: Pose) -> Pose:
        return Pose(self.rotation @ other.rotation, self.rotation @ other.position + self.position)

    def relative(self, other: Pose) -> Pose:
        """Pose of `other` in this frame."""
        transposed = self.rotation.T
        return Pose(transposed @ other.rotation, transposed @ (other.position - self.position))


def constant_pose(placement: pin.SE3) -> Pose:
    """Symbolic pose of a Pinocchio placement, with rounding errors replaced by structural zeros."""
    rotation = np.array(placement.rotation)
    position = np.array(placement.translation)
    rotation[np.abs(rotation) < ROUNDING_ERROR] = 0.0
    position[np.abs(position) < ROUNDING_ERROR] = 0.0
    return Pose(ca.sparsify(ca.SX(rotation)), ca.sparsify(ca.SX(position)))


def joint_motion(axis: Array, coordinate: ca.SX) -> Pose:
    """Motion exp6(S q) of a revolute or prismatic joint with the axis S = (v, ω), shape (6,)."""
    v, w = np.array(axis[:3]), np.array(axis[3:])
    if not np.any(w):
        return Pose(ca.SX.eye(3), ca.sparsify(ca.SX(v)) * coordinate)
    hat = pin.skew(w)
    s, c = ca.sin(coordinate), ca.cos(coordinate)
    rotation = (
        ca.SX.eye(3) + s * ca.sparsify(ca.SX(hat)) + (1.0 - c) * ca.sparsify(ca.SX(hat @ hat))
    )
    return Pose(rotation, ca.SX(3, 1))


class SymbolicTree:
    """Forward kinematics of a Pinocchio model whose placements may be expressions.

    Args:
        model: The nominal model.
        coordinates: Joint coordinates, shape (nv,); one angle per unbounded revolute joint.
        joint_placements: Indices of joints, mapped to their placements in the moving frames of
            their parents; those of the model by default.
        frame_placements: Indices of frames, mapped to their placements (see `nominal_placement`);
            those of the model by default.
    """

    def __init__(
        self,
        model: pin.Model,
        coordinates: ca.SX,
        *,
        joint_placements: Mapping[int, Pose] | None = None,
        frame_placements: Mapping[int, Pose] | None = None,
    ) -> None:
        self.model = model
        self.coordinates = coordinates
        self._joint_placements = dict(joint_placements or {})
        self._frame_placements = dict(frame_placements or {})
        self._bases: dict[int, Pose] = {}
        self._joints: dict[int, Pose] = {0: Pose(ca.SX.eye(3), ca.SX(3, 1))}
        self._frames: dict[int, Pose] = {}

    def joint_base(self, joint: int) -> Pose:
        """World pose of a joint's frame before the joint's motion; its errors act in this frame."""
        if joint not in self._bases:
            m = self.model
            placement = self._joint_placements.get(joint)
            if placement is None:
                placement = constant_pose(m.jointPlacements[joint])
            self._bases[joint] = self.joint_pose(m.parents[joint]) * placement
        return self._bases[joint]

    def joint_pose(self, joint: int) -> Pose:
        """World pose of a joint's moving frame."""
        if joint not in self._joints:
            coordinate = self.coordinates[self.model.joints[joint].idx_v]
            motion = joint_motion(joint_axis(self.model, joint), coordinate)
            self._joints[joint] = self.joint_base(joint) * motion
        return self._joints[joint]

    def frame_pose(self, frame: int) -> Pose:
        """World pose of a frame, with the errors of the frames that carry it."""
        if frame not in self._frames:
            placed = self._frame_placements
            carrier = nearest_carrier(self.model, frame, placed)
            placement = placed.get(frame)
            if placement is None:
                nominal = nominal_placement(self.model, Placement(frame, True), placed)
                placement = constant_pose(nominal)
            if carrier is None:
                pose = self.joint_pose(self.model.frames[frame].parentJoint) * placement
            else:
                pose = self.frame_pose(carrier) * placement
            self._frames[frame] = pose
        return self._frames[frame]

    def joints_to(self, frame: int) -> list[int]:
        """Indices of the joints that move a frame, from the frame to the base."""
        joint, joints = int(self.model.frames[frame].parentJoint), []
        while joint > 0:
            joints.append(joint)
            joint = int(self.model.parents[joint])
        return joints


def nominal_placement(model: pin.Model, placement: Placement, moved: Container[int]) -> pin.SE3:
    """Nominal placement of a joint, or of a frame in the nearest moved frame or joint.

    Args:
        model: The nominal model.
        placement: The placement.
        moved: Indices of the frames with errors.
    """
    if not placement.of_frame:
        return model.jointPlacements[placement.index]
    carrier = nearest_carrier(model, placement.index, moved)
    nominal = model.frames[placement.index].placement
    return nominal if carrier is None else model.frames[carrier].placement.inverse() * nominal


def moved_frames(moved: Iterable[Placement]) -> frozenset[int]:
    """Indices of the frames among moved placements."""
    return frozenset(p.index for p in moved if p.of_frame)


def closure_residual(robot: Robot, tree: SymbolicTree) -> ca.SX:
    """Constrained components of all closures: position of frame b in a, or log6 of its pose in a.

    Args:
        robot: Robot with the closures.
        tree: Forward kinematics.

    Returns:
        Shape (closure_rows,), [m, rad].
    """
    errors = []
    for c in robot.closures:
        a, b = (tree.frame_pose(robot.frame_id(name)) for name in (c.frame_a, c.frame_b))
        relative = a.relative(b)
        point = c.kind == "3d"
        error = relative.position if point else log6(relative.rotation, relative.position)
        errors.append(error[list(c.rows)])
    return ca.vertcat(ca.SX(0, 1), *errors)
