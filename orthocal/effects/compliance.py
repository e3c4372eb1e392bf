"""Compliance of the rods under the weight of platform and payload.

    change of a rod's length = F / k

with its axial stiffness k and its axial force F, tension positive (`RodForces`). Weights act at the
tool centre point; those of the rods are neglected. Stiffness and masses are stated and not
identified, because their effect is mostly below the noise of an indicator.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Self

import casadi as ca
import numpy as np
from pydantic import Field

from orthocal.arrays import Array
from orthocal.effects.protocol import Effect, EffectKeys, Symbols
from orthocal.errors import RobotError
from orthocal.io.documents import Number, PositiveNumber
from orthocal.io.fields import read_only
from orthocal.robot.description import HEAVIEST_KG
from orthocal.robot.model import Robot
from orthocal.units import UM

GRAVITY = 9.80665
"""Standard acceleration of gravity, [m/s²]."""


class ComplianceKeys(EffectKeys):
    """Keys under `orthocal.effects.compliance`."""

    rod_N_per_um: Annotated[PositiveNumber, Field(ge=1e-3, le=1e5)]
    """Axial stiffness of one rod with its hinges."""
    platform_kg: Annotated[Number, Field(ge=0.0, le=HEAVIEST_KG)] = 0.0
    """Mass of the platform with the spindle."""
    down: tuple[Number, Number, Number] = (0.0, 0.0, -1.0)
    """Direction of gravity in the world frame, of any norm."""


@dataclass(frozen=True, eq=False)
class Compliance(Effect):
    """Axial compliance of all rods, without parameters."""

    name = "compliance"
    keys = ComplianceKeys
    conditions = ("load",)

    robot: Robot
    stiffness: float
    """Axial stiffness of one rod, [N/m]."""
    platform: float
    """Mass of the platform with the spindle, [kg]."""
    down: Array
    """Direction of gravity in the world frame, unit vector, shape (3,)."""

    @classmethod
    def from_keys(cls, keys: ComplianceKeys, robot: Robot) -> Self:
        """Build the effect for a robot (see `Effect.from_keys`)."""
        if robot.tcp is None or not robot.rods:
            raise RobotError("needs a robot with rods (orthocal.legs) and a tool (orthocal.tcp)")
        down = np.array(keys.down)
        length = float(np.linalg.norm(down))
        if not length > 0.0:
            raise RobotError("found [0, 0, 0]; expected a direction", where="down")
        return cls(robot, keys.rod_N_per_um / UM, keys.platform_kg, read_only(down / length))

    def describe(self) -> str:
        """Description in a few words."""
        return "compliance of the rods under platform and payload"

    def tool_force(self, payload: float) -> Array:
        """Force on the tool centre point (see `Effect.tool_force`)."""
        return (self.platform + payload) * GRAVITY * self.down

    def rods(self, errors: Symbols, conditions: Symbols) -> Mapping[tuple[str, str], ca.SX]:
        """Changes of the lengths of rods (see `Effect.rods`)."""
        return {
            name: conditions["load"][i] / self.stiffness for i, name in enumerate(self.robot.rods)
        }
