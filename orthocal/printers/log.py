"""Log of a probed bed: settings of the firmware, and carriages where the probe triggered."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import SessionError
from orthocal.io.documents import parse_number
from orthocal.printers.settings import DESIGN_ANGLES, DeltaSettings
from orthocal.units import DEG, MM

FEWEST_POINTS = 3
MOST_POINTS = 2_000
"""Points of a log; a calibration takes a posture for each."""

FARTHEST = 2.0
"""Largest coordinate of a point, [m]: beyond it is a wrong unit or a damaged line."""

SAME_PLACE = 0.05 * MM
"""Probings of one place in a row are samples of one point."""

NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"

LARGE_ROD = 1.5 * MM
LARGE_ANGLE = 2.0 * DEG
"""Differences of rods and turns of towers that are more likely other errors that they absorb."""


@dataclass(frozen=True, slots=True, eq=False)
class PrintedDistance:
    """A distance measured by a calliper between two places of a print."""

    name: str
    """Of the distance: center_1, outer_3."""
    length: float
    """Measured length less the measured width of the pillar, [m]."""
    carriages: Array
    """Coordinates at its two ends, shape (2, 3), [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class PrinterLog:
    """Content of a log."""

    settings: DeltaSettings
    """With which the bed was probed."""
    carriages: Array
    """Coordinates where the probe triggered, shape (K, 3), [m]."""
    heights: Array
    """Height of the probe's tip above the bed there, shape (K,), [m]; 0 but for heights that were
    measured by hand."""
    notes: tuple[str, ...] = ()
    """What was left out or is unusual."""
    distances: tuple[PrintedDistance, ...] = ()


def numbers(texts: Sequence[str], *, where: str, name: str) -> list[float]:
    """Finite numbers of texts."""
    return [parse_number(t.strip(), where=where, name=name, error=SessionError) for t in texts]


def place_of(text: str, at: int, name: str) -> str:
    """File and line of a position in a text, for messages."""
    return f"{name}:{text.count(chr(10), 0, at) + 1}"


def average_samples(points: Array) -> Array:
    """Points with samples of one place in a row averaged, shape (K, 3), [m]."""
    groups: list[list[Array]] = []
    for point in points:
        if groups and np.abs(point[:2] - groups[-1][0][:2]).max() < SAME_PLACE:
            groups[-1].append(point)
        else:
            groups.append([point])
    return np.array([np.mean(g, axis=0) for g in groups])


def require_points(count: int, *, where: str, expected: str) -> None:
    """Refuse a log without enough points.

    Raises:
        SessionError: With what was expected.
    """
    if not FEWEST_POINTS <= count <= MOST_POINTS:
        found = "no probed points" if not count else f"{count} probed points"
        raise SessionError(
            f"found {found}; expected {FEWEST_POINTS} to {MOST_POINTS}: {expected}", where=where
        )


def probed_log(
    settings: DeltaSettings,
    nozzle: Array,
    *,
    where: str,
    expected: str,
    notes: Sequence[str] = (),
) -> PrinterLog:
    """Log from nozzle positions at the trigger, shape (K, 3), [m], in the firmware's coordinates.

    Raises:
        SessionError: If there are too few points, or one is out of reach.
    """
    require_points(len(nozzle), where=where, expected=expected)
    if np.abs(nozzle).max() > FARTHEST:
        raise SessionError(
            f"found a point at {np.abs(nozzle).max() / MM:g} mm; expected at most "
            f"{FARTHEST / MM:g} mm",
            where=where,
        )
    settings.require_plausible(where=where)
    points = average_samples(nozzle)
    require_points(len(points), where=where, expected=expected)
    try:
        carriages = settings.inverse(points)
    except SessionError as e:
        raise SessionError(e.problem, where=where) from None
    return PrinterLog(
        settings, carriages, np.zeros(len(points)), (*notes, *unusual_settings(settings))
    )


def unstated_trigger(key: str) -> str:
    """Note on a log without the height at which the probe triggers, with its key."""
    return (
        f"The log and its settings state no {key}: heights are those of the probe's trigger. "
        f"State {key} (0 if the nozzle is the probe), or the first layer is wrong by it."
    )


def unusual_settings(settings: DeltaSettings) -> Iterator[str]:
    """Notes on settings that more likely absorb other errors than describe the printer."""
    mean = float(np.mean(settings.rods))
    apart = np.array(settings.rods) - mean
    if np.abs(apart).max() > LARGE_ROD:
        listed = ", ".join(f"{v / MM:+.3f}" for v in apart)
        yield (
            f"The firmware's rods differ by {listed} mm from their mean. Rods of one batch do not: "
            "these settings absorb other errors. The calibration begins with equal rods of "
            f"{mean / MM:.3f} mm."
        )
    turns = np.array(settings.angles) - DESIGN_ANGLES
    turns -= turns.mean()
    if np.abs(turns).max() > LARGE_ANGLE:
        listed = ", ".join(f"{v / DEG:+.2f}" for v in turns)
        yield (
            f"The firmware's towers are turned by {listed}°, which more likely absorbs other "
            "errors. The calibration begins with towers 120° apart."
        )


def last_words(text: str, pattern: str) -> dict[str, str]:
    """Letters and values of a G-code command, those of later lines in place of earlier ones."""
    words: dict[str, str] = {}
    for match in re.finditer(rf"^[^;\n]*?\b{pattern}\b([^;\n]*)", text, re.MULTILINE):
        words |= dict(re.findall(rf"\b([A-Z]) ?({NUMBER}(?::{NUMBER})*)", match[1]))
    return words
