"""Kinds of machines of `orthocal new`."""

from __future__ import annotations

from orthocal.builder.biglide import Biglide
from orthocal.builder.dimensions import Dimensions
from orthocal.builder.linear_delta import LinearDelta
from orthocal.builder.orthoglide import InclinedOrthoglide, Orthoglide

KINDS: dict[str, type[Dimensions]] = {
    k.kind: k for k in (Orthoglide, InclinedOrthoglide, LinearDelta, Biglide)
}
"""Name in machine.yaml and on the command line, to the class of dimensions."""

USUAL = Orthoglide.kind
"""Default kind."""
