"""Line model of the paper: an indicator on the base measures the line of a leg.

The gauge touches the leg where its line, from root to tip, crosses the plane of the section, like
an edge across leg and plunger. If the plunger is square to the leg, the reading is the coordinate
of that point along the direction of the plunger:

    h = d · (root + t (tip − root)),  t = (c − a · root)/(a · (tip − root))

with a the leg's nominal axis and c the plane: a world coordinate, or counted from the root in the
reference posture (the paper's X-leg midpoint, section 3.2).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from orthocal.errors import SessionError
from orthocal.io.documents import Name, Number
from orthocal.robot.model import Leg, Robot
from orthocal.sensors.mounting import USUAL, Mounting, MountingKeys, mount
from orthocal.sensors.protocol import Contact, Frames, NuisanceParameter, Sensor, SetupKeys, View
from orthocal.sensors.tips import touch_by_blade
from orthocal.units import MM, to_mm

Array = NDArray[np.float64]

DIRECTIONS: dict[str, tuple[float, float, float]] = {
    "x": (1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-x": (-1.0, 0.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "-z": (0.0, 0.0, -1.0),
}
"""Names of measured directions, and their unit vectors in the world."""

Direction = str | tuple[float, float, float]
"""A name of `DIRECTIONS`, or a vector in the world, of any length."""

SectionForm = Literal["coordinate_mm", "from_root_mm", "fraction"]
"""Key that states a section."""


LARGEST_OBLIQUITY_DEG = 1.0
"""Largest deviation of a measured direction from square to the nominal leg at the mechanical zero.
A line has no surface for an oblique plunger."""


class SectionKeys(BaseModel):
    """Section: position along the leg's nominal axis at which the gauge touches."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    coordinate_mm: Number | None = None
    from_root_mm: Number | None = None
    fraction: Number | None = None

    @model_validator(mode="after")
    def _one_form(self) -> SectionKeys:
        forms = ("coordinate_mm", "from_root_mm", "fraction")
        stated = [k for k in forms if getattr(self, k) is not None]
        if len(stated) != 1:
            text = " and ".join(stated) if stated else "none"
            raise ValueError(f"found {text}; expected one of {', '.join(forms)}")
        return self


class LegKeys(MountingKeys, SetupKeys):
    """Keys of a setup with an indicator on a leg."""

    leg: Name
    direction: str | Annotated[list[Number], Field(min_length=3, max_length=3)]
    section: SectionKeys

    @field_validator("direction", mode="before")
    @classmethod
    def _name_or_vector(cls, value: object) -> object:
        vector = isinstance(value, list) and len(value) == 3 and all(map(_is_number, value))
        if not vector and not isinstance(value, str):
            raise ValueError(
                f"found {value}; expected one of {', '.join(DIRECTIONS)}, or a vector of three "
                "numbers such as [0, 1, 1]"
            )
        return value


@dataclass(frozen=True, slots=True)
class Section:
    """Section: position along the leg's nominal axis at which the gauge touches."""

    form: SectionForm
    value: float
    """World coordinate [m], distance from the root at the mechanical zero [m], or fraction [1]."""

    @staticmethod
    def from_keys(keys: SectionKeys) -> Section:
        """Build from the keys of a session.yaml."""
        if keys.coordinate_mm is not None:
            return Section("coordinate_mm", keys.coordinate_mm * MM)
        if keys.from_root_mm is not None:
            return Section("from_root_mm", keys.from_root_mm * MM)
        return Section("fraction", keys.fraction or 0.0)

    def to_keys(self) -> dict[str, float]:
        """Keys for a session.yaml."""
        return {self.form: self.value if self.form == "fraction" else to_mm(self.value)}


