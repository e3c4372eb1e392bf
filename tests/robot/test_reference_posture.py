"""The mechanical zero: found, given, and refused, on linkages with the traits of other people's."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from linkages import (
    FREE,
    chain,
    joint,
    make_robot,
    write_ball_platform,
    write_crooked_loop,
    write_wide_linkage,
)
from tolerances import CLOSED, KINEMATICS

from orthocal import load_robot
from orthocal.errors import ClosureError, RobotError
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.robot.reference_posture import count_free_motions


def gap(robot, coordinates):
    """Distance of the first closure's frames in plain Pinocchio, [m]."""
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.configuration(coordinates))
    closure = robot.closures[0]
    a, b = (data.oMf[robot.frame_id(n)].translation for n in (closure.frame_a, closure.frame_b))
    return float(np.linalg.norm(a - b))


def test_loops_that_newton_does_not_close_are_closed(tmp_path):
    robot = load_robot(write_crooked_loop(tmp_path / "crooked"))

    assert gap(robot, robot.reference_posture) < CLOSED
    assert robot.drive_zero.tolist() == [0.0]
    assert not robot.drives[0].zero_computed
    passive = robot.reference_passive
    assert np.abs(LoopClosure(robot).close([[0.0]])[0] - passive).max() < CLOSED
    assert np.abs(robot.reference_posture).max() <= np.pi


def test_drives_without_a_zero_are_moved_until_the_loops_close(tmp_path):
    """Not much further than to where the rods first meet, and clear of that singular posture."""
    robot = load_robot(write_wide_linkage(tmp_path / "wide"))
    assert gap(robot, robot.reference_posture) < CLOSED
    assert all(d.zero_computed for d in robot.drives)
    assert np.array_equal(robot.drive_zero, robot.reference_posture[robot.drive_index])
    # elbows at least 0.6 apart until both cranks are at 90 degrees
    assert np.pi / 2 < np.abs(robot.drive_zero).max() < 0.9 * np.pi
    assert count_free_motions(robot) == 0
    solver = LoopClosure(robot)
    assert np.abs(solver.close(robot.drive_zero) - robot.reference_passive).max() < KINEMATICS
    solver.close(robot.drive_zero + 0.01)


def test_drives_without_passive_joints_close_a_loop_alone(tmp_path):
    """Two slides along one line, 0.2 apart: each comes half of the way."""
    slides = [joint(f"s{i}", "base", (0.2 * i, 0, 0), "x", kind="prismatic") for i in range(2)]
    yaml = "closed_loop: [[s0, s1]]\ntype: [3d]\nname_mot: [s0, s1]\n"
    robot = make_robot(tmp_path / "slides", "".join(slides), yaml)
    assert np.abs(robot.drive_zero - [0.1, -0.1]).max() < KINEMATICS


def test_a_given_zero_is_kept(tmp_path):
    """One drive is told where it is: only the other one moves."""
    extra = "  drives: {motor_a: {zero_deg: 150}}\n"
    robot = load_robot(write_wide_linkage(tmp_path / "wide", extra))
    assert robot.drives[0].zero == np.deg2rad(150)
    assert [d.zero_computed for d in robot.drives] == [False, True]
    assert gap(robot, robot.reference_posture) < CLOSED


def test_a_drive_that_cannot_be_at_0_stands_at_its_nearest_limit(tmp_path):
    limit = '<limit lower="0.12" upper="0.39" effort="1" velocity="1"/>'
    slide = joint("slide", "base", (0, 0, 0), "x", kind="prismatic", limit=limit)
    robot = make_robot(tmp_path / "s", slide, "closed_loop: []\ntype: []\nname_mot: [slide]\n")
    assert robot.drives[0].zero == 0.12
    assert robot.drives[0].zero_computed


def test_given_zeros_at_which_loops_stay_open_are_refused_with_how_far(tmp_path):
    extra = "  drives: {motor_a: {zero_deg: 0}, motor_b: {zero_deg: 0}}\n"
    folder = write_wide_linkage(tmp_path / "wide", extra)
    message = (
        r"wide.yaml: its loops do not close in any posture that was found within the limits of its "
        r"joints: the best leaves 'end_a' and 'end_b' apart by 200 mm; set orthocal.drives"
    )
    with pytest.raises(RobotError, match=message):
        load_robot(folder)


def test_what_no_drive_can_close_is_refused(tmp_path):
    """Motors 2 m apart; crank and rod of each reach 0.4: 1.2 m stay open."""
    folder = write_wide_linkage(tmp_path / "wide", half=1.0)
    with pytest.raises(RobotError, match=r"with its drives moved too.*apart by 12\d\d mm"):
        load_robot(folder)


