"""Marlin: settings by M665, M666 and M851, probings by G29, G30 and G33.

After homing, the nozzle is at the height H − z of M851, and each carriage is lowered by its M666.
Sources: Marlin/src/module/delta.cpp, gcode/calibrate/G33.cpp, M665.cpp, M666.cpp.
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
    require_one_value,
    require_points,
    unstated_trigger,
)
from orthocal.printers.settings import DESIGN_ANGLES, DeltaSettings
from orthocal.units import DEG, MM

DECIMALS = 4
"""Decimals of settings."""

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
_AVERAGED = re.compile(r"\bG33\b[^\n;]*\bP ?([4-9]|10)\b")
_GRID = re.compile(
    r"Bilinear Leveling Grid:[^\n]*\n[ \d]+\n(?P<rows>(?: *\d+(?: +[-+.\d=]+)+ *(?:\n|\Z))+)"
)


def recognise(text: str) -> bool:
    """True if a text is certainly from Marlin."""
    return bool(_BED.search(text) or _G33.search(text) or _GRID.search(text))


def read_log(text: str, *, where: str, radius: float | None = None) -> PrinterLog:
    """Read settings and probed points.

    Args:
        text: The log and files with settings.
        where: Name of the log, for messages.
        radius: Radius of the points of G33, or half the side of a grid, [m].

    Raises:
        SessionError: If the text is invalid; names the line or the missing setting.
    """
    m851 = last_words(text, "M851")
    x, y, z = numbers([m851.get(k, "0") for k in "XYZ"], where=where, name="M851")
    probe = np.array([x, y, z]) * MM
    g33 = _G33.search(text)
    if g33 is None:  # G33 changes settings, and prints those of the probing
        for command in ("M665", "M666", "M851"):
            require_one_value(text, command, where=where)
    settings = _settings(text, g33, probe, where)
    points = np.array([numbers(m.groups(), where=where, name="Bed") for m in _BED.finditer(text)])
    if len(points):
        nozzle = points * MM - probe
    else:
        table = "G33" if g33 else "the grid"
        if g33 is None and not _GRID.search(text):
            require_points(0, where=where, expected=EXPECTED)
        if radius is None:
            raise SessionError(
                f"is missing; {table} does not state where it was probed: state the largest "
                "distance from the middle (DELTA_PRINTABLE_RADIUS minus the margin)",
                where="--radius-mm",
            )
        points = _table(text, g33, radius, where) if g33 else _grid(text, radius, where)
        nozzle = points - [0.0, 0.0, probe[2]]
        nozzle[:, :2] -= 0.0 if g33 else probe[:2]  # G33 probes with the nozzle at the point
    notes = [] if "Z" in m851 else [unstated_trigger("M851 Z")]
    return probed_log(settings, nozzle, where=where, expected=EXPECTED, notes=notes)


def _settings(text: str, g33: re.Match[str] | None, probe: Array, where: str) -> DeltaSettings:
    """Settings of M665 and M666; different settings that G33 printed replace them."""
    trims = last_words(text, "M666")
    words = {k: "0" for k in "XYZABC"} | last_words(text, "M665")
    words |= {f"E{k}": trims.get(k, "0") for k in "XYZ"}
    printed = {} if g33 is None else {k: v for k, v in g33.groupdict().items() if v is not None}
    for name, value in printed.items():
        key = {"E": f"E{name[-1].upper()}", "T": name[-1].upper()}.get(name[0], name)
        stated = numbers([value, words.get(key, value)], where=where, name=name)
        if key not in words or abs(stated[0] - stated[1]) > ROUNDING_TOLERANCE:
            words[key] = value
    for letter in "LRH":
        if letter not in words:
            raise SessionError(
                f"has no M665 {letter}; expected the settings that M503 prints, with "
                "M665 L R H X Y Z, M666 X Y Z and M851",
                where=where,
            )
    rod, radius, height = numbers([words[k] for k in "LRH"], where=where, name="M665")
    rods = rod + np.array(numbers([words[k] for k in "ABC"], where=where, name="M665"))
    turns = np.array(numbers([words[k] for k in "XYZ"], where=where, name="M665"))
    lowered = np.array(numbers([words[f"E{k}"] for k in "XYZ"], where=where, name="M666"))
    if not 0.0 < radius < rods.min():
        raise SessionError(
            f"M665 has R {radius:g} and rods from {rods.min():g}; expected a positive radius and "
            "longer rods",
            where=where,
        )
    middle = np.sqrt(rods**2 - radius**2)
    homed = (height + middle - lowered) * MM - probe[2]
    angles = np.array(DESIGN_ANGLES) + turns * DEG
    a, b, c = (rods * MM).tolist()
    return DeltaSettings(
        "marlin",
        radius * MM,
        (a, b, c),
        (homed[0].item(), homed[1].item(), homed[2].item()),
        (angles[0].item(), angles[1].item(), angles[2].item()),
        probe=(probe[0].item(), probe[1].item(), probe[2].item()),
    )


def _table(text: str, g33: re.Match[str], radius: float, where: str) -> Array:
    """Points of G33's first table, which belongs to its first settings, shape (K, 3), [m]."""
    if averaged := _AVERAGED.search(text):
        raise SessionError(
            f"G33 P{averaged[1]} prints means over arcs, not points; expected G33 P3 V3, or G29 V4",
            where=place_of(text, averaged.start(), where),
        )
    after = text[g33.end() :]
    following = _G33.search(after)
    after = after[: following.start()] if following else after
    points = []
    for match in re.finditer(rf"\b(c|xy|yz|zx|x|y|z): *({NUMBER})", after):
        (height,) = numbers([match[2]], where=where, name=match[1])
        angle = POINT_DIRECTIONS[match[1]]
        x, y = (0.0, 0.0) if angle is None else (np.cos(angle * DEG), np.sin(angle * DEG))
        points.append([radius * x, radius * y, height * MM])
    return np.array(points).reshape(-1, 3)


def _grid(text: str, radius: float, where: str) -> Array:
    """Points of the last bilinear grid within the radius, shape (K, 3), [m]."""
    grid = list(_GRID.finditer(text))[-1]
    where = place_of(text, grid.start(), where)
    rows = [
        numbers(line.split()[1:], where=where, name="grid")
        for line in grid["rows"].splitlines()
        if line.strip()
    ]
    if len({len(row) for row in rows}) != 1:
        raise SessionError("has rows of different lengths; expected a complete grid", where=where)
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
