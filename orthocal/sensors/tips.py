"""Contact of the tip of a plunger with a round rod: closed forms.

A rod has the axis a + s u and the radius r. The plunger moves along the unit vector d of a growing
reading h, and touches the rod on the side of d. Its tip is at c + h d.

- A blade is an edge along e. At contact, the plane through the edge and parallel to the rod is a
  radius away from the rod's axis. With n = e × u, its sign such that n · d > 0,

      h = ((a − c) · n + r |n|)/(d · n).

  For r = 0 the edge meets the axis. If the edge is a pin, its radius is added to r.
- A ball of radius R touches at |(c + h d − a) × u| = r + R; the larger root applies. Without a root
  the ball passes the rod.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import casadi as ca
from pydantic import Field

from orthocal.io.documents import Keys, Number, OneKey, PositiveNumber
from orthocal.units import MM, to_mm

LARGEST_TIP_MM = 100.0
"""Largest accepted radius or width of a tip, [mm]; a larger one has a wrong unit."""


def touch_by_blade(
    point: ca.SX, along: ca.SX, radius: ca.SX, tip: ca.SX, direction: ca.SX, edge: ca.SX
) -> ca.SX:
    """Reading of an indicator with a blade, [m].

    Args:
        point: Point of the rod's axis, shape (3,), [m].
        along: Vector along the rod's axis, of any length, shape (3,).
        radius: Radius of the rod, plus that of an edge that is a pin, [m].
        tip: Point of the edge at reading 0, shape (3,), [m].
        direction: Unit vector of the plunger, along which the reading grows, shape (3,).
        edge: Vector along the blade's edge, of any length, shape (3,).
    """
    normal = ca.cross(edge, along)
    normal = normal * ca.sign(ca.dot(normal, direction))
    return (ca.dot(point - tip, normal) + radius * ca.norm_2(normal)) / ca.dot(direction, normal)


def touch_by_ball(
    point: ca.SX,
    along: ca.SX,
    radius: ca.SX,
    tip: ca.SX,
    direction: ca.SX,
    edge: ca.SX | None = None,
) -> ca.SX:
    """Reading of an indicator with a ball, [m]; NaN if the ball passes the rod without contact.

    Args:
        point: Point of the rod's axis, shape (3,), [m].
        along: Vector along the rod's axis, of any length, shape (3,).
        radius: Sum of the radii of rod and ball, [m].
        tip: Centre of the ball at reading 0, shape (3,), [m].
        direction: Unit vector of the plunger, along which the reading grows, shape (3,).
        edge: Not used; for the same signature as `touch_by_blade`.
    """
    del edge
    unit = along / ca.norm_2(along)
    offset = tip - point
    offset = offset - ca.dot(offset, unit) * unit
    across = direction - ca.dot(direction, unit) * unit
    a, b = ca.dot(across, across), ca.dot(offset, across)  # a h² + 2 b h + c = 0
    discriminant = b**2 - a * (ca.dot(offset, offset) - radius**2)
    return (ca.sqrt(discriminant) - b) / a


class BallKeys(Keys):
    """Keys of a ball at the end of a plunger."""

    radius_mm: Annotated[PositiveNumber, Field(le=LARGEST_TIP_MM)]


class BladeKeys(Keys):
    """Keys of a straight edge across a rod."""

    width_mm: Annotated[PositiveNumber, Field(le=LARGEST_TIP_MM)]
    radius_mm: Annotated[Number, Field(ge=0.0, le=LARGEST_TIP_MM)] = 0.0
    """Radius of an edge that is a pin; 0 for a sharp edge."""


class TipKeys(OneKey):
    """Keys of a tip in a session.yaml: ball or blade."""

    ball: BallKeys | None = None
    blade: BladeKeys | None = None


@dataclass(frozen=True, slots=True)
class Tip:
    """Tip of a plunger.

    Raises:
        ValueError: If the form is unknown, a size is negative or not finite, or a ball has none.
    """

    form: Literal["ball", "blade"]
    """Form of the tip."""
    radius: float
    """Radius of the ball, or of an edge that is a pin, [m]."""
    width: float = 0.0
    """Width of a blade, [m]."""

    def __post_init__(self) -> None:
        if self.form not in ("ball", "blade"):
            raise ValueError(f"form: found {self.form!r}; expected 'ball' or 'blade'")
        for name, value in (("radius", self.radius), ("width", self.width)):
            if not 0.0 <= value < math.inf:
                raise ValueError(f"{name}: found {value!r}; expected 0 or more, in m")
        if self.form == "ball" and self.radius == 0.0:
            raise ValueError("radius: found 0; expected that of the ball, in m")

    @staticmethod
    def from_keys(keys: TipKeys) -> Tip:
        """Build from the keys of a session.yaml."""
        form, tip = keys.stated
        if form == "ball":
            return Tip("ball", tip.radius_mm * MM)
        return Tip("blade", tip.radius_mm * MM, tip.width_mm * MM)

    def to_keys(self) -> dict[str, dict[str, float]]:
        """Keys for a session.yaml."""
        if self.form == "ball":
            return {"ball": {"radius_mm": to_mm(self.radius)}}
        radius = {"radius_mm": to_mm(self.radius)} if self.radius else {}
        return {"blade": {"width_mm": to_mm(self.width), **radius}}
