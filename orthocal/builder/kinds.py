"""Kinds of machines that `orthocal new` makes."""

from __future__ import annotations

from orthocal.builder.biglide import Biglide
from orthocal.builder.dimensions import Dimensions
from orthocal.builder.linear_delta import LinearDelta
from orthocal.builder.orthoglide import InclinedOrthoglide, Orthoglide

KINDS: dict[str, type[Dimensions]] = {
    k.kind: k for k in (Orthoglide, InclinedOrthoglide, LinearDelta, Biglide)
}
"""Name in machine.yaml and on the command line to dimensions."""

USUAL = Orthoglide.kind
"""Kind where none is stated."""


def describe_kinds() -> str:
    """Kinds in words."""
    return ", ".join(KINDS)
