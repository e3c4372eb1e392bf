"""Headings of a table of readings, in English or German.

A heading states the role of its column, the unit of its readings, and the cycle if cycles are side
by side.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Literal, cast, get_args

from orthocal.errors import SessionError, errors_at
from orthocal.io.tables.cell import Row
from orthocal.io.tables.numerals import tidy_text
from orthocal.text import composed, shorten

Coordinate = Literal["x", "y", "z"]
"""Role of a column with a coordinate of points."""

Role = (
    Literal["setup", "posture", "minus", "cycle", "approach", "temperature", "time", "reading"]
    | Coordinate
    | Literal["nominal x", "nominal y", "nominal z"]
)
"""Role of a column. A nominal coordinate belongs to a commanded point."""

KEYS: tuple[Role, ...] = ("setup", "posture", "minus", "cycle")
"""Roles of columns that identify a reading."""

NOMINAL: tuple[Role, ...] = ("nominal x", "nominal y", "nominal z")
"""Roles of the commanded point that identifies a posture, in a session with points."""

SINGLE: tuple[Role, ...] = (*KEYS, "approach", "temperature", "time")
"""Roles that at most one column has."""

POINT: tuple[Role, ...] = get_args(Coordinate)
"""Roles of the columns of points, in place of readings."""

LENGTHS: tuple[Role, ...] = ("reading", *POINT, *NOMINAL)
"""Roles of columns that have a unit of length."""

ROLES: tuple[Role, ...] = (*SINGLE, *LENGTHS)
"""All roles, in the order of messages."""

EXPECTED = "the headings setup, posture and reading"

EXPECTED_POINTS = "the headings posture (or nominal x, y and z), x, y and z"

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
        *("cycle", "cycles", "repeat", "repetition", "rep", "rep.", "run", "pass", "round"),
        *("wdh", "wdh.", "zyklus", "durchgang", "wiederholung"),
        *("lauf", "durchlauf", "messreihe", "umlauf"),
    ),
    "reading": (
        *("reading", "readings", "value", "measured", "measured value", "measurement"),
        *("indicator", "dial", "dial reading", "indicator reading", "gauge reading"),
        *("messwert", "messwerte", "ablesung", "anzeige", "wert", "messuhr", "gemessen"),
    ),
    "approach": (
        *("approach", "approach direction", "direction of approach", "side of approach"),
        *("anfahrrichtung", "anfahrt", "anfahrseite"),
    ),
    "temperature": (
        *("temperature", "temp", "temp.", "machine temperature", "temperature of the machine"),
        *("temperatur", "maschinentemperatur"),
    ),
    "time": (
        *("time", "date and time", "date time", "datetime", "timestamp", "time of reading"),
        *("zeitpunkt", "zeitstempel", "datum und uhrzeit", "datum uhrzeit"),
    ),
}
"""Headings of every role, in lower case with single blanks."""

for _axis in POINT:
    WORDS[_axis] = (
        *(_axis, f"measured {_axis}", f"{_axis} measured", f"{_axis} meas", f"actual {_axis}"),
        *(f"{_axis} actual", f"{_axis} coordinate", f"{_axis} position", f"target {_axis}"),
        *(f"{_axis} ist", f"ist {_axis}", f"{_axis} koordinate"),
    )
    WORDS[cast(Role, f"nominal {_axis}")] = (
        *(f"nominal {_axis}", f"{_axis} nominal", f"{_axis} nom", f"commanded {_axis}"),
        *(f"{_axis} commanded", f"{_axis} command", f"{_axis} cmd", f"command {_axis}"),
        *(f"{_axis} soll", f"soll {_axis}"),
    )

_ROLES = {word: role for role, words in WORDS.items() for word in words}

Degrees = Literal["C", "F"]
"""Unit of a temperature: degrees Celsius or Fahrenheit."""

UnitName = Literal["mm", "um", "inch", "cm", "thou", "hundredths"]
UNITS: dict[UnitName, Decimal] = {
    "mm": Decimal(1),
    "um": Decimal("0.001"),
    "inch": Decimal("25.4"),
    "cm": Decimal(10),
    "thou": Decimal("0.0254"),
    "hundredths": Decimal("0.01"),
}
"""Units of readings and their exact sizes, [mm]."""

_UNIT_WORDS: dict[str, UnitName] = {
    **dict.fromkeys(("mm", "millimeter", "millimetre", "millimeters", "millimetres"), "mm"),
    **dict.fromkeys(("um", "µm", "μm", "micron", "microns", "mikrometer", "micrometer"), "um"),
    **dict.fromkeys(("micrometre", "micrometres", "micrometers"), "um"),
    **dict.fromkeys(("inch", "inches", "in", "zoll", '"', "″", "in."), "inch"),
    **dict.fromkeys(("cm", "centimeter", "centimetre", "zentimeter"), "cm"),
    **dict.fromkeys(("thou", "mil", "mils"), "thou"),
    **dict.fromkeys(("hundredths", "hundredth", "hundertstel"), "hundredths"),
}

LONGEST_HEADING = 100
"""Maximum number of characters of a heading; longer cells are not headings."""

_BRACKETED = re.compile(r"[\[(]([^\[\]()]*)[\])]")
_BREAK = re.compile(r"[\s_\-/,;:\[\]()]+")
_INCHES = r"(?:inch(?:es)?|in(?![a-z])|zoll|\")"
_THOUSANDTH = r"(?:1 ?/ ?1000|0[.,]001)[ _]?"
_FRACTIONS: tuple[tuple[re.Pattern[str], UnitName], ...] = (
    (re.compile(rf"{_THOUSANDTH}{_INCHES}"), "thou"),
    (re.compile(rf"{_THOUSANDTH}mm(?![a-z])"), "um"),
    (re.compile(r"(?:1 ?/ ?100|0[.,]01)[ _]?mm(?![a-z])"), "hundredths"),
    (re.compile(r"(?:hundredths?(?: of)?(?: a)?|hundertstel) ?mm(?![a-z])"), "hundredths"),
)
"""Fractions of a millimetre or an inch that are units."""

_MULTIPLE = re.compile(rf"(?:/ ?[0-9]+|0[.,][0-9]+|10+)[ _]?(?:mm|cm|[uµμ]m|{_INCHES})(?![a-z])")
"""Other multiples of a unit, which are not supported."""

_INCH = re.compile(r"(?:[/,;:_] ?|(?<![a-z])in |^)in\.?(?=_|$)")
_DEGREES = re.compile(
    r"(?:[\s\[(,;:/_-]+|(?=[°º]))(?:in )?(?:[°º]|deg(?:rees|\.)?)? ?(c|f|celsius|fahrenheit)[\])]?"
)
_NUMBERED = re.compile(r"([^0-9]*?)\s*(?:#|nr\.?|no\.?)?\s*([0-9]{1,4})\.?")
_NUMBER_FIRST = re.compile(r"([0-9]{1,4})(?:\.|st|nd|rd|th)?\s+([^0-9]+)")


@dataclass(frozen=True, slots=True)
class Heading:
    """Meaning of a heading."""

    role: Role
    cycle: int | None = None
    """Cycle of all readings of the column; None if the rows state it."""
    unit: UnitName | None = None


@dataclass(frozen=True, slots=True)
class Columns:
    """Roles of the columns of a table."""

    single: Mapping[Role, int]
    """Indices of the columns with a role in SINGLE, in that order."""
    readings: Mapping[int, Heading]
    """Headings of the columns of readings and points, by index. Columns of commanded points are
    included if there is no column of postures."""
    extra: tuple[int, ...]
    """Columns with a heading that has no role."""

    @property
    def keys(self) -> tuple[int, ...]:
        """Columns that identify a reading."""
        return tuple(i for role, i in self.single.items() if role in KEYS)


def parse_unit(text: str) -> UnitName | None:
    """Unit named by a text such as µm or 1/100 mm; None for other text."""
    return _UNIT_WORDS.get(_name_fractions(" ".join(tidy_text(text).casefold().split())))


def _name_fractions(plain: str) -> str:
    """Text with fractions of a unit, such as 1/100 mm, replaced by the name of the unit."""
    if len(plain) > LONGEST_HEADING:
        return plain
    for pattern, unit in _FRACTIONS:
        plain = pattern.sub(unit, plain)
    return plain


def read_heading(text: str) -> Heading | None:
    """Meaning of a heading such as `Messwert 2 [mm]`; None if it has no role."""
    plain = _normalize(text)
    heading = _read_words(plain)
    if heading is not None:
        return heading
    words, degrees = split_degrees(plain)
    if degrees is not None and _ROLES.get(" ".join(_BREAK.split(words)).strip()) == "temperature":
        return Heading("temperature")
    words, unit = _split_unit(plain)
    heading = None if unit is None else _read_words(words)
    if heading is None or heading.role not in LENGTHS:
        return None
    return Heading(heading.role, heading.cycle, unit)


def split_degrees(text: str) -> tuple[str, Degrees | None]:
    """Split the unit of a temperature from the end of a text; the unit is None if there is none."""
    plain = _normalize(text)
    for match in _DEGREES.finditer(plain):
        if match.end() == len(plain):
            return plain[: match.start()], "C" if match[1].startswith("c") else "F"
    return plain, None


def _normalize(text: str) -> str:
    """Heading in lower case with single blanks; empty if it is too long for a heading."""
    return _plain(text).casefold()


def _plain(text: str) -> str:
    """Heading with single blanks; empty if it is too long for a heading."""
    return " ".join(tidy_text(composed(text)).split()) if len(text) <= LONGEST_HEADING else ""


def _split_unit(plain: str) -> tuple[str, UnitName | None]:
    """Words of a heading without its unit, and the unit; None if there is none or several.

    A unit in brackets has priority. The word "in" is a preposition after a blank, and the unit inch
    after any other character.
    """
    plain = _name_fractions(plain)
    if _MULTIPLE.search(plain):
        return plain, None
    for bracket in _BRACKETED.finditer(plain):
        if unit := parse_unit(bracket[1].removeprefix("in ")):
            return f"{plain[: bracket.start()]} {plain[bracket.end() :]}", unit
    words = [word for word in _BREAK.split(plain) if word]
    units = [(i, unit) for i, w in enumerate(words) if w != "in" and (unit := parse_unit(w))]
    if len({unit for _, unit in units}) == 1:
        index, unit = units[0]
        first = index - 1 if index and words[index - 1] == "in" else index
        return " ".join(words[:first] + words[index + 1 :]), unit
    if not units and (inch := _INCH.search(plain)):
        return f"{plain[: inch.start()]} {plain[inch.end() :]}", "inch"
    return plain, None


def _read_words(plain: str) -> Heading | None:
    """Meaning of a heading without a unit."""
    plain = " ".join(re.split(r"[\s_\-]+", plain)).strip(" .:")
    if plain in _ROLES:
        return Heading(_ROLES[plain])
    if match := _NUMBERED.fullmatch(plain):
        word, number = match.groups()
    elif match := _NUMBER_FIRST.fullmatch(plain):
        number, word = match.groups()
    else:
        return None
    word = word.strip(" .:")
    if not word or _ROLES.get(word) in ("cycle", "reading"):
        return Heading("reading", int(number))
    return None


def find_header(
    rows: Sequence[Row], assigned: Mapping[str, str] | None = None, *, points: bool = False
) -> int | None:
    """Index of the first row with the headings of a table of readings; None if there is none.

    Args:
        rows: The first rows of a table.
        assigned: Headings or numbers of columns by role, as in `choose_columns`.
        points: Whether the table may contain measured points.
    """
    for index, row in enumerate(rows):
        texts = [c.text for c in row.cells]
        headings = _read_headings(texts, assigned or {}, points)
        roles = {h.role for h in headings if h is not None}
        if {"setup", "posture", "reading"} <= roles:
            return index
        if roles.issuperset(POINT) and ("posture" in roles or roles.issuperset(NOMINAL)):
            return index
    return None


def _read_headings(
    texts: Sequence[str], assigned: Mapping[str, str], points: bool
) -> list[Heading | None]:
    """Meaning of every heading of a row; roles assigned by the user replace those of headings."""
    indices = {key: _find_column(texts, name) for key, name in assigned.items()}
    by_index = {
        columns[0]: parse_role(key) for key, columns in indices.items() if len(columns) == 1
    }
    assigned_roles = {parse_role(key).role for key in assigned}
    headings: list[Heading | None] = []
    for index, text in enumerate(texts):
        heading = read_heading(text)
        if index in by_index:
            unit = heading.unit if heading and heading.unit else _split_unit(_normalize(text))[1]
            heading = Heading(by_index[index].role, by_index[index].cycle, unit)
        elif heading is not None and (
            heading.role in assigned_roles or (heading.role in (*POINT, *NOMINAL) and not points)
        ):
            heading = None
        headings.append(heading)
    return headings


def parse_role(key: str) -> Heading:
    """Parse the role of a --column option, such as `setup` or `reading 2`.

    Raises:
        SessionError: If the text is not a role.
    """
    match = re.fullmatch(r"((?:nominal )?[a-z]+)\s*([0-9]{1,4})?", key.strip().casefold())
    role = match[1] if match else ""
    if match is None or role not in ROLES or (match[2] and role != "reading"):
        raise SessionError(
            f"'{shorten(key)}' is not the role of a column; expected one of "
            f"{', '.join(ROLES)}, or reading 1, reading 2 ... for cycles side by side",
            where="--column",
        )
    return Heading(cast("Role", role), int(match[2]) if match[2] else None)


def _find_column(texts: Sequence[str], name: str) -> list[int]:
    """Indices of the columns with a heading; `#4` is the fourth column."""
    numbered = re.fullmatch(r"#([0-9]{1,4})", name.strip())
    if numbered:
        index = int(numbered[1]) - 1
        return [index] if 0 <= index < len(texts) else []
    for simplify in (_plain, _normalize):
        wanted = simplify(name)
        if indices := [i for i, text in enumerate(map(simplify, texts)) if text and text == wanted]:
            return indices
    return []


def choose_columns(
    texts: Sequence[str],
    assigned: Mapping[str, str],
    *,
    where: str,
    points: bool = False,
    one_setup: bool = False,
) -> Columns:
    """Assign a role to every column.

    Args:
        texts: Headings.
        assigned: Heading of a column, or its number such as `#4`, by role or `reading 2`.
        where: File and line, for messages.
        points: Whether the table may contain measured points. Commanded points may then name
            their postures.
        one_setup: Whether the setup need not be stated.

    Raises:
        SessionError: If a required role has no column, or a role has several columns.
    """
    for key, name in assigned.items():
        indices = _find_column(texts, name)
        if len(indices) != 1:
            shown = shorten(", ".join(f"'{' '.join(t.split())}'" for t in texts))
            problem = (
                f"appears twice; --column {key}=#{indices[0] + 1} selects the first one"
                if indices
                else f"is not among the headings {shown}"
            )
            raise SessionError(f"column '{shorten(name)}' {problem}", where=f"{where}: {key}")
    headings = _read_headings(texts, assigned, points)
    columns: dict[Role, list[int]] = {role: [] for role in ROLES}
    for index, heading in enumerate(headings):
        if heading is not None:
            columns[heading.role].append(index)
    has_points = any(columns[role] for role in POINT)
    required: dict[Role, bool] = {
        "setup": not one_setup,
        "posture": not all(columns[role] for role in NOMINAL),
        **dict.fromkeys(POINT, has_points),
    }
    lengths = ("reading", *POINT) if columns["posture"] else LENGTHS
    readings = {i: h for i, h in enumerate(headings) if h is not None and h.role in lengths}
    with errors_at(where):
        for role in (*SINGLE, *lengths[1:]):
            if len(columns[role]) > 1:
                raise _several_columns(texts, columns[role], role)
            if not columns[role] and required.get(role):
                raise _missing_column(role)
        single = {role: columns[role][0] for role in SINGLE if columns[role]}
        reading_columns = {i: readings[i] for i in columns["reading"]}
        if reading_columns or not has_points:
            _check_readings(texts, reading_columns, single.get("cycle"))
    used = {*readings, *single.values()}
    return Columns(
        single=single,
        readings=readings,
        extra=tuple(i for i, text in enumerate(texts) if i not in used and text.strip()),
    )


def _check_readings(
    texts: Sequence[str], readings: Mapping[int, Heading], cycle: int | None
) -> None:
    """Refuse missing and ambiguous columns of readings."""
    if not readings:
        raise _missing_column("reading")
    by_cycle: dict[int, list[int]] = {}
    for index, heading in readings.items():
        if heading.cycle is None:
            if len(readings) > 1:
                raise _several_columns(texts, list(readings), "reading")
            continue
        if heading.cycle < 1:
            raise SessionError(
                f"column '{shorten(texts[index])}' is cycle {heading.cycle}; expected 1, 2, 3 ..."
            )
        by_cycle.setdefault(heading.cycle, []).append(index)
    for indices in by_cycle.values():
        if len(indices) > 1:
            raise _several_columns(texts, indices, "reading")
    if by_cycle and cycle is not None:
        raise SessionError(
            f"has cycles side by side ('{shorten(texts[min(readings)])}' ...) and a column "
            f"'{shorten(texts[cycle])}' as well; choose one by --column"
        )


def _missing_column(role: str) -> SessionError:
    """Error about a role without a column."""
    return SessionError(f"no column has the role {role}; assign one by --column {role}=HEADING")


def _several_columns(texts: Sequence[str], indices: Sequence[int], role: str) -> SessionError:
    """Error about several columns with one role."""
    names = " and ".join(f"'{' '.join(texts[i].split())}' (#{i + 1})" for i in indices[:4])
    return SessionError(
        f"several columns have the role {role}: {names}; choose one by --column {role}=HEADING"
    )
