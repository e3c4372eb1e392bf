"""Workspace of a robot: stated in its YAML, by default, and of a machine that must reach it."""

from __future__ import annotations

import linkages
import numpy as np
import pytest

from orthocal import load_robot
from orthocal.builder.build import make_robot
from orthocal.builder.linear_delta import LinearDelta
from orthocal.builder.orthoglide import Orthoglide
from orthocal.errors import ClosureError, RobotError
from orthocal.kinematics import reachable_box
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.kinematics.reachable_box import find_workspace
from orthocal.kinematics.workspace import box_workspace, gauss_box, uniform_grid

BOX = ((-0.05, 0.06), (-0.06, 0.05), (-0.07, 0.04))


def make(folder, box=BOX):
    return make_robot(Orthoglide(workspace=box), folder / "mine")


def test_a_stated_workspace_is_read_from_the_yaml(tmp_path):
    robot = make(tmp_path)
    found = find_workspace(robot)
    assert np.array_equal(found.limits, BOX)
    assert found.half_side is None
    assert found.words == "the workspace x −50…60, y −60…50, z −70…40 mm"
    assert found.points.min(axis=0) == pytest.approx([-0.05, -0.06, -0.07])
    assert found.points.max(axis=0) == pytest.approx([0.06, 0.05, 0.04])
    assert found.requested is None


def test_the_default_is_a_cube_of_60_mm(orthoglide):
    assert orthoglide.workspace is None
    assert find_workspace(orthoglide).words == "the workspace ±60 mm"


def test_the_default_workspace_is_kept_on_disk(tmp_path, monkeypatch):
    monkeypatch.setenv("ORTHOCAL_CACHE", str(tmp_path / "cache"))
    find_default = reachable_box._default_workspace.__wrapped__  # without the cache in memory
    small = make_robot(Orthoglide(leg=0.28, travel=(0.15, 0.34)), tmp_path / "small")
    longer = make_robot(Orthoglide(leg=0.28, travel=(0.15, 0.36)), tmp_path / "longer")
    found, other = find_default(small), find_default(longer)
    assert found.half_side < other.half_side
    monkeypatch.setattr(reachable_box, "_largest_box", None)
    for robot, expected in ((small, found), (longer, other)):
        kept = find_default(robot)
        assert np.array_equal(kept.limits, expected.limits)
        assert np.array_equal(kept.points, expected.points)


def test_a_machine_that_reaches_more_keeps_the_default_of_the_nominal_one(tmp_path):
    """Plans are made for the nominal machine, tool errors for the calibrated one."""
    lower, upper = 0.15, 0.34
    robot = make_robot(Orthoglide(leg=0.28, travel=(lower, upper)), tmp_path / "small")
    planned = find_workspace(robot)
    assert planned.half_side < 0.06
    assert np.array_equal(find_workspace(robot, lambda points: None).limits, planned.limits)


def test_rules_over_a_box_are_exact_for_polynomials(orthoglide):
    """Mean of x² y over the box, by its antiderivative; all rules lie within the limits."""
    low, high = np.array(BOX).T
    square = (high[0] ** 3 - low[0] ** 3) / (3.0 * (high[0] - low[0]))
    mean = square * 0.5 * (low[1] + high[1])
    for space in (box_workspace(orthoglide, BOX), gauss_box(orthoglide, BOX)):
        x, y, _ = space.points.T
        assert space.weights @ (x**2 * y) == pytest.approx(mean, rel=1e-12)
        assert (space.points >= low - 1e-12).all()
        assert (space.points <= high + 1e-12).all()
    grid = uniform_grid(orthoglide, BOX, points_per_side=3)
    assert grid[0] == pytest.approx(low)
    assert grid[-1] == pytest.approx(high)


def test_a_stated_workspace_out_of_reach_is_refused(tmp_path):
    """Drives end 79.75 mm beyond the zero."""
    with pytest.raises(RobotError, match=r"orthocal\.workspace\.box_mm") as e:
        find_workspace(make(tmp_path, ((-0.09, 0.09),) * 3))
    assert str(e.value).endswith("the largest box of this shape is ±79 mm")


