"""Numbers as text: numerals of table cells, their decimal sign, and typed readings.

A numeral can have two values: `1,234` is 1.234 with a decimal comma and 1234 with a decimal point.
The other numerals of the table decide. If they do not, the result contains the ambiguous numeral.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from decimal import Decimal
from typing import Literal

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import SessionError
from orthocal.io.strict_yaml import LONGEST_NUMBER
from orthocal.text import shorten
from orthocal.units import MM

Sign = Literal["point", "comma"]
"""Decimal sign."""

_MINUS = dict.fromkeys(map(ord, "\u2212\u2010\u2011\u2012\u2013\ufe63\uff0d"), "-")
"""Translation of typographic minus signs, hyphens and dashes to a hyphen."""

_BLANKS = " \t\n\u00a0\u2007\u2009\u202f"
_INVISIBLE = dict.fromkeys(map(ord, "\u200b\u200e\u200f\u2060\ufeff\u00ad\u202a\u202c"), "")

MISSING = frozenset(
    {"", "n/a", "na", "n.a.", "#n/a", "#nv", "nan", "k.a.", "k. a.", "tbd", "offen", "open", "?"}
)
"""Texts of cells without a reading, in lower case."""

_DASHES = re.compile(r"[-\u2012-\u2015\u2212_./…]+")


def _pattern(decimal: str, group: str) -> re.Pattern[str]:
    """Pattern of a numeral with a decimal sign and another separator of thousands."""
    grouped = (
        rf"[1-9][0-9]{{0,2}}(?P<group>[{group}{_BLANKS}'’])[0-9]{{3}}(?:(?P=group)[0-9]{{3}})*"
    )
    integer = rf"(?P<integer>{grouped}|[0-9]+)"
    fraction = rf"{decimal}(?P<fraction>[0-9]*)"
    return re.compile(
        rf"(?P<sign>[-+]?)[{_BLANKS}]*(?:{integer}(?:{fraction})?|{decimal}(?P<only>[0-9]+))"
        r"(?:[eE](?P<power>[-+]?[0-9]{1,3}))?"
    )


_PATTERNS: dict[Sign, re.Pattern[str]] = {
    "point": _pattern(r"\.", ","),
    "comma": _pattern(",", r"\."),
}

_TYPED = re.compile(r"([-+]?) ?([0-9]+[.,]?[0-9]*|[.,][0-9]+)")
_TYPED_UNIT = re.compile(r"(.*?)\s*(mm|µm|μm|um|m|in|inch|\"|'|″)", re.I)
_UNIT_NAMES = dict.fromkeys(("in", "inch", '"', "″"), "inches") | {"'": "feet"}
_SEVERAL_SEPARATORS = re.compile(r"[-+]? ?[0-9]+([.,' ][0-9]+){2,}|[-+]? ?[0-9]+[' ][0-9.,]+")
_THOUSANDS = re.compile(r"[1-9][0-9]{0,2},[0-9]{3}")


def tidy_text(text: str) -> str:
    """Text of a cell without surrounding blanks and invisible characters."""
    return text.translate(_INVISIBLE).strip(_BLANKS)


def plain_minus(text: str) -> str:
    """Text in which a hyphen replaces every typographic minus."""
    return text.translate(_MINUS)


def is_missing(text: str) -> bool:
    """True for an empty cell and for text that marks a missing reading."""
    text = tidy_text(text)
    return text.casefold() in MISSING or _DASHES.fullmatch(text) is not None


def parse_numeral(text: str, sign: Sign) -> Decimal | None:
    """Exact value of a numeral with a decimal sign; None if it is not a number."""
    # an apostrophe marks a number as text in spreadsheet programs
    text = plain_minus(tidy_text(text)).removeprefix("'")
    if len(text) > LONGEST_NUMBER:
        return None
    match = _PATTERNS[sign].fullmatch(text)
    if not match:
        return None
    integer = re.sub("[^0-9]", "", match["integer"] or "")
    fraction = match["fraction"] or match["only"] or ""
    return Decimal(f"{match['sign']}{integer or '0'}.{fraction or '0'}e{match['power'] or '0'}")


def format_decimal(value: Decimal) -> str:
    """Plain decimal notation without trailing zeros; exponents beyond ±30 keep their form."""
    text = f"{value:f}" if -30 < value.adjusted() < 30 else f"{value:e}"
    return text.rstrip("0").rstrip(".") if "." in text and "e" not in text else text


@dataclass(frozen=True, slots=True)
class Numeral:
    """Numeral and its line."""

    text: str
    line: int


@dataclass(frozen=True, slots=True)
class DecimalSign:
    """Decimal sign of a table, with the evidence."""

    sign: Sign
    evidence: Numeral | None
    """First numeral that determines the sign; None if the sign is stated, or not needed."""


def decide_decimal_sign(
    numerals: Iterable[Numeral], *, standard: bool, advice: str, place: Callable[[int], str]
) -> DecimalSign:
    """Common decimal sign (point or comma) of the numerals of a table.

    A numeral that is a number with one of the signs only determines the sign of the table. Integers
    have no sign.

    Args:
        numerals: The numerals.
        standard: Whether the headings are those of a readings.csv; then a point is a decimal point.
        advice: Action for the user in case of an ambiguous sign.
        place: Function from a line to file and line, for messages.

    Raises:
        SessionError: If both signs are possible, or both occur.
    """
    evidence: dict[Sign, list[Numeral]] = {}
    ambiguous: list[tuple[Numeral, Decimal, Decimal]] = []
    for numeral in numerals:
        point, comma = parse_numeral(numeral.text, "point"), parse_numeral(numeral.text, "comma")
        if point == comma:
            continue
        if point is not None and comma is not None:
            ambiguous.append((numeral, comma, point))
        else:
            evidence.setdefault("comma" if point is None else "point", []).append(numeral)
    if standard:
        points = [numeral for numeral, *_ in ambiguous if "," not in numeral.text]
        ambiguous = [values for values in ambiguous if "," in values[0].text]
        if points and "comma" in evidence:
            evidence.setdefault("point", points)
    if len(evidence) == 2:
        # of equally frequent signs, the second one is the rival
        frequent, rare = sorted(evidence, key=lambda sign: len(evidence[sign]), reverse=True)
        rival, other = evidence[rare][0], evidence[frequent][0]
        raise SessionError(
            f"the reading '{shorten(rival.text)}' has a decimal {rare}, and "
            f"'{shorten(other.text)}' in line {other.line} a decimal {frequent}; use one decimal "
            "sign",
            where=place(rival.line),
        )
    for sign, same in evidence.items():
        return DecimalSign(sign, same[0])
    if not ambiguous:
        return DecimalSign("point", None)
    numeral, comma, point = ambiguous[0]
    raise SessionError(
        f"the reading '{numeral.text}' is {format_decimal(comma)} with a decimal comma and "
        f"{format_decimal(point)} with a decimal point, and no other reading decides; {advice}",
        where=place(numeral.line),
    )


def parse_typed_reading(text: str, *, largest: float = math.inf) -> float:
    """Reading typed by the operator, [m].

    Args:
        text: Number in mm, such as 0.12, -0,35 or +1.2 mm.
        largest: Largest possible reading, [m]; a comma that would mean a larger one is a decimal
            comma.

    Raises:
        SessionError: If the text is not a number, has another unit, or has two possible values.
    """
    shown = shorten(text.strip())
    plain = " ".join(plain_minus(text).split()) if len(text) <= 2 * LONGEST_NUMBER else ""
    unit = _TYPED_UNIT.fullmatch(plain)
    if unit is not None:
        plain = unit[1]
        if unit[2].lower() != "mm":
            name = _UNIT_NAMES.get(unit[2].lower(), unit[2])
            raise SessionError(f"'{shown}' is in {name}; readings are in mm")
    number = _TYPED.fullmatch(plain) if len(plain) <= LONGEST_NUMBER else None
    if number is None:
        if _SEVERAL_SEPARATORS.fullmatch(plain):
            raise SessionError(
                f"'{shown}' has more than one separator; write a decimal point alone, such as 1.23"
            )
        raise SessionError(f"'{shown}' is neither a number nor a command; help lists those")
    sign, digits = number.groups()
    decimal, grouped = digits.replace(",", "."), digits.replace(",", "")
    if _THOUSANDS.fullmatch(digits) and float(grouped) * MM <= largest:
        raise SessionError(
            f"'{shown}' may be {sign}{decimal} or {sign}{grouped}; write {sign}{decimal} with a "
            f"point, or {sign}{grouped} without a separator"
        )
    value = float(decimal) * MM
    return (-value if sign == "-" else value) + 0.0


def parse_typed_point(text: str) -> Array:
    """Coordinates of a point typed by the operator, shape (3,), [m].

    Args:
        text: Three numbers in mm, separated by blanks, semicolons or tabs. Commas may separate
            numbers with decimal points.

    Raises:
        SessionError: If the text is not three numbers.
    """
    for separator in (";", None, ","):
        parts = [part.strip().rstrip(",") for part in text.strip().rstrip(";,").split(separator)]
        if len(parts) == 3 and all(parts):
            break
    else:
        raise SessionError(
            f"'{shorten(text.strip())}' is no point; expected x, y and z in mm with blanks between "
            "them, such as 1.25 -3.5 40"
        )
    return np.array([parse_typed_reading(part) for part in parts])
