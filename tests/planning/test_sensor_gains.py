"""Gains of an hour with each usual sensor, against plans with these sensors."""

from __future__ import annotations

import pytest
from conftest import marked_plots

from orthocal import calibrate, load_robot, plan_readings, simulate_session, summarize
from orthocal.output.report.page import build_report
from orthocal.output.text import accuracy
from orthocal.planning import plan as planning
from orthocal.planning.equipment import Equipment
from orthocal.planning.owned_sensors import load_owned_sensor
from orthocal.planning.sensor_gains import find_sensor_gains

BAR = """sensor: ball_bar
sigma_mm: 0.002
resolution_mm: 0.001
length_mm: 50
length_tolerance_mm: unknown
"""
PLATE = """sensor: tool_indicator
sigma_mm: 0.005
resolution_mm: 0.01
artefact: {kind: plate, flat_tolerance_mm: 0.003}
"""
QUICK = {"along": 5, "across": 0.0, "sections": (0.5,)}


@pytest.fixture(scope="module")
def legs():
    robot = load_robot("orthoglide").with_tolerances({"*.offset_mm": 1.0})
    return plan_readings(robot, equipment=Equipment(**QUICK), starts=1)


@pytest.fixture(scope="module")
def gains(legs):
    return legs.find_sensor_gains()


def gain_of(gains, noun):
    (gain,) = (g for g in gains if noun in g.words)
    return gain


@pytest.mark.parametrize(("noun", "text"), [("ball bar", BAR), ("plate", PLATE)])
def test_a_gain_is_nearly_that_of_a_plan_with_the_sensor(tmp_path, legs, gains, noun, text):
    """By session, forecast of drawn machines and exchanges: a little better, at most."""
    gain = gain_of(gains, noun)
    (tmp_path / "own.yaml").write_text(text)
    equipment = Equipment(owned=(load_owned_sensor(tmp_path / "own.yaml"),), **QUICK)
    plan = plan_readings(
        legs.session.robot, hours=1.0, equipment=equipment, measured=legs.session, starts=1
    )
    assert gain.minutes <= 60.0
    assert 0.75 * gain.rms < plan.expected.reported.rms < 1.05 * gain.rms
    assert gain.rms < 0.7 * legs.expected.reported.rms


def test_sensors_are_ranked(legs, gains):
    assert [g.rms for g in gains] == sorted(g.rms for g in gains)
    bar, square, legs_again = (gain_of(gains, n) for n in ("ball bar", "square", "at the legs"))
    assert bar.rms < square.rms < legs_again.rms < legs.expected.reported.rms


def test_where_leg_readings_determine_nothing_the_answer_names_the_sensor(monkeypatch):
    """Parallel slides: moving all drives moves the tool, and turns no leg."""
    robot = load_robot("linear_delta").with_tolerances({"*.offset_mm": 0.5})
    plan = plan_readings(robot, equipment=Equipment(**QUICK), starts=1)
    shown = []

    def record(*words):
        shown.append(find_sensor_gains(*words))
        return shown[-1]

    monkeypatch.setattr(planning, "find_sensor_gains", record)
    answer = summarize(plan)
    ((best, *_),) = shown
    assert "ball bar" in best.words
    assert best.rms < 0.1 * plan.expected.reported.rms
    calibration = calibrate(simulate_session(plan.session, {"a_slide.offset": 3e-4}).session)
    for text in (answer, summarize(calibration)):
        words = " ".join(text.split())
        sentence = next(s for s in words.split(". ") if "do not determine the offset of" in s)
        assert all(name in sentence for name in ("a_slide", "b_slide", "c_slide"))
        assert f"Another hour with {best.words} would reduce the error to 0.017 mm" in words
    monkeypatch.setattr(accuracy, "find_sensor_gains", record)
    details = " ".join(summarize(calibration, details=True).split())
    assert len(shown) == 2  # one search for the remedy and for the gains of all sensors
    assert "would reduce the error to 0.017 mm" in details
    assert "0.017 mm with a ball bar" in details


def test_the_report_of_a_calibration_names_the_same_sensors(legs):
    readings = simulate_session(legs.session, {"x_slide.offset": 0.2e-3}, seed=1).session
    calibration = calibrate(readings)
    with marked_plots():
        page = " ".join(build_report(calibration).split())
    assert "Another hour, with all errors corrected: " in page
    assert "with a ball bar of 50 mm" in page
    assert "do not determine" not in summarize(calibration)
    offsets = calibrate(readings, "offsets")
    assert "Another hour" not in summarize(offsets, details=True)


def test_a_machine_that_moves_in_a_plane_compares_a_dial_and_a_bar(biglide):
    plan = plan_readings(biglide, equipment=Equipment(**QUICK), starts=1)
    assert {g.words for g in plan.find_sensor_gains()} == {
        "a dial at the legs",
        "a ball bar of 50 mm",
    }
