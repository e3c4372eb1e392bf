"""Readings of a ball bar: sound, and with a ball that is not where the session states it."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from orthocal import draw_errors, load_plan, simulate_session
from orthocal.assessment.judgement import judge_session
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.hypotheses.anomaly import Explanation
from orthocal.hypotheses.families.unit_and_sign import factor_family
from orthocal.hypotheses.families.wrong_readings import inconsistent_groups
from orthocal.hypotheses.hypothesis import Rows
from orthocal.hypotheses.search import find_anomalies

CIRCLES = {"xy": (0, 1), "yz": (1, 2), "zx": (2, 0)}


def with_bar(root, folder, example, planes):
    """Plan of an example with circles of a ball bar of known length about one ball."""
    doc = yaml.safe_load((root / f"examples/{example}/plan.yaml").read_text())
    doc["gauges"] = {"dial": doc.pop("gauge") | {"range_mm": [-20, 20]}}
    doc["gauges"]["bar"] = {"sigma_mm": 0.002, "resolution_mm": 0.001, "range_mm": [-20, 20]}
    for setup in doc["setups"].values():
        setup["gauge"] = "dial"
    for plane in planes:
        names = [f"{plane}{k}" for k in range(8)]
        for name, angle in zip(names, 2.0 * np.pi * np.arange(8) / 8, strict=True):
            point = np.zeros(3)
            point[list(CIRCLES[plane])] = np.round([50 * np.cos(angle), 50 * np.sin(angle)], 3)
            doc["postures"][name] = {"tcp_mm": point.tolist()}
        bar = {"sensor": "ball_bar", "ball": "post", "centre_mm": [0, 0, 0], "gauge": "bar"}
        bar |= {"length_mm": 50, "length_tolerance_mm": 0.005, "postures": names}
        doc["setups"][f"bar_{plane}"] = bar
    (folder / "plan.yaml").write_text(yaml.safe_dump(doc))
    return load_plan(folder / "plan.yaml")


def test_the_scale_of_readings_changes_their_density_in_each_free_direction(root, tmp_path):
    """A free gauge zero takes one dimension from the readings of a setup, a known one none."""
    plan = with_bar(root, tmp_path, "raw-cycles", ["xy"])
    rows = Rows(plan, np.ones(len(plan.readings)))
    dial = next(name for name in rows.setups if not name.startswith("bar"))
    groups = [
        Explanation("wrong unit", "setup", tuple(rows.setups[name].tolist()), (name,), factor=25.4)
        for name in (dial, "bar_xy")
    ]
    family = factor_family(rows, groups)
    expected = [len(rows.setups[dial]) - 1, len(rows.setups["bar_xy"])]
    assert family.log_volume == pytest.approx(np.array(expected) * np.log(25.4))


def test_an_inconsistent_setup_has_an_amount_for_each_place_but_one_for_a_free_zero(root, tmp_path):
    """A known zero takes none of the amounts of a bar."""
    rows = Rows(with_bar(root, tmp_path, "raw-cycles", ["xy"]))
    family = next(inconsistent_groups(rows))
    amounts = {family.explain(h).setups[0]: len(family.groups[h]) for h in range(family.count)}
    places = {n: len({rows.session.readings[i].place for i in r}) for n, r in rows.setups.items()}
    assert amounts.pop("bar_xy") == places.pop("bar_xy") == 8
    assert amounts == {name: count - 1 for name, count in places.items()}


@pytest.mark.parametrize(
    ("example", "planes", "seed", "tolerances"),
    [
        ("inclined_orthoglide", CIRCLES, 14, {"*.offset_mm": 4.0}),
        ("raw-cycles", ["xy"], 0, None),
    ],
)
def test_a_known_bar_on_a_machine_with_large_offsets_is_not_accused(
    root, tmp_path, example, planes, seed, tolerances
):
    """The search linearised about a machine that fits worse than the most likely one: too few steps
    for offsets of some mm, or the ball on the wrong side of the plane in which the tool moves."""
    plan = with_bar(root, tmp_path, example, planes)
    errors = draw_errors(plan.robot, machine_errors(plan.robot), seed=seed, tolerances=tolerances)
    anomalies = find_anomalies(simulate_session(plan, errors, seed=seed).session)
    assert anomalies.found == ()
    assert anomalies.tolerance_scale < 2.0


@pytest.mark.parametrize(
    ("axis", "off_mm", "verdict"),
    [("x", 3.0, "enter"), ("y", -15.0, "reject")],
)
def test_a_misplaced_ball_is_named(root, tmp_path, axis, off_mm, verdict):
    """Near its tolerance of 2 mm the fit follows it; far beyond, it is the only large error."""
    plan = with_bar(root, tmp_path, "raw-cycles", ["xy"])
    errors = draw_errors(plan.robot, machine_errors(plan.robot), seed=2)
    name = f"ball.post.centre_{axis}"
    session = simulate_session(plan, errors | {name: off_mm / 1e3}, seed=2).session
    judgement = judge_session(session)
    assert judgement.verdict == verdict
    rejected = [f for f in judgement.findings if f.severity == "reject"]
    assert [p.parameter for f in rejected for p in f.places] == [name] * len(rejected)
    for finding in rejected:
        assert finding.numbers["error_mm"] == pytest.approx(off_mm, rel=0.1)


def test_errors_of_many_parts_name_none(root, tmp_path):
    plan = with_bar(root, tmp_path, "raw-cycles", ["xy", "yz", "zx"])
    names = [n for n in machine_errors(plan.robot) if not n.endswith(".offset")]
    drawn = draw_errors(plan.robot, names, seed=3)
    session = simulate_session(plan, {n: 8.0 * v for n, v in drawn.items()}, seed=3).session
    (finding,) = [f for f in judge_session(session).findings if f.severity == "reject"]
    assert finding.kind == "beyond tolerances"
    assert finding.places == ()
