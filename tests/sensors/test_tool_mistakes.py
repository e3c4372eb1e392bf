"""Mistakes in readings of sensors at the tool are named as those of leg readings are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball_bar_plans import circles
from test_tool_indicator import AXES, BLOCK, STEPS, Plan

from orthocal import draw_errors, simulate_session
from orthocal.assessment.judgement import judge_session
from orthocal.measurement.joining import join_sessions
from orthocal.observation.model import predict_readings
from orthocal.observation.sensor_groups import nominal_values, nuisance_parameters

SQUARE = "kind: square, name: granite, square_tolerance_mrad: 1, straight_tolerance_mm: 0.002"


def errors_of(plan, seed):
    names = plan.robot.parameters.select_model("full")
    return draw_errors(plan.robot, names, seed=seed, tolerances={"*.offset_mm": 1.0})


def warnings_of(session):
    return [f for f in judge_session(session).findings if f.severity != "note"]


def every_second(plan):
    """Eight postures of each circle."""
    odd = ("1", "3", "5", "7", "9")
    return plan.select([r for r in plan.readings if not r.posture.endswith(odd)])


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    plan = every_second(circles(tmp_path_factory.mktemp("mistakes")))
    return simulate_session(plan, errors_of(plan, 2), seed=2).session


def reverse_one(values, setup):
    values[10] *= -1.0


def bump(values, setup):
    """The fixed ball moves towards the bar between two readings."""
    values[np.flatnonzero(setup == "zx")[4:]] += 50e-6


def swap(values, setup):
    values[[3, 5]] = values[[5, 3]]


def inches(values, setup):
    values *= 25.4


MISTAKES = {
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
    found = warnings_of(sound.with_values(values))
    assert [f.kind for f in found] == [kind]
    if place is not None:
        assert {p.setup for p in found[0].places} == {place}


def test_a_bar_with_all_signs_reversed_is_named(tmp_path):
    """Beside readings of the legs; the fixed ball seems to be on the opposite side of its place."""
    plan = every_second(circles(tmp_path, legs=True))
    session = simulate_session(plan, errors_of(plan, 2), seed=2).session
    of_bar = np.array([session.setups[r.setup].gauge == "bar" for r in session.readings])
    (found,) = warnings_of(session.with_values(np.where(of_bar, -1.0, 1.0) * session.values))
    assert found.kind == "reversed sign"
    assert {p.setup for p in found.places} == {"xy", "yz", "zx"}


def test_a_later_bar_with_all_signs_reversed_is_named(tmp_path):
    """To first order about the readings as stated, the reversed sign has no evidence."""
    plan = every_second(circles(tmp_path, length="0", legs=True))
    first = plan.select([r for r in plan.readings if r.setup.startswith("leg")])
    later = plan.select([r for r in plan.readings if r.setup == "xy"])
    errors = errors_of(plan, 2)
    legs = simulate_session(first, errors, seed=2).session
    bar = simulate_session(later, errors, seed=52).session
    (found,) = warnings_of(join_sessions([legs, bar.with_values(-bar.values)]))
    assert found.kind == "reversed sign"
    assert [p.setup for p in found.places] == ["session-2/xy"]


def test_a_ball_displaced_between_setups_is_named(tmp_path):
    plan = every_second(circles(tmp_path))
    errors = errors_of(plan, 1)
    simulated = simulate_session(plan, errors, seed=1)
    names = [p.name for p in nuisance_parameters(plan).parameters]
    nuisance = np.array([simulated.nuisance.get(name, 0.0) for name in names])
    displaced = nuisance + 50e-6 * np.array([name.startswith("ball.post.") for name in names])
    before, after = (predict_readings(plan, errors, nuisance=n) for n in (nuisance, displaced))
    later = ["yz", "zx"]
    changed = [r.setup in later for r in plan.readings]
    values = simulated.session.values + np.where(changed, after - before, 0.0)
    found = warnings_of(simulated.session.with_values(values))
    assert found[0].kind == "displaced artefact"
    assert [p.setup for p in found[0].places] == later


def with_artefact(session, names, **keys):
    setups = dict(session.setups)
    for name in names:
        sensor = setups[name].sensor
        other = replace(sensor, artefact=replace(sensor.artefact, **keys))
        setups[name] = replace(setups[name], sensor=other)
    return replace(session, setups=setups)


@pytest.fixture(scope="module")
def turned_over(tmp_path_factory):
    """A square along x and y beside the paper's readings, before and after it was turned over."""
    plan = Plan()
    plan.legs()
    for over in (False, True):
        for along, across in ("xy", "yx"):
            points = [tuple(s * v for v in AXES[along]) for s in STEPS]
            key = f"{SQUARE}, along: {along}, reversed: {str(over).lower()}"
            plan.read(f"{'over' if over else 'first'}_{along}", across, key, points)
    plan = plan.load(tmp_path_factory.mktemp("square"))
    return simulate_session(plan, errors_of(plan, 0), seed=0).session


