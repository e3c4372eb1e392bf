"""An indicator on a rod, against where Pinocchio has the rod and plain geometry has the tip."""

from __future__ import annotations

import machines
import numpy as np
import pytest

from orthocal import (
    LegIndicator,
    Section,
    Tip,
    draw_scene,
    load_plan,
    load_robot,
)
from orthocal.errors import SessionError
from orthocal.kinematics.error_map import error_map
from orthocal.observation.model import ObservationModel, predict_readings
from orthocal.observation.observations import build_observations
from orthocal.observation.sensor_groups import nuisance_parameters
from orthocal.sensors.mounting import Mounting
from orthocal.sensors.registry import read_setup, write_sensor
from orthocal.sensors.tips import touch_by_ball

PLAN = """robot: orthoglide
gauge: {{sigma_mm: 0.005, resolution_mm: 0.001, range_mm: [-20, 20]}}
postures:
  zero: {{tcp_mm: [0, 0, 0]}}
  x_max: {{tcp_mm: [60, 0, 0]}}
  x_min: {{tcp_mm: [-100, 0, 0]}}
  y_max: {{tcp_mm: [0, 60, 0]}}
  y_min: {{tcp_mm: [0, -100, 0]}}
  z_max: {{tcp_mm: [0, 0, 60]}}
  z_min: {{tcp_mm: [0, 0, -100]}}
setups:
{setups}
"""
AXES = "xyz"
TIPS = {
    "ball": "{ball: {radius_mm: 1.5}}",
    "blade": "{blade: {width_mm: 20}}",
    "pin": "{blade: {width_mm: 20, radius_mm: 0.8}}",
}
TRUTH = {"x_slide.offset": 0.9e-3, "y_slide.offset": -0.6e-3, "z_slide.offset": 0.4e-3}


def plan(folder, tip, rod="a"):
    setups = "\n".join(
        f"  {d}{leg}: {{leg: {leg}, touches: {rod}, tip: {TIPS[tip]}, direction: {d}, "
        f"section: {{fraction: 0.5}}, postures: [zero, {leg}_max, {leg}_min]}}"
        for leg in AXES
        for d in AXES
        if d != leg
    )
    (folder / "plan.yaml").write_text(PLAN.format(setups=setups))
    return load_plan(folder / "plan.yaml")


def set_beside(session, o, errors):
    """How far each entry's ball is beside the drawing, over the rod that is there, [m]."""
    known = nuisance_parameters(session)
    found = dict(
        zip(
            [p.name for p in known.parameters],
            ObservationModel(session).alignment(error_map(session.robot).expand(errors)),
            strict=True,
        )
    )
    setups = list(session.setups)
    return [found.get(f"setup.{setups[k]}.lateral", 0.0) for k in o.setup]


@pytest.mark.parametrize(("tip", "rod"), [("ball", "a"), ("blade", "b"), ("pin", "b")])
def test_readings_are_those_of_solids_that_touch(tmp_path, tip, rod):
    """The rod's axis by Pinocchio, the tip by the distance from it: exactly the radii."""
    session = plan(tmp_path, tip, rod)
    o = build_observations(session)
    found = predict_readings(session, TRUTH, observations=o)
    robot = session.robot
    beside = set_beside(session, o, TRUTH)
    real = robot.with_errors(TRUTH)
    drives = np.array([p.drives for p in session.postures.values()])
    for i in range(o.size):
        setup = list(session.setups.values())[o.setup[i]]
        leg = robot.legs[setup.sensor.leg]
        root, end = (
            machines.place(real, drives[o.posture[i]], f)
            for f in (leg.rods[rod].root, leg.rods[rod].tip)
        )
        d = np.eye(3)[AXES.index(setup.sensor.direction)]
        side = np.cross(leg.axis, d)
        zero = 0.5 * (leg.rods[rod].reference_root + leg.rods[rod].reference_tip)
        offset = TRUTH[f"{leg.name}_slide.offset"] * -leg.axis
        c = zero + (offset @ leg.axis) * leg.axis + beside[i] * side
        centre, unit = c + found[i] * d, (end - root) / np.linalg.norm(end - root)
        if tip == "ball":
            apart = centre - root - ((centre - root) @ unit) * unit
            assert np.linalg.norm(apart) == pytest.approx(7e-3, abs=1e-12)
        else:
            normal = np.cross(side, unit)
            apart = (centre - root) @ normal / np.linalg.norm(normal)
            radius = 5.5e-3 + (0.8e-3 if tip == "pin" else 0.0)
            assert abs(apart) == pytest.approx(radius, abs=1e-12)
        assert (centre - root) @ d > 0  # on the rod's side from which the plunger comes


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("touches: a", "touches: c", "touches: 'c' is not a rod of leg x; rods: a, b"),
        ("tip: {ball: {radius_mm: 1.5}}, ", "", "tip: is missing; expected ball or blade"),
        (
            "{radius_mm: 1.5}",
            "{radius_mm: 150}",
            "tip.ball.radius_mm: found '150'; expected less than or equal to 100",
        ),
        ("{ball: {radius_mm: 1.5}}", "{}", "tip: found none; expected one of ball, blade"),
        (
            "direction: y",
            "direction: [0, 1]",
            "setups.yx.direction: found [0, 1]; expected one of x, y, z, -x, -y, -z, or a vector",
        ),
        ("direction: y", "direction: [0, 0, 0]", "found [0, 0, 0], which has no direction"),
        (
            "direction: y",
            "direction: [0, .inf, 0]",
            "setups.yx.direction: found [0, inf, 0]; expected one",
        ),
        (
            "direction: y",
            "direction: [1, 1, 0]",
            "direction: '(1, 1, 0)' is at 45.0° to leg x in the mechanical zero; expected a "
            "direction square to the leg, to within 30°; square to it: y, z, -y, -z",
        ),
        (
            "direction: y",
            "direction: y, beside_mm: [0, 1, 10]",
            "setups.yx.beside_mm: found [0, 1, 10]; expected a multiple of (0, 0, -1), across",
        ),
        (
            "touches: a, tip: {ball: {radius_mm: 1.5}}",
            "beside_mm: [0, 0, 1]",
            "setups.yx.beside_mm: found without `touches`, a rod; expected",
        ),
        ("direction: y", "direction: up", "found 'up'; expected one of x, y, z, -x, -y, -z, or"),
    ],
)
def test_what_does_not_fit_is_refused_by_key(tmp_path, old, new, message):
    plan(tmp_path, "ball")
    path = tmp_path / "plan.yaml"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(SessionError, match=r"expected|rods") as refused:
        load_plan(path)
    assert message in str(refused.value)


