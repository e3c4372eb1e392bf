"""Limits of robots and sessions: too large ones are refused promptly."""

from __future__ import annotations

import re
import shutil
import time
from pathlib import Path

import pytest

from orthocal import load_robot, load_session
from orthocal.errors import OrthocalError, RobotError, SessionError
from orthocal.measurement.files import readings_checks, readings_file
from orthocal.measurement.files.session_file import load_plan
from orthocal.measurement.files.session_keys import LARGEST_READING_MM, MOST_READINGS
from orthocal.robot.urdf import MOST_JOINTS, MOST_MOVING
from orthocal.viewer.visuals import load_visuals

PROMPT = 5.0
"""Largest processor time of a refusal, [s]."""


def write_robot(folder, count, kind):
    """Robot of a motor and a chain of joints."""
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
    """Message of a prompt refusal."""
    began = time.process_time()
    with pytest.raises(OrthocalError) as caught:
        act(*args)
    assert time.process_time() - began < PROMPT
    assert caught.value.exit_code == 2
    return str(caught.value)


@pytest.mark.parametrize(
    ("count", "kind", "message"),
    [
        (4000, "fixed", f"has 4000 joints; expected at most {MOST_JOINTS}"),
        (50_000, "fixed", f"has 50000 joints; expected at most {MOST_JOINTS}"),
        (400, "continuous", f"has 400 moving joints; expected at most {MOST_MOVING}"),
    ],
)
def test_long_chains_are_refused(count, kind, message, tmp_path):
    assert refusal(load_robot, write_robot(tmp_path / "robot", count, kind)).endswith(message)


def test_the_longest_chain_is_loaded(tmp_path):
    assert load_robot(write_robot(tmp_path / "robot", MOST_JOINTS, "fixed")).model.nv == 1


@pytest.fixture
def biglide_at(root, tmp_path):
    """Copy of a robot directory."""
    return Path(shutil.copytree(root / "tests/robots/biglide", tmp_path / "biglide"))


LINK = '<link name="{}"><visual>{}</visual></link>'


def change_urdf(folder, pattern, new):
    """Replace the first match of a pattern in the URDF; {} is its first group."""
    path = folder / "biglide.urdf"
    text, count = re.subn(pattern, lambda m: new.format(*m.groups()), path.read_text(), count=1)
    assert count == 1
    path.write_text(text)


@pytest.mark.parametrize(
    ("pattern", "new", "message"),
    [
        *(
            (r'<link name="(\w+)"/>', LINK.format("{}", element), "within ±10000")
            for element in (
                '<origin xyz="1e308 0 0"/><geometry><sphere radius="0.1"/></geometry>',
                '<geometry><sphere radius="1e308"/></geometry>',
                '<geometry><box size="1e308 1 1"/></geometry>',
                '<geometry><cylinder radius="1e308" length="1"/></geometry>',
                '<geometry><mesh filename="a.stl" scale="1e308 1 1"/></geometry>',
            )
        ),
        ("<origin [^>]*/>", '<origin xyz="1e308 0 0"/>', "expected numbers within ±10000"),
        ("<origin [^>]*/>", '<origin rpy="0 1e308 0"/>', "expected numbers within ±10000"),
        ("</robot>", "<link/>" * 30_000 + "</robot>", "elements; expected at most"),
    ],
    ids=lambda v: v[:60],
)
def test_large_values_of_a_robot_are_refused(pattern, new, message, biglide_at):
    change_urdf(biglide_at, pattern, new)
    assert message in refusal(load_robot, biglide_at)


def test_a_large_mesh_is_refused(biglide_at):
    (biglide_at / "a.stl").write_text(
        "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1e308 0 0\n"
        "vertex 0 1e30 0\nendloop\nendfacet\nendsolid a\n"
    )
    mesh = LINK.format("{}", '<geometry><mesh filename="a.stl"/></geometry>')
    change_urdf(biglide_at, r'<link name="(\w+)"/>', mesh)
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
    """Copy of a session directory."""
    return Path(shutil.copytree(root / "examples/table1/experiment-2", tmp_path / "session"))


def swap(path, old, new):
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")


def test_a_plan_with_too_many_readings_is_refused(root, tmp_path):
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


def test_too_many_readings_are_refused(session, monkeypatch):
    most = MOST_READINGS // 10  # as promptly for each reading
    for module in (readings_checks, readings_file):
        monkeypatch.setattr(module, "MOST_READINGS", most)
    rows = "".join(f"yx,x_max,x_min,{i},0.42\n" for i in range(1, most + 2))
    (session / "readings.csv").write_text(f"setup,posture,minus,cycle,reading_mm\n{rows}")
    assert f"holds more than {most} readings" in refusal(load_session, session)


@pytest.mark.parametrize("key", ["resolution_mm", "sigma_mm"])
def test_a_large_resolution_is_refused(key, session):
    old = {"resolution_mm": "resolution_mm: 0.01", "sigma_mm": "sigma_mm: 0.02"}[key]
    swap(session / "session.yaml", old, f"{key}: 1.0e+9")
    message = refusal(load_session, session)
    assert message.endswith(f"gauge.{key}: found '1000000000.0'; expected less than or equal to 10")


def test_a_large_difference_is_refused(session):
    swap(session / "session.yaml", ", range_mm: [-5, 5]", "")
    swap(session / "readings.csv", "0.42", "5000")
    message = refusal(load_session, session)
    assert f"reading_mm is 5000; expected a number within ±{LARGEST_READING_MM:g}" in message


def test_a_chain_of_differences_is_followed_promptly(session):
    """Each difference refers to the one before it."""
    count = 1500
    postures = "".join(f"  p{i}: {{tcp_mm: [{i * 0.01:.2f}, 0, 0]}}\n" for i in range(count))
    swap(session / "session.yaml", "postures:\n", f"postures:\n{postures}")
    rows = "".join(f"yx,p{i},p{i - 1},1,0.001\n" for i in range(count - 1, 0, -1))
    (session / "readings.csv").write_text(f"setup,posture,minus,cycle,reading_mm\n{rows}")
    began = time.process_time()
    assert len(load_session(session).readings) == count - 1
    assert time.process_time() - began < 2.0 * PROMPT


def test_a_long_number_is_shortened_in_the_message(session):
    swap(session / "readings.csv", "0.42", "4" * 100_000)
    with pytest.raises(SessionError) as caught:
        load_session(session)
    assert len(str(caught.value)) < 500
