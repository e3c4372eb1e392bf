"""Mounting uncertainty of a gauge: direction, section, lateral position and dial scale.

Each setup has nuisance parameters with Gaussian priors: roll about the leg, pitch towards it,
position of the section along the leg, and lateral position of a ball. The scale belongs to the
dial. On the axes of a parallel machine, readings depend on roll, pitch and section only to second
order. Setups on one square block share its roll, up to the squareness of the block.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import casadi as ca
from pydantic import Field, model_validator

from orthocal.io.documents import Keys, Name, Number
from orthocal.sensors.protocol import NuisanceParameter
from orthocal.units import MM, MRAD, read_tolerance, show_tolerance

DIRECTION_STD = 10 * MRAD
"""Prior standard deviation of the direction of a plunger aligned by eye, [rad]."""

POSITION_STD = 0.5 * MM
"""Prior standard deviation of a position measured with a ruler, along or across the leg, [m]."""

SCALE_STD = 0.002
"""Prior standard deviation of the scale of a dial, [1], from the lead error of its rack."""

SQUARE_STD = 0.1 * MRAD
"""Prior standard deviation of the squareness of a block, [rad]."""

LARGEST_TOLERANCE_MM = 40.0
LARGEST_TOLERANCE_MRAD = 400.0
LARGEST_SCALE = 0.4
"""Largest accepted tolerances of positions, directions and scale; larger ones have a wrong unit."""

ScaleTolerance = Annotated[Number, Field(ge=0.0, le=LARGEST_SCALE)]
"""Tolerance of the scale of a gauge, dimensionless."""

Millimetres = Annotated[Number, Field(ge=0.0, le=LARGEST_TOLERANCE_MM)]
Milliradians = Annotated[Number, Field(ge=0.0, le=LARGEST_TOLERANCE_MRAD)]
"""Tolerances of positions and directions."""


class MountingKeys(Keys):
    """Tolerances of a gauge's mounting in a session.yaml; 0 for a parameter without error."""

    direction_tolerance_mrad: Milliradians = show_tolerance(DIRECTION_STD, MRAD)
    section_tolerance_mm: Millimetres = show_tolerance(POSITION_STD, MM)
    lateral_tolerance_mm: Millimetres = show_tolerance(POSITION_STD, MM)
    """Lateral position of a ball; other tips have none."""
    scale_tolerance: ScaleTolerance = show_tolerance(SCALE_STD)
    """Scale of the dial: one for all setups with the same gauge."""
    stand: Name | None = None
    """Square block that several setups of this leg share, with its roll."""
    square_tolerance_mrad: Milliradians | None = None

    @model_validator(mode="after")
    def _require_stand(self) -> MountingKeys:
        """Refuse a tolerance of squareness without a block."""
        if self.square_tolerance_mrad is not None and self.stand is None:
            raise ValueError("square_tolerance_mrad|found without `stand`, a square block")
        return self


