"""Contact of the tip of a plunger with a round rod: closed forms.

A rod has the axis a + s u and the radius r. The plunger moves along the unit vector d, in which the
reading h grows, on the rod's d side. Its tip is at c + h d.

- A blade is an edge along e: it touches where the plane through the edge and along the rod is a
  radius away from the rod's axis. With n = e × u, its sign such that n · d > 0,

      h = ((a − c) · n + r |n|)/(d · n);

  without a radius the edge meets the axis. A pin as edge adds its radius to r.
- A ball of radius R touches where |(c + h d − a) × u| = r + R; of the two roots the larger. Where
  there is none the plunger passes the rod.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import casadi as ca
from pydantic import BaseModel, ConfigDict, Field, model_validator

from orthocal.io.documents import Number, PositiveNumber
from orthocal.units import MM, to_mm

LARGEST_TIP_MM = 100.0
"""Largest ball or blade of an indicator; a larger one has a wrong unit."""


def touch_by_blade(
    at: ca.SX, along: ca.SX, radius: ca.SX, tip: ca.SX, direction: ca.SX, edge: ca.SX
) -> ca.SX:
    """Reading of an indicator with a blade, [m].

    Args:
        at: A point of the rod's axis, shape (3,), [m].
        along: The rod's axis, of any length, shape (3,).
        radius: Of the rod, and of the edge where that is a pin, [m].
        tip: A point of the edge at reading 0, shape (3,), [m].
        direction: Of the plunger, in which the reading grows; a unit vector, shape (3,).
        edge: The blade's edge, of any length, shape (3,).
    """
    normal = ca.cross(edge, along)
    normal = normal * ca.sign(ca.dot(normal, direction))
    return (ca.dot(at - tip, normal) + radius * ca.norm_2(normal)) / ca.dot(direction, normal)


def touch_by_ball(
    at: ca.SX,
    along: ca.SX,
    radius: ca.SX,
    tip: ca.SX,
    direction: ca.SX,
    edge: ca.SX | None = None,
) -> ca.SX:
    """Reading of an indicator with a ball, [m]; NaN if the ball passes the rod.

    Args:
        at: A point of the rod's axis, shape (3,), [m].
        along: The rod's axis, of any length, shape (3,).
        radius: Of the rod and the ball together, [m].
        tip: The ball's centre at reading 0, shape (3,), [m].
        direction: Of the plunger, in which the reading grows; a unit vector, shape (3,).
        edge: Not used: a ball has none.
    """
    del edge
    unit = along / ca.norm_2(along)
    apart = tip - at
    apart = apart - ca.dot(apart, unit) * unit
    across = direction - ca.dot(direction, unit) * unit
    square, mixed = ca.dot(across, across), ca.dot(apart, across)
    discriminant = mixed**2 - square * (ca.dot(apart, apart) - radius**2)
    return (ca.sqrt(discriminant) - mixed) / square


class BallKeys(BaseModel):
    """A ball at the end of a plunger."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    radius_mm: Annotated[PositiveNumber, Field(le=LARGEST_TIP_MM)]


class BladeKeys(BaseModel):
    """A straight edge across a rod."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    width_mm: Annotated[PositiveNumber, Field(le=LARGEST_TIP_MM)]
    radius_mm: Annotated[Number, Field(ge=0.0, le=LARGEST_TIP_MM)] = 0.0
    """Of an edge that is a pin."""


class TipKeys(BaseModel):
    """Keys of a tip in a session.yaml: ball or blade."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    ball: BallKeys | None = None
    blade: BladeKeys | None = None

    @model_validator(mode="after")
    def _one_form(self) -> TipKeys:
        if (self.ball is None) == (self.blade is None):
            text = "none" if self.ball is None else "ball and blade"
            raise ValueError(f"found {text}; expected one of ball, blade")
        return self


@dataclass(frozen=True, slots=True)
class Tip:
    """Tip of a plunger."""

    form: Literal["ball", "blade"]
    radius: float
    """Of the ball, or of an edge that is a pin, [m]."""
    width: float = 0.0
    """Of a blade, [m]."""

    @staticmethod
    def from_keys(keys: TipKeys) -> Tip:
        """Build from the keys of a session.yaml."""
        if keys.ball is not None:
            return Tip("ball", keys.ball.radius_mm * MM)
        blade = keys.blade or BladeKeys(width_mm=1.0)
        return Tip("blade", blade.radius_mm * MM, blade.width_mm * MM)

    def to_keys(self) -> dict[str, dict[str, float]]:
        """Keys for a session.yaml."""
        if self.form == "ball":
            return {"ball": {"radius_mm": to_mm(self.radius)}}
        radius = {"radius_mm": to_mm(self.radius)} if self.radius else {}
        return {"blade": {"width_mm": to_mm(self.width), **radius}}
