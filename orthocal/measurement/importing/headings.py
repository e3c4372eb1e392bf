"""Headings of a table of readings: what each column is, in English or German, and in which unit."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Literal, cast, get_args

from orthocal.errors import SessionError
from orthocal.io.tables.cell import Row
from orthocal.io.tables.numerals import tidy_text
from orthocal.text import composed, shorten

Role = Literal["setup", "posture", "minus", "cycle", "reading"]
"""What a column is to a session."""

EXPECTED = "the headings setup, posture and reading"

WORDS: dict[Role, tuple[str, ...]] = {
    "setup": (
        *("setup", "set up", "setups", "setup name", "standing", "stand"),
        *("aufstellung", "aufbau", "messaufbau", "einrichtung", "messaufstellung"),
    ),
    "posture": (
        *("posture", "postures", "pose", "position", "machine position"),
        *("stellung", "messstellung", "haltung", "maschinenstellung", "lage"),
    ),
    "minus": (
        *("minus", "less", "minus posture", "posture minus", "subtracted"),
        *("abzüglich", "weniger", "minus stellung", "stellung minus", "minus position"),
    ),
    "cycle": (
        *("cycle", "cycles", "repeat", "repetition", "run", "pass", "round"),
        *("zyklus", "durchgang", "wiederholung", "lauf", "durchlauf", "messreihe", "umlauf"),
    ),
    "reading": (
        *("reading", "readings", "value", "measured", "measured value", "measurement"),
        *("indicator", "dial", "dial reading", "indicator reading", "gauge reading"),
        *("messwert", "messwerte", "ablesung", "anzeige", "wert", "messuhr", "gemessen"),
    ),
}
"""Headings without regard to capitals, blanks and underscores."""

_ROLES = {word: role for role, words in WORDS.items() for word in words}

UnitName = Literal["mm", "um", "inch", "cm", "thou"]
UNITS: dict[UnitName, Decimal] = {
    "mm": Decimal(1),
    "um": Decimal("0.001"),
    "inch": Decimal("25.4"),
    "cm": Decimal(10),
    "thou": Decimal("0.0254"),
}
"""Units of readings, and what they are in mm, exactly."""

_UNIT_WORDS: dict[str, UnitName] = {
    **dict.fromkeys(("mm", "millimeter", "millimetre", "millimeters", "millimetres"), "mm"),
    **dict.fromkeys(("um", "µm", "μm", "micron", "microns", "mikrometer", "micrometer"), "um"),
    **dict.fromkeys(("micrometre", "micrometres", "micrometers"), "um"),
    **dict.fromkeys(("inch", "inches", "in", "zoll", '"', "″", "in."), "inch"),
    **dict.fromkeys(("cm", "centimeter", "centimetre", "zentimeter"), "cm"),
    **dict.fromkeys(("thou", "mil", "mils", "0.001 in", '0.001"', "0.001 inch"), "thou"),
}

_BRACKETED = re.compile(r"(.*?)\s*[\[(]\s*(?:in\s+)?([^\[\]()]*?)\s*[\])]\s*(.*)", re.S)
_TAILED = re.compile(r"(.*?)(?:\s*[/,;:_]\s*(?:in\s+)?|\s+in\s+)(\S+)", re.S)
_SPACED = re.compile(r"(.*?)\s+(\S+)", re.S)
_NUMBERED = re.compile(r"([^0-9]*?)\s*(?:#|nr\.?|no\.?)?\s*([0-9]{1,4})\.?")
_NUMBER_FIRST = re.compile(r"([0-9]{1,4})(?:\.|st|nd|rd|th)?\s+([^0-9]+)")


@dataclass(frozen=True, slots=True)
class Heading:
    """What a heading says."""

    role: Role
    cycle: int | None = None
    """Of a reading that stands beside others: which cycle it is."""
    unit: UnitName | None = None


@dataclass(frozen=True, slots=True)
class ReadingColumn:
    """A column of readings."""

    index: int
    cycle: int | None
    """None where a row says it."""
    unit: UnitName | None


@dataclass(frozen=True, slots=True)
class Columns:
    """Which column of a table is what."""

    setup: int
    posture: int
    minus: int | None
    cycle: int | None
    readings: tuple[ReadingColumn, ...]
    extra: tuple[int, ...]
    """Columns that have a heading and are nothing of a session's."""

    @property
    def keys(self) -> tuple[int, ...]:
        """Columns that say which reading a row is of."""
        found = (self.setup, self.posture, self.minus, self.cycle)
        return tuple(i for i in found if i is not None)


