"""Log of a probed bed: settings of the firmware, and positions of the carriages at the triggers."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from orthocal.arrays import Array, triple
from orthocal.errors import SessionError
from orthocal.io.documents import parse_number
from orthocal.printers.settings import DESIGN_ANGLES, DeltaSettings, FirmwareName
from orthocal.units import DEG, MM

MIN_POINTS = 3
"""Fewest points of a log."""

MAX_POINTS = 2_000
"""Most points of a log; each is a posture of the calibration."""

LARGEST_COORDINATE = 2.0
"""Largest accepted coordinate of a point, [m]; a larger one has a wrong unit or is damaged."""

SAME_PLACE = 0.05 * MM
"""Largest distance of successive probings that are samples of one point, along x or y, [m]."""

DECIMALS = 4
"""Decimals of settings in G-code."""

NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"

LARGE_ROD_DIFFERENCE = 1.5 * MM
"""Difference of a rod from the mean that more likely absorbs another error, [m]."""

SMALL_REACH = 1.0 / 3.0
"""Distance of the outermost point from the middle, relative to the radius of the printer, below
which points hardly determine radius, rods and towers."""

LARGE_HEIGHT = 5.0 * MM
"""Median height of the bed that is more likely a wrong offset of the probe, [m]."""

LARGE_TOWER_ANGLE = 2.0 * DEG
"""Angular error of a tower that more likely absorbs another error, [rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class PrintedDistance:
    """Distance between two places of a print, measured with a calliper."""

    name: str
    """Name of the distance, such as center_1 or outer_3."""
    length: float
    """Measured length minus the measured width of the pillar, [m]."""
    carriages: Array
    """Coordinates of the carriages at the two ends, shape (2, 3), [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class PrinterLog:
    """Content of a log."""

    settings: DeltaSettings
    """Settings with which the bed was probed."""
    carriages: Array
    """Coordinates of the carriages at the triggers, shape (K, 3), [m]."""
    heights: Array
    """Height of the probe's tip above the bed at the triggers, shape (K,), [m]; 0 except for
    manually measured heights."""
    notes: tuple[str, ...] = ()
    """Notes on omitted and unusual content."""
    distances: tuple[PrintedDistance, ...] = ()
    """Distances measured on a print."""


@dataclass(frozen=True, slots=True)
class LogText:
    """Text of a log, after the files with settings."""

    files: tuple[tuple[str, str], ...]
    """Name and text of each file; the log is the last one."""
    radius: float | None = None
    """Radius of the points of Marlin's G33, or half the side of its grid, [m]."""

    @property
    def text(self) -> str:
        """Text of all files."""
        return "\n".join(text for _, text in self.files)

    @property
    def name(self) -> str:
        """Name of the log, for messages."""
        return self.files[-1][0]

    @property
    def begin(self) -> int:
        """Position in `text` at which the log begins."""
        return len(self.text) - len(self.files[-1][1])

    def place(self, position: int) -> str:
        """File and line of a position in `text`, for messages."""
        line = self.text.count("\n", 0, position)
        for name, text in self.files[:-1]:
            lines = text.count("\n") + 1
            if line < lines:
                return f"{name}:{line + 1}"
            line -= lines
        return f"{self.name}:{line + 1}"


def numbers(texts: Sequence[str], *, name: str, where: str | None = None) -> list[float]:
    """Parse texts as finite numbers.

    Args:
        texts: The texts.
        name: Name of the numbers, for messages.
        where: File and line, for messages.

    Raises:
        SessionError: If a text is not a finite number.
    """
    return [parse_number(t.strip(), where=where, name=name, error=SessionError) for t in texts]


def _place_begins(points: Array) -> list[int]:
    """Indices at which successive samples of a place begin."""
    begins = [0]
    for k in range(1, len(points)):
        if not _is_same_place(points[k], points[begins[-1]]):
            begins.append(k)
    return begins


def _is_same_place(one: Array, other: Array) -> bool:
    return bool(np.abs(one[:2] - other[:2]).max() < SAME_PLACE)


def last_probing(
    points: Array, positions: Sequence[int], source: LogText, *, headings: Sequence[int] = ()
) -> tuple[slice, list[str]]:
    """Last complete probing of a log.

    A probing begins after a heading, or where the first two places are probed again in the same
    order. It is incomplete if a probing before it has the same places and more of them.

    Args:
        points: All points of the log, shape (K, 3), [m].
        positions: Position of each point in the text of the source.
        source: The log.
        headings: Positions of lines after which a probing begins.

    Returns:
        Indices of the points; and notes on the probings.
    """
    if len(points) < MIN_POINTS:
        return slice(0, len(points)), []
    begins = _place_begins(points)
    places = points[begins]
    starts = [0]
    for k in range(1, len(places)):
        before, at = positions[begins[k] - 1], positions[begins[k]]
        first = starts[-1]
        if any(before < h < at for h in headings) or (
            k - first >= MIN_POINTS
            and k + 1 < len(places)
            and _is_same_place(places[k], places[first])
            and _is_same_place(places[k + 1], places[first + 1])
        ):
            starts.append(k)
    if len(starts) == 1:
        return slice(0, len(points)), []
    probings = [places[a:b] for a, b in pairwise([*starts, len(places)])]
    chosen = max(i for i, p in enumerate(probings) if not any(map(partial(_extends, p), probings)))
    ends = [*(begins[k] for k in starts[1:]), len(points)]
    used = slice(begins[starts[chosen]], ends[chosen])
    begin, end = (source.place(positions[i]) for i in (used.start, used.stop - 1))
    return used, [
        f"The log has {len(probings)} probings. The last complete one is used: "
        f"{len(probings[chosen])} points, {begin} to line {end.rpartition(':')[2]}."
    ]


def _extends(probing: Array, other: Array) -> bool:
    """True if another probing has the same places and more of them."""
    return len(other) > len(probing) and all(map(_is_same_place, probing, other))


def require_points(count: int, expected: str) -> None:
    """Refuse a log with too few or too many points.

    Args:
        count: Number of points.
        expected: Description of a complete log, for the message.

    Raises:
        SessionError: If the number of points is out of range.
    """
    if not MIN_POINTS <= count <= MAX_POINTS:
        number = count or "no"
        raise SessionError(
            f"found {number} probed points; expected {MIN_POINTS} to {MAX_POINTS}: {expected}"
        )


def probed_log(
    settings: DeltaSettings,
    nozzle: Array,
    *,
    expected: str,
    notes: Sequence[str],
) -> PrinterLog:
    """Log from positions of the nozzle at the triggers.

    Args:
        settings: The settings.
        nozzle: Positions in the firmware's coordinates, shape (K, 3), [m].
        expected: Description of a complete log, for messages.
        notes: Notes on omitted and unusual content.

    Raises:
        SessionError: If the number of points is out of range, or a point is out of reach.
    """
    require_points(len(nozzle), expected)
    if np.abs(nozzle).max() > LARGEST_COORDINATE:
        raise SessionError(
            f"found a point at {np.abs(nozzle).max() / MM:g} mm; expected at most "
            f"{LARGEST_COORDINATE / MM:g} mm"
        )
    settings.require_plausible()
    places = np.split(nozzle, _place_begins(nozzle)[1:])
    points = np.array([samples.mean(axis=0) for samples in places])
    require_points(len(points), expected)
    carriages = settings.inverse(points)
    notes = (*notes, *unusual_content(settings, carriages))
    return PrinterLog(settings, carriages, np.zeros(len(points)), notes)


def unstated_trigger(key: str) -> str:
    """Note on a log that does not state the trigger height of the probe; `key` would state it."""
    return (
        f"The log and its settings state no {key}: heights are those of the probe's trigger. "
        f"State {key} (0 if the nozzle is the probe). Otherwise the first layer is wrong by it."
    )


def unusual_content(settings: DeltaSettings, carriages: Array) -> Iterator[str]:
    """Notes on settings that more likely absorb other errors, and on points that show too little.

    Args:
        settings: Settings of the firmware.
        carriages: Coordinates of the carriages at the triggers, shape (K, 3), [m].
    """
    with np.errstate(invalid="ignore"):  # of damaged steps; the calibration refuses them
        reach = float(np.hypot(*settings.forward(carriages)[:, :2].T).max())
        height = float(np.median(settings.touched(carriages)[:, 2]))
    if abs(height) > LARGE_HEIGHT:
        yield (
            f"The firmware sees the bed at a height of {height / MM:.3f} mm. If the printer prints "
            "on the bed, the offset of the probe is wrong, or the settings are not those of the "
            "probing. The new endstops would be wrong by this height."
        )
    if reach < SMALL_REACH * settings.radius:
        yield (
            f"All points are within {reach / MM:.0f} mm of the middle. They hardly determine "
            "radius, rods and towers, nor the height of the first layer farther out. Probe up to "
            "the edge of the bed."
        )
    mean = float(np.mean(settings.rods))
    differences = np.array(settings.rods) - mean
    if np.abs(differences).max() > LARGE_ROD_DIFFERENCE:
        listed = ", ".join(f"{v / MM:+.3f}" for v in differences)
        yield (
            f"The firmware's rods differ by {listed} mm from their mean. Rods of one batch differ "
            "less, so these settings absorb other errors. The calibration begins with equal rods "
            f"of {mean / MM:.3f} mm."
        )
    angles = np.array(settings.angles) - DESIGN_ANGLES
    angles -= angles.mean()
    if np.abs(angles).max() > LARGE_TOWER_ANGLE:
        listed = ", ".join(f"{v / DEG:+.2f}" for v in angles)
        yield (
            f"The firmware's towers are rotated by {listed}° from 120° spacing, which more likely "
            "absorbs other errors. The calibration begins with a spacing of 120°."
        )


def last_words(text: str, pattern: str) -> dict[str, str]:
    """Letters and values of a G-code command; later lines replace values of earlier ones."""
    words: dict[str, str] = {}
    for _, of_line in command_words(text, pattern):
        words |= of_line
    return words


def command_words(text: str, pattern: str) -> Iterator[tuple[int, dict[str, str]]]:
    """Position of each line with a G-code command, and its letters and values.

    Blanks need not separate the words.
    """
    words = re.compile(rf"(?<![A-Za-z])([A-Z]) ?({NUMBER}(?::{NUMBER})*)")
    for match in re.finditer(rf"^[^;\n]*?\b{pattern}(?![\d.])([^;\n]*)", text, re.MULTILINE):
        yield match.start(1), dict(words.findall(match[1]))


def write_words(letters: str, values: Array) -> str:
    """Words of a G-code line."""
    words = zip(letters, values + 0.0, strict=True)  # not -0.0
    return " ".join(f"{letter}{value:.{DECIMALS}f}" for letter, value in words)


def settings_of_m665(
    firmware: FirmwareName,
    m665: Mapping[str, str],
    rods: Array,
    stops: Array,
    probe: Array,
    *,
    raised: float = 0.0,
) -> DeltaSettings:
    """Settings of the G-code command M665.

    Args:
        firmware: The firmware.
        m665: Values of R and H, [mm], and of X, Y and Z, [°], by letter.
        rods: Lengths of the rods, shape (3,), [mm].
        stops: Heights of the endstops above H, shape (3,), [mm].
        probe: Tip of the probe at the trigger, from the nozzle, shape (3,), [m].
        raised: Height of the zero of H above that of the nozzle, [m].

    Raises:
        SessionError: If a value is no number, or the rods are too short.
    """
    radius, height = numbers([m665[k] for k in "RH"], name="M665")
    turns = numbers([m665.get(k, "0") for k in "XYZ"], name="M665")
    if not 0.0 < radius < rods.min():
        raise SessionError(
            f"M665 has R {radius:g} and rods from {rods.min():g}; expected a positive radius and "
            "longer rods"
        )
    homed = (height + np.sqrt(rods**2 - radius**2) + stops) * MM - raised
    angles = triple(DESIGN_ANGLES + np.array(turns) * DEG)
    return DeltaSettings(
        firmware, radius * MM, triple(rods, MM), triple(homed), angles, probe=triple(probe)
    )


def require_one_value(source: LogText, command: str, *, since: int = 0, until: int) -> None:
    """Refuse a setting that a log states twice with different values.

    Args:
        source: The log.
        command: Command of the settings.
        since: Position in the text at which the search begins.
        until: Position in the text at which the search ends.

    Raises:
        SessionError: Naming the setting and the place of its second value.
    """
    values: dict[str, str] = {}
    for position, words in command_words(source.text, command):
        if not since <= position < until:
            continue
        where = source.place(position)
        for letter, value in words.items():
            first, second = numbers(
                [values.setdefault(letter, value), value], where=where, name=command
            )
            if first != second:
                raise SessionError(
                    f"{command} {letter} is {second:g}, and {first:g} before; expected only the "
                    "settings during the probing",
                    where=where,
                )
