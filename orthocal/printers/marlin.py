"""Marlin: settings by M665, M666 and M851, probings by G29, G30 and G33.

After homing, the nozzle is at the height H − z of M851, and each carriage is lowered by its M666.
Marlin 1.1 has one length for all rods, and its M665 B is the radius at which G33 probes. Later
versions have trims A, B and C of the rods. Sources: Marlin/src/module/delta.cpp,
gcode/calibrate/G33.cpp, M665.cpp, M666.cpp; Marlin_main.cpp and configuration_store.cpp of 1.1.9.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import SessionError, errors_at
from orthocal.printers.log import (
    DECIMALS,
    MIN_POINTS,
    NUMBER,
    LogText,
    PrinterLog,
    last_probing,
    last_words,
    numbers,
    probed_log,
    require_one_value,
    settings_of_m665,
    unstated_trigger,
    write_words,
)
from orthocal.printers.settings import (
    DESIGN_ANGLES,
    MAX_ROD_DIFFERENCE,
    DeltaSettings,
    FirmwareName,
)
from orthocal.units import DEG, MM

EXPECTED = (
    "lines 'Bed X: Y: Z:' of G30 or G29 V4, the table of G33 V3, or a bilinear leveling grid; and "
    "the settings that M503 prints"
)

ROUNDING_TOLERANCE = 0.006
"""Rounding error of a setting that G33 prints with two decimals, [mm, °]."""

POINT_DIRECTIONS = {"c": None, "x": 210, "xy": 270, "y": 330, "yz": 30, "z": 90, "zx": 150}
"""Name of a point in G33's table, to its direction, [°]; None for the middle."""

_BED = re.compile(rf"Bed X: *({NUMBER}) +Y: *({NUMBER}) +Z: *({NUMBER})")
_G33 = re.compile(
    rf"\.Height: *(?P<H>{NUMBER})(?: +Ex: *(?P<Ex>{NUMBER}) +Ey: *(?P<Ey>{NUMBER}) +"
    rf"Ez: *(?P<Ez>{NUMBER}))? +Radius: *(?P<R>{NUMBER})"
    rf"(?:\s*\.[^\n]*Tx: *(?P<Tx>{NUMBER}) +Ty: *(?P<Ty>{NUMBER}) +Tz: *(?P<Tz>{NUMBER}))?"
)
_G33_RUN = re.compile(r"G33 Auto Calibrate")
_G33_COMMAND = re.compile(r"\bG33\b(?! Auto)[^\n;]*")
_AVERAGED = re.compile(r"\bP ?([4-9]|10)\b")
_TABLE_POINT = re.compile(rf"\b(c|xy|yz|zx|x|y|z): *({NUMBER})")
_HEADING = re.compile(r"G29 Auto Bed Leveling")
_GRID = re.compile(
    r"Bilinear Leveling Grid:[^\n]*\n[ \d]+\n(?P<rows>(?: *\d+(?: +[-+.\d=]+)+ *(?:\n|\Z))+)"
)


def recognise(text: str) -> bool:
    """True if a text is certainly from Marlin."""
    return bool(_BED.search(text) or _G33.search(text) or _GRID.search(text))


@dataclass(frozen=True, slots=True, eq=False)
class _Probing:
    """Points of one probing, and the part of the log that states its settings."""

    points: Array
    """Commanded positions and heights, shape (K, 3), [mm]."""
    since: int
    """Position in the text from which on a setting has one value."""
    until: int
    """Position in the text up to which settings are stated."""
    g33: re.Match[str] | None
    """Settings that G33 printed last before the points."""
    at_nozzle: bool = False
    """True if the nozzle was commanded to the points, not the probe."""
    notes: tuple[str, ...] = ()


