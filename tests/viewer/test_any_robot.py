"""Scenes of robots with free motions, redundant closure rows, no legs or no tool."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from commands import run_orthocal
from conftest import ROOT
from linkages import joint, write_ball_platform, write_crooked_loop, write_robot, write_wide_linkage
from tolerances import CLOSED, KINEMATICS

from orthocal import draw_scene, load_robot
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.output.scene import drawing
from orthocal.robot.reference_posture import count_free_motions
from orthocal.viewer.visuals import load_visuals


def write_loose_loop(folder):
    """Two rods between a crank and a post, and a hinge along the last one."""
    joints = joint("motor", "base", (0, 0, 0), "z") + joint("rod", "motor", (0.1, 0, 0), "z")
    joints += joint("arm", "rod", (0.1, 0, 0), "z") + joint("spin", "arm", (0.1, 0, 0), "x")
    joints += joint("end", "spin", (0, 0, 0), "") + joint("post", "base", (0.1, 0.15, 0), "")
    extra = "orthocal: {passive_start: {rod_deg: 60, arm_deg: 40}}\n"
    return write_robot(
        folder, joints, f"closed_loop: [[end, post]]\ntype: [3d]\nname_mot: [motor]\n{extra}"
    )


def write_open_arm(folder):
    """No loop, and a drive with practically no limits."""
    far = '<limit lower="-1e6" upper="1e6" effort="1" velocity="1"/>'
    joints = joint("slide", "base", (0, 0, 0), "x", kind="prismatic", limit=far)
    joints += joint("hand", "slide", (0.2, 0, 0), "")
    return write_robot(folder, joints, "closed_loop: []\ntype: []\nname_mot: [slide]\n")


ROBOTS = {
    "crooked": write_crooked_loop,
    "wide": write_wide_linkage,
    "balls": write_ball_platform,
    "universal": lambda folder: write_ball_platform(folder, "UJOINT_YX"),
    "loose": write_loose_loop,
    "open": write_open_arm,
    "orthoglide": lambda _: "orthoglide",
    "fivebar": lambda _: ROOT / "tests/robots/fivebar",
}


@pytest.fixture(scope="module")
def robots(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robots")
    return {name: load_robot(write(folder / name)) for name, write in ROBOTS.items()}


@pytest.fixture(params=ROBOTS)
def robot(request, robots):
    return robots[request.param]


def test_links_are_where_pinocchio_places_them(robot):
    scene = draw_scene(robot)
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.configuration(robot.reference_posture))
    drawn = {p.split("/")[1] for p in scene.nodes if p.startswith(f"{drawing.MACHINE}/")}
    bodies = {f.name for f in robot.model.frames if f.type == pin.FrameType.BODY}
    assert drawn == {v.link for v in load_visuals(robot)}
    assert drawn == bodies or (robot.name == "orthoglide" and drawn < bodies)
    for link in drawn:
        expected = data.oMf[robot.frame_id(link)].homogeneous
        assert np.abs(scene.pose(f"{drawing.MACHINE}/{link}") - expected).max() < KINEMATICS
    facts = " ".join(scene.facts)
    assert facts.startswith("Mechanical zero: ")
    assert "Mechanical zero: " in scene.to_html()
    moved = [d.name for d in robot.drives if d.zero_computed]
    assert ("Computed by closing the loops" in facts) == bool(moved)
    assert all(name in facts for name in moved)
    free = count_free_motions(robot)
    assert (f"The loops do not constrain {free} passive motion" in facts) == bool(free)


def test_every_drive_moves_within_the_size_of_the_machine(robot):
    stops = drawing._tour(robot)
    assert len(stops) > 1
    drives = np.array([s.drives for s in stops])
    assert np.abs(drives - robot.drive_zero).max() <= 0.4 * max(1.0, robot.characteristic_length)
    passive = nominal_closure(robot).close(drives, allow_free=True)
    for d, p in zip(drives, passive, strict=True):
        residual, _ = robot.evaluate_constraints(d, p)
        assert np.abs(residual).max(initial=0.0) < CLOSED


def test_only_the_wide_linkage_has_a_computed_zero(robots):
    assert [name for name, r in robots.items() if r.drives[0].zero_computed] == ["wide"]


def test_view_writes_its_page(robots, tmp_path):
    done = run_orthocal(tmp_path, "view", robots["balls"].urdf.parent, "--html", "page.html")
    assert done.returncode == 0, done.stderr
    assert "Mechanical zero" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_visuals_behind_a_ball_joint_are_drawn_on_their_links(tmp_path):
    folder = write_ball_platform(tmp_path / "balls")
    urdf = folder / "balls.urdf"
    box = '<visual><origin xyz="0 0 0.01"/><geometry><box size="0.1 0.2 0.3"/></geometry></visual>'
    urdf.write_text(
        urdf.read_text().replace('<link name="ball_a"/>', f'<link name="ball_a">{box}</link>')
    )
    (visual,) = load_visuals(load_robot(folder))
    assert visual.link == "ball_a"
    assert np.abs(visual.placement[:3, 3] - [0, 0, 0.01]).max() < KINEMATICS
