"""The paper's sensor: an indicator on the base reads a leg that is not parallel to its motion.

It touches the leg where the leg's line, from root to tip, crosses the plane of the section, as an
edge across leg and plunger does. Where the plunger is square to the leg its reading is the
coordinate of that point along its direction:

    h = d · (root + t (tip − root)),  t = (c − a · root)/(a · (tip − root))

with a the leg's nominal axis and c the plane: a world coordinate, or counted from the root in the
zero posture (the paper's X-leg midpoint, section 3.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, model_validator

from orthocal.documents import Name, Number
from orthocal.errors import SessionError
from orthocal.robot.model import Leg, Robot
from orthocal.sensors.protocol import Contact, Frames, SetupKeys, Unknown, View
from orthocal.sensors.standing import USUAL, Standing, StandingKeys, stand
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

SectionForm = Literal["coordinate_mm", "from_root_mm", "fraction"]
"""How a section is given."""


LARGEST_OBLIQUITY_DEG = 1.0
"""How far a measured direction may be from square to the leg; the nominal leg, in the mechanical
zero."""


class SectionKeys(BaseModel):
    """Where along the leg's nominal axis the gauge touches."""

    model_config = ConfigDict(extra="forbid", frozen=True)

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
    direction: str
    section: SectionKeys


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
    direction: str
    """x, y, z, -x, -y or -z of the world: the direction of a growing reading."""
    section: Section
    standing: Standing = USUAL

    kind: ClassVar[str] = "leg"
    keys: ClassVar[type[SetupKeys]] = LegKeys
    ideal: ClassVar[str] = "parallel"

    @classmethod
    def from_keys(cls, keys: LegKeys) -> LegIndicator:
        """As in a session.yaml."""
        section = Section.from_keys(keys.section)
        return cls(keys.leg, keys.direction, section, Standing.from_keys(keys))

    def to_keys(self) -> dict[str, Any]:
        """As in a session.yaml."""
        section, standing = self.section.to_keys(), self.standing.to_keys()
        return {"leg": self.leg, "direction": self.direction, "section": section, **standing}

    def require_fit(self, robot: Robot, *, where: str) -> None:
        """Refuse a leg, direction or section that the robot does not have.

        Raises:
            SessionError: Naming the key.
        """
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
        if self.direction not in DIRECTIONS:
            raise SessionError(
                f"found '{self.direction}'; expected one of {', '.join(DIRECTIONS)}",
                where=f"{where}.direction",
            )
        check_direction(self.direction, robot.legs[self.leg], where=f"{where}.direction")
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
        return np.array([*DIRECTIONS[self.direction], plane, float(from_root), *axis])

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """How it stands."""
        return self.standing.unknowns(ball=False)

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
        return f"leg {self.leg}, {self.direction}, {where}"

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
            direction=np.array(DIRECTIONS[self.direction]),
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


def check_direction(direction: str, leg: Leg, *, where: str) -> None:
    """Refuse a gauge that does not measure square to the leg, as its model takes for granted.

    An oblique plunger also sees how far the leg moves along itself.

    Args:
        direction: One of `DIRECTIONS`.
        leg: The leg it touches.
        where: File and key, for messages.

    Raises:
        SessionError: With the angle to the leg, and the directions that are square to it.
    """
    angles = {
        name: float(np.degrees(np.arccos(np.clip(np.dot(axis, leg.axis), -1.0, 1.0))))
        for name, axis in DIRECTIONS.items()
    }
    if abs(angles[direction] - 90.0) <= LARGEST_OBLIQUITY_DEG:
        return
    square = [n for n, a in angles.items() if abs(a - 90.0) <= LARGEST_OBLIQUITY_DEG]
    choice = f"; square to it: {', '.join(square)}" if square else ""
    found = min(angles[direction], 180.0 - angles[direction])
    if found < LARGEST_OBLIQUITY_DEG:
        problem = f"'{direction}' is along leg {leg.name}; a gauge measures across it{choice}"
    else:
        problem = (
            f"'{direction}' is at {found:.1f}° to leg {leg.name} in the mechanical zero; expected "
            f"a direction square to the leg, to within {LARGEST_OBLIQUITY_DEG:g}°{choice}"
            + ("" if square else _crooked(leg))
        )
    raise SessionError(problem, where=where)
