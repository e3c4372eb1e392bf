"""Gauges that stand crooked: by touching solids, shared blocks and dials, refused by key."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from calibrated import SOUND
from workshop import Crooked, Workshop

from orthocal import (
    calibrate,
    load_calibration,
    load_plan,
    load_session,
    simulate_session,
    write_calibration,
    write_session,
)
from orthocal.errors import SessionError
from orthocal.kinematics.error_map import error_map
from orthocal.measurement.joining import join_sessions
from orthocal.observation.model import ObservationModel, predict_readings
from orthocal.observation.observations import build_observations
from orthocal.observation.sensor_groups import nuisance_parameters

TIPS = {
    "ball": "{ball: {radius_mm: 1.5}}",
    "blade": "{blade: {width_mm: 40}}",
    "pin": "{blade: {width_mm: 40, radius_mm: 0.8}}",
}
PLAN = """robot: orthoglide
gauge: {{sigma_mm: 0.005, range_mm: [-20, 20], tip: {tip}}}
postures:
  zero: {{tcp_mm: [0, 0, 0]}}
  x_max: {{tcp_mm: [60, 3, -4]}}
  x_min: {{tcp_mm: [-100, -3, 4]}}
  z_max: {{tcp_mm: [2, -4, 60]}}
setups:
  yx: {{leg: x, touches: a, direction: y, section: {{fraction: 0.5}},
    postures: [zero, x_max, x_min]{yx}}}
  zx: {{leg: x, touches: b, direction: -z, section: {{fraction: 0.4}},
    postures: [zero, x_max, x_min]{zx}}}
  yz: {{leg: z, touches: a, direction: -y, section: {{fraction: 0.6}},
    postures: [zero, z_max]{yz}}}
"""
ERRORS = {"x_slide.offset": 0.8e-3, "y_slide.offset": -0.5e-3, "x_swivel.rx": 2e-3}
BLOCK = ", stand: block"


def plan(folder, tip="ball", *, yx="", zx="", yz=""):
    folder.mkdir(exist_ok=True)
    (folder / "plan.yaml").write_text(PLAN.format(tip=TIPS[tip], yx=yx, zx=zx, yz=yz))
    return load_plan(folder / "plan.yaml")


def names(session):
    return [p.name for p in nuisance_parameters(session).parameters]


@pytest.mark.parametrize(
    ("tip", "oblique"), [("ball", False), ("ball", True), ("blade", True), ("pin", True)]
)
def test_crooked_readings_are_those_of_solids_that_touch(tmp_path, tip, oblique):
    """Many times over, three times the tolerances: the plunger moves until solids touch.

    Square to the leg where the rod lies in the zero posture; and oblique, beside it.
    """
    session = plan(tmp_path, tip)
    if oblique:  # by 4 degrees along the leg, and between the axes across it
        path = tmp_path / "plan.yaml"
        for name, vector in (
            ("y", "[0.07, 0.8, 0.6], beside_mm: [0, 1.2, -1.6]"),
            ("-z", "[-0.1, 0.5, -2], beside_mm: [0, -1, -0.25]"),
        ):
            path.write_text(
                path.read_text().replace(f"direction: {name},", f"direction: {vector},")
            )
        session = load_plan(path)
    o, workshop = build_observations(session), Workshop(session, ERRORS)
    beside = ObservationModel(session).alignment(error_map(session.robot).expand(ERRORS))
    rng, known = np.random.default_rng(0), nuisance_parameters(session)
    setups, missed = list(session.setups), 0
    for _ in range(20):
        values = 3.0 * rng.normal(size=len(known.parameters))
        values *= [p.prior_std for p in known.parameters]
        found = predict_readings(session, ERRORS, observations=o, nuisance=values)
        said = dict(zip(names(session), (values + beside).tolist(), strict=True))
        for i, r in enumerate(session.readings):
            own = {f.name: said.get(f"setup.{r.setup}.{f.name}", 0.0) for f in fields(Crooked)}
            stood = replace(Crooked(**own), scale=said["gauge.scale"])
            assert o.setup[i] == setups.index(r.setup)
            touched = workshop.read(r.setup, r.posture, stood)
            assert found[i] == pytest.approx(touched, abs=1e-9, nan_ok=True)
            missed += np.isnan(touched)
    assert missed < 5  # a ball far beside its place passes the rod


def test_a_line_is_read_as_by_an_edge_without_a_radius(tmp_path, root):
    """Turned and moved, an edge in the plane of plunger and edge; square, the paper's section."""
    session = load_plan(root / "tests/sessions/lines/plan.yaml")
    o, rng = build_observations(session), np.random.default_rng(1)
    known = nuisance_parameters(session)
    values = rng.normal(size=len(known.parameters)) * [p.prior_std for p in known.parameters]
    said = dict(zip(names(session), values.tolist(), strict=True))
    found = predict_readings(session, ERRORS, observations=o, nuisance=values)
    workshop = Workshop(session, ERRORS)
    postures, setups = list(session.postures), session.setups
    for i in range(0, o.size, 7):
        setup = list(setups.values())[o.setup[i]]
        leg = session.robot.legs[setup.sensor.leg]
        frames = workshop.frames[postures[o.posture[i]]]
        root_, tip = frames[leg.root], frames[leg.tip]
        d, a = np.eye(3)["xyz".index(setup.sensor.direction)], leg.axis
        s = np.cross(a, d)
        own = {k: said[f"setup.{setup.name}.{k}"] for k in ("roll", "pitch", "section")}
        plunger = np.cos(own["pitch"]) * d + np.sin(own["pitch"]) * a
        turn = lambda v, r=own["roll"], a=a: (  # noqa: E731
            (a @ v) * a + np.cos(r) * (v - (a @ v) * a) + np.sin(r) * np.cross(a, v)
        )
        c = (a @ workshop.at_zero[leg.root] + 0.5 * leg.length + own["section"]) * a
        # c + h plunger + w edge = root + t (tip − root)
        sides = np.column_stack([turn(plunger), turn(s), root_ - tip])
        h = np.linalg.solve(sides, root_ - c)[0] * (1.0 + said["gauge.scale"])
        assert found[i] == pytest.approx(h, abs=1e-12)


