"""Robots embedded in calibration.json; changed directories are named."""

from __future__ import annotations

import hashlib
import json
import logging
import platform
import shutil

import numpy as np
import pytest
from calibrated import UNJUDGED
from commands import run_orthocal
from tolerances import KINEMATICS

import orthocal
from orthocal import (
    calibrate,
    draw_scene,
    load_calibration,
    load_plan,
    load_session,
    simulate_session,
    validate_calibration,
    write_calibration,
)
from orthocal.calibration.file import calibration_document
from orthocal.calibration.identify import identify
from orthocal.errors import CalibrationFileError, SessionError
from orthocal.measurement.files.write_session import write_session
from orthocal.robot import files as robot_files
from orthocal.robot.files import is_inner_path
from orthocal.robot.loading import content_digest

BOX = '<geometry><box size="0.36 0.05 0.018"/></geometry>'
MESH = '<geometry><mesh filename="package://mill/parts/rail.stl"/></geometry>'
STL = b"\0" * 80 + (1).to_bytes(4, "little") + np.eye(4, 3, -1, dtype="<f4").tobytes() + b"\0\0"


@pytest.fixture(scope="module")
def made(root, tmp_path_factory):
    """Directory with a machine that has a mesh, a session, and its calibration."""
    above = tmp_path_factory.mktemp("made")
    folder = above / "mill"
    shutil.copytree(root / "robots/orthoglide", folder)
    urdf = (folder / "orthoglide.urdf").read_text()
    assert BOX in urdf
    (folder / "orthoglide.urdf").write_text(urdf.replace(BOX, MESH))
    (folder / "parts").mkdir()
    (folder / "parts/rail.stl").write_bytes(STL)
    session = above / "first"
    shutil.copytree(root / "examples/raw-cycles", session)
    text = (session / "session.yaml").read_text()
    (session / "session.yaml").write_text(text.replace("robot: orthoglide", "robot: ../mill"))
    write_calibration(calibrate(session, **UNJUDGED), above / "calibration.json")
    return above


