"""Changes of the lengths of rods, as twists of the placements that the rods carry."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
import pinocchio as pin

from orthocal.robot.frames import Placement, carriers, parent_frame
from orthocal.robot.model import Robot, Rod

SAME_POSITION = 1e-6
"""Largest difference between equal positions along a rod, as a fraction of its length. Smaller
components of a displacement per change of the length are rounding errors, too."""


def stretch_rod(robot: Robot, rod: Rod, change: ca.SX) -> dict[Placement, ca.SX]:
    """Twists of the placements on a rod whose length changes uniformly along its axis.

    Args:
        robot: The nominal robot.
        rod: One of its rods.
        change: Change of the length, [m].

    Returns:
        Placements, mapped to twists, shape (6,), [m, rad].
    """
    model = robot.model
    data = model.createData()
    pin.framesForwardKinematics(model, data, robot.configuration(robot.reference_posture))
    root, tip = (data.oMf[robot.frame_id(f)].translation for f in (rod.root, rod.tip))
    axis = (tip - root) / rod.length

    def fraction(position: np.ndarray) -> float:
        """Position along the rod: 0 at the root, 1 at the tip."""
        return float(axis @ (position - root)) / rod.length

    fractions = [fraction(data.oMi[i].translation) for i in range(model.njoints)]
    body = _body_of(robot, rod, fractions)
    twists: dict[Placement, ca.SX] = {}

    def move(placement: Placement, pose: pin.SE3, carrier: pin.SE3) -> None:
        """Displace a placement relative to its carrier by its share of the change."""
        stretched = fraction(pose.translation) - fraction(carrier.translation)
        if abs(stretched) > SAME_POSITION:
            local = pose.rotation.T @ axis * stretched
            local[np.abs(local) < SAME_POSITION] = 0.0
            twists[placement] = ca.vertcat(ca.sparsify(ca.SX(local)) * change, ca.SX(3, 1))

    for joint in range(1, model.njoints):
        if int(model.parents[joint]) == body:
            # pose before the motion of the joint, in which placements act
            pose = data.oMi[body] * model.jointPlacements[joint]
            move(Placement(joint, of_frame=False), pose, data.oMi[body])
    for frame in sorted(_used_frames(robot)):
        if int(model.frames[frame].parentJoint) == body:
            parent = parent_frame(model, frame)
            carrier = data.oMi[body] if parent is None else data.oMf[parent]
            move(Placement(frame, of_frame=True), data.oMf[frame], carrier)
    return twists


def _body_of(robot: Robot, rod: Rod, fractions: Sequence[float]) -> int:
    """Joint that moves the link of a rod: the last joint before the tip.

    Args:
        robot: The nominal robot.
        rod: One of its rods.
        fractions: Position of each joint along the rod, from 0 at the root to 1 at the tip.
    """
    model = robot.model
    first, joint = (int(model.frames[robot.frame_id(f)].parentJoint) for f in (rod.root, rod.tip))
    while joint != first and joint > 0 and fractions[joint] > 1.0 - SAME_POSITION:
        joint = int(model.parents[joint])
    return joint


def _used_frames(robot: Robot) -> set[int]:
    """Indices of the frames of closures, legs, rods and tool, and of the frames that carry them."""
    names = {*robot.frames, *(f for rod in robot.rods.values() for f in (rod.root, rod.tip))}
    return {f for name in names for f in carriers(robot.model, robot.frame_id(name))}
