"""Session files: forms of postures and sections, controller offsets, round trips."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibrated import session_of
from hypothesis import given, settings
from hypothesis import strategies as st
from tolerances import CLOSED_FORM, KINEMATICS

from orthocal import (
    Gauge,
    Section,
    Tip,
    calibrate,
    load_plan,
    load_session,
    plan_readings,
    write_session,
)
from orthocal.effects.compensation import JointTrim
from orthocal.errors import ParameterError, SessionError
from orthocal.estimation.problem import build_problem
from orthocal.session.session import split_label

HEAD = """robot: orthoglide
postures:
  zero: {tcp_mm: [0, 0, 0]}
  x_max: {tcp_mm: [60, 0, 0]}
"""


def write(folder, setup="{leg: x, direction: y, section: {fraction: 0.5}}", head=HEAD, rows=None):
    folder.mkdir(exist_ok=True)
    text = f"{head}setups:\n  yx: {setup}\nreadings: readings.csv\n"
    (folder / "session.yaml").write_text(text)
    table = rows or "setup,posture,reading_mm\nyx,zero,0.1\nyx,x_max,0.2\n"
    (folder / "readings.csv").write_text(table)
    return folder


def test_experiment_2_has_the_printed_readings(experiment_2):
    assert [r.label for r in experiment_2.readings[:2]] == ["xy y_max − y_min", "xz z_max − z_min"]
    assert np.allclose(experiment_2.values * 1e3, [-0.43, -0.37, 0.42, -0.18, -1.14, -0.70])
    assert experiment_2.only_differences
    assert experiment_2.gauge.sigma == pytest.approx(0.02e-3)
    assert np.array_equal(experiment_2.controller_offsets, [0.0, 0.0, 0.0])


def test_postures_by_tool_and_by_joints_are_equal(tmp_path, experiment_2):
    tool = experiment_2.postures["x_max"].drives
    assert np.abs(tool - [0.37025, 0.304393, 0.304393]).max() < 1e-6
    mm = ", ".join(f"{v * 1e3:.9f}" for v in tool)
    head = HEAD.replace("{tcp_mm: [60, 0, 0]}", f"{{joints_mm: [{mm}]}}")
    by_joints = load_session(write(tmp_path / "s", head=head))
    assert np.abs(by_joints.postures["x_max"].drives - tool).max() < KINEMATICS


def test_a_session_without_its_robot_names_the_key(tmp_path):
    folder = write(tmp_path / "moved", head=HEAD.replace("robot: orthoglide", "robot: .."))
    with pytest.raises(SessionError, match=r"session\.yaml: robot: found '\.\.', .* no URDF"):
        load_session(folder)


def test_active_offsets_are_subtracted_from_the_drive_coordinates(tmp_path):
    plain = load_session(write(tmp_path / "plain"))
    head = HEAD + "controller: {offsets_mm: [0.5, -0.3, 0.2]}\n"
    active = load_session(write(tmp_path / "active", head=head))
    for name in ("zero", "x_max"):
        shift = active.postures[name].drives - plain.postures[name].drives
        assert np.abs(shift - [-0.0005, 0.0003, -0.0002]).max() < KINEMATICS
    assert np.abs(active.zero_drives - (0.31025 - active.active_offsets)).max() < KINEMATICS


@pytest.mark.parametrize(
    ("section", "expected"),
    [
        ("{fraction: 0.2}", (0.2 * 0.31025, True)),
        ("{from_root_mm: 100}", (0.1, True)),
        # the X-leg's axis points to -x, from root to tip
        ("{coordinate_mm: 150}", (-0.15, False)),
    ],
)
def test_sections_become_planes_along_the_leg(tmp_path, section, expected):
    setup = f"{{leg: x, direction: -y, section: {section}}}"
    session = load_session(write(tmp_path / "s", setup))
    plane, from_root = session.setups["yx"].sensor.plane(session.robot)
    assert abs(plane - expected[0]) < KINEMATICS
    assert from_root is expected[1]


@pytest.mark.parametrize("example", ["table1/experiment-2", "raw-cycles"])
def test_a_loaded_session_is_the_written_one(tmp_path, example):
    session = session_of(example)
    again = load_session(write_session(session, tmp_path / "copy"))
    assert again.title == session.title
    assert again.source == session.source
    assert np.abs(again.values - session.values).max() < KINEMATICS
    key = [(r.setup, r.posture, r.minus, r.cycle) for r in session.readings]
    assert [(r.setup, r.posture, r.minus, r.cycle) for r in again.readings] == key
    for name, posture in session.postures.items():
        assert np.abs(again.postures[name].drives - posture.drives).max() < CLOSED_FORM
    assert (again.controller_offsets is None) == (session.controller_offsets is None)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"compensation": (JointTrim(1e-5),) * 4}, "has 4 compensations of joints; expected 3"),
        ({"compensation": (JointTrim(1e-5),)}, "has 1 compensations of joints; expected 3"),
        (
            {"compensation": (JointTrim(1e-5, home=0.1), *(JointTrim(1e-5),) * 2)},
            "has 1 home positions of joints; expected 3",
        ),
        ({"gauges": {}}, "expected at least 1 item"),
    ],
)
def test_an_incomplete_session_is_not_written(tmp_path, raw_cycles, change, message):
    with pytest.raises(SessionError, match=message):
        write_session(replace(raw_cycles, **change), tmp_path / "copy")
    assert not (tmp_path / "copy/session.yaml").exists()


def test_a_name_that_would_not_load_is_not_written(tmp_path, raw_cycles):
    posture = replace(raw_cycles.postures["zero"], name="a,b")
    session = replace(raw_cycles, postures={**raw_cycles.postures, "a,b": posture})
    with pytest.raises(SessionError, match="without blanks, commas"):
        write_session(session, tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


@settings(max_examples=20, deadline=None)
@given(
    fraction=st.floats(0.4, 0.7),
    direction=st.sampled_from(["y", "-y", "z", "-z"]),
    values=st.lists(st.floats(-4.9, 4.9), min_size=2, max_size=2),
    offsets=st.none() | st.lists(st.floats(-5, 5), min_size=3, max_size=3),
)
def test_any_session_is_the_same_after_a_round_trip(
    tmp_path_factory, fraction, direction, values, offsets
):
    head = HEAD if offsets is None else f"{HEAD}controller: {{offsets_mm: {offsets}}}\n"
    rows = f"setup,posture,minus,reading_mm\nyx,zero,,{values[0]}\nyx,x_max,,{values[1]}\n"
    folder = tmp_path_factory.mktemp("round")
    setup = f"{{leg: x, direction: {direction}, section: {{fraction: {fraction}}}}}"
    session = load_session(write(folder / "a", setup, head, rows))
    again = load_session(write_session(session, folder / "b", decimals=12))
    assert np.abs(again.values - session.values).max() < 1e-14
    assert again.setups["yx"].sensor.direction == direction
    assert abs(again.setups["yx"].sensor.section.value - fraction) < 1e-11
    assert np.abs(again.active_offsets - session.active_offsets).max() < 1e-14


def test_a_robot_without_legs_cannot_be_measured(root, tmp_path):
    head = HEAD.replace("orthoglide", str(root / "tests/robots/fivebar"))
    with pytest.raises(SessionError, match="'fivebar' has no legs for a gauge to touch"):
        load_session(write(tmp_path / "s", head=head))


def test_a_session_written_elsewhere_has_its_robot(root, tmp_path):
    head = HEAD.replace("orthoglide", str(root / "robots/orthoglide"))
    session = load_session(write(tmp_path / "s", head=head))
    again = load_session(write_session(session, tmp_path / "deep/er/copy"))
    assert again.robot.sha256 == session.robot.sha256


@pytest.mark.parametrize(
    ("name", "joined", "parts"),
    [
        ("monday/yx", True, ("monday", "yx")),
        ("monday", True, ("monday", "")),  # an unnamed gauge
        ("monday/a/b", True, ("monday", "a/b")),
        ("a/b", False, ("", "a/b")),
    ],
)
def test_names_of_joined_sessions_have_a_label(name, joined, parts):
    assert split_label(name, joined=joined) == parts


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Section("frac", 0.5), "expected one of coordinate_mm, from_root_mm, fraction"),
        (lambda: Tip("bal", 2e-3), "expected 'ball' or 'blade'"),
        (lambda: Gauge(sigma=0.0), "sigma: found 0.0; expected a positive number"),
        (lambda: Gauge(sigma=-1e-5), "sigma: found -1e-05"),
        (lambda: Gauge(resolution=np.inf), "resolution: found inf; expected a positive number"),
        (lambda: Gauge(resolution=float("nan")), "resolution: found nan"),
    ],
)
def test_impossible_parts_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_unknown_arguments_are_refused(raw_cycles):
    problem = build_problem(raw_cycles, model="offsets")
    with pytest.raises(ParameterError, match="expected 'prior_std' or 'SI'"):
        problem.predict_and_jacobian(problem.active_theta, units="mm")
    with pytest.raises(ParameterError, match=f"has 2 numbers; expected {problem.n_free}"):
        problem.predict_and_jacobian(np.zeros(2))
    with pytest.raises(ParameterError, match="criterion: found 'zzz'; expected one of aligned"):
        plan_readings(raw_cycles.robot, criterion="zzz")


def test_semicolons_and_a_byte_order_mark_are_read(tmp_path):
    rows = "\ufeffsetup;posture;reading_mm\nyx;zero;0.1\n\nyx;x_max;0.2\n"
    session = load_session(write(tmp_path / "s", rows=rows))
    assert np.allclose(session.values, [0.1e-3, 0.2e-3])


def test_a_plan_is_not_calibrated(root):
    plan = load_plan(root / "examples/raw-cycles/plan.yaml")
    assert np.isnan(plan.values).all()
    with pytest.raises(SessionError, match="54 of 54 readings have no value"):
        calibrate(plan, "offsets")
