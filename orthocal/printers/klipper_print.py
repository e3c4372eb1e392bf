"""Distances on a print of Klipper's calibration object, in the format of `DELTA_ANALYZE`.

The object has a pillar in the middle and six pillars on a circle of 65 mm. Each pillar has ridges
at 4.5 mm from its middle. A calliper measures between the far sides of two pillars. This length
minus the width of one pillar is the distance of two ridges that face in the same direction. Source:
klippy/extras/delta_calibrate.py and docs/Delta_Calibrate.md of Klipper.
"""

from __future__ import annotations

import re

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import SessionError, errors_at
from orthocal.printers.log import LogText, PrintedDistance, numbers
from orthocal.printers.settings import DeltaSettings
from orthocal.units import DEG, MM

ANGLES = np.array([210, 270, 330, 30, 90, 150]) * DEG
"""Directions of the outer pillars from the middle, [rad]."""

CIRCLE_RADIUS = 65 * MM
"""Radius of the circle of pillars, [m]."""

RIDGE_DISTANCE = 4.5 * MM
"""Distance of a ridge from the middle of its pillar, [m]."""

CENTRE_PILLARS = (0, 2, 1, 0, 2, 1)
"""Index of the width of the middle pillar in each direction."""

NEXT_DIRECTION = 2
"""Index of the direction from a pillar to the next one, minus the index of the pillar."""

COUNTS = {
    "CENTER_DISTS": 6,
    "CENTER_PILLAR_WIDTHS": 3,
    "OUTER_DISTS": 6,
    "OUTER_PILLAR_WIDTHS": 6,
}
"""Measurements of `DELTA_ANALYZE`, and the number of values of each."""

LARGEST_MM = 2000.0
"""Largest accepted length, [mm]; a larger one has a wrong unit."""

Distances = list[tuple[float, list[list[float]]]]
"""Pairs of distance without pillars, [mm], and stable positions at both ends, [steps]."""

_COMMAND = re.compile(r"^[^\n;#]*\bDELTA_ANALYZE\b([^\n;#]*)", re.MULTILINE | re.IGNORECASE)
_WORD = re.compile(r"\b([A-Z_]+)\s*=\s*(\[[^\]]*\]|[^\s=]*)", re.IGNORECASE)


def has_analysis(source: LogText) -> bool:
    """True if the log itself, not a file with settings, has a command `DELTA_ANALYZE`."""
    return _COMMAND.search(source.text, source.begin) is not None


def read_analysis(source: LogText, settings: DeltaSettings) -> tuple[PrintedDistance, ...]:
    """Distances of the commands `DELTA_ANALYZE` in a text; later values replace earlier ones.

    Args:
        source: The log.
        settings: Settings with which the object was printed.

    Returns:
        Twelve distances; empty if the text has no measurement.

    Raises:
        SessionError: If a measurement is invalid or missing; names the line or the measurement.
    """
    values: dict[str, list[float]] = {}
    for command in _COMMAND.finditer(source.text):
        for word in _WORD.finditer(command[1]):
            name = word[1].upper()
            if name in COUNTS or name == "SCALE":
                with errors_at(source.place(command.start(1))):
                    values[name] = _lengths(name, word[2])
    measured = [name for name in COUNTS if name in values]
    if not measured:
        return ()
    if missing := [name for name in COUNTS if name not in values]:
        raise SessionError(
            f"DELTA_ANALYZE states {', '.join(measured)} but not {', '.join(missing)}; expected "
            "all four"
        )
    (scale,) = values.get("SCALE", [1.0])
    return _place(values, scale, settings)


def _lengths(name: str, text: str) -> list[float]:
    """Positive numbers of a parameter of `DELTA_ANALYZE`."""
    parts = text.strip("[]").split(",")  # klippy.log has brackets
    values, count = numbers(parts, name=name), COUNTS.get(name, 1)
    if len(values) != count:
        raise SessionError(f"{name} has {len(values)} numbers; expected {count}")
    for value in values:
        if not 0.0 < value <= LARGEST_MM:
            raise SessionError(
                f"{name} has {value:g}; expected numbers above 0 and at most {LARGEST_MM:g}"
            )
    return values


def _place(
    values: dict[str, list[float]], scale: float, settings: DeltaSettings
) -> tuple[PrintedDistance, ...]:
    """Distances with the coordinates of the carriages at their ends."""
    centre, outer = ends(scale)
    rows = [
        *zip(values["CENTER_DISTS"], CENTRE_PILLARS, centre, strict=True),
        *zip(values["OUTER_DISTS"], range(6), outer, strict=True),
    ]
    printed = []
    for i, (length, pillar, points) in enumerate(rows):
        part = "center" if i < len(centre) else "outer"
        width = values[f"{part.upper()}_PILLAR_WIDTHS"][pillar]
        printed.append(
            PrintedDistance(
                f"{part}_{i % len(centre) + 1}",
                (length - width) * MM,
                settings.inverse(points),
            )
        )
    return tuple(printed)


def ends(scale: float) -> tuple[Array, Array]:
    """Positions of the nozzle at the far and the near end of each distance, [m].

    Args:
        scale: Scale of the printed object.

    Returns:
        Distances from the middle outwards, and from each outer pillar to the next one, shape
        (6, 2, 3) each.
    """
    along = np.column_stack([np.cos(ANGLES), np.sin(ANGLES), np.zeros(len(ANGLES))])
    ridges = scale * np.array([CIRCLE_RADIUS + RIDGE_DISTANCE, RIDGE_DISTANCE])
    centre = ridges[:, None] * along[:, None]
    to_next = np.roll(along, -NEXT_DIRECTION, axis=0)
    outer = scale * CIRCLE_RADIUS * along[:, None] + ridges[:, None] * to_next[:, None]
    return centre, outer


def saved_distances(
    settings: DeltaSettings, steps: Array, distances: Distances
) -> tuple[PrintedDistance, ...]:
    """Distances that Klipper saved with stable positions, without the widths of pillars.

    Args:
        settings: The settings.
        steps: Travel of each carriage per step, shape (3,), [m].
        distances: The distances.

    Raises:
        SessionError: If a distance is invalid; names it.
    """
    printed = []
    for i, (length, stable) in enumerate(distances):
        positions = np.array(stable)
        if positions.shape != (2, 3) or not np.isfinite(positions).all():
            raise SessionError(f"distance {i}: expected three step counts at each end")
        if not 0.0 < length <= LARGEST_MM:
            raise SessionError(
                f"distance {i} is {length:g}; expected a number above 0 and at most "
                f"{LARGEST_MM:g} mm"
            )
        carriages = np.array(settings.homed) - positions[::-1] * steps
        printed.append(PrintedDistance(f"distance_{i + 1}", length * MM, carriages))
    return tuple(printed)
