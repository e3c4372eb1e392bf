"""Logs of the firmwares: triggers, settings, and what is refused."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from calibrated import identified
from commands import run_orthocal
from simulated_printer import Firmware, nominal, rings, write_log, write_settings

from orthocal import load_session
from orthocal.cli.files import require_not_calibrated
from orthocal.errors import SessionError
from orthocal.measurement.importing.printer_log import import_printer_log, write_printer_import
from orthocal.printers.firmwares import FIRMWARES, find_firmware
from orthocal.units import MM

PRINTED = 0.01 * MM
"""[m] Logs have three or four decimals of a mm, and whole steps of 12.5 µm to three decimals."""


def odd(firmware="klipper"):
    """Settings of a printer that was calibrated before."""
    return Firmware(
        141.2,
        np.full(3, 280.0) if FIRMWARES[firmware].equal_rods else np.array([280.0, 280.4, 279.7]),
        np.array([210.3, 329.8, 90.0]),
        np.array([317.2, 316.1, 318.0]),
    )


@pytest.fixture
def probed(tmp_path):
    """Writes a text into a log and imports it."""

    def read(text, **options):
        log = tmp_path / "log.txt"
        log.write_text(text)
        return import_printer_log(log, **options).log

    return read


@pytest.mark.parametrize("firmware", FIRMWARES)
@pytest.mark.parametrize("m851", [0.0, -1.85])
def test_carriages_where_the_probe_triggered(probed, firmware, m851):
    """Travel below the endstops, which no setting changes."""
    settings, xy = odd(firmware), rings()
    z = -m851 + 0.3 * np.sin(0.05 * xy[:, 0])
    text = write_log(firmware, settings, xy, z, m851)
    assert find_firmware(text) == firmware.rstrip("1")
    log = probed(text)
    assert log.settings.firmware == firmware
    travel = np.array(log.settings.homed) - log.carriages
    expected = settings.travel(np.column_stack([xy, z])) * MM
    assert np.abs(travel - expected).max() < PRINTED
    assert log.settings.probe == pytest.approx((0.0, 0.0, m851 * MM))
    assert np.abs(log.heights).max() < 1e-12


def test_console_lines_of_klipper_old_and_new(probed):
    """Old lines have the nozzle, new ones the point of contact; samples of a point are averaged."""
    settings = (
        write_settings("klipper", odd()) + "[probe]\nx_offset: 2\ny_offset: -3\nz_offset: 1\n"
    )
    old = probed(
        settings
        + "".join(
            f"// probe at {x},{y} is z={z}\n"
            for x, y, z in [(0, 0, 1.1), (0, 0, 1.3), (50, 0, 1.2), (0, 50, 0.9)]
        )
    )
    new = probed(
        settings
        + "".join(
            f"// probe: at {x},{y} bed will contact at z={z}\n"
            for x, y, z in [(2, -3, 0.2), (52, -3, 0.2), (2, 47, -0.1)]
        )
    )
    assert np.abs(old.carriages - new.carriages).max() < 1e-12
    expected = odd().travel([[0, 0, 1.2], [50, 0, 1.2], [0, 50, 0.9]]) * MM
    assert np.abs(np.array(old.settings.homed) - old.carriages - expected).max() < 1e-9


def test_settings_of_a_later_start_of_klipper_are_not_those_of_the_probing(probed):
    """The log of a printer that was calibrated and started again after it was probed."""
    before = write_settings("klipper", odd()) + "[probe]\nz_offset: 1.5\n"
    after = write_settings("klipper", nominal()) + "[probe]\nz_offset: 2\n"
    points = "".join(f"probe at {x},{y} is z={z}\n" for x, y, z in POINTS)
    expected = probed(before + points)
    log = probed(before + points + after)
    assert log.settings == expected.settings
    assert np.abs(log.carriages - expected.carriages).max() < 1e-12
    assert probed(before + calculation() + after).settings.probe[2] == pytest.approx(-1.5 * MM)


@pytest.mark.parametrize(
    ("firmware", "key"),
    [("klipper", "z_offset"), ("marlin", "M851 Z"), ("reprapfirmware", "G31 Z")],
)
@pytest.mark.parametrize("stated", [True, False])
def test_a_probe_without_its_height_is_named(tmp_path, firmware, key, stated):
    """On stderr: the first layer is wrong by that height."""
    text = write_log(firmware, odd(), rings(), np.zeros(41), -1.0)
    if firmware == "klipper":
        points = "".join(f"probe at {x:.3f},{y:.3f} is z=1.0\n" for x, y in rings())
        text = f"{write_settings('klipper', odd())}[bltouch]\nz_offset: 1.0\n{points}"
    lines = [v for v in text.splitlines() if stated or key.split()[0] not in v]
    (tmp_path / "log.txt").write_text("\n".join(lines) + "\n")
    done = run_orthocal(tmp_path, "import", "log.txt", "bed")
    assert done.returncode == 0, done.stderr
    assert (key in done.stderr) == (not stated)
    assert ("[bltouch]" in done.stderr) == (not stated and firmware == "klipper")


def test_saved_heights_state_that_of_the_probe(probed):
    """Beside the nozzle or not, with z_offset or without."""
    text = write_log("klipper", odd(), rings(), np.full(41, 1.0), -1.0)
    with_place = text.replace("z_offset: 1.0", "x_offset: 2")
    for log in (probed(text), probed(text.replace("z_offset: 1.0", "")), probed(with_place)):
        assert log.settings.probe[2] == pytest.approx(-1.0 * MM)
        assert not log.notes
        assert np.abs(log.heights).max() < 1e-12


POINTS = np.array([[0, 0, 1.5], [50, 0, 1.5], [0, 50, 1.5], [-20, -50, 0.1]])


def calculation(**changed):
    """Calculation of delta_calibrate in klippy.log for POINTS in reverse order."""
    s = odd()
    parameters = {"radius": s.radius}
    for i, k in enumerate("abc"):
        parameters |= {f"angle_{k}": s.angles[i], f"arm_{k}": s.rods[i], f"stepdist_{k}": 0.01}
        parameters |= {f"endstop_{k}": s.endstops[i]}
    stated = ", ".join(
        f"'{k}': {v}" for k, v in ({k: float(v) for k, v in parameters.items()} | changed).items()
    )
    steps = s.travel(POINTS) / 0.01
    pairs = [
        (float(p[2]), tuple(map(float, t))) for p, t in zip(POINTS[::-1], steps[::-1], strict=True)
    ]
    return (
        f"Calculating delta_calibrate with:\n{pairs}\n[(74.0, {pairs[0][1]}, {pairs[1][1]})]\n"
        f"Initial delta_calibrate parameters: {{{stated}}}\nCoordinate descent initial error: 1\n"
    )


def test_a_calculation_in_klippy_log(probed):
    """It holds its own parameters, and heights measured by hand count as they are."""
    log, points = probed(calculation()), POINTS
    assert np.abs(log.settings.forward(log.carriages) / MM - points[::-1]).max() < 1e-6
    assert log.heights == pytest.approx(np.array([-1.4, 0, 0, 0]) * MM)
    (distance,) = log.distances
    assert distance.length == pytest.approx(74.0 * MM)
    assert distance.carriages == pytest.approx(log.carriages[[1, 0]], abs=1e-12)


def test_manual_heights_of_a_calculation_are_those_of_the_nozzle(probed):
    """They are not used beside a probe at another place; without a probe all are."""
    probe = "[probe]\nx_offset: 20\nz_offset: 1.5\n"
    log = probed(probe + calculation())
    assert len(log.heights) == 3
    assert "Manual heights are not used (1)" in log.notes[0]
    assert log.settings.probe == pytest.approx((20.0 * MM, 0.0, -1.5 * MM))
    assert log.heights == pytest.approx(np.zeros(3))
    by_hand = calculation().replace("(1.5, (", "(0.0, (")
    log = probed(probe + by_hand)
    assert log.settings.probe == pytest.approx((0.0, 0.0, -1.5 * MM))
    assert log.heights == pytest.approx(np.array([-1.4, -1.5, -1.5, -1.5]) * MM)


def test_tables_of_g33_and_grids(probed):
    """G33 prints names of towers, a bilinear grid rows from the front to the back."""
    base = nominal()
    table = (
        ">>> G33 P3 V3\nG33 Auto Calibrate\nChecking... AC\n"
        f".Height:{base.endstops[0]:.2f}    Ex:-0.10  Ey:+0.00  Ez:-0.20    Radius:140.00\n"
        ".Tower angle :    Tx:+0.00  Ty:+0.00  Tz:+0.00\n"
        ".    c:+0.011   x:+0.200   y:-0.100   z:+0.300\n"
        ".             yz:+0.400  zx:-0.500  xy:+0.600\n"
        "Iteration : 01                                    std dev:0.400\n"
        ".Height:999.00    Ex:-0.10  Ey:+0.00  Ez:-0.20    Radius:120.00\n"
        ".Tower angle :    Tx:+0.00  Ty:+0.00  Tz:+0.00\n.    c:+9.000\n"
    )
    settings = "M665 L280.00 R140.00 H300\nM666 X-0.1 Y0 Z-0.2\n"
    with pytest.raises(SessionError) as raised:
        probed(settings + table)
    assert raised.value.where == "--radius-mm"
    log = probed(settings + table, radius=0.08)
    found = log.settings.forward(log.carriages) / MM
    angles = np.radians([210, 330, 90, 30, 150, 270])
    heights = [0.011, 0.2, -0.1, 0.3, 0.4, -0.5, 0.6]
    xy = np.vstack([[0, 0], 80 * np.column_stack([np.cos(angles), np.sin(angles)])])
    assert np.abs(found - np.column_stack([xy, heights])).max() < 1e-9
    lowered = log.settings.endstops - log.settings.endstops[1]
    assert lowered == pytest.approx(np.array([0.1, 0.0, 0.2]) * MM)
    grid = "Bilinear Leveling Grid:\n      0      1      2\n"
    grid += " 0 +9.0 -0.2 +9.0\n 1 +0.1 +0.0 +0.4\n 2 +9 +0.5 +9\n"
    log = probed(settings + grid, radius=0.06)
    found = log.settings.forward(log.carriages) / MM
    assert (
        np.abs(found - [[0, -60, -0.2], [-60, 0, 0.1], [0, 0, 0], [60, 0, 0.4], [0, 60, 0.5]]).max()
        < 1e-9
    )
    with pytest.raises(SessionError, match="G33 P6"):
        probed(settings + table.replace("G33 P3", "G33 P6"), radius=0.08)


def test_reports_of_reprapfirmware(probed):
    """Replies to M665 and M666 without parameters."""
    text = (
        "Diagonals 280.000:280.400:279.700, delta radius 141.200, homed height 317.100, bed radius "
        "90.0, X 0.300°, Y -0.200°, Z 0.000°\n"
        "Endstop adjustments X0.10 Y-1.00 Z0.90, tilt X0.30% Y-0.20%\n"
        "G31 X2 Y3 Z1.5\nG30 P0 X0 Y0 Z-9999\nG30 P2 X0 Y50 Z-9999\nG30P1X50Y0Z-9999S-1\n"
        "G32 bed probe heights: 0.100 0.200 0.300, mean 0.2, deviation from mean 0.1\n"
    )
    log = probed(text)
    expected = Firmware(*vars(odd()).values())
    expected.tilts = (0.003, -0.002)
    nozzle = np.array([[-2, -3, 1.6], [48, -3, 1.7], [-2, 47, 1.8]])
    travel = np.array(log.settings.homed) - log.carriages
    assert np.abs(travel - expected.travel(nozzle) * MM).max() < 1e-9


KLIPPER = write_log("klipper", nominal(), rings()[:4], np.zeros(4), -1.0)
MARLIN = write_log("marlin", nominal(), rings()[:4], np.zeros(4))
CFG = write_settings("klipper", nominal())
RRF = write_log("reprapfirmware", nominal(), rings()[:4], np.zeros(4))


@pytest.mark.parametrize(
    ("text", "where", "found"),
    [
        ("hello\n", "log.txt", "no known firmware"),
        (KLIPPER + MARLIN, "log.txt", "several"),
        (KLIPPER.replace("delta_radius: 140.000000", "delta_radius: x"), "[printer]", "'x'"),
        (KLIPPER.replace("kinematics: delta", "kinematics: corexy"), "[printer] kin", "'corexy'"),
        (KLIPPER.replace("microsteps: 16", "m: 1"), "[stepper_a]", "microsteps"),
        (KLIPPER.replace("arm_length: 280.0", "arm_length: 1620.0", 1), "log.txt", "1620"),
        (KLIPPER.replace("height1_pos = ", "height1_pos = 1,"), "height1_pos", "4 numbers"),
        (MARLIN.replace("L280.0", "Q280.0"), "log.txt", "M665 L"),
        (MARLIN.replace("R140.0", "R340.0"), "log.txt", "R 340"),
        (MARLIN.replace("Bed X: 0.0000", "Bed X: 990.0000"), "log.txt", "x 990"),
        (MARLIN.replace("Bed X: -", "Bed -"), "log.txt", "probed points"),
        (MARLIN + "M665 L280.0 R141.5 H300.0\n", "log.txt:", "R is 141.5, and 140 before"),
        (KLIPPER.replace("#*# height1 =", "#*# other ="), "height1", "missing"),
        (CFG + "probe at 0.0,0.0 is z=0,634\n" * 7, "log.txt:", "decimal comma"),
        (CFG + "probe at 0,000,0,000 is z=0,634\n", "log.txt:", "with a decimal point"),
        (CFG + "probe: at 0.0,0.0 bed will contact at z=\n", "log.txt:", "contact at z='"),
        (RRF.replace("G30 P3", "G30 P2"), "log.txt:", "4 heights of 3 points"),
        (RRF.replace("heights: 0.0000", "heights: failed"), "log.txt:", "failed"),
    ],
)
def test_what_is_refused_is_named(probed, text, where, found):
    with pytest.raises(SessionError) as raised:
        probed(text)
    assert where in str(raised.value.where)
    assert found in raised.value.problem


def test_a_wrong_probe_is_sought_in_the_file_with_settings(tmp_path):
    log, settings = tmp_path / "log.txt", tmp_path / "printer.cfg"
    settings.write_text(write_settings("klipper", odd()) + "[probe]\nz_offset: x\n")
    log.write_text("probe at 0.0,0.0 is z=1.25\n" * 3)
    with pytest.raises(SessionError) as raised:
        import_printer_log(log, settings=[settings])
    assert "printer.cfg" in str(raised.value.where)


def test_lines_that_a_host_received(probed):
    """With and without a time, as terminal and log of a host show them."""
    plain = probed(MARLIN)
    for prefix in ("Recv: ", "2026-03-01 10:00:07,125 - Recv: "):
        log = probed("".join(f"{prefix}{line}\n" for line in MARLIN.splitlines()))
        assert np.array_equal(log.carriages, plain.carriages)


def test_a_missing_log_is_named(tmp_path):
    done = run_orthocal(tmp_path, "import", "none.cfg", "bed")
    assert done.returncode == 2
    assert "none.cfg: there is no such file" in done.stderr
    (tmp_path / "notes.txt").write_text("hello\n")
    done = run_orthocal(tmp_path, "import", "notes.txt", "bed")
    assert done.returncode == 2
    assert "notes.txt is not recognised as a printer's log" in " ".join(done.stderr.split())


@pytest.mark.parametrize("words", [[], ["--dry-run"]], ids=["written", "tried"])
def test_the_command_prints_json(tmp_path, words):
    log = tmp_path / "printer.cfg"
    log.write_text(write_log("klipper", odd(), rings(), np.zeros(41), -1.0))
    done = run_orthocal(tmp_path, "import", log, tmp_path / "bed", "--json", *words)
    document, direct = json.loads(done.stdout), import_printer_log(log)
    carriages = [p["carriages_mm"] for p in document["points"]]
    assert carriages == pytest.approx(direct.log.carriages / MM)
    assert document["settings"]["rods_mm"] == pytest.approx([280.0, 280.4, 279.7])
    written = None if words else str(tmp_path / "bed/session.yaml")
    assert document["written"] == written
    assert (tmp_path / "bed").exists() == (not words)
    if not words:
        session = load_session(tmp_path / "bed")
        assert len(session.readings) == 41
        assert session.firmware.radius == pytest.approx(direct.session.firmware.radius)
        again = run_orthocal(tmp_path, "import", log, tmp_path / "bed", "--format", "klipper")
        assert (again.returncode, "exists" in again.stderr) == (2, True)


def test_heights_of_a_file_with_settings_are_not_those_of_a_log(tmp_path):
    """A printer.cfg keeps the heights of an earlier probing."""
    (tmp_path / "printer.cfg").write_text(KLIPPER)
    (tmp_path / "console.txt").write_text("ok\n")
    with pytest.raises(SessionError, match="found no probed points"):
        import_printer_log(tmp_path / "console.txt", settings=[tmp_path / "printer.cfg"])


def test_the_later_heights_count(probed):
    """Klippy.log begins with the configuration and its saved heights."""
    lines = "".join(f"probe at {x:.3f},{y:.3f} is z=0.1\n" for x, y in rings())
    for after in (KLIPPER + lines, KLIPPER + lines + KLIPPER):  # each start prints them again
        log = probed(after)
        assert len(log.carriages) == 41
        assert log.notes == ("4 saved heights are not used: they are older.",)
    assert len(probed(lines + KLIPPER).carriages) == 4


def test_saved_heights_with_entered_settings_are_a_copy(tmp_path):
    """The travels are the same, although all settings differ."""
    log = write_log("klipper", odd(), rings(), 0.1 * np.sin(rings()[:, 0]), -1.0)
    (tmp_path / "old.cfg").write_text(log)
    (tmp_path / "new.cfg").write_text(
        log.replace(write_settings("klipper", odd()), write_settings("klipper", nominal()))
    )
    for name in ("old", "new"):
        assert run_orthocal(tmp_path, "import", f"{name}.cfg", name).returncode == 0
    done = run_orthocal(tmp_path, "calibrate", "old", "new")
    assert done.returncode == 2
    assert "new/readings.csv: has the same readings as old/session.yaml" in done.stderr
    one, other = (load_session(tmp_path / name) for name in ("old", "new"))
    assert one.firmware.homed != other.firmware.homed


def test_a_copy_of_one_of_several_calibrated_logs_is_refused(tmp_path):
    """A joint calibration names the postures of each log after its session."""
    heights = 0.1 * np.sin(rings()[:, 0]), 0.1 * np.cos(rings()[:, 1]), 0.1 * np.sin(rings()[:, 1])
    for name, z in zip(("old", "second", "third"), heights, strict=True):
        (tmp_path / "log.txt").write_text(write_log("klipper", odd(), rings(), z, -1.0))
        write_printer_import(import_printer_log(tmp_path / "log.txt"), tmp_path / name)
    old, second, third = (load_session(tmp_path / n) for n in ("old", "second", "third"))
    calibration = identified([old, second])
    require_not_calibrated([third], calibration)
    for copied in (old, second):
        copy = replace(copied, sha256="")
        with pytest.raises(SessionError, match=f"same readings as .*{copied.path.parent.name}"):
            require_not_calibrated([copy], calibration)


def test_options_of_tables_are_refused_for_a_log(tmp_path):
    (tmp_path / "printer.cfg").write_text(KLIPPER)
    done = run_orthocal(tmp_path, "import", "printer.cfg", "bed", "--unit", "inch")
    assert done.returncode == 2
    assert "--unit: is for tables; found the log of a printer" in done.stderr
    for code in (0, 2):  # not into a session that exists, as if it were a table
        done = run_orthocal(tmp_path, "import", "printer.cfg", "bed")
        assert done.returncode == code
    assert "exists already; choose another directory" in done.stderr
    done = run_orthocal(tmp_path, "import", "printer.cfg", "bed/printer")
    assert (done.returncode, "directory of a robot" in done.stderr) == (2, True)


@pytest.mark.parametrize("height", [-17.2, 0.0, 4.0])
def test_a_bed_far_from_its_height_is_named(probed, height):
    """A console without the offset of the probe, which the settings state."""
    text = write_settings("klipper", odd()) + "[probe]\nz_offset: 17.2\n"
    text += "".join(f"probe at {x:.3f},{y:.3f} is z={17.2 + height:.3f}\n" for x, y in rings())
    notes = [note for note in probed(text).notes if "the offset of the probe is wrong" in note]
    assert len(notes) == (abs(height) > 5.0)
    assert all(f"{height:.3f} mm" in note for note in notes)


def test_what_two_readers_of_a_setting_disagree_about_is_refused(probed):
    """A colon in M666 beside what G33 printed, as a damaged line has it."""
    text = (
        "M665 L280 R140 H300\nM666 X0 Y0:-0.2\n.Height:300.00  Ex:+0.00  Ey:+0.00  Ez:+0.00  "
        "Radius:140.00\n.    c:+0.0   x:+0.2   y:-0.1   z:+0.3\n"
    )
    with pytest.raises(SessionError, match=r"0:-0\.2"):
        probed(text, radius=0.08)


def test_words_of_a_command_need_no_blanks(probed):
    """Marlin and RepRapFirmware read `M666 X-0.5Y0.8Z-0.3`."""
    for firmware in ("marlin", "reprapfirmware"):
        text = write_log(firmware, odd(firmware), rings(), np.zeros(len(rings())))
        expected = probed(text).settings
        close = re.sub(r"(?m)^(.*\bM66[56]\b) ?(.*)$", lambda m: m[1] + m[2].replace(" ", ""), text)
        assert close != text
        assert probed(close).settings == expected


def test_sections_with_hyphens_are_sections(probed):
    """Their keys are not those of the section before."""
    text = write_log("klipper", odd(), rings(), np.zeros(len(rings())))
    at = text.index("[", text.index("[stepper_c]") + 1)
    other = "[extruder_stepper right-hand]\nrotation_distance: 22.6\nmicrosteps: 32\n\n"
    found = probed(text[:at] + other + text[at:])
    assert found.carriages == pytest.approx(probed(text).carriages, abs=1e-12)


@pytest.mark.parametrize("value", ["1e200", "1e999", "1" + 400 * "0"])
@pytest.mark.parametrize("name", ["arm_a", "stepdist_a"])
def test_numbers_of_a_calculation_are_finite(probed, name, value):
    with pytest.raises(SessionError, match=r"is damaged|expected"):
        probed(calculation(**{name: value}))


def test_nothing_is_written_for_a_wrong_log(tmp_path):
    log = tmp_path / "log.txt"
    log.write_text(RRF.replace("G30 P3", "G30 P2"))
    done = run_orthocal(tmp_path, "import", log, tmp_path / "bed", "--format", "reprapfirmware")
    assert done.returncode == 2
    assert not (tmp_path / "bed").exists()


def test_settings_may_come_from_another_file(tmp_path):
    (tmp_path / "printer.cfg").write_text(write_settings("klipper", odd()))
    log = tmp_path / "console.txt"
    log.write_text("".join(f"probe at {x:.3f},{y:.3f} is z=0.1\n" for x, y in rings()))
    result = import_printer_log(log, settings=[tmp_path / "printer.cfg"])
    write_printer_import(result, tmp_path / "bed")
    assert load_session(tmp_path / "bed").firmware.rods == pytest.approx((0.28, 0.2804, 0.2797))
