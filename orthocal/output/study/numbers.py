"""Numbers of studies."""

from __future__ import annotations

import math

from orthocal.output.text.layout import plain
from orthocal.units import UM

MOST_ROWS = 12
"""Of a table of parameters, unless all are asked for."""


def um_of(value: float) -> str:
    """A length in µm; nothing for NaN."""
    size = value / UM
    if not math.isfinite(size):
        return ""
    return plain(size, 0 if abs(size) >= 100.0 else 1)


def sized(value: float) -> str:
    """A number with three digits that count, and not finer than a millionth."""
    if not math.isfinite(value):
        return ""
    if abs(value) < 5e-7:
        return "0"
    return f"{value:.3g}" if abs(value) >= 1e-4 else f"{value:.6f}"
