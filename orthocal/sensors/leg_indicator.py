"""The paper's sensor: an indicator on the base reads a leg that is not parallel to its motion.

It touches the leg where the leg's line, from root to tip, crosses the plane of the section, as an
edge across leg and plunger does. Where the plunger is square to the leg its reading is the
coordinate of that point along its direction:

    h = d · (root + t (tip − root)),  t = (c − a · root)/(a · (tip − root))

with a the leg's nominal axis and c the plane: a world coordinate, or counted from the root in the
zero posture (the paper's X-leg midpoint, section 3.2).
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
from orthocal.sensors.mounting import USUAL, Standing, StandingKeys, stand
from orthocal.sensors.protocol import Contact, Frames, Sensor, SetupKeys, Unknown, View
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
"""How a section is given."""


LARGEST_OBLIQUITY_DEG = 1.0
"""How far a measured direction may be from square to the leg; the nominal leg, in the mechanical
zero. What touches a line has no side that an oblique plunger could slide on."""


class SectionKeys(BaseModel):
    """Where along the leg's nominal axis the gauge touches."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    coordinate_mm: Number | None = None
    from_root_mm: Number | None = None
    fraction: Number | None = None

    @model_validator(mode="after")
    def _one_form(self) -> SectionKeys:
        forms = ("coordinate_mm", "from_root_mm", "fraction")
        given = [k for k in forms if getattr(self, k) is not None]
        if len(given) != 1:
            found = " and ".join(given) if given else "none"
            raise ValueError(f"found {found}; expected one of {', '.join(forms)}")
        return self


class LegKeys(StandingKeys, SetupKeys):
    """A setup of an indicator on a leg, as in a session.yaml."""

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
    """Where along the leg's nominal axis the gauge touches."""

    form: SectionForm
    value: float
    """World coordinate [m], distance from the root in the zero posture [m], or fraction [1]."""

    @staticmethod
    def from_keys(keys: SectionKeys) -> Section:
        """As in a session.yaml."""
        if keys.coordinate_mm is not None:
            return Section("coordinate_mm", keys.coordinate_mm * MM)
        if keys.from_root_mm is not None:
            return Section("from_root_mm", keys.from_root_mm * MM)
        return Section("fraction", keys.fraction or 0.0)

    def to_keys(self) -> dict[str, float]:
        """As in a session.yaml."""
        return {self.form: self.value if self.form == "fraction" else to_mm(self.value)}


