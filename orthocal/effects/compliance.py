"""Compliance of the rods under gravity: each shortens or lengthens by its axial force.

    change of a rod's length = c F,  c = 1/stiffness

The force follows from virtual work on the nominal machine with its drives held: a rod that becomes
longer by dℓ lifts the platform with its payload, of mass m, by dz, and F dℓ = −m g dz. It is
computed with Pinocchio's constraint Jacobians, for tension positive. Stiffness and masses are
stated, not identified: what they do to a reading is mostly below the noise of a dial.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike
from pydantic import Field

from orthocal.arrays import Array
from orthocal.effects.machine import stretch_rod
from orthocal.effects.protocol import Effect, EffectKeys
from orthocal.errors import RobotError
from orthocal.io.documents import Number, PositiveNumber
from orthocal.robot.model import Robot, require_tcp
from orthocal.units import UM

GRAVITY = 9.80665
"""Standard acceleration of gravity, [m/s²]."""

STEP = 1e-4
"""Change of a rod's length for differences, [m]; the closures are nearly linear in it."""


class ComplianceKeys(EffectKeys):
    """Keys under `orthocal.effects.compliance`."""

    rod_N_per_um: PositiveNumber
    """Axial stiffness of one rod with its hinges."""
    platform_kg: Annotated[Number, Field(ge=0.0, le=1e4)] = 0.0
    """Mass of platform and spindle, at the tool centre point."""
    down: tuple[Number, Number, Number] = (0.0, 0.0, -1.0)
    """Direction of gravity in the world frame."""