@dataclass(frozen=True, slots=True)
class LegIndicator:
    """An indicator on a leg."""

    leg: str
    direction: Direction
    """Direction of a growing reading: x, y, z, -x, -y or -z of the world, or a vector."""
    section: Section
    mounting: Mounting = USUAL

    kind: ClassVar[str] = "leg"
    keys: ClassVar[type[SetupKeys]] = LegKeys
    ideal: ClassVar[str] = "parallel"

    @classmethod
    def from_keys(cls, keys: LegKeys) -> LegIndicator:
        """Build from the keys of a session.yaml."""
        section = Section.from_keys(keys.section)
        return cls(keys.leg, read_direction(keys), section, Mounting.from_keys(keys))

    def to_keys(self) -> dict[str, Any]:
        """Keys for a session.yaml."""
        section, mounting = self.section.to_keys(), self.mounting.to_keys()
        direction = self.direction if isinstance(self.direction, str) else list(self.direction)
        return {"leg": self.leg, "direction": direction, "section": section, **mounting}

    def require_fit(self, robot: Robot, *, where: str) -> None:
        """Refuse a leg, direction or section that the robot does not have.

        Raises:
            SessionError: Naming the key.
        """
        self.require_fit_within(LARGEST_OBLIQUITY_DEG, robot, where=where)

    def require_fit_within(self, largest_deg: float, robot: Robot, *, where: str) -> None:
        """Refuse as `require_fit`, with another limit of the deviation from square, [°]."""
        if not robot.legs:
            raise SessionError(
                f"'{robot.name}' has no legs for a gauge to touch; add orthocal.legs to "
                f"{robot.yaml}",
                where=f"{where}.leg",
            )
        if self.leg not in robot.legs:
            raise SessionError(
                f"'{self.leg}' is not a leg of {robot.name}; legs: {', '.join(robot.legs)}",
                where=f"{where}.leg",
            )
        if isinstance(self.direction, str) and self.direction not in DIRECTIONS:
            raise SessionError(
                f"found '{self.direction}'; expected one of {', '.join(DIRECTIONS)}, or a vector",
                where=f"{where}.direction",
            )
        if not np.any(direction_vector(self.direction)):
            raise SessionError(
                "found [0, 0, 0], which has no direction; expected a vector such as [0, 1, 1]",
                where=f"{where}.direction",
            )
        check_direction(
            self.direction, robot.legs[self.leg], largest_deg, where=f"{where}.direction"
        )
        if self.section.form == "fraction" and not 0.0 <= self.section.value <= 1.0:
            raise SessionError(
                f"found {self.section.value:g}; expected 0 (root) to 1 (tip)",
                where=f"{where}.section.fraction",
            )
        self.plane(robot, where=f"{where}.section")

    @property
    def place(self) -> tuple[str, str]:
        """The leg."""
        return "leg", self.leg

    def frames(self, robot: Robot) -> Frames:
        """Root and tip of the leg; its root in the reference posture for sections from the root."""
        leg = robot.legs[self.leg]
        return Frames((leg.root, leg.tip), (leg.root,) if leg.root_driven else ())

    def constants(self, robot: Robot) -> Array:
        """Direction (3), plane (1), 1 if it counts from the root else 0, axis of the leg (3)."""
        plane, from_root = self.plane(robot)
        axis = robot.legs[self.leg].axis
        return np.array([*direction_vector(self.direction), plane, float(from_root), *axis])

    @property
    def nuisance_parameters(self) -> tuple[NuisanceParameter, ...]:
        """Nuisance parameters of the mounting."""
        return self.mounting.nuisance_parameters(ball=False)

    def aligned_to(self, robot: Robot) -> Mapping[str, Sensor]:
        """No parameter is aligned by eye."""
        del robot
        return {}

    def expression(self, view: View, robot: Robot) -> ca.SX:
        """Reading with the gauge zero at 0, [m]."""
        del robot
        root, tip = (pose.position for pose in view.frames)
        c = view.constants
        direction, plane, axis = c[:3], c[3], c[5:8]
        if view.at_zero:
            plane += c[4] * ca.dot(axis, view.at_zero[0].position)
        gauge = mount(
            self.nuisance_parameters,
            view.nuisance,
            direction=direction,
            side=ca.cross(axis, direction),
            axis=axis,
        )
        reading = touch_by_blade(
            at=root,
            along=tip - root,
            radius=ca.SX(0.0),
            edge=gauge.edge,
            tip=plane * axis + gauge.displacement,
            direction=gauge.direction,
        )
        return gauge.scale * reading

    def describe(self) -> str:
        """Leg, direction and section."""
        form, place = self.section.form, self.section.value
        words = form.removesuffix("_mm").replace("_", " ")
        where = f"{words} {place:g}" if form == "fraction" else f"{words} {place / MM:g} mm"
        return f"leg {self.leg}, {direction_name(self.direction)}, {where}"

    def contact(self, frames: Sequence[Array], at_zero: Sequence[Array], robot: Robot) -> Contact:
        """Points in which the leg's line crosses the plane of the section."""
        leg = robot.legs[self.leg]
        plane, from_root = self.plane(robot)
        if from_root:
            plane += float(leg.axis @ at_zero[0][:3, 3])
        root, tip = (pose[:, :3, 3] for pose in frames)
        fraction = (plane - root @ leg.axis) / ((tip - root) @ leg.axis)
        length = leg.length / MM
        return Contact(
            points=root + fraction[:, None] * (tip - root),
            direction=direction_vector(self.direction),
            along=leg.axis,
            problems=[
                ""
                if 0.0 <= t <= 1.0
                else f"the gauge would touch at {t * length:.1f} mm from the root; the leg reaches "
                f"from 0 to {length:.1f} mm"
                for t in fraction.tolist()
            ],
            key="section",
        )

    def plane(self, robot: Robot, *, where: str = "") -> tuple[float, bool]:
        """Plane of the section across the leg, a · p = plane (+ a · root).

        Args:
            robot: The robot.
            where: File and key, for messages.

        Returns:
            Coordinate of the plane along the leg's axis a (from root to tip), [m], and whether it
            counts from the root in the reference posture.

        Raises:
            SessionError: If the section's form does not fit the leg.
        """
        leg = robot.legs[self.leg]
        form, value = self.section.form, self.section.value
        if form == "coordinate_mm":
            return _coordinate_plane(leg, value, where), False
        if not leg.root_driven:
            raise SessionError(
                f"the root of leg {leg.name} moves with passive joints; give coordinate_mm",
                where=where,
            )
        return (value * leg.length if form == "fraction" else value), True


