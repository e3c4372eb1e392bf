"""Periodic error of each drive's screw, with one period per turn.

    actual coordinate = ρ + A sin(2πρ/lead) + B cos(2πρ/lead)

with the commanded coordinate ρ. ρ excludes the offset in the controller: the phase depends only on
the screw and its home switch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import casadi as ca
import numpy as np

from orthocal.effects.protocol import Effect, EffectKeys, Symbols
from orthocal.errors import RobotError
from orthocal.io.documents import PositiveNumber
from orthocal.robot.model import Robot
from orthocal.robot.parameters import ElementaryError
from orthocal.units import MM, read_limit

SCREW_COMPONENTS = ("screw_sin", "screw_cos")
"""Suffixes of the parameters A and B of a drive."""


class ScrewKeys(EffectKeys):
    """Keys under `orthocal.effects.screw`."""

    lead_mm: PositiveNumber
    """Travel per turn of the screw."""
    periodic_tolerance_mm: PositiveNumber = 0.01
    """Tolerance of A and of B."""


@dataclass(frozen=True, eq=False)
class Screw(Effect):
    """Periodic error of the screws of all linear drives."""

    name = "screw"
    keys = ScrewKeys

    robot: Robot
    lead: float
    """Travel per turn, [m]."""
    errors: tuple[ElementaryError, ...]
    """A and B of each linear drive, `<drive>.screw_sin` and `<drive>.screw_cos`, [m]."""

    @classmethod
    def from_keys(cls, keys: ScrewKeys, robot: Robot) -> Self:
        """Build the effect for a robot (see `Effect.from_keys`)."""
        std = read_limit(keys.periodic_tolerance_mm) * MM
        linear = [d for d in robot.drives if d.unit == "m"]
        if not linear:
            raise RobotError("has no linear drive; expected a robot with screws")
        for d in linear:
            travel = d.upper - d.lower
            if keys.lead_mm * MM > travel:
                raise RobotError(
                    f"found {keys.lead_mm:g}; expected at most the travel of {d.name}, "
                    f"{travel / MM:g}",
                    where="lead_mm",
                )
        errors = (
            ElementaryError(
                name=f"{d.name}.{component}", kind=cls.name, owner=d.name, unit="m", prior_std=std
            )
            for d in linear
            for component in SCREW_COMPONENTS
        )
        return cls(robot, keys.lead_mm * MM, tuple(errors))

    @property
    def period(self) -> float:  # type: ignore[override] # a field of other effects
        """Lead of the screws, [m]."""
        return self.lead

    def describe(self) -> str:
        """Description in a few words."""
        return "periodic error of the screws"

    def drives(self, coordinates: ca.SX, errors: Symbols, conditions: Symbols) -> ca.SX:
        """Actual drive coordinates (see `Effect.drives`)."""
        phase = 2.0 * np.pi * coordinates / self.lead
        zero = ca.SX(1, 1)  # for revolute drives, which have no screw
        sine, cosine = (
            ca.vertcat(*(errors.get(f"{d.name}.{component}", zero) for d in self.robot.drives))
            for component in SCREW_COMPONENTS
        )
        return coordinates + sine * ca.sin(phase) + cosine * ca.cos(phase)
