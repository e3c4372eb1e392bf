"""Offsets to enter into a controller: those with the least tool error, or the active ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import plans
import pytest
from calibrated import UNJUDGED, calibrated, identified, session_of
from conftest import ROOT
from drawn_machines import DrawnMachines
from machines import write_orthoglide

from orthocal import Choice, calibrate, load_plan, restore_session, simulate_session
from orthocal.assessment.assess import is_significant
from orthocal.assessment.calibrated_tool import find_tool
from orthocal.assessment.controller_entries import (
    WORTH_ENTERING,
    choose_offsets,
    compute_entries,
    entered_offsets,
    find_entries,
    lowers,
    offsets_to_enter,
)
from orthocal.assessment.judgement import find_tolerance_scale
from orthocal.assessment.tool_error import assess_placed, summarise_tool
from orthocal.errors import ExportError
from orthocal.export.formats import export_calibration
from orthocal.export.linuxcnc.export import ExportOptions
from orthocal.kinematics.loop_closure import LoopClosure, nominal_closure
from orthocal.output.report.page import build_report
from orthocal.output.scene.drawing import draw_scene
from orthocal.output.text.answer import render_answer
from orthocal.output.text.layout import to_text


@pytest.fixture(scope="module")
def quarter(tmp_path_factory):
    """The paper's plan for a machine with legs of 250 mm, travel in proportion."""
    folder = tmp_path_factory.mktemp("quarter")
    write_orthoglide(folder / "machine", 0.25)
    plan = plans.paper(max=48.0, min=-80.0)
    plan |= {"robot": "machine", "cycles": 3}
    plan["gauge"] = {"sigma_mm": 0.01, "resolution_mm": 0.01, "range_mm": [-20, 20]}
    return load_plan(plans.write(folder, plan))


def tool_error(plan, errors, offsets, space):
    """RMS tool error of a machine with offsets in its controller, aligned, [m]."""
    nominal = nominal_closure(plan.robot)
    drives = nominal.inverse(space.points)
    reached = LoopClosure(plan.robot, fixed=errors).forward(drives - offsets)
    aligned = space.remove_motion(reached - nominal.forward(drives), space.points)
    return float(np.sqrt(space.weights @ (aligned**2).sum(axis=1)))


def test_offsets_of_the_model_of_offsets_are_entered_as_identified():
    result = calibrated("raw-cycles", "offsets", **UNJUDGED)
    for entry in find_entries(result):
        assert entry.enter == entry.identified == result[f"{entry.drive}.offset"].value


def test_offsets_to_enter_have_the_least_tool_error(quarter):
    """Their gain is their derivative by the parameters."""
    machines = DrawnMachines(quarter)
    errors = machines.by_name(machines.draw(np.random.default_rng(1)))
    result = calibrate(simulate_session(quarter, errors, seed=1).session, "full", **UNJUDGED)
    tool = find_tool(result)
    space = tool.workspace
    best = entered_offsets(result)
    least = tool_error(quarter, result.errors, best, space)
    for i in range(3):
        for step in (-20e-6, 20e-6):
            other = best.copy()
            other[i] += step
            assert tool_error(quarter, result.errors, other, space) > least
    identified = np.array([e.identified for e in find_entries(result)])
    assert tool_error(quarter, result.errors, identified, space) > 1.2 * least
    # the gain by a difference; it holds for the active offsets, some mm away
    _, gain = choose_offsets(tool, best, drives=range(3))
    name, step = "x_slide.ry", 1e-5
    parameters = tuple(
        replace(p, value=p.value + step) if p.name == name else p for p in result.parameters
    )
    moved = replace(result, parameters=parameters, assessment=None)
    change = (entered_offsets(moved) - best) / step
    column = gain[:, list(tool.free).index(name)]
    assert change == pytest.approx(column, abs=0.05 * np.abs(column).max())


