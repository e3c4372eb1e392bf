"""RepRapFirmware: settings by M665, M666 and G31, heights reported by G30 and G32.

A height is that of the nozzle at the trigger minus the trigger height of G31. Sources:
src/Movement/Kinematics/LinearDeltaKinematics.cpp, src/Movement/BedProbing/RandomProbePointSet.cpp.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import NoReturn

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import SessionError, errors_at
from orthocal.printers.log import (
    DECIMALS,
    NUMBER,
    LogText,
    PrinterLog,
    command_words,
    last_words,
    numbers,
    probed_log,
    settings_of_m665,
    unstated_trigger,
    write_words,
)
from orthocal.printers.settings import DESIGN_ANGLES, DeltaSettings
from orthocal.units import DEG, MM

EXPECTED = (
    "the line 'bed probe heights:' that G30 or G32 with S-1 reports, and the lines 'G30 P X Y' of "
    "bed.g and 'M665', 'M666' and 'G31' of config.g (--settings)"
)

_HEIGHTS = re.compile(r"[Bb]ed probe heights:(?P<values>[^,\n]*), mean")
_CALIBRATED = re.compile(r"Calibrated (\d+) factors using \d+ points")
_STOPPED = re.compile(rf"Stopped at height {NUMBER} mm")
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
    return any(p.search(text) for p in (_HEIGHTS, _M665, _CALIBRATED, _STOPPED))


def read_log(source: LogText) -> PrinterLog:
    """Read settings and probed points.

    Raises:
        SessionError: If the text is invalid; names the line or the missing setting.
    """
    text = source.text
    reports = list(_HEIGHTS.finditer(text))
    if not reports:
        _refuse_without_heights(source)
    report = reports[-1]
    line = source.place(report.start())
    with errors_at(line):
        heights = _heights(report["values"])
    points = _points(source, report.start())
    if len(points) != len(heights):
        raise SessionError(
            f"reports {len(heights)} heights of {len(points)} points; expected a line 'G30 P X Y' "
            "of bed.g for each height (--settings bed.g)",
            where=line,
        )
    g31 = last_words(text, "G31")
    x, y, z = numbers([g31.get(k, "0") for k in "XYZ"], name="G31")
    nozzle = np.column_stack([points - [x, y], np.array(heights) + z]) * MM
    _require_settings_of(source, report.start())
    settings = _settings(text, np.array([x, y, -z]) * MM)
    notes = [] if "Z" in g31 else [unstated_trigger("G31 Z")]
    if len(reports) > 1:
        notes.append(f"The log has {len(reports)} probings. The last one is used: {line}.")
    return probed_log(settings, nozzle, expected=EXPECTED, notes=notes)


def _refuse_without_heights(source: LogText) -> NoReturn:
    """Refuse a log without heights.

    Raises:
        SessionError: Naming the line of an answer that has none.
    """
    text = source.text
    if calibrated := list(_CALIBRATED.finditer(text)):
        factors = calibrated[-1][1]
        raise SessionError(
            f"G30 S{factors} calibrated {factors} factors and printed no heights; expected S-1 in "
            f"place of S{factors} in the last G30 of bed.g. Restart, so that the settings of "
            "config.g are active, and probe again by G32",
            where=source.place(calibrated[-1].start()),
        )
    if stopped := _STOPPED.search(text):
        raise SessionError(
            f"found '{stopped[0]}' of a G30 without P, which states no place; expected {EXPECTED}",
            where=source.place(stopped.start()),
        )
    raise SessionError(f"found no probed points; expected {EXPECTED}")


def _heights(text: str) -> list[float]:
    """Heights of a report, [mm].

    Raises:
        SessionError: If a point was not probed.
    """
    words = re.findall(r"not set|probing failed|\S+", text)
    for number, word in enumerate(words):
        if word in ("not set", "probing failed"):
            raise SessionError(f"point P{number} has '{word}' in place of a height; probe again")
    return numbers(words, name="a bed probe height")


def _require_settings_of(source: LogText, report: int) -> None:
    """Refuse settings that are not those of a report because a calibration changed them.

    Args:
        source: The log.
        report: Position of the report in the text.

    Raises:
        SessionError: Naming the line of the calibration.
    """
    text = source.text
    stated = [[m.start() for m in pattern.finditer(text)] for pattern in (_M665, _M666)]
    for match in _CALIBRATED.finditer(text):
        place, at = source.place(match.start()), match.start()
        if at > report and any(p > at for positions in stated for p in positions):
            raise SessionError(
                "changed the settings after the heights, and M665 or M666 reported the new ones; "
                "expected only the settings during the probing",
                where=place,
            )
        reported = all(any(at < p < report for p in positions) for positions in stated)
        if at < report and not reported:
            raise SessionError(
                "changed the settings before the heights; expected the answers of M665 and M666 "
                "without parameters between this line and the heights, or a log since the restart",
                where=place,
            )


def _points(source: LogText, report: int) -> Array:
    """Points of the commands G30 P in the order of their numbers, shape (K, 2), [mm].

    The commands before the report count, all commands if there are none. P0 begins a new list.
    """
    places: dict[float, tuple[float, float]] = {}
    commands = list(command_words(source.text, "G30"))
    for position, words in [c for c in commands if c[0] < report] or commands:
        if {"P", "X", "Y"} <= words.keys():
            line = source.place(position)
            number, x, y = numbers([words[k] for k in "PXY"], where=line, name="G30")
            if number == 0.0:
                places = {}
            places[number] = (x, y)
    return np.array([places[k] for k in sorted(places)]).reshape(-1, 2)


def _settings(text: str, probe: Array) -> DeltaSettings:
    """Settings of commands; reports of M665 and M666 replace them."""
    m665, m666 = last_words(text, "M665"), last_words(text, "M666")
    for words, pattern in ((m665, _M665), (m666, _M666)):
        for report in pattern.finditer(text):
            words |= {k: v for k, v in report.groupdict().items() if v is not None}
    for letter in "LRH":
        if letter not in m665:
            raise SessionError(
                f"has no M665 {letter}; expected M665 L R H of config.g or config-override.g "
                "(--settings), or the report of M665 without parameters"
            )
    rods = numbers(m665["L"].split(":"), name="M665 L")
    rods = rods if len(rods) == 3 else [rods[0]] * 3
    stops = numbers([m666.get(k, "0") for k in "XYZ"], name="M666")
    a, b = numbers([m666.get(k, "0") for k in "AB"], name="M666")
    settings = settings_of_m665("reprapfirmware", m665, np.array(rods), np.array(stops), probe)
    return replace(settings, tilts=(a / 100.0, b / 100.0))


def config_lines(settings: DeltaSettings) -> str:
    """Lines of config.g, and of config-override.g if M501 reads it."""
    n, height = DECIMALS, float(settings.endstops.mean())
    rods = ":".join(f"{v / MM:.{n}f}" for v in settings.rods)
    turns = (np.array(settings.angles) - DESIGN_ANGLES) / DEG
    stops = write_words("XYZ", (settings.endstops - height) / MM)
    tilts = write_words("AB", 100.0 * np.array(settings.tilts))
    return (
        f"M665 L{rods} R{settings.radius / MM:.{n}f} H{height / MM:.{n}f} "
        f"{write_words('XYZ', turns)}\nM666 {stops} {tilts}\n"
    )
