"""Sheet, programs and scene of sensors at the tool: known zeros, artefacts, bars that turn."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from lxml import etree
from machines import place

from orthocal import load_plan
from orthocal.observation.contacts import locate_contacts
from orthocal.output.scene.drawing import draw_scene
from orthocal.output.sheet.page import sheet_files

PLAN = """robot: orthoglide
gauge: {sigma_mm: 0.005, range_mm: [-5, 5]}
postures:
  a: {tcp_mm: [50, 0, -20]}
  b: {tcp_mm: [0, 50, -20]}
  c: {tcp_mm: [-50, 0, -20]}
setups:
  plate: {sensor: tool_indicator, direction: -z, artefact: {kind: plate, length_mm: 150},
          tool_mm: [0, 0, -40]}
  bar: {sensor: ball_bar, centre_mm: [0, 0, -100], length_mm: 64, tool_mm: [0, 0, -40]}
"""


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures")
    (folder / "plan.yaml").write_text(PLAN)
    return load_plan(folder / "plan.yaml")


@pytest.fixture(scope="module")
def files(plan):
    return sheet_files(plan)


def section(files, number):
    page = etree.HTML(files["sheet.html"])
    (found,) = page.xpath(f'//section[@id="setup-{number}"]')
    return found


def words(element):
    return " ".join("".join(element.itertext()).split())


def test_only_a_gauge_with_a_free_zero_is_set(files):
    plate, bar = (words(section(files, n)) for n in (1, 2))
    assert "turn the bezel" in plate
    assert "turn the bezel" not in bar
    assert "set the dial to 0" in files["01-plate.ngc"]
    assert "set the dial" not in files["02-bar.ngc"]


@pytest.mark.parametrize(
    ("setup", "with_dial"),
    [
        ("{sensor: probe, direction: -z, surface: plane}", False),
        ("{sensor: points, target_mm: [0, 0, -40], frame: unknown}", False),
        ("{sensor: ball_bar, centre_mm: [0, 0, -20], length_mm: 50}", True),
    ],
    ids=("probe", "points", "bar"),
)
def test_a_dial_is_drawn_and_named_only_where_one_is_read(tmp_path, setup, with_dial):
    (tmp_path / "plan.yaml").write_text(
        "robot: orthoglide\npostures: {out: {tcp_mm: [50, 0, -20]}, in: {tcp_mm: [-50, 0, -20]}}\n"
        f"setups: {{only: {setup}}}\n"
    )
    plan = load_plan(tmp_path / "plan.yaml")
    page = etree.HTML(sheet_files(plan)["sheet.html"])
    assert ("dial grows" in words(page)) is with_dial
    assert ("dial must show" in words(page)) is with_dial
    (head,) = (h for h in page.iter("h3") if words(h) == "Rules for all readings")
    rules = words(head.getnext())
    assert "leave the box empty" in rules
    assert "set the gauge zero" not in rules  # it is known
    for words_of_dials in ("bezel", "dial", "in contact"):
        assert (words_of_dials in rules) is with_dial


def test_only_a_sheet_with_a_bar_warns_of_its_fixed_ball(plan, files):
    """In the rules for programs, before the first motion, at the mounting and at the end."""
    page = etree.HTML(files["sheet.html"])
    (rules,) = (words(p) for p in page.iter("p") if words(p).startswith("Programs: "))
    assert "fixed ball" in rules
    plate, bar = (section(files, n) for n in (1, 2))
    assert "fixed ball" not in words(plate)
    move, mount, *_ = (words(step) for step in bar.findall(".//li"))
    assert "tool at 50, 0, −20 mm" in move
    assert "after the tool is in the alignment posture" in mount
    assert "same ball" in words(bar.findall("p")[-1])
    alone = replace(
        plan,
        setups={"plate": plan.setups["plate"]},
        readings=tuple(r for r in plan.readings if r.setup == "plate"),
    )
    assert "fixed ball" not in sheet_files(alone)["sheet.html"]


def test_pictures_show_the_artefact_and_the_bar(files):
    for number, label in ((1, "dial grows −z"), (2, "fixed ball")):
        pictures = section(files, number).findall(".//svg")
        assert len(pictures) == 2
        assert all(label in words(picture) for picture in pictures)
    outlines = section(files, 1).findall(".//svg")[1].findall(".//polygon")
    corners = [re.findall(r"[-0-9.]+", p.get("points")) for p in outlines]
    assert any(len(c) == 8 for c in corners)


def test_a_bar_turns_about_its_fixed_ball_with_the_tool(plan):
    scene = draw_scene(plan)
    (moving,) = [n for n in scene.nodes if n.endswith("bar/bar/rod")]
    node = moving.removesuffix("/rod").removeprefix("/")
    pose = scene.pose(node)
    np.testing.assert_allclose(pose[:3, 3], [0.0, 0.0, -0.1], atol=1e-9)
    tool = place(plan.robot, plan.robot.drive_zero, plan.robot.tcp.frame)
    along = tool + np.array([0.0, 0.0, -0.04]) - pose[:3, 3]
    np.testing.assert_allclose(pose[:3, 2], along / np.linalg.norm(along), atol=1e-6)
    (command,) = [c for c in scene.commands if c["type"] == "set_animation"]
    assert any(part["path"].endswith("bar/bar") for part in command["animations"])


def drawn_block(picture):
    """Corners of the artefact, shape (4, 2), and the contact, shape (2,), on paper, [mm]."""
    (outline,) = (p.get("points") for p in picture.iter("polygon") if p.get("fill") == "#dbe9d8")
    (tip,) = (c for c in picture.iter("circle") if (c.get("r"), c.get("fill")) == ("1.10", "#222"))
    corners = np.array([[float(v) for v in pair.split(",")] for pair in outline.split()])
    return corners, np.array([float(tip.get("cx")), float(tip.get("cy"))])


def test_a_gauge_block_stands_on_the_table(tmp_path):
    """It is drawn from the tip on the table to the tip on the block, beside it or under it."""
    (tmp_path / "plan.yaml").write_text(
        """robot: orthoglide
