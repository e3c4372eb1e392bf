"""RepRapFirmware: settings by M665, M666 and G31, heights reported by G30 and G32.

A height is that of the nozzle at the trigger minus the trigger height of G31. Sources:
src/Movement/Kinematics/LinearDeltaKinematics.cpp, src/Movement/BedProbing/RandomProbePointSet.cpp.
"""

from __future__ import annotations

import re

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import SessionError
from orthocal.printers.log import (
    NUMBER,
    PrinterLog,
    last_words,
    numbers,
    place_of,
    probed_log,
    require_points,
    unstated_trigger,
)
from orthocal.printers.settings import DESIGN_ANGLES, DeltaSettings
from orthocal.units import DEG, MM

DECIMALS = 4
"""Decimals of settings."""

EXPECTED = (
    "the line 'bed probe heights:' that G30 or G32 with S-1 reports, and the lines 'G30 P X Y' of "
    "bed.g and 'M665', 'M666' and 'G31' of config.g (--settings)"
)

_HEIGHTS = re.compile(r"bed probe heights:(?P<values>[^,\n]*)")
_POINT = re.compile(r"^[^;\n]*?\bG30\b(?P<words>[^;\n]*)", re.MULTILINE)
_M665 = re.compile(
    rf"Diagonals? (?P<L>{NUMBER}(?::{NUMBER})*), delta radius (?P<R>{NUMBER}), homed height "
    rf"(?P<H>{NUMBER}), bed radius {NUMBER}, X (?P<X>{NUMBER})[^,]*, Y (?P<Y>{NUMBER})[^,]*, "
    rf"Z (?P<Z>{NUMBER})"
)
_M666 = re.compile(
    rf"Endstop adjustments X(?P<X>{NUMBER}) Y(?P<Y>{NUMBER}) Z(?P<Z>{NUMBER})"
    rf"(?:, tilt X(?P<A>{NUMBER})% Y(?P<B>{NUMBER})%)?"
)


def recognise(text: str) -> bool:
    """True if a text is certainly from RepRapFirmware."""
    return bool(_HEIGHTS.search(text) or _M665.search(text))


def read_log(text: str, *, where: str, radius: float | None = None) -> PrinterLog:
    """Read settings and probed points.

    Args:
        text: The log and files with settings and points.
        where: Name of the log, for messages.
        radius: Not used.

    Raises:
        SessionError: If the text is invalid; names the line or the missing setting.
    """
    del radius
    reports = list(_HEIGHTS.finditer(text))
    if not reports:
        require_points(0, where=where, expected=EXPECTED)
    report = reports[-1]
    line = place_of(text, report.start(), where)
    heights = numbers(report["values"].split(), where=line, name="a bed probe height")
    points = _points(text, where)
    if len(points) != len(heights):
        raise SessionError(
            f"reports {len(heights)} heights of {len(points)} points; expected a line 'G30 P X Y' "
            "of bed.g for each height (--settings bed.g)",
            where=line,
        )
    g31 = last_words(text, "G31")
    x, y, z = numbers([g31.get(k, "0") for k in "XYZ"], where=where, name="G31")
    nozzle = np.column_stack([points - [x, y], np.array(heights) + z]) * MM
    settings = _settings(text, np.array([x, y, -z]) * MM, where)
    notes = [] if "Z" in g31 else [unstated_trigger("G31 Z")]
    return probed_log(settings, nozzle, where=where, expected=EXPECTED, notes=notes)


def _points(text: str, where: str) -> Array:
    """Points of the commands G30 P in the order of their numbers, shape (K, 2), [mm]."""
    places = {}
    for match in _POINT.finditer(text):
        words = dict(re.findall(rf"\b([A-Z])({NUMBER})", match["words"]))
        if {"P", "X", "Y"} <= words.keys():
            line = place_of(text, match.start(), where)
            number, x, y = numbers([words[k] for k in "PXY"], where=line, name="G30")
            places[number] = (x, y)
    return np.array([places[k] for k in sorted(places)]).reshape(-1, 2)


def _settings(text: str, probe: Array, where: str) -> DeltaSettings:
    """Settings of commands; reports of M665 and M666 replace them."""
    m665, m666 = last_words(text, "M665"), last_words(text, "M666")
    for words, pattern in ((m665, _M665), (m666, _M666)):
        for report in pattern.finditer(text):
            words |= {k: v for k, v in report.groupdict().items() if v is not None}
    for letter in "LRH":
        if letter not in m665:
            raise SessionError(
                f"has no M665 {letter}; expected M665 L R H of config.g or config-override.g "
                "(--settings), or the report of M665 without parameters",
                where=where,
            )
    rods = numbers(m665["L"].split(":"), where=where, name="M665 L")
    rods = rods if len(rods) == 3 else [rods[0]] * 3
    radius, height = numbers([m665[k] for k in "RH"], where=where, name="M665")
    turns = numbers([m665.get(k, "0") for k in "XYZ"], where=where, name="M665")
    stops = numbers([m666.get(k, "0") for k in "XYZ"], where=where, name="M666")
    tilts = numbers([m666.get(k, "0") for k in "AB"], where=where, name="M666")
    if not 0.0 < radius < min(rods):
        raise SessionError(
            f"M665 has R {radius:g} and rods from {min(rods):g}; expected a positive radius and "
            "longer rods",
            where=where,
        )
    homed = height + np.sqrt(np.array(rods) ** 2 - radius**2) + stops
    a, b, c = (np.array(DESIGN_ANGLES) + np.array(turns) * DEG).tolist()
    return DeltaSettings(
        "reprapfirmware",
        radius * MM,
        (rods[0] * MM, rods[1] * MM, rods[2] * MM),
        (homed[0].item() * MM, homed[1].item() * MM, homed[2].item() * MM),
        (a, b, c),
        (tilts[0] / 100.0, tilts[1] / 100.0),
        (probe[0].item(), probe[1].item(), probe[2].item()),
    )


def config_lines(settings: DeltaSettings) -> str:
    """Lines of config.g, and of config-override.g if M501 reads it."""
    n, height = DECIMALS, float(settings.endstops.mean())
    rods = ":".join(f"{v / MM:.{n}f}" for v in settings.rods)
    turns = (np.array(settings.angles) - DESIGN_ANGLES) / DEG + 0.0
    turned = " ".join(f"{k}{v:.{n}f}" for k, v in zip("XYZ", turns, strict=True))
    stops = " ".join(
        f"{k}{v:.{n}f}" for k, v in zip("XYZ", (settings.endstops - height) / MM, strict=True)
    )
    a, b = (100.0 * v for v in settings.tilts)
    return (
        f"M665 L{rods} R{settings.radius / MM:.{n}f} H{height / MM:.{n}f} {turned}\n"
        f"M666 {stops} A{a:.{n}f} B{b:.{n}f}\n"
    )