def test_one_dial_has_one_scale_and_a_block_one_roll(tmp_path):
    alone = names(plan(tmp_path / "alone"))
    assert alone.count("gauge.scale") == 1
    assert {f"setup.{s}.{k}" for s in ("yx", "zx", "yz") for k in ("roll", "lateral")} <= {*alone}
    shared = names(plan(tmp_path / "shared", yx=BLOCK, zx=BLOCK))
    assert "stand.block.roll" in shared
    assert "setup.yx.roll" not in shared
    assert {"setup.yx.square", "setup.zx.square", "setup.yz.roll"} <= {*shared}


def test_two_sessions_share_the_dial_and_not_the_mountings(tmp_path):
    days = [plan(tmp_path / day, yx=BLOCK, zx=BLOCK) for day in ("monday", "tuesday")]
    found = names(join_sessions(days))
    assert found.count("gauge.scale") == 1
    assert {"monday/stand.block.roll", "tuesday/stand.block.roll"} <= {*found}
    assert {"setup.monday/yx.pitch", "setup.tuesday/yx.pitch"} <= {*found}


def test_exact_mountings_have_no_nuisance_parameters(tmp_path):
    exact = ", direction_tolerance_mrad: 0, section_tolerance_mm: 0, lateral_tolerance_mm: 0"
    session = plan(tmp_path, yx=exact, zx=exact, yz=exact)
    assert names(session) == ["gauge.scale"]
    text = (tmp_path / "plan.yaml").read_text().replace("tip:", "scale_tolerance: 0, tip:")
    (tmp_path / "plan.yaml").write_text(text)
    assert names(load_plan(tmp_path / "plan.yaml")) == []


def test_files_keep_the_mounting(tmp_path):
    own = ", stand: block, square_tolerance_mrad: 0.1, direction_tolerance_mrad: 8"
    made = plan(tmp_path / "plan", yx=own, zx=own, yz=", lateral_tolerance_mm: 0.4")
    truth = {n: v for n, v in ERRORS.items() if n.endswith("offset")}
    session = simulate_session(made, truth, seed=1).session
    again = load_session(write_session(session, tmp_path / "session"))
    assert [s.sensor for s in again.setups.values()] == [s.sensor for s in made.setups.values()]
    found = calibrate(again, solver="variable-projection", judgement=SOUND)
    loaded = load_calibration(write_calibration(found, tmp_path / "calibration.json"))
    assert [s.sensor for s in loaded.setups] == [s.sensor for s in made.setups.values()]
    assert [p.name for p in loaded.sensors] == names(made)
    assert {p.prior_std for p in loaded.sensors if p.name.endswith("square")} == {0.05e-3}


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"yx": ", square_tolerance_mrad: 0.2"}, "setups.yx.square_tolerance_mrad: found without"),
        ({"yx": BLOCK, "yz": BLOCK}, "setups.yz: shares the roll of 'stand.block' with 'yx'"),
        (
            {"yx": BLOCK, "zx": f"{BLOCK}, direction_tolerance_mrad: 10"},
            "setups.zx: shares the roll of 'stand.block' with 'yx', which states a tolerance of "
            "20 mrad",
        ),
        ({"zx": ", direction_tolerance_mrad: 900"}, "setups.zx.direction_tolerance_mrad"),
        ({"zx": ", section_tolerance_mm: -1"}, "setups.zx.section_tolerance_mm"),
        ({"zx": ", scale_tolerance: 2"}, "setups.zx.scale_tolerance"),
    ],
)
def test_a_wrong_key_is_named(tmp_path, keys, message):
    with pytest.raises(SessionError) as caught:
        plan(tmp_path, **keys)
    assert message in str(caught.value)
