"""Backlash to enter: one decision for answer, export, corrected programs and tool error."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from calibrated import SOUND, UNJUDGED
from effect_plans import effect_plan, sided_plan

from orthocal import (
    ExportOptions,
    calibrate,
    draw_scene,
    export_calibration,
    simulate_session,
    validate_calibration,
)
from orthocal.assessment import controller_entries
from orthocal.assessment.assess import assess
from orthocal.assessment.calibrated_tool import find_tool
from orthocal.assessment.controller_entries import (
    backlash_changes,
    compute_backlash,
    entered_offsets,
    expanded_uncertainty,
    is_worth_changing,
)
from orthocal.assessment.recommendation import Recommendation
from orthocal.assessment.tool_error import assess_tool
from orthocal.assessment.wording import um
from orthocal.cli.correct import _find_lags
from orthocal.effects.compensation import JointTrim
from orthocal.kinematics.conditions import UseConditions
from orthocal.kinematics.loop_closure import LoopClosure, nominal_closure
from orthocal.output.scene import tool_errors
from orthocal.output.text.answer import render_answer
from orthocal.output.text.layout import to_text
from orthocal.output.text.validation import render_validation
from orthocal.units import MM

TRUTH = {
    "x_slide.offset": 0.8e-3,
    "y_slide.offset": -0.5e-3,
    "x_slide.backlash": 40e-6,
    "y_slide.backlash": 60e-6,
}
"""Drive z has no backlash."""

NOISE = 6e-6

pytestmark = pytest.mark.usefixtures("module_of_few_tool_points")

LINES = ExportOptions(module=False, latched=(1, 1, 1))

KNOWN = {"judgement": SOUND, "recommendation": Recommendation("full", 1.0, {}, 0.0)}
"""Arguments of an assessment whose readings are sound, and whose model is not in question."""


@pytest.fixture(scope="module")
def plan():
    plan = sided_plan()
    return plan.with_gauge(replace(plan.gauge, sigma=NOISE)).with_controller(np.zeros(3))


def measure(plan, model="offsets", *, truth=TRUTH, seed=3, sigma=NOISE):
    session = simulate_session(plan, truth, seed=seed, sigma=sigma).session
    return calibrate(session, model, **UNJUDGED)


def answer(calibration):
    return to_text(render_answer(calibration, saved=Path("out")))


@pytest.fixture(scope="module")
def calibration(plan):
    return measure(plan)


@pytest.fixture
def found(calibration):
    return {e.drive[0]: e for e in calibration.assessment.backlash}


def test_a_backlash_is_entered_where_it_is_determined(calibration, found):
    for drive, entered in zip("xyz", (True, True, False), strict=True):
        e, p = found[drive], calibration[f"{drive}_slide.backlash"]
        half = expanded_uncertainty(calibration, e)
        assert half == pytest.approx(float(calibration.expand(p.std, p.std_scatter, p.std_scaled)))
        assert (e.identified > half) is entered
        assert e.enter == (max(p.value, 0.0) if entered else 0.0)


def test_every_output_has_the_same_decision(calibration, found):
    lines = export_calibration(calibration, "linuxcnc", options=LINES)
    written = dict(re.findall(r"\[JOINT_(\d)\][^\[]*?BACKLASH = (\S+)", lines["joints.ini"]))
    assert sorted(written) == ["0", "1"]
    for joint, drive in (("0", "x"), ("1", "y")):
        assert float(written[joint]) == pytest.approx(round(found[drive].enter / MM, 3))
    half = f"±{expanded_uncertainty(calibration, found['z']) * 1e3:.3f} mm"
    assert f"JOINT_2 ({half})" in lines["README.md"]
    half = 0.5 * backlash_changes(calibration, list(found.values()))
    assert _find_lags(calibration) == pytest.approx(half, abs=1e-9)
    text = answer(calibration)
    rows = [r.split() for r in text.splitlines() if r.split()[:1] == ["z_slide"]]
    assert rows[1][2] == "unchanged"
    assert "and this backlash" in text


def test_a_compensation_table_has_the_same_decision():
    noise = 1.5e-6  # determines the screws, too
    both = effect_plan("backlash", "screw").with_controller(np.zeros(3))
    both = both.with_gauge(replace(both.gauge, sigma=noise, resolution=None))
    truth = {**TRUTH, "x_slide.screw_sin": 15e-6, "z_slide.screw_sin": 15e-6}
    calibration = measure(both, "full", truth=truth, sigma=noise)
    x, _, z = calibration.assessment.backlash
    assert x.enter > 0.0
    assert z.enter == 0.0
    options = replace(LINES, home_offsets=(0.3, 0.3, 0.3))
    files = export_calibration(calibration, "linuxcnc", anyway=True, options=options)
    for joint, entry in (("0", x), ("2", z)):
        rows = np.array([r.split() for r in files[f"joint_{joint}.comp"].splitlines()], float)
        apart = 1e-3 * (rows[:, 1] - rows[:, 2])
        assert apart == pytest.approx(entry.enter, rel=0.05, abs=1e-9)


def test_the_tool_error_is_that_with_the_entered_backlash(calibration):
    """Loops are closed under every combination of sides with compensated drives."""
    tool, placed = calibration.assessment.tool, find_tool(calibration)
    points = placed.workspace.points[: len(placed.drives)]
    nominal = nominal_closure(calibration.robot)
    drives = nominal.inverse(points) - entered_offsets(calibration)
    half = 0.5 * np.array([e.enter for e in calibration.assessment.backlash])
    for expected, compensation in ((tool.entered, half), (tool.without_backlash, 0.0 * half)):
        fields = []
        for sides in itertools.product((1.0, -1.0), repeat=3):
            letters = "".join("p" if s > 0.0 else "n" for s in sides)
            closure = LoopClosure(
                calibration.robot,
                fixed=calibration.errors,
                conditions=UseConditions(approach=letters),
            )
            reached = closure.forward(drives + np.array(sides) * compensation)
            fields.append(reached - placed.targets[: len(points)])
        field = np.concatenate(fields)
        space = placed.workspace.once(placed.use.size).repeat(8)
        targets = np.tile(placed.targets[: len(points)], (8, 1))
        aligned = space.remove_motion(field, targets)
        known = np.sqrt(space.weights @ (aligned**2).sum(axis=1))
        assert np.hypot(known, tool.compensated) == pytest.approx(expected, rel=1e-6)
    assert tool.without_backlash > 1.1 * tool.entered


def test_the_scene_shows_the_largest_error_and_the_entered_backlash(calibration, monkeypatch):
    """Under several sides of approach the mean of the errors is smaller than the largest."""
    accuracy = assess_tool(calibration)
    assert accuracy.use.size > 1
    fields = (accuracy.deviation, accuracy.deviation_with_entries)
    now, entered = (np.linalg.norm(accuracy.align(d), axis=1).max() * 1e6 for d in fields)
    for changes in (True, False):  # with unchanged offsets, backlash is entered all the same
        monkeypatch.setattr(tool_errors, "changes_offsets", lambda calibration, c=changes: c)
        scene = draw_scene(calibration, show="tool")
        texts = {e.nodes[0]: e.text for e in scene.legend}
        assert f"up to {now:.0f} µm" in texts[tool_errors.TOOL_NOW]
        assert "arrows: mean over the conditions" in texts[tool_errors.TOOL_NOW]
        shown = texts[tool_errors.TOOL_ENTERED]
        assert shown.startswith("Tool error with the values entered")
        assert f"up to {um(entered * 1e-6)} µm" in shown
        assert scene.headline.startswith(f"Tool error now: up to {now:.0f} µm")


def test_an_undetermined_backlash_is_entered_if_that_lowers_the_tool_error(calibration):
    tool = find_tool(calibration)
    index = next(i for i, p in enumerate(calibration.parameters) if p.name == "x_slide.backlash")
    p = calibration.parameters[index]
    for scale, entered in ((1.0, True), (0.1, False)):
        covariance = np.array(calibration.model_covariance) * 1e-2
        value = p.value * scale
        vague = replace(p, value=value, std=value, prior_std=10.0 * value)
        vague_at = replace(
            calibration,
            assessment=None,
            model_covariance=covariance,
            parameters=tuple(vague if q is p else q for q in calibration.parameters),
        )
        (x, *_) = compute_backlash(vague_at, tool)
        assert x.identified < expanded_uncertainty(vague_at, x)
        assert (x.enter == value) is entered


def test_backlash_that_the_controller_compensates_stays(plan, calibration):
    trims = tuple(JointTrim(e.enter) for e in calibration.assessment.backlash)
    again = replace(plan.with_controller(entered_offsets(calibration).round(6)), compensation=trims)
    second = measure(again, seed=4)
    found = second.assessment
    assert [e.active for e in found.backlash] == pytest.approx([t.backlash for t in trims])
    assert found.keeps_offsets
    assert not any(e.change for e in found.backlash)
    assert found.tool.without_backlash is None
    assert not is_worth_changing(second, found.backlash, None, None)
    text = answer(second)
    assert text.count(" unchanged ") == 3
    assert "Next: nothing to enter" in text or "Next: correct" in text


def test_a_backlash_that_no_reading_shows_keeps_its_compensation(plan):
    """All postures are approached from one side. The estimate follows the prior, which is no reason
    to remove what the controller compensates."""
    one_side = plan.select([r for r in plan.readings if r.conditions.approach == "ppp"])
    trims = (JointTrim(20e-6),) * 3
    found = measure(replace(one_side, compensation=trims), "full")
    backlash = found.assessment.backlash
    assert [(e.enter, e.change) for e in backlash] == [(pytest.approx(20e-6), 0.0)] * 3
    assert answer(found).count("not determined") == 3
    lines = export_calibration(found, "linuxcnc", options=LINES)
    assert lines["joints.ini"].count("BACKLASH = 0.020") == 3


def test_a_session_that_states_no_compensation_is_asked_for_it(calibration):
    """A stated 0 is an answer; so is any other number. A joined session is named."""
    kind = "compensation not stated"
    assert calibration.assessment.of_kind(kind)
    stated = (JointTrim(0.02 * MM), JointTrim(), JointTrim())
    for trims in ((JointTrim(),) * 3, stated):
        record = replace(calibration.session, compensation=trims)
        assessed = assess(replace(calibration, assessment=None, session=record), **KNOWN)
        assert not assessed.of_kind(kind)
    both = replace(calibration.session, parts=(calibration.session,) * 2)
    setups = [
        replace(s, name=f"{part}/{s.name}", compensation=trims)
        for part, trims in (("first", stated), ("second", None))
        for s in calibration.setups
    ]
    joint = replace(calibration, assessment=None, session=both, setups=tuple(setups))
    (asked,) = assess(joint, **KNOWN).of_kind(kind)
    assert "second" in asked.text
    assert "first" not in asked.text


def test_validation_shows_the_backlash_of_its_tool_error(plan, calibration):
    entered = plan.with_controller(entered_offsets(calibration).round(6))
    session = simulate_session(entered, TRUTH, seed=4, sigma=NOISE).session
    validation = validate_calibration(
        calibration, replace(session, compensation=(JointTrim(),) * 3)
    )
    judged = assess(validation.joint, **KNOWN)
    assert judged.keeps_offsets
    text = to_text(render_validation(validation))
    assert "with the backlash from all readings" in text
    assert "Offsets from" not in text
    for e in judged.backlash:
        if e.change:
            assert re.search(rf"{e.drive} +0\.000 +{e.enter / MM:.3f} ", text)


def test_a_small_backlash_stays_where_the_offsets_stay(plan):
    """It is determined, but lowers the tool error by less than 5 %."""
    still = {**TRUTH, "x_slide.backlash": 3e-6, "y_slide.backlash": 0.0}
    plan = plan.with_gauge(replace(plan.gauge, sigma=1.5e-6))
    entered = plan.with_controller(np.array([0.8e-3, -0.5e-3, 0.0]))
    found = measure(entered, None, truth=still, sigma=1.5e-6)
    judged = found.assessment
    (x, *_) = judged.backlash
    assert x.identified > expanded_uncertainty(found, x)
    assert (judged.keeps_offsets, x.enter) == (True, 0.0)
    assert "acklash" not in judged.decision.headline
    assert re.search("x_slide +0.000 +unchanged ", answer(found))


def test_backlash_alone_is_entered_where_the_offsets_stay(plan):
    entered = plan.with_controller(np.array([0.8e-3, -0.5e-3, 0.0]))
    found = measure(entered, seed=5)
    judged = found.assessment
    assert judged.keeps_offsets
    assert any(e.change for e in judged.backlash)
    assert "Enter the backlash." in judged.decision.headline
    assert judged.tool.entered < judged.tool.without_backlash == judged.tool.now
    lines = export_calibration(found, "linuxcnc", anyway=True, options=LINES)["joints.ini"]
    assert lines.count("BACKLASH = ") == 2


def test_small_undetermined_changes_are_omitted(calibration, monkeypatch):
    """A backlash of 1 µm is not entered because another one that is not determined matters."""
    least = 10e-6
    monkeypatch.setattr(
        controller_entries, "_changes_tool", lambda c, tool, changes: sum(changes.values()) > least
    )
    sizes = (1e-6, 30e-6, 8e-6, 4e-6)
    changes = [
        controller_entries._Change({f"{i}.backlash": size}, determined=i == 1, limited=True)
        for i, size in enumerate(sizes)
    ]
    choose = partial(controller_entries._choose_changes, calibration, None)
    assert choose(changes) == [False, True, True, False]
    assert choose(changes[:2]) == [False, True]
    assert choose([changes[0], changes[1]._replace(limited=False)]) == [False, False]