def parse_unit(text: str) -> UnitName | None:
    """The unit of a word, such as µm; None if it is none."""
    return _UNIT_WORDS.get(" ".join(tidy_text(text).casefold().split()))


def read_heading(text: str) -> Heading | None:
    """What a heading says, such as `Messwert 2 [mm]`; None if it is nothing of a session's."""
    plain = " ".join(tidy_text(composed(text)).casefold().split())
    found = _read_words(plain)
    if found is not None:
        return found
    for rest, unit in _without_unit(plain):
        inner = _read_words(rest)
        if inner is not None and inner.role == "reading":
            return Heading("reading", inner.cycle, unit)
    return None


def _without_unit(plain: str) -> Iterator[tuple[str, UnitName]]:
    """A heading without its unit, and the unit: in brackets, at the end, or among its words."""
    found = _BRACKETED.fullmatch(plain)
    if found and (unit := parse_unit(found[2])):
        yield f"{found[1]} {found[3]}", unit
    for pattern in (_TAILED, _SPACED):
        found = pattern.fullmatch(plain)
        # "measured in" ends with no inch
        if (
            found
            and (unit := parse_unit(found[2]))
            and not (pattern is _SPACED and found[2] == "in")
        ):
            yield found[1], unit
    words = plain.split("_")
    for at, word in enumerate(words):
        if unit := parse_unit(word):
            yield " ".join(words[:at] + words[at + 1 :]), unit


def _read_words(plain: str) -> Heading | None:
    """What a heading without a unit says."""
    plain = " ".join(re.split(r"[\s_\-]+", plain)).strip(" .:")
    if plain in _ROLES:
        return Heading(_ROLES[plain])
    found = _NUMBERED.fullmatch(plain)
    word, number = (found[1], found[2]) if found else ("", "")
    if not found:
        first = _NUMBER_FIRST.fullmatch(plain)
        if not first:
            return None
        word, number = first[2], first[1]
    word = word.strip(" .:")
    if not word or _ROLES.get(word) in ("cycle", "reading"):
        return Heading("reading", int(number))
    return None


def find_header(rows: Sequence[Row], given: Mapping[str, str] | None = None) -> int | None:
    """Which of some rows holds the headings of a table of readings, if any."""
    for at, row in enumerate(rows):
        texts = [c.text for c in row.cells]
        roles = {h.role for h in _headings(texts, given or {}) if h is not None}
        if {"setup", "posture", "reading"} <= roles:
            return at
    return None


def _headings(texts: Sequence[str], given: Mapping[str, str]) -> list[Heading | None]:
    """What each column is: as is said, or by its heading."""
    said = {key: _find_named(texts, name) for key, name in given.items()}
    roles = {_said_heading(key).role for key in said}
    headings: list[Heading | None] = []
    for index, text in enumerate(texts):
        own = read_heading(text)
        keys = [key for key, places in said.items() if places == [index]]
        if keys:
            heading = _said_heading(keys[0])
            unit = (own.unit if own else None) or _trailing_unit(text)
            headings.append(Heading(heading.role, heading.cycle, unit))
        else:
            headings.append(None if own is None or own.role in roles else own)
    return headings


def _trailing_unit(text: str) -> UnitName | None:
    """The unit at the end of a heading whose words are not known."""
    plain = " ".join(tidy_text(composed(text)).casefold().split())
    return next((unit for _, unit in _without_unit(plain)), None)


def _said_heading(key: str) -> Heading:
    """What `setup` or `reading 2` of a --column is.

    Raises:
        SessionError: If it is none of these.
    """
    found = re.fullmatch(r"([a-z]+)\s*([0-9]{1,4})?", key.strip().casefold())
    role = found[1] if found else ""
    if found is None or role not in get_args(Role) or (found[2] and role != "reading"):
        raise SessionError(
            f"'{shorten(key)}' is no column of readings; expected one of "
            f"{', '.join(get_args(Role))}, or reading 1, reading 2 ... for cycles side by side",
            where="--column",
        )
    return Heading(cast("Role", role), int(found[2]) if found[2] else None)


