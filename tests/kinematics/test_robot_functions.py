"""Functions of a robot against direct expressions of its errors and against Pinocchio."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from conftest import load_afresh
from symbolic_robot import SymbolicRobot
from tolerances import KINEMATICS

from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.robot_functions import robot_functions


def _draw(robot, size, seed=1):
    """Errors, commanded drives and passive coordinates; loops need not be closed."""
    rng = np.random.default_rng(seed)
    errors = size * rng.normal(size=len(robot_functions(robot).errors.names))
    drives = robot.drive_zero + 0.03 * rng.normal(size=len(robot.drives))
    passive = robot.reference_passive
    return errors, drives, passive + 0.3 * rng.normal(size=passive.size)


def _derivatives(functions, actuated, passive, placements):
    """g, ∂g by actuated and passive coordinates and by twists, of one posture."""
    g, g_a, g_q, nonzeros = (
        v[0] for v in functions.closure_jacobian(actuated, passive, placements)
    )
    g_t = np.zeros((g.size, functions.n_twists))
    g_t[functions.twist_pattern] = nonzeros
    return g, g_a, g_q, g_t


@pytest.mark.parametrize("size", [0.0, 1e-3, 0.3])
@pytest.mark.parametrize("name", ["orthoglide", "fivebar", "biglide"])
def test_derivatives_equal_those_of_the_expressions(request, name, size):
    """Every error the robot has: joints, frames, offsets, scales; closures and a frame."""
    robot = request.getfixturevalue(name)
    functions = robot_functions(robot)
    names = functions.errors.names
    theta = ca.SX.sym("theta", len(names))
    drives = ca.SX.sym("drives", len(robot.drives))
    passive = ca.SX.sym("passive", robot.passive_index.size)
    plain = SymbolicRobot(
        robot, drives=drives, passive=passive, errors={n: theta[i] for i, n in enumerate(names)}
    )
    frame = robot.frame_id(robot.closures[0].frame_b)
    pose = plain.tree.frame_pose(frame)
    row = np.array([0.3, -0.5, 0.8])
    g, p = plain.closure_residual(), ca.dot(ca.SX(row), pose.position)
    theirs = ca.Function(
        "theirs",
        [theta, drives, passive],
        [ca.densify(e) for e in (g, p)]
        + [ca.densify(ca.jacobian(e, v)) for e in (g, p) for v in (passive, theta)],
    )
    at, d, q = _draw(robot, size)
    expected = [np.asarray(v.full()) for v in theirs(at, d, q)]

    errors = functions.errors
    slopes = errors.placement_jacobian(at, np.eye(len(names)))
    geometry = errors.geometry(at)
    where = geometry.drives(d)[None], q[None], geometry.placements
    residual, g_a, g_q, g_t = _derivatives(functions, *where)
    joints, twists = functions.wrench_rows(frame, ca.SX(row).T)
    actuated, rest = functions.split(joints)
    of_frame = ca.Function("row", functions.symbols, [actuated, rest, twists])
    p_a, p_q, p_t = (np.asarray(v.full()) for v in of_frame(*(w.reshape(-1) for w in where)))

    _, by_drive_errors = geometry.drive_derivatives(d)

    def by_errors(by_twists, by_drives):
        by_drives = by_drives @ by_drive_errors
        return by_twists @ slopes + by_drives @ np.eye(len(names))[errors.drive_errors]

    position = float(row @ functions.position(robot.closures[0].frame_b)(*where)[0][0])
    found = [residual[:, None], np.array([[position]]), g_q, by_errors(g_t, g_a), p_q]
    found.append(by_errors(p_t, p_a))
    for ours, wanted in zip(found, expected, strict=True):
        assert np.abs(ours - wanted).max() < KINEMATICS


@pytest.mark.parametrize("name", ["closure_by_passive", "closure_and_tool", "closure_jacobian"])
def test_common_subexpressions_are_computed_once(orthoglide, name):
    function = getattr(robot_functions(orthoglide), name).function
    symbols = function.sx_in()
    shared = ca.Function("shared", symbols, ca.cse(function.call(symbols)))
    assert function.n_instructions() == shared.n_instructions()


def test_robots_share_functions_only_where_they_are_the_same(orthoglide):
    """One that was moved, though from the same file, has functions of its own."""
    again, moved = load_afresh("orthoglide"), orthoglide.with_errors({"x_bar_a.x": 1e-3})
    assert again is not orthoglide
    assert robot_functions(again) is robot_functions(orthoglide)
    assert moved.yaml == orthoglide.yaml
    assert robot_functions(moved) is not robot_functions(orthoglide)
    zero = [LoopClosure(r).forward(orthoglide.drive_zero + 0.01) for r in (orthoglide, moved)]
    assert np.abs(zero[1] - zero[0]).max() > 1e-4
