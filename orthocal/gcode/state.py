"""What a program's lines mean: modes, positions and motions, in the machine's coordinates."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

from orthocal.errors import GcodeError
from orthocal.gcode.arcs import CENTRES, MOST_TURNS, NAMES, arc_about, center_of_radius
from orthocal.gcode.path import PLANES, Arc, Motion, Vector
from orthocal.gcode.refusals import refuse_code, refuse_letter
from orthocal.gcode.words import Line, Plain, Word
from orthocal.units import MM

INCH = 25.4 * MM

LARGEST_COORDINATE = 1e3
"""[m]"""

SYSTEMS = {
    **{540.0 + 10 * k: f"G{54 + k}" for k in range(6)},
    **{591.0 + k: f"G59.{1 + k}" for k in range(3)},
}
"""Ten times the number to the name of a work coordinate system."""

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
"""Ten times the number of a G-word that is understood to what it is about: one a line."""

STOPS = frozenset({0.0, 1.0, 2.0, 30.0, 60.0})
"""M-words that take effect after the motion of their line."""

ENDS = frozenset({2.0, 30.0})

M_WORDS = STOPS | frozenset(
    float(m) for m in (3, 4, 5, 6, 7, 8, 9, 48, 49, 50, 51, 52, 53, 62, 63, 64, 65)
)

TAKES_P = frozenset({50.0, 51.0, 52.0, 53.0, 62.0, 63.0, 64.0, 65.0})


@dataclass(frozen=True, slots=True)
class Modes:
    """What stays until it is told otherwise."""

    motion: int | None = None
    """0 to 3."""
    plane: int = 17
    unit: float = MM
    """[m]"""
    unit_told: bool = False
    absolute: bool = True
    centers_absolute: bool = False
    feed: float | None = None
    """As it is written; None where it is not known."""
    system: str | None = None
    """Work coordinates that the program has named."""
    ended: bool = False


class Step(NamedTuple):
    """What a line does."""

    line: Line | Plain
    modes: Modes
    """Those of the line."""
    offset: Vector
    """Place of the work coordinates' zero, [m]."""
    motion: Motion | None = None
    fed: bool = False
    """Whether the line tells a feed."""
    straight: bool = False
    """Whether only its end is known: the first motion, from wherever the machine stands."""


