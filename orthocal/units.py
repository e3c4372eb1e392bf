"""Numbers at the edges, where people read and write them."""

from __future__ import annotations


def to_mm(value: float) -> float:
    """Metres as mm, without the rounding that the factor brings."""
    return tidy(value * 1e3)


def tidy(value: float) -> float:
    """A number without what a factor has left in its last digits."""
    return float(f"{value:.12g}")
