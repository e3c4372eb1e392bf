"""How a controller's joints count: up or down, and what they show in the mechanical zero."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from orthocal.effects.loading import load_robot
from orthocal.errors import RobotError
from orthocal.robot.loading import packaged_robots


def with_joint(folder, text):
    """The packaged machine, its x joint described by some words."""
    shutil.copytree(packaged_robots()["orthoglide"], folder)
    file = folder / "orthoglide.yaml"
    found = file.read_text()
    entry = "x_slide: {zero_mm: 310.25}"
    assert entry in found
    file.write_text(found.replace(entry, f"x_slide: {{zero_mm: 310.25, joint: {text}}}"))
    (folder / "orthoglide.urdf").rename(folder / f"{folder.name}.urdf")
    file.rename(folder / f"{folder.name}.yaml")
    return load_robot(folder)


def test_a_joint_counts_as_its_drive_where_nothing_is_said(orthoglide):
    drive = orthoglide.drives[0]
    assert drive.to_joint(0.3) == 0.3
    assert drive.joint_limits == (drive.lower, drive.upper)


def test_a_joint_counts_from_the_mechanical_zero(tmp_path):
    robot = with_joint(tmp_path / "mine", "{at_zero_mm: 0}")
    x, y = robot.drives[:2]
    assert x.to_joint(0.32025) == pytest.approx(0.01, abs=1e-15)
    assert y.to_joint(0.32025) == 0.32025
    # travel 120 ... 390 mm
    assert x.joint_limits == pytest.approx((-0.19025, 0.07975))


def test_a_joint_counts_down(tmp_path):
    """Further from the origin it shows less; its limits change places."""
    x = with_joint(tmp_path / "mine", "{counts: down, at_zero_mm: 5}").drives[0]
    assert x.to_joint(0.32025) == pytest.approx(-0.005)
    assert x.joint_limits == pytest.approx((0.005 - 0.07975, 0.005 + 0.19025))
    shown = np.array([[-0.1, 0.0], [0.02, 0.05]])
    assert x.to_joint(x.from_joint(shown)) == pytest.approx(shown)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{counts: left}", "counts"),
        ("{at_zero_deg: 3}", r"x_slide\.joint\.at_zero_deg: the drive is prismatic; expected "),
        ("{at_zero_mm: far}", "at_zero_mm"),
        ("{zero: 1}", "zero"),
    ],
)
def test_other_words_are_refused(tmp_path, text, message):
    with pytest.raises(RobotError, match=message):
        with_joint(tmp_path / "mine", text)
