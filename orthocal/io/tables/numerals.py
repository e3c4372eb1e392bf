"""One cell to a number, and the decimal sign of a whole table.

A numeral may be two numbers: `1,234` is 1.234 with a decimal comma and 1234 with a decimal point.
What decides is the other cells; where they do not, that is said as data.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from typing import Literal

from orthocal.io.strict_yaml import LONGEST_NUMBER

Sign = Literal["point", "comma"]
"""A decimal sign."""

SIGNS: dict[Sign, str] = {"point": ".", "comma": ","}

_MINUS = dict.fromkeys(map(ord, "\u2212\u2010\u2011\u2012\u2013\ufe63\uff0d"), "-")
"""What spreadsheets and fonts make of a minus: minus sign, hyphens, dashes."""

_BLANK = " \t\n\u00a0\u2007\u2009\u202f"
_UNSEEN = dict.fromkeys(map(ord, "\u200b\u200e\u200f\u2060\ufeff\u00ad\u202a\u202c"), "")

UNREAD = frozenset(
    {"", "n/a", "na", "n.a.", "#n/a", "#nv", "nan", "k.a.", "k. a.", "tbd", "offen", "open", "?"}
)
"""What stands in cells that are not yet read, in small letters; and dashes alone."""

_DASHES = re.compile(r"[-\u2012-\u2015\u2212_./…]+")


def _pattern(decimal: str, group: str) -> re.Pattern[str]:
    grouped = rf"[1-9][0-9]{{0,2}}(?P<group>[{group}{_BLANK}'’])[0-9]{{3}}(?:(?P=group)[0-9]{{3}})*"
    whole = rf"(?P<whole>{grouped}|[0-9]+)"
    fraction = rf"{decimal}(?P<fraction>[0-9]*)"
    return re.compile(
        rf"(?P<sign>[-+]?)[{_BLANK}]*(?:{whole}(?:{fraction})?|{decimal}(?P<only>[0-9]+))"
        r"(?:[eE](?P<power>[-+]?[0-9]{1,3}))?"
    )


_PATTERNS: dict[Sign, re.Pattern[str]] = {
    "point": _pattern(r"\.", ","),
    "comma": _pattern(",", r"\."),
}


def tidy_text(text: str) -> str:
    """A cell's text without blanks around it and without characters that nobody sees."""
    return text.translate(_UNSEEN).strip(_BLANK)


def plain_minus(text: str) -> str:
    """A text in which every typographic minus is an ordinary one."""
    return text.translate(_MINUS)


def is_unread(text: str) -> bool:
    """Whether a cell is empty, or says that nothing was read."""
    text = tidy_text(text)
    return text.casefold() in UNREAD or _DASHES.fullmatch(text) is not None


def parse_numeral(text: str, sign: Sign) -> Decimal | None:
    """The number that a text is with a decimal sign, exactly; None if it is none."""
    text = tidy_text(text).translate(_MINUS)
    if len(text) > LONGEST_NUMBER:
        return None
    if text.startswith("'"):  # how spreadsheets mark a number that shall stay text
        text = text[1:]
    found = _PATTERNS[sign].fullmatch(text)
    if not found:
        return None
    whole = re.sub("[^0-9]", "", found["whole"] or "")
    fraction = found["fraction"] or found["only"] or ""
    try:
        return Decimal(f"{found['sign']}{whole or '0'}.{fraction or '0'}e{found['power'] or '0'}")
    except InvalidOperation:
        return None


def shown(value: Decimal | None) -> str:
    """A number as people write it, without zeros at its end."""
    if value is None:
        return "no number"
    text = f"{value:f}" if -30 < value.adjusted() < 30 else f"{value:e}"
    return text.rstrip("0").rstrip(".") if "." in text and "e" not in text else text


@dataclass(frozen=True, slots=True)
class Seen:
    """A numeral, and where it stands."""

    text: str
    line: int


@dataclass(frozen=True, slots=True)
class DecimalSign:
    """The decimal sign of a table, or why it has none that is certain."""

    sign: Sign | None
    """None where two are possible, or where both are there."""
    evidence: Seen | None
    """A numeral that has this sign; None where no numeral has any."""
    rival: Seen | None = None
    """One that may be two numbers, or has the other sign."""
    torn: bool = False
    """Whether numerals contradict each other."""


def tell_decimal(cells: Iterable[Seen]) -> DecimalSign:
    """The decimal sign of numerals that were written by one hand.

    One that can be read with only one sign decides for all; whole numbers without any sign say
    nothing, and need none.
    """
    only: dict[Sign, Seen] = {}
    open_cell: Seen | None = None
    for seen in cells:
        point, comma = parse_numeral(seen.text, "point"), parse_numeral(seen.text, "comma")
        if point is None and comma is not None:
            only.setdefault("comma", seen)
        elif comma is None and point is not None:
            only.setdefault("point", seen)
        elif point != comma and open_cell is None:
            open_cell = seen
    if len(only) == 2:
        return DecimalSign(None, only["comma"], only["point"], torn=True)
    for sign, seen in only.items():
        return DecimalSign(sign, seen)
    if open_cell is not None:
        return DecimalSign(None, None, open_cell)
    return DecimalSign("point", None)
