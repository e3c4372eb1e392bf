"""Small files that would take a machine down are refused before the work, and say why."""

from __future__ import annotations

import re
import time

import pytest

from orthocal import load_robot, load_session
from orthocal.errors import OrthocalError, RobotError, SessionError
from orthocal.measurement.files.schema import LARGEST_READING_MM, MOST_READINGS
from orthocal.measurement.files.session_file import load_plan
from orthocal.robot.urdf import MOST_JOINTS, MOST_MOVING
from orthocal.viewer.visuals import load_visuals

PROMPT = 5.0
"""Processor time that no refusal may take, [s]."""


def write_robot(folder, count, kind):
    """A motor with a chain of so many joints."""
    joints = [
        '<joint name="motor" type="prismatic"><parent link="l0"/><child link="l1"/>'
        '<axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    ]
    joints += [
        f'<joint name="j{i}" type="{kind}"><origin xyz="0 0 0.1"/><parent link="l{i}"/>'
        f'<child link="l{i + 1}"/><axis xyz="0 0 1"/></joint>'
        for i in range(1, count)
    ]
    links = "".join(f'<link name="l{i}"/>' for i in range(count + 1))
    folder.mkdir()
    (folder / "robot.urdf").write_text(f'<robot name="r">{links}{"".join(joints)}</robot>')
    (folder / "robot.yaml").write_text("closed_loop: []\ntype: []\nname_mot: [motor]\n")
    return folder


def refusal(act, *args):
    """The message with which something is refused, promptly."""
    began = time.process_time()
    with pytest.raises(OrthocalError) as caught:
        act(*args)
    assert time.process_time() - began < PROMPT
    assert caught.value.exit_code == 2
    return str(caught.value)


@pytest.mark.parametrize("count", [4000, 50_000])
def test_a_chain_that_would_end_the_stack_of_a_parser(count, tmp_path):
    folder = write_robot(tmp_path / "robot", count, "fixed")
    message = refusal(load_robot, folder)
    assert message.endswith(f"has {count} joints; expected at most {MOST_JOINTS}")


def test_the_longest_chain_that_is_taken_ends_no_stack(tmp_path):
    assert load_robot(write_robot(tmp_path / "robot", MOST_JOINTS, "fixed")).model.nv == 1


def test_more_moving_joints_than_any_robot_has(tmp_path):
    folder = write_robot(tmp_path / "robot", 400, "continuous")
    message = refusal(load_robot, folder)
    assert message.endswith(f"has 400 moving joints; expected at most {MOST_MOVING}")


def test_more_elements_than_any_robot_has(tmp_path):
    folder = write_robot(tmp_path / "robot", 2, "fixed")
    path = folder / "robot.urdf"
    path.write_text(path.read_text().replace("</robot>", "<link/>" * 30_000 + "</robot>"))
    assert "elements; expected at most" in refusal(load_robot, folder)


@pytest.fixture
def biglide_at(root, tmp_path):
    """A robot folder that can be spoilt."""
    folder = tmp_path / "biglide"
    folder.mkdir()
    for kind in ("yaml", "urdf"):
        data = (root / f"tests/robots/biglide/biglide.{kind}").read_bytes()
        (folder / f"biglide.{kind}").write_bytes(data)
    return folder


@pytest.mark.parametrize(
    "element",
    [
        '<origin xyz="1e308 0 0"/><geometry><sphere radius="0.1"/></geometry>',
        '<geometry><sphere radius="1e308"/></geometry>',
        '<geometry><box size="1e308 1 1"/></geometry>',
        '<geometry><cylinder radius="1e308" length="1"/></geometry>',
        '<geometry><mesh filename="a.stl" scale="1e308 1 1"/></geometry>',
    ],
)
def test_sizes_and_places_beyond_any_robot(element, biglide_at):
    path = biglide_at / "biglide.urdf"
    text = path.read_text()
    link = next(line for line in text.splitlines() if "<link name=" in line)
    name = link.split('"')[1]
    new = f'<link name="{name}"><visual>{element}</visual></link>'
    assert link.strip().endswith("/>")
    path.write_text(text.replace(link, new, 1))
    assert "within ±10000" in refusal(load_robot, biglide_at)


@pytest.mark.parametrize("place", ['xyz="1e308 0 0"', 'rpy="0 1e308 0"'])
def test_a_joint_beyond_any_robot(place, biglide_at):
    path = biglide_at / "biglide.urdf"
    text = path.read_text()
    spoilt = re.sub(r"<origin [^>]*/>", f"<origin {place}/>", text, count=1)
    assert spoilt != text
    path.write_text(spoilt)
    assert "1e308" in (message := refusal(load_robot, biglide_at))
    assert message.endswith("expected numbers within ±10000")


def test_a_mesh_beyond_any_robot(biglide_at):
    (biglide_at / "a.stl").write_text(
        "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1e308 0 0\n"
        "vertex 0 1e30 0\nendloop\nendfacet\nendsolid a\n"
    )
    path = biglide_at / "biglide.urdf"
    text = path.read_text()
    link = next(line for line in text.splitlines() if "<link name=" in line)
    name = link.split('"')[1]
    mesh = '<visual><geometry><mesh filename="a.stl"/></geometry></visual>'
    path.write_text(text.replace(link, f'<link name="{name}">{mesh}</link>', 1))
    with pytest.raises(RobotError, match=r"the mesh '.*a.stl' reaches beyond"):
        load_visuals(load_robot(biglide_at))


DOCTYPE = '<!DOCTYPE robot [<!ENTITY a "b">]>'


@pytest.mark.parametrize(
    ("encoding", "text"),
    [
        ("utf-8", f"<?xml version='1.0' encoding='UTF-7'?>{DOCTYPE}"),
        ("utf-8", f"<?xml version='1.0' encoding='UTF-16'?>{DOCTYPE}"),
        ("utf-8", "<?xml version='1.0' encoding='UTF-7'?>+ADwAIQ-DOCTYPE robot +AFs-+AF0APg-"),
        ("utf-16", f"<?xml version='1.0' encoding='UTF-16'?>{DOCTYPE}"),
        ("utf-32", DOCTYPE),
        ("utf-8", f"<?xml version='1.0' encoding='EBCDIC-US'?>{DOCTYPE}"),
    ],
)
def test_a_doctype_in_any_encoding(encoding, text, biglide_at):
    path = biglide_at / "biglide.urdf"
    good = path.read_text()
    body = good[good.index("<robot") :]
    path.write_bytes((text + body).encode(encoding))
    message = refusal(load_robot, biglide_at)
    assert any(word in message for word in ("has a DOCTYPE", "is not UTF-8", "is not valid XML"))


# ---- sessions


@pytest.fixture
def session(root, tmp_path):
    """The folder of a session that can be spoilt."""
    for name in ("session.yaml", "readings.csv"):
        data = (root / "examples/table1/experiment-2" / name).read_bytes()
        (tmp_path / name).write_bytes(data)
    return tmp_path


def swap(path, old, new):
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")


def test_a_plan_of_more_readings_than_anyone_takes(root, tmp_path):
    text = (root / "examples/raw-cycles/plan.yaml").read_text(encoding="utf-8")
    text = re.sub(r", postures: \[[^]]*\]", "", text)
    lines = [line for line in text.splitlines() if not line.startswith("cycles")]
    zero = next(i for i, line in enumerate(lines) if line.startswith("postures:"))
    more = [f"  p{i}: {{tcp_mm: [{i % 50}, 0, 0]}}" for i in range(100)]
    text = "\n".join([*lines[: zero + 1], *more, *lines[zero + 1 :], "cycles: 1000"])
    assert len(text) < 6000
    (tmp_path / "plan.yaml").write_text(text, encoding="utf-8")
    message = refusal(load_plan, tmp_path / "plan.yaml")
    assert "plan.yaml: cycles: plans " in message
    assert f"expected at most {MOST_READINGS}" in message


def test_more_readings_than_anyone_takes(session):
    rows = "".join(f"yx,x_max,x_min,{i},0.42\n" for i in range(1, MOST_READINGS + 2))
    (session / "readings.csv").write_text(f"setup,posture,minus,cycle,reading_mm\n{rows}")
    assert f"holds more than {MOST_READINGS} readings" in refusal(load_session, session)


@pytest.mark.parametrize("key", ["resolution_mm", "sigma_mm"])
def test_a_resolution_of_a_thousand_kilometres(key, session):
    old = {"resolution_mm": "resolution_mm: 0.01", "sigma_mm": "sigma_mm: 0.02"}[key]
    swap(session / "session.yaml", old, f"{key}: 1.0e+9")
    message = refusal(load_session, session)
    assert message.endswith(f"gauge.{key}: found '1000000000.0'; expected less than or equal to 10")


def test_differences_of_five_metres(session):
    swap(session / "session.yaml", ", range_mm: [-5, 5]", "")
    swap(session / "readings.csv", "0.42", "5000")
    message = refusal(load_session, session)
    assert f"reading_mm is 5000; expected a number within ±{LARGEST_READING_MM:g}" in message


def test_a_chain_of_differences_is_followed_without_going_back(session):
    """Each difference joins the one before: looked up from the far end it would take for ever."""
    count = 3000
    postures = "".join(f"  p{i}: {{tcp_mm: [{i * 0.01:.2f}, 0, 0]}}\n" for i in range(count))
    swap(session / "session.yaml", "postures:\n", f"postures:\n{postures}")
    rows = "".join(f"yx,p{i},p{i - 1},1,0.001\n" for i in range(count - 1, 0, -1))
    (session / "readings.csv").write_text(f"setup,posture,minus,cycle,reading_mm\n{rows}")
    began = time.process_time()
    assert len(load_session(session).readings) == count - 1
    assert time.process_time() - began < 2.0 * PROMPT


def test_a_number_that_is_a_text_of_megabytes(session):
    swap(session / "readings.csv", "0.42", "4" * 100_000)
    with pytest.raises(SessionError) as caught:
        load_session(session)
    assert len(str(caught.value)) < 500