def read_log(source: LogText) -> PrinterLog:
    """Read settings and probed points.

    Raises:
        SessionError: If the text is invalid; names the line or the missing setting.
    """
    probing = _bed_points(source) or _table(source) or _grid(source)
    text, notes = source.text, list(probing.notes)
    if not probing.at_nozzle:  # G33 changes settings, and prints those of the probing
        for command in ("M665", "M666", "M851"):
            require_one_value(source, command, since=probing.since, until=probing.until)
    m665, m666, m851 = (
        last_words(text, k) | last_words(text[: probing.until], k) for k in ("M665", "M666", "M851")
    )
    x, y, z = numbers([m851.get(k, "0") for k in "XYZ"], name="M851")
    settings = _settings(m665, m666, probing.g33, np.array([x, y, z]) * MM)
    if (bed := _calibration_radius(m665)) is not None:
        notes.append(
            f"M665 B{bed:g} is the radius at which G33 of Marlin 1.1 probes, not a trim of a rod."
        )
    if "Z" not in m851:
        notes.append(unstated_trigger("M851 Z"))
    nozzle = (
        probing.points - [0.0, 0.0, z] if probing.at_nozzle else probing.points - [x, y, z]
    ) * MM
    return probed_log(settings, nozzle, expected=EXPECTED, notes=notes)


def read_log_1(source: LogText) -> PrinterLog:
    """Read a log of Marlin 1.1 as `read_log` does.

    Raises:
        SessionError: If the settings have trims of rods, which Marlin 1.1 lacks, or as `read_log`.
    """
    log = read_log(source)
    if len(set(log.settings.rods)) > 1:
        raise SessionError(
            "M665 has trims A, B, C of rods, which Marlin 1.1 lacks; expected --format marlin"
        )
    return replace(log, settings=replace(log.settings, firmware="marlin1"))


def _calibration_radius(m665: Mapping[str, str]) -> float | None:
    """Radius at which G33 of Marlin 1.1 probes, [mm]; None if B is a trim or missing.

    A trim of one rod without those of the others is small, this radius is large.
    """
    if "B" not in m665 or "A" in m665 or "C" in m665:
        return None
    bed, rod = numbers([m665["B"], m665.get("L", "0")], where="M665", name="B")
    return bed if bed > MAX_ROD_DIFFERENCE * rod else None


def _firmware(m665: Mapping[str, str]) -> FirmwareName:
    """Marlin with or without trims of the rods, which M503 prints beside all other settings."""
    complete = set("LRHSXYZ") <= m665.keys() and not set("ABC") & m665.keys()
    return "marlin1" if complete or _calibration_radius(m665) is not None else "marlin"


def _bed_points(source: LogText) -> _Probing | None:
    """Points of the last complete probing by G30 or G29 V4; None without any."""
    matches = list(_BED.finditer(source.text))
    if not matches:
        return None
    positions = [m.start() for m in matches]
    points = np.array(
        [numbers(m.groups(), where=source.place(m.start()), name="Bed") for m in matches]
    )
    headings = [m.start() for m in _HEADING.finditer(source.text)]
    used, notes = last_probing(points * MM, positions, source, headings=headings)
    g33 = _last_g33(source.text, positions[used.start])
    since = max(positions[used.start - 1] if used.start else 0, g33.end() if g33 else 0)
    until = positions[used.stop - 1] if used.stop < len(points) else len(source.text)
    return _Probing(points[used], since, until, g33, notes=tuple(notes))


def _last_g33(text: str, position: int) -> re.Match[str] | None:
    """Settings that G33 printed last before a position; None without any."""
    return next((m for m in reversed(list(_G33.finditer(text))) if m.end() <= position), None)


def _settings(
    m665: Mapping[str, str],
    m666: Mapping[str, str],
    g33: re.Match[str] | None,
    probe: Array,
) -> DeltaSettings:
    """Settings of M665 and M666; different settings that G33 printed replace them."""
    firmware = _firmware(m665)
    words = {k: "0" for k in "XYZABC"} | dict(m665) | {f"E{k}": m666.get(k, "0") for k in "XYZ"}
    if firmware == "marlin1":
        words |= {k: "0" for k in "ABC"}
    printed = {} if g33 is None else {k: v for k, v in g33.groupdict().items() if v is not None}
    for name, value in printed.items():
        key = {"E": f"E{name[-1].upper()}", "T": name[-1].upper()}.get(name[0], name)
        stated = numbers([value, words.get(key, value)], name=name)
        if key not in words or abs(stated[0] - stated[1]) > ROUNDING_TOLERANCE:
            words[key] = value
    for letter in "LRH":
        if letter not in words:
            raise SessionError(
                f"has no M665 {letter}; expected the settings that M503 prints, with "
                "M665 L R H X Y Z, M666 X Y Z and M851"
            )
    rod, *trims = numbers([words[k] for k in "LABC"], name="M665")
    lowered = np.array(numbers([words[f"E{k}"] for k in "XYZ"], name="M666"))
    return settings_of_m665(
        firmware, words, rod + np.array(trims), -lowered, probe, raised=probe[2]
    )