def _coordinate_plane(leg: Leg, value: float, where: str) -> float:
    axis = int(np.abs(leg.axis).argmax())
    if abs(leg.axis[axis]) < 1.0 - 1e-9:
        raise SessionError(
            f"leg {leg.name} does not lie along a world axis; give from_root_mm or fraction",
            where=where,
        )
    return float(np.sign(leg.axis[axis]) * value)


def _crooked(leg: Leg) -> str:
    """Hint for a leg that lies along no axis of the world."""
    along = ", ".join(f"{v:.3f}" for v in leg.axis)
    return (
        f". In the mechanical zero the leg lies along ({along}): where it should lie along an axis "
        "of the world, check lengths and zeros in the robot's files"
    )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def read_direction(keys: LegKeys) -> Direction:
    """Direction of the keys of a session.yaml."""
    d = keys.direction
    return d if isinstance(d, str) else (d[0], d[1], d[2])


def direction_vector(direction: Direction) -> Array:
    """Unit vector of a growing reading in the world, shape (3,); 0 for the vector 0."""
    vector = np.array(DIRECTIONS[direction] if isinstance(direction, str) else direction)
    if isinstance(direction, str) or not vector.any():
        return vector
    vector = vector / np.abs(vector).max()  # its square is not too large for a number
    return np.asarray(vector / np.linalg.norm(vector))


def direction_name(direction: Direction) -> str:
    """Name of a direction, or its vector in brackets."""
    if isinstance(direction, str):
        return direction
    return f"({', '.join(f'{v:g}' for v in direction)})"


def check_direction(
    direction: Direction, leg: Leg, largest_deg: float = LARGEST_OBLIQUITY_DEG, *, where: str
) -> None:
    """Refuse a gauge that does not measure square to the leg.

    The reading of an oblique plunger also changes when the leg moves along itself.

    Args:
        direction: Direction of the plunger.
        leg: The leg that it touches.
        largest_deg: Largest deviation from square, [°].
        where: File and key, for messages.

    Raises:
        SessionError: With the angle to the leg, and the directions that are square to it.
    """

    def angle(axis: ArrayLike) -> float:
        return float(np.degrees(np.arccos(np.clip(np.dot(axis, leg.axis), -1.0, 1.0))))

    to_leg = angle(direction_vector(direction))
    if abs(to_leg - 90.0) <= largest_deg:
        return
    square = [n for n, a in DIRECTIONS.items() if abs(angle(a) - 90.0) <= largest_deg]
    choice = f"; square to it: {', '.join(square)}" if square else ""
    acute, named = min(to_leg, 180.0 - to_leg), f"'{direction_name(direction)}'"
    if acute < LARGEST_OBLIQUITY_DEG:
        problem = f"{named} is along leg {leg.name}; a gauge measures across it{choice}"
    else:
        problem = (
            f"{named} is at {acute:.1f}° to leg {leg.name} in the mechanical zero; expected "
            f"a direction square to the leg, to within {largest_deg:g}°{choice}"
            + ("" if square else _crooked(leg))
        )
    raise SessionError(problem, where=where)
