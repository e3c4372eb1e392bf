"""What a calibration problem is made of: expressions of one posture and of one reading."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class SharedInputs:
    """What depends on θ̂ alone: evaluated once, and given to every piece."""

    symbols: tuple[ca.SX, ...]
    """Column vectors: θ̂, placements, their slopes, and per leg that is read the coordinate of its
    root in the zero posture with its slope."""
    function: ca.Function
    """θ̂ to the values of the symbols."""


@dataclass(frozen=True, slots=True, eq=False)
class PosturePiece:
    """The closures of one posture and their derivatives."""

    passive: ca.SX
    """q̂, shape (n_passive,)."""
    drives: ca.SX
    """Commanded drive coordinates, shape (n_drives,), [m, rad]."""
    closure: ca.SX
    """ĝ, shape (closure_rows,)."""
    by_passive: ca.SX
    """∂ĝ/∂q̂, shape (closure_rows, n_passive)."""
    by_theta: ca.SX
    """∂ĝ/∂θ̂, shape (closure_rows, n_free)."""


@dataclass(frozen=True, slots=True, eq=False)
class ReadingPiece:
    """One reading on one leg, in the few variables that it depends on."""

    leg: str
    entries: Indices
    """Entries of the observations that are on this leg, shape (n,)."""
    passive_index: Indices
    """Which passive coordinates it depends on."""
    theta_index: Indices
    """Which free parameters it depends on."""
    passive: ca.SX
    """Those q̂."""
    drives: ca.SX
    """Commanded drive coordinates of the posture, shape (n_drives,), [m, rad]."""
    setup: ca.SX
    """Constants of the setup, shape (5,): direction, plane, from_root."""
    reading: ca.SX
    """h, [m]."""
    by_passive: ca.SX
    """∂h/∂q̂ of those, shape (1, n), [m]."""
    by_theta: ca.SX
    """∂h/∂θ̂ of those, shape (1, n), [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class DirectExpressions:
    """Closures and readings as expressions of θ̂ itself, for second derivatives."""

    theta: ca.SX
    passive: ca.SX
    drives: ca.SX
    setup: ca.SX
    closure: ca.SX
    """ĝ, shape (closure_rows,)."""
    readings: Mapping[str, ca.SX]
    """Leg to h, [m]."""
