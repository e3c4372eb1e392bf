"""Sessions drawn anew: what scatters is what the covariance says of noise."""

from __future__ import annotations

import numpy as np
import pytest
from gauges import exact

from orthocal import load_plan, load_session, simulate_session
from orthocal.errors import SessionError
from orthocal.study.bootstrap import build_bootstrap_study, find_cycles, summarise_bootstrap
from orthocal.study.runner import run_study

CYCLES = 40


@pytest.fixture(scope="module")
def many_cycles(root, tmp_path_factory):
    """The raw plan in 40 cycles, of a machine without other errors than offsets."""
    text = (root / "examples/raw-cycles/plan.yaml").read_text()
    folder = tmp_path_factory.mktemp("cycles")
    (folder / "plan.yaml").write_text(text.replace("cycles: 3", f"cycles: {CYCLES}"))
    errors = {"x_slide.offset": 1e-3, "z_slide.offset": -0.5e-3}
    return simulate_session(exact(load_plan(folder / "plan.yaml")), errors, seed=1).session


@pytest.mark.parametrize("how", ["residuals", "cycles"])
def test_estimates_scatter_as_the_covariance_says(many_cycles, how):
    study = build_bootstrap_study(many_cycles, "offsets", how=how, draws=1000)
    found = summarise_bootstrap(study, run_study(study))
    assert found.fewest_cycles == (CYCLES if how == "cycles" else None)
    for p in found.parameters:
        # the residuals' own spread is known to 1/√(2 dof), that of 40 cycles of 6 setups too
        assert p.std / p.foretold == pytest.approx(1.0, abs=0.15)
        assert p.low < p.estimate < p.high
        assert p.high - p.low == pytest.approx(2 * 1.96 * p.std, rel=0.08)
        assert p.doubt == pytest.approx(p.std / np.sqrt(2 * 999), rel=1e-9)


def test_a_draw_of_cycles_takes_whole_ones(raw_cycles):
    study = build_bootstrap_study(raw_cycles, "offsets", how="cycles", draws=10)
    prepared = study.prepare()
    drawn = prepared.draw(np.random.default_rng(0), "cycles")
    o = prepared.fit.problem.observations
    for cycles in find_cycles(raw_cycles, o):
        known = {tuple(prepared.values[c]) for c in cycles}
        assert {tuple(drawn[c]) for c in cycles} <= known


def test_residuals_are_as_large_as_the_noise(many_cycles):
    prepared = build_bootstrap_study(many_cycles, "offsets", draws=2).prepare()
    sigma = many_cycles.gauge.sigma
    resolution = many_cycles.gauge.resolution or 0.0
    expected = np.hypot(sigma, resolution / np.sqrt(12))
    assert prepared.residuals.std() == pytest.approx(expected, rel=0.08)
    assert abs(prepared.residuals.mean()) < 1e-18


def test_beside_a_prior_noise_is_not_all_that_is_unknown(root):
    session = load_session(root / "examples/sweep")
    study = build_bootstrap_study(session, "lengths", draws=60)
    found = summarise_bootstrap(study, run_study(study))
    assert all(p.foretold < p.unknown for p in found.parameters)


def test_nothing_to_draw_from_is_told(root):
    with pytest.raises(SessionError, match="leaves no residuals to draw from"):
        build_bootstrap_study(load_session(root / "examples/workshop"), "full")
    with pytest.raises(SessionError, match=r"setups\.\w+: was read in one cycle"):
        build_bootstrap_study(load_session(root / "examples/workshop"), how="cycles")


def test_cycles_of_other_postures_are_told(raw_cycles):
    from dataclasses import replace

    short = replace(raw_cycles, readings=raw_cycles.readings[1:])
    with pytest.raises(SessionError, match="has cycles in which other postures were read"):
        build_bootstrap_study(short, how="cycles")