def test_a_machine_that_reaches_less_has_a_smaller_box_of_the_same_shape(tmp_path):
    """It shrinks towards the mechanical zero, and its words name both."""
    robot = make(tmp_path)

    def reach(points):
        if np.abs(points).max() > 0.0351:
            raise ClosureError("is out of reach", posture="a corner")

    found = find_workspace(robot, reach)
    assert found.limits == pytest.approx(np.array(BOX) * 0.5)
    assert found.requested is robot.workspace
    assert found.words == (
        "the workspace x −25…30, y −30…25, z −35…20 mm (the machine does not reach x −50…60, "
        "y −60…50, z −70…40 mm)"
    )
    assert find_workspace(robot, nominal_closure(robot).inverse).requested is None


def test_a_machine_that_hardly_moves_has_no_workspace(tmp_path):
    def reach(points):
        raise ClosureError("is out of reach", posture="a corner")

    with pytest.raises(ClosureError, match="no box of ±1 mm around it"):
        find_workspace(make(tmp_path), reach)


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ("[[-50, 50]]", "workspace.box_mm: has 1 ranges; expected one for each coordinate of"),
        ("[[50, -50], [-50, 50], [-50, 50]]", "found [50, -50]; expected [least, largest], in mm"),
        ("[[-50, 50], [-50, 50], [-50]]", "workspace.box_mm"),
        ("[[-50, 50], [-50, 50], [-50, far]]", "workspace.box_mm"),
    ],
)
def test_an_invalid_workspace_is_named_by_file_and_key(tmp_path, box, message):
    yaml = make(tmp_path).yaml
    good = "[[-50, 60], [-60, 50], [-70, 40]]"
    assert good in yaml.read_text()
    yaml.write_text(yaml.read_text().replace(good, box))
    with pytest.raises(RobotError) as e:
        load_robot(yaml.parent)
    assert str(yaml) in str(e.value)
    assert message in str(e.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"z_mm: 0": "z_mm: 5"}, "orthocal.bed.z_mm"),
        ({"[0, 140]]": "[-10, 140]]"}, "begins at z -10 mm, below the bed; expected at least 0 mm"),
        ({"  workspace: ": "  # "}, "orthocal.bed: needs orthocal.workspace"),
        ({", z]": "]", ", [0, 140]]": "]"}, "orthocal.bed: needs a tool that moves along z"),
    ],
)
def test_an_impossible_bed_is_named_by_file_and_key(tmp_path, changes, message):
    (tmp_path / "mine").mkdir()
    machine = LinearDelta()
    (tmp_path / "mine/mine.urdf").write_text(machine.urdf("mine"))
    text = machine.yaml()
    (tmp_path / "mine/mine.yaml").write_text(text)
    assert load_robot(tmp_path / "mine").bed == 0.0
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "mine/mine.yaml").write_text(text)
    with pytest.raises(RobotError) as e:
        load_robot(tmp_path / "mine")
    assert message in str(e.value)


def test_radians_and_metres_of_drives_are_not_compared(tmp_path):
    """An arm of 80 mm that turns and a slide along it: both move the tool alike."""
    joints = linkages.joint("turn", "base", (0, 0, 0), "z")
    joints += linkages.joint("slide", "turn", (0.08, 0, 0), "x", kind="prismatic")
    yaml = "closed_loop: []\ntype: []\nname_mot: [turn, slide]\n"
    yaml += "orthocal: {tcp: {frame: slide, coordinates: [x, y]}}\n"
    robot = linkages.make_robot(tmp_path / "polar", joints, yaml)
    assert find_workspace(robot).half_side > 0.03


def test_a_machine_with_a_free_motion_has_no_workspace(tmp_path):
    """A closure that the free hinge does not change."""
    joints = linkages.joint("turn", "base", (0, 0, 0), "z")
    joints += linkages.joint("tool", "turn", (0.1, 0, 0), "")
    joints += linkages.joint("free", "base", (0, 0, 0), "z")
    yaml = "closed_loop: [[base, free]]\ntype: [3d]\nname_mot: [turn]\northocal:\n"
    yaml += "  closures: {post: {rows: [z]}}\n  tcp: {frame: tool, coordinates: [y]}\n"
    robot = linkages.make_robot(tmp_path / "free", joints, yaml)
    with pytest.raises(ClosureError, match="no box of ±1 mm"):
        find_workspace(robot)
