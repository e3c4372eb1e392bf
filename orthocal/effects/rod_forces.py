"""Axial forces of the rods, from the statics of the closed loops with locked drives.

A rod that becomes longer by dℓ moves the tool centre point by ∂p/∂ℓ dℓ. By virtual work on the
nominal machine, a force f on the tool centre point causes the tension

    F = f · ∂p/∂ℓ = f · p_ℓ − λ · g_ℓ,  g_qᵀ λ = p_qᵀ f

Subscripts denote the Jacobians of the tool p and of the closures g, from Pinocchio. The closing
forces λ balance f at the passive joints q.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import pinocchio as pin

from orthocal.arrays import Array
from orthocal.effects.protocol import Placement
from orthocal.effects.rods import stretch_rod
from orthocal.robot.closing import invert_closures
from orthocal.robot.frames import carriers, frame_jacobian
from orthocal.robot.model import Robot, require_tcp


@dataclass(frozen=True, slots=True, eq=False)
class _Displacement:
    """Displacement of a placement per unit change of a rod's length."""

    placement: Placement
    direction: Array
    """Displacement in the axes of the placement, shape (3,)."""
    moves_tool: bool
    """True if the placement carries the tool."""
    moves_closures: tuple[int, ...]
    """For each closure 1 if frame b moves, minus 1 if frame a moves."""


class RodForces:
    """Axial forces of the rods of a nominal machine.

    Args:
        robot: The nominal robot, with a tool centre point.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot, model = robot, robot.model
        self._tool = robot.frame_id(require_tcp(robot).frame)
        pairs = [(robot.frame_id(c.frame_a), robot.frame_id(c.frame_b)) for c in robot.closures]
        # residuals are in the axes of frame a for points, of frame b for poses
        self._axes = [
            a if c.kind == "3d" else b for c, (a, b) in zip(robot.closures, pairs, strict=True)
        ]
        self._rods = list(robot.rods.values())
        self._displacements: list[tuple[int, _Displacement]] = []
        for i, rod in enumerate(self._rods):
            for placement, twist in stretch_rod(robot, rod, ca.SX(1.0)).items():
                moves = [[_carries(model, placement, f) for f in pair] for pair in pairs]
                displacement = _Displacement(
                    placement,
                    np.array(ca.DM(twist[:3])).reshape(3),
                    _carries(model, placement, self._tool),
                    tuple(int(b) - int(a) for a, b in moves),
                )
                self._displacements.append((i, displacement))
        placements = dict.fromkeys(d.placement for _, d in self._displacements)
        self._index = {placement: i for i, placement in enumerate(placements)}

    def __call__(self, coordinates: Array) -> Array:
        """Axial forces of the rods per unit force on the tool centre point, tension positive.

        Args:
            coordinates: Joint coordinates with closed loops, shape (K, nv), [m, rad].

        Returns:
            ∂p/∂ℓ, shape (K, n_rods, 3), for forces along x, y and z of the world, in the order of
            `Robot.rods`.
        """
        data = self.robot.model.createData()
        states = [self._evaluate(q, data) for q in coordinates]
        by_joints, by_tool, axes, placements = (np.array(v) for v in zip(*states, strict=True))
        passive = self.robot.passive_index
        multipliers = by_tool[:, :, passive] @ invert_closures(by_joints[:, :, passive])
        closing_forces = self._closing_forces(np.swapaxes(multipliers, 1, 2), axes)
        result = np.zeros((len(coordinates), len(self._rods), 3))
        for i, d in self._displacements:
            direction = placements[:, self._index[d.placement]] @ d.direction
            forces = np.tile(np.eye(3) * d.moves_tool, (len(coordinates), 1, 1))
            forces -= np.tensordot(np.array(d.moves_closures), closing_forces, axes=(0, 1))
            result[:, i] += np.einsum("kij,ki->kj", forces, direction)
        return result

    def _evaluate(self, coordinates: Array, data: pin.Data) -> tuple[Array, ...]:
        """Jacobians and rotations in one posture.

        Returns:
            ∂g/∂q, ∂p/∂q, and the world rotations of the axes of the closures and of the displaced
            placements, shape (n, 3, 3) each.
        """
        robot, model = self.robot, self.robot.model
        _, by_joints = robot.evaluate_constraints_at(coordinates, data=data)
        pin.updateFramePlacements(model, data)
        by_tool = frame_jacobian(model, data, self._tool)[:3]
        axes = np.array([data.oMf[frame].rotation for frame in self._axes]).reshape(-1, 3, 3)
        placements = [self._rotation(placement, data) for placement in self._index]
        return by_joints, by_tool, axes, np.array(placements).reshape(-1, 3, 3)

    def _closing_forces(self, multipliers: Array, axes: Array) -> Array:
        """Closing forces in the world per unit force on the tool, (K, n_closures, 3, 3)."""
        result, first = np.zeros((len(multipliers), len(self._axes), 3, 3)), 0
        for i, closure in enumerate(self.robot.closures):
            forces = np.zeros((len(multipliers), 6, 3))
            forces[:, list(closure.rows)] = multipliers[:, first : first + len(closure.rows)]
            result[:, i] = axes[:, i] @ forces[:, :3]
            first += len(closure.rows)
        return result

    def _rotation(self, placement: Placement, data: pin.Data) -> Array:
        """World rotation of a placement before the motion of its joint, shape (3, 3)."""
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
