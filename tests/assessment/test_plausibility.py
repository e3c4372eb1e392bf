"""Plausibility of units, dimensions, gauges and postures; sound sessions have no findings."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import plans
import pytest
from calibrated import calibrated, plan_of, session_of
from effect_plans import effect_plan
from gauges import with_gauges
from machines import write_orthoglide
from models import TRUTH

from orthocal import join_sessions, load_plan, load_robot, simulate_session, summarize
from orthocal.assessment.judgement import _owner_of, find_warnings, judge_session
from orthocal.assessment.plausibility import (
    _check_distances,
    _legs,
    describe_legs,
    find_finer,
    find_implausible,
    find_impossible_gauges,
)
from orthocal.assessment.words.effects import condition_incomplete
from orthocal.assessment.words.plausibility import outstanding_error
from orthocal.calibration.file import calibration_json
from orthocal.effects.loading import identified_effects
from orthocal.errors import RobotError
from orthocal.estimation.problem import build_problem
from orthocal.output.text.answer import describe_machine
from orthocal.session.session import Gauge


@pytest.fixture(scope="module")
def plan():
    return plan_of("raw-cycles")


@pytest.fixture(scope="module")
def session(plan):
    return simulate_session(plan, TRUTH, seed=4).session


@pytest.fixture(scope="module")
def cycles():
    return session_of("raw-cycles")


def kinds(session):
    return [d.kind for d in find_implausible(session)]


def judged(session):
    """Findings of the judgement that are no notes."""
    return [f for f in judge_session(session).findings if f.severity != "note"]


def test_readings_in_inches_are_found(session):
    inches = session.with_values(np.round(session.values / 25.4, 7))
    (finer,) = (f for f in find_implausible(inches) if f.kind == "finer than the gauge")
    assert finer.text.startswith("All 54 readings of the gauge appear to be in inches")
    coarse = session.with_values(np.round(session.values / 25.4, 6))  # no multiples in inches
    (finer,) = (f for f in find_implausible(coarse) if f.kind == "finer than the gauge")
    assert "readings have more digits, or are in inches" in finer.text
    assert "residuals too small" in kinds(inches)
    assert [f.kind for f in judged(inches)] == ["wrong unit"]


def test_readings_in_inches_do_not_accuse_the_dimensions(root, tmp_path):
    """Beside the axes the nominal machine moves the gauge, which inches do not show."""
    text = (root / "examples/raw-cycles/plan.yaml").read_text()
    beside = re.sub(r"(_m\w+: {tcp_mm: )\[(.*?)\]", _beside, text)
    (tmp_path / "plan.yaml").write_text(beside)
    session = simulate_session(load_plan(tmp_path / "plan.yaml"), {}, seed=1).session
    inches = session.with_values(np.round(session.values / 25.4, 7))
    assert "wrong dimensions" in kinds(inches)
    assert [f.kind for f in judged(inches)] == ["wrong unit"]


def _beside(posture):
    """Posture 6 mm beside the axis of its leg."""
    shifted = ["6" if v.strip() == "0" else v for v in posture[2].split(",")]
    return f"{posture[1]}[{', '.join(shifted)}]"


def test_few_readings_between_the_steps_are_a_note_unless_all_of_a_setup():
    """A setup in inches, whose small readings agree with the machine all the same."""
    session = session_of("workshop")
    of_setup = np.array([r.setup == next(iter(session.setups)) for r in session.readings])
    rows = np.flatnonzero(of_setup)[1:]
    few, halves, inches = session.values, session.values, session.values
    few[rows] += 3e-6
    halves[of_setup] += 5e-6  # read between two marks
    inches[of_setup] = np.round(inches[of_setup] / 25.4, 7)
    for values, severity, count in (
        (few, "note", 2.0),
        (halves, "note", 3.0),
        (inches, "review", 3.0),
    ):
        (finer,) = find_finer(session.with_values(values))
        assert (finer.severity, finer.numbers["readings_between_steps"]) == (severity, count)
    assert not [f for f in find_warnings(session.with_values(few)) if f.severity == "note"]


def test_small_readings_in_metres_are_found():
    errors = {name: 0.1 * error for name, error in TRUTH.items()}
    session = simulate_session(plan_of("workshop"), errors, seed=1).session
    metres = session.with_values(np.round(session.values * 1e-3, 9))
    assert not list(find_impossible_gauges(metres))
    (found,) = judged(metres)
    text = "It looks as if all readings were written in m."
    assert (found.kind, found.text) == ("wrong unit", text)


def test_some_means_of_cycles_may_be_finer_than_the_dial(session):
    values = session.values.copy()
    values[::4] += 3e-6
    found = find_implausible(session.with_values(values))
    assert [(f.kind, f.severity) for f in found] == [("finer than the gauge", "note")]


@pytest.mark.parametrize("seed", range(4))
def test_sound_sessions_are_plausible(plan, seed):
    rng = np.random.default_rng(seed)
    sigma = (2e-6, 5e-6, 10e-6, 30e-6)[seed % 4]
    errors = {n: 1.5e-3 * rng.normal() for n in TRUTH}
    assert kinds(simulate_session(plan, errors, seed=seed, sigma=sigma).session) == []


def test_the_dimensions_of_the_machine_are_printed():
    result = calibrated("raw-cycles")
    assert describe_machine(result) == "legs of 310.25 mm, travel 120 … 390 mm"
    assert "Machine: legs of 310.25 mm, travel 120 … 390 mm" in summarize(result)
    assert describe_legs(plan_of("linear_delta").robot) == "rods of 280 mm"
    document = json.loads(calibration_json(result))["robot"]
    assert dict(document["legs"]) == pytest.approx(dict.fromkeys("xyz", 0.31025))
    assert document["travel"][0] == ["x_slide", "m", 0.12, 0.39]


def small_plan(folder, postures):
    write_orthoglide(folder / "machine", 0.295, travel=(0.05, 0.39))
    plan = plans.paper() | {"robot": "machine"}
    plan |= {"gauge": {"sigma_mm": 0.01, "resolution_mm": 0.01}, "postures": postures}
    return load_plan(plans.write(folder, plan))


def test_postures_of_a_machine_of_other_dimensions_are_found(tmp_path, plan, session):
    joints = {
        name: {"joints_mm": [float(v) for v in np.round(p.drives * 1e3, 3)]}
        for name, p in plan.postures.items()
    }
    other = small_plan(tmp_path, joints)
    own = {(r.setup[:2], r.posture): r.value for r in session.readings if r.cycle == 1}
    values = [own[r.setup[:2], r.posture] for r in other.readings]
    found = judge_session(other.with_values(values))
    assert found.findings[0].kind == "wrong dimensions"
    assert found.verdict == "reject"
    nominal = simulate_session(other, {}, exact=True).session.values
    setups = np.array([r.setup for r in other.readings])
    for motion, name in ((nominal, "nominal_rms_mm"), (np.array(values), "measured_rms_mm")):
        centred = np.array(motion)
        for setup in other.setups:
            centred[setups == setup] -= centred[setups == setup].mean()
        expected = 1e3 * np.sqrt(np.mean(centred**2))
        assert found.findings[0].numbers[name] == pytest.approx(expected)


def test_a_line_with_the_name_of_another_setup_is_not_another_machine():
    """A leg swings by tens of millimetres where its indicator does not follow it."""
    session = session_of("workshop")
    readings = list(session.readings)
    row = [(r.setup, r.posture) for r in readings].index(("zx", "x_max"))
    readings[row] = replace(readings[row], setup="xz")
    found = judge_session(replace(session, readings=tuple(readings)))
    assert found.verdict == "review"
    finding = found.findings[0]
    assert [(p.setup, p.posture) for p in finding.places] == [("xz", "x_max")]
    assert "may name another setup or posture" in finding.text


def test_legs_of_different_lengths_are_found(tmp_path):
    folder = tmp_path / "machine"
    write_orthoglide(folder, 0.31025)
    urdf = folder / "machine.urdf"
    text = urdf.read_text()
    # only the first leg was edited
    head, tail = text[: text.index("y_slide")], text[text.index("y_slide") :]
    urdf.write_text(head.replace('"0.31025', '"0.3083').replace('"0.155125', '"0.15415') + tail)
    plan = plans.paper() | {"robot": "machine", "gauge": {"sigma_mm": 0.01}}
    session = simulate_session(load_plan(plans.write(tmp_path, plan)), TRUTH, seed=1).session
    (found,) = [f for f in find_implausible(session) if f.kind == "legs differ"]
    assert found.numbers == pytest.approx({"x_mm": 308.3, "y_mm": 310.25, "z_mm": 310.25})


def test_equal_legs_without_errors_of_their_frames_do_not_differ(cycles):
    robot = cycles.robot
    names = [n for n, e in robot.parameters.elementary.items() if e.kind != "translation"]
    parameters = SimpleNamespace(elementary={n: robot.parameters.elementary[n] for n in names})
    rigid = SimpleNamespace(legs=robot.legs, drives=robot.drives, parameters=parameters)
    assert _legs(rigid) is None


@pytest.mark.parametrize(
    ("gauge", "number"),
    [
        ({"resolution": 10e-3, "range": (-0.4e-3, 0.4e-3)}, {"range_mm": 0.8}),
        ({"resolution": 10e-3, "range": None}, {"readings_between_steps": 49.0}),
        # of ±5 mm, but 50 times the noise
        ({"resolution": 0.5e-3}, {"readings_between_steps": 51.0}),
        ({"resolution": 0.5e-3, "sigma": None, "range": None}, {"readings_between_steps": 51.0}),
    ],
)
def test_an_impossible_resolution_is_the_only_finding(cycles, gauge, number):
    """Such steps would also explain decimal points and inches."""
    wrong = cycles.with_gauge(replace(cycles.gauge, **gauge))
    (found,) = judged(wrong)
    assert found.kind == "resolution too coarse"
    expected = {"resolution_mm": gauge["resolution"] * 1e3} | number
    assert found.numbers == pytest.approx(expected)
    assert all(p.line for p in found.places)


def test_a_resolution_of_a_tenth_of_the_readings_is_the_only_finding(cycles):
    """Rounding to 0.01 mm would look like mistakes."""
    wrong = cycles.with_gauge(replace(cycles.gauge, resolution=1e-6, sigma=0.5e-6))
    (found,) = judged(wrong)
    assert found.kind == "resolution too fine"
    assert found.numbers == pytest.approx({"resolution_mm": 0.001, "coarser_mm": 0.01})
    assert "more scatter than its stated noise" in found.text
    unstated = wrong.with_gauge(replace(wrong.gauge, sigma=None))
    (found,) = find_impossible_gauges(unstated)
    assert "stated noise" not in found.text
    # five such readings may be by chance
    assert not list(find_impossible_gauges(wrong.select(wrong.readings[:5])))


@pytest.mark.parametrize("joined", [False, True])
def test_a_finding_about_one_of_several_gauges_states_its_key_and_its_readings(cycles, joined):
    coarse, fine = cycles.gauge, replace(cycles.gauge, resolution=1e-6, sigma=0.5e-6)
    session = with_gauges(cycles, {"coarse": coarse, "fine": fine}, ["yx", "zx"])
    session = replace(session, path=Path("tuesday/session.yaml"))
    if joined:
        session = join_sessions([replace(cycles, sha256=""), session])
    (found,) = find_impossible_gauges(session)
    name = "tuesday/fine" if joined else "fine"
    count = sum(session.setups[r.setup].gauge == name for r in session.readings)
    assert f"'{name}'" in found.words
    assert "tuesday/session.yaml: gauges.fine.resolution_mm" in found.words
    assert f"its {count} readings" in found.words


@pytest.mark.parametrize("resolution", [1e-6, 5e-6, 10e-6, None])
def test_a_possible_resolution_has_no_finding(cycles, resolution):
    for limits in (cycles.gauge.range, None):
        gauge = replace(cycles.gauge, resolution=resolution, range=limits)
        assert list(find_impossible_gauges(cycles.with_gauge(gauge))) == []


def test_a_gauge_without_readings_is_not_judged(cycles):
    """A bar whose stated noise is in a wrong unit, mounted in a setup that is not read."""
    wrong = Gauge(10e-3, 1e-6, (-2e-6, 2e-6))
    first, *others = cycles.setups
    setups = {**cycles.setups, first: replace(cycles.setups[first], gauge="bar")}
    session = replace(cycles, gauges={**cycles.gauges, "bar": wrong}, setups=setups)
    assert len(list(find_impossible_gauges(session))) == 2  # its noise and its range
    unread = session.select([r for r in session.readings if r.setup in others])
    unread = replace(unread, gauges=session.gauges, setups=setups)
    assert not list(find_impossible_gauges(unread))


def test_a_leg_of_250_metres_is_refused(tmp_path):
    write_orthoglide(tmp_path / "machine", 250.0)
    with pytest.raises(RobotError, match=r"legs\.x: is 250 m long; expected at most 20 m"):
        load_robot(tmp_path / "machine")


def test_a_sigma_in_micrometres_is_found(cycles):
    """Computed readings without scatter do not contradict it."""
    coarse = cycles.with_gauge(replace(cycles.gauge, sigma=10e-3))
    (found,) = judged(coarse)
    assert found.kind == "sigma too large"
    assert found.numbers["gauge_sigma_mm"] == pytest.approx(10.0)
    fine = cycles.with_gauge(replace(cycles.gauge, sigma=1e-3, resolution=1e-5))
    unknown = cycles.with_gauge(replace(cycles.gauge, sigma=5e-3, resolution=None))
    for session in (fine, unknown):
        assert [f.kind for f in judged(session)] == ["sigma too large"]
    assert "sigma too large" not in kinds(cycles)
    for scatter in (0.0, 5e-8):
        noise = scatter * np.random.default_rng(0).normal(size=len(cycles.readings))
        same = cycles.with_values(noise)
        same = same.with_gauge(replace(same.gauge, sigma=10e-6, resolution=None))
        assert "sigma too large" not in kinds(same)


def test_a_sigma_that_is_too_large_is_found_in_each_of_joined_sessions(cycles):
    """A gauge that read nothing does not hide it."""
    coarse = cycles.with_gauge(replace(cycles.gauge, sigma=10e-3))
    gauges = {**coarse.gauges, "spare": replace(coarse.gauge, sigma=None)}
    assert kinds(replace(coarse, gauges=gauges)).count("sigma too large") == 1
    both = join_sessions([coarse, replace(coarse, sha256="")])
    assert kinds(both).count("sigma too large") == 2


def near(session, name, other):
    """The session with a posture 0.05 mm per drive from another one."""
    moved = replace(session.postures[name], drives=session.postures[other].drives + 0.05e-3)
    return replace(session, postures={**session.postures, name: moved})


def test_a_posture_in_metres_is_found(cycles):
    """Neighbouring postures far from the mechanical zero may be those of a path in both ways."""
    assert "postures too near" not in kinds(cycles)
    name, other = (p for p in list(cycles.postures)[:3] if p != "zero")
    assert "postures too near" not in kinds(near(cycles, name, other))
    (found,) = [f for f in find_implausible(near(cycles, name, "zero")) if "near" in f.kind]
    assert found.numbers["gap_mm"] == pytest.approx(0.087, abs=0.001)
    assert found.places[0].posture in (name, "zero")


def test_near_postures_are_described_in_the_units_of_their_drives(fivebar):
    """A slide in m and a motor in rad are compared in their own travels."""
    displacements = {"a": (0, 0), "b": (0.5, 0), "c": (0, 0.5), "d": (-0.4, 0.3), "e": (3e-4, 0)}

    def find(units):
        """Finding about postures of two drives with these units."""
        drives = [replace(d, unit=u) for d, u in zip(fivebar.drives, units, strict=True)]
        postures = {
            n: SimpleNamespace(drives=fivebar.drive_zero + np.array(d))
            for n, d in displacements.items()
        }
        session = SimpleNamespace(
            robot=SimpleNamespace(drives=drives, drive_zero=fivebar.drive_zero),
            active_offsets=np.zeros(2),
            readings=(),
            postures=postures,
        )
        session.select = lambda readings: session
        return _check_distances(session)

    gap, largest = np.degrees(3e-4), np.degrees(np.hypot(0.9, 0.5))
    found = find(["rad", "rad"])
    assert found.places[0].posture == "e"
    assert found.numbers == pytest.approx({"gap_deg": gap, "largest_deg": largest})
    assert "0.017 deg from another one; others are up to 59 deg apart" in found.text
    found = find(["m", "rad"])
    expected = {"gap_mm": 0.3, "largest_mm": 900.0, "gap_deg": 0.0, "largest_deg": np.degrees(0.5)}
    assert found.numbers == pytest.approx(expected)
    displacements["e"] = (3e-4, 0.02)  # near along the slide only
    assert find(["m", "rad"]) is None


def test_postures_of_another_session_are_not_too_near(cycles):
    """Their drives differ by the entered offsets, by fractions of a mm."""
    later = cycles.with_controller([0.1e-3, -0.1e-3, 0.05e-3])
    both = join_sessions([cycles, later])
    assert "postures too near" not in kinds(both)
    name = next(p for p in cycles.postures if p != "zero")
    both = join_sessions([cycles, near(later, name, "zero")])
    assert "postures too near" in kinds(both)


@pytest.mark.parametrize(
    ("name", "advice"),
    [
        ("setup.yx.roll", "Read setup yx again: a wrong reading, such as a dial misread by one"),
        ("setup.2025.03.14/yx.roll", "Read setup 2025.03.14/yx again:"),
        ("x_slide.offset", "Measure that place or part again."),
    ],
)
def test_an_error_of_a_mounting_may_be_a_wrong_reading(name, advice):
    problem = build_problem(session_of("workshop"), model="offsets")
    plain = name.replace("2025.03.14/", "")
    (parameter,) = (p for p in problem.parameters if p.name == plain)
    found = outstanding_error(replace(parameter, name=name), 0.1)
    assert found.kind == "outstanding error"
    assert found.severity == "reject"
    assert found.action.startswith(advice)


@pytest.mark.parametrize(
    ("name", "label", "owner"),
    [
        ("setup.yx.roll", "", "setup.yx"),
        ("setup.2025.03.14/y.x.roll", "2025.03.14", "setup.y.x"),
        ("2025.03.14/square.block.long.bow", "2025.03.14", "square.block"),
    ],
)
def test_names_with_dots_keep_the_owners_of_errors_apart(name, label, owner):
    assert _owner_of(name, label) == owner


@pytest.mark.parametrize(("two", "advice"), [(False, "Complete the column"), (True, "Differences")])
def test_differences_of_two_postures_cannot_state_an_approach(two, advice):
    (effect,) = identified_effects(effect_plan("backlash").robot)
    found = condition_incomplete(effect, "approach", [3, 4], 2, 9, two_postures=two)
    assert found.text.startswith("2 of 9 readings (lines 3, 4) do not state")
    assert found.action.startswith(advice)
