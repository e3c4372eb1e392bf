"""Gains of an hour with each usual sensor, compared with plans that have the sensor."""

from __future__ import annotations

import re
from functools import cache
from unittest.mock import patch

import pytest
from calibrated import UNJUDGED
from conftest import marked_plots
from planned import QUICK, quick_plan
from uncompared import few_balls, uncompared

from orthocal import calibrate, plan_readings, simulate_session, summarize
from orthocal.output.report import page
from orthocal.planning import plan as planning
from orthocal.planning import sensor_gains, tool_candidates
from orthocal.planning.equipment import Equipment
from orthocal.planning.owned_sensors import load_owned_sensor
from orthocal.planning.sensor_gains import find_sensor_gains

BAR = """sensor: ball_bar
sigma_mm: 0.002
resolution_mm: 0.001
length_mm: 50
length_tolerance_mm: unknown
"""


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Two positions of a fixed ball, few points on a bed, and plans alone."""
    with few_balls(2), uncompared(), patch.object(tool_candidates, "BED_POINTS", 5):
        yield


@cache
def gains_of(robot):
    return quick_plan(robot).find_sensor_gains()


def gain_of(gains, noun):
    (gain,) = (g for g in gains if noun in g.words)
    return gain


def test_a_gain_is_nearly_that_of_a_plan_with_the_sensor(tmp_path):
    """Exchanges of setups and readings make the plan a little better."""
    legs, gain = quick_plan("biglide"), gain_of(gains_of("biglide"), "ball bar")
    (tmp_path / "bar.yaml").write_text(BAR)
    equipment = Equipment(owned=(load_owned_sensor(tmp_path / "bar.yaml"),), **QUICK)
    plan = plan_readings(
        legs.session.robot, hours=1.0, equipment=equipment, measured=legs.session, starts=1
    )
    assert gain.minutes <= 60.0
    assert 0.75 * gain.rms < plan.expected.reported.rms < 1.05 * gain.rms
    assert gain.rms < 0.7 * legs.expected.reported.rms


def test_sensors_are_ranked():
    gains = gains_of("orthoglide")
    assert [g.rms for g in gains] == sorted(g.rms for g in gains)
    bar, square, legs_again = (gain_of(gains, n) for n in ("ball bar", "square", "at the legs"))
    before = quick_plan().expected.reported.rms
    assert bar.rms < square.rms < legs_again.rms < before


def test_offsets_that_leg_readings_do_not_determine_are_named_with_the_best_sensor(monkeypatch):
    """A motion of all parallel slides together moves the tool and rotates no leg."""
    plan, searches = quick_plan("linear_delta"), []
    number = r"would reduce the error to ([\d.]+) mm"

    def find_once(*arguments):
        searches.append(searches[0] if searches else find_sensor_gains(*arguments))
        return searches[0]

    for module in (planning, sensor_gains):
        monkeypatch.setattr(module, "find_sensor_gains", find_once)
    answer = summarize(plan)
    ((best, *_),) = searches
    assert "ball bar" in best.words
    assert best.rms < 0.1 * plan.expected.reported.rms
    simulated = simulate_session(plan.session, {"a_slide.offset": 3e-4}).session
    calibration = calibrate(simulated, **UNJUDGED)
    for text in (answer, summarize(calibration)):
        words = " ".join(text.split())
        sentence = next(s for s in words.split(". ") if "do not determine the offsets of" in s)
        assert all(name in sentence for name in ("a_slide", "b_slide", "c_slide"))
        found = re.search(f"Another hour with {best.words} {number}", words)
        assert float(found[1]) == pytest.approx(1e3 * best.rms, rel=0.02)
    before = len(searches)
    details = " ".join(summarize(calibration, details=True).split())
    assert len(searches) == before + 1  # for the remedy and for the gains of all sensors
    assert f"{re.search(number, details)[1]} mm with a ball bar" in details


def test_the_report_of_a_calibration_names_the_same_sensors(monkeypatch):
    monkeypatch.setattr(page, "_scene", lambda _: "<!-- scene -->")
    gains, forecasts = gains_of("orthoglide"), []
    monkeypatch.setattr(
        sensor_gains, "find_sensor_gains", lambda *of: (forecasts.append(of[0]), gains)[1]
    )
    session = quick_plan().session
    readings = simulate_session(session, {"x_slide.offset": 0.2e-3}, seed=1).session
    calibration = calibrate(readings, **UNJUDGED)
    with marked_plots():
        text = " ".join(page.build_report(calibration).split())
    assert "Another hour, with all errors corrected: " in text
    assert "with a ball bar of 50 mm" in text
    assert len(forecasts) == 1
    assert "do not determine" not in summarize(calibration)
    offsets = calibrate(readings, "offsets", **UNJUDGED)
    assert "Another hour" not in summarize(offsets, details=True)


def test_a_dial_and_a_bar_are_compared_for_a_machine_that_moves_in_a_plane():
    words = {g.words for g in gains_of("biglide")}
    assert words == {"a dial at the legs", "a ball bar of 50 mm"}