@pytest.mark.slow
def test_the_tool_error_with_the_offsets_to_enter_is_the_predicted_one(quarter):
    """It is smaller than with identified offsets of the complete model or of offsets alone.

    The machines have legs of 250 mm and all errors at their tolerances.
    """
    machines, found = DrawnMachines(quarter), []
    for seed in range(6):
        errors = machines.by_name(machines.draw(np.random.default_rng(100 + seed)))
        session = simulate_session(quarter, errors, seed=seed).session
        scale = find_tolerance_scale(session)
        full, alone = (
            identified(session, m, find_scale=lambda _, s=scale: s) for m in ("full", "offsets")
        )
        tool = find_tool(full)
        entries = compute_entries(full, tool)
        ways = [e.enter for e in entries], [e.identified for e in entries], alone.offsets
        achieved = [tool_error(quarter, errors, np.array(way), tool.workspace) for way in ways]
        predicted = summarise_tool(full, assess_placed(full, tool, entries)).entered
        found.append([*achieved, predicted])
    chosen, best_fit, offsets, predicted = np.sqrt(np.mean(np.square(found), axis=0))
    assert chosen < 0.9 * best_fit
    assert chosen < 0.9 * offsets
    # three standard deviations: the squared ratio scatters by 0.48 from machine to machine, so the
    # root of the mean of six by 0.48 / (2 √6) = 0.10
    assert chosen == pytest.approx(predicted, rel=0.3)


@pytest.fixture(scope="module")
def summed(tmp_path_factory):
    """A session of an Orthoglide with a sum of all its offsets, which is the machine's error."""
    folder = tmp_path_factory.mktemp("summed") / "machine"
    write_orthoglide(folder, 0.31025)
    listed = "  parameters:\n    common: [x_slide.offset, y_slide.offset, -z_slide.offset]\n"
    text = (folder / "machine.yaml").read_text().replace("  parameters:\n", listed, 1)
    # single offsets are known better than their sum
    (folder / "machine.yaml").write_text(text.replace("{offset_mm: 10,", "{offset_mm: 0.1,"))
    text = (ROOT / "examples/raw-cycles/plan.yaml").read_text()
    (folder.parent / "plan.yaml").write_text(text.replace("orthoglide", "machine"))
    plan = load_plan(folder.parent / "plan.yaml")
    return simulate_session(plan, {"common": 1.4e-3}, seed=1).session


def test_offsets_that_were_identified_as_a_sum_are_entered(summed):
    result = calibrate(summed, Choice(free=["common"]), **UNJUDGED)
    assert not result.prior  # as with offsets
    entries = {e.drive: e for e in find_entries(result)}
    value, std = result["common"].value, result["common"].std
    assert value == pytest.approx(1.4e-3, abs=4.0 * std)
    for drive, sign in (("x_slide", 1.0), ("y_slide", 1.0), ("z_slide", -1.0)):
        assert entries[drive].enter == pytest.approx(sign * value, rel=1e-12)
        assert entries[drive].std == pytest.approx(std, rel=1e-12)
    assert result.assessment.decision.verdict == "enter"
    assert result.assessment.tool.entered > 0.0


def test_offsets_identified_as_a_sum_beside_lengths_have_the_least_tool_error(summed):
    result = calibrate(summed, Choice(free=["common", "*_leg.length"]), **UNJUDGED)
    entries = find_entries(result)
    assert [e.drive for e in entries] == ["x_slide", "y_slide", "z_slide"]
    assert all(np.isfinite(e.std) for e in entries)
    assert entries[2].identified == -result["common"].value


@pytest.fixture(scope="module")
def entered():
    """Calibrations of a machine by two sessions, before and after its offsets were entered."""
    session = session_of("workshop")
    rng = np.random.default_rng(3)
    parameters = session.robot.parameters
    truth = {n: rng.normal() * parameters[n].prior_std for n in parameters.select_model("full")}
    truth |= {"x_slide.offset": 0.5e-3, "y_slide.offset": -0.7e-3, "z_slide.offset": 0.3e-3}
    first = calibrate(simulate_session(session, truth, seed=4).session, **UNJUDGED)
    again = session.with_controller(offsets_to_enter(first))
    # with the same noise the readings give the same offsets
    second = simulate_session(again, truth, seed=4).session
    return first, calibrate(second, **UNJUDGED)


