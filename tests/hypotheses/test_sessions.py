"""Anomalies between joined sessions, and of sessions in unusual form."""

from __future__ import annotations

import re
import shlex
import tracemalloc
from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest
from calibrated import identified, plan_of
from effect_plans import effect_plan
from gauges import with_gauges
from made_mistakes import sound_session

from orthocal import (
    check_session,
    draw_errors,
    load_session,
    simulate_session,
    write_session,
)
from orthocal.assessment.judgement import judge_session
from orthocal.effects.compensation import JointTrim
from orthocal.errors import SessionError
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.hypotheses.families.sessions import enter_backlash_wrongly, enter_wrongly
from orthocal.hypotheses.family_scores import list_families
from orthocal.hypotheses.hypothesis import Rows
from orthocal.hypotheses.joined_sessions import divide_sessions
from orthocal.hypotheses.linear_model import LinearModel, linear_model
from orthocal.hypotheses.search import _nearly_as_likely, _Search, find_anomalies
from orthocal.measurement.joining import join_sessions
from orthocal.session.session import Conditions
from orthocal.text import uncapitalised

ENTERED = np.array([0.63e-3, 1.66e-3, -3.22e-3])
"""Offsets that the second session states, [m]."""


@pytest.fixture(scope="module")
def plan():
    return plan_of("workshop")


def measure_twice(plan, active, *, before=(0.0, 0.0, 0.0), changed=0.0, seed=1):
    """Two joined sessions of one machine with stated offsets: `before` in the first, `ENTERED` in
    the second one, while `active` are in the controller and the second drive has `changed`."""
    robot = plan.robot
    errors = draw_errors(robot, machine_errors(robot), seed=seed)
    names = [f"{d.name}.offset" for d in robot.drives]
    errors.update(zip(names, ENTERED + 10e-6, strict=True))
    second = dict(errors)
    for name, stated, value in zip(names, ENTERED, active, strict=True):
        second[name] += stated - value
    second[names[1]] += changed
    one = simulate_session(plan.with_controller(before), errors, seed=seed).session
    other = simulate_session(plan.with_controller(ENTERED), second, seed=seed + 100).session
    return join_sessions([one, other])


def test_a_drive_that_slipped_leads_to_the_offsets_of_the_present_machine(plan, tmp_path):
    """The stated offsets are right, so the new session alone is calibrated, as the action says."""
    parts = measure_twice(plan, ENTERED, changed=0.8e-3).parts
    paths = [write_session(part, tmp_path / f"day {k}").parent for k, part in enumerate(parts)]
    found = check_session(join_sessions([load_session(p) for p in paths]))
    (finding,) = found.of_kind("offset of one drive")
    assert found.decision.verdict == "review"
    assert "drive y_slide or its home switch moved by" in uncapitalised(finding.text)
    by, std = (finding.numbers[f"y_slide.offset_{what}_mm"] for what in ("by", "std"))
    assert abs(by - 0.8) < 3.0 * std < 0.2
    (command,) = re.findall(r"`orthocal (calibrate .*)`", finding.action)
    action, path, option, _ = shlex.split(command)
    assert (action, path, option) == ("calibrate", str(paths[1]), "--out")
    calibration = identified(load_session(path))
    after = ENTERED + 10e-6 + [0.0, 0.8e-3, 0.0]
    for drive, true in zip(plan.robot.drives, after, strict=True):
        (offset,) = [p for p in calibration.free if p.name == f"{drive.name}.offset"]
        assert abs(offset.value - true) < min(2.0 * offset.std, 0.4e-3)  # half of the slip


def test_readings_that_are_not_possible_do_not_end_the_search(plan, monkeypatch):
    """Where the tip would miss its rod after a change, which needs large offsets."""
    assemble = LinearModel._assemble

    def assemble_possible(self, theta, of_session, *predicted, **options):
        if of_session.any() and theta.any():
            raise SessionError("the predicted reading is not finite")
        return assemble(self, theta, of_session, *predicted, **options)

    session = measure_twice(plan, -ENTERED)
    monkeypatch.setattr(LinearModel, "_assemble", assemble_possible)
    explanations = [a.explanation for a in find_anomalies(session).found]
    (found,) = [e for e in explanations if e.kind.startswith("offsets")]
    assert found.kind == "offsets reversed"
    assert np.array(found.active) == pytest.approx(-ENTERED, abs=1e-9)


BEFORE = np.array([-0.5e-3, -1.0e-3, 0.3e-3])
"""Offsets that are active already when a machine is calibrated for the second time, [m]."""

