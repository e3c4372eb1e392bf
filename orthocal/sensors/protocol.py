"""What every sensor says of itself, and nothing else is known of any.

A sensor looks at frames of the machine, in the posture and (where they move with drives alone) in
the zero posture, and shows a number: an expression of their poses, of constants of its setup and of
unknowns of its own, plus the zero of its setup, which is free and comes on top.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocal.kinematics.symbolic import Pose
from orthocal.robot.model import Robot
from orthocal.robot.parameters import Unit

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Unknown:
    """Something of a sensor that is not known exactly, and is identified with the machine."""

    name: str
    """Within its setup; with `shared_by`, within those who share it."""
    unit: Unit
    tolerance: float
    """One standard deviation, [unit]; its mean is 0."""
    shared_by: str | None = None
    """Name of what all setups share that have the same of it, such as a dial; None for its own."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What a sensor sees of a machine, as expressions."""

    frames: Sequence[Pose]
    """Frames that it looks at, in the posture."""
    at_zero: Sequence[Pose]
    """Frames that it looks at in the zero posture."""
    constants: ca.SX
    """Of its setup, shape (n_constants,)."""
    unknowns: ca.SX
    """Its own, shape (n_unknowns,), [unit]."""


@dataclass(frozen=True, slots=True)
class Frames:
    """Names of the frames that a sensor looks at."""

    in_posture: tuple[str, ...]
    at_zero: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """Where and how a sensor touches, for scenes and checks."""

    point: Array
    """In the world, shape (3,), [m]."""
    direction: Array
    """Of a growing reading, shape (3,)."""
    along: float
    """Where on what it touches: 0 where that begins, 1 where it ends."""


class Sensor(Protocol):
    """One standing of a sensor: all that a setup says of it."""

    @property
    def kind(self) -> str:
        """Name of this kind of sensor: those of a kind and the same frames share one expression."""

    def frames(self, robot: Robot) -> Frames:
        """What it looks at."""

    def constants(self, robot: Robot) -> Array:
        """Constants of its expression, shape (n_constants,), [SI]."""

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """What of it is not known exactly, besides the zero of its setup."""

    def expression(self, view: View, robot: Robot) -> ca.SX:
        """What it shows, its zero at 0, [m]."""

    def describe(self) -> str:
        """What it reads, in a few words: for tables."""
