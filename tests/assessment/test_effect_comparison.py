"""Comparison of effects: evidence, omitted setups, and the recommendation."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from datetime import timedelta

import numpy as np
import pytest
from calibrated import SOUND, UNJUDGED, session_of
from effect_plans import ALL, FEW, FIRST, effect_plan
from gauges import with_gauges
from slack import Slack

from orthocal import calibrate, simulate_session
from orthocal.assessment.comparison import compare_models
from orthocal.assessment.effect_comparison import compare_effects
from orthocal.assessment.recommendation import STRONG
from orthocal.assessment.words.comparison import describe_effects
from orthocal.effects import registry
from orthocal.effects.registry import order_effects
from orthocal.estimation.options import SolverOptions
from orthocal.hypotheses.linear_model import LinearModel
from orthocal.session.session import Gauge

pytestmark = pytest.mark.usefixtures("module_of_few_tool_points")

QUICK = SolverOptions("variable-projection")
ERRORS = {"x_slide.offset": 0.1e-3, "y_leg.length": 40e-6, "y_slide.backlash": 50e-6}


@pytest.fixture(scope="module")
def session():
    return simulate_session(effect_plan("backlash", setups=FEW), ERRORS, seed=4).session


@pytest.fixture(scope="module")
def compared(session):
    return compare_effects(session.with_effects(["backlash"]))


def test_stated_effects_are_recommended_and_the_visible_one_is_named(session):
    found = compare_effects(session.with_effects(None))
    assert found.recommended == found.stated == ALL
    assert found.shown == ("backlash",)
    alone = [tuple(e for e in ALL if e != name) for name in ALL]
    assert [w.effects for w in found.weighed] == [(), ALL, *alone]
    assert found.best.log_evidence > 10.0
    assert found.best.prediction_rms < found.weighed[0].prediction_rms
    assert found.weighed[0].log_evidence == 0.0


def test_candidates_are_those_chosen(session):
    found = compare_effects(session.with_effects(["thermal"]))
    assert [w.effects for w in found.weighed] == [(), ("thermal",)]
    assert (found.recommended, found.shown) == (("thermal",), ())
    assert compare_effects(session.with_effects([])) is None


def test_a_machine_without_effects_shows_none():
    errors = {n: v for n, v in ERRORS.items() if "backlash" not in n}
    plan = effect_plan(setups=FEW)
    session = simulate_session(plan, errors, seed=4).session.with_effects(["backlash", "drift"])
    assert compare_effects(session).shown == ()


def test_an_effect_whose_values_are_entered_is_recommended():
    """The evidence is about all drives together and weak; one drive has a determined backlash."""
    plan = effect_plan("backlash")
    plan = plan.with_gauge(replace(plan.gauge, sigma=6e-6))
    session = simulate_session(plan, {"y_slide.backlash": 20e-6}, seed=4, sigma=6e-6).session
    found = compare_effects(session)
    assert found.best.log_evidence < STRONG
    assert (found.recommended, found.shown) == (("backlash",), ())
    entries = calibrate(session, "full", **UNJUDGED).assessment.backlash
    assert [bool(e.change) for e in entries] == [False, True, False]


def test_an_effect_that_cannot_act_does_not_change_the_evidence(session):
    """Drift within seconds. The scatter of repeated readings shows the noise of two gauges."""
    rows = []
    for name in session.setups:
        of_setup = [r for r in session.readings if r.setup == name]
        rows += [*of_setup, *(replace(of_setup[0], cycle=k) for k in (2, 3, 4))]
    timed = [
        replace(r, conditions=replace(r.conditions, time=FIRST + timedelta(seconds=k)))
        for k, r in enumerate(rows)
    ]
    gauges, (_, *others) = {"coarse": Gauge(2e-6), "fine": Gauge(1e-6)}, session.setups
    plan = with_gauges(replace(session, readings=tuple(timed)), gauges, others)
    noisy = simulate_session(plan, ERRORS, seed=4).session
    values = noisy.values
    values[[r.cycle == 2 for r in noisy.readings]] += 6e-6  # above the stated noise
    found = compare_effects(noisy.with_values(values).with_effects(["backlash", "drift"]))
    by_effects = {w.effects: w.log_evidence for w in found.weighed}
    assert found.shown == ("backlash",)
    assert by_effects["backlash",] > 10.0
    assert by_effects["backlash", "drift"] == pytest.approx(by_effects["backlash",], abs=0.05)
    assert by_effects["drift",] == pytest.approx(0.0, abs=0.05)


@pytest.fixture
def slack():
    registry.register_effect(Slack)
    truth = {"y_leg.length": 40e-6, "x_slide.slack": 30e-6, "y_slide.slack": 50e-6}
    machine = effect_plan(keys="thermal: {}", setups=FEW).with_effects(["slack"])
    yield simulate_session(machine, truth, seed=4).session.with_effects(None)
    registry.unregister_effect("slack")


def test_an_effect_of_another_package_is_compared_like_those_of_orthocal(slack):
    """Its parameters explain backlash, and the periodic errors of the screws besides."""
    found = compare_effects(slack)
    assert {"backlash", "thermal", "drift", "slack"} <= {
        n for w in found.weighed for n in w.effects
    }
    assert found.stated == ("thermal",)
    assert found.recommended == ("thermal", "slack")
    assert found.shown == ("slack",)
    assert found.best.log_evidence > 10.0
    (note, *_) = describe_effects(found, 40)
    assert "--effects thermal,slack`" in note.action


def test_effects_are_compared_only_where_all_conditions_are_stated(session):
    assert compare_effects(session_of("raw-cycles")) is None
    first = replace(session.readings[3], conditions=None)
    readings = (*session.readings[:3], first, *session.readings[4:])
    found = compare_effects(replace(session, readings=readings).with_effects(["backlash"]))
    assert found.weighed == ()
    assert found.lacking["backlash"][0] == 1


def test_omitted_setups_are_predicted_by_conditioning(session):
    model = LinearModel(session)
    near = model.most_likely(session.values)
    about = model.linearise(near.theta, (), near.passive, keep_jacobian=True)
    deviation = model.entries(session.values[None])[0] - about.expected
    joint = about.jacobian @ about.jacobian.T + model.sigma**2 * np.eye(deviation.size)
    setups = model.problem.observations.setup
    for setup in np.unique(setups):
        out = setups == setup
        gain = np.linalg.solve(joint[np.ix_(~out, ~out)], deviation[~out])
        expected = deviation[out] - joint[np.ix_(out, ~out)] @ gain
        assert model.predict_left_out(session.values)[out] == pytest.approx(expected, abs=1e-10)


@pytest.mark.parametrize(
    ("stated", "option"),
    [(("backlash",), ""), (("thermal",), "backlash,thermal"), ((), "backlash")],
)
def test_the_option_is_named_unless_the_effect_is_stated(compared, stated, option):
    """It includes the stated effects, because it replaces their choice."""
    recommended = order_effects({*stated, "backlash"})
    (note, *_) = describe_effects(replace(compared, stated=stated, recommended=recommended), 40)
    assert note.kind == "effects recommended"
    assert re.findall(r"--effects (\S+)`", note.action) == ([option] if option else [])


def test_a_comparison_of_models_recommends_the_effect(session):
    found = compare_models(
        session.with_effects(["backlash"]), models=["offsets"], options=QUICK, judgement=SOUND
    )
    (note,) = found.assessment.of_kind("effects recommended")
    assert note.action == ""
    assert note.numbers["log_evidence"] > 10.0
    assert found.assessment.decision.verdict == "enter"
    document = json.loads(found.to_json())["effects"]
    assert document["recommended"] == document["stated"] == document["shown"] == ["backlash"]
    assert len(document["weighed"]) == 2
