"""Axial forces of the rods, from the statics of the closed loops with the drives held.

A rod that becomes longer by dℓ moves the tool centre point by ∂p/∂ℓ dℓ. By virtual work on the
nominal machine a force f on the tool centre point causes the tension

    F = f · ∂p/∂ℓ

With the tool's Jacobian and the closures' Jacobian by Pinocchio, the forces λ that close the loops
balance f at the passive joints, g_qᵀ λ = p_qᵀ f, so that F = f · p_ℓ − λ · g_ℓ.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import pinocchio as pin

from orthocal.arrays import Array
from orthocal.effects.machine import stretch_rod
from orthocal.effects.protocol import Placement
from orthocal.robot.frames import carriers
from orthocal.robot.model import Robot, require_tcp


@dataclass(frozen=True, slots=True, eq=False)
class _Displacement:
    """Displacement of a placement by the unit change of a rod's length."""

    placement: Placement
    direction: Array
    """In the axes of the placement, shape (3,)."""
    moves_tool: bool
    moves_closures: tuple[int, ...]
    """1 for each closure whose frame b moves, less 1 if frame a moves."""


class RodForces:
    """Axial forces of the rods of a nominal machine.

    Args:
        robot: The nominal robot, with a tool centre point.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot, model = robot, robot.model
        self._tool = robot.frame_id(require_tcp(robot).frame)
        pairs = [(robot.frame_id(c.frame_a), robot.frame_id(c.frame_b)) for c in robot.closures]
        # a displacement counts in the axes of frame a for points, of frame b for poses
        self._axes = [
            a if c.kind == "3d" else b for c, (a, b) in zip(robot.closures, pairs, strict=True)
        ]
        self._rods: list[list[_Displacement]] = []
        for rod in robot.rods.values():
            displacements = []
            for placement, twist in stretch_rod(robot, rod, ca.SX(1.0)).items():
                moves = [[_carries(model, placement, f) for f in pair] for pair in pairs]
                displacements.append(
                    _Displacement(
                        placement,
                        np.array(ca.DM(twist[:3])).reshape(3),
                        _carries(model, placement, self._tool),
                        tuple(int(b) - int(a) for a, b in moves),
                    )
                )
            self._rods.append(displacements)

    def __call__(self, coordinates: Array, force: Array) -> Array:
        """Axial forces, tension positive.

        Args:
            coordinates: Joint coordinates with closed loops, shape (K, nv), [m, rad].
            force: On the tool centre point in each posture, shape (K, 3), [N].

        Returns:
            Shape (K, n_rods), in the order of `Robot.rods`, [N].
        """
        data = self.robot.model.createData()
        rows = [self._forces(q, f, data) for q, f in zip(coordinates, force, strict=True)]
        return np.array(rows).reshape(len(coordinates), len(self._rods))

    def _forces(self, coordinates: Array, force: Array, data: pin.Data) -> list[float]:
        """Axial forces in one posture, [N]."""
        robot, model = self.robot, self.robot.model
        _, by_joints = robot.evaluate_constraints_at(coordinates, data=data)
        pin.updateFramePlacements(model, data)
        world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        by_tool = pin.getFrameJacobian(model, data, self._tool, world)[:3]
        passive = robot.passive_index
        closing = np.linalg.lstsq(
            by_joints[:, passive].T, by_tool[:, passive].T @ force, rcond=1e-10
        )[0]
        along = self._closing_forces(closing, data)
        result = []
        for displacements in self._rods:
            work = 0.0
            for d in displacements:
                moved = self._rotation(d.placement, data) @ d.direction
                balance = force if d.moves_tool else np.zeros(3)
                balance = balance - np.array(d.moves_closures) @ along
                work += float(balance @ moved)
            result.append(work)
        return result

    def _closing_forces(self, closing: Array, data: pin.Data) -> Array:
        """Forces that close the loops, in the world, shape (n_closures, 3), [N]."""
        result, first = np.zeros((len(self._axes), 3)), 0
        for i, (closure, frame) in enumerate(zip(self.robot.closures, self._axes, strict=True)):
            force = np.zeros(6)
            force[list(closure.rows)] = closing[first : first + len(closure.rows)]
            result[i] = data.oMf[frame].rotation @ force[:3]
            first += len(closure.rows)
        return result

    def _rotation(self, placement: Placement, data: pin.Data) -> Array:
        """Axes of a placement in the world, before the motion of its joint, shape (3, 3)."""
        if placement.of_frame:
            return np.asarray(data.oMf[placement.index].rotation)
        model, joint = self.robot.model, placement.index
        parent = data.oMi[int(model.parents[joint])].rotation
        return np.asarray(parent @ model.jointPlacements[joint].rotation)


def _carries(model: pin.Model, placement: Placement, frame: int) -> bool:
    """True if a displacement of a placement moves a frame."""
    if placement.of_frame:
        return placement.index in carriers(model, frame)
    return placement.index in list(model.supports[model.frames[frame].parentJoint])
