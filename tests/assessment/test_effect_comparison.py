"""Effects weighed by the readings: evidence, left-out setups, and what is recommended."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from commands import run_orthocal
from effect_plans import write_plan
from slack import Slack, SlackKeys

from orthocal import calibrate, load_plan, load_session, simulate_session, write_session
from orthocal.assessment.comparison import compare_models
from orthocal.assessment.effect_comparison import compare_effects
from orthocal.assessment.words.comparison import describe_effects
from orthocal.calibration.assessment_record import EXIT_CODES
from orthocal.effects import registry
from orthocal.estimation.options import SolverOptions
from orthocal.hypotheses.linear_model import LinearModel

QUICK = SolverOptions("variable-projection")
ERRORS = {"x_slide.offset": 0.1e-3, "y_leg.length": 40e-6, "y_slide.backlash": 50e-6}


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    folder = tmp_path_factory.mktemp("weighed") / "plan"
    plan = load_plan(write_plan(folder, effects="screw: {lead_mm: 10}")).with_effects([])
    return plan.select([r for r in plan.readings if r.setup in ("yx", "xy", "xz")])


@pytest.fixture(scope="module")
def session(plan):
    """A machine with backlash; its robot has the effects of its YAML."""
    return simulate_session(plan.with_effects(["backlash"]), ERRORS, seed=4).session


def test_the_supported_effect_is_recommended(session):
    found = compare_effects(session.with_effects(None))
    assert found.recommended == ("backlash",)
    assert [w.effects for w in found.weighed[:5]] == [
        (), *((n,) for n in ("screw", "backlash", "thermal", "drift")),
    ]  # fmt: skip
    assert found.best.log_evidence > 10.0
    assert found.best.unseen_rms < found.weighed[0].unseen_rms
    assert found.weighed[0].log_evidence == 0.0


def test_candidates_are_those_chosen(session):
    found = compare_effects(session.with_effects(["thermal"]))
    assert [w.effects for w in found.weighed] == [(), ("thermal",)]
    assert found.recommended == ()
    assert compare_effects(session.with_effects([])) is None


def test_a_machine_without_effects_needs_none(plan):
    errors = {n: v for n, v in ERRORS.items() if "backlash" not in n}
    session = simulate_session(plan, errors, seed=4).session.with_effects(None)
    assert compare_effects(session).recommended == ()


@pytest.fixture
def slack(tmp_path):
    """Readings of a machine with an effect of another package, whose YAML does not name it."""
    registry.register_effect(Slack)
    plan = load_plan(write_plan(tmp_path / "plan", effects="thermal: {}"))
    plan = plan.select([r for r in plan.readings if r.setup in ("yx", "xy", "xz")])
    truth = {"y_leg.length": 40e-6, "x_slide.slack": 30e-6, "y_slide.slack": 50e-6}
    machine = plan.with_effects(["slack"])
    yield simulate_session(machine, truth, seed=4).session.with_effects(None)
    registry.unregister_effect("slack")


def test_an_effect_of_another_package_is_weighed_like_those_of_orthocal(slack):
    """It explains what backlash explains, and the waves of the screws besides."""
    bare = slack.with_effects(["slack"])
    found = compare_effects(bare)
    assert [w.effects for w in found.weighed] == [(), ("slack",)]
    assert found.recommended == ("slack",)
    assert found.best.log_evidence > 10.0
    assert set(found.named) == {e.name for e in Slack.from_keys(SlackKeys(), bare.robot).errors}
    (note, *_) = describe_effects(found, 40)
    assert "--effects slack --model full --free '" in note.action
    every = compare_effects(slack)
    alone = {w.effects: w.log_evidence for w in every.weighed if len(w.effects) < 2}
    assert {("backlash",), ("thermal",), ("drift",), ("slack",)} < set(alone)
    assert alone[("slack",)] == pytest.approx(found.best.log_evidence, abs=0.5)


def test_readings_without_conditions_are_not_weighed(root, session):
    assert compare_effects(load_session(root / "examples/raw-cycles")) is None
    first = replace(session.readings[3], conditions=None)
    readings = (*session.readings[:3], first, *session.readings[4:])
    found = compare_effects(replace(session, readings=readings).with_effects(["backlash"]))
    assert found.weighed == ()
    assert found.lacking["backlash"][0] == 1


def test_left_out_setups_are_predicted_as_by_conditioning(session):
    """Against the conditional mean of the joint normal distribution of all entries."""
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


def test_comparison_and_calibration_have_the_same_verdict(session, tmp_path):
    """Without the effect both ask to review, with it both say enter."""
    bare = session.with_effects(None)
    write_session(bare, tmp_path / "session")
    for effects, verdict in (("none", "review"), ("backlash", "enter")):
        options = ["--effects", effects, "--json"]
        compared, calibrated, checked = (
            run_orthocal(tmp_path, *words, tmp_path / "session", *options)
            for words in (
                ("compare", "--models", "offsets"),
                ("calibrate", "--model", "offsets", "--solver", "variable-projection"),
                ("check",),
            )
        )
        for done in (compared, calibrated, checked):
            assert json.loads(done.stdout)["decision"]["verdict"] == verdict
            assert done.returncode == EXIT_CODES[verdict]
    document = json.loads(compared.stdout)["effects"]
    assert document["recommended"] == ["backlash"]
    assert len(document["weighed"]) == 2


@pytest.mark.parametrize(
    ("identified", "option"),
    [(("backlash",), ""), (("thermal",), "thermal,backlash"), ((), "backlash")],
)
def test_the_option_is_named_unless_the_effect_is_identified_already(session, identified, option):
    """With those that are: an option in place of them would take them away."""
    found = compare_effects(session.with_effects(["backlash"]))
    (note, *_) = describe_effects(replace(found, identified=identified), 40)
    assert note.kind == "effects recommended"
    stated = re.findall(r"--effects (\S+)`", note.action)
    assert [set(s.split(",")) for s in stated] == ([set(option.split(","))] if option else [])


def test_the_evidence_counts_where_left_out_setups_disagree(session):
    found = compare_effects(session.with_effects(["backlash"]))
    none, best = found.weighed
    worse = replace(best, unseen_rms=1.5 * none.unseen_rms)
    said = [describe_effects(replace(found, weighed=(none, w)), 40)[0].text for w in (best, worse)]
    assert ["the evidence of all readings" in text for text in said] == [False, True]


def test_the_answer_has_the_recommendation(session):
    found = compare_models(session.with_effects(["backlash"]), models=["offsets"], options=QUICK)
    (note,) = found.assessment.of_kind("effects recommended")
    assert note.action == ""
    assert note.numbers["log_evidence"] > 10.0
    verdict = calibrate(session, "offsets", solver="variable-projection").assessment.decision
    assert found.assessment.decision.verdict == verdict.verdict == "enter"
