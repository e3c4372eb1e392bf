"""First plan of any machine: clear of hinges, within reach, in the range of the dial."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from orthocal import load_plan
from orthocal.builder.build import make_robot
from orthocal.builder.orthoglide import Orthoglide
from orthocal.errors import RobotError
from orthocal.measurement.files.session_file import check_contacts
from orthocal.planning.equipment import Equipment, reachable
from orthocal.planning.first_plan import CLEAR, first_equipment, paper_plan
from orthocal.sensors.tips import Tip


def test_the_first_plan_of_the_orthoglide_is_the_paper_plan(orthoglide, root):
    """The seven postures of the workshop example, and its setups; the zero again at the end."""
    plan, workshop = paper_plan(orthoglide, Equipment()), load_plan(root / "examples/workshop")
    assert {n: p.values.tolist() for n, p in plan.postures.items()} == {
        n: p.values.tolist() for n, p in workshop.postures.items()
    }
    for name, posture in plan.postures.items():
        assert posture.drives == pytest.approx(workshop.postures[name].drives)
    for name, setup in workshop.setups.items():
        assert plan.setups[name].sensor == setup.sensor
    rows = [(r.setup, r.posture, r.cycle) for r in plan.readings]
    assert [r for r in rows if r[2] == 1] == [
        (r.setup, r.posture, r.cycle) for r in workshop.readings
    ]
    assert [r for r in rows if r[2] == 2] == [(name, "zero", 2) for name in plan.setups]


@pytest.mark.parametrize(
    "sizes",
    [
        Orthoglide(
            leg=0.25, travel=(0.1, 0.32), attachment=0.03, rods_apart=0.06, rod_radius=0.004
        ),
        Orthoglide(leg=0.15, travel=(0.06, 0.24), attachment=0.02),
        Orthoglide(leg=0.6, travel=(0.3, 0.9)),
    ],
)
def test_the_paper_plan_of_other_dimensions_is_within_reach(tmp_path, sizes):
    robot = make_robot(sizes, tmp_path / "mine")
    plan = paper_plan(robot, Equipment())
    check_contacts(plan)
    points = np.array([p.values for p in plan.postures.values()])
    assert reachable(robot, points).all()
    assert np.abs(points).max() <= 0.1
    equipment = first_equipment(robot, Equipment())
    clear = min(CLEAR, 0.2 * sizes.leg)
    for section in equipment.sections:  # from a hinge, wherever the leg goes
        assert section * sizes.leg + equipment.box.max() <= sizes.leg - clear + 1e-9
        assert section * sizes.leg + equipment.box.min() >= clear - 1e-9
    assert 1 <= len(equipment.sections) <= 3


def test_the_paper_plan_uses_the_given_equipment(orthoglide):
    blade = Equipment(tip=Tip("blade", 0.0, 0.02), rods=("b",))
    sensors = [s.sensor for s in paper_plan(orthoglide, blade).setups.values()]
    assert {(s.tip.form, s.rod) for s in sensors} == {("blade", "b")}
    none = paper_plan(orthoglide, replace(blade, tip=None))
    assert {s.sensor.rod for s in none.setups.values()} == {None}


def test_a_machine_that_hardly_moves_is_refused(tmp_path):
    robot = make_robot(Orthoglide(leg=0.25, travel=(0.245, 0.3)), tmp_path / "mine")
    with pytest.raises(RobotError, match="expected 10 mm to either side of the mechanical zero"):
        paper_plan(robot, Equipment())
