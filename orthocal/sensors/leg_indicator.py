"""The paper's sensor: an indicator on the base reads a leg that is not parallel to its motion.

It touches the leg where the leg's line, from root to tip, crosses the plane of the section. Its
reading is the coordinate of that point along its direction:

    h = d · (root + t (tip − root)),  t = (c − a · root)/(a · (tip − root))

with a the leg's nominal axis and c the plane: a world coordinate, or counted from the root in the
zero posture (the paper's X-leg midpoint, section 3.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocal.errors import SessionError
from orthocal.robot.model import Leg, Robot
from orthocal.sensors.protocol import Frames, Unknown, View

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


@dataclass(frozen=True, slots=True)
class Section:
    """Where along the leg's nominal axis the gauge touches."""

    form: SectionForm
    value: float
    """World coordinate [m], distance from the root in the zero posture [m], or fraction [1]."""


@dataclass(frozen=True, slots=True)
class LegIndicator:
    """An indicator on a leg."""

    leg: str
    direction: str
    """x, y, z, -x, -y or -z of the world: the direction of a growing reading."""
    section: Section

    kind = "leg"

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
        """None but the zero of its setup."""
        return ()

    def expression(self, view: View, robot: Robot) -> ca.SX:
        """What it shows, [m]."""
        del robot
        root, tip = (pose.position for pose in view.frames)
        c = view.constants
        direction, plane, axis = c[:3], c[3], c[5:8]
        if view.at_zero:
            plane += c[4] * ca.dot(axis, view.at_zero[0].position)
        t = (plane - ca.dot(axis, root)) / ca.dot(axis, tip - root)
        return ca.dot(direction, root + t * (tip - root))

    def describe(self) -> str:
        """Leg, direction and section."""
        form, place = self.section.form, self.section.value
        words = form.removesuffix("_mm").replace("_", " ")
        where = f"{words} {place:g}" if form == "fraction" else f"{words} {place * 1e3:g} mm"
        return f"leg {self.leg}, {self.direction}, {where}"

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
