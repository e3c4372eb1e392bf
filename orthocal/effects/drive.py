"""Offset and scale of each drive.

    actual coordinate = (gain + s) ρ + Δρ

for the commanded coordinate ρ, with the offset Δρ (paper, equation 1) and the scale error s. The
gain of the nominal machine is 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import casadi as ca

from orthocal.effects.protocol import Effect, EffectKeys, Symbols
from orthocal.io.documents import PositiveNumber
from orthocal.robot.model import Robot
from orthocal.robot.parameters import ElementaryError
from orthocal.units import MM, MRAD, PPM, read_limit


class DriveTolerances(EffectKeys):
    """Tolerances of the drives under `orthocal.tolerances`: ±2 prior standard deviations."""

    offset_mm: PositiveNumber = 10.0
    offset_mrad: PositiveNumber = 20.0
    scale_ppm: PositiveNumber = 200.0


@dataclass(frozen=True, eq=False)
class DriveErrors(Effect):
    """Offset and scale of each drive."""

    name = "drive"
    keys = DriveTolerances

    robot: Robot
    errors: tuple[ElementaryError, ...]
    """Offsets `<drive>.offset` of all drives, [m, rad], then scale errors `<drive>.scale`, [1]."""

    @classmethod
    def from_keys(cls, keys: DriveTolerances, robot: Robot) -> Self:
        """Build the effect for a robot (see `Effect.from_keys`)."""
        stds = {"m": read_limit(keys.offset_mm) * MM, "rad": read_limit(keys.offset_mrad) * MRAD}
        offsets = (
            ElementaryError(
                name=f"{d.name}.offset",
                kind="offset",
                owner=d.name,
                unit=d.unit,
                prior_std=stds[d.unit],
            )
            for d in robot.drives
        )
        scale_std = read_limit(keys.scale_ppm) * PPM
        scales = (
            ElementaryError(
                name=f"{d.name}.scale", kind="scale", owner=d.name, unit="1", prior_std=scale_std
            )
            for d in robot.drives
        )
        return cls(robot, (*offsets, *scales))

    def describe(self) -> str:
        """Description in a few words."""
        return "offset and scale of each drive"

    def drives(self, coordinates: ca.SX, errors: Symbols, conditions: Symbols) -> ca.SX:
        """Actual drive coordinates (see `Effect.drives`)."""
        offset, scale = (
            ca.vertcat(*(errors[f"{d.name}.{kind}"] for d in self.robot.drives))
            for kind in ("offset", "scale")
        )
        return (ca.SX(self.robot.drive_gain) + scale) * coordinates + offset