@pytest.mark.parametrize(("tip", "lean", "good"), [("ball", 0.5, True), ("blade", 0.5, False)])
def test_a_ball_may_lean_further_than_a_blade(tmp_path, tip, lean, good):
    plan(tmp_path, tip)
    path = tmp_path / "plan.yaml"
    path.write_text(path.read_text().replace("direction: y", f"direction: [{lean}, 1, 0]"))
    if good:
        vector = load_plan(path).setups["yx"].sensor.constants(load_robot("orthoglide"))[:3]
        assert vector == pytest.approx(np.array([lean, 1.0, 0.0]) / np.hypot(lean, 1.0))
    else:
        with pytest.raises(SessionError, match=r"is at 63.4° to leg x.* to within 10°"):
            load_plan(path)


def test_a_gauges_tip_is_that_of_its_setups(tmp_path):
    """One that names none of its own has it; beside a line between the rods it says nothing."""
    plan(tmp_path, "ball")
    path = tmp_path / "plan.yaml"
    text = path.read_text().replace("tip: {ball: {radius_mm: 1.5}}, ", "")
    text = text.replace("gauge: {", "gauge: {tip: {blade: {width_mm: 12}}, ", 1)
    path.write_text(text.replace("touches: a, ", "", 1))
    setups = load_plan(path).setups
    line, *rods = (s.sensor.to_keys() for s in setups.values())
    assert "tip" not in line
    assert all(keys["tip"] == {"blade": {"width_mm": 12.0}} for keys in rods)


def test_descriptions_state_lengths_to_a_micrometre_and_directions_to_three_digits():
    section = Section("coordinate_mm", -0.1031234567)
    line = LegIndicator("x", (0.0, np.sqrt(0.75), 0.5), section)
    assert line.describe() == "leg x, gauge in (0, 0.866, 0.5), at coordinate -103.123 mm"
    for direction, name in (((0.0, -2.0, 0.0), "-y"), ((0.6, 0.8, -0.0), "(0.6, 0.8, 0)")):
        assert f"gauge in {name}, at" in LegIndicator("x", direction, section).describe()
    blade = line.on_rod("b", Tip("blade", 0.0, 0.02))
    assert blade.describe().endswith(", blade on rod b")
    ball = line.on_rod("a", Tip("ball", 0.0015), (0.0, -0.0001234567, 2e-7))
    assert ball.describe().endswith(", off its centre line by 0.123 mm towards −y")


def test_a_written_mounting_is_read():
    """The squareness of a block has no key without a block."""
    mounting = Mounting(square=0.0)
    sensor = LegIndicator("x", "y", Section("fraction", 0.5), mounting)
    keys, read = read_setup(write_sensor(sensor), where="", under="", error=SessionError)
    assert keys.square_tolerance_mrad is None
    assert read.nuisance_parameters == sensor.nuisance_parameters


def test_a_ball_that_passes_the_rod_is_named_before_measuring(tmp_path):
    """20 mm beside the axis the rod has moved away: displaced lines, by a ball."""
    path = tmp_path / "plan.yaml"
    plan(tmp_path, "ball")
    path.write_text(
        path.read_text().replace("x_max: {tcp_mm: [60, 0, 0]}", "x_max: {tcp_mm: [60, 40, 40]}")
    )
    with pytest.raises(SessionError, match="the ball would pass the rod"):
        load_plan(path)


def test_the_dial_that_is_drawn_touches_the_rods_surface(tmp_path):
    """By Pinocchio's placement of the rod: a radius from its axis, on the plunger's side."""
    session = plan(tmp_path, "ball")
    robot = session.robot
    scene = draw_scene(session, posture="x_max")
    drives = session.postures["x_max"].drives
    root, end = (
        machines.place(robot, drives, f)
        for f in (robot.legs["x"].rods["a"].root, robot.legs["x"].rods["a"].tip)
    )
    unit = (end - root) / np.linalg.norm(end - root)
    for name, d in (("yx", np.eye(3)[1]), ("zx", np.eye(3)[2])):
        at = scene.pose(f"Gauges/{name}")[:3, 3]
        away = at - root - ((at - root) @ unit) * unit
        assert np.linalg.norm(away) == pytest.approx(5.5e-3, abs=1e-9)
        assert away @ d > 5e-3


def test_a_ball_is_not_read_as_a_blade():
    line, ball = LegIndicator("x", "y", Section("fraction", 0.5)), Tip("ball", 2e-3)
    with pytest.raises(ValueError, match="on_rod"):
        LegIndicator("x", "y", Section("fraction", 0.5), rod="a", tip=ball)
    assert type(line.on_rod("a", ball)).touch is touch_by_ball
