"""Effects in the model that the readings do not show or do not separate."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from datetime import timedelta

import numpy as np
import pytest
from effect_plans import FIRST, effect_plan

from orthocal import SessionError, calibrate, check_session, simulate_session
from orthocal.assessment.effect_limits import DETERMINED
from orthocal.assessment.effect_separability import MAX_R_SQUARED, WARMER, find_unshown_effects
from orthocal.estimation.problem import CalibrationProblem
from orthocal.estimation.selection import select_parameters
from orthocal.output.text.answer import render_decision
from orthocal.output.text.layout import to_text
from orthocal.statistics.zeros import project_out_zeros


@pytest.fixture(scope="module")
def plan():
    return effect_plan()


def under(session, change):
    readings, counts = [], Counter()
    for i, r in enumerate(session.readings):
        changed = replace(r, conditions=change(i, r.conditions))
        counts[changed.place] += 1
        readings.append(replace(changed, cycle=counts[changed.place]))
    return replace(session, readings=tuple(readings))


def find(session, effects):
    return find_unshown_effects(session.with_effects(effects))


def test_effects_that_the_readings_show_have_no_finding(plan):
    assert find(plan, []) == []
    assert find(plan, ["backlash"]) == []
    assert find(plan, ["backlash", "drift"]) == []


def test_an_approach_from_one_side_is_one_note(plan):
    one = under(plan, lambda _, c: replace(c, approach=f"p{c.approach[1:]}"))
    (found,) = find(one, ["backlash"])
    assert (found.kind, found.severity) == ("effect not shown", "note")
    assert [p.parameter for p in found.places] == ["x_slide"]
    session = simulate_session(one.with_effects(["backlash"]), {"x_slide.backlash": 0.1e-3}).session
    assessment = check_session(session)
    assert len(assessment.of_kind("effect not shown")) == 1
    assert assessment.decision.verdict == "enter"


def test_common_approach_of_a_plan_is_a_detail(plan):
    session = under(plan, lambda _, c: replace(c, approach="ppp")).with_effects(["backlash"])
    assessment = check_session(simulate_session(session, {}).session)
    assert len(assessment.of_kind("common approach")) == 1
    short, long = (to_text(render_decision(assessment, details=d)) for d in (False, True))
    assert ("same side" in short, "same side" in long) == (False, True)


def test_readings_without_conditions_show_no_effect(plan):
    bare = replace(plan, readings=tuple(replace(r, conditions=None) for r in plan.readings[::2]))
    kinds = [f.kind for f in find(bare, ["backlash", "thermal"])]
    assert kinds[:2] == ["effect not shown"] * 2


def test_readings_without_approach_are_counted_with_their_lines(plan):
    rows = [replace(r, line=i + 2) for i, r in enumerate(plan.readings)]
    for i in (3, 4, 5, 9):
        rows[i] = replace(rows[i], conditions=replace(rows[i].conditions, approach=None))
    (found, *_) = find(replace(plan, readings=tuple(rows)), ["backlash"])
    assert found.numbers == {"missing": 4.0}
    assert f"4 of {len(rows)} readings (lines 5 to 7, 11) do not state" in found.text
    assert "`approach`" in found.action


@pytest.mark.parametrize(
    ("effect", "missing", "change"),
    [
        ("backlash", 60.0, lambda i, c: replace(c, approach=f"u{c.approach[1:]}")),
        (
            "backlash",
            59.0,
            lambda i, c: replace(c, approach=f"{'u' if i else 'p'}{c.approach[1:]}"),
        ),
        ("thermal", 57.0, lambda i, c: replace(c, temperature=20.0 if i < 3 else None)),
        ("thermal", 60.0, lambda i, c: replace(c, temperature=None)),
    ],
)
def test_only_conditions_of_all_readings_are_called_equal(plan, effect, missing, change):
    """`calibrate` refuses the others."""
    session = under(plan, change)
    (found,) = (f for f in find(session, [effect]) if f.kind == "effect not shown")
    assert found.numbers == {"missing": missing}
    with pytest.raises(SessionError, match=f"which {missing:.0f} of 60 readings do not state"):
        calibrate(session.with_effects([effect]))


@pytest.mark.parametrize(("sigma", "helps"), [(20e-6, False), (1e-6, True)])
def test_another_temperature_is_recommended_only_where_it_determines_more(plan, sigma, helps):
    """By the posterior limit of the coefficients relative to their tolerance, as in a plan."""
    session = under(plan, lambda _, c: replace(c, temperature=22.0)).with_gauge(
        replace(plan.gauge, sigma=sigma)
    )
    (found,) = (f for f in find(session, ["thermal"]) if f.kind == "effect not shown")
    assert bool(found.action) is bool(found.places) is helps
    setup = session.readings[0].setup
    again = [
        replace(r, cycle=9, conditions=replace(r.conditions, temperature=22.0 + WARMER))
        for r in session.readings
        if r.setup == setup
    ]
    both = replace(session, readings=(*session.readings, *again)).with_effects(["thermal"])
    selection = select_parameters(both.robot.parameters, model="full", prior=True)
    problem = CalibrationProblem(both, selection)
    _, jacobian = problem.predict_and_jacobian(problem.active_theta)
    slopes = project_out_zeros(jacobian, problem.observations)
    covariance = np.linalg.inv(slopes.T @ slopes / sigma**2 + np.diag(problem.prior_precision))
    grown = [problem.free.index(n) for n in ("legs.expansion", "screws.expansion")]
    assert bool(max(np.sqrt(np.diag(covariance)[grown])) < DETERMINED) is helps


def test_temperature_and_drift_that_grow_together_are_not_separated(plan):
    kept = plan.select([r for r in plan.readings if r.posture == f"{r.setup[1]}_60"])
    rows = [replace(r, cycle=r.cycle + 2 * k) for k in range(3) for r in kept.readings]
    rows.sort(key=lambda r: r.setup)
    repeated = replace(kept, readings=tuple(rows))
    together = under(
        repeated,
        lambda i, c: replace(c, temperature=20.0 + 0.2 * i, time=FIRST + timedelta(minutes=i)),
    )
    found = [f for f in find(together, ["thermal", "drift"]) if f.kind == "effects inseparable"]
    names = [{p.parameter for p in f.places} for f in found]
    assert any({"legs.expansion", "setup.yx.drift"} <= n for n in names)
    rng = np.random.default_rng(1)
    apart = under(together, lambda i, c: replace(c, temperature=20.0 + float(rng.normal())))
    found = [f for f in find(apart, ["thermal", "drift"]) if f.kind == "effects inseparable"]
    assert not any("setup.yx.drift" in {p.parameter for p in f.places} for f in found)


def test_expansions_of_legs_and_screws_are_inseparable(plan):
    """By the correlation of both columns under all other errors, from the covariance itself."""
    (found,) = find(plan, ["thermal"])
    assert {p.parameter for p in found.places} == {"legs.expansion", "screws.expansion"}
    session = plan.with_effects(["thermal"])
    selection = select_parameters(session.robot.parameters, model="full", prior=True)
    problem = CalibrationProblem(session, selection)
    _, jacobian = problem.predict_and_jacobian(problem.active_theta)
    jacobian = project_out_zeros(jacobian, problem.observations)
    pair = [problem.free.index(n) for n in ("legs.expansion", "screws.expansion")]
    others = np.delete(jacobian, pair, axis=1)
    weight = np.linalg.inv(others @ others.T + plan.gauge.sigma**2 * np.eye(len(others)))
    a = jacobian[:, pair].T @ weight @ jacobian[:, pair]
    assert a[0, 1] ** 2 / (a[0, 0] * a[1, 1]) > MAX_R_SQUARED