WAYS = {
    "previous ones": ("offsets not entered", BEFORE),
    "none": ("offsets not entered", 0.0 * BEFORE),
    "sign": ("offsets reversed", -ENTERED),
    "sign of the change": ("offsets reversed", 2.0 * BEFORE - ENTERED),
    "twice": ("offsets entered twice", 2.0 * ENTERED),
    "added to the previous ones": ("offsets entered twice", BEFORE + ENTERED),
    "change added": ("offsets entered twice", 2.0 * ENTERED - BEFORE),
    "cyclic": ("offsets interchanged", ENTERED[[1, 2, 0]]),
}
"""Offsets in the controller instead of `ENTERED` where `BEFORE` were active."""


def enter(way, drives):
    active = ENTERED.copy()
    active[list(drives)] = WAYS[way][1][list(drives)]
    return active


@pytest.mark.parametrize(
    ("before", "active", "kind", "drives"),
    [
        (0.0 * BEFORE, ENTERED[[0, 2, 1]], "offsets interchanged", (1, 2)),
        (0.0 * BEFORE, np.add(ENTERED, (0.0, 0.8e-3, 0.0)), "offset of one drive", (1,)),
        (BEFORE, enter("sign of the change", (0, 2)), "offsets reversed", (0, 2)),
        (BEFORE, enter("change added", (0, 1, 2)), "offsets entered twice", (0, 1, 2)),
    ],
)
def test_offsets_that_are_not_as_stated_are_named(plan, before, active, kind, drives):
    found = find_anomalies(measure_twice(plan, active, before=before))
    (anomaly,) = found.found
    e = anomaly.explanation
    assert (e.kind, e.sessions) == (kind, ("session-2",))
    assert e.drives == tuple(plan.robot.drives[i].name for i in drives)
    if e.active:
        assert np.array(e.active) == pytest.approx(active, abs=1e-9)
    else:  # the change of the machine that has the same effect
        assert e.amount == pytest.approx(-0.8e-3, abs=0.2e-3)
    assert found.explained


@pytest.mark.parametrize("drives", [(1,), (0, 2), (0, 1, 2)])
def test_each_way_is_considered_for_some_drives_and_for_all(drives):
    considered = list(enter_wrongly(BEFORE, ENTERED))
    for way, (kind, _) in WAYS.items():
        if way == "cyclic" and len(drives) < 3:
            continue
        active = enter(way, drives)
        (found,) = [(k, d) for k, d, c in considered if np.allclose(c, active, atol=1e-9)]
        assert found == (kind, drives)


def test_wrong_offsets_are_listed_once():
    before, stated = np.zeros(3), np.array([1e-3, 1e-3, 2e-3])
    ways = list(enter_wrongly(before, stated))
    entered = {tuple(np.round(c, 9)) for _, _, c in ways}
    assert len(entered) == len(ways)
    assert tuple(stated) not in entered
    assert {kind for kind, _, _ in ways} == {kind for kind, _ in WAYS.values()}
    assert list(enter_wrongly(before, before)) == []


@pytest.fixture(scope="module")
def sided():
    plan = effect_plan("backlash")
    return plan.with_gauge(replace(plan.gauge, sigma=5e-6, resolution=10e-6))


def compensate(plan, backlash, parts, *, seed=1):
    """Session of a machine whose controller compensates these parts of the stated backlash."""
    errors = draw_errors(plan.robot, machine_errors(plan.robot), seed=1)
    errors |= {f"{d.name}.offset": 0.0 for d in plan.robot.drives}
    errors |= {f"{d.name}.backlash": backlash for d in plan.robot.drives}
    active = tuple(JointTrim(backlash * p) for p in parts)
    session = simulate_session(replace(plan, compensation=active), errors, seed=seed).session
    return replace(session, compensation=(JointTrim(backlash),) * len(active))


@pytest.mark.parametrize(
    ("parts", "kind"),
    [((0.5, 0.5, 0.5), "backlash halved"), ((2.0, 2.0, 2.0), "backlash entered twice")],
)
def test_backlash_that_the_controller_does_not_compensate_as_stated_is_named(sided, parts, kind):
    first = replace(compensate(sided, 0.12e-3, (0.0, 0.0, 0.0)), compensation=())
    second = compensate(sided, 0.12e-3, parts, seed=2)
    (found,) = find_anomalies(join_sessions([first, second])).found
    e = found.explanation
    assert (e.kind, e.sessions, found.alternatives) == (kind, ("session-2",), ())
    assert e.drives == tuple(f"{d}_slide" for d in "xyz")
    assert e.active == pytest.approx(np.multiply(parts, 0.12e-3))