@pytest.fixture
def mill(made, tmp_path):
    """A copy of the directory, to be changed."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    path = tmp_path / "calibration.json"
    path.write_text(path.read_text().replace(str(made / "mill"), str(tmp_path / "mill")))
    return tmp_path


COMMANDS = """
export calibration.json --to linuxcnc --out linuxcnc
correct calibration.json part.ngc --work-offset-mm 0,0,0 --out corrected.ngc
forward calibration.json joints.csv
again calibration.json --out second
"""
FILES = {
    "joints.csv": "x_slide_mm,y_slide_mm,z_slide_mm\n310,310,310\n",
    "part.ngc": "G21 G90 G54\nG0 X0 Y0 Z0\nG1 X10 F1000\nM2\n",
}


@pytest.mark.usefixtures("short_reports", "without_sensor_gains")
def test_commands_work_without_the_robot_directory(mill, tmp_path_factory):
    folder = tmp_path_factory.mktemp("elsewhere")
    shutil.move(mill / "calibration.json", folder)
    shutil.rmtree(mill)
    for name, text in FILES.items():
        (folder / name).write_text(text)
    for line in COMMANDS.split("\n")[1:-1]:
        done = run_orthocal(folder, *line.split())
        assert done.returncode == 0, (line, done.stderr)
    assert (folder / "second/mill/parts/rail.stl").read_bytes() == STL
    assert (folder / "corrected.ngc").exists()
    errors = load_calibration(folder / "calibration.json").errors
    measured = simulate_session(load_plan(folder / "second"), errors, seed=3).session
    write_session(measured, folder / "third")
    done = run_orthocal(folder, "validate", "calibration.json", "third")
    assert done.returncode == 0, done.stderr


def test_an_embedded_robot_is_the_robot_of_its_directory(mill):
    first = load_calibration(mill / "calibration.json")
    assert first.robot.folder == mill / "mill"
    drawn = draw_scene(first).nodes
    shutil.rmtree(mill / "mill")
    again = load_calibration(mill / "calibration.json")
    assert again.robot.folder is None
    assert calibration_document(again) == calibration_document(first)
    joints = np.full(3, 0.31)
    assert np.abs(again.machine.forward(joints) - first.machine.forward(joints)).max() < KINEMATICS
    assert draw_scene(again).nodes == drawn


def test_files_versions_and_seed_are_in_the_file(mill):
    document = json.loads((mill / "calibration.json").read_text())
    files = {f["name"]: f for f in document["robot"]["files"]}
    assert list(files) == ["orthoglide.urdf", "orthoglide.yaml", "parts/rail.stl"]
    for name, file in files.items():
        content = (mill / "mill" / name).read_bytes()
        assert file["sha256"] == hashlib.sha256(content).hexdigest()
        assert file["text"] == (None if name.endswith(".stl") else content.decode())
    versions = document["versions"]
    assert set(versions) == {"orthocal", "python", "pin", "casadi", "numpy", "scipy"}
    assert versions["python"] == platform.python_version()
    assert versions["orthocal"] == orthocal.__version__
    assert document["session"]["seed"] == 1  # that of the example
    plan = load_plan(mill / "first")
    session = simulate_session(plan, {"x_slide.offset": 1e-3}, seed=7).session
    loaded = load_session(write_session(session, mill / "simulated"))
    calibration, _ = identify(loaded, solver="variable-projection")
    assert calibration_document(calibration)["session"]["seed"] == 7


def test_a_changed_directory_is_named_and_the_embedded_robot_is_used(mill, caplog):
    before = load_calibration(mill / "calibration.json")
    yaml = mill / "mill/orthoglide.yaml"
    yaml.write_text(yaml.read_text().replace("zero_mm: 310.25", "zero_mm: 310.2"))
    with caplog.at_level(logging.WARNING):
        after = load_calibration(mill / "calibration.json")
    (record,) = caplog.records
    assert str(mill / "calibration.json") in record.getMessage()
    assert str(mill / "mill") in record.getMessage()
    assert after.robot.sha256 == before.robot.sha256
    assert np.array_equal(after.robot.drive_zero, before.robot.drive_zero)
    with pytest.raises(SessionError, match="is of robot 'mill'"):
        validate_calibration(after, load_session(mill / "first"))


def test_large_meshes_are_omitted_and_not_drawn(mill, monkeypatch):
    monkeypatch.setattr(robot_files, "LARGEST_MESHES", len(STL) - 1)
    calibration, _ = identify(mill / "first", solver="variable-projection")
    path = write_calibration(calibration, mill / "large.json")
    shutil.rmtree(mill / "mill")
    loaded = load_calibration(path)
    assert len(loaded.robot_record.files) == 2
    assert draw_scene(loaded).nodes


def set_file(index, **values):
    """Change of one of the embedded files."""
    return lambda files: files[index].update(values)


HOSTILE = {
    "parent": (set_file(2, name="../rail.stl"), "robot.files[2].name"),
    "other kind": (set_file(2, name="rail.py"), "robot.files"),
    "inside a file": (set_file(2, name="orthoglide.urdf/rail.stl"), "robot.files"),
    "same name": (set_file(0, name="orthoglide.yaml"), "robot.files"),
    "nested URDF": (set_file(0, name="parts/orthoglide.urdf"), "robot.files"),
    "no URDF": (lambda files: files.pop(0), "robot.files"),
    "two YAML": (lambda files: files.append({**files[1], "name": "b.yaml"}), "robot.files"),
    "too many": (lambda files: files.extend(files * 333), "robot.files"),
    "checksum": (set_file(0, sha256="0" * 64), "robot.files[0].sha256"),
    "content": (set_file(1, text="robot: {}"), "robot.files[1].sha256"),
    "no base64": (set_file(2, base64="%"), "robot.files[2].base64"),
    "text and base64": (set_file(2, text=""), "robot.files[2]"),
    "neither": (set_file(2, base64=None), "robot.files[2]"),
    "unknown key": (set_file(0, mode=0o777), "robot.files[0].mode"),
}


def assert_refused(made, folder, change, key):
    """Refuse the file of the calibration with a changed record of its robot, naming the key."""
    document, path = json.loads((made / "calibration.json").read_text()), folder / "changed.json"
    change(document["robot"])
    path.write_text(json.dumps(document))
    with pytest.raises(CalibrationFileError) as caught:
        load_calibration(path)
    assert caught.value.where == f"{path}: {key}"


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_files_are_refused(made, tmp_path, case):
    change, key = HOSTILE[case]
    assert_refused(made, tmp_path, lambda robot: change(robot["files"]), key)


def test_an_embedded_robot_that_does_not_load_names_file_and_line(made, tmp_path):
    text = (made / "mill/orthoglide.urdf").read_text().replace("</robot>", "")

    def cut(robot):
        first, second, *_ = robot["files"]
        first |= {"text": text, "sha256": hashlib.sha256(text.encode()).hexdigest()}
        robot["sha256"] = content_digest(text.encode(), second["text"].encode())

    line = text.count("\n") + 1
    assert_refused(made, tmp_path, cut, f"robot.files: orthoglide.urdf:{line}")


def test_the_robot_checksum_belongs_to_the_files(made, tmp_path):
    assert_refused(made, tmp_path, lambda robot: robot.update(sha256="0" * 64), "robot.sha256")


def test_paths_inside_a_directory_are_accepted_and_no_others():
    inside = ("a.stl", "parts/a.stl", "my robot.urdf", "é.yaml", "...stl")
    assert all(map(is_inner_path, inside))
    outside = ("/tmp/rail.stl", "c:rail.stl", "..\\rail.stl", "", "a" * 300 + ".stl")
    assert not any(map(is_inner_path, outside))