@dataclass(frozen=True, slots=True)
class LegIndicator:
    """An indicator on a leg."""

    leg: str
    direction: Direction
    """Of a growing reading: x, y, z, -x, -y or -z of the world, or a vector."""
    section: Section
    standing: Standing = USUAL

    kind: ClassVar[str] = "leg"
    keys: ClassVar[type[SetupKeys]] = LegKeys
    ideal: ClassVar[str] = "parallel"

    @classmethod
    def from_keys(cls, keys: LegKeys) -> LegIndicator:
        """As in a session.yaml."""
        section = Section.from_keys(keys.section)
        return cls(keys.leg, read_direction(keys), section, Standing.from_keys(keys))

    def to_keys(self) -> dict[str, Any]:
        """As in a session.yaml."""
        section, standing = self.section.to_keys(), self.standing.to_keys()
        direction = self.direction if isinstance(self.direction, str) else list(self.direction)
        return {"leg": self.leg, "direction": direction, "section": section, **standing}

    def require_fit(self, robot: Robot, *, where: str) -> None:
        """Refuse a leg, direction or section that the robot does not have.

        Raises:
            SessionError: Naming the key.
        """
        self.require_fit_within(LARGEST_OBLIQUITY_DEG, robot, where=where)

    def require_fit_within(self, largest_deg: float, robot: Robot, *, where: str) -> None:
        """The same where a plunger may be further from square to the leg."""
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
        """Root and tip of the leg; its root at zero, where a section may count from it."""
        leg = robot.legs[self.leg]
        return Frames((leg.root, leg.tip), (leg.root,) if leg.root_driven else ())

    def constants(self, robot: Robot) -> Array:
        """Direction (3), plane, whether that counts from the root; and the leg's axis (3)."""
        plane, from_root = self.plane(robot)
        axis = robot.legs[self.leg].axis
        return np.array([*direction_vector(self.direction), plane, float(from_root), *axis])

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """How it stands."""
        return self.standing.unknowns(ball=False)

    def set_by(self, robot: Robot) -> Mapping[str, Sensor]:
        """Nothing: how it stands is measured along the leg."""
        del robot
        return {}

    def expression(self, view: View, robot: Robot) -> ca.SX:
        """What it shows, [m]."""
        del robot
        root, tip = (pose.position for pose in view.frames)
        c = view.constants
        direction, plane, axis = c[:3], c[3], c[5:8]
        if view.at_zero:
            plane += c[4] * ca.dot(axis, view.at_zero[0].position)
        stood = stand(
            self.unknowns,
            view.unknowns,
            direction=direction,
            side=ca.cross(axis, direction),
            axis=axis,
        )
        found = touch_by_blade(
            at=root,
            along=tip - root,
            radius=ca.SX(0.0),
            edge=stood.edge,
            tip=plane * axis + stood.moved,
            direction=stood.direction,
        )
        return stood.scale * found

    def describe(self) -> str:
        """Leg, direction and section."""
        form, place = self.section.form, self.section.value
        words = form.removesuffix("_mm").replace("_", " ")
        where = f"{words} {place:g}" if form == "fraction" else f"{words} {place / MM:g} mm"
        return f"leg {self.leg}, {direction_name(self.direction)}, {where}"

    def contact(self, frames: Sequence[Array], at_zero: Sequence[Array], robot: Robot) -> Contact:
        """Where the leg's line crosses the plane of the section."""
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
        """Plane across the leg that the gauge touches in: a · p = plane (+ a · root).

        Args:
            robot: The robot.
            where: File and key, for messages.

        Returns:
            Coordinate of the plane along the leg's axis a (from root to tip), [m], and whether it
            counts from the root in the zero posture.

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
    """That a leg lies along no axis, which may not be meant."""
    along = ", ".join(f"{v:.3f}" for v in leg.axis)
    return (
        f". In the mechanical zero the leg lies along ({along}): where it should lie along an axis "
        "of the world, check lengths and zeros in the robot's files"
    )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def read_direction(keys: LegKeys) -> Direction:
    """A direction as a session.yaml has it."""
    given = keys.direction
    return given if isinstance(given, str) else (given[0], given[1], given[2])


def direction_vector(direction: Direction) -> Array:
    """Of a growing reading in the world, a unit vector, shape (3,); 0 where a vector is 0."""
    vector = np.array(DIRECTIONS[direction] if isinstance(direction, str) else direction)
    if isinstance(direction, str) or not vector.any():
        return vector
    vector = vector / np.abs(vector).max()  # its square is not too large for a number
    return np.asarray(vector / np.linalg.norm(vector))


def direction_name(direction: Direction) -> str:
    """A direction in words: its name, or its vector in brackets."""
    if isinstance(direction, str):
        return direction
    return f"({', '.join(f'{v:g}' for v in direction)})"


def check_direction(
    direction: Direction, leg: Leg, largest_deg: float = LARGEST_OBLIQUITY_DEG, *, where: str
) -> None:
    """Refuse a gauge that does not measure square to the leg, as far as what touches it needs that.

    An oblique plunger also sees how far the leg moves along itself.

    Args:
        direction: Of the plunger.
        leg: The leg it touches.
        largest_deg: How far from square it may be, [°].
        where: File and key, for messages.

    Raises:
        SessionError: With the angle to the leg, and the directions that are square to it.
    """

    def angle(axis: ArrayLike) -> float:
        return float(np.degrees(np.arccos(np.clip(np.dot(axis, leg.axis), -1.0, 1.0))))

    own = angle(direction_vector(direction))
    if abs(own - 90.0) <= largest_deg:
        return
    square = [n for n, a in DIRECTIONS.items() if abs(angle(a) - 90.0) <= largest_deg]
    choice = f"; square to it: {', '.join(square)}" if square else ""
    found, named = min(own, 180.0 - own), f"'{direction_name(direction)}'"
    if found < LARGEST_OBLIQUITY_DEG:
        problem = f"{named} is along leg {leg.name}; a gauge measures across it{choice}"
    else:
        problem = (
            f"{named} is at {found:.1f}° to leg {leg.name} in the mechanical zero; expected "
            f"a direction square to the leg, to within {largest_deg:g}°{choice}"
            + ("" if square else _crooked(leg))
        )
    raise SessionError(problem, where=where)
