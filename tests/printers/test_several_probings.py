"""Logs with several probings, with answers that state no heights, and with too small a bed."""

from __future__ import annotations

import numpy as np
import pytest
from simulated_printer import Firmware, nominal, rings, write_log, write_settings

from orthocal.errors import SessionError
from orthocal.measurement.importing.printer_log import import_printer_log
from orthocal.printers.firmwares import FIRMWARES
from orthocal.units import MM

TOLERANCE_MM = 0.01
NEW = Firmware(141.5, np.full(3, 280.0), np.array([210.0, 330.0, 90.0]), np.full(3, 318.0))
"""Settings that were entered between two probings."""


@pytest.fixture
def read(tmp_path):
    """Writes texts into a log and files with settings, and imports them."""

    def read(text, *settings, **options):
        (tmp_path / "log.txt").write_text(text)
        files = []
        for i, content in enumerate(settings):
            files.append(tmp_path / f"settings{i}.txt")
            files[-1].write_text(content)
        return import_printer_log(tmp_path / "log.txt", settings=files, **options).log

    return read


def z_of(log):
    """Heights of the nozzle at the triggers in the firmware's coordinates, [mm]."""
    return log.settings.forward(log.carriages)[:, 2] / MM


def console(z, xy=None):
    """Lines of Klipper's console."""
    points = zip(rings() if xy is None else xy, z, strict=True)
    return "".join(f"// probe at {x:.3f},{y:.3f} is z={h:.6f}\n" for (x, y), h in points)


CFG = write_settings("klipper", nominal()) + "[probe]\nz_offset: 1\n"
ONE, TWO = 1.0 + 0.001 * np.arange(41), 1.3 + 0.002 * np.arange(41)


def test_the_last_complete_probing_is_used(read):
    assert z_of(read(console(ONE), CFG)) == pytest.approx(ONE, abs=1e-5)
    log = read(console(ONE) + "// done\n" + console(TWO), CFG)
    assert z_of(log) == pytest.approx(TWO, abs=1e-5)
    assert "2 probings" in log.notes[0]
    assert "log.txt:43 to line 83" in log.notes[0]
    stopped = read(console(TWO) + console(ONE[:20], rings()[:20]), CFG)
    assert z_of(stopped) == pytest.approx(TWO, abs=1e-5)
    assert "log.txt:1 to line 41" in stopped.notes[0]


def test_points_that_are_repeated_in_another_order_are_one_probing(read):
    order = np.random.default_rng(1).permutation(41)
    log = read(console(ONE) + console(ONE[order], rings()[order]), CFG)
    assert len(log.carriages) == 82
    assert not log.notes


def test_saved_heights_of_the_settings_are_older_than_the_log(read):
    """printer.cfg still has the heights of the first DELTA_CALIBRATE."""
    saved = write_log("klipper", nominal(), rings(), ONE, -1.0)
    assert z_of(read(console(TWO), saved)) == pytest.approx(TWO, abs=TOLERANCE_MM)
    assert z_of(read(saved)) == pytest.approx(ONE, abs=TOLERANCE_MM)


@pytest.mark.parametrize("firmware", ["marlin", "marlin1"])
def test_settings_are_those_before_the_last_probing(read, firmware):
    first, second = (
        write_log(firmware, s, rings(), z, -1.0) for s, z in ((nominal(), ONE), (NEW, TWO))
    )
    log = read(first + second)
    assert z_of(log) == pytest.approx(TWO, abs=1e-3)
    assert log.settings.radius == pytest.approx(141.5 * MM)
    partial = write_log(firmware, NEW, rings()[:5], TWO[:5], -1.0)
    log = read(first + partial)
    assert z_of(log) == pytest.approx(ONE, abs=1e-3)
    assert log.settings.radius == pytest.approx(140.0 * MM)
    with pytest.raises(SessionError, match=r"R is 141\.5") as raised:
        read(first + write_settings(firmware, NEW, -1.0))
    assert "log.txt:" in raised.value.where


G33 = (
    "G33 Auto Calibrate\nChecking... AC\n.Height:{h:.2f}  Ex:+0.00  Ey:+0.00  Ez:+0.00  "
    "Radius:{r:.2f}\n.Tower angle :    Tx:+0.00  Ty:+0.00  Tz:+0.00\n{table}"
)
TABLE = (
    ".    c:+0.0{i}   x:+0.20   y:-0.10   z:+0.30\n.      yz:+0.40  zx:-0.50  xy:+0.60\n"
    ".Height:310.00  Ex:+0.00  Ey:+0.00  Ez:+0.00  Radius:145.00\n.    c:+9.00 x:+9 y:+9 z:+9\n"
)
POINTS = "Bed X: 0 Y: 0 Z: 0.1\nBed X: 50 Y: 0 Z: 0.1\nBed X: 0 Y: 50 Z: 0.1\n"
M503 = "M665 L280.00 R140.00 H310.000 S200 B80.00 X0.00 Y0.00 Z0.00\nM666 X0 Y0 Z0\nM851 Z0\n"


def test_the_last_complete_g33_is_used(read):
    """After one that failed, and before one that failed."""
    failed = G33.format(h=310.0, r=140.0, table="Error:Probing failed\n")
    runs = [G33.format(h=310.0, r=r, table=TABLE.format(i=i)) for i, r in ((1, 140.0), (2, 141.5))]
    for text, radius, middle in (
        (failed + runs[0], 140.0, 0.01),
        (runs[0] + failed, 140.0, 0.01),
        (runs[0] + runs[1], 141.5, 0.02),
    ):
        log = read(M503 + text, radius=0.08)
        assert len(log.carriages) == 7
        assert z_of(log)[0] == pytest.approx(middle, abs=1e-9)
        assert log.settings.radius == pytest.approx(radius * MM)


