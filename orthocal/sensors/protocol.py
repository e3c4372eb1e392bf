"""What every kind of sensor says of itself, and nothing else is known of any.

A sensor looks at frames of the machine, in the posture and (where they move with drives alone) in
the zero posture, and shows a number: an expression of their poses, of constants of its setup and of
unknowns of its own. The zero of its setup comes on top, unless it is known to be 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal, Protocol, Self

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from orthocal.effects.protocol import Condition
from orthocal.io.documents import Name
from orthocal.kinematics.symbolic import Pose
from orthocal.robot.model import Robot
from orthocal.units import Unit

Array = NDArray[np.float64]


GaugeZero = Literal["free", "known"]
"""Gauge zero of a setup: estimated from its readings, or known to be 0, so that its readings are
absolute."""


@dataclass(frozen=True, slots=True)
class Unknown:
    """Something of a sensor that is not known exactly, and is identified with the machine."""

    name: str
    """Within its setup; with `shared_by`, within those who share it."""
    unit: Unit
    tolerance: float
    """One standard deviation, [unit]; its mean is 0."""
    shared_by: str | None = None
    """Name of what setups of a session share that have the same of it, at one place, such as a
    block they stand on; None for its own."""
    of_gauge: bool = False
    """Whether all setups share it whose readings are shown by the same gauge."""


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
    conditions: Mapping[str, ca.SX] = field(default_factory=dict)
    """Conditions of the reading that it names under `conditions`."""


@dataclass(frozen=True, slots=True)
class Frames:
    """Names of the frames that a sensor looks at."""

    in_posture: tuple[str, ...]
    at_zero: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class TouchingTip:
    """What touches, as it is: a ball, or a blade or pin along an edge."""

    radius: float
    """Of the ball or the pin, [m]; 0 for a blade's edge."""
    edge: Array | None = None
    """Way of the edge, a unit vector, shape (3,); None for a ball."""
    width: float = 0.0
    """Of the edge, [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """Where and how a sensor touches, in K postures: for scenes and checks."""

    points: Array
    """In the world, shape (K, 3), [m]."""
    direction: Array
    """Of a growing reading, shape (3,)."""
    along: Array
    """Way on what it touches on which there is room beside it, shape (3,)."""
    problems: Sequence[str]
    """Why it cannot touch there, in words; empty where it can. K of them."""
    key: str
    """Key of the setup that says where it touches, for messages."""
    tip: TouchingTip | None = None
    """What touches there, where that is said."""


class SetupKeys(BaseModel):
    """What a session.yaml may say of a setup, whatever stands there."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    sensor: str = "leg"
    """The kind of sensor."""
    gauge: Name | None = None
    """Which of the session's gauges; needed where there are several."""
    postures: Annotated[list[Name], Field(min_length=1)] | None = None
    """In a plan: the postures it is to be read in; all by default."""
    aligned_at: Name | None = None
    """Posture in which the operator aligned the gauge; by default the mechanical zero if the setup
    reads it, otherwise the posture nearest to it."""
    zero: GaugeZero | None = None
    """Whether the gauge zero is estimated or known to be 0; that of the sensor by default."""


class Sensor(Protocol):
    """One standing of a sensor: all that a setup says of it."""

    kind: ClassVar[str]
    """Name of this kind of sensor: those of a kind and the same frames share one expression."""
    keys: ClassVar[type[SetupKeys]]
    """What a session.yaml says of a setup with it."""
    ideal: ClassVar[str]
    """What the place would be if there were no deviation, such as parallel."""

    # conditions: ClassVar[tuple[Condition, ...]], optional: conditions of a reading on which its
    # expression depends (`sensor_conditions`)

    # zero: ClassVar[GaugeZero], optional: gauge zero of its setups unless they state another one;
    # "free" by default (`default_zero`)

    @classmethod
    def from_keys(cls, keys: Any) -> Self:  # noqa: ANN401 - an instance of `keys`
        """As a session.yaml describes it."""

    def to_keys(self) -> dict[str, Any]:
        """As a session.yaml describes it, without what every setup may say."""

    def require_fit(self, robot: Robot, *, where: str) -> None:
        """Refuse what the robot does not have.

        Raises:
            SessionError: Naming the key; `where` is the setup's file and key.
        """

    @property
    def place(self) -> tuple[str, str]:
        """What of the machine it stands at, as kind and name, such as leg and x."""

    def describe(self) -> str:
        """What it reads, in a few words: for tables."""

    def frames(self, robot: Robot) -> Frames:
        """What it looks at."""

    def constants(self, robot: Robot) -> Array:
        """Constants of its expression, shape (n_constants,), [SI]."""

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """What of it is not known exactly, besides the zero of its setup."""

    def set_by(self, robot: Robot) -> Mapping[str, Sensor]:
        """Unknowns that a hand sets by what it sees, by their names: what it sees.

        Such an unknown counts from what that other sensor would show in the alignment posture of
        the setup, less what it would show on the nominal machine.
        """

    def expression(self, view: View, robot: Robot) -> ca.SX:
        """What it shows, its zero at 0, [m]."""

    def contact(self, frames: Sequence[Array], at_zero: Sequence[Array], robot: Robot) -> Contact:
        """Where it touches.

        Args:
            frames: Poses of its frames in K postures, shape (K, 4, 4) each.
            at_zero: Poses of its frames in the zero posture, shape (4, 4) each.
            robot: The robot.
        """


def sensor_conditions(sensor: Sensor) -> tuple[Condition, ...]:
    """Conditions of a reading on which a sensor's expression depends."""
    conditions: tuple[Condition, ...] = getattr(sensor, "conditions", ())
    return conditions


def default_zero(sensor: Sensor) -> GaugeZero:
    """Gauge zero of a sensor's setups that state none."""
    zero: GaugeZero = getattr(sensor, "zero", "free")
    return zero
