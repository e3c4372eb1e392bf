"""Marlin: settings by M665, M666 and M851, probings by G29, G30 and G33.

Homed, the nozzle is at the height H − z of M851, and each carriage is lowered by its M666. Sources:
Marlin/src/module/delta.cpp, gcode/calibrate/G33.cpp, M665.cpp, M666.cpp.
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

EXPECTED = (
    "lines 'Bed X: Y: Z:' of G30 or G29 V4, the table of G33 V3, or a bilinear leveling grid; and "
    "the settings that M503 prints"
)

ROUNDED = 0.006
"""Deviation of a setting that G33 prints with two decimals, [mm, °]."""

TABLE = {"c": None, "x": 210, "xy": 270, "y": 330, "yz": 30, "z": 90, "zx": 150}
"""Names of the points in G33's table to their directions, [°]; None for the middle."""

_BED = re.compile(rf"Bed X: *({NUMBER}) +Y: *({NUMBER}) +Z: *({NUMBER})")
_G33 = re.compile(
    rf"\.Height: *(?P<H>{NUMBER})(?: +Ex: *(?P<Ex>{NUMBER}) +Ey: *(?P<Ey>{NUMBER}) +"
    rf"Ez: *(?P<Ez>{NUMBER}))? +Radius: *(?P<R>{NUMBER})"
    rf"(?:\s*\.[^\n]*Tx: *(?P<Tx>{NUMBER}) +Ty: *(?P<Ty>{NUMBER}) +Tz: *(?P<Tz>{NUMBER}))?"
)
_AVERAGED = re.compile(r"\bG33\b[^\n;]*\bP ?([4-9]|10)\b")
_GRID = re.compile(
    r"Bilinear Leveling Grid:[^\n]*\n[ \d]+\n(?P<rows>(?: *\d+(?: +[-+.\d=]+)+ *(?:\n|\Z))+)"
)


def recognise(text: str) -> bool:
    """True if a text is of Marlin for certain."""
    return bool(_BED.search(text) or _G33.search(text) or _GRID.search(text))


def read_log(text: str, *, where: str, radius: float | None = None) -> PrinterLog:
    """Settings and probed points.

    Args:
        text: The log, and files with settings.
        where: Name of the log, for messages.
        radius: Of the points of G33, half the side of a grid, [m].

    Raises:
        SessionError: Naming the line or the missing setting.
    """
    m851 = last_words(text, "M851")
    x, y, z = numbers([m851.get(k, "0") for k in "XYZ"], where=where, name="M851")
    probe = np.array([x, y, z]) * MM
    shown = _G33.search(text)
    settings = _settings(text, shown, probe, where)
    points = np.array([numbers(m.groups(), where=where, name="Bed") for m in _BED.finditer(text)])
    if len(points):
        nozzle = points * MM - probe
    else:
        table = "G33" if shown else "the grid"
        if shown is None and not _GRID.search(text):
            require_points(0, where=where, expected=EXPECTED)
        if radius is None:
            raise SessionError(
                f"is missing; {table} does not state where it was probed: give the largest "
                "distance from the middle (DELTA_PRINTABLE_RADIUS less the margin)",
                where="--radius-mm",
            )
        points = _table(text, shown, radius, where) if shown else _grid(text, radius, where)
        nozzle = points - [0.0, 0.0, probe[2]]
        nozzle[:, :2] -= 0.0 if shown else probe[:2]  # G33 probes with the nozzle at the point
    notes = [] if "Z" in m851 else [unstated_trigger("M851 Z")]
    return probed_log(settings, nozzle, where=where, expected=EXPECTED, notes=notes)


