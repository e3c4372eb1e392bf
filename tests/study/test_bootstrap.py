"""Bootstrap of sessions: the scatter agrees with the covariance of noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_plans import effect_plan
from gauges import exact, with_gauges

from orthocal import load_plan, load_session, simulate_session
from orthocal.errors import ParameterError, SessionError
from orthocal.observation.observations import build_observations
from orthocal.session.session import Gauge
from orthocal.study.bootstrap import build_bootstrap_study, find_cycles, summarise_bootstrap
from orthocal.study.runner import run_study

CYCLES = 40

FEWER_CYCLES = 14
"""Their residuals have as many degrees of freedom as cycles of six setups in all cycles."""


@pytest.fixture(scope="module")
def many_cycles(root, tmp_path_factory):
    """The raw plan in 40 cycles, on a machine that has offsets only."""
    text = (root / "examples/raw-cycles/plan.yaml").read_text()
    folder = tmp_path_factory.mktemp("cycles")
    (folder / "plan.yaml").write_text(text.replace("cycles: 3", f"cycles: {CYCLES}"))
    errors = {"x_slide.offset": 1e-3, "z_slide.offset": -0.5e-3}
    return simulate_session(exact(load_plan(folder / "plan.yaml")), errors, seed=1).session


@pytest.mark.parametrize("by", ["residuals", "cycles"])
def test_scatter_agrees_with_the_covariance(many_cycles, by):
    if by == "residuals":
        rows = [r for r in many_cycles.readings if r.cycle <= FEWER_CYCLES]
        many_cycles = many_cycles.select(rows)
    study = build_bootstrap_study(many_cycles, "offsets", by=by, draws=1000)
    found = summarise_bootstrap(study, run_study(study))
    assert found.fewest_cycles == (CYCLES if by == "cycles" else None)
    for p in found.parameters:
        # the standard error of the ratio is 1/√(2 dof), for residuals and for 40 cycles of 6 setups
        assert p.std / p.predicted == pytest.approx(1.0, abs=0.15)
        assert p.low < p.estimate < p.high
        # the standard error of the width is 3.1 % with 1000 draws
        assert p.high - p.low == pytest.approx(2 * 1.96 * p.std, rel=0.08)
        assert p.standard_error == pytest.approx(p.std / np.sqrt(2 * 999), rel=1e-9)


@pytest.mark.parametrize("order", [("coarse", "fine"), ("fine", "coarse")])
def test_gauges_have_their_own_noise(many_cycles, order):
    """One scatters ten times as much. Residuals are resampled in units of the noise."""
    plan = many_cycles.select([r for r in many_cycles.readings if r.cycle <= FEWER_CYCLES])
    gauges = {name: Gauge({"coarse": 20e-6, "fine": 2e-6}[name]) for name in order}
    plan = with_gauges(plan, gauges, set(list(plan.setups)[:3]))
    session = simulate_session(plan, {"x_slide.offset": 0.5e-3}, seed=1).session
    study = build_bootstrap_study(session, "offsets", draws=200)
    for p in summarise_bootstrap(study, run_study(study)).parameters:
        assert p.low < p.estimate < p.high
        assert p.std / p.predicted == pytest.approx(1.0, abs=0.3)
        assert p.estimate == pytest.approx(
            0.5e-3 if p.parameter.name == "x_slide.offset" else 0.0, abs=5.0 * p.std
        )


def test_a_known_zero_leaves_its_reading(many_cycles):
    """Six absolute readings of three offsets have residuals to resample."""
    chosen = [r for r in many_cycles.readings if r.cycle == 1 and r.posture.endswith("_max")]
    setups = {name: replace(s, zero="known") for name, s in many_cycles.setups.items()}
    few = replace(many_cycles.select(chosen), setups=setups)
    assert [r.setup for r in chosen] == list(dict.fromkeys(r.setup for r in chosen))
    prepared = build_bootstrap_study(few, "offsets", draws=2).prepare()
    assert prepared.residuals.size == len(chosen)


def test_cycles_in_another_order_of_approaches_are_the_same():
    """A reading is replaced by one with its approach."""
    plan = effect_plan("backlash")
    first = [r for r in plan.readings if r.cycle == 1]
    again = [replace(r, cycle=2) for r in reversed(first)]
    both = replace(plan, readings=(*first, *again))
    cycles = find_cycles(both, build_observations(both))
    readings = both.readings
    for one, other in cycles:
        assert [(readings[i].posture, readings[i].approach) for i in one] == [
            (readings[i].posture, readings[i].approach) for i in other
        ]
    turned = [replace(r, cycle=2, conditions=replace(r.conditions, approach="uuu")) for r in first]
    both = replace(plan, readings=(*first, *turned))
    with pytest.raises(SessionError, match="different postures or conditions"):
        find_cycles(both, build_observations(both))


def test_studies_of_other_orders_are_others(many_cycles):
    """The first gauge is the unit of noise, and random numbers follow the order of setups."""
    gauges = {"coarse": Gauge(20e-6), "fine": Gauge(2e-6)}
    plan = with_gauges(many_cycles, gauges, set(list(many_cycles.setups)[:3]))
    others = [
        replace(plan, gauges=dict(reversed(gauges.items()))),
        replace(plan, setups=dict(reversed(plan.setups.items()))),
    ]
    digests = {build_bootstrap_study(s, "offsets", draws=2).digest for s in (plan, plan, *others)}
    assert len(digests) == 3


def test_draws_consist_of_complete_cycles(raw_cycles):
    study = build_bootstrap_study(raw_cycles, "offsets", by="cycles", draws=10)
    prepared = study.prepare()
    drawn = prepared.draw(np.random.default_rng(0), "cycles")
    o = prepared.fit.problem.observations
    for cycles in find_cycles(raw_cycles, o):
        known = {tuple(prepared.fit.problem.values[c]) for c in cycles}
        assert {tuple(drawn[c]) for c in cycles} <= known


def test_model_std_includes_the_prior(root):
    session = load_session(root / "examples/sweep")
    study = build_bootstrap_study(session, "lengths", draws=2)
    found = summarise_bootstrap(study, run_study(study))
    assert all(p.predicted < p.model_std for p in found.parameters)


def test_rescaled_residuals_have_the_size_of_the_noise(many_cycles):
    prepared = build_bootstrap_study(many_cycles, "offsets", draws=2).prepare()
    sigma = many_cycles.gauge.sigma
    resolution = many_cycles.gauge.resolution or 0.0
    expected = np.hypot(sigma, resolution / np.sqrt(12))
    assert prepared.residuals.std() == pytest.approx(expected, rel=0.08)
    assert abs(prepared.residuals.mean()) < 1e-18


def test_session_without_residuals_or_cycles(root):
    with pytest.raises(SessionError, match="has no residuals to resample"):
        build_bootstrap_study(load_session(root / "examples/workshop"), "full")
    with pytest.raises(SessionError, match=r"setups\.\w+: has one cycle of readings"):
        build_bootstrap_study(load_session(root / "examples/workshop"), "offsets", by="cycles")


def test_cycles_with_different_postures(raw_cycles):
    short = replace(raw_cycles, readings=raw_cycles.readings[1:])
    with pytest.raises(SessionError, match="has cycles with different postures"):
        build_bootstrap_study(short, by="cycles")


@pytest.mark.parametrize(("argument", "value"), [("by", "cycle"), ("draws", 0)])
def test_arguments_without_a_meaning_are_refused(raw_cycles, argument, value):
    with pytest.raises(ParameterError, match=f"{argument}: found {value!r}; expected"):
        build_bootstrap_study(raw_cycles, "offsets", **{argument: value})
