"""Sessions that are made in Python are checked before they are calibrated."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from calibrated import session_of

from orthocal import Conditions, Mounting, Section, Tip, calibrate, check_session, judge_session
from orthocal.errors import SessionError
from orthocal.session.completeness import require_complete


@pytest.fixture(scope="module")
def session():
    return session_of("raw-cycles")


def first_reading(session, **changes):
    """Session whose first reading is changed."""
    return replace(
        session, readings=(replace(session.readings[0], **changes), *session.readings[1:])
    )


def first_posture(session, **changes):
    """Session whose first posture is changed."""
    name, posture = next(iter(session.postures.items()))
    return replace(session, postures={**session.postures, name: replace(posture, **changes)})


def first_setup(session, **changes):
    """Session whose first setup is changed."""
    name, setup = next(iter(session.setups.items()))
    return replace(session, setups={**session.setups, name: replace(setup, **changes)})


def first_sensor(session, **changes):
    """Session in which the sensor of the first setup is changed."""
    sensor = next(iter(session.setups.values())).sensor
    return first_setup(session, sensor=replace(sensor, **changes))


def mix_time_zones(session):
    """Session with times with a time zone and without."""
    times = [datetime(2025, 1, 6, 9, i, tzinfo=z) for i, z in enumerate((UTC, UTC, None))]
    pairs = zip(session.readings, times, strict=False)
    return replace(
        session, readings=tuple(replace(r, conditions=Conditions(time=t)) for r, t in pairs)
    )


WRONG = {
    "no reading": (replace, {"readings": ()}, "readings", "there are none"),
    "missing": (first_reading, {"value": np.nan}, "readings", "1 of 54 readings have no"),
    "infinite": (first_reading, {"value": np.inf}, "csv:2", "found inf"),
    "text": (first_reading, {"value": "1"}, "csv:2", "found '1'"),
    "cycle": (first_reading, {"cycle": 0}, "csv:2", "found the cycle 0"),
    "part of a cycle": (first_reading, {"cycle": 1.5}, "csv:2", "found the cycle 1.5"),
    "coordinates": (
        first_posture,
        {"drives": np.zeros(2)},
        "postures.zero.drives",
        "expected an array of 3",
    ),
    "conditions": (first_reading, {"conditions": "ppp"}, "csv:2", "expected a Conditions"),
    "temperature": (
        first_reading,
        {"conditions": Conditions(temperature=np.nan)},
        "csv:2",
        "temperature: found nan",
    ),
    "time zones": (mix_time_zones, {}, "csv:4", "all times of setup 'yx' with a time zone, or all"),
    "repeated": (first_reading, {"cycle": 2}, "csv", "repeats cycle 2"),
    "setup": (first_reading, {"setup": "xx"}, "readings", "'xx' is not a setup"),
    "posture": (first_reading, {"posture": "p"}, "readings", "'p' is not a posture"),
    "approach": (
        first_reading,
        {"conditions": Conditions(approach="pp")},
        "csv:2",
        "found 'pp'; expected 3 letters",
    ),
    "offsets": (
        replace,
        {"controller_offsets": [0.0, 0.0, 0.0]},
        "controller_offsets",
        "an array of 3 numbers",
    ),
    "active": (first_setup, {"active": np.zeros(2)}, ".active", "expected an array of 3"),
    "gauges": (replace, {"gauges": {}}, "setups.", "'' is not a gauge"),
    "gauge": (replace, {"gauges": {"": None}}, "gauges.", "expected a Gauge"),
    "zero": (first_setup, {"zero": "fixed"}, ".zero", "expected free or known"),
    "aligned": (first_setup, {"aligned_at": "p"}, ".aligned_at", "'p' is not a posture"),
    "payload": (first_setup, {"payload": -1.0}, ".payload", "found -1.0"),
    "sensor": (first_setup, {"sensor": None}, ".sensor", "expected a sensor"),
    "minus": (first_reading, {"minus": "up"}, "readings", "'up' is not a posture"),
    "leg": (first_sensor, {"leg": "w"}, ".leg", "'w' is not a leg of orthoglide"),
    "direction": (first_sensor, {"direction": "q"}, "setups.yx.direction", "found 'q'"),
    "section": (
        first_sensor,
        {"section": Section("fraction", 1.5)},
        "setups.yx",
        "found 1.5; expected 0",
    ),
    "name": (first_setup, {"name": "xx"}, "setups.", "has the name 'xx'"),
    "adjusted": (replace, {"adjusted": {"a": 1e-3}}, "adjusted", "'a' is not an adjust"),
    "list": (replace, {"postures": []}, "postures", "found a list"),
}


@pytest.mark.parametrize(("change", "keys", "place", "problem"), WRONG.values(), ids=WRONG)
def test_a_session_that_cannot_be_calibrated_is_refused(session, change, keys, place, problem):
    require_complete(session)
    with pytest.raises(SessionError, match=problem) as caught:
        require_complete(change(session, **keys))
    assert place in str(caught.value)


def test_differences_that_follow_from_others_of_their_cycle_are_refused():
    """Both directions of one difference, and three differences in a circle."""
    session = session_of("table1/experiment-2")
    first = session.readings[0]
    reverse = replace(first, posture=first.minus, minus=first.posture)
    for cycle, accepted in ((first.cycle, False), (first.cycle + 1, True)):
        changed = replace(session, readings=(*session.readings, replace(reverse, cycle=cycle)))
        if accepted:
            require_complete(changed)
            continue
        with pytest.raises(SessionError, match="follows from the other differences of setup"):
            calibrate(changed)
    other = next(n for n in session.postures if n not in (first.posture, first.minus))
    circle = [replace(first, minus=other), replace(first, posture=other)]
    with pytest.raises(SessionError, match="follows from the other differences of setup"):
        require_complete(replace(session, readings=(*session.readings, *circle)))


def test_every_use_checks_the_session(session):
    for use in (calibrate, check_session):
        with pytest.raises(SessionError, match="'xx' is not a setup"):
            use(first_reading(session, setup="xx"))


def test_sizes_of_tips_and_mountings_are_not_negative():
    for size in (-2e-3, 0.0, np.nan):
        with pytest.raises(ValueError, match="radius: found"):
            Tip("ball", size)
    for size in (-1e-3, np.nan):
        with pytest.raises(ValueError, match="direction: found"):
            Mounting(direction=size)


def test_a_judgement_is_used_for_its_readings_only(session):
    judgement = judge_session(session)
    other = session.with_values(session.values + 1e-6)
    with pytest.raises(ValueError, match="judgement: found one of other readings"):
        calibrate(other, judgement=judgement)
    with pytest.raises(TypeError, match="found a int; expected a Judgement"):
        calibrate(session, judgement=3)
    with pytest.raises(TypeError, match="found a str; expected a Session"):
        judge_session("raw-cycles")


def test_readings_of_an_array_may_be_missing(session):
    values = np.full(len(session.readings), np.nan)
    assert not any(r.is_read for r in session.with_values(values).readings)
    values[3] = np.inf
    with pytest.raises(ValueError, match="values: found inf"):
        session.with_values(values)