def test_metres_and_radians_are_not_one_number(tmp_path):
    """A hinge about z and a post that is 3 mm too high and turned about x by 0.2 rad."""
    joints = chain([((0, 0, 0), "z"), ((0.1, 0, 0), "z")])
    joints += joint("post", "base", (0.1, 0, 0.003), "").replace(
        'xyz="0.1 0 0.003"', 'xyz="0.1 0 0.003" rpy="0.2 0 0"'
    )
    yaml = "closed_loop: [[j1, post]]\ntype: [6d]\nname_mot: [j0]\n"
    with pytest.raises(RobotError, match=r"apart by \S+ mm and 2\d\d mrad; set"):
        make_robot(tmp_path / "high", joints, yaml)


def test_the_limits_of_joints_hold_in_a_zero_that_is_found(tmp_path):
    """A hinge that may turn one way only: the linkage folds to its other side, or not at all."""
    folder = write_wide_linkage(tmp_path / "wide", half=0.15)
    free = load_robot(folder)
    elbow = free.model.joints[free.model.getJointId("elbow_a")].idx_v
    angle = float(free.reference_posture[elbow])
    urdf = folder / "wide.urdf"
    text = urdf.read_text()
    start = text.index('<joint name="elbow_a"')
    wanted = "0.05" if angle <= 0.0 else "-3"
    limit = f'<limit lower="{wanted}" upper="{float(wanted) + 2.95}" effort="1" velocity="1"/>'
    head, tail = text[:start], text[start:]
    urdf.write_text(head + tail.replace(FREE, limit, 1))
    other = load_robot(folder)
    assert float(wanted) <= other.reference_posture[elbow] <= float(wanted) + 2.95
    assert gap(other, other.reference_posture) < CLOSED


def test_a_posture_beyond_the_limits_of_a_joint_names_it(tmp_path):
    extra = "  drives: {motor_a: {zero_deg: 120}, motor_b: {zero_deg: -120}}\n"
    folder = write_wide_linkage(tmp_path / "wide", extra)
    urdf = folder / "wide.urdf"
    head, start, tail = urdf.read_text().partition('<joint name="elbow_a"')
    limit = '<limit lower="2.9" upper="3" effort="1" velocity="1"/>'
    load_robot(folder)
    urdf.write_text(head + start + tail.replace(FREE, limit, 1))
    with pytest.raises(RobotError, match=r"apart by \S+ mm \(one closes outside the limits of elb"):
        load_robot(folder)


def test_free_motions_are_counted(tmp_path, orthoglide, fivebar):
    """A plate between two balls turns about the line through them; closed 6d loops that do not."""
    assert count_free_motions(orthoglide) == 0
    assert count_free_motions(fivebar) == 0
    joints = (
        joint("motor", "base", (0, 0, 0), "z")
        + joint("rod", "motor", (0.1, 0, 0), "z")
        + joint("spin", "rod", (0.1, 0, 0), "x")
        + joint("end", "spin", (0, 0, 0), "")
        + joint("post", "base", (0.1, 0.1, 0), "")
    )
    yaml = "closed_loop: [[end, post]]\ntype: [3d]\nname_mot: [motor]\n"
    robot = make_robot(
        tmp_path / "loose", joints, yaml + "orthocal: {passive_start: {rod_deg: 9}}\n"
    )
    assert count_free_motions(robot) == 1


def test_loops_that_leave_motions_free_close_for_the_eye_only(tmp_path):
    """The 6d loop of a robot with two balls: more joints than rows."""
    robot = load_robot(write_ball_platform(tmp_path / "balls"))
    solver = LoopClosure(robot)
    assert robot.passive_index.size > robot.closure_rows
    with pytest.raises(ClosureError, match="is singular: the drives leave"):
        solver.close(robot.drive_zero)
    drives = robot.drive_zero + np.array([[0.1, -0.05], [-0.2, 0.1]])
    for d, passive in zip(drives, solver.close(drives, allow_free=True), strict=True):
        residual, _ = robot.evaluate_constraints(d, passive)
        assert np.abs(residual).max() < CLOSED


def test_an_open_posture_says_mm_and_mrad(orthoglide):
    with pytest.raises(ClosureError, match=r"does not close: open by \S+ mm( and \S+ mrad)?$"):
        orthoglide.close_with_pinocchio([0.9, 0.3, 0.3], orthoglide.reference_passive)
    far = np.array([0.9, 0.3, 0.3])
    with pytest.raises(ClosureError, match=r"open by \S+ mm( and \S+ mrad)?, \d+ % of the way"):
        LoopClosure(orthoglide).close(far)


def test_a_found_zero_is_where_pinocchio_says(tmp_path):
    """The loop closure solver starts from the posture that Pinocchio's models closed."""
    robot = load_robot(write_wide_linkage(tmp_path / "wide"))
    passive = LoopClosure(robot).close(robot.drive_zero)
    assert np.abs(passive - robot.reference_passive).max() < KINEMATICS
