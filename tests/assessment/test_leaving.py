"""Offsets that stay as they are, in all outputs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibrated import UNJUDGED, calibrated, session_of

from orthocal import calibrate, restore_session, simulate_session
from orthocal.assessment.assess import is_significant
from orthocal.assessment.calibrated_tool import find_tool
from orthocal.assessment.controller_entries import (
    WORTH_ENTERING,
    entered_offsets,
    find_entries,
    lowers,
    offsets_to_enter,
)
from orthocal.assessment.tool_error import assess_placed, summarise_tool
from orthocal.errors import ExportError
from orthocal.export.formats import export_calibration
from orthocal.export.linuxcnc.export import ExportOptions
from orthocal.output.report.page import build_report
from orthocal.output.scene.drawing import draw_scene
from orthocal.output.text.answer import render_answer
from orthocal.output.text.layout import to_text


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
    assert "orthocal export out --to linuxcnc --out out-linuxcnc" in answer
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
    assert "orthocal export out --to linuxcnc --out out-linuxcnc" in answer
    assert ("orthocal correct out PROGRAM.ngc --offsets active" in answer) is not keep
    assert "orthocal again" not in answer
    assert "measure again" not in answer
    assert ("Choose one" in joint.assessment.decision.action) is not keep


def test_there_is_a_next_step_where_nothing_is_entered():
    kept = calibrated("table1/experiment-3")
    assert kept.assessment.keeps_offsets
    assert "orthocal again out" in to_text(render_answer(kept, saved=Path("out")))
