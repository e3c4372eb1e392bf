"""Interpreter of a program: modes, tools, positions and motions in coordinates of the world."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple, NoReturn

from orthocal.errors import GcodeError
from orthocal.gcode.lines import Line, PointLine, Word
from orthocal.gcode.path import (
    AXES,
    CENTERS,
    PLANES,
    Arc,
    Motion,
    Vector,
    arc_about,
    centre_of_radius,
)
from orthocal.units import INCH, MM

LARGEST_COORDINATE = 1e3
"""Largest accepted coordinate of a point, [m]."""

MOST_TURNS = 10_000
"""Largest number of turns of an arc."""

SYSTEMS = {
    **{540.0 + 10 * k: f"G{54 + k}" for k in range(6)},
    **{591.0 + k: f"G59.{1 + k}" for k in range(3)},
}
"""Names of the work coordinate systems by ten times the number of their G-word."""

GROUPS: dict[float, str] = {
    **dict.fromkeys((0.0, 10.0, 20.0, 30.0, 800.0), "motion"),
    **dict.fromkeys((170.0, 180.0, 190.0), "plane"),
    **dict.fromkeys((200.0, 210.0), "unit"),
    **dict.fromkeys((900.0, 910.0), "distance"),
    **dict.fromkeys((901.0, 911.0), "arc distance"),
    **dict.fromkeys((940.0, 950.0), "feed"),
    **dict.fromkeys((610.0, 611.0, 640.0), "path"),
    **dict.fromkeys((980.0, 990.0), "return"),
    **dict.fromkeys(SYSTEMS, "system"),
    40.0: "dwell",
    80.0: "diameter",
    400.0: "compensation",
    490.0: "tool length",
    921.0: "shift",
    970.0: "spindle",
}
"""Modal groups of the accepted G-words, by ten times their number. A line has at most one word of a
group."""

STOPS = frozenset({0.0, 1.0, 2.0, 30.0, 60.0})
"""M-words that take effect after the motion of their line."""

COORDINATES = frozenset("XYZIJKR")
"""Letters of points, centres and radii: a line with one of them is a motion."""

ENDS = frozenset({2.0, 30.0})
"""M-words that end the program."""

P_WORDS = frozenset({50.0, 51.0, 52.0, 53.0, 62.0, 63.0, 64.0, 65.0})
"""M-words with an argument P."""

M_WORDS = STOPS | P_WORDS | frozenset(float(m) for m in (3, 4, 5, 6, 7, 8, 9, 48, 49))
"""Accepted M-words."""

TOOL_CHANGE, PALLET_CHANGE = 6.0, 60.0

_LINES_AND_ARCS = "write the motion as lines and arcs (G0 to G3)"
_STATE_ZERO = "set it before the program, and state the zero with --work-offset-mm"
_CENTER_PATH = "export the path of the tool centre point from the CAM"

REFUSED_CODES: dict[str, tuple[str, str]] = {
    **dict.fromkeys(("G5", "G5.1", "G5.2", "G5.3"), ("is a spline", _LINES_AND_ARCS)),
    "G7": ("is diameter mode", "expected G8"),
    "G10": ("sets values of the controller", "set them before the program"),
    **dict.fromkeys(("G15", "G16"), ("is for polar coordinates", "write X, Y and Z")),
    **dict.fromkeys(
        ("G28", "G28.1", "G30", "G30.1"),
        ("is a motion to a position that the controller has stored", "write its coordinates"),
    ),
    **dict.fromkeys(
        ("G33", "G33.1"), ("is a motion synchronised with the spindle", _LINES_AND_ARCS)
    ),
    **dict.fromkeys(
        ("G38.2", "G38.3", "G38.4", "G38.5"),
        ("is a probing motion, with an unknown end", "remove it"),
    ),
    **dict.fromkeys(
        ("G41", "G41.1", "G42", "G42.1"),
        ("is cutter compensation, which the controller applies to uncorrected paths", _CENTER_PATH),
    ),
    **dict.fromkeys(
        ("G43", "G43.1", "G43.2"),
        (
            "is a tool length offset, and the length is in the controller",
            "remove G43, H and G49 from the program; add the length to Z of the work zero, in the "
            "controller and in --work-offset-mm; and state the tip with --tool",
        ),
    ),
    "G53": ("is a motion in machine coordinates", "write it in coordinates of the program"),
    **dict.fromkeys(
        ("G73", "G76", *(f"G{k}" for k in range(81, 90))),
        ("is a canned cycle, whose motions the controller makes", _LINES_AND_ARCS),
    ),
    **dict.fromkeys(("G92", "G92.2", "G92.3"), ("moves the zero of the program", _STATE_ZERO)),
    "G93": ("is inverse time feed", "expected G94"),
    "G95": ("is feed per revolution", "expected G94"),
    "G96": ("is constant surface speed", "expected G97"),
    "M61": ("sets the number of the current tool", "remove it"),
    "M66": ("waits for an input", "remove it"),
    "M98": ("calls a subroutine", "write its lines out"),
    "M99": ("ends a subroutine", "write its lines out"),
}
"""Reasons and remedies for G and M words that cannot be corrected."""

REFUSED_LETTERS: dict[str, tuple[str, str]] = {
    **dict.fromkeys("ABC", ("a rotary axis", "expected {axes}")),
    **dict.fromkeys("UVW", ("a secondary axis", "expected {axes}")),
    **dict.fromkeys("XYZ", ("an axis that the drives do not command", "expected {axes}")),
    "D": ("a tool radius", "remove it"),
    "H": ("a tool length offset", "remove it, and state the tip with --tool"),
    "O": ("subroutines and loops", "write their lines out"),
    "L": ("repetitions", "write them out"),
    "E": ("a word of splines", _LINES_AND_ARCS),
}
"""Meanings and remedies of letters that cannot be corrected."""


@dataclass(frozen=True, slots=True)
class Modes:
    """Modal state of the controller."""

    motion: int | None = None
    """Number of the G-word, 0 to 3; None if no motion is active."""
    plane: int = 17
    """Number of the G-word, 17 to 19."""
    unit: float = MM
    """Length unit, [m]."""
    has_unit: bool = False
    """Whether the program has set the unit."""
    absolute: bool = True
    """Whether coordinates are absolute (G90)."""
    centres_absolute: bool = False
    """Whether centres of arcs are absolute (G90.1)."""
    feed: float | None = None
    """Feed in units of the program per minute; None if unknown."""
    ended: bool = False
    """Whether the program has ended."""


class Step(NamedTuple):
    """Effect of a line."""

    line: Line | PointLine
    modes: Modes
    """Modes during the line."""
    offset: Vector
    """Zero of the work coordinates, [m]."""
    motion: Motion | None = None
    has_feed: bool = False
    """Whether the line sets the feed."""
    end_only: bool = False
    """Whether only the end is known, as for the first motion from an unknown position."""


class Tools:
    """Tools that a program moves, according to its T and M6 words.

    T selects a tool and M6 loads it. Before the first M6 the selected tool counts as loaded, as on
    controllers that change tools by T alone. The tool without a number is the tool that is loaded
    at the start of the program. T0 unloads the tool.

    Args:
        one: Whether to refuse a second tool.
    """

    def __init__(self, *, one: bool) -> None:
        self.used: list[str] = []
        """Tools that have moved, in order."""
        self.recorded = False
        """Whether further motions of the loaded tool do not change `used`."""
        self._one = one
        self._selected: float | None = None
        self._loaded: float | None = None
        self._changed = False

    def read(self, number: float | None, *, load: bool) -> None:
        """Apply the T and M6 words of a line.

        Args:
            number: Number of the T word; None if there is none.
            load: Whether the line contains M6.

        Raises:
            GcodeError: If a second tool is loaded and must be refused.
        """
        if number is not None:
            self._selected = number
        if load or not self._changed:
            self._changed |= load
            self._loaded, self.recorded = self._selected, False
            is_same = self._loaded is not None and _tool_name(self._loaded) in self.used[-1:]
            if self._one and self.used and not is_same and self._loaded != 0.0:
                second = "M6 without T" if self._loaded is None else _tool_name(self._loaded)
                raise GcodeError(
                    f"found {second} after motions of {self.used[-1]}, and --tool states one tip; "
                    "expected one tool: split the program by tools, and correct each part with "
                    "its own --tool"
                )

    def move(self, *, feed: bool) -> None:
        """Record a motion; rapid motions of a tool without a number are ignored.

        Args:
            feed: Whether the motion is at the feed, not rapid.
        """
        self.recorded = feed or self._loaded is not None
        name = _tool_name(self._loaded)
        if self.recorded and self._loaded != 0.0 and name not in self.used:
            self.used.append(name)


def _tool_name(number: float | None) -> str:
    return "the tool that was loaded before" if number is None else f"T{number:g}"


def _subtract(point: Vector, origin: Vector) -> Vector:
    return point[0] - origin[0], point[1] - origin[1], point[2] - origin[2]


class Interpreter:
    """Interpreter that reads a program line by line.

    Its errors do not state a place.

    Args:
        axes: Indices of the axes that the drives command.
        offsets: Zeros of the work coordinate systems in machine coordinates, [m], by name. Without
            G54 the program starts in machine coordinates.
        origin: Machine coordinates of the world's origin, [m].
        start: Position before the program, in coordinates of the program, [m]; None if unknown.
        one_tool: Whether to refuse a second tool.
    """

    def __init__(
        self,
        *,
        axes: Sequence[int],
        offsets: Mapping[str, Vector],
        origin: Vector = (0.0, 0.0, 0.0),
        start: Vector | None = None,
        one_tool: bool = False,
    ) -> None:
        self.axes = tuple(axes)
        self.modes = Modes()
        self.tools = Tools(one=one_tool)
        self._offsets = {name: _subtract(zero, origin) for name, zero in offsets.items()}
        self.offset = zero = self._offsets.get("G54", _subtract((0.0, 0.0, 0.0), origin))
        """Zero of the work coordinates in the world, [m]."""
        self.position: list[float | None] = [
            (None if start is None else start[k] + zero[k]) if k in self.axes else 0.0
            for k in range(3)
        ]
        """Programmed position of the tool in the world, [m]; None if unknown."""
        self._letters = {k: AXES[k] for k in self.axes}
        self._accepted = _ACCEPTED.union(self._letters.values())
        self._moved = False
        self.uncorrected: int | None = None
        """First line with an uncorrected rapid motion, because other axes have no position yet."""

    def read(self, line: Line) -> Step:
        """Apply a line to modes, tools and position.

        Raises:
            GcodeError: If the line contains a word that cannot be corrected.
        """
        words, codes = self._collect_words(line)
        dwell = ends = change = False
        for word in codes:
            if word.letter == "M":
                ends |= word.value in ENDS
                change |= word.value == TOOL_CHANGE
                if word.value in (TOOL_CHANGE, PALLET_CHANGE):
                    self._forget_position()
            elif word.value != self.modes.motion:
                dwell |= word.value == 4.0
                self._set_mode(word)
        if change or "T" in words:
            self.tools.read(words.get("T"), load=change)
        if "F" in words:
            if words["F"] < 0.0:
                raise GcodeError(f"found a feed of {words['F']:g}")
            if words["F"] != self.modes.feed:
                self.modes = replace(self.modes, feed=words["F"])
        if not _ARGUMENTS.isdisjoint(words):
            self._check_arguments(words, codes)
        moves = not COORDINATES.isdisjoint(words)
        if moves and dwell:
            raise GcodeError("found a dwell and coordinates; expected one of them")
        step = self._move(line, words) if moves else Step(line, self.modes, self.offset)
        if ends:
            self.modes = replace(self.modes, ended=True)
        return step

    def read_point(self, line: PointLine) -> Step | None:
        """Apply a line of coordinates only; None if `read` is needed.

        This shortcut of `read` halves the time for a program of short lines.
        """
        modes, offset, position = self.modes, self.offset, self.position
        code, unit = line.motion, modes.unit
        if (
            not (self._moved and self.tools.recorded)
            or (modes.motion != 0 and (modes.motion != 1 or not modes.feed))
            or (code is not None and int(code) != modes.motion)
        ):
            return None
        start: Vector = (position[0] or 0.0, position[1] or 0.0, position[2] or 0.0)
        end = list(start)
        for k, digits in enumerate(line[3:6]):
            if digits is not None:
                base = offset[k] if modes.absolute else start[k]
                end[k] = coordinate = float(digits) * unit + base
                if k not in self._letters or abs(coordinate) > LARGEST_COORDINATE:
                    return None
        if line[3:6] == _NO_COORDINATES:
            return None
        self.position[:] = end
        return Step(line, modes, offset, Motion(start, (end[0], end[1], end[2])))

    def _collect_words(self, line: Line) -> tuple[dict[str, float], list[Word]]:
        """Values of a line by letter, and its G and M words.

        Raises:
            GcodeError: If a word is repeated or not accepted.
        """
        words: dict[str, float] = {}
        codes: list[Word] = []
        groups: set[str] = set()
        for item in line.items:
            if isinstance(item, str):
                continue
            letter = item.letter
            if letter in self._accepted:
                if letter in words:
                    raise GcodeError(f"found the word {letter} twice")
                words[letter] = item.value
            elif letter == "G":
                group = GROUPS.get(_tenfold(item.value))
                if group is None:
                    _refuse_code(item)
                if group in groups:
                    raise GcodeError(
                        f"found {item.code} and another word of its group; expected one"
                    )
                groups.add(group)
                codes.append(item)
            elif letter == "M":
                if item.value not in M_WORDS:
                    _refuse_code(item)
                codes.append(item)
            else:
                self._refuse_letter(item)
        return words, codes

    def _refuse_letter(self, word: Word) -> NoReturn:
        """Refuse a word with another letter.

        Raises:
            GcodeError: Always.
        """
        reason, remedy = REFUSED_LETTERS.get(word.letter, ("an unknown word", "remove it"))
        remedy = remedy.format(axes=", ".join(self._letters.values()))
        raise GcodeError(f"found {word.text.strip()}, {reason}; {remedy}")

    def _set_mode(self, word: Word) -> None:
        """Apply a G-word to the modes."""
        code, modes = _tenfold(word.value), self.modes
        match GROUPS[code]:
            case "motion":
                self.modes = replace(modes, motion=None if code == 800.0 else int(word.value))
            case "plane":
                self.modes = replace(modes, plane=int(word.value))
            case "unit":
                unit = INCH if code == 200.0 else MM
                feed = modes.feed if unit == modes.unit else None
                self.modes = replace(modes, unit=unit, has_unit=True, feed=feed)
            case "distance":
                self.modes = replace(modes, absolute=code == 900.0)
            case "arc distance":
                self.modes = replace(modes, centres_absolute=code == 901.0)
            case "feed":
                if code == 950.0:
                    _refuse_code(word)
            case "system":
                name = SYSTEMS[code]
                if name not in self._offsets:
                    raise GcodeError(
                        f"found {name}, whose zero in machine coordinates is not stated; expected "
                        f"--work-offset-mm {name}=X,Y,Z (0,0,0 for machine coordinates)"
                    )
                self.offset = self._offsets[name]

    def _check_arguments(self, words: Mapping[str, float], codes: Sequence[Word]) -> None:
        """Refuse P, Q and the words of arcs on lines without a word that needs them."""
        is_arc = self.modes.motion in (2, 3)
        if "P" in words or "Q" in words:
            codes_with_p = {("G", 4.0), ("G", 64.0), *(("M", m) for m in P_WORDS)}
            belongs_to_code = any((w.letter, w.value) in codes_with_p for w in codes)
            belongs_to_arc = is_arc and not COORDINATES.isdisjoint(words)
            if not (belongs_to_code or (belongs_to_arc and "Q" not in words)):
                raise GcodeError("found P or Q without a word that needs it")
            if belongs_to_code and belongs_to_arc:
                raise GcodeError("found an arc and P for another word; write two lines")
        for letter in ("I", "J", "K", "R"):
            if letter in words and not is_arc:
                raise GcodeError(
                    f"found {letter}, a word of arcs, and the motion is {self._motion}; expected "
                    "G2 or G3"
                )

    @property
    def _motion(self) -> str:
        """Name of the active motion, for messages."""
        return "none" if self.modes.motion is None else f"G{self.modes.motion}"

    def _forget_position(self) -> None:
        """Treat the next motion as the first one: a tool change may have moved the machine."""
        for k in self.axes:
            self.position[k] = None
        self._moved = False

    def _move(self, line: Line, words: Mapping[str, float]) -> Step:
        """Effect of a line with coordinates.

        Raises:
            GcodeError: If the motion cannot be corrected.
        """
        modes = self.modes
        if modes.motion is None:
            raise GcodeError("found coordinates without a motion; expected G0 to G3")
        if modes.motion != 0 and not modes.feed:
            raise GcodeError(
                f"found {self._motion} without a feed; expected F before it, and again after a "
                "change of unit"
            )
        if self._is_unknown_after(words):
            return self._pass(line, words)
        end = self._end(words)
        start = self.position
        first, self._moved = not self._moved, True
        if first and modes.motion != 0:
            raise GcodeError(
                f"found {self._motion} as the first motion, from a position that is not on the "
                "corrected path; expected G0 to its start"
            )
        self.position = list(end)
        self.tools.move(feed=modes.motion != 0)
        has_feed = "F" in words
        if first:
            return Step(line, modes, self.offset, Motion(end, end), has_feed, end_only=True)
        begin: Vector = (start[0] or 0.0, start[1] or 0.0, start[2] or 0.0)
        arc = None if modes.motion < 2 else self._arc(begin, end, words)
        return Step(line, modes, self.offset, Motion(begin, end, arc), has_feed)

    def _is_unknown_after(self, words: Mapping[str, float]) -> bool:
        """True for a rapid motion at the start that leaves the position of an axis unknown."""
        return (self.modes.motion, self.modes.absolute, self._moved) == (0, True, False) and any(
            self.position[k] is None and letter not in words for k, letter in self._letters.items()
        )

    def _pass(self, line: Line, words: Mapping[str, float]) -> Step:
        """Effect of an uncorrected rapid motion, such as the first one to a safe height."""
        for k, letter in self._letters.items():
            if letter in words:
                self.position[k] = self._coordinate(
                    letter, words[letter] * self.modes.unit + self.offset[k]
                )
        self.tools.move(feed=False)
        if self.uncorrected is None:
            self.uncorrected = line.number
        return Step(line, self.modes, self.offset)

    def _end(self, words: Mapping[str, float]) -> Vector:
        """End of a motion, [m].

        Raises:
            GcodeError: If the position of an axis is unknown.
        """
        absolute, unit, offset = self.modes.absolute, self.modes.unit, self.offset
        end: list[float] = [0.0, 0.0, 0.0]
        for k, letter in self._letters.items():
            value, position = words.get(letter), self.position[k]
            if value is not None and absolute:
                coordinate = value * unit + offset[k]
            elif position is None:
                names = ", ".join(self._letters.values())
                raise GcodeError(
                    f"the position along {letter} is unknown before this motion; expected "
                    f"a first G0 to {names} in G90, or --start-mm"
                )
            else:
                coordinate = position + (value or 0.0) * unit
            end[k] = self._coordinate(letter, coordinate)
        return (end[0], end[1], end[2])

    @staticmethod
    def _coordinate(letter: str, value: float) -> float:
        """Coordinate, [m]; refuses one beyond LARGEST_COORDINATE."""
        if not -LARGEST_COORDINATE <= value <= LARGEST_COORDINATE:
            raise GcodeError(
                f"found {letter} at {value / MM:.6g} mm; expected at most "
                f"{LARGEST_COORDINATE / MM:g} mm"
            )
        return value

    def _arc(self, start: Vector, end: Vector, words: Mapping[str, float]) -> Arc:
        """Geometry of an arc from its words.

        Raises:
            GcodeError: If the words do not determine an arc.
        """
        modes = self.modes
        i, j, _ = PLANES[modes.plane]
        if i not in self.axes or j not in self.axes:
            raise GcodeError(
                f"found an arc in the plane of {AXES[i]} and {AXES[j]}; the drives command "
                f"{', '.join(self._letters.values())}"
            )
        clockwise = modes.motion == 2
        misplaced = [c for k, c in enumerate(CENTERS) if k not in (i, j) and c in words]
        if misplaced:
            raise GcodeError(
                f"found {misplaced[0]} with G{modes.plane}; expected {CENTERS[i]} and {CENTERS[j]}"
            )
        turns = words.get("P", 1.0)
        if turns != math.floor(turns) or not 1.0 <= turns <= MOST_TURNS:
            raise GcodeError(f"P is {turns:g}; expected a whole number of turns, 1 to {MOST_TURNS}")
        centres = [c for c in (CENTERS[i], CENTERS[j]) if c in words]
        if centres and "R" in words:
            raise GcodeError(f"found R and {centres[0]}; expected one of them")
        if "R" in words:
            radius = words["R"] * modes.unit
            centre = centre_of_radius(start, end, radius, plane=modes.plane, clockwise=clockwise)
        else:
            if not centres or (modes.centres_absolute and len(centres) < 2):
                problem = f"only {centres[0]}" if centres else "an arc without a centre"
                raise GcodeError(f"found {problem}; expected {CENTERS[i]} and {CENTERS[j]}, or R")
            base = self.offset if modes.centres_absolute else start
            first, second = (base[k] + words.get(CENTERS[k], 0.0) * modes.unit for k in (i, j))
            centre = (first, second)
        return arc_about(
            start, end, centre, plane=modes.plane, clockwise=clockwise, turns=int(turns)
        )


def _refuse_code(word: Word) -> NoReturn:
    """Refuse a G or M word.

    Raises:
        GcodeError: Always.
    """
    reason, remedy = REFUSED_CODES.get(
        word.code, ("is unknown", "expected G0 to G3 and words that do not change coordinates")
    )
    raise GcodeError(f"found {word.code}, which {reason}; {remedy}")


@lru_cache(maxsize=256)
def _tenfold(value: float) -> float:
    """Ten times the number of a G-word, without binary rounding."""
    return round(10.0 * value, 6)


_NO_COORDINATES = (None, None, None)
_ARGUMENTS = frozenset("PQIJKR")
_ACCEPTED = frozenset("NFSTPQIJKR")