class Interpreter:
    """Reads a program line by line.

    Args:
        file: Name of the program, for messages.
        axes: Indices of the axes that the drives command.
        offsets: Work coordinate systems to the place of their zero, [m]. Without G54 among them the
            program's coordinates are the machine's.
        start: Where the program begins, in its coordinates, [m]; None where that is not known.
    """

    def __init__(
        self,
        file: str,
        *,
        axes: Sequence[int],
        offsets: Mapping[str, Vector],
        start: Vector | None = None,
    ) -> None:
        self.modes = Modes()
        self._file, self._axes, self._offsets = file, tuple(axes), offsets
        self._letters = {k: NAMES[k] for k in self._axes}
        self._known = _KNOWN.union(self._letters.values())
        self._offset = zero = offsets.get("G54", (0.0, 0.0, 0.0))
        self.position: list[float | None] = [
            (None if start is None else start[k] + zero[k]) if k in self._axes else 0.0
            for k in range(3)
        ]
        """Where the tool is to be, [m]; None where that is not known."""
        self._moved = False

    @property
    def offset(self) -> Vector:
        """Place of the work coordinates' zero, [m]."""
        return self._offset

    def read(self, line: Line) -> Step:
        """What a line does; the position and the modes follow.

        Raises:
            GcodeError: If it holds what cannot be corrected.
        """
        where = f"{self._file}:{line.number}"
        words, codes = self._sort(line, where)
        dwell = ends = False
        for word in codes:
            if word.letter == "M":
                ends = ends or word.value in ENDS
            elif word.value != self.modes.motion:
                dwell = dwell or word.value == 4.0
                self._set_mode(word, where)
        if "F" in words:
            if words["F"] < 0.0:
                raise GcodeError(f"found a feed of {words['F']:g}", where=where)
            if words["F"] != self.modes.feed:
                self.modes = replace(self.modes, feed=words["F"])
        if not _TAKEN.isdisjoint(words):
            self._check_taken(words, codes, where)
        moves = not _MOVES.isdisjoint(words)
        if moves and dwell:
            raise GcodeError("found a dwell and coordinates; expected one of them", where=where)
        step = self._move(line, words, where) if moves else Step(line, self.modes, self._offset)
        if ends:
            self.modes = replace(self.modes, ended=True)
        return step

    def read_plain(self, line: Plain) -> Step | None:
        """What such a line does: as `read`; None where that has more to look at."""
        modes, offset, position = self.modes, self._offset, self.position
        told, unit = line.motion, modes.unit
        if (
            not self._moved
            or (modes.motion != 0 and (modes.motion != 1 or not modes.feed))
            or (told is not None and int(told) != modes.motion)
        ):
            return None
        begin: Vector = (position[0] or 0.0, position[1] or 0.0, position[2] or 0.0)
        end = list(begin)
        for k, digits in enumerate(line[3:6]):
            if digits is not None:
                base = offset[k] if modes.absolute else begin[k]
                end[k] = place = float(digits) * unit + base
                if k not in self._letters or abs(place) > LARGEST_COORDINATE:
                    return None
        if line[3:6] == _NOWHERE:
            return None
        self.position[:] = end
        return Step(line, modes, offset, Motion(begin, (end[0], end[1], end[2])))

    def _sort(self, line: Line, where: str) -> tuple[dict[str, float], list[Word]]:
        """Values by letter, and G and M words; each once, and none that is not known."""
        words: dict[str, float] = {}
        codes: list[Word] = []
        groups: set[str] = set()
        for item in line.items:
            if isinstance(item, str):
                continue
            letter = item.letter
            if letter in self._known:
                if letter in words:
                    raise GcodeError(f"the word {letter} stands twice", where=where)
                words[letter] = item.value
            elif letter == "G":
                group = GROUPS.get(_tenfold(item.value))
                if group is None:
                    refuse_code(item, where)
                elif group in groups:
                    raise GcodeError(
                        f"found {item.code} beside another word of its kind; expected one",
                        where=where,
                    )
                else:
                    groups.add(group)
                codes.append(item)
            elif letter == "M":
                if item.value not in M_WORDS:
                    refuse_code(item, where)
                codes.append(item)
            else:
                refuse_letter(item, where, axes=", ".join(self._letters.values()))
        return words, codes

    def _set_mode(self, word: Word, where: str) -> None:
        code, modes = _tenfold(word.value), self.modes
        match GROUPS[code]:
            case "motion":
                motion = None if code == 800.0 else int(word.value)
                if motion != modes.motion:
                    self.modes = replace(modes, motion=motion)
            case "plane":
                self.modes = replace(modes, plane=int(word.value))
            case "unit":
                unit = INCH if code == 200.0 else MM
                kept = modes.feed if unit == modes.unit else None
                self.modes = replace(modes, unit=unit, unit_told=True, feed=kept)
            case "distance":
                self.modes = replace(modes, absolute=code == 900.0)
            case "arc distance":
                self.modes = replace(modes, centers_absolute=code == 901.0)
            case "feed":
                if code == 950.0:
                    refuse_code(word, where)
            case "system":
                name = SYSTEMS[code]
                if name not in self._offsets:
                    raise GcodeError(
                        f"found {name}, and nothing says where its zero is in the machine's "
                        f"coordinates; expected --work-offset-mm {name}=X,Y,Z (0,0,0 if it is "
                        "theirs)",
                        where=where,
                    )
                self.modes, self._offset = replace(modes, system=name), self._offsets[name]

    def _check_taken(self, words: Mapping[str, float], codes: Sequence[Word], where: str) -> None:
        """Refuse P, Q and the words of arcs where nothing takes them."""
        arc = self.modes.motion in (2, 3)
        if "P" in words or "Q" in words:
            taken = {("G", 4.0), ("G", 64.0), *(("M", m) for m in TAKES_P)}
            by_code = any((w.letter, w.value) in taken for w in codes)
            moves = arc and not _MOVES.isdisjoint(words)
            if not (by_code or (moves and "Q" not in words)):
                raise GcodeError("found P or Q, which nothing on the line takes", where=where)
            if by_code and moves:
                raise GcodeError(
                    "found an arc and P for another word; write two lines", where=where
                )
        for letter in ("I", "J", "K", "R"):
            if letter in words and not arc:
                raise GcodeError(
                    f"found {letter}, a word of arcs, where the motion is {self._motion}; expected "
                    "G2 or G3",
                    where=where,
                )

    @property
    def _motion(self) -> str:
        return "none" if self.modes.motion is None else f"G{self.modes.motion}"

    def _move(self, line: Line, words: Mapping[str, float], where: str) -> Step:
        modes = self.modes
        if modes.motion is None:
            raise GcodeError("found coordinates without a motion; expected G0 to G3", where=where)
        if modes.motion != 0 and not modes.feed:
            raise GcodeError(
                f"found {self._motion}, and no feed is known; expected F before it, and again "
                "after another unit",
                where=where,
            )
        end = self._end(words, where)
        start = self.position
        first, self._moved = not self._moved, True
        if first and modes.motion != 0:
            raise GcodeError(
                f"found {self._motion} as the first motion: where the machine stands is not on the "
                "corrected path; expected G0 to where it begins",
                where=where,
            )
        self.position = list(end)
        if first:
            return Step(line, modes, self._offset, Motion(end, end), "F" in words, straight=True)
        begin: Vector = (start[0] or 0.0, start[1] or 0.0, start[2] or 0.0)
        arc = None if modes.motion < 2 else self._arc(begin, end, words, where)
        return Step(line, modes, self._offset, Motion(begin, end, arc), "F" in words)

    def _end(self, words: Mapping[str, float], where: str) -> Vector:
        absolute, unit, offset = self.modes.absolute, self.modes.unit, self._offset
        end: list[float] = [0.0, 0.0, 0.0]
        for k, letter in self._letters.items():
            value, old = words.get(letter), self.position[k]
            if value is not None and absolute:
                end[k] = place = value * unit + offset[k]
            elif old is None:
                names = ", ".join(self._letters.values())
                raise GcodeError(
                    f"where the tool is along {letter} is not known before this motion; expected "
                    f"a first G0 to {names} in G90, or --start-mm",
                    where=where,
                )
            else:
                end[k] = place = old + (value or 0.0) * unit
            if not -LARGEST_COORDINATE <= place <= LARGEST_COORDINATE:
                raise GcodeError(f"{letter} is beyond any machine", where=where)
        return (end[0], end[1], end[2])

    def _arc(self, start: Vector, end: Vector, words: Mapping[str, float], where: str) -> Arc:
        modes = self.modes
        i, j, _ = PLANES[modes.plane]
        if i not in self._axes or j not in self._axes:
            raise GcodeError(
                f"found an arc in the plane of {NAMES[i]} and {NAMES[j]}; the drives command "
                f"{', '.join(self._letters.values())}",
                where=where,
            )
        clockwise = modes.motion == 2
        wrong = [c for k, c in enumerate(CENTRES) if k not in (i, j) and c in words]
        if wrong:
            raise GcodeError(
                f"found {wrong[0]} with G{modes.plane}; expected {CENTRES[i]} and {CENTRES[j]}",
                where=where,
            )
        told = [c for c in (CENTRES[i], CENTRES[j]) if c in words]
        turns = words.get("P", 1.0)
        if turns != math.floor(turns) or not 1.0 <= turns <= MOST_TURNS:
            raise GcodeError(
                f"P is {turns:g}; expected a whole number of turns, 1 to {MOST_TURNS}", where=where
            )
        if told and "R" in words:
            raise GcodeError(f"found R and {told[0]}; expected one of them", where=where)
        if "R" in words:
            center = center_of_radius(
                start,
                end,
                words["R"] * modes.unit,
                plane=modes.plane,
                clockwise=clockwise,
                where=where,
            )
        else:
            center = self._center(start, words, told, where)
        return arc_about(
            start,
            end,
            center,
            plane=modes.plane,
            clockwise=clockwise,
            turns=int(turns),
            where=where,
        )

    def _center(
        self, start: Vector, words: Mapping[str, float], told: Sequence[str], where: str
    ) -> tuple[float, float]:
        modes, offset = self.modes, self.offset
        i, j, _ = PLANES[modes.plane]
        if not told or (modes.centers_absolute and len(told) < 2):
            found = f"only {told[0]}" if told else "an arc without a centre"
            raise GcodeError(
                f"found {found}; expected {CENTRES[i]} and {CENTRES[j]}, or R", where=where
            )
        values = [words.get(CENTRES[k], 0.0) * modes.unit for k in (i, j)]
        base = [offset[i], offset[j]] if modes.centers_absolute else [start[i], start[j]]
        return (base[0] + values[0], base[1] + values[1])


@lru_cache(maxsize=256)
def _tenfold(value: float) -> float:
    """Ten times the number of a G-word, without what binary fractions add."""
    return round(10.0 * value, 6)


_NOWHERE = (None, None, None)
_MOVES = frozenset("XYZIJKR")
_TAKEN = frozenset("PQIJKR")
_KNOWN = frozenset("NFSTPQIJKR")
