"""Loading robots: what is in them, and Gepetto's keys."""

from __future__ import annotations

import shutil

import linkages
import numpy as np
import pinocchio as pin
import pytest
from derivatives import assert_derivative
from tolerances import KINEMATICS

from orthocal import load_robot
from orthocal.errors import RobotError
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.kinematics.conditions import UseConditions
from orthocal.kinematics.loop_closure import LoopClosure
from orthocal.kinematics.sensitivity import ToolSensitivity

WARM = UseConditions(temperature=40.0)


def test_the_orthoglide_is_the_designed_machine(orthoglide):
    r = orthoglide
    assert r.model.njoints - 1 == 21
    assert r.passive_index.size == 18
    assert [d.name for d in r.drives] == ["x_slide", "y_slide", "z_slide"]
    assert all((d.lower, d.upper) == (0.12, 0.39) for d in r.drives)
    assert all(abs(leg.length - 0.31025) < KINEMATICS for leg in r.legs.values())
    assert np.array_equal(r.legs["y"].axis, [0.0, -1.0, 0.0])
    assert all(leg.root_driven for leg in r.legs.values())
    with pytest.raises(ValueError, match="read-only"):
        r.reference_posture[0] = 1.0
    assert r.closure_rows == 18
    assert [c.rows for c in r.closures] == [(0, 2)] * 3 + [(0, 1, 2, 3, 4, 5)] * 2


def test_closures_are_pinocchio_constraint_models(orthoglide):
    kinds = [type(c).__name__ for c in orthoglide.constraints]
    assert kinds == ["PointAnchorConstraintModel"] * 3 + ["FrameAnchorConstraintModel"] * 2
    passive = orthoglide.reference_passive
    residual, _ = orthoglide.evaluate_constraints(orthoglide.drive_zero, passive)
    assert np.abs(residual).max() < KINEMATICS


@pytest.mark.parametrize("name", ["orthoglide", "fivebar", "biglide"])
def test_constraint_jacobians_are_derivatives(request, name):
    robot = request.getfixturevalue(name)
    rng = np.random.default_rng(0)
    drives = robot.drive_zero + 0.02 * rng.normal(size=len(robot.drives))
    passive = robot.reference_passive + 0.2 * rng.normal(size=robot.passive_index.size)
    _, jacobian = robot.evaluate_constraints(drives, passive)
    assert_derivative(
        jacobian[:, robot.passive_index],
        lambda p: robot.evaluate_constraints(drives, p)[0],
        passive,
    )


def test_gepettos_three_keys_are_enough(fivebar):
    assert fivebar.name == "fivebar"
    assert fivebar.legs == {}
    assert fivebar.tcp is None
    assert fivebar.parameters.select_model("offsets") == ("motor_a.offset", "motor_b.offset")
    assert fivebar.parameters["motor_a.offset"].unit == "rad"
    # five joints: all six components each, less the two that are offsets, and the offsets; two
    # scales, and both frames that the loop joins
    assert len(fivebar.parameters.select_model("full")) == 5 * 6 + 2 + 2 * 6


def test_a_path_and_a_name_load_the_same_robot(root, orthoglide):
    other = load_robot(root / "robots/orthoglide")
    assert other.sha256 == orthoglide.sha256


def test_an_unknown_robot_is_named_with_what_there_is():
    with pytest.raises(RobotError, match="'orthoslide' is neither a robot of orthocal"):
        load_robot("orthoslide")


def test_frame_errors_move_the_frames_that_hang_on_them(orthoglide):
    r = orthoglide
    moved = r.with_errors({"frame.platform.x": 1e-3})
    shift = {
        name: moved.model.frames[moved.frame_id(name)].placement.translation
        - r.model.frames[r.frame_id(name)].placement.translation
        for name in ("platform", "tcp", "x_foot")
    }
    assert abs(np.linalg.norm(shift["platform"]) - 1e-3) < KINEMATICS
    assert np.abs(shift["tcp"] - shift["platform"]).max() < KINEMATICS
    assert np.abs(shift["x_foot"]).max() == 0.0


