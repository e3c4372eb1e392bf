"""Units, sizes and numbers that are too good are noticed; sound sessions are left alone."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import plans
import pytest
from folders import session_folder
from machines import write_orthoglide

from orthocal import (
    calibrate,
    join_sessions,
    load_plan,
    load_robot,
    load_session,
    simulate_session,
    summarize,
)
from orthocal.assessment.judgement import judge_session
from orthocal.assessment.plausibility import find_implausible, find_impossible_gauges
from orthocal.calibration.file import calibration_json
from orthocal.errors import RobotError
from orthocal.output.text.answer import describe_machine

TRUTH = {"x_slide.offset": 1.2e-3, "y_slide.offset": -0.8e-3, "z_slide.offset": 0.5e-3}


@pytest.fixture(scope="module")
def plan(root):
    return load_plan(root / "examples/raw-cycles/plan.yaml")


@pytest.fixture(scope="module")
def session(plan):
    return simulate_session(plan, TRUTH, seed=4).session


def kinds(session):
    return [d.kind for d in find_implausible(session)]


@pytest.mark.parametrize(
    "name",
    ["raw-cycles", "sweep", "lines", *(f"table1/experiment-{n}" for n in ("1-printed", "2", "3"))],
)
def test_the_examples_are_sound(root, name):
    assert kinds(load_session(session_folder(root, name))) == []


def test_readings_in_inches_are_noticed(session):
    inches = session.with_values(np.round(session.values / 25.4, 7))
    assert "finer than the gauge" in kinds(inches)
    assert "residuals too small" in kinds(inches)
    found = [f for f in judge_session(inches).findings if f.severity != "note"]
    assert [f.kind for f in found] == ["wrong unit"]


def test_readings_in_inches_of_a_dial_in_inches_leave_too_little(session):
    """Rounded to what the session says: only what remains tells."""
    rows = [r.value for r in session.readings]
    coarse = session.with_gauge(replace(session.gauge, resolution=1e-6))
    again = coarse.with_values(np.round(np.array(rows) / 25.4, 6))
    assert kinds(again) == []  # finer steps stated: nothing contradicts
    stated = session.with_gauge(replace(session.gauge, resolution=0.5e-3))
    smooth = stated.with_values(np.array(rows) / 25.4)
    assert "residuals too small" in kinds(smooth)


def test_means_of_cycles_may_be_finer_than_the_dial_here_and_there(session):
    values = session.values.copy()
    values[::4] += 3e-6
    assert kinds(session.with_values(values)) == []


@pytest.mark.parametrize("seed", range(12))
def test_sound_sessions_raise_no_doubt(plan, seed):
    rng = np.random.default_rng(seed)
    sigma = (2e-6, 5e-6, 10e-6, 30e-6)[seed % 4]
    errors = {n: 1.5e-3 * rng.normal() for n in TRUTH}
    found = simulate_session(plan, errors, seed=seed, sigma=sigma).session
    assert kinds(found) == []


def test_the_machines_size_is_printed(session):
    result = calibrate(session)
    assert describe_machine(result) == "legs of 310.25 mm, travel 120 … 390 mm"
    assert "Machine: legs of 310.25 mm, travel 120 … 390 mm" in summarize(result)
    document = json.loads(calibration_json(result))["robot"]
    assert dict(document["legs"]) == pytest.approx(dict.fromkeys("xyz", 0.31025))
    assert document["travel"][0] == ["x_slide", "m", 0.12, 0.39]


def small_plan(folder, *, postures=None):
    write_orthoglide(folder / "machine", 0.295, travel=(0.05, 0.39))
    plan = plans.paper() | {"robot": "machine"}
    plan["gauge"] = {"sigma_mm": 0.01, "resolution_mm": 0.01}
    if postures is not None:
        plan["postures"] = postures
    return load_plan(plans.write(folder, plan))


def test_postures_of_a_machine_of_another_size_are_noticed(tmp_path, root, plan, session):
    """Joint coordinates of the packaged machine, read there, given to one with legs of 295 mm."""
    joints = {
        name: {"joints_mm": [float(v) for v in np.round(p.drives * 1e3, 3)]}
        for name, p in plan.postures.items()
    }
    other = small_plan(tmp_path, postures=joints)
    own = {(r.setup[:2], r.posture): r.value for r in session.readings if r.cycle == 1}
    values = [own[r.setup[:2], r.posture] for r in other.readings]
    found = judge_session(other.with_values(values))
    assert found.findings[0].kind == "wrong dimensions"
    assert found.verdict == "reject"


def test_legs_of_different_lengths_are_noticed(tmp_path):
    folder = tmp_path / "machine"
    write_orthoglide(folder, 0.31025)
    urdf = folder / "machine.urdf"
    text = urdf.read_text()
    # the first leg alone was edited: 250 mm long, and its drive's zero and travel as before
    head, tail = text[: text.index("y_slide")], text[text.index("y_slide") :]
    urdf.write_text(head.replace('"0.31025', '"0.3083').replace('"0.155125', '"0.15415') + tail)
    plan = plans.paper() | {"robot": "machine", "gauge": {"sigma_mm": 0.01}}
    session = simulate_session(load_plan(plans.write(tmp_path, plan)), TRUTH, seed=1).session
    (found,) = [f for f in find_implausible(session) if f.kind == "legs differ"]
    assert found.numbers == pytest.approx({"x_mm": 308.3, "y_mm": 310.25, "z_mm": 310.25})


@pytest.mark.parametrize(
    ("gauge", "number"),
    [
        ({"resolution": 10e-3, "range": (-0.4e-3, 0.4e-3)}, {"range_mm": 0.8}),
        ({"resolution": 10e-3, "range": None}, {"finer": 49.0}),  # nearly all miss such steps
        ({"resolution": 0.5e-3}, {"finer": 51.0}),  # of ±5 mm, but 50 times the noise
        ({"resolution": 0.5e-3, "sigma": None, "range": None}, {"finer": 51.0}),
    ],
)
def test_a_resolution_that_the_gauge_or_its_readings_contradict_is_the_only_cause(
    root, gauge, number
):
    """Not decimal points or inches, which such steps would explain as well."""
    session = load_session(root / "examples/raw-cycles")
    wrong = session.with_gauge(replace(session.gauge, **gauge))
    (found,) = [f for f in judge_session(wrong).findings if f.severity != "note"]
    assert found.kind == "resolution too coarse"
    expected = {"resolution_mm": gauge["resolution"] * 1e3} | number
    assert found.numbers == pytest.approx(expected)
    assert all(p.line for p in found.places)


@pytest.mark.parametrize("resolution", [1e-6, 5e-6, 10e-6, None])
def test_a_resolution_that_suits_the_gauge_is_not_contradicted(root, resolution):
    session = load_session(root / "examples/raw-cycles")
    for limits in (session.gauge.range, None):
        known = replace(session.gauge, resolution=resolution, range=limits)
        assert list(find_impossible_gauges(session.with_gauge(known))) == []


def test_a_leg_of_250_metres_is_refused(tmp_path):
    write_orthoglide(tmp_path / "machine", 250.0)
    with pytest.raises(RobotError, match=r"legs\.x: is 250 m long; expected at most 20 m"):
        load_robot(tmp_path / "machine")


def test_a_sigma_in_micrometres_is_noticed_and_computed_readings_are_no_scatter(root):
    session = load_session(root / "examples/raw-cycles")
    coarse = session.with_gauge(replace(session.gauge, sigma=10e-3))
    (found,) = [d for d in find_implausible(coarse) if d.kind == "sigma too large"]
    assert found.numbers["given_mm"] == pytest.approx(10.0)
    assert "sigma too large" not in kinds(session)
    same = session.with_values(np.zeros(len(session.readings)))
    same = same.with_gauge(replace(same.gauge, sigma=10e-6, resolution=None))
    assert "sigma too large" not in kinds(same)


def near(session, name, other):
    """The same session with a posture 0.05 mm a drive from another one."""
    moved = replace(session.postures[name], drives=session.postures[other].drives + 0.05e-3)
    return replace(session, postures={**session.postures, name: moved})


def test_a_posture_in_metres_is_noticed(root):
    session = load_session(root / "examples/raw-cycles")
    assert "postures too near" not in kinds(session)
    name = next(p for p in session.postures if p != "zero")
    (found,) = [f for f in find_implausible(near(session, name, "zero")) if "near" in f.kind]
    assert found.numbers["gap_mm"] == pytest.approx(0.087, abs=0.001)
    assert found.places[0].posture in (name, "zero")


def test_postures_beside_each_other_far_from_the_mechanical_zero_are_not_in_metres(root):
    """Such as those of a path that is run there and back."""
    session = load_session(root / "examples/raw-cycles")
    first, second = (p for p in list(session.postures)[:3] if p != "zero")
    assert "postures too near" not in kinds(near(session, first, second))


def test_postures_of_another_round_are_not_too_near(root):
    """Their drives differ by the offsets that were entered in between, by fractions of a mm."""
    session = load_session(root / "examples/raw-cycles")
    later = session.with_controller([0.1e-3, -0.1e-3, 0.05e-3])
    both = join_sessions([session, later])
    assert "postures too near" not in kinds(both)
    name = next(p for p in session.postures if p != "zero")
    both = join_sessions([session, near(later, name, "zero")])
    assert "postures too near" in kinds(both)
