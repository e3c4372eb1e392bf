"""Plans with sensors at the tool: places, ranges, and tool errors against plans by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from orthocal import load_robot, plan_readings
from orthocal.effects.loading import with_effects
from orthocal.errors import SessionError
from orthocal.estimation.choice import resolve_choice
from orthocal.measurement.motion.motion import plan_motion
from orthocal.planning.equipment import Equipment
from orthocal.planning.expected_error import ToolForecast
from orthocal.planning.owned_sensors import load_owned_sensor
from orthocal.planning.tool_candidates import list_tool_candidates

BAR = """sensor: ball_bar
sigma_mm: 0.002
range_mm: [-25, 25]
length_mm: 50
length_tolerance_mm: unknown
"""
SQUARE = """sensor: tool_indicator
sigma_mm: 0.005
resolution_mm: 0.01
range_mm: [-5, 5]
artefact: {kind: square, straight_tolerance_mm: 0.002, square_tolerance_mrad: 0.02, length_mm: 150}
"""
PLATE = SQUARE.replace("square, straight_tolerance_mm: 0.002, square_tolerance_mrad: 0.02",
                       "plate, flat_tolerance_mm: 0.003")  # fmt: skip
BLOCK = SQUARE.replace(
    "square, straight_tolerance_mm: 0.002, square_tolerance_mrad: 0.02, length_mm: 150",
    "gauge_block, height_mm: 50, height_tolerance_mm: 0.0005",
)
QUICK = {"along": 5, "across": 0.0, "sections": (0.5,)}


@pytest.fixture
def owned(tmp_path):
    def load(**texts):
        found = []
        for name, text in texts.items():
            (tmp_path / f"{name}.yaml").write_text(text)
            found.append(load_owned_sensor(tmp_path / f"{name}.yaml"))
        return tuple(found)

    return load


def test_places_of_every_sensor_are_reached_and_touch_what_they_are_for(owned, orthoglide):
    sensors = owned(bar=BAR, square=SQUARE, plate=PLATE, block=BLOCK)
    gauges, postures, setups, readings = list_tool_candidates(orthoglide, sensors, None)
    assert set(gauges) == {"bar", "square", "plate", "block"}
    assert {s.gauge for s in setups.values()} == set(gauges)
    for name, setup in setups.items():
        points = np.array([postures[r.posture].values for r in readings if r.setup == name])
        if setup.gauge == "bar":
            distances = np.linalg.norm(points - np.array(setup.sensor.centre), axis=1)
            np.testing.assert_allclose(distances, 0.05, atol=1e-8)
        elif setup.gauge == "block":
            axis = "xyz".index(setup.sensor.direction[-1])
            assert np.ptp(points[:, axis]) == pytest.approx(0.05)
        else:
            axis = "xyz".index(setup.sensor.direction[-1])
            assert np.ptp(points[:, axis]) == pytest.approx(0.0, abs=1e-12)


def test_two_hours_with_a_dial_and_a_bar_beat_plans_by_hand(owned):
    """By hand: the paper's 18 readings, and three circles of 16: 127 minutes, 5.5 µm."""
    robot = load_robot("orthoglide").with_tolerances({"*.offset_mm": 1.0})
    equipment = Equipment(owned=owned(bar=BAR), **QUICK)
    plan = plan_readings(robot, hours=2.0, equipment=equipment, starts=1)
    assert plan.minutes <= 120.0 + 1e-9
    used = {s.gauge for s in plan.session.setups.values()}
    assert used == {"dial", "bar"}
    assert plan.expected.reported.rms < 5.5e-6
    alone = plan_readings(robot, hours=2.0, equipment=Equipment(**QUICK), starts=1)
    assert plan.expected.reported.rms < 0.5 * alone.expected.reported.rms


def test_the_search_agrees_with_the_forecast_of_its_plan(owned):
    """Two gauges, shared ball and length, known zeros: one number by two ways of linear algebra."""
    robot = load_robot("orthoglide").with_tolerances({"*.offset_mm": 1.0})
    equipment = Equipment(owned=owned(bar=BAR, square=SQUARE), **QUICK)
    plan = plan_readings(robot, hours=1.5, equipment=equipment, starts=1)
    open_setups = [r for r in plan.session.readings if r.cycle == 1]
    session = replace(plan.session, readings=tuple(open_setups))
    choice = resolve_choice(None, None, default_model="full")
    forecast = ToolForecast(robot, choice.select(robot.parameters))
    nominal = forecast.about_nominal(session)
    # the stage's error is scaled from the nominal machine to those within tolerances
    assert plan.stage.error == pytest.approx(plan.expected.reported.rms, rel=0.05)
    assert nominal.reported.rms == pytest.approx(plan.expected.reported.rms, rel=0.25)


def test_approaches_of_a_bar_follow_from_its_path(owned):
    robot = with_effects(load_robot("orthoglide"), ("backlash",))
    robot = robot.with_tolerances({"*.offset_mm": 1.0})
    equipment = Equipment(owned=owned(bar=BAR), **QUICK)
    plan = plan_readings(robot, hours=1.5, equipment=equipment, starts=1)
    bars = [r for r in plan.session.readings if plan.session.setups[r.setup].gauge == "bar"]
    assert bars
    assert all(r.approach and len(r.approach) == 3 for r in bars)
    plan_motion(plan.session)  # the stated approaches are those of the path


@pytest.mark.parametrize(
    ("text", "place"),
    [
        (BAR.replace("ball_bar", "leg"), ""),
        (BAR.replace("sigma_mm: 0.002\n", ""), "sigma_mm"),
        (BAR + "centre_mm: [0, 0, 0]\n", "centre_mm"),
    ],
)
def test_a_wrong_file_is_refused_by_its_key(owned, text, place):
    with pytest.raises(SessionError) as caught:
        owned(bar=text)
    assert str(caught.value.where).endswith(place or "bar.yaml")
