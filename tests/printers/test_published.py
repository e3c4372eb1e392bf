"""Printers of which others published data or reports.

The seven triggers and Klipper's stored answer are in `examples/delta/printer.cfg`, with their
source. Klipper #5567 (rods of 1620 mm), Marlin #14910 (trims of the rods of +6.3 and −3.5 mm) and
Klipper #4755 (one mistyped value) are reports without data: such printers are simulated.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from calibrated import UNJUDGED, identified
from conftest import ROOT
from klipper_peer import calibrate_as_klipper, locate
from simulated_printer import Firmware, Printer, nominal, read_settings, rings, write_log

from orthocal import Choice, calibrate, check_session
from orthocal.assessment.printer_settings import fit_firmware
from orthocal.assessment.words.entries import FIRMWARE_HEADLINES
from orthocal.measurement.importing.printer_log import import_printer_log
from orthocal.printers.firmwares import FIRMWARES
from orthocal.units import MM

SEVEN = ROOT / "examples" / "delta" / "printer.cfg"
SIX = ["radius", "a_tower.tangential", "b_tower.tangential", "*.offset"]

STORED = 1e-3
"""[mm] Klipper's steps add up to 1e-5 when it ends; its valley is flat."""


def sum_of(calibration, weights):
    """Value, standard deviation and prior standard deviation of a sum of parameters, [mm]."""
    names = [p.name for p in calibration.parameters]
    w = np.zeros(len(names))
    w[[names.index(n) for n in weights]] = list(weights.values())
    prior = np.array([p.prior_std for p in calibration.parameters])
    std = np.sqrt(w @ calibration.total_covariance @ w)
    value = w @ [p.value for p in calibration.parameters]
    return value / MM, std / MM, np.linalg.norm(w * prior) / MM


RADIUS = {f"{k}_slide.x": -1.0 / 3.0 for k in "abc"}


def rod(tower):
    """Mean of both rods of an arm."""
    return {f"{tower}_coupler.x": 0.5, f"frame.{tower}_rod_b_tip.x": 0.5}


def without_tilt(session):
    """A session whose bed is square to the towers, as Klipper has it."""
    bed = session.setups["bed"]
    surface = replace(bed.sensor.artefact, direction_std=0.0)
    setups = {"bed": replace(bed, sensor=replace(bed.sensor, artefact=surface))}
    return replace(session, setups=setups)


def test_klippers_answer_is_the_optimum_of_its_own_model():
    """From its answer six parameters without priors stay; a peer of its search ends there."""
    session = without_tilt(import_printer_log(SEVEN).session)
    result = identified(session, Choice(free=SIX, prior=False))
    value = {p.name: p.value / MM for p in result.free}
    radius = 141.553523
    assert value["radius"] == pytest.approx(0.0, abs=STORED)
    for name, turned in (("a", 0.181908), ("b", -0.215796)):
        beside = radius * np.tan(np.radians(turned))
        assert value[f"{name}_tower.tangential"] == pytest.approx(beside, abs=2.0 * STORED)
    offsets = np.array([value[f"{k}_slide.offset"] for k in "abc"])
    assert offsets == pytest.approx(np.zeros(3), abs=2.0 * STORED)
    assert result.rms_after / MM == pytest.approx(0.0719, abs=1e-4)
    present = session.firmware
    start = Firmware(140.0, np.full(3, 280.0), np.array([210.0, 330.0, 90.0]), np.full(3, 373.0))
    travel = (np.array(present.homed) - [p.drives for p in session.postures.values()]) / MM
    peer, _ = calibrate_as_klipper(start, travel, 17.197)
    assert peer.radius == pytest.approx(radius, abs=STORED)
    assert peer.endstops == pytest.approx(present.endstops / MM, abs=STORED)


def test_what_seven_points_determine():
    """Klipper prints the radius with six decimals. Its own model leaves ± 2 mm of it; with all
    errors and priors the readings hardly add to what is known of radius and rods before."""
    session = import_printer_log(SEVEN).session
    own = identified(without_tilt(session), Choice(free=SIX, prior=False))
    assert 2.0 * own["radius"].std > 1.0 * MM
    complete = calibrate(session, **UNJUDGED)
    for weights in (RADIUS, *map(rod, "abc")):
        _, std, prior = sum_of(complete, weights)
        assert 0.85 < std / prior <= 1.0
    assert complete.assessment.of_kind("no redundancy")


def made(folder, settings, errors, seed, *, firmware="klipper", trigger=0.0, xy=None):
    """Log of a printer with given errors, and the printer."""
    log, xy = folder / "log.txt", rings() if xy is None else xy
    log.write_text(write_log(firmware, settings, xy, np.zeros(41), -trigger))
    printer = Printer(import_printer_log(log).session.robot, errors, trigger=trigger)
    rng = np.random.default_rng(seed)
    if firmware == "marlin":
        present = settings.endstops + np.sqrt(settings.rods**2 - settings.radius**2)
        settings.endstops += 560.0 - present
    z = printer.probe(settings, xy, noise=0.02, rng=rng)
    log.write_text(write_log(firmware, settings, xy, z, -trigger))
    return printer, log, z


