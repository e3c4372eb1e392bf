"""Closed forms of the firmwares, and their lines."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import fsolve
from simulated_printer import nominal, read_settings
from tolerances import CLOSED_FORM

from orthocal.errors import SessionError
from orthocal.printers.firmwares import FIRMWARES
from orthocal.printers.settings import DESIGN_ANGLES, DeltaSettings
from orthocal.units import DEG, MM

ROUNDING = 1e-6
"""[m] Change at the nozzle by the rounding of printed settings."""


def odd(firmware="klipper"):
    """Settings with everything different."""
    turns = np.array([0.7, -0.4, 0.2]) * DEG
    rods = (0.2801234567, 0.2812345678, 0.2793456789)
    tilts = (0.003, -0.002) if firmware == "reprapfirmware" else (0.0, 0.0)
    return DeltaSettings(
        firmware,
        0.1412345678,
        rods[:1] * 3 if FIRMWARES[firmware].equal_rods else rods,
        (0.5512345678, 0.5498765432, 0.5523456789),
        tuple((np.array(DESIGN_ANGLES) + turns).tolist()),
        tilts,
        (0.0, 0.0, -1.23456e-3),
    )


def points():
    rng = np.random.default_rng(5)
    return rng.uniform([-0.07, -0.07, 0.0], [0.07, 0.07, 0.15], (40, 3))


def test_forward_meets_the_spheres():
    s = odd("reprapfirmware")
    for point, h in zip(points(), s.inverse(points()), strict=True):

        def spheres(p, h=h):
            lifted = p[2] + p[0] * s.tilts[0] + p[1] * s.tilts[1]
            across = (p[:2] - s.towers) ** 2
            return np.sqrt(across.sum(axis=1) + (lifted - h) ** 2) - s.rods

        assert np.abs(fsolve(spheres, [0.0, 0.0, 0.05], xtol=1e-13) - point).max() < CLOSED_FORM
        assert np.abs(s.forward(h) - point).max() < CLOSED_FORM


@pytest.mark.parametrize("firmware", FIRMWARES)
def test_printed_lines_mean_these_settings(firmware):
    """Read by another reader, they move each carriage as far, to a micrometre at the nozzle."""
    s = odd(firmware)
    lines = FIRMWARES[firmware].config_lines(s)
    read = read_settings(firmware, lines, m851=s.probe[2] / MM)
    travel = (np.array(s.homed) - s.inverse(points())) / MM
    printed = read.travel(points() / MM)
    there = s.forward(np.array(s.homed) - printed * MM)
    assert np.abs(travel - printed).max() < 2e-3
    assert np.abs(there - points()).max() < ROUNDING


def test_settings_agree_with_the_simulated_firmware():
    s = DeltaSettings("klipper", 0.14, (0.28,) * 3, (0.56,) * 3)
    travel = (np.array(s.homed) - s.inverse(points())) / MM
    assert np.abs(travel - nominal().travel(points() / MM)).max() * MM < CLOSED_FORM


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"rods": (1.620, 0.773, 0.831)}, "rods of tower a"),
        ({"radius": 0.02}, "radius"),
        ({"angles": (230 * DEG, 330 * DEG, 90 * DEG)}, "tower a"),
    ],
)
def test_settings_that_no_printer_has_are_refused(change, named):
    """The rods are those that a search without priors found (Klipper #5567)."""
    values = {"radius": 0.13571, "rods": (0.2693, 0.2691, 0.2685), **change}
    settings = DeltaSettings("klipper", homed=(0.5,) * 3, **values)
    with pytest.raises(SessionError, match=named):
        settings.require_plausible()


def test_a_point_beyond_the_rods_is_refused():
    with pytest.raises(SessionError, match="x 500"):
        odd().inverse([[0.5, 0.0, 0.0]])
