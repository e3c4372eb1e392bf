"""First plan of machines: distance from hinges, reach, range of the dial."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from orthocal import Choice, load_plan, load_robot
from orthocal.builder.build import make_robot
from orthocal.builder.orthoglide import InclinedOrthoglide, Orthoglide
from orthocal.errors import RobotError
from orthocal.measurement.files.session_file import check_contacts
from orthocal.output.sheet.page import sheet_files
from orthocal.planning.equipment import Equipment, reachable
from orthocal.planning.first_plan import (
    CLEARANCE,
    bed_plan,
    expect_fixed,
    first_equipment,
    paper_plan,
)
from orthocal.sensors.tips import Tip


def test_the_first_plan_of_the_orthoglide_is_the_paper_plan(orthoglide, root):
    """Postures and setups are those of the workshop example. Setups end in their first posture."""
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
    clear = min(CLEARANCE, 0.2 * sizes.leg)
    for section in equipment.sections:  # distance from both hinges in all postures
        assert section * sizes.leg + equipment.box.max() <= sizes.leg - clear + 1e-9
        assert section * sizes.leg + equipment.box.min() >= clear - 1e-9
    assert 1 <= len(equipment.sections) <= 3


def test_the_paper_plan_has_tip_and_rods_of_the_equipment(orthoglide):
    blade = Equipment(tip=Tip("blade", 0.0, 0.02), rods=("b",))
    sensors = [s.sensor for s in paper_plan(orthoglide, blade).setups.values()]
    assert {(s.tip.form, s.rod) for s in sensors} == {("blade", "b")}
    none = paper_plan(orthoglide, replace(blade, tip=None))
    assert {s.sensor.rod for s in none.setups.values()} == {None}


def test_a_machine_that_hardly_moves_is_refused(tmp_path):
    robot = make_robot(Orthoglide(leg=0.25, travel=(0.245, 0.3)), tmp_path / "mine")
    with pytest.raises(RobotError, match="expected at least 10 mm to either side"):
        paper_plan(robot, Equipment())


@pytest.fixture(scope="module")
def delta():
    return load_robot("linear_delta").with_tolerances({"*.offset_mm": 4.0})


def test_the_bed_of_a_delta_is_read_on_a_grid_from_above(delta):
    plan = bed_plan(delta, Equipment())
    points = np.array([p.values for p in plan.postures.values()])
    assert points[0] == pytest.approx(0.0)
    places = (-0.07, -0.035, 0.0, 0.035, 0.07)
    grid = {(x, y, 0.0) for x in places for y in places}
    assert {tuple(p) for p in points.round(6).tolist()} == grid
    steps = np.linalg.norm(np.diff(points[1:], axis=0), axis=1)
    assert steps.max() <= 0.07 + 1e-9  # short motions over the bed
    assert {r.approach for r in plan.readings} == {"nnn"}
    assert (plan.readings[-1].posture, plan.readings[-1].cycle) == (plan.readings[0].posture, 2)
    files = sheet_files(plan)
    (motion,) = [program for name, program in files.items() if name.endswith(".ngc")]
    heights = [float(z) for z in re.findall(r"(?m)^G53 .* Z(-?[\d.]+)", motion)]
    assert min(heights) == 0.0
    sheet = files["sheet.html"]
    assert "by eye, once: the tool at x 0, y 0, z 0 mm" in sheet
    assert "a little upwards" in sheet
    assert "the plunger touches the bed itself. It must not move" in sheet
    assert "and touches the bed." in sheet
    assert "Clamp it" not in sheet


def test_the_bed_determines_a_delta_better_than_its_legs(delta):
    """0.98 mm before, 0.16 mm after the bed, 0.23 mm after 24 readings of the legs.

    Neither determines the mean offset: a motion of all slides lifts the tool and rotates no leg.
    """
    choice = Choice("full")
    bed = expect_fixed(bed_plan(delta, Equipment()), choice, Equipment())
    assert bed.before.reported.rms == pytest.approx(0.98e-3, rel=0.02)
    assert bed.expected.reported.rms < 0.17e-3
    legs = paper_plan(replace(delta, bed=None), Equipment(tip=None))  # reads below the bed, too
    assert len(legs.readings) == 24
    of_legs = expect_fixed(legs, choice, Equipment()).expected
    assert of_legs.reported.rms == pytest.approx(0.23e-3, rel=0.02)
    for after in (bed.expected, of_legs):
        drives = [after.names.index(f"{k}_slide.offset") for k in "abc"]
        variance = after.covariance[np.ix_(drives, drives)].mean()
        assert np.sqrt(variance) == pytest.approx(2e-3 / np.sqrt(3.0), rel=1e-3)


def test_the_legs_of_an_inclined_machine_are_read_along_them(tmp_path):
    machine = InclinedOrthoglide()
    robot = make_robot(machine, tmp_path / "mine")
    plan = paper_plan(robot, Equipment())
    assert list(plan.setups) == ["a_1", "a_2", "b_1", "b_2", "c_1", "c_2"]
    check_contacts(plan)
    for leg in machine.legs():
        for end, sign in (("max", 1.0), ("min", -1.0)):
            at = plan.postures[f"{leg.name}_{end}"].values
            assert np.abs(np.cross(at, leg.direction)).max() < 1e-12
            assert sign * (at @ leg.direction) > 0.03
    sheet = sheet_files(plan)["sheet.html"]
    assert "a little outwards" in sheet
    assert "by eye, once: each leg parallel to its axis" in sheet


def test_a_tool_that_moves_in_x_and_z_is_moved_along_both(tmp_path, root):
    """The plane of the biglide, turned about its x axis."""
    turned = (
        ('xyz="0 0 1"', 'xyz="0 -1 0"'),
        ("0 0 1.5707963267948966", "0 -1.5707963267948966 0"),
        ("rows: [x, y]", "rows: [x, z]"),
        ("coordinates: [x, y]", "coordinates: [x, z]"),
    )
    folder = tmp_path / "biglide"
    folder.mkdir()
    for file in (root / "tests/robots/biglide").iterdir():
        text = file.read_text()
        for old, new in turned:
            text = text.replace(old, new)
        (folder / file.name).write_text(text)
    plan = paper_plan(load_robot(folder), Equipment())
    assert plan.postures["z_max"].values == pytest.approx([0.0, 0.06])
    assert plan.postures["x_min"].values == pytest.approx([-0.08, 0.0])