def require_role(key: str) -> None:
    """Refuse what is no role of a column.

    Raises:
        SessionError: If it is neither setup, posture, minus, cycle nor reading.
    """
    _said_heading(key)


def _find_named(texts: Sequence[str], name: str) -> list[int]:
    """Columns with a heading, or with a number as `#4`."""
    numbered = re.fullmatch(r"#([0-9]{1,4})", name.strip())
    if numbered:
        index = int(numbered[1]) - 1
        return [index] if 0 <= index < len(texts) else []

    def plain(text: str) -> str:
        return " ".join(tidy_text(composed(text)).split())

    exact = [i for i, text in enumerate(texts) if plain(text) == plain(name)]
    alike = [i for i, t in enumerate(texts) if plain(t).casefold() == plain(name).casefold()]
    return exact or alike


def choose_columns(texts: Sequence[str], given: Mapping[str, str], *, where: str) -> Columns:
    """Which column is what.

    Args:
        texts: The headings.
        given: Role, or `reading 2`, to the heading of its column, or its number as `#4`.
        where: File and line, for messages.

    Raises:
        SessionError: If a role has no column, or several.
    """
    for key, name in given.items():
        places = _find_named(texts, name)
        if len(places) != 1:
            shown = shorten(", ".join(f"'{' '.join(t.split())}'" for t in texts))
            problem = (
                f"stands twice; --column {key}=#{places[0] + 1} says the first of them"
                if places
                else f"is not among the headings; found {shown}"
            )
            raise SessionError(f"column '{shorten(name)}' {problem}", where=f"{where}: {key}")
    headings = _headings(texts, given)
    single: dict[str, int] = {}
    for role in ("setup", "posture", "minus", "cycle"):
        places = [i for i, h in enumerate(headings) if h is not None and h.role == role]
        if len(places) > 1:
            raise _several(texts, places, role, where)
        if places:
            single[role] = places[0]
        elif role in ("setup", "posture"):
            raise SessionError(f"no column is the {role}; --column {role}=HEADING", where=where)
    readings = [
        ReadingColumn(i, h.cycle, h.unit)
        for i, h in enumerate(headings)
        if h is not None and h.role == "reading"
    ]
    _check_readings(texts, readings, single.get("cycle"), where)
    used = {r.index for r in readings} | set(single.values())
    extra = tuple(i for i, text in enumerate(texts) if i not in used and text.strip())
    return Columns(
        setup=single["setup"],
        posture=single["posture"],
        minus=single.get("minus"),
        cycle=single.get("cycle"),
        readings=tuple(readings),
        extra=extra,
    )


def _check_readings(
    texts: Sequence[str], readings: Sequence[ReadingColumn], cycle: int | None, where: str
) -> None:
    """Refuse columns of readings of which it is not clear what they are."""
    if not readings:
        raise SessionError("no column is the reading; --column reading=HEADING", where=where)
    single = [r.index for r in readings if r.cycle is None]
    if single and len(readings) > 1:
        raise _several(texts, [r.index for r in readings], "reading", where)
    numbers = [r.cycle for r in readings if r.cycle is not None]
    for r in readings:
        if r.cycle is None:
            continue
        if numbers.count(r.cycle) > 1:
            raise _several(
                texts, [o.index for o in readings if o.cycle == r.cycle], "reading", where
            )
        if r.cycle < 1:
            raise SessionError(
                f"column '{shorten(texts[r.index])}' is cycle {r.cycle}; expected 1, 2, 3 ...",
                where=where,
            )
    if numbers and cycle is not None:
        raise SessionError(
            f"has cycles side by side ('{shorten(texts[readings[0].index])}' ...) and a column "
            f"'{shorten(texts[cycle])}' as well; --column says which one counts",
            where=where,
        )


def _several(texts: Sequence[str], places: Sequence[int], role: str, where: str) -> SessionError:
    names = " and ".join(f"'{' '.join(texts[i].split())}' (#{i + 1})" for i in places[:4])
    return SessionError(
        f"several columns are the {role}: {names}; say which: --column {role}=HEADING", where=where
    )
