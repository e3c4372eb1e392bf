"""The measuring sheet: all setups and rows, what to command, where to stand.

Numbers on it are held against Pinocchio's loops and placements.
"""

from __future__ import annotations

import re
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
from lxml import etree
from machines import place

from orthocal import load_plan
from orthocal.cli.run import main
from orthocal.output.sheet.page import sheet_files
from orthocal.robot.builder.build import make_robot
from orthocal.robot.builder.machine_file import Counting, Dimensions
from orthocal.units import MM

ROUNDED = 1e-3
"""Joints are shown with three decimals, [mm]."""

SHOWN = 0.06
"""Places are shown with one decimal, [mm]."""

SMALL = Dimensions(
    leg=0.25, lower=0.1, upper=0.32, attachment=0.03, rods_apart=0.06, rod_radius=0.004
)
COUNTING = (Counting(True, 0.0), Counting(False, 0.005), Counting(False, None))

PLAN = """robot: mine
title: '<script>alert("1")</script> & more'
gauge: {range_mm: [-5, 5], resolution_mm: 0.01}
postures:
  zero: {tcp_mm: [0, 0, 0]}
  <out>: {tcp_mm: [40, -15, 4]}
  in&: {joints_mm: [200, 245, 240]}
setups:
  <b>yx: {leg: x, touches: a, tip: {ball: {radius_mm: 1.5}}, direction: y, section: {fraction: 0.5}}
  xy: {leg: y, touches: b, tip: {blade: {width_mm: 20}}, direction: -x, section: {fraction: 0.4},
       postures: [in&, <out>]}
  zx: {leg: x, direction: z, section: {fraction: 0.5}}
  oblique: {leg: z, touches: b, tip: {blade: {width_mm: 60, radius_mm: 2}}, direction: [1, 1, 0],
            section: {fraction: 0.45}}
"""


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sheet")
    make_robot(SMALL, folder / "mine", counting=COUNTING)
    (folder / "plan.yaml").write_text(PLAN)
    return load_plan(folder / "plan.yaml")


@pytest.fixture(scope="module")
def files(small):
    return sheet_files(small)


@pytest.fixture(scope="module")
def page(files):
    return etree.HTML(files["sheet.html"])


def words(element):
    return " ".join("".join(element.itertext()).replace("−", "-").split())


def sections(page):
    return page.xpath("//section[starts-with(@id, 'setup-')]")


def rows(section):
    """Cells of the rows of a setup."""
    lines = section.xpath(".//table[@class='boxes']/tbody/tr")
    return [[words(cell) for cell in line] for line in lines]


def test_every_setup_and_row_is_on_it(small, page):
    found = sections(page)
    names = list(small.setups)
    assert [words(s.find("h2")) for s in found] == [
        f"Setup {i} of 4: {name}" for i, name in enumerate(names, 1)
    ]
    readings = list(small.readings)
    for section, name in zip(found, names, strict=True):
        expected = [(str(i + 2), r.posture) for i, r in enumerate(readings) if r.setup == name]
        own = rows(section)
        assert [(r[0], r[1]) for r in own[:-1]] == expected
        # back to the first posture, with a box of its own
        assert own[-1][:2] == ["", f"{expected[0][1]}, again"]
        assert len(section.xpath(".//td[@class='box']")) == len(own)


def test_joints_on_it_bring_pinocchios_tool_to_where_it_says(small, page):
    robot = small.robot
    for section in sections(page):
        for row in rows(section):
            tool = [float(v) for v in row[2].split(",")]
            joints = [float(v) * MM for v in row[3:6]]
            drives = [d.from_joint(v) for d, v in zip(robot.drives, joints, strict=True)]
            at = place(robot, drives, robot.tcp.frame) / MM
            assert at == pytest.approx(tool, abs=2.0 * ROUNDED)


def test_where_a_tip_touches_is_where_the_rod_is(small, page):
    """Surface of rod a in the mechanical zero: half the rods' distance up, a radius towards y."""
    text = words(sections(page)[0])
    robot, drives = small.robot, small.robot.drive_zero
    root, tip = (place(robot, drives, f) for f in ("x_bar_a", "x_coupler"))
    expected = 0.5 * (root + tip) + np.array([0.0, 0.004, 0.0])
    found = re.search(r"in the world at \(([-\d., ]+)\) mm", text)
    assert [float(v) for v in found[1].split(",")] == pytest.approx(expected / MM, abs=SHOWN)
    assert "on the +y side of rod a of leg x, its plunger pointing to -y" in text
    assert "ball of 3 mm diameter touches over the middle of the rod, 125.0 mm from" in text


