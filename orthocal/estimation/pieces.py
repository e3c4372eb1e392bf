"""What a calibration problem is made of: expressions of one posture and of one reading."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


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
    """One reading of a kind of sensor, in the few variables that it depends on."""

    group: int
    """Index of the sensor group."""
    entries: Indices
    """Entries of the observations that are of it, shape (n,)."""
    table: Array
    """Constants of their setups, shape (n, n_constants)."""
    setups: Indices
    """Their setups, shape (n,)."""
    unknown_index: Indices
    """Which free parameters their sensors' unknowns are, shape (n, n_unknowns)."""
    unknowns: ca.SX
    """Those, shape (n_unknowns,), [SI]."""
    by_unknowns: ca.SX
    """∂h by them, shape (1, n_unknowns)."""
    passive_index: Indices
    """Which passive coordinates it depends on."""
    theta_index: Indices
    """Which free parameters it depends on."""
    passive: ca.SX
    """Those q̂."""
    drives: ca.SX
    """Commanded drive coordinates of the posture, shape (n_drives,), [m, rad]."""
    zero: ca.SX
    """Those of the zero posture, shape (n_drives,), [m, rad]."""
    constants: ca.SX
    """Constants of the setup, shape (n_constants,)."""
    reading: ca.SX
    """h, [m]."""
    by_passive: ca.SX
    """∂h/∂q̂ of those, shape (1, n), [m]."""
    by_theta: ca.SX
    """∂h/∂θ̂ of those, shape (1, n), [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class DirectExpressions:
    """Closures and readings as expressions of the machine's θ̂ itself, for second derivatives."""

    theta: ca.SX
    passive: ca.SX
    drives: ca.SX
    zero: ca.SX
    """Commanded drive coordinates of the zero posture, shape (n_drives,), [m, rad]."""
    closure: ca.SX
    """ĝ, shape (closure_rows,)."""
    constants: tuple[ca.SX, ...]
    """Constants of a setup, by sensor group."""
    unknowns: tuple[ca.SX, ...]
    """What is not known of a sensor, by sensor group, [SI]."""
    readings: tuple[ca.SX, ...]
    """h by sensor group, [m]."""
