"""Machines of other sizes: the packaged one comes out of its own sizes, others close and move."""

from __future__ import annotations

from dataclasses import replace

import closed_form
import numpy as np
import pytest
import yaml
from tolerances import CLOSED_FORM

from orthocal.builder.build import describe_machine, make_robot, remake_robot
from orthocal.builder.linear_delta import LinearDelta
from orthocal.builder.machine_file import KINDS, MACHINE, Counting, read_machine
from orthocal.builder.orthoglide import FEET, Orthoglide
from orthocal.errors import RobotError
from orthocal.kinematics.loop_closure import LoopClosure

SMALL = Orthoglide(leg=0.25, travel=(0.1, 0.32), attachment=0.03, rods_apart=0.06, rod_radius=0.004)


def test_a_made_machine_has_adjustable_feet_beside_the_keys_of_its_kind():
    (text,) = (t for n, t in describe_machine(SMALL, name="mine").items() if n == "mine.yaml")
    assert FEET in text
    keys = yaml.safe_load(text)
    assert len(keys["orthocal"].pop("adjustments")) == 15
    assert keys == yaml.safe_load(SMALL.yaml())


@pytest.mark.parametrize("sizes", [SMALL, Orthoglide(leg=0.5, travel=(0.3, 0.7))])
def test_a_machine_of_other_sizes_moves_as_the_papers_equations_say(tmp_path, sizes):
    robot = make_robot(sizes, tmp_path / "mine")
    points = np.random.default_rng(0).uniform(-0.06, 0.06, (20, 3))
    drives = closed_form.inverse(points, length=sizes.leg)
    assert np.abs(LoopClosure(robot).forward(drives) - points).max() < CLOSED_FORM
    assert robot.drive_zero == pytest.approx([sizes.leg] * 3)
    assert [(d.lower, d.upper) for d in robot.drives] == [sizes.travel] * 3
    leg = robot.legs["y"]
    assert (leg.length, leg.rods["b"].radius) == pytest.approx((sizes.leg, sizes.rod_radius))
    apart = np.linalg.norm(leg.rods["a"].reference_root - leg.rods["b"].reference_root)
    assert apart == pytest.approx(sizes.rods_apart)


def test_dimensions_that_make_no_machine_are_refused(tmp_path):
    with pytest.raises(RobotError, match=r"dimensions.*does not include 400 mm, the leg length"):
        make_robot(Orthoglide(leg=0.4), tmp_path / "mine")
    assert not (tmp_path / "mine").exists()


COUNTING = (Counting(True, 0.0), Counting(False, 0.0), Counting(True, None))


def test_a_machine_is_made_again_from_its_sizes_in_one_place(tmp_path):
    folder = tmp_path / "mine"
    make_robot(SMALL, folder, counting=COUNTING)
    file = folder / MACHINE
    assert read_machine(file) == (SMALL, COUNTING)
    before = {p.name: p.read_text() for p in folder.iterdir()}
    remake_robot(folder)
    assert {p.name: p.read_text() for p in folder.iterdir()} == before
    file.write_text(file.read_text().replace("leg_mm: 250", "leg_mm: 260"))
    described = folder / "mine.yaml"  # what else was changed there stays
    described.write_text(described.read_text().replace("offset_mm: 10,", "offset_mm: 4,"))
    robot = remake_robot(folder)
    fresh = make_robot(replace(SMALL, leg=0.26), tmp_path / "mine.fresh", counting=COUNTING)
    fresh_urdf = fresh.urdf.read_text().replace('"mine.fresh"', '"mine"')
    assert (folder / "mine.urdf").read_text() == fresh_urdf
    assert robot.drive_zero == pytest.approx([0.26] * 3)
    assert robot.parameters["x_slide.offset"].prior_std == pytest.approx(2e-3)
    assert described.read_text().replace("offset_mm: 4,", "offset_mm: 10,").replace(
        "mine", ""
    ) == fresh.yaml.read_text().replace("mine.fresh", "")


@pytest.mark.parametrize("kind", KINDS)
def test_machines_of_every_kind_are_made_again_from_one_file(tmp_path, kind):
    folder, usual = tmp_path / "mine", KINDS[kind]()
    counting = tuple(Counting(k % 2 == 0, 0.01 * k) for k in range(len(usual.letters)))
    robot = make_robot(usual, folder, counting=counting, effects=["backlash"])
    assert robot.drive_zero == pytest.approx([usual.zero] * len(usual.letters))
    assert [d.direction for d in robot.drives] == [1, -1, 1][: len(usual.letters)]
    shown = [float(d.to_joint(d.zero)) for d in robot.drives]
    assert shown == pytest.approx([0.01 * k for k in range(len(counting))])
    assert robot.effect_names == ("backlash",)
    dimensions, read = read_machine(folder / MACHINE)
    assert read == counting
    for d in usual.keys:
        value = getattr(dimensions, d.name)
        assert value == pytest.approx(getattr(usual, d.name), rel=1e-9), d.key
    before = {p.name: p.read_text() for p in folder.iterdir()}
    assert remake_robot(folder).sha256 == robot.sha256
    assert {p.name: p.read_text() for p in folder.iterdir()} == before


