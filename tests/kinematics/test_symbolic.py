"""Symbolic kinematics against Pinocchio, values and derivatives."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from derivatives import assert_derivative, central_differences
from symbolic_robot import SymbolicRobot, erroneous_placements
from tolerances import DERIVATIVE, KINEMATICS

from orthocal.effects.protocol import Placement
from orthocal.kinematics.symbolic import SymbolicTree
from orthocal.robot.frames import place_frames
from orthocal.robot.urdf import load_urdf


@pytest.fixture(scope="module")
def all_models(root):
    return {
        "orthoglide": load_urdf(root / "robots/orthoglide/orthoglide.urdf"),
        "fivebar": load_urdf(root / "tests/robots/fivebar/fivebar.urdf"),
        "tilted": load_urdf(root / "tests/robots/tilted/tilted.urdf"),
    }


NAMES = ["orthoglide", "fivebar", "tilted"]


def build(model, joints, frames):
    """Poses of all frames as one function of (q, joint twists, frame twists)."""
    q = ca.SX.sym("q", model.nv)
    dj = ca.SX.sym("dj", 6, len(joints))
    df = ca.SX.sym("df", 6, len(frames))
    at = [Placement(model.getJointId(name), False) for name in joints]
    at += [Placement(frame, True) for frame in frames]
    twists = dict(zip(at, ca.horzsplit(ca.horzcat(dj, df)), strict=True))
    at_joints, at_frames = erroneous_placements(model, twists)
    tree = SymbolicTree(model, q, joint_placements=at_joints, frame_placements=at_frames)
    poses = [tree.frame_pose(i) for i in range(1, model.nframes)]
    stacked = ca.vertcat(*(ca.vertcat(ca.vec(p.rotation), p.position) for p in poses))
    return ca.Function("poses", [q, dj, df], [stacked])


def pinocchio_poses(model, v, joints, frames, dj, df):
    moved = model.copy()
    for i, name in enumerate(joints):
        k = moved.getJointId(name)
        moved.jointPlacements[k] = moved.jointPlacements[k] * pin.exp6(dj[:, i])
    place_frames(moved, model, {frame: df[:, i] for i, frame in enumerate(frames)})
    data = moved.createData()
    pin.framesForwardKinematics(moved, data, pin.integrate(moved, pin.neutral(moved), v))
    poses = [data.oMf[i] for i in range(1, moved.nframes)]
    return np.concatenate([np.r_[p.rotation.T.ravel(), p.translation] for p in poses])


def some_frames(model):
    """Links and moving joints whose frames have errors, some on one body."""
    kinds = [model.frames[i].type for i in range(1, model.nframes)]
    bodies, joints = (
        [i for i, kind in enumerate(kinds, 1) if kind == of]
        for of in (pin.FrameType.BODY, pin.FrameType.JOINT)
    )
    return bodies[:: max(1, len(bodies) // 6)] + joints[::3]


@pytest.mark.parametrize("name", NAMES)
def test_poses_equal_pinocchios(all_models, name):
    model = all_models[name]
    joints, frames = list(model.names)[1:], some_frames(model)
    function = build(model, joints, frames)
    rng = np.random.default_rng(7)
    for size in (0.0, 1e-9, 1e-3, 0.15, 0.5, 2.5) * 3:
        v = rng.uniform(-3.0, 3.0, model.nv)
        dj = size * rng.uniform(-1.0, 1.0, (6, len(joints)))
        df = size * rng.uniform(-1.0, 1.0, (6, len(frames)))
        ours = np.asarray(function(v, dj, df)).ravel()
        theirs = pinocchio_poses(model, v, joints, frames, dj, df)
        assert np.abs(ours - theirs).max() < KINEMATICS * max(1.0, np.abs(theirs).max())


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_by_coordinates_and_errors_are_exact(all_models, name):
    model = all_models[name]
    joints, frames = list(model.names)[1:], some_frames(model)
    function = build(model, joints, frames)
    n, m = model.nv, 6 * len(joints)
    x = ca.MX.sym("x", n + m + 6 * len(frames))
    split = ca.vertsplit(x, [0, n, n + m, x.numel()])
    y = function(split[0], ca.reshape(split[1], 6, -1), ca.reshape(split[2], 6, -1))
    value, slope = ca.Function("y", [x], [y]), ca.Function("dy", [x], [ca.jacobian(y, x)])
    rng = np.random.default_rng(11)
    along = rng.normal(size=(x.numel(), 12))
    for size in (0.0, 0.2):
        at = np.r_[rng.uniform(-2, 2, n), size * rng.uniform(-1, 1, x.numel() - n)]
        assert_derivative(
            slope(at).full() @ along,
            lambda t, at=at: value(at + along @ t).full().ravel(),
            np.zeros(12),
            step=1e-5,
        )


@pytest.mark.parametrize("robot", ["orthoglide", "fivebar", "biglide"])
def test_closure_residual_equals_pinocchios_constraint_error(request, robot):
    """Also with errors on everything, by a robot that has them in its Pinocchio placements."""
    r = request.getfixturevalue(robot)
    names = r.parameters.names
    drives, passive = ca.SX.sym("d", len(r.drives)), ca.SX.sym("p", r.passive_index.size)
    theta = ca.SX.sym("t", len(names))
    symbolic = SymbolicRobot(
        r, drives=drives, passive=passive, errors={n: theta[i] for i, n in enumerate(names)}
    )
    g = symbolic.closure_residual()
    function = ca.Function("g", [drives, passive, theta], [g, ca.jacobian(g, passive)])
    rng = np.random.default_rng(9)
    for size in (0.0, 1e-3, 0.3):
        errors = size * rng.normal(size=len(names))
        with_errors = r.with_errors(dict(zip(names, errors, strict=True)))
        d = r.drive_zero + 0.05 * rng.normal(size=len(r.drives))
        p = r.reference_passive + 0.3 * rng.normal(size=r.passive_index.size)
        residual, jacobian = with_errors.evaluate_constraints(d, p)
        ours, slope = (np.asarray(v) for v in function(d, p, errors))
        assert np.abs(ours.ravel() - residual).max() < KINEMATICS
        assert np.abs(slope - jacobian[:, r.passive_index]).max() < KINEMATICS * 10
        numeric = central_differences(
            lambda u, d=d, e=errors: np.asarray(function(d, u, e)[0]).ravel(), p
        )
        assert np.abs(slope - numeric).max() < DERIVATIVE


def test_error_derivatives_equal_pinocchios_kinematic_regressor(orthoglide):
    """d pose / d placement twist at zero error, as a twist in the frame's own axes."""
    model = orthoglide.model
    joints = list(model.names)[1:]
    frame = orthoglide.frame_id("tcp")
    q, dj = ca.SX.sym("q", model.nv), ca.SX.sym("dj", 6, len(joints))
    twists = {Placement(model.getJointId(n), False): dj[:, i] for i, n in enumerate(joints)}
    tree = SymbolicTree(model, q, joint_placements=erroneous_placements(model, twists)[0])
    pose = tree.frame_pose(frame)
    stacked = ca.vertcat(ca.vec(pose.rotation), pose.position)
    slope = ca.Function("slope", [q, dj], [ca.jacobian(stacked, ca.vec(dj))])
    v = np.random.default_rng(5).uniform(-1.0, 1.0, model.nv)
    ours = np.asarray(slope(v, np.zeros((6, len(joints)))).full())
    data = model.createData()
    pin.framesForwardKinematics(model, data, orthoglide.configuration(v))
    theirs = pin.computeFrameKinematicRegressor(model, data, frame, pin.ReferenceFrame.LOCAL)
    rotation = data.oMf[frame].rotation
    linear = rotation.T @ ours[9:]
    turned = ours[:9].reshape(3, 3, -1, order="F")
    angular = np.stack(
        [
            [s[2, 1], s[0, 2], s[1, 0]]
            for s in (rotation.T @ turned[:, :, i] for i in range(turned.shape[2]))
        ],
        axis=1,
    )
    assert np.abs(np.vstack([linear, angular]) - theirs).max() < KINEMATICS
