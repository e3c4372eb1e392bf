"""Protocol of sensors: the interface between a kind of sensor and other modules.

A reading is an expression of poses of frames, constants of the setup and nuisance parameters. Poses
are those in the posture and, for frames that drives alone move, in the reference posture. The gauge
zero of the setup is added, unless it is known to be 0. A reading of a pair of postures depends on
the poses in both postures.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, ClassVar, Literal, Protocol, Self, TypeVar

import casadi as ca
import numpy as np
from pydantic import Field

from orthocal.arguments import require_names
from orthocal.arrays import Array, Triple
from orthocal.effects.protocol import Condition
from orthocal.errors import SessionError
from orthocal.io.documents import Keys, Name
from orthocal.kinematics.symbolic import Pose
from orthocal.robot.model import Robot, require_tcp
from orthocal.robot.parameters import require_prior
from orthocal.units import InUnit, Unit

Value = TypeVar("Value")

GaugeZero = Literal["free", "known"]
"""Gauge zero of a setup: estimated from its readings, or known to be 0. With a known gauge zero the
readings are absolute."""

ToolPath = Callable[..., Array]
"""Function from two tool positions, shape (3,), [m], to the corners of the path between them, with
both ends, shape (n, 3), [m]. For a tool that moves in a plane it has a third argument: the unit
normal of the plane, shape (3,). On a machine with a bed it has a keyword `above`: True for a path
that is nowhere lower than its lower end."""

DIMENSION_STEP = 1e-6
"""Increment of a dimension for the derivative of readings with respect to it, [m]."""

PROBING_DISTANCE = 10e-3
"""Distance from a posture at which a probe begins to move towards the surface, [m]; larger than
usual errors of a machine before the calibration."""

LARGEST_READING = 0.3
"""Largest reading of an indicator, [m]; no leg is as far from parallel."""


@dataclass(frozen=True, slots=True)
class NuisanceParameter(InUnit):
    """Error of a sensor or its mounting that is estimated together with the machine.

    Raises:
        ValueError: If the unit is unknown, or the standard deviation no number of at least 0.
    """

    name: str
    """Name that is unique within its setup, or within the setups that share the parameter."""
    unit: Unit
    """SI unit."""
    prior_std: float
    """Prior standard deviation, [unit]; the prior mean is 0."""
    shared_by: str | None = None
    """Name of the object that setups share at one place, such as a square block; None for a
    parameter of one setup."""
    of_gauge: bool = False
    """True if all setups with the same gauge share the parameter."""
    fixed: bool = False
    """True for a part of the machine, such as its bed: all logs of a printer share the parameter.
    """
    nominal: float = 0.0
    """Nominal value of the quantity, [unit]; setups that share the parameter must agree in it."""

    def __post_init__(self) -> None:
        require_prior(self.name, self.unit, self.prior_std)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Arguments of a sensor's expression."""

    frames: Sequence[Pose]
    """Poses of the sensor's frames in the posture."""
    at_zero: Sequence[Pose]
    """Poses of the sensor's frames in the reference posture."""
    constants: ca.SX
    """Constants of the setup, shape (n_constants,), [SI]."""
    nuisance: ca.SX
    """Values of the nuisance parameters, shape (n_nuisance,), [unit]."""
    conditions: Mapping[str, ca.SX] = field(default_factory=dict)
    """Values of the conditions that the sensor lists under `conditions`."""
    second: Sequence[Pose] = ()
    """Poses of the sensor's frames in the second posture of a pair."""


@dataclass(frozen=True, slots=True)
class Frames:
    """Names of the frames on which a reading depends.

    Raises:
        TypeError: If a field is not a list of names.
    """

    in_posture: tuple[str, ...]
    """Frames in the posture."""
    at_zero: tuple[str, ...] = ()
    """Frames in the reference posture."""
    in_second: tuple[str, ...] = ()
    """Frames in the second posture, for a sensor that reads pairs of postures."""

    def __post_init__(self) -> None:
        for field_ in fields(self):
            require_names(getattr(self, field_.name), argument=f"Frames.{field_.name}")