gauge: {sigma_mm: 0.005, range_mm: [-5, 5]}
postures:
  beside: {tcp_mm: [10, 0, -20]}
  above: {tcp_mm: [10, 0, 30]}
setups:
  step: {sensor: tool_indicator, direction: -z, tool_mm: [0, 0, -40],
         artefact: {kind: gauge_block, height_mm: 50, table_mm: 20}}
"""
    )
    plan = load_plan(tmp_path / "plan.yaml")
    for posture in ("beside", "above"):
        setups = {"step": replace(plan.setups["step"], aligned_at=posture)}
        files = sheet_files(replace(plan, setups=setups))
        block, tip = drawn_block(section(files, 1).findall(".//svg")[1])
        (low, top), (high, bottom) = block.min(axis=0), block.max(axis=0)
        if posture == "above":
            assert tip == pytest.approx([0.5 * (low + high), top], abs=0.02)
        else:
            assert tip[1] == pytest.approx(bottom, abs=0.02)
            assert not low - 5.0 < tip[0] < high + 5.0  # the radius of the dial
    rules = words(etree.HTML(files["sheet.html"]).find(".//header").getparent())
    assert "Hold the plunger up during these motions, then lower it again." in rules
    steps = words(section(files, 1))
    assert "touches the flat surface. Where the posture is higher, put the gauge block of" in steps
    assert "Clamp it" not in steps
    assert "Push the holder lightly" in steps
    assert "stand" not in rules
    _, contact = locate_contacts(plan)["step"]
    tips, corners = contact.points[:, 2], contact.surface[:, 2]
    assert np.array([corners.min(), corners.max()]) == pytest.approx(np.sort(tips), abs=1e-9)
    assert contact.surface[:, 0] == pytest.approx([0.01] * 4, abs=0.018)
