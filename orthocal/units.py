"""Conversion between SI, which is used inside, and the units that users read and write.

Each constant is its unit in SI: `0.5 * MM` is half a millimetre, `length / MM` a length in mm.
"""

from __future__ import annotations

import math
from typing import Literal

MM = 1e-3
INCH = 25.4 * MM
UM = 1e-6
MRAD = 1e-3
DEG = math.pi / 180.0
PPM = 1e-6

Unit = Literal["m", "rad", "1", "1/K", "m/s"]
"""SI unit of an error parameter or of a drive."""

UNIT_SUFFIXES: dict[str, tuple[Unit, float]] = {
    "_mm": ("m", MM),
    "_um": ("m", UM),
    "_m": ("m", 1.0),
    "_mrad": ("rad", MRAD),
    "_deg": ("rad", DEG),
    "_rad": ("rad", 1.0),
    "_ppm": ("1", PPM),
    "_ppm_per_K": ("1/K", PPM),
    "_um_per_min": ("m/s", UM / 60.0),
}
"""Suffix of a key to the SI unit and the size of the unit that the suffix names."""

EDGE_UNITS: dict[Unit, tuple[str, float]] = {
    "m": ("mm", MM),
    "rad": ("mrad", MRAD),
    "1": ("ppm", PPM),
    "1/K": ("ppm_per_K", PPM),
    "m/s": ("um_per_min", UM / 60.0),
}
"""SI unit to the unit in which users read errors, and its size."""

LIMIT = 2.0
"""Prior standard deviations in a tolerance that users state or read."""

DRIVE_UNITS: dict[Unit, tuple[str, float]] = {"m": ("mm", MM), "rad": ("deg", DEG)}
"""SI unit to the unit in which users read drive and joint coordinates, and its size."""


class InUnit:
    """Mixin for objects with an SI `unit` that users read in another unit."""

    __slots__ = ()
    unit: Unit

    @property
    def edge_unit(self) -> str:
        """Unit that users read: mm, mrad, ppm, ppm_per_K or um_per_min."""
        return EDGE_UNITS[self.unit][0]

    @property
    def unit_in_text(self) -> str:
        """Unit as sentences write it."""
        return unit_in_text(self.unit)

    @property
    def edge_factor(self) -> float:
        """Factor from SI to the unit that users read."""
        return 1.0 / EDGE_UNITS[self.unit][1]


def unit_in_text(unit: Unit) -> str:
    """Unit that users read, as sentences write it: mm, mrad, ppm, ppm/K or µm/min."""
    return EDGE_UNITS[unit][0].replace("um_", "µm_").replace("_per_", "/")


def read_limit(value: float) -> float:
    """Prior standard deviation of a stated tolerance, a limit of ±2 prior standard deviations."""
    return value / LIMIT


def show_limit(std: float) -> float:
    """Tolerance that states a prior standard deviation; inverse of `read_limit`."""
    return std * LIMIT


def read_tolerance(value: float, unit: float = 1.0) -> float:
    """Prior standard deviation, [SI], of a tolerance that a file states.

    Args:
        value: The tolerance.
        unit: Its unit in SI.
    """
    return tidy(read_limit(value) * unit)


def show_tolerance(std: float, unit: float = 1.0) -> float:
    """Tolerance in a unit for a file; inverse of `read_tolerance`."""
    return tidy(show_limit(std) / unit)


def to_mm(value: float) -> float:
    """A length in mm, rounded to 12 significant digits."""
    return tidy(value / MM)


def show_mm(value: float) -> str:
    """A length in mm to 1 µm, without trailing zeros."""
    return f"{round(value / MM, 3) + 0.0:.12g}"


def tidy(value: float) -> float:
    """A number rounded to 12 significant digits, without the rounding error of a conversion."""
    return float(f"{value:.12g}") + 0.0


def trim_zeros(number: str) -> str:
    """A decimal number without trailing zeros beyond the second decimal."""
    integer, _, decimals = number.partition(".")
    return f"{integer}.{decimals.rstrip('0').ljust(2, '0')}"


def format_fixed(value: float, decimals: int = 3, *, sign: bool = False) -> str:
    """Number with fixed decimals, and without a negative zero."""
    return f"{round(value, decimals) + 0.0:{'+' if sign else ''}.{decimals}f}"