def test_a_single_session_shows_a_large_backlash_that_was_not_entered(sided):
    """The machine is sound if the controller compensates it, although it exceeds its tolerance."""
    size = 0.14e-3
    table = np.array([[-0.2, size / 2, -size / 2], [0.4, size / 2, -size / 2]])
    stated = JointTrim(table=table)

    def judge(parts):
        session = compensate(sided, size, parts)
        return judge_session(replace(session, compensation=(stated,) * 3)).findings

    assert {f.severity for f in judge((1.0, 1.0, 1.0))} <= {"note"}
    (found,) = (f for f in judge((0.0, 0.0, 0.0)) if f.severity != "note")
    assert found.kind == "backlash not entered"
    assert found.text == (
        "The controller does not compensate the stated backlash of x_slide, y_slide and z_slide, "
        "or the backlash is twice the stated one."
    )
    assert {p.parameter for p in found.places} == {"x_slide", "y_slide", "z_slide"}


def test_each_wrong_backlash_is_considered_once():
    """A part of the drives, all of them, none entered or the previous ones, half or twice."""
    found = list(enter_backlash_wrongly(np.array([0.0, 2e-5]), np.array([4e-5, 6e-5])))
    assert [(k, d, np.round(a, 9).tolist()) for k, d, a in found] == [
        ("backlash not entered", (0, 1), [0.0, 2e-5]),
        ("backlash not entered", (0,), [0.0, 6e-5]),
        ("backlash not entered", (1,), [4e-5, 2e-5]),
        ("backlash not entered", (0, 1), [0.0, 0.0]),
        ("backlash not entered", (1,), [4e-5, 0.0]),
        ("backlash halved", (0, 1), [2e-5, 3e-5]),
        ("backlash halved", (0,), [2e-5, 6e-5]),
        ("backlash halved", (1,), [4e-5, 3e-5]),
        ("backlash entered twice", (0, 1), [8e-5, 12e-5]),
        ("backlash entered twice", (0,), [8e-5, 6e-5]),
        ("backlash entered twice", (1,), [4e-5, 12e-5]),
    ]


def test_the_order_of_rows_does_not_change_a_reversed_sign(raw_cycles):
    session = raw_cycles.select([r for r in raw_cycles.readings if r.cycle <= 2])
    values = session.values
    row = next(i for i, r in enumerate(session.readings) if r.value > 0.4e-3 and r.cycle == 2)
    values[row] *= -1.0
    session = session.with_values(values)
    order = np.random.default_rng(3).permutation(len(values))
    shuffled = replace(session, readings=tuple(session.readings[i] for i in order))
    one, other = find_anomalies(session), find_anomalies(shuffled)
    (first,), (second,) = one.found, other.found
    assert first.explanation.kind == second.explanation.kind == "reversed sign"
    assert first.explanation.rows[0] == order[second.explanation.rows[0]]
    assert second.log_evidence == pytest.approx(first.log_evidence, abs=1e-6)
    assert second.expected == pytest.approx(first.expected, abs=1e-9)


