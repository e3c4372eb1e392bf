"""Units, sizes and numbers that are too good are noticed; sound sessions are left alone."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import plans
import pytest
from folders import session_folder
from machines import write_orthoglide
from orthocal.assessment.findings.calibration import decide
from orthocal.output.text.explanation import advise

from orthocal import calibrate, load_plan, load_robot, load_session, simulate_session, summarize
from orthocal.assessment.plausibility import describe_machine, find_doubts
from orthocal.calibration.file import calibration_json
from orthocal.errors import RobotError

TRUTH = {"x_slide.offset": 1.2e-3, "y_slide.offset": -0.8e-3, "z_slide.offset": 0.5e-3}


@pytest.fixture(scope="module")
def plan(root):
    return load_plan(root / "examples/raw-cycles/plan.yaml")


@pytest.fixture(scope="module")
def session(plan):
    return simulate_session(plan, TRUTH, seed=4).session


def kinds(calibration):
    return [d.kind for d in find_doubts(calibration)]


@pytest.mark.parametrize(
    "name",
    ["raw-cycles", "sweep", "lines", *(f"table1/experiment-{n}" for n in ("1-printed", "2", "3"))],
)
def test_the_examples_are_sound(root, name):
    assert kinds(calibrate(load_session(session_folder(root, name)))) == []


def test_readings_in_inches_are_noticed(session):
    inches = session.with_values(np.round(session.values / 25.4, 7))
    result = calibrate(inches)
    assert "finer than the dial" in kinds(result)
    assert "too little left" in kinds(result)
    assert [f.kind for f in decide(result).findings if f.severity != "informs"] == ["wrong unit"]
    assert "in inches" in advise(result)
    assert advise(result).startswith("Do not enter these.")


def test_readings_in_inches_of_a_dial_in_inches_leave_too_little(session):
    """Rounded to what the session says: only what remains tells."""
    rows = [r.value for r in session.readings]
    coarse = session.with_gauge(replace(session.gauge, resolution=1e-6))
    again = coarse.with_values(np.round(np.array(rows) / 25.4, 6))
    assert kinds(calibrate(again)) == []  # finer steps stated: nothing contradicts
    stated = session.with_gauge(replace(session.gauge, resolution=0.5e-3))
    smooth = stated.with_values(np.array(rows) / 25.4)
    assert "too little left" in kinds(calibrate(smooth))


def test_means_of_cycles_may_be_finer_than_the_dial_here_and_there(session):
    values = session.values.copy()
    values[::4] += 3e-6
    assert kinds(calibrate(session.with_values(values))) == []


@pytest.mark.parametrize("seed", range(12))
def test_sound_sessions_raise_no_doubt(plan, seed):
    rng = np.random.default_rng(seed)
    sigma = (2e-6, 5e-6, 10e-6, 30e-6)[seed % 4]
    errors = {n: 1.5e-3 * rng.normal() for n in TRUTH}
    found = simulate_session(plan, errors, seed=seed, sigma=sigma).session
    for model in ("offsets", "lengths"):
        assert kinds(calibrate(found, model)) == []


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
    result = calibrate(other.with_values(values))
    assert kinds(result)[0] == "wrong size"
    assert advise(result).startswith("Do not enter these.")
    assert "another size" in advise(result)


def test_legs_of_different_lengths_are_noticed(tmp_path):
    folder = tmp_path / "machine"
    write_orthoglide(folder, 0.31025)
    urdf = folder / "machine.urdf"
    text = urdf.read_text()
    # the first leg alone was edited: 250 mm long, and its drive's zero and travel as before
    head, tail = text[: text.index("y_slide")], text[text.index("y_slide") :]
    urdf.write_text(head.replace('"0.31025', '"0.3083').replace('"0.155125', '"0.15415') + tail)
    plan = plans.paper() | {"robot": "machine", "gauge": {"sigma_mm": 0.01}}
    result = calibrate(
        simulate_session(load_plan(plans.write(tmp_path, plan)), TRUTH, seed=1).session
    )
    assert "legs differ" in kinds(result)
    assert "legs of x 308.3, y 310.25, z 310.25 mm" in advise(result)


def test_a_leg_of_250_metres_is_refused(tmp_path):
    write_orthoglide(tmp_path / "machine", 250.0)
    with pytest.raises(RobotError, match=r"legs\.x: is 250 m long; expected at most 20 m"):
        load_robot(tmp_path / "machine")


def test_a_sigma_in_micrometres_is_noticed_and_computed_readings_are_no_scatter(root):
    session = load_session(root / "examples/raw-cycles")
    coarse = session.with_gauge(replace(session.gauge, sigma=10e-3))
    words = [d.words for d in find_doubts(calibrate(coarse)) if d.kind == "sigma too coarse"]
    assert len(words) == 1
    assert "The σ given for the gauge, 10 mm" in words[0]
    assert not [d for d in find_doubts(calibrate(session)) if d.kind == "sigma too coarse"]
    same = session.with_values(np.zeros(len(session.readings)))
    same = same.with_gauge(replace(same.gauge, sigma=10e-6, resolution=None))
    assert not [d for d in find_doubts(calibrate(same)) if d.kind == "sigma too coarse"]


def test_a_posture_in_metres_is_noticed(root):
    calibration = calibrate(load_session(root / "examples/raw-cycles"))
    assert not [d for d in find_doubts(calibration) if d.kind == "posture too near"]
    first, *others = calibration.postures
    near = tuple(v + 0.05e-3 for v in others[-1].drives)
    moved = replace(calibration, postures=(replace(first, drives=near), *others))
    words = [d.words for d in find_doubts(moved) if d.kind == "posture too near"]
    assert len(words) == 1
    assert "0.087 mm from another one" in words[0]


def test_postures_of_another_round_are_not_too_near(root, tmp_path):
    """Their drives differ by the offsets that were entered in between, by fractions of a mm."""
    session = load_session(root / "examples/raw-cycles")
    copy = tmp_path / "later"
    shutil.copytree(root / "examples/raw-cycles", copy)
    text = (copy / "session.yaml").read_text()
    assert "offsets_mm: [0.0, 0.0, 0.0]" in text
    (copy / "session.yaml").write_text(text.replace("[0.0, 0.0, 0.0]", "[0.1, -0.1, 0.05]"))
    rows = (copy / "readings.csv").read_text()
    (copy / "readings.csv").write_text(rows.replace(",0.19", ",0.18"))
    both = calibrate([session, load_session(copy)])
    assert "posture too near" not in {d.kind for d in find_doubts(both)}
    first, *others = both.postures
    near = tuple(v + 0.05e-3 for v in others[0].drives)
    moved = replace(both, postures=(replace(first, drives=near), *others))
    assert "posture too near" in {d.kind for d in find_doubts(moved)}