def _settings(text: str, shown: re.Match[str] | None, probe: Array, where: str) -> DeltaSettings:
    """Settings of M665 and M666, or those that G33 printed before its table where they differ."""
    trims = last_words(text, "M666")
    words = {k: "0" for k in "XYZABC"} | last_words(text, "M665")
    words |= {f"E{k}": trims.get(k, "0") for k in "XYZ"}
    printed = {} if shown is None else {k: v for k, v in shown.groupdict().items() if v is not None}
    for name, value in printed.items():
        key = {"E": f"E{name[-1].upper()}", "T": name[-1].upper()}.get(name[0], name)
        stated = numbers([value, words.get(key, value)], where=where, name=name)
        if key not in words or abs(stated[0] - stated[1]) > ROUNDED:
            words[key] = value
    for letter in "LRH":
        if letter not in words:
            raise SessionError(
                f"has no M665 {letter}; expected the settings that M503 prints, with "
                "M665 L R H X Y Z, M666 X Y Z and M851",
                where=where,
            )
    rod, reach, height = numbers([words[k] for k in "LRH"], where=where, name="M665")
    rods = rod + np.array(numbers([words[k] for k in "ABC"], where=where, name="M665"))
    turns = np.array(numbers([words[k] for k in "XYZ"], where=where, name="M665"))
    lowered = np.array(numbers([words[f"E{k}"] for k in "XYZ"], where=where, name="M666"))
    if not 0.0 < reach < rods.min():
        raise SessionError(
            f"M665 has R {reach:g} and rods from {rods.min():g}; expected a radius above 0 and "
            "rods that are longer",
            where=where,
        )
    middle = np.sqrt(rods**2 - reach**2)
    homed = (height + middle - lowered) * MM - probe[2]
    angles = np.array(DESIGN_ANGLES) + turns * DEG
    a, b, c = (rods * MM).tolist()
    return DeltaSettings(
        "marlin",
        reach * MM,
        (a, b, c),
        (homed[0].item(), homed[1].item(), homed[2].item()),
        (angles[0].item(), angles[1].item(), angles[2].item()),
        probe=(probe[0].item(), probe[1].item(), probe[2].item()),
    )


def _table(text: str, shown: re.Match[str], radius: float, where: str) -> Array:
    """Points of G33's first table, shape (K, 3), [m], which belongs to its first settings."""
    if averaged := _AVERAGED.search(text):
        raise SessionError(
            f"G33 P{averaged[1]} prints means over arcs, not points; expected G33 P3 V3, or G29 V4",
            where=place_of(text, averaged.start(), where),
        )
    after = text[shown.end() :]
    following = _G33.search(after)
    after = after[: following.start()] if following else after
    points = []
    for match in re.finditer(rf"\b(c|xy|yz|zx|x|y|z): *({NUMBER})", after):
        (height,) = numbers([match[2]], where=where, name=match[1])
        angle = TABLE[match[1]]
        at = (0.0, 0.0) if angle is None else (np.cos(angle * DEG), np.sin(angle * DEG))
        points.append([radius * at[0], radius * at[1], height * MM])
    return np.array(points).reshape(-1, 3)


def _grid(text: str, radius: float, where: str) -> Array:
    """Points of the last bilinear grid within the radius, shape (K, 3), [m]."""
    grid = list(_GRID.finditer(text))[-1]
    at = place_of(text, grid.start(), where)
    rows = [
        numbers(line.split()[1:], where=at, name="grid")
        for line in grid["rows"].splitlines()
        if line.strip()
    ]
    if len({len(row) for row in rows}) != 1:
        raise SessionError("has rows of different lengths; expected a complete grid", where=at)
    heights = np.array(rows) * MM
    y, x = np.meshgrid(*(np.linspace(-radius, radius, n) for n in heights.shape), indexing="ij")
    points = np.column_stack([x.ravel(), y.ravel(), heights.ravel()])
    within = np.hypot(points[:, 0], points[:, 1]) <= radius * (1.0 + 1e-9)
    return np.asarray(points[within])


def config_lines(settings: DeltaSettings) -> str:
    """Commands that set and save the settings."""
    lowest = float(settings.endstops.min())
    rods = np.array(settings.rods) / MM
    rod, n = round(float(rods.mean()), DECIMALS), DECIMALS
    height = (lowest + settings.probe[2]) / MM
    turns = (np.array(settings.angles) - DESIGN_ANGLES) / DEG
    lowered = (lowest - settings.endstops) / MM
    trims = " ".join(f"{k}{v:.{n}f}" for k, v in zip("ABC", rods - rod + 0.0, strict=True))
    turned = " ".join(f"{k}{v:.{n}f}" for k, v in zip("XYZ", turns + 0.0, strict=True))
    stops = " ".join(f"{k}{v:.{n}f}" for k, v in zip("XYZ", lowered, strict=True))
    return (
        f"M665 L{rod:.{n}f} R{settings.radius / MM:.{n}f} H{height:.{n}f} {turned} {trims}\n"
        f"M666 {stops}\nM500\n"
    )
