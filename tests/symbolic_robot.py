"""A robot as plain CasADi expressions, with which the functions of orthocal are compared."""

from __future__ import annotations

import casadi as ca

from orthocal.effects.machine import express_machine, neutral_conditions
from orthocal.kinematics.se3 import exp6
from orthocal.kinematics.symbolic import (
    Pose,
    SymbolicTree,
    closure_residual,
    constant_pose,
    moved_frames,
    nominal_placement,
)


class SymbolicRobot:
    """Closed-loop model of a robot as expressions of drives, passive joints and errors.

    Errors map names of parameters to expressions or numbers. Conditions are neutral.
    """

    def __init__(self, robot, *, drives, passive, errors=None):
        self.robot = robot
        elementary = dict.fromkeys(robot.parameters.elementary, ca.SX(1, 1))
        for name, value in (errors or {}).items():
            for term, coefficient in robot.parameters[name].terms:
                elementary[term] = elementary[term] + coefficient * value
        conditions = {**neutral_conditions(robot), "coordinates": drives}
        actuated, twists = express_machine(robot, drives, elementary, conditions)
        coordinates = ca.SX(robot.model.nv, 1)
        coordinates[robot.drive_index.tolist()] = actuated
        coordinates[robot.passive_index.tolist()] = passive
        joints, frames = erroneous_placements(robot.model, twists)
        self.tree = SymbolicTree(
            robot.model, coordinates, joint_placements=joints, frame_placements=frames
        )

    def closure_residual(self):
        return closure_residual(self.robot, self.tree)


def erroneous_placements(model, twists):
    """Placements · exp6(δ) of the joints and of the frames with errors, by index."""
    joints, frames = {}, {}
    nonzero = {p: twist for p, twist in twists.items() if ca.sparsify(twist).nnz()}
    moved = moved_frames(nonzero)
    for placement, twist in nonzero.items():
        nominal = constant_pose(nominal_placement(model, placement, moved))
        poses = frames if placement.of_frame else joints
        poses[placement.index] = nominal * Pose(*exp6(twist))
    return joints, frames