def _table(source: LogText) -> _Probing | None:
    """First table of the last complete G33, which belongs to its first settings; None without any.

    Raises:
        SessionError: If G33 printed means, or the radius is missing.
    """
    text = source.text
    printed = list(_G33.finditer(text))
    ends = [*(m.start() for m in printed[1:]), len(text)]
    tables = [
        (m, rows)
        for m, end in zip(printed, ends, strict=False)
        if len(rows := list(_TABLE_POINT.finditer(text, m.end(), end))) >= MIN_POINTS
    ]
    if not tables:
        return None
    runs = [m.start() for m in _G33_RUN.finditer(text) if m.start() < tables[-1][0].start()]
    g33, rows = next(t for t in tables if t[0].start() >= (runs or [0])[-1])
    commands = [m for m in _G33_COMMAND.finditer(text) if m.start() < g33.start()]
    if commands and (averaged := _AVERAGED.search(commands[-1][0])):
        raise SessionError(
            f"G33 P{averaged[1]} prints means over arcs, not points; expected G33 P3 V3, or G29 V4",
            where=source.place(commands[-1].start()),
        )
    distance = _require_radius(source, "G33")
    points = []
    for match in rows:
        line = source.place(match.start())
        (height,) = numbers([match[2]], where=line, name=match[1])
        angle = POINT_DIRECTIONS[match[1]]
        x, y = (0.0, 0.0) if angle is None else (np.cos(angle * DEG), np.sin(angle * DEG))
        points.append([distance * x, distance * y, height])
    return _Probing(np.array(points), 0, g33.start(), g33, at_nozzle=True)


def _require_radius(source: LogText, table: str) -> float:
    """Distance from the middle of the outermost points of a table, [mm].

    Raises:
        SessionError: If it is not stated.
    """
    if source.radius is not None:
        return source.radius / MM
    bed = _calibration_radius(last_words(source.text, "M665"))
    hint = "DELTA_PRINTABLE_RADIUS minus the margin" if bed is None else f"M665 B: {bed:g} mm"
    raise SessionError(
        f"is missing; {table} does not state where it was probed: state the largest distance from "
        f"the middle ({hint})",
        where="--radius-mm",
    )


def _grid(source: LogText) -> _Probing:
    """Points of the last bilinear grid within the radius; no points without a grid.

    Raises:
        SessionError: If the grid is incomplete, or the radius is missing.
    """
    text = source.text
    grids = list(_GRID.finditer(text))
    if not grids:
        return _Probing(np.zeros((0, 3)), 0, len(text), _last_g33(text, len(text)))
    grid = grids[-1]
    lines = [line.split()[1:] for line in grid["rows"].splitlines() if line.strip()]
    with errors_at(source.place(grid.start())):
        rows = [numbers(line, name="grid") for line in lines]
        if len({len(row) for row in rows}) != 1:
            raise SessionError("has rows of different lengths; expected a complete grid")
    distance, heights = _require_radius(source, "the grid"), np.array(rows)
    y, x = np.meshgrid(*(np.linspace(-distance, distance, n) for n in heights.shape), indexing="ij")
    points = np.column_stack([x.ravel(), y.ravel(), heights.ravel()])
    within = np.hypot(points[:, 0], points[:, 1]) <= distance * (1.0 + 1e-9)
    g33 = _last_g33(text, grid.start())
    return _Probing(points[within], g33.end() if g33 else 0, len(text), g33)


def config_lines(settings: DeltaSettings) -> str:
    """Commands that set and save the settings."""
    lowest = float(settings.endstops.min())
    rods = np.array(settings.rods) / MM
    rod, n = round(float(rods.mean()), DECIMALS), DECIMALS
    height = (lowest + settings.probe[2]) / MM
    turns = (np.array(settings.angles) - DESIGN_ANGLES) / DEG
    lowered = (lowest - settings.endstops) / MM
    trims = "" if settings.firmware == "marlin1" else f" {write_words('ABC', rods - rod)}"
    return (
        f"M665 L{rod:.{n}f} R{settings.radius / MM:.{n}f} H{height:.{n}f} "
        f"{write_words('XYZ', turns)}{trims}\nM666 {write_words('XYZ', lowered)}\nM500\n"
    )
