"""Numbers as people type them: with a decimal point or comma, and whichever minus they have."""

from __future__ import annotations

import re

from orthocal.errors import SessionError
from orthocal.io.strict_yaml import LONGEST_NUMBER
from orthocal.text import shorten
from orthocal.units import MM

MINUS = str.maketrans(dict.fromkeys("−–‐‑‒﹣－", "-"))
"""Signs that spreadsheets, telephones and typesetters write for a minus."""

_NUMBER = re.compile(r"([-+]?) ?([0-9]+[.,]?[0-9]*|[.,][0-9]+)")
_UNIT = re.compile(r"(.*?)\s*(mm|µm|μm|um|m|in|inch|\"|'')", re.I)
_THOUSANDS = re.compile(r"[1-9][0-9]{0,2},[0-9]{3}")


def read_typed(text: str) -> float:
    """A reading that was typed, [m].

    Args:
        text: In mm, such as 0.12, -0,35 or +1.2 mm.

    Raises:
        SessionError: If it is no number, or may be read in two ways.
    """
    shown = shorten(text.strip())
    plain = " ".join(text.translate(MINUS).split())
    unit = _UNIT.fullmatch(plain)
    if unit is not None:
        plain = unit[1]
        if unit[2].lower() != "mm":
            raise SessionError(f"'{shown}' is in {unit[2]}; readings are in mm")
    found = _NUMBER.fullmatch(plain) if len(plain) <= LONGEST_NUMBER else None
    if found is None:
        if re.fullmatch(r"[-+]? ?[0-9]+([.,' ][0-9]+){2,}|[-+]? ?[0-9]+[' ][0-9.,]+", plain):
            raise SessionError(
                f"'{shown}' has more than one separator; write a decimal point alone, such as 1.23"
            )
        raise SessionError(f"'{shown}' is neither a number nor a command; help lists those")
    sign, digits = found.groups()
    if _THOUSANDS.fullmatch(digits):
        one, other = digits.replace(",", "."), digits.replace(",", "")
        raise SessionError(
            f"'{shown}' may be {sign}{one} or {sign}{other}; write {sign}{one} with a point, or "
            f"{sign}{other} without a separator"
        )
    value = float(digits.replace(",", ".")) * MM
    return (-value if sign == "-" else value) + 0.0