def test_a_rod_that_lies_aside_in_the_first_posture_is_told(small):
    """By how much the tip, over the rod's middle in the zero, is beside it: by Pinocchio's rod."""
    readings = [r for r in small.readings if r.setup == "<b>yx" and r.posture == "<out>"]
    session = replace(small, readings=tuple(readings))
    text = words(sections(etree.HTML(sheet_files(session)["sheet.html"]))[0])
    robot = small.robot
    drives = small.postures["<out>"].drives
    root, tip = (place(robot, drives, f) for f in ("x_bar_a", "x_coupler"))
    at_zero = place(robot, robot.drive_zero, "x_bar_a")
    share = (root[0] - (at_zero[0] - 0.125)) / (root[0] - tip[0])
    axis = root + share * (tip - root)
    across = np.cross(tip - root, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    # the plunger's line, through the rod as it was in the zero, from the rod's axis now
    aside = float((np.array([at_zero[0] - 0.125, 0.0, at_zero[2]]) - axis) @ across) / MM
    found = re.search(r"touches (\d+\.\d) mm beside the middle of the rod, towards", text)
    assert float(found[1]) == pytest.approx(abs(aside), abs=SHOWN)
    assert abs(aside) > 1.0


def test_what_is_done_with_the_gauge_is_said(page):
    ball, blade, line, pin = (words(s) for s in sections(page))
    for text in (ball, blade, line, pin):
        assert "does the dial grow? If it falls, write every reading" in text
        assert "half of its travel (5 mm) is taken, and turn the bezel until it shows 0" in text
    assert "blade 20 mm wide" in blade
    assert "on the -x side of rod b of leg y, its plunger pointing to +x" in blade
    assert "it touches the line between the rods; in the world at (155.0, 0.0, 0.0) mm" in line
    assert "pin of 4 mm diameter, 60 mm wide" in pin
    # the leg moves aside by more than this dial has
    assert "Even a perfect machine would show -32.7 mm in line 6" in blade
    assert "Hold the plunger up on the way to line 6, in&: the dial would go -32.7 mm" in blade
    assert "Even a perfect" not in line
    assert "on the (0.71, 0.71, 0.00) side of rod b of leg z" in pin


def test_what_holds_for_the_machine_is_said(page):
    text = words(page.find("body"))
    assert "must show about x_slide 0.000 mm, y_slide 5.000 mm, z_slide 250.000 mm" in text
    assert "x_slide -150.0 to 70.0 mm; y_slide -65.0 to 155.0 mm; z_slide 180.0 to 400.0 mm" in text
    assert "its number must grow for x_slide, fall for y_slide, fall for z_slide" in text
    assert (
        "towards larger numbers of x_slide, smaller numbers of y_slide, smaller numbers of z_slide"
    ) in text
    assert "touch nothing of the gauge: not its bezel" in text
    assert "write controller: {offsets_mm: [0, 0, 0]} there" in text
    assert words(page.find(".//code")) == "orthocal calibrate ."


def test_offsets_that_were_entered_are_no_fault_of_the_robots_files(small):
    """Home switches are off by what is to be found; entered, it shifts where joints may go."""
    for active, told in (([0.0] * 3, " mm. If a number"), ([1e-3, 0.0, 0.0], "what was entered.")):
        text = sheet_files(small.with_controller(np.array(active)))["sheet.html"]
        assert "zeros may be off by a few mm, which the calibration finds" in text
        (limits,) = re.findall(r"Its joints may go: [^<]*", text)
        assert told in limits
        assert ("shifted by" in limits) == any(active)


def test_odd_names_are_texts(files, page):
    text = files["sheet.html"]
    assert page.xpath("//script") == []
    assert page.xpath("//b") == []
    assert '<script>alert("1")</script> & more' in words(page.find("body"))
    assert "://" not in text.replace('xmlns="http://www.w3.org/2000/svg"', "")
    assert "default-src 'none'" in text


def test_pictures_are_whole_and_on_their_paper(page, files):
    """A picture of the machine and one of the rods for each setup, with what they have to name."""
    drawn = re.findall(r"<svg.*?</svg>", files["sheet.html"])
    assert len(drawn) == 2 * 4
    for svg in drawn:
        root = etree.fromstring(svg.encode())
        _, _, width, height = (float(v) for v in root.get("viewBox").split())
        pairs = " ".join(e.get("points") for e in root.iter("{*}polygon", "{*}polyline"))
        points = np.array([[float(v) for v in p.split(",")] for p in pairs.split()])
        assert np.isfinite(points).all()
        assert (points >= 0.0).all()
        assert (points <= [width, height]).all()
    for section in sections(page):
        machine, cut = (words(svg) for svg in section.xpath(".//*[local-name()='svg']"))
        assert "dial grows" in machine
        assert "tool" in machine
        assert "rod a" in cut
        assert "rod b" in cut


def test_a_tip_near_a_hinge_is_warned_of(small):
    sensor = small.setups["xy"].sensor
    near = replace(sensor, section=replace(sensor.section, value=0.99))
    setups = {**small.setups, "xy": replace(small.setups["xy"], sensor=near)}
    text = words(etree.HTML(sheet_files(replace(small, setups=setups))["sheet.html"]).find("body"))
    assert text.count("of the middle of a hinge") == 1


@pytest.mark.parametrize("name", ["raw_cycles", "experiment_2"])
def test_sessions_that_are_there_have_sheets(request, name):
    session = request.getfixturevalue(name)
    found = sheet_files(session)
    assert len(found) == 1 + len({r.setup for r in session.readings})
    page = etree.HTML(found["sheet.html"])
    assert len(page.xpath("//td[@class='box']")) >= len(session.readings)
    if name == "experiment_2":
        assert "set to 0" in words(page.find("body"))


def test_a_planar_robot_has_a_sheet(root, tmp_path):
    (tmp_path / "plan.yaml").write_text(
        f"robot: {root / 'tests/robots/biglide'}\n"
        "postures: {zero: {joints_mm: [200, 200]}, out: {tcp_mm: [10, -5]}}\n"
        "setups: {yx: {leg: x, direction: y, section: {fraction: 0.5}}}\n"
    )
    found = sheet_files(load_plan(tmp_path / "plan.yaml"))
    assert "Z" not in re.sub(r"\([^)]*\)", "", found["01-yx.ngc"])
    assert len(rows(sections(etree.HTML(found["sheet.html"]))[0])) == 3


def test_without_a_tool_there_are_joints_alone(root, tmp_path):
    folder = tmp_path / "biglide"
    shutil.copytree(root / "tests/robots/biglide", folder)
    yaml = folder / "biglide.yaml"
    yaml.write_text(re.sub(r"(?m)^ *tcp: .*$", "", yaml.read_text()))
    (tmp_path / "plan.yaml").write_text(
        "robot: biglide\n"
        "postures: {zero: {joints_mm: [200, 200]}, out: {joints_mm: [210, 195]}}\n"
        "setups: {yx: {leg: x, direction: y, section: {fraction: 0.5}}}\n"
    )
    found = sheet_files(load_plan(tmp_path / "plan.yaml"))
    assert list(found) == ["sheet.html"]
    own = rows(sections(etree.HTML(found["sheet.html"]))[0])
    assert [r[1:4] for r in own][1] == ["out", "210.000", "195.000"]


def run(monkeypatch, capsys, *given):
    monkeypatch.setattr(sys, "argv", ["orthocal", *map(str, given)])
    with pytest.raises(SystemExit) as ended:
        main()
    out, err = capsys.readouterr()
    return ended.value.code or 0, out, err


def test_the_command_writes_beside_the_session_or_elsewhere(monkeypatch, capsys, small, tmp_path):
    session, out = small.path, tmp_path / "out"
    code, _, err = run(monkeypatch, capsys, "sheet", session, "--out", out, "--shift-mm", "0,0,50")
    assert code == 0
    assert f"Wrote {out}/sheet.html to print and 4 programs" in err
    assert "Z50.0000" in (out / "03-zx.ngc").read_text()
    assert "the world moved by 0, 0, 50 mm" in (out / "sheet.html").read_text()
    code, _, err = run(monkeypatch, capsys, "sheet", session, "--out", out)
    assert code == 2
    assert err == f"orthocal: {out}/sheet.html: is there already; --force writes over it\n"
    code, _, _ = run(monkeypatch, capsys, "sheet", session, "--out", out, "--force")
    assert code == 0
    assert "Z50" not in (out / "03-zx.ngc").read_text()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["nowhere"], "nowhere: there is no such file"),
        (["examples/workshop/plan.yaml", "--shift-mm", "1,2"], "--shift-mm: found '1,2'; expected"),
        (["examples/workshop/plan.yaml", "--shift-mm", "1,2,z"], "--shift-mm: part is 'z'; exp"),
        (["examples/workshop/plan.yaml", "--feed", "0"], "--feed: found 0; expected 1 to 20000"),
    ],
)
def test_what_makes_no_sheet_is_refused(monkeypatch, capsys, root, tmp_path, given, message):
    given[0] = str(root / given[0])
    code, out, err = run(monkeypatch, capsys, "sheet", *given, "--out", tmp_path / "out")
    assert (code, out) == (2, "")
    assert message in err
    assert len(err.splitlines()) == 1
    assert not (tmp_path / "out").exists()
