"""Closing readings that differ from the first ones."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta

import numpy as np
import pytest
from effect_plans import FIRST, effect_plan
from models import TRUTH
from planned import quick_plan

from orthocal import check_session, join_sessions, load_session, simulate_session, write_session
from orthocal.assessment.repeated_readings import find_scattered
from orthocal.estimation.problem import build_problem
from orthocal.hypotheses.hypothesis import Rows
from orthocal.observation.gauge_noise import usual_difference
from orthocal.observation.observations import build_observations
from orthocal.session.session import Conditions, Gauge
from orthocal.statistics.noise import estimate_repeatability

KIND = "differing closing reading"
HOUR = timedelta(hours=1)


@pytest.fixture(scope="module")
def sound():
    """Planned readings with a closing reading in each setup, exactly repeated."""
    session = simulate_session(quick_plan().session, TRUTH, seed=3).session
    values = session.values
    for rows in Rows(session).setups.values():
        values[rows[-1]] = values[rows[0]]
    return session.with_values(values)


def with_closings(session, *differences):
    """Session whose first setups have closing readings that differ by these amounts, [m]."""
    values = session.values
    for rows, difference in zip(Rows(session).setups.values(), differences, strict=False):
        values[rows[-1]] = values[rows[0]] + difference
    return session.with_values(values)


@pytest.mark.parametrize(
    ("gauge", "largest"),
    [
        (Gauge(5e-6, 1e-5), 3e-5),  # 4 · √2 · 5.8 µm, in steps
        (Gauge(1e-6, 1e-5), 1e-5),
        (Gauge(5e-6), 4.0 * 2.0**0.5 * 5e-6),
        (Gauge(None, 1e-5), 3e-5),
        (Gauge(), 0.0),
    ],
)
def test_the_largest_usual_difference_is_a_multiple_of_the_resolution(gauge, largest):
    assert usual_difference(gauge) == pytest.approx(largest)


@pytest.mark.parametrize(
    ("differences", "named"), [((-0.03e-3,), 0), ((0.04e-3,), 1), ((0.04e-3, -0.04e-3), 2)]
)
def test_closing_readings_that_differ_are_named(sound, differences, named):
    session = with_closings(sound.with_values(sound.values + 0.11e-3), *differences)
    assessment = check_session(session)
    assert assessment.decision.verdict == ("review" if named else "enter")
    findings = assessment.of_kind(KIND)
    assert len(findings) == bool(named)
    for finding in findings:
        size = finding.numbers["largest_difference_mm"]
        assert size == pytest.approx(max(map(abs, differences)) * 1e3)
        assert {p.setup for p in finding.places} == set(list(session.setups)[:named])


def test_readings_of_which_most_closings_differ_scatter(sound):
    session = with_closings(sound, *(60e-6 * (-1) ** i for i in range(len(sound.setups))))
    (finding,) = find_scattered(session)
    assert finding.kind == "scattered repeats"


def test_two_readings_in_succession_have_no_closing_reading(sound):
    session = with_closings(sound, 0.06e-3)
    assert find_scattered(session)
    setup = session.readings[0].setup
    repeated = [i for i, r in enumerate(session.readings) if r.setup == setup]
    session = session.select([r for i, r in enumerate(session.readings) if i not in repeated[1:-1]])
    (finding,) = find_scattered(session)  # read twice in succession: nothing moved in between
    assert finding.kind == "scattered repeats"


def test_sound_sessions_have_no_finding():
    """The probability of one in 300 sessions of six setups is 11 %."""
    exact = simulate_session(quick_plan().session, TRUTH, exact=True).session
    assert exact.gauge.resolution is None
    noise = exact.gauge.sigma * np.random.default_rng(0).normal(size=(300, exact.values.size))
    for values in exact.values + noise:
        assert not find_scattered(exact.with_values(values))


def test_the_setup_is_read_again_unless_other_offsets_are_active(sound, tmp_path):
    write_session(with_closings(sound, 0.045e-3), tmp_path / "first")
    first = load_session(tmp_path / "first")
    line = first.readings[Rows(first).setups[first.readings[0].setup][-1]].line
    entered = simulate_session(
        quick_plan().session.with_controller(np.array([0.5e-3, -0.2e-3, 0.1e-3])), TRUTH, seed=4
    ).session
    for session, again in ((first, True), (join_sessions([first, entered]), False)):
        (finding,) = check_session(session).of_kind(KIND)
        assert (f"type `restart {line}`" in finding.action) == again
        assert ("omit the setup" in finding.action) != again


BACKLASHES = {"x_slide.backlash": 40e-6, "y_slide.backlash": 55e-6, "z_slide.backlash": 30e-6}


def read_with_effect(effect, cycles, gauge=None):
    """Session and observations of a plan, read in cycles at a temperature and an hour.

    The errors of the effect are their tolerances.
    """
    rng, plan = np.random.default_rng(3), effect_plan(effect)
    plan = plan.with_gauge(gauge or plan.gauge)
    readings = tuple(
        replace(r, cycle=cycle, conditions=Conditions(r.approach, celsius, FIRST + hour * HOUR))
        for cycle, (celsius, hour) in enumerate(cycles, start=1)
        for r in plan.readings
    )
    problem = build_problem(replace(plan, readings=readings), model="full", prior=True)
    theta = problem.active_theta.copy()
    for i, name in enumerate(problem.free):
        if name.endswith((".expansion", ".drift")):
            theta[i] += 2.0 * problem.theta_scale[i]
    noise = problem.session.gauge.sigma * rng.normal(size=problem.observations.size)
    rows = problem.observations.rows(problem.predict(theta) + noise)
    return problem.session.with_values(rows), problem.observations


def assert_scatter_is_noise(session, observations, *, within):
    """Repeats estimate the noise; the relative standard deviation of the estimate is 1/√(2 ν)."""
    sigma, dof = estimate_repeatability(session.values, observations)
    assert dof == 60  # each of 60 readings is repeated once
    assert sigma == pytest.approx(session.gauge.sigma, rel=within / np.sqrt(2.0 * dof))


@pytest.mark.parametrize("effect", ["thermal", "drift"])
def test_readings_under_conditions_on_which_the_model_depends_repeat_under_equal_ones(effect):
    """Differences by temperature or time are no scatter if an effect of the model causes them."""
    session, observations = read_with_effect(effect, [(19.0, 0), (29.0, 2)])
    assert estimate_repeatability(session.values, observations)[1] == 0
    assert find_scattered(session) == ()
    without = session.with_effects([])
    assert [f.kind for f in find_scattered(without)] == ["scattered repeats"]
    cycles = [(19.0, 2), (29.0, 0), (19.0, 2)]
    assert_scatter_is_noise(*read_with_effect(effect, cycles), within=2.1)


def test_readings_at_nearly_the_same_temperature_repeat_each_other():
    """Of 0.31 m of steel, 0.1 K changes 0.4 µm, far below the noise of a dial of 0.01 mm."""
    dial = Gauge(5e-6, 1e-5)
    for cycles in ([(20.0, 0), (20.1, 1)], [(20.1, 0), (29.0, 1), (20.0, 2)]):
        session, observations = read_with_effect("thermal", cycles, dial)
        assert_scatter_is_noise(session, observations, within=2.1)
        assert find_scattered(session) == ()
        places = observations.place.tolist()  # readings from another side never repeat
        approaches = [r.approach for r in session.readings]
        assert len(set(zip(places, approaches, strict=True))) == len(set(places))
    session, observations = read_with_effect("thermal", [(19.0, 0), (29.0, 1)], dial)
    assert estimate_repeatability(session.values, observations)[1] == 0
    # without the effect the temperature does not matter
    without = build_observations(session.with_effects([]))
    assert estimate_repeatability(session.values, without)[1] == 60
    # 0.1 K matters to a gauge of 0.1 µm
    session, observations = read_with_effect("thermal", [(20.0, 0), (20.1, 1)], Gauge(1e-7))
    assert estimate_repeatability(session.values, observations)[1] == 0