@dataclass(frozen=True, slots=True, eq=False)
class TouchingTip:
    """Tip for checks and drawings: a ball, or a blade or pin along an edge."""

    radius: float
    """Radius of the ball or the pin, [m]; 0 for a blade's edge."""
    edge: Array | None = None
    """Unit vector of the edge, shape (3,); None for a ball."""
    width: float = 0.0
    """Width of the edge, [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """Points of contact of a sensor in K postures, for scenes and checks."""

    points: Array
    """Points in the world frame, shape (K, 3), [m]."""
    direction: Array
    """Unit vector of a growing reading, shape (3,)."""
    along: Array
    """Unit vector along the touched surface, with free space beside the sensor, shape (3,)."""
    problems: Sequence[str]
    """Reason why the sensor cannot touch, or an empty string, for each posture."""
    key: str
    """Key of the setup that states the place of contact, for messages."""
    tip: TouchingTip | None = None
    """Tip, if the setup states one."""
    at_tool: bool = False
    """True if the gauge moves with the tool; then it is behind its tip, against `direction`."""
    fixed: Array | None = None
    """Fixed end of a bar whose other end is the contact, in the world frame, shape (3,), [m]."""
    surface: Array | None = None
    """Corners of the touched surface of an artefact in the world frame, shape (4, 3), [m]."""


class SetupKeys(Keys):
    """Keys of a setup in a session.yaml that all kinds of sensor share."""

    sensor: str = "leg"
    """Kind of sensor."""
    gauge: Name | None = None
    """Name of the gauge; required if the session has several."""
    postures: Annotated[list[Name], Field(min_length=1)] | None = None
    """Postures to read in a plan; all by default."""
    aligned_at: Name | None = None
    """Posture in which the operator aligned the gauge. By default it is the mechanical zero if the
    setup reads it, otherwise the posture nearest to it."""
    zero: GaugeZero | None = None
    """Gauge zero: estimated, or known to be 0; by default the one of the kind of sensor."""


class Sensor(Protocol):
    """Sensor of one setup."""

    kind: ClassVar[str]
    """Name of the kind. Sensors of one kind with the same frames share one expression."""
    keys: ClassVar[type[SetupKeys]]
    """Schema of the sensor's setups in a session.yaml."""
    ideal: ClassVar[str]
    """State of the measured place without deviations, such as parallel."""

    # conditions: ClassVar[tuple[Condition, ...]], optional: conditions of a reading on which the
    # expression depends (`sensor_conditions`)

    # path: ToolPath, optional: path of the tool between two readings; straight by default
    # (`tool_path`)

    # probing: Triple, optional: direction, a unit vector, in which the tool moves in each posture
    # until the sensor triggers (`probing_direction`)

    # mounting_steps: tuple[str, ...], optional: instructions for mounting the sensor in the
    # alignment posture (`mounting_steps`)

    # states_readings: ClassVar[bool], optional: whether readings are prescribed, such as the height
    # of a bed, and the postures measured (`states_readings`)

    # equal_readings: ClassVar[bool], optional: whether different postures usually have equal
    # readings, such as equal lengths of a print; by default if readings are prescribed. Then equal
    # readings do not indicate a sticking dial (`equal_readings`)

    # instrument: ClassVar[str], optional: noun for what shows a reading; dial by default
    # (`instrument`)

    # reads_pairs: ClassVar[bool], optional: whether a reading belongs to a pair of postures: the
    # posture of its row and the one in the column `minus`. It is a single reading (`reads_pairs`)

    # zero: ClassVar[GaugeZero], optional: gauge zero of setups that state none; "free" by default
    # (`default_zero`)

    # largest_reading: ClassVar[float], optional: largest reading, [m]; 300 mm by default
    # (`largest_reading`)

    # mirrored: ClassVar[tuple[str, ...]], optional: nuisance parameters that form a vector, such as
    # the position of a fixed ball, and that some postures determine only up to a sign. Solvers
    # start from both sides of a direction that changes readings only to second order
    # (`mirrored_parameters`)

    # dimensions: Mapping[str, Sensor], optional: sensors with one dimension that is larger by
    # DIMENSION_STEP, by the key of this dimension in a session.yaml (`stated_dimensions`)

    @classmethod
    def from_keys(cls, keys: Any) -> Self:  # noqa: ANN401 - an instance of `keys`
        """Build the sensor from the keys of a session.yaml."""

    def to_keys(self) -> dict[str, Any]:
        """Keys for a session.yaml, without those that all kinds of sensor share."""

    def require_fit(self, robot: Robot, *, where: str) -> None:
        """Refuse legs, frames and places that the robot does not have.

        Args:
            robot: The robot.
            where: File and key of the setup, for messages.

        Raises:
            SessionError: If the sensor does not fit the robot; names the key.
        """

    @property
    def place(self) -> tuple[str, str]:
        """Kind and name of the measured part of the machine, such as leg and x."""

    def describe(self) -> str:
        """Short description for tables."""

    def frames(self, robot: Robot) -> Frames:
        """Frames on which a reading depends."""

    def constants(self, robot: Robot) -> Array:
        """Constants of the expression, shape (n_constants,), [SI]."""

    @property
    def nuisance_parameters(self) -> tuple[NuisanceParameter, ...]:
        """Nuisance parameters of mounting and scale, without the gauge zero of the setup."""

    def aligned_to(self, robot: Robot) -> Mapping[str, Sensor]:
        """Nuisance parameters that the operator aligns by eye, mapped to the virtual sensor.

        Such a parameter refers to the actual position of the rod in the alignment posture. The
        virtual sensor reads this position, relative to the nominal machine.
        """

    def expression(self, view: View, robot: Robot) -> ca.SX:
        """Reading with the gauge zero at 0, [m]."""

    def contact(self, frames: Sequence[Array], at_zero: Sequence[Array], robot: Robot) -> Contact:
        """Contact with the machine in K postures.

        Args:
            frames: Poses of the sensor's frames in K postures, shape (K, 4, 4) each.
            at_zero: Poses of the sensor's frames in the reference posture, shape (4, 4) each.
            robot: The robot.
        """