@dataclass(frozen=True, slots=True)
class Mounting:
    """Mounting uncertainty of a gauge: prior standard deviation of each parameter.

    Raises:
        ValueError: If a standard deviation is negative, or not a number.
    """

    direction: float = DIRECTION_STD
    """Roll and pitch, [rad]."""
    section: float = POSITION_STD
    """Position along the leg, [m]."""
    lateral: float = POSITION_STD
    """Position across leg and plunger, [m]."""
    scale: float = SCALE_STD
    """Scale of the dial, [1]."""
    stand: str | None = None
    """Name of the square block."""
    square: float = SQUARE_STD
    """Squareness of the block, [rad]."""

    def __post_init__(self) -> None:
        for name in ("direction", "section", "lateral", "scale", "square"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise ValueError(f"{name}: found {value!r}; expected 0 or a positive number")

    @staticmethod
    def from_keys(keys: Any) -> Mounting:  # noqa: ANN401 - of any setup with MountingKeys
        """Build from the keys of a session.yaml, which inherit those of `MountingKeys`."""
        square = keys.square_tolerance_mrad
        return Mounting(
            direction=read_tolerance(keys.direction_tolerance_mrad, MRAD),
            section=read_tolerance(keys.section_tolerance_mm, MM),
            lateral=read_tolerance(keys.lateral_tolerance_mm, MM),
            scale=read_tolerance(keys.scale_tolerance),
            stand=keys.stand,
            square=SQUARE_STD if square is None else read_tolerance(square, MRAD),
        )

    def to_keys(self) -> dict[str, Any]:
        """Keys for a session.yaml that differ from the defaults."""
        values: dict[str, Any] = {
            "direction_tolerance_mrad": (self.direction, USUAL.direction, MRAD),
            "section_tolerance_mm": (self.section, USUAL.section, MM),
            "lateral_tolerance_mm": (self.lateral, USUAL.lateral, MM),
            "scale_tolerance": (self.scale, USUAL.scale, 1.0),
        }
        if self.stand is not None:
            values["square_tolerance_mrad"] = (self.square, USUAL.square, MRAD)
        keys = {k: show_tolerance(v, unit) for k, (v, usual, unit) in values.items() if v != usual}
        return keys if self.stand is None else {**keys, "stand": self.stand}

    def nuisance_parameters(self, *, ball: bool) -> tuple[NuisanceParameter, ...]:
        """Nuisance parameters with a standard deviation above 0.

        Args:
            ball: Whether the tip is a ball, which has a lateral position.
        """
        block = None if self.stand is None else f"stand.{self.stand}"
        parameters = [
            NuisanceParameter("roll", "rad", self.direction, shared_by=block),
            NuisanceParameter("pitch", "rad", self.direction),
            NuisanceParameter("section", "m", self.section),
            NuisanceParameter("scale", "1", self.scale, of_gauge=True),
        ]
        if block is not None:
            parameters.append(NuisanceParameter("square", "rad", self.square))
        if ball:
            parameters.append(NuisanceParameter("lateral", "m", self.lateral))
        return tuple(p for p in parameters if p.prior_std > 0.0)


USUAL = Mounting()
"""Mounting by eye and ruler."""

EXACT = Mounting(0.0, 0.0, 0.0, 0.0)
"""Mounting without errors: the gauge of the paper."""


def mount(
    parameters: Sequence[NuisanceParameter],
    values: ca.SX,
    *,
    direction: ca.SX,
    side: ca.SX,
    axis: ca.SX,
) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """Gauge with mounting errors, as expressions.

    Args:
        parameters: Nuisance parameters of the mounting.
        values: Their values, shape (n_nuisance,), [SI].
        direction: Nominal unit vector of the plunger, shape (3,).
        side: Unit vector across leg and plunger, shape (3,).
        axis: Unit vector of the leg, from root to tip, shape (3,).

    Returns:
        Displacement of the tip from its nominal position, shape (3,), [m]; unit vectors of the
        plunger and of a blade across leg and plunger, shape (3,); and the ratio of indicated to
        actual displacement, [1].
    """
    error = {p.name: values[i] for i, p in enumerate(parameters)}
    roll = ca.SX(error.get("roll", 0.0) + error.get("square", 0.0))
    pitched = rotate(direction, side, -error.get("pitch", ca.SX(0.0)))
    displacement = error.get("section", 0.0) * axis + error.get("lateral", 0.0) * side
    plunger, edge = (rotate(vector, axis, roll) for vector in (pitched, side))
    return displacement, plunger, edge, 1.0 + error.get("scale", ca.SX(0.0))


def rotate(vector: ca.SX, axis: ca.SX, angle: ca.SX) -> ca.SX:
    """Rotation of a vector about a unit vector (Rodrigues)."""
    along = ca.dot(axis, vector) * axis
    return along + ca.cos(angle) * (vector - along) + ca.sin(angle) * ca.cross(axis, vector)
