"""Backlash of each drive: the slide lags behind the command by half of the backlash.

    actual coordinate = ρ − (b/2) s

with the commanded coordinate ρ and the backlash b ≥ 0 of the drive. s = 1 if the coordinate grew in
the last motion, −1 if it fell. If the direction is unknown, s = 0: the middle of both positions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import casadi as ca

from orthocal.effects.protocol import Effect, EffectKeys, Symbols
from orthocal.io.documents import PositiveNumber
from orthocal.robot.model import Robot
from orthocal.robot.parameters import ElementaryError
from orthocal.units import MM, MRAD, read_limit


class BacklashKeys(EffectKeys):
    """Keys under `orthocal.effects.backlash`: largest backlash of a drive in good condition."""

    tolerance_mm: PositiveNumber = 0.04
    """Tolerance for prismatic drives."""
    tolerance_mrad: PositiveNumber = 0.2
    """Tolerance for revolute drives."""


@dataclass(frozen=True, eq=False)
class Backlash(Effect):
    """Backlash of each drive, with a half-normal prior."""

    name = "backlash"
    keys = BacklashKeys
    conditions = ("approach",)

    errors: tuple[ElementaryError, ...]
    """Backlash of each drive, `<drive>.backlash`, [m, rad]."""

    @classmethod
    def from_keys(cls, keys: BacklashKeys, robot: Robot) -> Self:
        """Build the effect for a robot (see `Effect.from_keys`)."""
        stds = {
            "m": read_limit(keys.tolerance_mm) * MM,
            "rad": read_limit(keys.tolerance_mrad) * MRAD,
        }
        errors = (
            ElementaryError(
                name=f"{d.name}.backlash",
                kind=cls.name,
                owner=d.name,
                unit=d.unit,
                prior_std=stds[d.unit],
                positive=True,
            )
            for d in robot.drives
        )
        return cls(tuple(errors))

    def describe(self) -> str:
        """Description in a few words."""
        return "backlash of each drive"

    def drives(self, coordinates: ca.SX, errors: Symbols, conditions: Symbols) -> ca.SX:
        """Actual drive coordinates (see `Effect.drives`)."""
        backlash = ca.vertcat(*(errors[e.name] for e in self.errors))
        return coordinates - 0.5 * backlash * conditions["approach"]