class ToolSensor:
    """Base of sensors that measure the tool, without parameters that are aligned by eye."""

    __slots__ = ()

    noun: ClassVar[str]
    """Noun for the sensor in messages, with its article."""

    def require_fit(self, robot: Robot, *, where: str) -> None:
        """Refuse a robot without a tool.

        Raises:
            SessionError: If the robot has no tool; names the key.
        """
        if robot.tcp is None:
            raise SessionError(
                f"'{robot.name}' has no tool for {self.noun}; add orthocal.tcp to {robot.yaml}",
                where=f"{where}.sensor",
            )

    @property
    def place(self) -> tuple[str, str]:
        """Kind of the measured part: the tool, without a name."""
        return "tool", ""

    def aligned_to(self, robot: Robot) -> Mapping[str, Sensor]:
        """Empty mapping: no parameter is aligned by eye."""
        del robot
        return {}

    def frames(self, robot: Robot) -> Frames:
        """Frame of the tool."""
        return Frames((require_tcp(robot).frame,))


def place_point(poses: Array, point: Sequence[float] | Array) -> Array:
    """Positions of a point that is fixed in a frame, shape (K, 3), [m].

    Args:
        poses: Poses of the frame, shape (K, 4, 4).
        point: Coordinates in the frame, shape (3,), [m].
    """
    return np.asarray(poses[:, :3, 3] + poses[:, :3, :3] @ np.array(point))


def _optional(sensor: Sensor, name: str, default: Value) -> Value:
    """Attribute of a sensor, or the default if it has none."""
    value: Value = getattr(sensor, name, default)
    return value


def sensor_conditions(sensor: Sensor) -> tuple[Condition, ...]:
    """Conditions of a reading on which a sensor's expression depends."""
    return _optional(sensor, "conditions", ())


def tool_path(sensor: Sensor) -> ToolPath | None:
    """Function of the path that a sensor prescribes for the tool; None for a straight one."""
    return _optional(sensor, "path", None)


def probing_direction(sensor: Sensor) -> Triple | None:
    """Direction in which the tool moves until a sensor triggers; None for other sensors."""
    return _optional(sensor, "probing", None)


def mounting_steps(sensor: Sensor) -> tuple[str, ...] | None:
    """Instructions for mounting a sensor in the alignment posture.

    None for an indicator on the base, whose instructions the sheet contains.
    """
    return _optional(sensor, "mounting_steps", None)


def largest_reading(sensor: Sensor) -> float:
    """Largest reading of a sensor, [m]; a larger one has a wrong unit."""
    return _optional(sensor, "largest_reading", LARGEST_READING)


def stated_dimensions(sensor: Sensor) -> Mapping[str, Sensor]:
    """Sensors with one dimension larger by DIMENSION_STEP, by the key of the dimension."""
    return _optional(sensor, "dimensions", {})


def mirrored_parameters(sensor: Sensor) -> tuple[NuisanceParameter, ...]:
    """Nuisance parameters that form a vector and that readings may determine only up to a sign."""
    names: tuple[str, ...] = _optional(sensor, "mirrored", ())
    return tuple(p for p in sensor.nuisance_parameters if p.name in names) if names else ()


def default_zero(sensor: Sensor) -> GaugeZero:
    """Gauge zero of setups that state none."""
    return _optional(sensor, "zero", "free")


def reads_pairs(sensor: Sensor) -> bool:
    """True if a reading belongs to a pair of postures; such a row is a single reading."""
    return _optional(sensor, "reads_pairs", False)


def is_difference(minus: str | None, sensor: Sensor) -> bool:
    """True for a row that is the difference of readings in two postures.

    Args:
        minus: Second posture of the row; None if it has one posture.
        sensor: Sensor of its setup.
    """
    return minus is not None and not reads_pairs(sensor)


def states_readings(sensor: Sensor) -> bool:
    """True if readings are prescribed, such as the height of a bed, and the postures measured."""
    return _optional(sensor, "states_readings", False)


def equal_readings(sensor: Sensor) -> bool:
    """True if equal readings in different postures are usual, and no anomaly."""
    return _optional(sensor, "equal_readings", states_readings(sensor))


WITH_DIAL = frozenset(("dial", "ball bar"))
"""Nouns of instruments with a dial: bezel, hand and plunger."""


def has_dial(sensor: Sensor) -> bool:
    """True if a dial shows the readings of a sensor."""
    return instrument(sensor) in WITH_DIAL


def instrument(sensor: Sensor) -> str:
    """Noun for what shows a reading, such as dial or ball bar."""
    return _optional(sensor, "instrument", "dial")
