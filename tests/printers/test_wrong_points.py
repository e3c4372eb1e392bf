"""Points of a bed that contradict the others: bump, dirt, wrong trigger, loose probe."""

from __future__ import annotations

import numpy as np
import pytest
from simulated_printer import Printer, nominal, rings, write_log

from orthocal import check_session, draw_errors, load_session
from orthocal.hypotheses.families.row_order import row_offsets, swapped_rows
from orthocal.hypotheses.families.unit_and_sign import wrong_units_and_signs
from orthocal.hypotheses.families.wrong_readings import wrong_readings
from orthocal.hypotheses.hypothesis import Rows
from orthocal.measurement.importing.printer_log import import_printer_log, write_printer_import

NOISE_MM = 0.02
TRIGGER_MM = 1.85

WITHIN_MM = 0.06
"""Three standard deviations of a probed height that the others predict."""


@pytest.fixture(scope="module")
def heights(tmp_path_factory):
    """Heights of the triggers of a printer with errors, shape (41,), [mm]."""
    log = tmp_path_factory.mktemp("printer") / "nominal.txt"
    log.write_text(write_log("klipper", nominal(), rings(), np.zeros(41)))
    robot = import_printer_log(log).session.robot
    errors = draw_errors(robot, robot.parameters.select_model("full"), seed=4)
    printer = Printer(robot, errors, (0.002, -0.003), TRIGGER_MM)
    return printer.probe(nominal(), rings(), noise=NOISE_MM, rng=np.random.default_rng(1))


def check(folder, heights):
    """Findings of a session that was imported from a log, without notes."""
    log = folder / "log.txt"
    log.write_text(write_log("klipper", nominal(), rings(), heights, -TRIGGER_MM))
    write_printer_import(import_printer_log(log), folder / "bed")
    findings = check_session(load_session(folder / "bed")).findings
    return [f for f in findings if f.severity != "note"]


@pytest.mark.parametrize("bump_mm", [0.3, -0.3])
def test_a_bump_is_the_only_explanation(tmp_path, heights, bump_mm):
    """Nobody read a dial or wrote rows, so no other mistake is named."""
    heights = heights + bump_mm * (np.arange(41) == 15)
    (finding,) = check(tmp_path, heights)
    assert finding.kind == "outlier"
    assert [(p.line, p.posture) for p in finding.places] == [(17, "p16")]
    assert finding.numbers["expected_mm"] == pytest.approx(bump_mm, abs=WITHIN_MM)
    above = ("above the surface", "too early") if bump_mm > 0.0 else ("below", "too late")
    assert all(words in finding.text for words in above)
    assert "delete line 17" in finding.action


def test_a_probe_that_came_loose_is_no_gauge(tmp_path, heights):
    (finding,) = check(tmp_path, heights + 0.2 * (np.arange(41) > 20))
    assert finding.kind == "displaced gauge"
    assert finding.places[0].setup == "bed" or finding.places[0].posture == "p22"
    assert "probe or the bed" in finding.text
    assert "import the new log" in finding.action


def test_numbers_of_triggers_have_no_units_signs_or_rows(tmp_path, heights):
    log = tmp_path / "log.txt"
    log.write_text(write_log("klipper", nominal(), rings(), heights, -TRIGGER_MM))
    rows = Rows(import_printer_log(log).session)
    families = [*wrong_units_and_signs(rows), *row_offsets(rows), *swapped_rows(rows)]
    assert not families
    assert [f.explain(0).kind for f in wrong_readings(rows) if f.count] == ["outlier"]
