"""Lines of a corrected program: other coordinates, and all else as it was."""

from __future__ import annotations

import math
from collections.abc import Sequence

from orthocal.gcode.cutting import Cut
from orthocal.gcode.state import INCH, STOPS, Modes, Step
from orthocal.gcode.words import Line, Plain, Word
from orthocal.units import MM

FEWEST_DECIMALS = {MM: 4, INCH: 5}
MOST_DECIMALS = 9

FEED_STEP = 1e-4
"""Part of itself by which a feed may be off before it is written anew."""

FEED_DIGITS = 6

REPLACED = frozenset("XYZIJKR")


def find_decimals(unit: float, rounding: float) -> int:
    """Decimals with which coordinates in space are rounded by less than that.

    Args:
        unit: Of the coordinates, [m].
        rounding: Largest distance, [m].
    """
    needed = math.ceil(math.log10(0.5 * math.sqrt(3.0) * unit / rounding))
    return min(max(FEWEST_DECIMALS[unit], needed), MOST_DECIMALS)


class Writer:
    """Writes lines, and knows what the controller knows after each.

    Args:
        axes: Indices of the axes that the drives command.
        rounding: By how much points may be off for their decimals, [m].
        start: Where the controller is in the beginning, [m]; None where that is not known.
    """

    def __init__(
        self, axes: Sequence[int], *, rounding: float, start: Sequence[float | None]
    ) -> None:
        self._axes = tuple(axes)
        self._forms: dict[float, tuple[int, str, str]] = {}
        """Unit to decimals, words of a point, and a zero that came from below."""
        for unit in (MM, INCH):
            n = find_decimals(unit, rounding)
            words = " ".join(f"{'XYZ'[k]}%.{n}f" for k in axes)
            self._forms[unit] = (n, words, f"-{0.0:.{n}f}")
        self._written: list[float] = [0.0 if v is None else v for v in start]
        """Where the controller is sent, [m]."""
        self._motion: int | None = None
        self._feed: float | None = None

    def keep(self, line: Line) -> str:
        """A line without a motion, as it is."""
        for item in line.items:
            if isinstance(item, Word):
                if item.letter == "F":
                    self._feed = item.value
                elif item.letter == "G" and item.value in _MOTIONS:
                    self._motion = int(item.value)
                elif item.letter == "G" and item.value in _FORGETS:
                    self._motion = None if item.value == _CANCEL else self._motion
                    self._feed = self._feed if item.value == _CANCEL else None
        return line.text

    def write(self, step: Step, cut: Cut) -> list[str]:
        """A line with a motion as the lines of its pieces."""
        feeds = self._feeds(step, cut)
        places = self._places(step, cut)
        motion = 0 if step.modes.motion == 0 else 1
        if isinstance(step.line, Plain):
            first, stops = _begin_plain(step.line, places[0], feeds[0]), ""
        else:
            held = len(places) > 1
            first, stops = self._begin(step.line, step.modes, places[0], feeds[0], held=held)
        self._motion = motion
        if step.fed and not motion:
            self._feed = step.modes.feed
        end = step.line.ending.lstrip(" \t") or "\n"
        if len(places) == 1:
            return [first + end]
        rest = zip(places[1:], feeds[1:], strict=True)
        texts = [first, *(f"{words} {feed}" if feed else words for words, feed in rest)]
        texts[-1] += stops
        return [text + end for text in texts]

    def _begin(
        self, line: Line, modes: Modes, place: str, feed: str, *, held: bool
    ) -> tuple[str, str]:
        """A line up to its first place, the feed there, and what follows the last."""
        motion = 0 if modes.motion == 0 else 1
        parts: list[str] = []
        stops = ""
        told = written = False
        at = 0
        for item in line.items:
            if isinstance(item, str):
                parts.append(item)
                continue
            letter, value = item.letter, item.value
            if letter in REPLACED or (letter == "P" and modes.motion in _ARCS):
                if not written:
                    parts.append(f" {place}" if parts else place)
                    written, at = True, len(parts)
            elif letter == "G" and value in _MOTIONS:
                parts.append(f" G{motion}" if parts else f"G{motion}")
                told = True
            elif letter == "F" and motion:
                continue
            elif letter == "M" and held and value in STOPS:
                stops += f" {item.text.strip()}"
            else:
                parts.append(item.text)
        if feed:
            parts.insert(at, f" {feed}")
        if self._motion != motion and not told:
            parts.insert(_after_number(line), f" G{motion}" if line.items else f"G{motion}")
        return "".join(parts).lstrip(), stops

    def _places(self, step: Step, cut: Cut) -> list[str]:
        """Words of the coordinates of each piece's end."""
        unit, axes = step.modes.unit, self._axes
        decimals, form, zero = self._forms[unit]
        base: Sequence[float] = step.offset
        found = []
        for point in cut.points:
            if not step.modes.absolute:
                base = tuple(self._written)
            values = tuple([(point[k] - base[k]) / unit for k in axes])
            text = form % values
            if zero in text:
                text = text.replace(zero, zero[1:])
            found.append(text)
            for k, value in zip(axes, values, strict=True):
                self._written[k] = round(value, decimals) * unit + base[k]
        return found

    def _feeds(self, step: Step, cut: Cut) -> list[str]:
        """Words of the feed of each piece; empty where it stays."""
        own, anew = step.modes.feed, step.fed
        if step.modes.motion == 0 or own is None:
            return [""] * len(cut.points)
        found = []
        for stretch in cut.stretch:
            feed, known = own * stretch, self._feed
            if anew or known is None or abs(feed - known) > FEED_STEP * known:
                text = _significant(feed)
                self._feed, anew = float(text), False
                found.append(f"F{text}")
            else:
                found.append("")
        return found


_MOTIONS = frozenset({0.0, 1.0, 2.0, 3.0})
_ARCS = frozenset({2, 3})
_CANCEL = 80.0
_FORGETS = frozenset({_CANCEL, 20.0, 21.0})


def _begin_plain(line: Plain, place: str, feed: str) -> str:
    """A line up to its first place, and the feed there."""
    parts = [] if line.label is None else [line.label]
    if line.motion is not None:
        parts.append(f"G{line.motion}")
    parts.append(place)
    if feed:
        parts.append(feed)
    return " ".join(parts)


def _after_number(line: Line) -> int:
    """Where words can be put in: behind the line's number."""
    first = line.items[0] if line.items else ""
    return 1 if isinstance(first, Word) and first.letter == "N" else 0


def _significant(value: float) -> str:
    """A positive number with six digits, and without an exponent."""
    if value <= 0.0:
        return "0"
    decimals = max(FEED_DIGITS - 1 - math.floor(math.log10(value)), 0)
    text = f"{value:.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text
