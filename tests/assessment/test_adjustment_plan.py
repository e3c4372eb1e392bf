"""Plans of mechanical adjustments, and tool errors of adjusted machines."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from adjusting import reached, shimmed_plan
from calibrated import UNJUDGED, identified, session_of
from commands import orthocal as run

from orthocal import (
    Choice,
    calibrate,
    draw_errors,
    plan_adjustments,
    simulate_session,
    write_calibration,
)
from orthocal.assessment.adjustment_plan import LEAST_GAIN, _Search
from orthocal.assessment.calibrated_tool import find_tool
from orthocal.assessment.controller_entries import offsets_to_enter
from orthocal.assessment.predictive import judge_deviations
from orthocal.assessment.tool_error import measure_deviations
from orthocal.assessment.validation import _apply_stated
from orthocal.assessment.words.adjustment import HEADLINES
from orthocal.calibration.build_record import adjust_calibration
from orthocal.calibration.refit import repeat_fit
from orthocal.cli.again import _read_amounts
from orthocal.effects.adjustment import find_adjustments
from orthocal.errors import ParameterError, RobotError
from orthocal.output.report.page import build_report
from orthocal.output.text.adjustment import render_plan
from orthocal.output.text.layout import to_text
from orthocal.statistics.chance import BY_CHANCE

SEED = 8


def machine_of(plan, seed):
    errors = draw_errors(plan.robot, plan.robot.parameters.patterns("full"), seed=seed)
    session = simulate_session(plan, errors, seed=seed, sigma=3e-6).session
    return errors, calibrate(session, **UNJUDGED)


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    return shimmed_plan(tmp_path_factory.mktemp("planned") / "mill")


@pytest.fixture(scope="module")
def machine(plan):
    return machine_of(plan, SEED)


@pytest.fixture(scope="module")
def calibration(machine):
    return machine[1]


@pytest.fixture(scope="module")
def planned(calibration):
    return plan_adjustments(calibration)


def test_an_adjusted_machine_has_the_predicted_tool_error(machine, planned):
    """tests/benchmarks/adjusting.py has more machines, whose mean is within 1.15.

    Few directions carry the uncertainty: the square of one ratio scatters by about 0.8.
    """
    errors, calibration = machine
    adjusted = adjust_calibration(calibration, planned.amounts)
    right, reversed_ = (
        (reached(errors, adjusted, amounts, seed=SEED) / planned.after.entered) ** 2
        for amounts in (planned.amounts, {n: -v for n, v in planned.amounts.items()})
    )
    assert right < 1.0 + 2.0 * 0.8
    assert reversed_ > 2.0 * (1.0 + 2.0 * 0.8)


def test_amounts_are_multiples_of_the_step_within_the_limits(planned):
    assert planned.judgement == "worthwhile"
    assert planned.adjustments[-1].tool_error == planned.after.entered
    for p in planned.adjustments:
        steps = p.amount / p.adjustment.step
        assert abs(steps - round(steps)) < 1e-9
        assert 0.0 < abs(p.amount) <= p.adjustment.largest * (1.0 + 1e-12)
        assert p.turns is None


def test_each_printed_tool_error_is_visibly_lower(plan, planned):
    """By 4 % and 1 µm. Machine 12 has an adjustment that does so with the next one only."""
    other = plan_adjustments(machine_of(plan, 12)[1])
    assert [p.tool_error is None for p in other.adjustments] == [False, False, True, False]
    for one in (planned, other):
        errors = [p.tool_error for p in one.adjustments if p.tool_error is not None]
        errors.insert(0, one.before.entered)
        assert (np.diff(np.round(errors, 6)) <= -0.99e-6).all()
        assert all(b < (1.0 - LEAST_GAIN) * a for a, b in pairwise(errors))
    rows = [line.split() for line in to_text(render_plan(other, saved=None)).splitlines()]
    cells = {row[0]: len(row) for row in rows if row[:1] in (["1"], ["2"], ["3"], ["4"])}
    assert cells["3"] == cells["1"] - 1


def search_of(calibration):
    tool = find_tool(calibration)
    candidates = find_adjustments(calibration.robot)
    return _Search(calibration, tool, candidates, calibration.assessment.tool.compensated)


def test_no_other_pair_is_much_better(calibration, planned):
    """Forward selection with exchange may miss the best one by LEAST_GAIN."""
    search = search_of(calibration)
    chosen = sorted(search.choose())
    assert len(chosen) == len(planned.adjustments) == 2
    own = search.error(search.fit(chosen))
    best = min(search.error(search.fit(t)) for t in itertools.combinations(range(15), len(chosen)))
    assert best <= own < best * (1.0 + LEAST_GAIN)


def test_best_amounts_are_a_minimum(calibration):
    """Within their limits no change of an amount is better, by central differences."""
    search = search_of(calibration)
    chosen = search.choose()
    amounts = search.fit(chosen)
    own = search.error(amounts)
    for i in chosen:
        for change in (-1e-5, 1e-5):
            trial = np.array(amounts)
            trial[i] += change
            assert search.error(trial) > own or abs(trial[i]) > search.max_amounts[i]


def test_first_order_effects_are_those_of_the_adjusted_machine(calibration):
    """With offsets entered again, against loops closed with the amounts."""
    plain = search_of(calibration)
    for i in (1, 4, 7):
        amounts = np.zeros(15)
        amounts[i] = 0.05e-3
        adjusted = adjust_calibration(calibration, plain.named(amounts))
        change = search_of(replace(adjusted, assessment=calibration.assessment))
        moved = np.linalg.norm(plain.effects[:, i] * amounts[i])
        assert abs(change.error(0.0 * amounts) - plain.error(amounts)) < 0.02 * moved


def test_uncertainties_of_amounts_are_those_of_sampled_machines(calibration):
    search = search_of(calibration)
    search.max_amounts = np.full(15, 1.0)
    chosen = search.choose()[:2]
    stated = search.uncertainties(chosen) / 2.0
    covariance = calibration.error_covariances[0]
    root = np.linalg.cholesky(covariance + 1e-24 * np.eye(len(covariance)))
    rng = np.random.default_rng(3)
    n = root.shape[0]
    field = search._without_offsets(search.tool.jacobian[:, :, :n])
    deviation = search._without_offsets(search.tool.deviation(calibration.active_offsets))
    found = []
    for _ in range(800):
        search._set_deviation(deviation + field @ (root @ rng.normal(size=n)))
        found.append(search.fit(chosen)[chosen])
    # four standard errors of a standard deviation from 800 draws
    assert np.std(found, axis=0) == pytest.approx(stated, rel=0.1)


def test_an_adjusted_calibration_is_the_machine_with_its_amounts(calibration):
    adjusted = adjust_calibration(calibration, {"x_outer_foot_z": 0.3e-3})
    terms = dict(calibration.robot.parameters["x_outer_foot_z.adjustment"].terms)
    moved = {n: calibration.errors[n] + 0.3e-3 * c for n, c in terms.items()}
    drives = calibration.robot.drive_zero + np.array([[0.01, -0.02, 0.03]])
    same = replace(calibration.machine, errors={**calibration.errors, **moved})
    assert np.abs(adjusted.machine.forward(drives) - same.forward(drives)).max() < 1e-10
    grown = adjusted["x_slide.ry"].std ** 2 - calibration["x_slide.ry"].std ** 2
    one = next(a for a in find_adjustments(calibration.robot) if a.name == "x_outer_foot_z")
    assert grown == pytest.approx((terms["x_slide.ry"] * one.setting_std(0.3e-3)) ** 2, rel=1e-6)
    assert adjust_calibration(calibration, {}) is calibration


def test_adjustments_are_planned_if_no_offset_is_identified(plan):
    rotations = ("*_slide.r?",)
    errors = draw_errors(plan.robot, rotations, seed=SEED)
    session = simulate_session(plan, errors, seed=SEED, sigma=3e-6).session
    fitted = identified(session, Choice(free=rotations, prior=True))
    planned = plan_adjustments(fitted)
    adjusted = find_tool(adjust_calibration(fitted, planned.amounts))
    deviation = measure_deviations(
        adjusted.deviation(np.zeros(3)), adjusted.workspace, adjusted.targets
    )
    expected = np.hypot(deviation.reported.rms, planned.before.compensated)
    assert planned.entries == ()
    assert planned.gain > LEAST_GAIN
    assert planned.after.entered == pytest.approx(expected, rel=0.01)


def test_a_plan_after_an_adjustment_with_small_gain_is_refused(plan, tmp_path):
    errors = {"x_slide.offset": 0.4e-3, "y_slide.rz": 1.4e-3}
    session = simulate_session(plan, errors, seed=1, sigma=3e-6).session
    calibration = calibrate(session, **UNJUDGED)
    write_calibration(calibration, tmp_path / "calibration.json")
    planned = plan_adjustments(calibration)
    assert planned.judgement == "small gain"
    assert planned.amounts
    new = tmp_path / "new"
    words = ("again", tmp_path, "--adjusted", "plan", "--out", new)
    code, out, err = run(*words)
    assert code == 3
    assert HEADLINES["small gain"] in err
    assert not out
    assert not new.exists()
    code, out, _ = run(*words, "--anyway")
    assert code == 0
    assert all(name in (new / "session.yaml").read_text() for name in planned.amounts)


def test_adjustments_with_uncertain_gain_are_details(planned):
    assert planned.judgement == "worthwhile"
    uncertain = replace(planned, displacement_uncertainty=1.0)
    assert uncertain.judgement == "uncertain gain"

    def show(plan, **options):
        return to_text(render_plan(plan, saved=None, **options))

    names = [p.adjustment.name for p in planned.adjustments]
    assert all(name in show(planned) for name in names)
    assert not any(name in show(uncertain) for name in names)
    assert "--details" in show(uncertain)
    assert all(name in show(uncertain, details=True) for name in names)


def test_a_robot_without_adjustments_is_refused():
    with pytest.raises(RobotError, match=r"orthocal\.adjustments"):
        plan_adjustments(identified(session_of("table1/experiment-2"), "offsets"))


def test_an_unknown_adjustment_is_named(calibration):
    foot = find_adjustments(calibration.robot)[0].name
    for among in (["w_foot"], [foot, "w_foot"]):
        with pytest.raises(ParameterError, match=r"among: 'w_foot' is not .*; adjustments: "):
            plan_adjustments(calibration, among=among)
    with pytest.raises(ParameterError, match="among: names no adjustment"):
        plan_adjustments(calibration, among=[])


def test_validation_expects_the_adjusted_machine(plan, machine, planned):
    errors, calibration = machine
    amounts = planned.amounts
    adjusted = adjust_calibration(calibration, amounts)
    entered = plan.with_controller(offsets_to_enter(adjusted))
    now = {**errors, **{f"{n}.adjustment": v for n, v in amounts.items()}}
    after = simulate_session(entered, now, seed=12, sigma=3e-6).session
    for stated, expected in ((amounts, True), ({}, False)):
        before, (new,) = _apply_stated(calibration, [replace(after, adjusted=stated)], {})
        test = judge_deviations(before, repeat_fit(before, new))
        assert (test.p_value > BY_CHANCE) is expected


@pytest.mark.usefixtures("short_reports", "without_sensor_gains")
def test_command_and_report_list_the_planned_adjustments(calibration, tmp_path):
    write_calibration(calibration, tmp_path / "calibration.json")
    code, text, _ = run("adjust", tmp_path, "--json")
    assert code == 0
    document = json.loads(text)
    assert document["schema"] == "orthocal/adjustment/1"
    names = [a["name"] for a in document["adjustments"]]
    assert document["worthwhile"]
    assert run("again", tmp_path, "--adjusted", "plan", "--out", tmp_path / "planned")[0] == 0
    assert document["after"]["entered"] < document["before"]["entered"]
    assert names[0] in build_report(calibration)
    code, _, err = run("adjust", tmp_path, "--among", "w_foot")
    assert code == 2
    assert "--among" in err
    new = tmp_path / "new"
    foot = "x_side_foot_z"
    assert _read_amounts(calibration, f"{foot}=0", anyway=False) == {}
    for amounts in (foot, "w_foot=1", f"{foot}=99", f"{foot}=.1,{foot}=.1"):
        with pytest.raises(ParameterError, match="--adjusted"):
            _read_amounts(calibration, amounts, anyway=False)
    code, out, _ = run("again", tmp_path, "--adjusted", f"{names[0]}=0.12", "--out", new, "--force")
    assert code == 0
    assert "Do not type them as HOME_OFFSET: it changes by " in out
    assert "orthocal export" not in out  # which knows no adjustments
    ini = tmp_path / "joints.ini"
    ini.write_text("# controller: {offsets_mm: [9, 9, 9]}\n[JOINT_0]\n[JOINT_1]\n[JOINT_2]\n")
    words = ("--adjusted", f"{names[0]}=0.12", "--ini", ini, "--out", new, "--force")
    assert "export" not in run("again", tmp_path, *words)[2].partition("other offsets")[2]
    assert f"adjusted_mm: {{{names[0]}: 0.12}}" in (new / "session.yaml").read_text()
