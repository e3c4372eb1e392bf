"""Numbers and names as the files of an export have them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

from orthocal.units import MM

LETTERS = "XYZABC"
"""LinuxCNC's coordinates, in its order."""

LONGEST_NAME = 60


def plain(text: str) -> str:
    """A text that may stand in comments of C and of an INI, and in Markdown, whoever wrote it."""
    return re.sub(r"[^A-Za-z0-9 _.,+-]", "_", text)[:LONGEST_NAME]


def as_millimetres(values: Iterable[float]) -> str:
    """Lengths with a comma between, mm."""
    return ", ".join(f"{round(float(v) / MM, 6) + 0.0:g}" for v in values)


def region_words(coordinates: Iterable[int], lower: Iterable[float], upper: Iterable[float]) -> str:
    """A region of [m] in mm: X -60 to 60, Y -60 to 60."""
    return ", ".join(
        f"{LETTERS[k]} {as_millimetres([low])} to {as_millimetres([high])}"
        for k, low, high in zip(coordinates, lower, upper, strict=True)
    )


def rounded_up(value: float, digits: int = 2) -> str:
    """A number with so many digits, never smaller than it is."""
    if not math.isfinite(value) or value <= 0.0:
        return f"{value:g}"
    decimals = digits - 1 - math.floor(math.log10(value))
    return f"{math.ceil(value * 10.0**decimals) / 10.0**decimals:.{digits}g}"