def test_g33_before_other_points_changed_the_settings(read):
    """The settings of G29 are those that M503 or G33 printed last before it."""
    g33 = G33.format(h=309.0, r=141.5, table=TABLE.format(i=1).replace("145.00", "141.52"))
    assert read(M503 + g33 + POINTS).settings.radius == pytest.approx(141.52 * MM)
    exact = M503.replace("R140.00", "R141.518")
    assert read(M503 + g33 + exact + POINTS).settings.radius == pytest.approx(141.518 * MM)


def test_b_is_a_radius_in_marlin_1(read):
    log = read(M503 + POINTS)
    assert log.settings.firmware == "marlin1"
    assert log.settings.rods == pytest.approx([0.28] * 3)
    assert "B80" in log.notes[0]
    with pytest.raises(SessionError, match="B: 80 mm") as raised:
        read(M503 + G33.format(h=310.0, r=140.0, table=TABLE.format(i=1)))
    assert raised.value.where == "--radius-mm"


@pytest.mark.parametrize(
    ("letters", "firmware", "rods"),
    [
        ("B0.40", "marlin", [280.0, 280.4, 280.0]),
        ("A-0.1 B0.40 C0.20", "marlin", [279.9, 280.4, 280.2]),
        ("", "marlin1", [280.0] * 3),
    ],
)
def test_b_is_a_trim_in_later_versions(read, letters, firmware, rods):
    """What M503 prints without A, B and C has no trims."""
    settings = read(M503.replace("B80.00", letters) + POINTS).settings
    assert settings.firmware == firmware
    assert np.array(settings.rods) / MM == pytest.approx(rods)


def test_trims_that_marlin_1_lacks_are_refused(read):
    with pytest.raises(SessionError, match="--format marlin"):
        read(M503.replace("B80.00", "A0 B0 C1") + POINTS, firmware="marlin1")
    assert read(M503.replace("S200 B80.00", "") + POINTS, firmware="marlin1").settings.firmware == (
        "marlin1"
    )


RRF = write_log("reprapfirmware", nominal(), rings(), np.zeros(41))
HEAD, REPORT = RRF[: RRF.index("G32 bed")], RRF[RRF.index("G32 bed") :]
S6 = "Calibrated 6 factors using 41 points, (mean, deviation) before (0.1, 0.2) after (0.0, 0.02)\n"
ANSWERS = (
    "Diagonals 280.000:280.000:280.000, delta radius 141.500, homed height 310.000, bed radius "
    "90.0, X 0.000°, Y 0.000°, Z 0.000°\nEndstop adjustments X0.00 Y0.00 Z0.00, tilt X0.00% "
    "Y0.00%\n"
)


@pytest.mark.parametrize(
    ("text", "line", "found"),
    [
        (HEAD + S6, 46, "S-1"),
        (HEAD + S6.replace("(mean, deviation)", "deviation"), 46, "S-1"),
        ("Stopped at height 1.234 mm\n", 1, "states no place"),
        (HEAD + REPORT.replace(" 0.0000", " not set", 1), 46, "P0 has 'not set'"),
        (HEAD + REPORT.replace(" 0.0000", " probing failed", 1), 46, "P0 has 'probing failed'"),
        (HEAD + REPORT + S6 + ANSWERS, 47, "after the heights"),
        (HEAD + S6 + REPORT, 46, "before the heights"),
    ],
)
def test_answers_without_heights_or_with_other_settings(read, text, line, found):
    with pytest.raises(SessionError, match=found) as raised:
        read(text)
    assert raised.value.where.endswith(f"log.txt:{line}")


def test_answers_of_reprapfirmware_that_are_read(read):
    """Old versions write a capital, M122 the first heights; M665 answers after a calibration."""
    assert len(read(HEAD + REPORT.replace("G32 bed", "Bed")).carriages) == 41
    diagnosis = "Bed probe heights: 0.000 0.000 0.000 0.000 0.000\n"
    assert len(read(HEAD + REPORT + diagnosis).carriages) == 41
    log = read(HEAD + S6 + ANSWERS + REPORT)
    assert log.settings.radius == pytest.approx(141.5 * MM)


def test_the_last_report_has_the_points_before_it(read):
    """bed.g changed in between: fewer points, farther out."""
    fewer = "".join(f"G30 P{i} X{x} Y{y} Z-9\n" for i, (x, y) in enumerate(rings()[-5:]))
    second = "G32 bed probe heights: 0.1 0.2 0.3 0.4 0.5, mean 0.3, deviation from mean 0.1\n"
    log = read(RRF + fewer + second)
    assert z_of(log) == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5], abs=1e-9)
    assert "2 probings" in log.notes[0]
    assert len(read(RRF + REPORT).carriages) == 41


def test_lines_are_those_of_their_file(read):
    """With settings in other files."""
    with pytest.raises(SessionError) as raised:
        read(console(ONE).replace("z=1.010000", "z=1,01"), CFG)
    assert raised.value.where.endswith("log.txt:11")
    marlin = write_settings("marlin", nominal()) + "M665 R150\n"
    with pytest.raises(SessionError) as raised:
        read("Bed X: 0 Y: 0 Z: 0.1\n" * 3, marlin)
    assert raised.value.where.endswith("settings0.txt:6")


@pytest.mark.parametrize(("share", "noted"), [(1.0, False), (0.5, True)])
@pytest.mark.parametrize("firmware", FIRMWARES)
def test_points_near_the_middle_are_noted(read, firmware, share, noted):
    """Points within 40 mm of a printer with a radius of 140 mm."""
    log = read(write_log(firmware, nominal(), share * rings(), np.full(41, 1.0), -1.0))
    notes = [n for n in log.notes if "within 40 mm of the middle" in n]
    assert len(notes) == noted
