"""How a gauge really stands: a little turned and moved from where it is said to be.

Each setup has small unknowns with a tolerance each: roll about the leg and pitch towards it, place
of the section, lateral place of a ball; and the dial, how much it shows of a millimetre. On the
axes of a parallel machine the first order of roll, pitch and section vanishes. Setups on one square
block share its roll, but for how square the block is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import casadi as ca
from pydantic import BaseModel, ConfigDict, Field, model_validator

from orthocal.io.documents import Name, Number
from orthocal.sensors.protocol import Unknown
from orthocal.units import MM, MRAD, tidy

DIRECTION = 10 * MRAD
"""How well a plunger is turned by hand and eye, [rad]."""

SECTION = 0.5 * MM
"""How well its place is measured with a ruler, along the leg and across it, [m]."""

SCALE = 0.002
"""How well a dial shows a millimetre: the lead of its rack, [1]."""

SQUARE = 0.1 * MRAD
"""How square a block is, [rad]."""

LARGEST_TOLERANCE_MM = 20.0
LARGEST_TOLERANCE_MRAD = 200.0
LARGEST_SCALE = 0.2

Millimetres = Annotated[Number, Field(ge=0.0, le=LARGEST_TOLERANCE_MM)]
Milliradians = Annotated[Number, Field(ge=0.0, le=LARGEST_TOLERANCE_MRAD)]


class StandingKeys(BaseModel):
    """What a setup may say of how well its gauge stands; 0 where it is known exactly."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    direction_tolerance_mrad: Milliradians = DIRECTION / MRAD
    section_tolerance_mm: Millimetres = SECTION / MM
    lateral_tolerance_mm: Millimetres = SECTION / MM
    """Of a ball; nothing else is moved by it."""
    scale_tolerance: Annotated[Number, Field(ge=0.0, le=LARGEST_SCALE)] = SCALE
    """Of the dial: one for all setups with the same gauge."""
    stand: Name | None = None
    """A square block that other setups at this leg stand on too: they share its roll."""
    square_tolerance_mrad: Milliradians | None = None

    @model_validator(mode="after")
    def _square_of_a_stand(self) -> StandingKeys:
        if self.square_tolerance_mrad is not None and self.stand is None:
            raise ValueError("square_tolerance_mrad|found without `stand`, a square block")
        return self


@dataclass(frozen=True, slots=True)
class Standing:
    """How well it is known how a gauge stands, one standard deviation each."""

    direction: float = DIRECTION
    """Of roll and of pitch, [rad]."""
    section: float = SECTION
    """Along the leg, [m]."""
    lateral: float = SECTION
    """Across leg and plunger, [m]."""
    scale: float = SCALE
    """Of the dial, [1]."""
    stand: str | None = None
    """The square block that it stands on."""
    square: float = SQUARE
    """Of that block, [rad]."""

    @staticmethod
    def from_keys(keys: Any) -> Standing:  # noqa: ANN401 - of any setup with StandingKeys
        """As in a session.yaml."""
        square = keys.square_tolerance_mrad
        return Standing(
            direction=tidy(keys.direction_tolerance_mrad * MRAD),
            section=tidy(keys.section_tolerance_mm * MM),
            lateral=tidy(keys.lateral_tolerance_mm * MM),
            scale=keys.scale_tolerance,
            stand=keys.stand,
            square=SQUARE if square is None else tidy(square * MRAD),
        )

    def to_keys(self) -> dict[str, Any]:
        """As in a session.yaml: what is not as by default."""
        usual = USUAL
        found: dict[str, Any] = {
            "direction_tolerance_mrad": (self.direction, usual.direction, MRAD),
            "section_tolerance_mm": (self.section, usual.section, MM),
            "lateral_tolerance_mm": (self.lateral, usual.lateral, MM),
            "scale_tolerance": (self.scale, usual.scale, 1.0),
            "square_tolerance_mrad": (self.square, usual.square, MRAD),
        }
        other = {k: tidy(v / unit) for k, (v, of_all, unit) in found.items() if v != of_all}
        return other if self.stand is None else {**other, "stand": self.stand}

    def unknowns(self, *, ball: bool) -> tuple[Unknown, ...]:
        """What is not known exactly of it; a tolerance of 0 leaves nothing unknown."""
        block = None if self.stand is None else f"stand.{self.stand}"
        found = [
            Unknown("roll", "rad", self.direction, shared_by=block),
            Unknown("pitch", "rad", self.direction),
            Unknown("section", "m", self.section),
            Unknown("scale", "1", self.scale, of_gauge=True),
        ]
        if block is not None:
            found.append(Unknown("square", "rad", self.square))
        if ball:
            found.append(Unknown("lateral", "m", self.lateral))
        return tuple(u for u in found if u.tolerance > 0.0)


USUAL = Standing()
"""By eye and ruler."""

EXACT = Standing(0.0, 0.0, 0.0, 0.0)
"""As it is said to be: the gauge of the paper."""


@dataclass(frozen=True, slots=True, eq=False)
class Stood:
    """A gauge as it stands with given unknowns, as expressions."""

    direction: ca.SX
    """Of the plunger, a unit vector, shape (3,)."""
    edge: ca.SX
    """Of a blade across leg and plunger, a unit vector, shape (3,)."""
    moved: ca.SX
    """What the tip is moved by from where it is said to be, shape (3,), [m]."""
    scale: ca.SX
    """What the dial shows of a metre, [1]."""


def stand(
    unknowns: Sequence[Unknown], values: ca.SX, *, direction: ca.SX, side: ca.SX, axis: ca.SX
) -> Stood:
    """How a gauge stands.

    Args:
        unknowns: Which there are.
        values: Of them, shape (n_unknowns,), [SI].
        direction: Of the plunger as it is said to be, a unit vector, shape (3,).
        side: Across leg and plunger, a unit vector, shape (3,).
        axis: Of the leg, from root to tip, a unit vector, shape (3,).
    """
    of = {u.name: values[i] for i, u in enumerate(unknowns)}
    roll = of.get("roll", 0.0) + of.get("square", 0.0)
    pitched = _turn(direction, side, -of.get("pitch", ca.SX(0.0)))
    return Stood(
        direction=_turn(pitched, axis, ca.SX(roll)),
        edge=_turn(side, axis, ca.SX(roll)),
        moved=of.get("section", 0.0) * axis + of.get("lateral", 0.0) * side,
        scale=1.0 + of.get("scale", ca.SX(0.0)),
    )


def _turn(vector: ca.SX, axis: ca.SX, angle: ca.SX) -> ca.SX:
    """A vector turned about a unit vector."""
    along = ca.dot(axis, vector) * axis
    return along + ca.cos(angle) * (vector - along) + ca.sin(angle) * ca.cross(axis, vector)
