"""Mistakes in readings of sensors at the tool are named as those of leg readings are."""

from __future__ import annotations

import numpy as np
import pytest
from test_ball_bar import circles

from orthocal import draw_errors, simulate_session
from orthocal.assessment.judgement import judge_session


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    plan = circles(tmp_path_factory.mktemp("mistakes"))
    names = plan.robot.parameters.select_model("full")
    errors = draw_errors(plan.robot, names, seed=2, tolerances={"*.offset_mm": 1.0})
    return simulate_session(plan, errors, seed=2).session


def reverse_setup(values, setup):
    values[setup == "yz"] *= -1.0


def reverse_one(values, setup):
    values[20] *= -1.0


def bump(values, setup):
    """The fixed ball moves towards the bar between two readings."""
    values[np.flatnonzero(setup == "zx")[8:]] += 50e-6


def swap(values, setup):
    values[[5, 9]] = values[[9, 5]]


def inches(values, setup):
    values *= 25.4


MISTAKES = {
    reverse_setup: ("reversed sign", "yz"),
    reverse_one: ("reversed sign", "yz"),
    bump: ("displaced gauge", "zx"),
    swap: ("swapped rows", "xy"),
    inches: ("wrong unit", None),
}


def test_sound_readings_are_not_accused(sound):
    assert {f.severity for f in judge_session(sound).findings} <= {"note"}


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda m: m.__name__)
def test_a_mistake_is_named_with_its_place(sound, mistake):
    kind, place = MISTAKES[mistake]
    values = np.array(sound.values)
    mistake(values, np.array([r.setup for r in sound.readings]))
    found = [f for f in judge_session(sound.with_values(values)).findings if f.severity != "note"]
    assert [f.kind for f in found] == [kind]
    if place is not None:
        assert {p.setup for p in found[0].places} == {place}
