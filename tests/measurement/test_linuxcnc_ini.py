"""Joints of a LinuxCNC machine from its INI file, and the commands that read them."""

from __future__ import annotations

import numpy as np
import pytest
from commands import run_orthocal
from effect_plans import write_plan

from orthocal import (
    ParameterError,
    calibrate,
    load_plan,
    simulate_session,
    write_calibration,
)
from orthocal.measurement.files.linuxcnc_ini import read_ini

MM = 1e-3

INI = """# a machine
[TRAJ]
LINEAR_UNITS = mm
[JOINT_0]
HOME_OFFSET = 352.5   # at the switch
HOME_LATCH_VEL = -1.5
BACKLASH = 0.031
[JOINT_1]
HOME_OFFSET = 340
HOME_LATCH_VEL = 2
HOME_LATCH_VEL = -2
; BACKLASH = 0.5
[JOINT_2]
HOME_OFFSET = -3.25
COMP_FILE = trims.comp
COMP_FILE_TYPE = 1
BACKLASH = 0.2
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "trims.comp").write_text("0 0.01 -0.02\n100 0.03 -0.04\n")
    (tmp_path / "machine.ini").write_text(INI)
    return tmp_path


def test_joints_are_read(folder, orthoglide):
    joints = read_ini(folder / "machine.ini", orthoglide)
    assert np.array(joints.home_offsets) / MM == pytest.approx([352.5, 340.0, -3.25])
    assert joints.latched == (-1, 1, 1)
    at = np.array([0.05])
    shown = [trim(at)[0] / MM for trim in joints.compensation]
    assert np.array(shown) == pytest.approx(
        np.array([[0.0155, -0.0155], [0.0, 0.0], [0.02, -0.03]]), abs=1e-12
    )


def test_a_machine_without_compensation_has_none(folder, orthoglide):
    lines = [v for v in INI.splitlines() if not v.startswith(("BACKLASH", "COMP"))]
    (folder / "machine.ini").write_text("\n".join(lines))
    assert read_ini(folder / "machine.ini", orthoglide).compensation == ()


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("LINEAR_UNITS = mm", "LINEAR_UNITS = inch", "[TRAJ]"),
        ("[JOINT_2]", "[JOINT_3]", "[JOINT_2]"),
        ("HOME_OFFSET = 340", "HOME_OFFSET = 340,0", "[JOINT_1]"),
        ("BACKLASH = 0.031", "BACKLASH = -0.031", "[JOINT_0]"),
        ("COMP_FILE_TYPE = 1", "COMP_FILE_TYPE = 0", "[JOINT_2]"),
    ],
)
def test_wrong_files_are_refused(folder, orthoglide, old, new, where):
    assert old in INI
    (folder / "machine.ini").write_text(INI.replace(old, new))
    with pytest.raises(ParameterError) as caught:
        read_ini(folder / "machine.ini", orthoglide)
    assert caught.value.where == f"{folder / 'machine.ini'}: {where}"


def test_commands_read_the_file(folder):
    """Export reads the INI of the measurement, again the one with what was entered."""
    plan = load_plan(write_plan(folder / "plan", effects="backlash: {}"))
    truth = {f"{d}_slide.backlash": 30e-6 for d in "xyz"}
    session = simulate_session(plan.with_controller(np.zeros(3)), truth, seed=1).session
    result = calibrate(session, solver="variable-projection")
    (folder / "one").mkdir()
    write_calibration(result, folder / "one" / "calibration.json")
    one, home = folder / "one", folder / "home"
    export = ["export", one, "--to", "linuxcnc", "--offsets", "--out", home, "--ini"]
    refused = run_orthocal(folder, *export, folder / "machine.ini")
    assert refused.returncode == 2
    assert "machine.ini" in refused.stderr
    lines = [v for v in INI.splitlines() if not v.startswith(("BACKLASH", "COMP"))]
    (folder / "plain.ini").write_text("\n".join(lines))
    done = run_orthocal(folder, *export, folder / "plain.ini")
    assert done.returncode == 0, done.stderr
    assert "Assumed" not in done.stderr
    again = ["again", one, "--out", folder / "second", "--ini", home / "joints.ini"]
    done = run_orthocal(folder, *again)
    assert done.returncode == 0, done.stderr
    second = load_plan(folder / "second")
    entered = [trim.backlash for trim in second.compensation]
    identified = [result.errors[f"{d.name}.backlash"] for d in plan.robot.drives]
    assert entered == pytest.approx(identified, abs=1e-7)