def test_the_readings_of_an_unfinished_session_are_searched(raw_cycles):
    session = raw_cycles
    half = session.select(session.readings[: len(session.readings) // 2])
    assert find_anomalies(half).found == ()
    values = half.values
    values[5] += 1e-3
    (anomaly,) = find_anomalies(half.with_values(values)).found
    assert anomaly.explanation.rows == (5,)
    for count in (1, 2, 3):
        assert find_anomalies(session.select(session.readings[:count])).found == ()


def test_one_reversed_reading_of_three_is_no_reversed_setup(plan):
    for seed, row in ((0, 13), (1, 3)):
        session = sound_session(plan, seed, entered=False)
        values = session.values
        values[row] *= -1.0
        found = find_anomalies(session.with_values(values)).found
        assert [(a.explanation.rows, a.explanation.setups) for a in found] == [((row,), ())]


def test_readings_are_compared_with_the_noise_of_their_gauge(raw_cycles):
    """A coarse gauge does not show a change of 0.1 mm; gauges of other setups are fine."""
    coarse = replace(raw_cycles.gauge, sigma=0.2e-3, resolution=0.1e-3)
    fine = replace(raw_cycles.gauge, sigma=2e-6, resolution=1e-6)
    _, *others = raw_cycles.setups
    values = raw_cycles.values
    values[0] += 0.1e-3
    for gauges in ({"coarse": coarse, "fine": fine}, {"fine": fine, "coarse": coarse}):
        mixed = with_gauges(raw_cycles, gauges, others)
        assert mixed.readings[0].setup not in others
        found = find_anomalies(mixed.with_values(values)).found
        assert not any(0 in a.explanation.rows for a in found)


@pytest.fixture(scope="module")
def days(raw_cycles):
    """Two sessions of one machine, with a closing reading of each setup."""
    rows = [r for r in raw_cycles.readings if r.cycle == 1 or (r.cycle, r.posture) == (2, "zero")]
    plan = raw_cycles.select(rows)
    errors = draw_errors(raw_cycles.robot, machine_errors(raw_cycles.robot), seed=4)
    return [simulate_session(plan, errors, seed=seed).session for seed in (4, 5)]


def test_a_displaced_gauge_is_named_beside_another_session(days):
    """The closing reading that differs does not count as noise."""
    values = days[0].values
    rows = [i for i, r in enumerate(days[0].readings) if r.setup == "xy"][-2:]
    values[rows] += 0.3e-3
    sessions = [days[0].with_values(values), days[1]]
    (found,) = find_anomalies(join_sessions(sessions)).found
    e = found.explanation
    assert (e.kind, {a.kind for a in found.alternatives}) == ("displaced gauge", set())
    assert list(e.rows) == rows
    assert e.amount == pytest.approx(0.3e-3, abs=0.05e-3)


def test_a_gauge_with_more_noise_than_stated_is_no_change_of_the_machine(days):
    values = days[0].values
    values += 5.0 * days[0].gauge.sigma * np.random.default_rng(1).normal(size=values.size)
    sessions = [days[0].with_values(values), days[1]]
    found = find_anomalies(join_sessions(sessions[::-1]))
    assert (found.found, found.explained) == ((), True)


def test_a_gauge_without_readings_is_not_that_of_the_readings(days):
    gauges = {"fine": replace(days[0].gauge, sigma=1e-7, resolution=None), **days[0].gauges}
    session = replace(days[0], gauges=gauges)
    assert session.gauge == days[0].gauge
    assert LinearModel(session).sigma == LinearModel(days[0]).sigma


def read_often(session, count, rng):
    """The first setup of a session, read `count` times with noise of 10 µm."""
    setup = session.readings[0].setup
    once = [r for r in session.readings if r.setup == setup and r.cycle == 1]
    readings = [replace(r, cycle=c + 1) for c in range(count // len(once)) for r in once]
    large = session.select(readings)
    return large.with_values(large.values + 1e-5 * rng.normal(size=count))


def test_a_dial_that_is_stuck_for_many_readings_is_one_finding(raw_cycles):
    """The first reading of the run counts, and all others have no information."""
    session = read_often(raw_cycles, 60, np.random.default_rng(0))
    values = session.values
    values[10:50] = values[10]
    found = find_anomalies(session.with_values(values)).found
    assert [(a.explanation.kind, a.explanation.rows) for a in found] == [
        ("stuck dial", tuple(range(10, 50)))
    ]


@pytest.mark.slow
def test_memory_is_linear_in_the_readings(raw_cycles):
    """All families consider all readings of a setup. The first search fills caches."""
    rng, peaks = np.random.default_rng(0), []
    find_anomalies(read_often(raw_cycles, 30, rng))
    for count in (90, 180):
        large = read_often(raw_cycles, count, rng)
        values = large.values
        values[count // 3] += 1e-3
        tracemalloc.start()
        found = find_anomalies(large.with_values(values))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert [a.explanation.rows for a in found.found] == [(count // 3,)]
    assert peaks[1] < 2.1 * peaks[0]


def test_a_change_that_may_be_zero_is_no_cause(plan):
    """Slide y moved, and slide z did not: a set with both is no alternative, however likely."""
    session = measure_twice(plan, ENTERED, changed=0.3e-3)
    search = _Search(session, linear_model(session))
    families = list_families(search.model, Rows(session), grouped=False)
    terms = [(f, h, f.explain(h)) for f in families if not f.known for h in range(f.count)]
    drives = {
        e.drives: search.scorer.term(f, h) for f, h, e in terms if e.kind == "offset of one drive"
    }
    moved, other = drives["y_slide",], drives["z_slide",]
    alone, both = search.sets.evaluate_all([(moved,), (moved, other)], search.sound.about)
    assert abs(alone.amounts[0][0]) > 2.0 * alone.stds[0][0]
    assert abs(both.amounts[1][0]) < 2.0 * both.stds[1][0]
    likely = replace(both, score=replace(both.score, log_likelihood=alone.score.log_likelihood))
    likely = replace(likely, terms=(moved, replace(other, prior=0.0)))
    assert likely.log_posterior == alone.log_posterior
    assert _nearly_as_likely([alone, likely], [alone, likely]) == [alone]


def test_no_machine_changes_by_a_hundred_tolerances(plan):
    """Readings of the second session that a change of 200 prior standard deviations explains."""
    session, tilt = measure_twice(plan, ENTERED, seed=0), "y_slide.rz"
    model = LinearModel(session)
    column = model.at_reference(keep_jacobian=True).jacobian[:, model.problem.free.index(tilt)]
    values = session.values + 200.0 * np.where(model.sessions.of_entry == 1, column, 0.0)
    explanations = [a.explanation for a in find_anomalies(session.with_values(values)).found]
    sizes = [abs(e.amount) for e in explanations if e.kind == "machine changed"]
    assert sizes
    assert max(sizes) < 100.0 * plan.robot.parameters[tilt].prior_std


def test_the_order_in_which_sessions_are_joined_does_not_matter(plan):
    """Offsets of 5 mm, entered and corrected; slide y is displaced before the last session."""
    large = np.array([3.4e-3, -5.1e-3, 4.2e-3])
    wide = plan.with_tolerances({"*.offset_mm": 4.0})
    errors = draw_errors(wide.robot, machine_errors(wide.robot), seed=0)
    errors.update(zip((f"{d.name}.offset" for d in wide.robot.drives), large, strict=True))
    moved = errors | {"y_slide.offset": large[1] + 0.6e-3}
    machines = ((0.0, errors), (0.97, errors), (1.0, errors), (1.0, moved))
    first, second, third, last = (
        simulate_session(wide.with_controller(share * large), machine, seed=seed).session
        for seed, (share, machine) in enumerate(machines)
    )
    assert not find_anomalies(join_sessions([second, first])).found
    (anomaly,) = find_anomalies(join_sessions((last, first, third))).found
    assert anomaly.explanation.sessions == ("session-1",)
    assert anomaly.explanation.amount == pytest.approx(0.6e-3, abs=0.1e-3)


def at(session, day):
    conditions = Conditions(time=datetime(2026, 1, day))
    return session.select([replace(r, conditions=conditions) for r in session.readings])


def test_sessions_are_in_the_order_of_their_times(plan):
    """Without times, or at equal ones, those without active offsets come first."""
    sessions = [plan.with_controller(v) for v in (ENTERED, 0.0 * ENTERED, ENTERED)]
    assert LinearModel(join_sessions(sessions)).sessions.order.tolist() == [1, 0, 2]
    timed = [at(s, day) for s, day in zip(sessions, (3, 2, 1), strict=True)]
    assert LinearModel(join_sessions(timed)).sessions.order.tolist() == [2, 1, 0]
    equal = [at(s, 1) for s in sessions]
    assert LinearModel(join_sessions(equal)).sessions.order.tolist() == [1, 0, 2]


@pytest.mark.parametrize(("days", "backlash"), [((1, 2), 0.0), ((), 0.01e-3)])
def test_sessions_in_another_order_are_found(plan, days, backlash):
    """The later one by its times, which is certain, or the one that states active offsets."""
    timed = days == (1, 2)
    plan = replace(plan, compensation=(JointTrim(backlash),) * 3)
    sessions = [
        simulate_session(plan.with_controller(v), {}, seed=k).session
        for k, v in enumerate((0.0 * ENTERED, 0.0 * ENTERED if timed else ENTERED))
    ]
    if days:
        sessions = [at(s, day) for s, day in zip(sessions, days, strict=True)]
    for given, notes in ((sessions, []), (sessions[::-1], ["session-1"])):
        found = [f for f in judge_session(join_sessions(given)).findings if f.kind == "wrong order"]
        assert [f.severity for f in found] == ["review" if timed else "note"] * len(notes)
        assert all(f"session {name} " in f.action for f, name in zip(found, notes, strict=True))


def test_few_sessions_are_divided_in_all_ways():
    steps = [(later, apart) for later, apart in divide_sessions(np.array([0, 1, 2, 3]))]
    assert [later for later, apart in steps if not apart] == [[1, 2, 3], [2, 3], [3]]
    assert [later for later, apart in steps if apart] == [[1], [2], [0, 2], [0, 3]]


def test_a_mistake_casts_no_doubt_on_the_other_session(plan):
    """A second mistake needs clear evidence against the likeliest machine with the first one."""
    sessions = [simulate_session(plan, {"x_slide.offset": 0.5e-3}, seed=k).session for k in (4, 5)]
    values = sessions[0].values.copy()
    values[4] += 0.7e-3
    (found,) = find_anomalies(join_sessions([sessions[0].with_values(values), sessions[1]])).found
    assert found.explanation.rows == (4,)
