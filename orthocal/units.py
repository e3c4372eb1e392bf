"""Units at the edges, where people read and write numbers: inside all is in m, rad and 1.

A constant is one of its unit in SI: `0.5 * MM` is half a millimetre, `length / MM` a length in mm.
"""

from __future__ import annotations

import math
from typing import Literal

MM = 1e-3
UM = 1e-6
MRAD = 1e-3
DEG = math.pi / 180.0
PPM = 1e-6

Unit = Literal["m", "rad", "1"]
"""Unit of an error parameter or of a drive, SI."""

UNIT_SUFFIXES: dict[str, tuple[Unit, float]] = {
    "_mm": ("m", MM),
    "_um": ("m", UM),
    "_m": ("m", 1.0),
    "_mrad": ("rad", MRAD),
    "_deg": ("rad", DEG),
    "_rad": ("rad", 1.0),
    "_ppm": ("1", PPM),
}
"""Suffix of a name to unit and size of the unit that it names."""

EDGE_UNITS: dict[Unit, tuple[str, float]] = {
    "m": ("mm", MM),
    "rad": ("mrad", MRAD),
    "1": ("ppm", PPM),
}
"""Unit to the one in which people read errors, and its size."""

DRIVE_UNITS: dict[Unit, tuple[str, float]] = {"m": ("mm", MM), "rad": ("deg", DEG)}
"""Unit to the one in which people read coordinates of drives and joints, and its size."""


class InUnit:
    """Something with a `unit` that people read in another one."""

    __slots__ = ()
    unit: Unit

    @property
    def edge_unit(self) -> str:
        """Unit in which people read it: mm, mrad or ppm."""
        return EDGE_UNITS[self.unit][0]

    @property
    def edge_factor(self) -> float:
        """Factor from SI to the unit in which people read it."""
        return 1.0 / EDGE_UNITS[self.unit][1]


def to_mm(value: float) -> float:
    """Metres as mm, without the rounding that the factor brings."""
    return tidy(value / MM)


def tidy(value: float) -> float:
    """A number without what a factor has left in its last digits."""
    return float(f"{value:.12g}") + 0.0


def format_fixed(value: float, decimals: int, *, sign: bool = False) -> str:
    """Number with fixed decimals, and without a negative zero."""
    return f"{round(value, decimals) + 0.0:{'+' if sign else ''}.{decimals}f}"