def test_rods_do_not_drift_where_a_search_without_priors_lets_them(tmp_path):
    """Heights of a bed say next to nothing of the rods. With the rods free, coordinate descent goes
    millimetres from the truth until it reaches the scatter of the probe; here they stay, with their
    uncertainty.

    The printer is that of #5567 as its owner corrected it.
    """
    errors = {f"{k}_slide.x": -0.71e-3 for k in "abc"}
    lengths = dict(zip("abc", (0.294e-3, 0.087e-3, -0.455e-3), strict=True))
    for k, extra in lengths.items():
        errors |= {f"{k}_coupler.x": extra, f"frame.{k}_rod_b_tip.x": extra}
    settings = nominal(radius=135.0, rod=269.0)
    _, log, z = made(tmp_path, settings, errors, 3)
    travel = settings.travel(np.column_stack([rings(), z]))
    theirs, _ = calibrate_as_klipper(settings, travel, 0.0, extended=True, most=300)
    heights = locate(theirs, travel)[:, 2]
    assert np.sqrt(np.mean(heights**2)) < 0.025
    off = theirs.rods - 269.0 - 1e3 * np.array(list(lengths.values()))
    assert np.abs(off).max() > 2.0
    result = identified(import_printer_log(log).session, solver="linearised")
    for k, extra in lengths.items():
        value, std, _ = sum_of(result, rod(k))
        assert abs(value - extra / MM) < 2.5 * std
        assert std > 0.2
    assert np.abs(np.array(fit_firmware(result, "klipper").settings.rods) / MM - 269.0).max() < 2.0


def test_trims_that_absorb_other_errors_are_undone(tmp_path):
    """A printer with equal rods, driven with the trims of #14910: they are named and go away."""
    present = nominal(radius=91.5, rod=180.0)
    present.rods = 180.19 + np.array([6.348, -2.297, -3.480])
    errors = {"a_slide.x": -0.4e-3, "b_slide.offset": 0.7e-3, "c_slide.z": 0.3e-3}
    xy = 0.6 * rings()
    printer, log, _ = made(tmp_path, present, errors, 5, firmware="marlin", xy=xy)
    imported = import_printer_log(log)
    assert any("absorb" in note and "+6.158" in note for note in imported.log.notes)
    lengths = [leg.length for leg in imported.session.robot.legs.values()]
    assert lengths == pytest.approx([0.18038] * 3, abs=1e-5)
    result = identified(imported.session)
    lines = FIRMWARES["marlin"].config_lines(fit_firmware(result, "marlin").settings)
    new = read_settings("marlin", lines)
    assert np.ptp(new.rods) < 2.0
    after = printer.probe(new, xy)
    assert np.sqrt(np.mean(after**2)) < 0.02


def test_one_mistyped_height_is_named(tmp_path):
    """A height of 1.58 in place of 1.85 among 41, as a saved value or one typed by hand."""
    errors = {"a_slide.offset": 0.8e-3, "b_slide.x": 0.3e-3}
    _, log, _ = made(tmp_path, nominal(), errors, 8, trigger=1.85)
    text = log.read_text()
    assert check_session(import_printer_log(log).session).decision.verdict == "enter"
    log.write_text(text.replace("height17 = 1.85", "height17 = 1.58"))
    judged = check_session(import_printer_log(log).session)
    assert judged.decision.verdict != "enter"
    assert {p.posture for f in judged.findings for p in f.places} == {"p18"}
    x, y = rings()[17]
    found = re.search(r"x (-?[\d.]+), y (-?[\d.]+) mm", judged.decision.reason)
    assert [float(v) for v in found.groups()] == pytest.approx([x, y], abs=0.06)
    assert "orthocal record" not in "".join(f.action for f in judged.findings)


def test_a_log_with_the_settings_of_another_printer_is_rejected(tmp_path):
    """Nothing is said of offsets: the firmware takes settings."""
    _, log, z = made(tmp_path, nominal(), {}, 1, trigger=1.0)
    z += 2.5 * (np.hypot(*rings().T) / 80.0) ** 2  # as with a radius that differs by 12 mm
    log.write_text(write_log("klipper", nominal(), rings(), z, -1.0))
    decision = calibrate(import_printer_log(log).session, solver="linearised").assessment.decision
    assert decision.verdict == "reject"
    assert decision.headline == FIRMWARE_HEADLINES["reject"]
    assert "settings" in decision.action
    assert "adjust" not in decision.action
