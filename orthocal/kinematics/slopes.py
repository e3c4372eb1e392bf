"""Derivatives of closures and frame positions by the geometry of the machine, not by the graph.

All that depends on the error parameters alone, the placements and how they move, is the same in
every posture and evaluated once (`SharedPlacements`). What is left for a posture is short: a joint
or an error that acts in a frame X moves another frame b by the twist Ad(b⁻¹ X) ξ. This is several
times less work than differentiating the expressions, and as exact.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from orthocal.kinematics.symbolic import (
    Pose,
    SymbolicRobot,
    SymbolicTree,
    erroneous_placements,
    exp6,
    express_errors,
    hangs_on,
    log6,
)
from orthocal.robot.model import Closure, Robot, joint_axis


@dataclass(frozen=True, slots=True, eq=False)
class Moved:
    """A joint or a frame whose placement depends on parameters."""

    index: int
    """Of the joint, or of the frame."""
    of_frame: bool
    first: int
    """Row of its first twist component in the slopes."""


class SharedPlacements:
    """Placements as functions of the parameters, to be evaluated once for all postures.

    Args:
        robot: The nominal robot.
        theta: Parameters, shape (n,).
        errors: Parameter name of the robot to expression of theta, or number.

    Attributes:
        function: theta to `values` (12 a moved placement: rotation by columns, position) and the
            nonzeros of `slopes`, shape (6 a moved placement, n): ∂ξ/∂θ, with placement · exp6(ξ).
        values: Symbol for the values.
        slopes: Symbol for the slopes, sparse.
    """

    def __init__(self, robot: Robot, theta: ca.SX, errors: Mapping[str, ca.SX | float]) -> None:
        self.robot = robot
        self.theta = theta
        self.errors = dict(errors)
        expressions = express_errors(robot, errors)
        joints, frames = erroneous_placements(robot.model, expressions)
        self._constant: tuple[dict[int, Pose], dict[int, Pose]] = ({}, {})
        self.moved: list[Moved] = []
        values, slopes = [ca.SX(0, 1)], [ca.SX(0, theta.numel())]
        for of_frame, poses, twists in (
            (False, joints, expressions.joint_twists),
            (True, frames, expressions.frame_twists),
        ):
            for i, pose in poses.items():
                by_theta = ca.jacobian(twists[i], theta)
                if by_theta.nnz() == 0:
                    self._constant[of_frame][i] = pose
                    continue
                self.moved.append(Moved(i, of_frame, 6 * len(self.moved)))
                values.append(ca.densify(ca.vertcat(ca.vec(pose.rotation), pose.position)))
                slopes.append(right_jacobian(twists[i]) @ by_theta)
        stacked = ca.sparsify(ca.vertcat(*slopes))
        self.values = ca.SX.sym("placements", 12 * len(self.moved))
        self.slopes = ca.SX.sym("slopes", stacked.sparsity())
        self.function = ca.Function(
            "placements",
            [theta],
            [ca.vertcat(*values), ca.densify(stacked.nz[:])],
            ["theta"],
            ["values", "slopes"],
        )

    @property
    def slope_nonzeros(self) -> ca.SX:
        """The nonzeros of the slopes, as a column of symbols."""
        return self.slopes.nz[:]

    def machine(self, *, drives: ca.SX, passive: ca.SX) -> SymbolicRobot:
        """The closed-loop model with these placements: offsets and gains by theta as before."""
        joints, frames = dict(self._constant[0]), dict(self._constant[1])
        for k, moved in enumerate(self.moved):
            v = self.values[12 * k : 12 * k + 12]
            pose = Pose(ca.reshape(v[:9], 3, 3), v[9:])
            (frames if moved.of_frame else joints)[moved.index] = pose
        return SymbolicRobot(
            self.robot,
            drives=drives,
            passive=passive,
            errors=self.errors,
            placements=(joints, frames),
        )

    def closure_slopes(self, machine: SymbolicRobot) -> tuple[ca.SX, ca.SX]:
        """Derivatives of the closure residual.

        Args:
            machine: From `machine`.

        Returns:
            By the joint coordinates, shape (closure_rows, nv), and by theta, shape
            (closure_rows, n).
        """
        by_joints, by_theta = [], []
        for closure in self.robot.closures:
            joints, twists = self._closure_blocks(machine, closure)
            by_joints.append(joints)
            by_theta.append(self._to_theta(machine, joints, twists))
        return ca.vertcat(*by_joints), ca.vertcat(*by_theta)

    def position_slopes(
        self, machine: SymbolicRobot, frame: int, row: ca.SX
    ) -> tuple[ca.SX, ca.SX]:
        """Derivatives of row · p, p the position of a frame and row a constant, shape (1, 3).

        Returns:
            By the joint coordinates, shape (1, nv), and by theta, shape (1, n).
        """
        tree = machine.tree
        position = tree.frame_pose(frame).position
        joints = ca.SX(1, self.robot.model.nv)
        twists = ca.SX(1, 6 * len(self.moved))
        for source in self._sources(tree, frame):
            turned = row @ source.pose.rotation
            arm = source.pose.rotation.T @ (position - source.pose.position)
            block = ca.horzcat(turned, -turned @ ca.skew(arm))
            self._place(joints, twists, source, block)
        return joints, self._to_theta(machine, joints, twists)

    def _to_theta(self, machine: SymbolicRobot, joints: ca.SX, twists: ca.SX) -> ca.SX:
        """Chain rule: placements by their slopes, drives by their offsets and gains."""
        total = ca.sparsify(twists) @ self.slopes
        by_drives = ca.jacobian(machine.actuated, self.theta)
        return total + joints[:, self.robot.drive_index.tolist()] @ by_drives

    def _closure_blocks(self, machine: SymbolicRobot, closure: Closure) -> tuple[ca.SX, ca.SX]:
        tree = machine.tree
        a, b = self.robot.frame_id(closure.frame_a), self.robot.frame_id(closure.frame_b)
        pose_b = tree.frame_pose(b)
        relative = tree.frame_pose(a).relative(pose_b)
        if closure.kind == "3d":
            outer = ca.horzcat(relative.rotation, ca.SX(3, 3))
        else:
            outer = log6_jacobian(relative)
        outer = outer[list(closure.rows), :]
        joints = ca.SX(len(closure.rows), self.robot.model.nv)
        twists = ca.SX(len(closure.rows), 6 * len(self.moved))
        of_a = {s.key: s for s in self._sources(tree, a)}
        of_b = {s.key: s for s in self._sources(tree, b)}
        for key in (*of_b, *of_a):
            if key in of_a and key in of_b:
                continue  # moves both alike
            sign, source = (1.0, of_b[key]) if key in of_b else (-1.0, of_a[key])
            block = sign * (outer @ adjoint(pose_b.relative(source.pose)))
            self._place(joints, twists, source, block)
        return joints, twists

    def _sources(self, tree: SymbolicTree, frame: int) -> list[_Source]:
        """All that moves a frame: its joints, and errors of joints and of frames it hangs on."""
        moved = {(m.index, m.of_frame): m.first for m in self.moved}
        found = [
            _Source((i, False), tree.joint_base(i), i, moved.get((i, False)))
            for i in tree.joints_to(frame)
        ]
        current: int | None = frame
        while current is not None:
            if (current, True) in moved:
                found.append(
                    _Source((current, True), tree.frame_pose(current), None, moved[current, True])
                )
            current = hangs_on(self.robot.model, current)
        return found

    def _place(self, joints: ca.SX, twists: ca.SX, source: _Source, block: ca.SX) -> None:
        """Put what a unit twist in a source's frame does where the source's columns are."""
        if source.first is not None:
            twists[:, source.first : source.first + 6] += block
        if source.joint is not None:
            model = self.robot.model
            joint = model.joints[source.joint]
            if joint.nv == 1:
                axis = ca.sparsify(ca.SX(joint_axis(model, source.joint)))
            else:
                axis = ca.vertcat(ca.SX.eye(3), ca.SX(3, 3))  # a translation joint
            joints[:, joint.idx_v : joint.idx_v + joint.nv] += block @ axis


@dataclass(frozen=True, slots=True, eq=False)
class _Source:
    """A frame in which a joint or an error acts."""

    key: tuple[int, bool]
    pose: Pose
    joint: int | None
    first: int | None


def adjoint(pose: Pose) -> ca.SX:
    """Action of a pose on twists (translation, rotation), shape (6, 6)."""
    turned = ca.skew(pose.position) @ pose.rotation
    return ca.blockcat([[pose.rotation, turned], [ca.SX(3, 3), pose.rotation]])


def right_jacobian(twist: ca.SX) -> ca.SX:
    """T with exp6(δ + dδ) = exp6(δ) exp6(T dδ) to first order, shape (6, 6)."""
    delta = ca.SX.sym("delta", 6)
    pose = exp6(delta)
    by_position = pose.rotation.T @ ca.jacobian(pose.position, delta)
    columns = ca.jacobian(ca.vec(pose.rotation), delta)
    turned = [ca.inv_skew(pose.rotation.T @ ca.reshape(columns[:, k], 3, 3)) for k in range(6)]
    result = ca.vertcat(by_position, ca.horzcat(*turned))
    return ca.Function("right_jacobian", [delta], [result])(twist)


def log6_jacobian(pose: Pose) -> ca.SX:
    """Derivative of log6(M exp6(ξ)) by ξ at 0, as Pinocchio's Jlog6, shape (6, 6)."""
    r, p = ca.SX.sym("r", 3, 3), ca.SX.sym("p", 3)
    error = log6(Pose(r, p))
    by_rotation = ca.jacobian(error, ca.vec(r))
    by_position = ca.jacobian(error, p) @ r
    turns = [ca.vec(r @ ca.skew(ca.SX(np.eye(3)[k]))) for k in range(3)]
    result = ca.horzcat(by_position, by_rotation @ ca.horzcat(*turns))
    return ca.Function("log6_jacobian", [r, p], [result])(pose.rotation, pose.position)
