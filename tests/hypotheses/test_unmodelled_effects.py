"""Effects that the model lacks are named where the readings show them.

`python tests/benchmarks/checking.py --effects 1000` prints the shares.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from calibrated import session_of
from effect_plans import FEW, effect_plan
from scipy.integrate import quad
from slack import Slack
from unmodelled_machines import EffectSearch, plan_with_conditions, read_machines

from orthocal import Choice, simulate_session
from orthocal.assessment.judgement import judge_session
from orthocal.calibration.identify import identify
from orthocal.effects import registry
from orthocal.errors import RobotError
from orthocal.hypotheses.families.effects import find_effects, linearise_effect, missing_effects
from orthocal.hypotheses.likelihood import (
    AmountPrior,
    _integrate_amounts,
    build_likelihood,
    log_of_sum,
)
from orthocal.hypotheses.linear_model import LinearModel
from orthocal.hypotheses.search import CLEAR_EFFECT_LOG_BAYES, find_anomalies
from orthocal.statistics.distributions import log_positive_share

GEOMETRY = {"x_slide.offset": 0.1e-3, "y_leg.length": 40e-6, "z_slide.offset": -0.2e-3}


@pytest.fixture(scope="module")
def plan():
    return effect_plan(setups=FEW)


def read(plan, effect, errors):
    machine = plan.with_effects([effect] if effect else [])
    return simulate_session(machine, GEOMETRY | errors, seed=4).session.with_effects([])


@pytest.fixture(scope="module")
def with_backlash(plan):
    return read(plan, "backlash", {"y_slide.backlash": 50e-6})


def test_backlash_is_named_with_its_drive_amount_and_option(with_backlash):
    judgement = judge_session(with_backlash)
    (found,) = judgement.anomalies
    e = found.explanation
    assert (e.kind, found.alternatives) == ("backlash", ())
    amounts = dict(zip(e.parameters, zip(e.amounts, e.stds, strict=True), strict=True))
    value, std = amounts["y_slide.backlash"]
    assert value == pytest.approx(50e-6, abs=3.0 * std)
    assert std < 10e-6
    assert amounts["x_slide.backlash"][0] < 10e-6
    (finding,) = [f for f in judgement.findings if f.severity != "note"]
    assert (finding.kind, finding.severity) == ("backlash", "review")
    assert [p.parameter for p in finding.places] == ["y_slide.backlash"]
    assert "--effects backlash" in finding.action


def test_an_effect_of_the_model_is_not_tested(with_backlash):
    chosen = with_backlash.with_effects(["backlash"])
    assert "backlash" not in missing_effects(chosen)
    assert find_anomalies(chosen).found == ()


def test_drift_of_the_gauges_is_named(plan):
    """Rates of up to 2.5 µm/min, by the stated times of the readings."""
    session = read(plan, None, {})
    rate = dict(zip(session.setups, (2.5e-6, -2.0e-6, 2.2e-6), strict=True))
    began = {r.setup: r.conditions.time for r in reversed(session.readings)}
    drifted = [
        r.value + rate[r.setup] * (r.conditions.time - began[r.setup]).total_seconds() / 60.0
        for r in session.readings
    ]
    (found,) = find_anomalies(session.with_values(drifted)).found
    e = found.explanation
    assert (e.kind, e.scope, e.setups) == ("drift", "session", tuple(session.setups))
    difference = np.array(e.amounts) - np.array(list(rate.values())) / 60.0
    assert (np.abs(difference) < 3.0 * np.array(e.stds)).all()


def test_thermal_expansion_is_named_without_deviation_from_its_stated_size():
    """Legs expand, screws do not: the nominal change explains the readings."""
    plan = effect_plan(keys="thermal: {screws_ppm: 0}", setups=FEW)
    warm = np.random.default_rng(2).uniform(15.0, 30.0, len(plan.readings))
    readings = [
        replace(r, conditions=replace(r.conditions, temperature=float(t)))
        for r, t in zip(plan.readings, warm, strict=True)
    ]
    (found,) = find_anomalies(read(plan.select(readings), "thermal", {})).found
    e = found.explanation
    assert e.kind == "thermal expansion"
    assert (np.abs(e.amounts) < 3.0 * np.array(e.stds)).all()
    assert e.amount > 5e-6


def test_effects_of_a_thousandth_of_their_tolerance_are_not_named(plan):
    parameters = plan.with_effects(["backlash"]).robot.parameters
    errors = {n: 1e-3 * parameters[n].prior_std for n in parameters.of_effects}
    assert find_anomalies(read(plan, "backlash", errors)).found == ()


def test_an_approach_from_one_side_shows_no_backlash(plan):
    """It changes the readings like an offset."""
    one_side = [r for r in plan.readings if r.approach[r.setup != "yx"] == "p"]
    readings = [replace(r, conditions=replace(r.conditions, approach="ppp")) for r in one_side]
    session = read(plan.select(readings), "backlash", {"y_slide.backlash": 0.1e-3})
    assert find_anomalies(session).found == ()


@pytest.fixture
def slack():
    registry.register_effect(Slack)
    yield effect_plan("slack", keys="slack: {lead_mm: 10}", setups=FEW)
    registry.unregister_effect("slack")


LOOSE = {
    "x_slide.slack": 30e-6,
    "y_slide.slack": 50e-6,
    "x_slide.wave": -9e-6,
    "y_slide.wave": 12e-6,
    "rods.growth": 12e-6,
}


def test_an_effect_of_another_package_is_named_by_its_description(slack):
    session = read(slack, "slack", LOOSE)
    judgement = judge_session(session)
    (found,) = judgement.anomalies
    e = found.explanation
    assert (e.kind, e.effect, found.alternatives) == ("other effect", "slack", ())
    for name, amount, std in zip(e.parameters, e.amounts, e.stds, strict=True):
        assert amount == pytest.approx(LOOSE.get(name, 0.0), abs=3.0 * std)
    assert dict(zip(e.parameters, e.stds, strict=True))["x_slide.slack"] < 4e-6
    (finding,) = [f for f in judgement.findings if f.severity != "note"]
    assert finding.kind == "other effect"
    assert Slack.describe(None) in finding.text
    assert {"x_slide.slack", "y_slide.slack"} <= {p.parameter for p in finding.places}
    (effects,) = re.search(r"--effects (\S+)`", finding.action).groups()
    choice = Choice(effects=effects.split(","))
    result, _ = identify(session, choice, solver="variable-projection")
    slack_of_x = next(p for p in result.free if p.name == "x_slide.slack")
    assert slack_of_x.value == pytest.approx(30e-6, abs=3.0 * slack_of_x.std)


def test_a_sound_machine_shows_no_effect_of_another_package(slack):
    assert missing_effects(slack.with_effects([]))[-1] == "slack"
    assert find_anomalies(read(slack, "slack", {})).found == ()


def test_an_effect_that_does_not_fit_the_robot_is_not_tested(slack):
    class Unfit(Slack):
        name = "unfit"

        @classmethod
        def from_keys(cls, keys, robot):
            raise RobotError("has no such part")

    registry.register_effect(Unfit)
    try:
        assert "unfit" not in missing_effects(slack.with_effects([]))
    finally:
        registry.unregister_effect("unfit")


def test_a_reversed_sign_is_not_named_as_an_effect(plan):
    session = read(plan, None, {})
    values = session.values
    row = int(np.abs(values).argmax())
    values[row] *= -1.0
    (found,) = find_anomalies(session.with_values(values)).found
    assert (found.explanation.kind, found.explanation.rows) == ("reversed sign", (row,))


def test_readings_without_conditions_can_only_show_drift():
    session = session_of("raw-cycles")
    assert missing_effects(session) == ("backlash", "thermal", "drift")
    assert [e.name for e in find_effects(LinearModel(session))] == ["drift"]


@pytest.mark.parametrize("effect", ["backlash", "thermal"])
def test_linearised_effects_are_differences_of_exact_readings(plan, effect):
    bare, machine = plan.with_effects([]), plan.with_effects([effect])
    found = linearise_effect(LinearModel(bare), effect)

    def differ(one, other):
        """Difference of readings, and the first row of the setup of each."""
        shown = one.values - other.values
        firsts = [next(i for i, r in enumerate(bare.readings) if r.setup == n) for n in bare.setups]
        of_setup = [list(bare.setups).index(r.setup) for r in bare.readings]
        return shown, np.array(firsts)[of_setup]

    nominal = simulate_session(machine, {}, exact=True).session
    change, first = differ(nominal, simulate_session(bare, {}, exact=True).session)
    assert found.change - found.change[first] == pytest.approx(change, abs=1e-10)
    for parameter, column in zip(found.parameters, found.columns, strict=True):
        errors = {parameter.name: 0.1 * parameter.prior_std}
        moved, _ = differ(simulate_session(machine, errors, exact=True).session, nominal)
        assert 0.1 * (column - column[first]) == pytest.approx(moved, abs=1e-9)


def test_a_half_normal_amount_is_integrated_over():
    """One column, against quadrature at each pair of scales."""
    rng = np.random.default_rng(3)
    jacobian, column = rng.normal(size=(8, 3)), rng.normal(size=8)
    likelihood = build_likelihood(jacobian, sigma=1.0, dof=8, stated=True)
    prior = AmountPrior(np.array([1.5]), np.array([True]))
    for amount in (2.0, -1.0):
        deviation = amount * column + rng.normal(size=8)

        def likelihood_of(a, deviation=deviation):
            log = likelihood.score(likelihood.products((deviation - a * column)[None]))[0]
            return np.exp(log - 0.5 * (a / 1.5) ** 2) * 2.0 / (1.5 * np.sqrt(2.0 * np.pi))

        found = likelihood.score_set(deviation, [column[None]], priors=[prior]).log_likelihood
        assert np.exp(found) == pytest.approx(quad(likelihood_of, 0.0, 12.0)[0], rel=1e-6)


def test_backlashes_of_several_drives_are_nearly_independent(plan):
    """The joint probability that all are positive differs by less than a ninth of the limit."""
    bare, machine = plan.with_effects([]), plan.with_effects(["backlash"])
    model = LinearModel(bare)
    about = model.at_reference(keep_jacobian=True)
    (effect,) = (e for e in find_effects(model) if e.name == "backlash")
    vectors = model.entries(effect.columns)
    for seed in range(3):
        errors = {f"{d}_slide.backlash": 0.0 for d in "xyz"} | GEOMETRY
        values = simulate_session(machine, errors, seed=seed).session.values
        deviation = model.entries(values[None])[0] - about.expected
        gram, slope = about.likelihood._gram(deviation, vectors)
        precision, positive = np.ones((1, 3)), np.ones(3, bool)
        (found,) = _integrate_amounts(gram, slope, precision, positive)
        (free,) = _integrate_amounts(gram, slope, precision, ~positive)
        inverse = np.linalg.inv(gram + np.eye(3))
        means = (inverse @ slope[..., None])[..., 0]
        shares = [log_positive_share(m, c) for m, c in zip(means, inverse, strict=True)]
        joint = free + 3.0 * np.log(2.0) + shares
        likelihood = about.likelihood
        pairs = likelihood.log_densities(likelihood.products(deviation[None]))[0]
        independent, exact = (log_of_sum(gain + pairs) for gain in (found, joint))
        assert abs(independent - exact) < CLEAR_EFFECT_LOG_BAYES / 9.0


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["backlash", None])
def test_effects_are_named_where_the_readings_show_them(effect):
    """A sample of the benchmark: backlash at its tolerance, read with a dial of 0.01 mm."""
    plan = plan_with_conditions()
    search = EffectSearch(plan, effect)
    found = [search.name(values) for values in read_machines(plan, effect, 15, seed=11)]
    if effect is None:
        assert [n.effects for n in found if n.effects] == []
        return
    evident = [n for n in found if n.gain > 5.0]
    assert len(evident) >= 5
    named = [n for n in evident if n.effects[:1] == (effect,)]
    assert len(named) >= 0.9 * len(evident)