def test_the_default_workspace_of_a_delta_follows_its_dimensions(tmp_path):
    make_robot(LinearDelta(), tmp_path / "mine")
    file = tmp_path / "mine" / MACHINE
    file.write_text(file.read_text().replace("radius_mm: 140", "radius_mm: 100"))
    fresh = make_robot(LinearDelta(radius=0.1), tmp_path / "fresh")
    assert (remake_robot(tmp_path / "mine").workspace == fresh.workspace).all()


def test_a_file_without_a_kind_is_of_an_orthoglide(tmp_path):
    make_robot(SMALL, tmp_path / "mine")
    file = tmp_path / "mine" / MACHINE
    text = file.read_text()
    file.write_text(text.replace("kind: orthoglide\n", ""))
    assert read_machine(file)[0] == SMALL
    file.write_text(text.replace("orthoglide", "biglide").replace("  z_slide", "  # z_slide"))
    assert read_machine(file)[0].find_problem() is None
    for kind, message in (
        ("hexaglide", r"kind: found 'hexaglide'; expected ortho"),
        ("[]", r"kind: found \[\]; expected orthoglide"),
        ("biglide", r"joints\.z_slide: unknown key"),
    ):
        file.write_text(text.replace("orthoglide", kind))
        with pytest.raises(RobotError, match=rf"machine\.yaml: {message}"):
            read_machine(file)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("leg_mm: 250", "leg_mm: 0.25", "machine.yaml: leg_mm: legs of 0.25 mm; expected 20 to"),
        ("[100, 320]", "[100, 240]", "machine.yaml: travel_mm: travel from 100 to 240 mm does not"),
        ("[100, 320]", "[100]", "machine.yaml: travel_mm"),
        ("leg_mm: 250", "leg_mm: long", "machine.yaml: leg_mm"),
        ("counts: down", "counts: left", "machine.yaml: joints.y_slide.counts"),
        ("at_zero_mm: 0}", "at_zero_mm: 1e6}", "joints: 1000000 mm in the mechanical zero"),
        ("leg_mm", "legs_mm", "machine.yaml: legs_mm"),
    ],
)
def test_a_size_that_makes_no_machine_is_named_by_its_key(tmp_path, old, new, message):
    folder = tmp_path / "mine"
    make_robot(SMALL, folder, counting=COUNTING)
    before = (folder / "mine.urdf").read_text()
    text = (folder / MACHINE).read_text()
    assert old in text
    (folder / MACHINE).write_text(text.replace(old, new, 1))
    with pytest.raises(RobotError) as e:
        remake_robot(folder)
    assert message in str(e.value)
    assert (folder / "mine.urdf").read_text() == before


def test_a_description_that_is_not_utf_8_is_refused_and_stays(tmp_path):
    make_robot(SMALL, tmp_path / "mine")
    described = tmp_path / "mine/mine.yaml"
    content = described.read_bytes() + "# geprüft\n".encode("latin-1")
    described.write_bytes(content)
    with pytest.raises(RobotError, match=r"mine\.yaml: is not UTF-8 text"):
        remake_robot(tmp_path / "mine")
    assert described.read_bytes() == content


def test_a_description_without_a_place_for_a_size_is_named(tmp_path):
    folder = tmp_path / "mine"
    make_robot(SMALL, folder)
    described = folder / "mine.yaml"
    text = described.read_text()
    described.write_text(text.replace("y_slide: {zero_mm: 250}", "y_slide: {}"))
    with pytest.raises(RobotError, match=r"mine\.yaml: has no line 'y_slide:"):
        remake_robot(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"leg": 250.0}, "legs of 250000 mm; expected 20 to 5000 mm"),
        ({"leg": 0.4}, "does not include 400 mm, the leg length"),
        (
            {"travel": (0.12, 0.65)},
            "travel from 120 to 650 mm; legs of 310.25 mm reach 31.025 to 589.475",
        ),
        ({"attachment": -0.01}, "hinges -10 mm from the tool centre point; expected 0"),
        ({"rods_apart": 0.01}, "rods of radius 5.5 mm, 10 mm apart; expected a radius above 0"),
        ({"rod_radius": 0.0}, "rods of radius 0 mm"),
        ({"leg": float("nan")}, "legs of nan mm"),
    ],
)
def test_sizes_that_make_no_machine_are_refused(tmp_path, change, message):
    with pytest.raises(RobotError, match="dimensions") as e:
        make_robot(Orthoglide(**change), tmp_path / "mine")
    assert message in str(e.value)
    assert not (tmp_path / "mine").exists()
