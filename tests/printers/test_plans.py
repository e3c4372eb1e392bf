"""Plans of further readings of a printer from the session of its log."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import marked_pictures
from planned import FEW
from simulated_printer import Firmware, nominal, rings, write_log
from tolerances import CLOSED_FORM
from uncompared import few_balls, few_machines, uncompared

from orthocal import load_plan, load_session, plan_readings, write_session
from orthocal.errors import SessionError
from orthocal.measurement.importing.printer_log import import_printer_log, write_printer_import
from orthocal.measurement.joining import join_sessions
from orthocal.output.sheet.page import sheet_files
from orthocal.planning.equipment import Equipment
from orthocal.planning.owned_sensors import load_owned_sensor
from orthocal.units import MM

BAR = "sensor: ball_bar\nsigma_mm: 0.002\nrange_mm: [-25, 25]\nlength_mm: 50\n"
CALIBRATED = Firmware(
    140.4, np.array([279.1, 280.2, 281.3]), np.array([209.2, 328.9, 90.0]), nominal().endstops
)
"""Settings that a calibration chose: unlike every nominal machine."""


@pytest.fixture
def printer(tmp_path):
    """Session of a printer's log, and a plan with a ball bar from it."""
    (tmp_path / "log.txt").write_text(write_log("klipper", CALIBRATED, rings(), np.zeros(41)))
    write_printer_import(import_printer_log(tmp_path / "log.txt"), tmp_path / "log")
    (tmp_path / "bar.yaml").write_text(BAR)
    log = load_session(tmp_path / "log")
    equipment = Equipment(owned=(load_owned_sensor(tmp_path / "bar.yaml"),), **FEW)
    with few_balls(2), uncompared(), few_machines():
        plan = plan_readings(
            log.robot, "offsets", hours=0.2, equipment=equipment, measured=log, starts=1
        )
    return log, plan.session


def test_a_plan_from_a_log_states_its_controller_and_coordinates(printer, tmp_path):
    """The name of a posture is where the firmware is sent. The drives are those it moves to."""
    log, plan = printer
    write_session(replace(plan, robot_reference=str(log.robot.folder)), tmp_path / "bar")
    written = load_plan(tmp_path / "bar")
    assert written.firmware == log.firmware
    assert np.array_equal(written.controller_offsets, [0.0, 0.0, 0.0])
    assert len(join_sessions([log, written]).readings) == len(log.readings) + len(plan.readings)
    with pytest.raises(SessionError, match=r"copy the block controller of .*log") as e:
        join_sessions([log, replace(written, firmware=None)])
    assert str(e.value.where).endswith("bar/session.yaml: controller.firmware")
    with marked_pictures():
        files = sheet_files(plan)
    lines = "".join(t for n, t in files.items() if n.endswith(".txt"))
    assert not re.search(r"G53|M0|M2|MSG", lines)  # no firmware runs these
    assert not [name for name in files if name.endswith(".ngc")]
    assert "program" not in files["sheet.html"]
    assert "a_slide" not in files["sheet.html"]
    checked = 0
    for name, posture in plan.postures.items():
        shift = dict(re.findall(r"([xyz])([-+][\d.]+)", name))
        point = np.array([float(shift.get(k, 0.0)) for k in "xyz"])
        there = log.firmware.forward(posture.drives)[0] / MM
        assert np.abs(there - point).max() < 1e-3  # of the name
        line = r"posture {}\n(?:G1 .*\n)*G1 X(.*) Y(.*) Z(.*) F120"
        for words in re.findall(line.format(re.escape(name)), lines):
            assert np.abs(np.array(words, float) - there).max() < 1e-4
            checked += 1
    assert checked >= len(plan.readings)
    heights = [float(z) for z in re.findall(r"(?m)^G1 .* Z(.*) F", lines)]
    assert min(heights) > -CLOSED_FORM
