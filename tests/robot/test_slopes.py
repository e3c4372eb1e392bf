"""Derivatives by geometry, against those of the expressions and Pinocchio's own."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from tolerances import KINEMATICS

from orthocal.kinematics.slopes import SharedPlacements, adjoint, log6_jacobian, right_jacobian
from orthocal.kinematics.symbolic import SymbolicRobot, constant_pose


@pytest.mark.parametrize("size", [0.0, 1e-3, 0.3])
@pytest.mark.parametrize("name", ["orthoglide", "fivebar", "biglide"])
def test_slopes_equal_those_of_the_expressions(request, name, size):
    """Every parameter the robot has: joints, frames, offsets, scales and sums."""
    robot = request.getfixturevalue(name)
    names = robot.parameters.names
    theta = ca.SX.sym("theta", len(names))
    drives = ca.SX.sym("drives", len(robot.drives))
    passive = ca.SX.sym("passive", robot.passive_index.size)
    errors = {n: theta[i] for i, n in enumerate(names)}

    shared = SharedPlacements(robot, theta, errors)
    machine = shared.machine(drives=drives, passive=passive)
    by_joints, by_theta = shared.closure_slopes(machine)
    frame = robot.frame_id(robot.closures[0].frame_b)
    row = ca.SX([[0.3, -0.5, 0.8]])
    p_joints, p_theta = shared.position_slopes(machine, frame, row)
    index = robot.passive_index.tolist()
    ours = ca.Function(
        "ours",
        [theta, drives, passive, shared.values, shared.slope_nonzeros],
        [machine.closure_residual(), by_joints[:, index], by_theta, p_joints[:, index], p_theta],
    )
    plain = SymbolicRobot(robot, drives=drives, passive=passive, errors=errors)
    g = plain.closure_residual()
    p = row @ plain.tree.frame_pose(frame).position
    theirs = ca.Function(
        "theirs",
        [theta, drives, passive],
        [g, *(ca.jacobian(e, v) for e in (g, p) for v in (passive, theta))],
    )
    rng = np.random.default_rng(1)
    at = size * rng.normal(size=len(names))
    d = robot.drive_zero + 0.03 * rng.normal(size=len(robot.drives))
    q = robot.zero[robot.passive_index] + 0.3 * rng.normal(size=robot.passive_index.size)
    found, expected = ours(at, d, q, *shared.function(at)), theirs(at, d, q)
    for a, b in zip(found, expected, strict=True):
        assert np.abs(np.asarray(a.full()) - np.asarray(b.full())).max() < KINEMATICS


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.1, 1.0])
def test_jacobians_of_exp6_and_log6_equal_pinocchios(angle):
    xi = np.r_[0.2, -0.4, 0.1, angle * np.array([0.36, 0.48, 0.8])]
    found = np.asarray(ca.DM(ca.evalf(right_jacobian(ca.SX(xi)))))
    assert np.abs(found - pin.Jexp6(xi)).max() < KINEMATICS
    pose = pin.exp6(xi)
    found = np.asarray(ca.DM(ca.evalf(log6_jacobian(constant_pose(pose)))))
    assert np.abs(found - pin.Jlog6(pose)).max() < 10 * KINEMATICS


def test_the_adjoint_is_pinocchios():
    pose = pin.exp6(np.array([0.1, 0.2, 0.3, 0.5, -0.4, 0.2]))
    found = np.asarray(ca.DM(ca.evalf(adjoint(constant_pose(pose)))))
    assert np.abs(found - pose.toActionMatrix()).max() < KINEMATICS