@pytest.mark.parametrize("number", [2, 3])
def test_the_tool_error_decides_not_significance(number):
    """The paper entered the offsets of Experiment 2; Experiment 3 was the validation."""
    calibration = calibrated(f"table1/experiment-{number}")
    found = calibration.assessment
    accuracy = assess_placed(
        calibration, find_tool(calibration), [replace(e, enter=e.best) for e in found.entries]
    )
    best = summarise_tool(calibration, accuracy).entered
    assert best < found.tool.now
    assert found.keeps_offsets is (number == 3) is (best > (1.0 - WORTH_ENTERING) * found.tool.now)
    assert not (found.keeps_offsets and found.of_kind("must change"))
    assert sum(is_significant(calibration, e) for e in found.entries) < 2


def test_a_sufficient_share_of_the_tool_error_decides():
    assert lowers(1.0, 1.0 - WORTH_ENTERING)
    assert not lowers(1.0, 1.0 - 0.9 * WORTH_ENTERING)


def test_the_active_offsets_are_entered_if_they_stay(entered):
    first, kept = entered
    assert not first.assessment.keeps_offsets
    assert kept.assessment.keeps_offsets
    assert kept.assessment.decision.headline.startswith("Leave")
    assert [e.change for e in find_entries(kept)] == [0.0] * 3
    assert [e.enter for e in find_entries(first)] == [e.best for e in find_entries(first)]
    np.testing.assert_array_equal(entered_offsets(kept), kept.active_offsets)
    tool = kept.assessment.tool
    assert tool.entered == tool.now


@pytest.mark.usefixtures("short_reports")
def test_scene_report_and_export_keep_them(entered):
    _, kept = entered
    shown = " ".join(draw_scene(kept).facts)
    assert "Offsets that stay as they are" in shown
    assert "Offsets to enter" not in shown
    report = build_report(kept)
    assert "Values to enter" not in report
    assert "Enter the total offset" not in report
    with pytest.raises(ExportError, match="HOME_OFFSET does not change"):
        export_calibration(kept, "linuxcnc", options=ExportOptions(module=False))


def test_the_next_step_is_the_correction_of_all_errors(entered):
    first, kept = entered
    assert lowers(kept.assessment.tool.now, kept.assessment.tool.compensated)
    answer = to_text(render_answer(kept, saved=Path("out")))
    assert "orthocal export out --to linuxcnc --ini FILE --out out-linuxcnc" in answer
    assert "orthocal correct out PROGRAM.ngc" in answer
    assert "orthocal again" not in answer
    assert "orthocal again out" in to_text(render_answer(first, saved=Path("out")))


def test_sessions_before_and_after_entering_end_with_a_correction(entered):
    """It contains the offsets, whether they are entered or not."""
    first, kept = entered
    assert not first.measured_again
    before, after = restore_session(first), restore_session(kept)
    joint = calibrate([before, after], **UNJUDGED)
    assert joint.measured_again
    assert "new readings can check" in first.assessment.of_kind("no redundancy")[0].text
    assert "new readings can check" not in joint.assessment.of_kind("no redundancy")[0].text
    active = tuple(joint.active_offsets.tolist())
    setups = tuple(replace(s, active=active) for s in joint.setups)
    assert not replace(joint, setups=setups).measured_again
    assert lowers(joint.assessment.tool.entered, joint.assessment.tool.compensated)
    keep = joint.assessment.keeps_offsets
    answer = to_text(render_answer(joint, saved=Path("out")))
    assert "orthocal export out --to linuxcnc --ini FILE --out out-linuxcnc" in answer
    assert ("orthocal correct out PROGRAM.ngc --offsets active" in answer) is not keep
    assert "orthocal again" not in answer
    assert "measure again" not in answer
    assert ("Choose one" in joint.assessment.decision.action) is not keep


def test_there_is_a_next_step_where_nothing_is_entered():
    kept = calibrated("table1/experiment-3")
    assert kept.assessment.keeps_offsets
    assert "orthocal again out" in to_text(render_answer(kept, saved=Path("out")))
