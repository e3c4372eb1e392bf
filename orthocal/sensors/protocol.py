"""Protocol of sensors: all that other modules know of a kind of sensor.

A reading is an expression of the poses of some frames, in the posture and (for frames that move
with drives alone) in the reference posture, of constants of the setup and of nuisance parameters.
The gauge zero of the setup is added, unless it is known to be 0. A reading of a pair of postures
depends on the poses in both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal, Protocol, Self

import casadi as ca
from pydantic import BaseModel, ConfigDict, Field

from orthocal.arrays import Array
from orthocal.effects.protocol import Condition
from orthocal.errors import SessionError
from orthocal.io.documents import Name
from orthocal.kinematics.symbolic import Pose
from orthocal.robot.model import Robot
from orthocal.units import Unit

GaugeZero = Literal["free", "known"]
"""Gauge zero of a setup: estimated from its readings, or known to be 0, so that its readings are
absolute."""

ToolPath = Callable[..., Array]
"""Corners of the path of the tool from one position to another, shape (3,), [m]: shape (n, 3), with
both ends. A third argument is given for a tool that moves in a plane: a unit vector square to it,
shape (3,)."""

DIMENSION_STEP = 1e-6
"""Increment of a dimension for its effect on readings, [m]."""

LARGEST_READING = 0.3
"""Largest reading of an indicator; no leg is as far from parallel, [m]."""


@dataclass(frozen=True, slots=True)
class NuisanceParameter:
    """Error of a sensor or its mounting that is estimated together with the machine."""

    name: str
    """Unique within its setup, or within the setups that share it."""
    unit: Unit
    prior_std: float
    """One standard deviation, [unit]; its mean is 0."""
    shared_by: str | None = None
    """Name of the object at one place that setups of a session share, such as a square block; None
    for a parameter of one setup."""
    of_gauge: bool = False
    """True if all setups with the same gauge share it."""
    nominal: float = 0.0
    """Quantity of which it is the error, for setups that share it, [unit]."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Arguments of a sensor's expression."""

    frames: Sequence[Pose]
    """Poses of its frames in the posture."""
    at_zero: Sequence[Pose]
    """Poses of its frames in the reference posture."""
    constants: ca.SX
    """Of its setup, shape (n_constants,)."""
    nuisance: ca.SX
    """Values of its nuisance parameters, shape (n_nuisance,), [unit]."""
    conditions: Mapping[str, ca.SX] = field(default_factory=dict)
    """Conditions of the reading that it names under `conditions`."""
    second: Sequence[Pose] = ()
    """Poses of its frames in the second posture of a reading of a pair."""


@dataclass(frozen=True, slots=True)
class Frames:
    """Names of the frames on which a reading depends."""

    in_posture: tuple[str, ...]
    at_zero: tuple[str, ...] = ()
    in_second: tuple[str, ...] = ()
    """Those in the second posture, for a sensor that reads pairs of postures."""


@dataclass(frozen=True, slots=True, eq=False)
class TouchingTip:
    """Tip for checks and drawings: a ball, or a blade or pin along an edge."""

    radius: float
    """Of the ball or the pin, [m]; 0 for a blade's edge."""
    edge: Array | None = None
    """Direction of the edge, a unit vector, shape (3,); None for a ball."""
    width: float = 0.0
    """Of the edge, [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """Points of contact of a sensor in K postures, for scenes and checks."""

    points: Array
    """In the world, shape (K, 3), [m]."""
    direction: Array
    """Of a growing reading, shape (3,)."""
    along: Array
    """Direction along the touched surface with free space beside the sensor, shape (3,)."""
    problems: Sequence[str]
    """Reason why it cannot touch, or an empty string; one for each posture."""
    key: str
    """Key of the setup that says where it touches, for messages."""
    tip: TouchingTip | None = None
    """The tip, if the setup states one."""
    at_tool: bool = False
    """True if the gauge moves with the tool: then it is behind its tip, against `direction`."""
    fixed: Array | None = None
    """Fixed end of a bar whose other end is the contact, in the world, shape (3,), [m]."""
    surface: Array | None = None
    """Corners of the touched surface of an artefact, in the world, shape (4, 3), [m]."""


class SetupKeys(BaseModel):
    """Keys of a setup in a session.yaml that all kinds of sensor share."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    sensor: str = "leg"
    """The kind of sensor."""
    gauge: Name | None = None
    """Name of the gauge; needed if the session has several."""
    postures: Annotated[list[Name], Field(min_length=1)] | None = None
    """Postures to read, in a plan; all by default."""
    aligned_at: Name | None = None
    """Posture in which the operator aligned the gauge; by default the mechanical zero if the setup
    reads it, otherwise the posture nearest to it."""
    zero: GaugeZero | None = None
    """Gauge zero: estimated, or known to be 0; that of the sensor by default."""