@pytest.mark.parametrize("pairs", ["", "[slide, post]"])
def test_a_machine_may_be_a_single_joint(tmp_path, pairs):
    joints = linkages.joint("slide", "base", (0, 0, 0), "x", kind="prismatic")
    joints += linkages.joint("end", "slide", (0.1, 0, 0), "")
    joints += linkages.joint("post", "base", (0, 0, 0), "")
    yaml = f"closed_loop: [{pairs}]\ntype: [{'3d' if pairs else ''}]\nname_mot: [slide]\n"
    yaml += "orthocal: {tcp: {frame: end, coordinates: [x]}, legs: {x: {root: slide, tip: end}}}\n"
    robot = linkages.make_robot(tmp_path / "slide", joints, yaml)
    assert np.array_equal(robot.legs["x"].root_motion, [1.0, 0.0, 0.0])
    assert "slide.offset" in robot.parameters.complete
    error = ToolSensitivity(robot, free=["slide.offset"])([0.0], passive=np.zeros((1, 0)))
    assert np.abs(error[0, :, 0] - [1.0, 0.0, 0.0]).max() < KINEMATICS


def test_the_same_files_give_the_same_robot_until_one_is_changed(root, tmp_path):
    folder = tmp_path / "biglide"
    shutil.copytree(root / "tests/robots/biglide", folder)
    first = load_robot(folder)
    assert load_robot(folder) is first
    path = folder / "biglide.yaml"
    text = path.read_text()
    assert "zero_mm: 200" in text
    path.write_text(text.replace("zero_mm: 200", "zero_mm: 210"))
    assert load_robot(folder).drive_zero == pytest.approx([0.21, 0.21])
    path.write_text(text)
    assert load_robot(folder) is first


@pytest.mark.parametrize(
    ("old", "new", "evaluate"),
    [
        (  # the other rod does not become warm
            "        b: {root: y_bar_b",
            "      # b: {root: y_bar_b",
            lambda r: LoopClosure(r, conditions=WARM).forward(r.drive_zero).tolist(),
        ),
        ("full: complete", "full: ['*.offset']", machine_errors),
    ],
)
def test_an_edited_robot_has_nothing_of_the_one_before(root, tmp_path, old, new, evaluate):
    source = root / "robots/biglide"
    urdf, yaml = (next(source.glob(f"*.{suffix}")).read_text() for suffix in ("urdf", "yaml"))
    yaml += "  effects: {thermal: {}}\n"
    edited = yaml.replace(old, new)
    results = []
    for name, text in (("edited", yaml), ("edited", edited), ("new", edited)):
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        (folder / f"{name}.urdf").write_text(urdf)
        (folder / f"{name}.yaml").write_text(text)
        results.append(evaluate(load_robot(folder)))
    assert results[1] == results[2] != results[0]


def test_a_folder_of_another_name_is_another_robot(root, tmp_path, monkeypatch):
    for name in ("one", "two"):
        folder = tmp_path / name
        folder.mkdir()
        for suffix in (".yaml", ".urdf"):
            shutil.copy(root / f"tests/robots/biglide/biglide{suffix}", folder)
        monkeypatch.chdir(folder)
        assert load_robot(".").name == name


def test_joint_axes_and_origins_are_those_of_the_design(orthoglide):
    """Leg frame: X from slider to tool; Z = e_z, e_x, e_y; the joints of the URDF."""
    r, w, a, length = orthoglide, 0.08, 0.04, 0.31025
    leg_x = {"x": [-1, 0, 0], "y": [0, -1, 0], "z": [0, 0, -1]}
    leg_z = {"x": [0, 0, 1], "y": [1, 0, 0], "z": [0, 1, 0]}
    expected = {
        "swivel": ([-a, 0, 0], [0, 0, 1]),
        "bar_a": ([0, 0, w / 2], [0, 1, 0]),
        "bar_b": ([0, 0, -w / 2], [0, 1, 0]),
        "coupler": ([length, 0, 0], [0, 1, 0]),
        "wrist": ([0, 0, -w / 2], [0, 0, 1]),
        "fork": ([0, 0, 0], [0, 1, 0]),
    }
    for k in "xyz":
        slide = r.model.jointPlacements[r.model.getJointId(f"{k}_slide")]
        x, z = np.array(leg_x[k]), np.array(leg_z[k])
        assert np.abs(slide.rotation - np.column_stack([x, np.cross(z, x), z])).max() < KINEMATICS
        for joint, (origin, axis) in expected.items():
            i = r.model.getJointId(f"{k}_{joint}")
            assert np.abs(r.model.jointPlacements[i].translation - origin).max() < KINEMATICS
            data = r.model.joints[i].createData()
            r.model.joints[i].calc(data, pin.neutral(r.model))
            assert np.array_equal(data.S.ravel()[3:], axis)
