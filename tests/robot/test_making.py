"""Machines of other sizes: the packaged one comes out of its own sizes, others close and move."""

from __future__ import annotations

import numpy as np
import pytest
from lxml import etree
from tolerances import CLOSED_FORM

from orthocal.errors import RobotError
from orthocal.kinematics import orthoglide as closed_forms
from orthocal.kinematics.assembly import Assembly
from orthocal.robot.loading import packaged_robots
from orthocal.robot.making import Sizes, describe_machine, make_robot

SMALL = Sizes(leg=0.25, lower=0.1, upper=0.32, attachment=0.03, rods_apart=0.06, rod_radius=0.004)


def elements(text):
    parser = etree.XMLParser(remove_comments=True, remove_blank_text=True)
    return etree.tostring(etree.fromstring(text.encode(), parser))


def test_the_packaged_machine_comes_out_of_its_own_sizes():
    folder = packaged_robots()["orthoglide"]
    made = describe_machine(Sizes(), name="orthoglide")
    assert elements(made["orthoglide.urdf"].partition("\n")[2]) == elements(
        (folder / "orthoglide.urdf").read_text().partition("\n")[2]
    )
    assert made["orthoglide.yaml"].endswith((folder / "orthoglide.yaml").read_text())


@pytest.mark.parametrize("sizes", [SMALL, Sizes(leg=0.5, lower=0.3, upper=0.7)])
def test_a_machine_of_other_sizes_moves_as_the_papers_equations_say(tmp_path, sizes):
    robot = make_robot(sizes, tmp_path / "mine")
    points = np.random.default_rng(0).uniform(-0.06, 0.06, (20, 3))
    drives = closed_forms.inverse(points, length=sizes.leg)
    assert np.abs(Assembly(robot).forward(drives) - points).max() < CLOSED_FORM
    assert robot.drive_zero == pytest.approx([sizes.leg] * 3)
    assert [(d.lower, d.upper) for d in robot.drives] == [(sizes.lower, sizes.upper)] * 3
    leg = robot.legs["y"]
    assert (leg.length, leg.rods["b"].radius) == pytest.approx((sizes.leg, sizes.rod_radius))
    apart = np.linalg.norm(leg.rods["a"].zero_root - leg.rods["b"].zero_root)
    assert apart == pytest.approx(sizes.rods_apart)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"leg": 250.0}, "legs of 250000 mm; expected 20 to 5000 mm"),
        ({"leg": 0.4}, "expected the mechanical zero in it, which is at the leg's length, 400 mm"),
        ({"upper": 0.65}, "travel from 120 to 650 mm; legs of 310.25 mm reach 31.025 to 589.475"),
        ({"attachment": -0.01}, "an attachment offset of -10 mm; expected 0"),
        ({"rods_apart": 0.01}, "rods of radius 5.5 mm, 10 mm apart; expected them to clear"),
        ({"rod_radius": 0.0}, "rods of radius 0 mm"),
        ({"leg": float("nan")}, "legs of nan mm"),
    ],
)
def test_sizes_that_make_no_machine_are_refused(tmp_path, change, message):
    with pytest.raises(RobotError, match="sizes") as e:
        make_robot(Sizes(**change), tmp_path / "mine")
    assert message in str(e.value)
    assert not (tmp_path / "mine").exists()
