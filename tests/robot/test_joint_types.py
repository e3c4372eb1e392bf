"""Ball joints and universal joints that a YAML declares, and limits that a URDF leaves out."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from derivatives import assert_derivative
from linkages import FREE, chain, joint, make_robot, write_ball_platform, write_robot
from symbolic_robot import SymbolicRobot
from tolerances import KINEMATICS

from orthocal import load_robot
from orthocal.errors import RobotError
from orthocal.robot.urdf import load_urdf

YAML = "closed_loop: []\ntype: []\nname_mot: [j0]\n"
ARM = [((0.1, 0, 0), "z"), ((0, 0.2, 0.1), "x"), ((0.3, 0, 0), "y")]


def declared(names, types):
    return YAML + f"joint_name: [{names}]\njoint_type: [{types}]\n"


def arm(folder, yaml):
    return make_robot(folder, chain(ARM), yaml)


def position_of_tip(robot, coordinates):
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.configuration(coordinates))
    return data.oMf[robot.frame_id("j2")]


def test_a_ball_joint_is_pinocchios(tmp_path):
    """Any turns about x, y, z are an orientation of a spherical joint in the same place."""
    robot = arm(tmp_path / "arm", declared("j1", "SPHERICAL"))
    assert list(robot.model.names) == ["universe", "j0", "j1_X", "j1_Y", "j1_Z", "j2"]
    theirs = pin.Model()
    first = theirs.addJoint(0, pin.JointModelRZ(), pin.SE3(np.eye(3), np.array(ARM[0][0])), "j0")
    ball = theirs.addJoint(
        first, pin.JointModelSpherical(), pin.SE3(np.eye(3), np.array(ARM[1][0])), "j1"
    )
    theirs.addJoint(ball, pin.JointModelRY(), pin.SE3(np.eye(3), np.array(ARM[2][0])), "j2")
    data = theirs.createData()
    rng = np.random.default_rng(3)
    for turn in rng.uniform(-1.2, 1.2, (20, 5)):
        rotation = pin.utils.rotate("x", turn[1]) @ pin.utils.rotate("y", turn[2])
        quaternion = pin.Quaternion(rotation @ pin.utils.rotate("z", turn[3])).coeffs()
        pin.forwardKinematics(theirs, data, np.array([turn[0], *quaternion, turn[4]]))
        ours = position_of_tip(robot, turn)
        assert np.abs(ours.homogeneous - data.oMi[3].homogeneous).max() < KINEMATICS


@pytest.mark.parametrize("axes", ["XY", "ZY", "YZ"])
def test_a_universal_joint_turns_about_its_first_axis_first(tmp_path, axes):
    robot = arm(tmp_path / "arm", declared("j1", f"UJOINT_{axes}"))
    assert list(robot.model.names)[2:4] == [f"j1_{a}" for a in axes]
    one, two = 0.4, -0.7
    turned = pin.utils.rotate(axes[0].lower(), one) @ pin.utils.rotate(axes[1].lower(), two)
    base = np.array(ARM[0][0]) + np.array(ARM[1][0])
    found = position_of_tip(robot, [0.0, one, two, 0.0])
    assert np.abs(found.rotation - turned).max() < KINEMATICS
    assert np.abs(found.translation - base - turned @ np.array(ARM[2][0])).max() < KINEMATICS


def test_a_joint_declared_fixed_does_not_move(tmp_path):
    robot = arm(tmp_path / "arm", declared("j2", "FIXED"))
    assert list(robot.model.names) == ["universe", "j0", "j1"]


def test_the_declared_joints_are_not_limited(tmp_path):
    limit = '<limit lower="-0.1" upper="0.1" effort="1" velocity="1"/>'
    joints = chain(ARM[:1]) + joint("j1", "j0", (0, 0, 0), "x", limit=limit)
    robot = make_robot(tmp_path / "arm", joints, declared("j1", "SPHERICAL"))
    assert np.isneginf(robot.model.lowerPositionLimit[1:]).all()
    assert np.isposinf(robot.model.upperPositionLimit[1:]).all()


@pytest.mark.parametrize("kind", ["SPHERICAL", "UJOINT_XY"])
def test_a_closed_robot_with_them_is_pinocchios_in_casadi_too(tmp_path, kind):
    robot = load_robot(write_ball_platform(tmp_path / "balls", kind))
    rng = np.random.default_rng(5)
    drives = robot.drive_zero + 0.1 * rng.normal(size=2)
    passive = robot.reference_passive + 0.3 * rng.normal(size=robot.passive_index.size)
    residual, jacobian = robot.evaluate_constraints(drives, passive)
    assert_derivative(
        jacobian[:, robot.passive_index],
        lambda p: robot.evaluate_constraints(drives, p)[0],
        passive,
    )
    d, p = ca.SX.sym("d", drives.size), ca.SX.sym("p", passive.size)
    symbolic = ca.Function(
        "g", [d, p], [SymbolicRobot(robot, drives=d, passive=p).closure_residual()]
    )
    assert np.abs(np.array(symbolic(drives, passive)).ravel() - residual).max() < KINEMATICS


@pytest.mark.parametrize(
    ("yaml", "message"),
    [
        (
            declared("j7", "SPHERICAL"),
            "joint_name: the URDF has no moving joint 'j7'; did you",
        ),
        (declared("plate", "FIXED"), "joint_name: the URDF has no moving joint 'plate'"),
        (declared("j1", "BALL"), "joint_type of 'j1': found 'BALL'; expected FIXED, SPHERICAL, UJ"),
        (declared("j1, j2", "FIXED"), "joint_type has 1 entries; joint_name has 2"),
        (declared("j1, j1", "FIXED, FIXED"), "joint_name names a joint twice"),
        (declared("j0", "SPHERICAL"), "joint_name: 'j0' is a motor"),
        (declared("j2", "SPHERICAL"), "joint_name: 'j2' needs the name 'j2_Y', which the URDF has"),
    ],
)
def test_declarations_that_do_not_fit_are_refused(tmp_path, yaml, message):
    fixed = joint("plate", "j2", (0, 0, 0), "") + joint("j2_Y", "plate", (0, 0, 0), "")
    with pytest.raises(RobotError, match=message) as caught:
        make_robot(tmp_path / "arm", chain(ARM) + fixed, yaml)
    assert caught.value.where.startswith(f"{tmp_path}/arm/arm.yaml")


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize(
    ("limit", "expected"),
    [
        ("", (-np.inf, np.inf)),
        ('lower="0" upper="0"', (0.0, 0.0)),
        ('lower="-0.5"', (-0.5, 0.0)),
        ('upper="0.5"', (0.0, 0.5)),
    ],
)
def test_limits_that_are_left_out(tmp_path, kind, limit, expected):
    """Neither: not limited, which no joint means that may not move. One: the other is URDF's 0."""
    own = FREE.replace("<limit", f"<limit {limit}")
    text = joint("slide", "base", (0, 0, 0), "z", kind=kind, limit=own)
    folder = write_robot(tmp_path / "slide", text, YAML)
    model = load_urdf(folder / "slide.urdf")
    assert (model.lowerPositionLimit[0], model.upperPositionLimit[0]) == expected


def test_a_limit_below_the_0_that_is_left_out_is_named(tmp_path):
    limit = '<limit upper="-0.5" effort="1" velocity="1"/>'
    folder = write_robot(tmp_path / "j", joint("j0", "base", (0, 0, 0), "z", limit=limit), YAML)
    with pytest.raises(RobotError, match=r"above its upper limit \(lower is 0"):
        load_robot(folder)


@pytest.mark.parametrize(
    "element",
    [
        '<gazebo reference="j0"><visual><material/></visual><collision/></gazebo>',
        '<gazebo><plugin name="p"><origin xyz="a"/><geometry/></plugin></gazebo>',
        '<transmission name="t"><joint name="j0"/><mass value="of no robot"/></transmission>',
    ],
)
def test_elements_of_other_programs_are_ignored(tmp_path, element):
    robot = make_robot(tmp_path / "arm", chain(ARM) + element, YAML)
    assert robot.model.njoints == 4
