"""Writer of corrected lines: new points, feeds and G-words of motion; other words are unchanged.

Arcs become straight segments, so G2 and G3 become G1, and the words of their centres are omitted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from orthocal.gcode.interpreter import COORDINATES, STOPS, Modes, Step
from orthocal.gcode.lines import Line, PointLine, Word
from orthocal.gcode.segmentation import Segments
from orthocal.units import INCH, MM

FEWEST_DECIMALS = {MM: 4, INCH: 5}
"""Fewest decimals of a coordinate by unit."""

MOST_DECIMALS = 9
"""Largest number of decimals of a coordinate: 1e-9 mm, the resolution of a float at 1 m."""

FEED_STEP = 1e-4
"""Relative change of the feed above which a new F is written."""

FEED_DIGITS = 6
"""Number of significant digits of a feed."""

_MOTIONS = frozenset({0.0, 1.0, 2.0, 3.0})
"""G-words of motions along lines and arcs."""

_ARCS = frozenset({2, 3})
_CANCEL = 80.0
_RESETS = frozenset({_CANCEL, 20.0, 21.0})
"""G-words after which the motion or the feed must be written again."""


def find_decimals(unit: float, rounding: float) -> int:
    """Number of decimals with which rounding displaces a point by less than a distance.

    A rounded point is off by at most √3/2 of the last decimal. The number is between
    FEWEST_DECIMALS and MOST_DECIMALS, which limits the accuracy to 1e-9 of the unit.

    Args:
        unit: Unit of the coordinates, [m].
        rounding: Largest displacement, [m].
    """
    needed = math.ceil(math.log10(0.5 * math.sqrt(3.0) * unit / rounding))
    return min(max(FEWEST_DECIMALS[unit], needed), MOST_DECIMALS)


class Writer:
    """Writer of lines that tracks the modes and the position of the controller.

    Args:
        axes: Indices of the axes that the drives command.
        rounding: Largest displacement of a point by rounding, [m].
        start: Position (x, y, z) of the controller before the program, in machine coordinates,
            [m]; None where unknown.
    """

    def __init__(
        self, axes: Sequence[int], *, rounding: float, start: Sequence[float | None]
    ) -> None:
        self._axes = tuple(axes)
        self._formats: dict[float, tuple[int, str, str]] = {}
        """Number of decimals, format of a point and text of a negative zero, by unit."""
        for unit in (MM, INCH):
            n = find_decimals(unit, rounding)
            words = " ".join(f"{'XYZ'[k]}%.{n}f" for k in axes)
            self._formats[unit] = (n, words, f"-{0.0:.{n}f}")
        self._position: list[float] = [0.0 if v is None else v for v in start]
        """Position (x, y, z) of the controller after the last written line, in machine
        coordinates and rounded, [m]."""
        self._motion: int | None = None
        self._feed: float | None = None

    def copy(self, line: Line) -> str:
        """Unchanged text of a line without a motion; tracks its modes."""
        for item in line.items:
            if isinstance(item, Word):
                if item.letter == "F":
                    self._feed = item.value
                elif item.letter == "G" and item.value in _MOTIONS:
                    self._motion = int(item.value)
                elif item.letter == "G" and item.value in _RESETS:
                    self._motion = None if item.value == _CANCEL else self._motion
                    self._feed = self._feed if item.value == _CANCEL else None
        return line.text

    def write(self, step: Step, segments: Segments) -> list[str]:
        """Lines of the segments of a motion; tracks their end and feed."""
        feeds = self._write_feeds(step, segments)
        points = self._write_points(step, segments)
        motion = 0 if step.modes.motion == 0 else 1
        if isinstance(step.line, PointLine):
            code = None if step.line.motion is None else f"G{step.line.motion}"
            first = " ".join(w for w in (step.line.label, code, points[0], feeds[0]) if w)
            stops = ""
        else:
            defer = len(points) > 1
            texts = (f"G{motion}", points[0], feeds[0])
            first, stops = self._begin(step.line, step.modes, *texts, defer=defer)
        self._motion = motion
        if step.has_feed and not motion:
            self._feed = step.modes.feed
        end = step.line.ending.lstrip(" \t") or "\n"
        if len(points) == 1:
            return [first + end]
        following = zip(points[1:], feeds[1:], strict=True)
        lines = [first, *(f"{words} {feed}" if feed else words for words, feed in following)]
        lines[-1] += stops
        return [line + end for line in lines]

    def _begin(
        self, line: Line, modes: Modes, motion: str, point: str, feed: str, *, defer: bool
    ) -> tuple[str, str]:
        """First line of a motion, and the stops to append to its last line.

        Args:
            line: The line of the program.
            modes: Modes during the line.
            motion: G-word of the motion, G0 or G1.
            point: Coordinate words of the first point.
            feed: Feed word of the first segment; empty if the feed does not change.
            defer: Whether stops are deferred to the last line.
        """
        parts: list[str] = []
        stops = ""
        has_motion = has_point = False
        feed_index = 0
        for item in line.items:
            if isinstance(item, str):
                parts.append(item)
            elif item.letter in COORDINATES or (item.letter == "P" and modes.motion in _ARCS):
                if not has_point:
                    parts.append(f" {point}")
                    has_point, feed_index = True, len(parts)
            elif item.letter == "G" and item.value in _MOTIONS:
                parts.append(f" {motion}")
                has_motion = True
            elif item.letter == "F" and motion != "G0":
                continue
            elif item.letter == "M" and defer and item.value in STOPS:
                stops += f" {item.text.strip()}"
            else:
                parts.append(item.text)
        if feed:
            parts.insert(feed_index, f" {feed}")
        if motion != f"G{self._motion}" and not has_motion:
            parts.insert(_after_number(line), f" {motion}")
        return "".join(parts).lstrip(), stops

    def _write_points(self, step: Step, segments: Segments) -> list[str]:
        """Coordinate words of the end of each segment; updates the position."""
        unit, axes = step.modes.unit, self._axes
        decimals, form, negative_zero = self._formats[unit]
        base: Sequence[float] = step.offset
        texts = []
        for point in segments.points:
            if not step.modes.absolute:
                base = tuple(self._position)
            values = tuple([(point[k] - base[k]) / unit for k in axes])
            text = form % values
            if negative_zero in text:
                text = text.replace(negative_zero, negative_zero[1:])
            texts.append(text)
            for k, value in zip(axes, values, strict=True):
                self._position[k] = round(value, decimals) * unit + base[k]
        return texts

    def _write_feeds(self, step: Step, segments: Segments) -> list[str]:
        """Feed word of each segment, empty if the feed does not change; updates the feed."""
        programmed, required = step.modes.feed, step.has_feed
        if step.modes.motion == 0 or programmed is None:
            return [""] * len(segments.points)
        texts = []
        for stretch in segments.stretch:
            feed, current = programmed * stretch, self._feed
            if required or current is None or abs(feed - current) > FEED_STEP * current:
                text = _format_feed(feed)
                self._feed, required = float(text), False
                texts.append(f"F{text}")
            else:
                texts.append("")
        return texts


def _after_number(line: Line) -> int:
    """Index of the first item after the number of the line."""
    first = line.items[0] if line.items else ""
    return 1 if isinstance(first, Word) and first.letter == "N" else 0


def _format_feed(feed: float) -> str:
    """Feed with FEED_DIGITS significant digits, without an exponent, which G-code does not have."""
    if feed == 0.0:
        return "0"
    decimals = max(FEED_DIGITS - 1 - math.floor(math.log10(feed)), 0)
    text = f"{feed:.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text