@pytest.mark.parametrize("wrong", [("over_x", "over_y"), ("over_y",)], ids="-".join)
def test_a_square_that_was_turned_over_unstated_is_named(turned_over, wrong):
    if len(wrong) == 2:
        assert warnings_of(turned_over) == []
    found = warnings_of(with_artefact(turned_over, wrong, reversed=False))
    assert len(found) == 1
    assert found[0].kind == ("displaced artefact" if len(wrong) == 2 else "ambiguous")
    assert "square granite was displaced or turned over" in found[0].text
    assert found[0].places[0].setup == wrong[0]


def test_a_gauge_block_of_another_height_is_named(tmp_path):
    """On the table and on the block by turns: nothing else explains that."""
    height = 50.5
    plan = Plan()
    plan.legs()
    for axis, across in ("xy", "yz", "zx"):
        points = [
            tuple(v * np.array(AXES[axis]) + s * np.array(AXES[across]))
            for s in (-4, 0, 4)
            for v in (-25, 25)
        ]
        plan.read(f"block_{axis}", f"-{axis}", BLOCK, points)
    plan = plan.load(tmp_path)
    session = simulate_session(plan, errors_of(plan, 1), seed=1).session
    assert warnings_of(session) == []
    (found,) = warnings_of(with_artefact(session, ["block_y"], height=height * 1e-3))
    assert found.kind == "wrong dimension"
    assert {p.setup for p in found.places} == {"block_y"}
    assert found.numbers["dimension_mm"] == pytest.approx(50.0, abs=0.05)
    assert found.numbers["stated_mm"] == height


def test_a_bar_that_was_zeroed_on_the_machine_is_named(tmp_path):
    """Each setup has another zero. A bar of another length has the same change in all setups."""
    plan = every_second(circles(tmp_path))
    sensors = {n: replace(s.sensor, length_std=0.0) for n, s in plan.setups.items()}
    plan = replace(
        plan,
        setups={n: replace(s, sensor=sensors[n], zero="known") for n, s in plan.setups.items()},
    )
    session = simulate_session(plan, errors_of(plan, 1), seed=1).session
    zeros = {"xy": 0.31e-3, "yz": -0.22e-3, "zx": 0.17e-3}
    session = session.with_values([r.value + zeros[r.setup] for r in session.readings])
    found = warnings_of(session)
    assert {f.kind for f in found} == {"wrong dimension"}
    assert {p.setup for f in found for p in f.places} == set(zeros)
    assert "or the dial was not zeroed at 50 mm" in found[0].text
    assert "`zero: free`" in found[0].action
    free = {n: replace(s, zero="free") for n, s in session.setups.items()}
    assert warnings_of(replace(session, setups=free)) == []


def two_sessions(folder, seed, *, change, stated=None):
    """Three circles of one bar on two days; before the second one it was readjusted.

    Args:
        folder: Of the plan.
        seed: Of the machine.
        change: Change of the length, [m].
        stated: What the second session states: another `name` of the gauge, or `length`.
    """
    plan = every_second(circles(folder))
    errors = errors_of(plan, seed)
    first = simulate_session(plan, errors, seed=seed)
    bar = {n: v for n, v in first.nuisance.items() if n.startswith("gauge.")}
    second = simulate_session(plan, {**errors, **bar}, seed=seed + 100).session
    setups = second.setups
    if stated == "name":
        setups = {n: replace(s, gauge="other") for n, s in setups.items()}
        second = replace(second, gauges={"other": second.gauge}, setups=setups)
    if stated == "length":
        bars = {n: replace(s.sensor, length=s.sensor.length + 0.5e-3) for n, s in setups.items()}
        second = replace(second, setups={n: replace(setups[n], sensor=b) for n, b in bars.items()})
    return join_sessions([first.session, second.with_values(np.array(second.values) - change)])


def test_a_bar_that_was_readjusted_between_sessions_is_named(tmp_path):
    assert warnings_of(two_sessions(tmp_path, 0, change=0.0)) == []
    change = 60e-6
    (found,) = warnings_of(two_sessions(tmp_path, 1, change=change))
    assert found.kind == "readjusted dimension"
    assert {p.setup for p in found.places} == {"session-2/xy", "session-2/yz", "session-2/zx"}
    assert found.numbers["dimension_mm"] == pytest.approx(50.0 + 1e3 * change, abs=0.01)
    assert "before session session-2" in found.text


@pytest.mark.parametrize("stated", ["name", "length"])
def test_a_bar_of_another_name_or_stated_length_has_another_length(tmp_path, stated):
    """The remedy that the finding states. Both sessions have one scale if the name is the same."""
    session = two_sessions(tmp_path, 1, change=-0.3e-3, stated=stated)
    assert warnings_of(session) == []
    names = {p.name for p in nuisance_parameters(session).parameters if "gauge" in p.name}
    later, length, more = {
        "name": ("gauge.other", 50e-3, {"gauge.other.scale"}),
        "length": ("gauge.session-2/bar", 50.5e-3, set()),
    }[stated]
    assert names == {"gauge.bar.length", "gauge.bar.scale", f"{later}.length", *more}
    values = nominal_values(session)
    assert values["gauge.bar.length"] == pytest.approx(50e-3)
    assert values[f"{later}.length"] == pytest.approx(length)