class Sensor(Protocol):
    """A sensor as one setup describes it."""

    kind: ClassVar[str]
    """Name of the kind. Sensors of one kind with the same frames share one expression."""
    keys: ClassVar[type[SetupKeys]]
    """Schema of its setups in a session.yaml."""
    ideal: ClassVar[str]
    """State of the place without deviations, such as parallel."""

    # conditions: ClassVar[tuple[Condition, ...]], optional: conditions of a reading on which its
    # expression depends (`sensor_conditions`)

    # path: ToolPath, optional: path of the tool between two of its readings; straight by default
    # (`tool_path`)

    # mounting_steps: tuple[str, ...], optional: steps that mount it in the alignment posture, for
    # the operator (`mounting_steps`)

    # states_readings: ClassVar[bool], optional: whether readings are stated, not shown, so that
    # equal ones are no sign of a dial that sticks (`states_readings`)

    # reads_pairs: ClassVar[bool], optional: whether a reading belongs to a pair of postures, that
    # of its row and that in the column `minus`; it is no difference of two readings (`reads_pairs`)

    # zero: ClassVar[GaugeZero], optional: gauge zero of its setups unless they state another one;
    # "free" by default (`default_zero`)

    # largest_reading: ClassVar[float], optional: largest reading that it shows, [m]; 300 mm by
    # default (`largest_reading`)

    # dimensions: Mapping[str, Sensor], optional: key of a stated dimension in session.yaml, to the
    # same sensor with a dimension that is larger by DIMENSION_STEP (`stated_dimensions`)

    @classmethod
    def from_keys(cls, keys: Any) -> Self:  # noqa: ANN401 - an instance of `keys`
        """Build the sensor from the keys of a session.yaml."""

    def to_keys(self) -> dict[str, Any]:
        """Keys for a session.yaml, without those that all setups share."""

    def require_fit(self, robot: Robot, *, where: str) -> None:
        """Refuse legs, frames and places that the robot does not have.

        Raises:
            SessionError: Naming the key; `where` is the setup's file and key.
        """

    @property
    def place(self) -> tuple[str, str]:
        """Part of the machine that it measures, as kind and name, such as leg and x."""

    def describe(self) -> str:
        """Short description for tables."""

    def frames(self, robot: Robot) -> Frames:
        """Frames on which a reading depends."""

    def constants(self, robot: Robot) -> Array:
        """Constants of its expression, shape (n_constants,), [SI]."""

    @property
    def nuisance_parameters(self) -> tuple[NuisanceParameter, ...]:
        """Nuisance parameters of its mounting and scale, besides the zero of its setup."""

    def aligned_to(self, robot: Robot) -> Mapping[str, Sensor]:
        """Nuisance parameters that the operator aligns by eye, mapped to the virtual sensor.

        The parameter is measured from the actual position of the rod in the alignment posture. The
        virtual sensor gives this position, relative to the nominal machine.
        """

    def expression(self, view: View, robot: Robot) -> ca.SX:
        """Reading with the gauge zero at 0, [m]."""

    def contact(self, frames: Sequence[Array], at_zero: Sequence[Array], robot: Robot) -> Contact:
        """Contact with the machine in K postures.

        Args:
            frames: Poses of its frames in K postures, shape (K, 4, 4) each.
            at_zero: Poses of its frames in the reference posture, shape (4, 4) each.
            robot: The robot.
        """


class ToolSensor:
    """Base of the sensors that measure the tool: of no leg, and with nothing aligned by eye."""

    __slots__ = ()

    noun: ClassVar[str]
    """The sensor in messages, with its article."""

    def require_fit(self, robot: Robot, *, where: str) -> None:
        """Refuse a robot without a tool.

        Raises:
            SessionError: Naming the key; `where` is the setup's file and key.
        """
        if robot.tcp is None:
            raise SessionError(
                f"'{robot.name}' has no tool for {self.noun}; add orthocal.tcp to {robot.yaml}",
                where=f"{where}.sensor",
            )

    @property
    def place(self) -> tuple[str, str]:
        """The tool."""
        return "tool", ""

    def aligned_to(self, robot: Robot) -> Mapping[str, Sensor]:
        """No parameter depends on the machine."""
        del robot
        return {}


def sensor_conditions(sensor: Sensor) -> tuple[Condition, ...]:
    """Conditions of a reading on which a sensor's expression depends."""
    conditions: tuple[Condition, ...] = getattr(sensor, "conditions", ())
    return conditions


def tool_path(sensor: Sensor) -> ToolPath | None:
    """Path of the tool that a sensor prescribes; None for a straight one."""
    path: ToolPath | None = getattr(sensor, "path", None)
    return path


def mounting_steps(sensor: Sensor) -> tuple[str, ...] | None:
    """Steps that mount it in the alignment posture; None for an indicator on the base."""
    steps: tuple[str, ...] | None = getattr(sensor, "mounting_steps", None)
    return steps


def largest_reading(sensor: Sensor) -> float:
    """Largest reading that a sensor shows; a larger one has a wrong unit, [m]."""
    largest: float = getattr(sensor, "largest_reading", LARGEST_READING)
    return largest


def stated_dimensions(sensor: Sensor) -> Mapping[str, Sensor]:
    """Keys of the dimensions that a setup states, to the sensor with a larger one."""
    dimensions: Mapping[str, Sensor] = getattr(sensor, "dimensions", {})
    return dimensions


def default_zero(sensor: Sensor) -> GaugeZero:
    """Gauge zero of a sensor's setups that state none."""
    zero: GaugeZero = getattr(sensor, "zero", "free")
    return zero


def reads_pairs(sensor: Sensor) -> bool:
    """True if a reading belongs to a pair of postures; such a row is a single reading."""
    pairs: bool = getattr(sensor, "reads_pairs", False)
    return pairs


def is_difference(minus: str | None, sensor: Sensor) -> bool:
    """True for a row that is the difference of readings in two postures.

    Args:
        minus: Second posture of the row.
        sensor: Sensor of its setup.
    """
    return minus is not None and not reads_pairs(sensor)


def states_readings(sensor: Sensor) -> bool:
    """True if readings are stated, not shown, so that equal ones say nothing."""
    stated: bool = getattr(sensor, "states_readings", False)
    return stated
