"""An effect for tests that depends on approach, position, temperature and time."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from orthocal.effects.protocol import NEUTRAL, Effect, EffectKeys
from orthocal.errors import RobotError
from orthocal.io.documents import PositiveNumber
from orthocal.robot.parameters import ElementaryError
from orthocal.units import MM, PPM, UM


class SlackKeys(EffectKeys):
    slack_mm: PositiveNumber = 0.02
    wave_mm: PositiveNumber = 0.01
    lead_mm: PositiveNumber = 5.0
    growth_ppm_per_K: PositiveNumber = 12.0
    creep_um_per_min: PositiveNumber = 0.5


@dataclass(frozen=True, eq=False)
class Slack(Effect):
    name = "slack"
    keys = SlackKeys
    conditions = ("approach", "temperature", "time")

    robot: object
    lead: float
    errors: tuple[ElementaryError, ...]
    setup_errors: tuple[ElementaryError, ...]

    @classmethod
    def from_keys(cls, keys, robot):
        if keys.lead_mm < 1.0:
            raise RobotError(f"found {keys.lead_mm:g}; expected at least 1", where="lead_mm")
        sizes = {"slack": keys.slack_mm * MM, "wave": keys.wave_mm * MM}
        errors = tuple(
            ElementaryError(
                f"{d.name}.{kind}", "slack", d.name, "m", size, positive=kind == "slack"
            )
            for kind, size in sizes.items()
            for d in robot.drives
        )
        growth = ElementaryError("rods.growth", "slack", "rods", "1/K", keys.growth_ppm_per_K * PPM)
        creep = ElementaryError("creep", "slack", "", "m/s", keys.creep_um_per_min * UM / 60.0)
        return cls(robot, keys.lead_mm * MM, (*errors, growth), (creep,))

    def describe(self):
        return "slack and periodic error of the screws, growth of the rods, creep of the gauge"

    def drives(self, coordinates, errors, conditions):
        slack, wave = (
            ca.vertcat(*(errors[f"{d.name}.{kind}"] for d in self.robot.drives))
            for kind in ("slack", "wave")
        )
        periodic = wave * ca.sin(2.0 * ca.pi * coordinates / self.lead)
        return coordinates + periodic - 0.5 * slack * conditions["approach"]

    def rods(self, errors, conditions):
        warmer = conditions["temperature"] - NEUTRAL["temperature"]
        return {
            (leg.name, rod.name): errors["rods.growth"] * warmer * rod.length
            for leg in self.robot.legs.values()
            for rod in leg.rods.values()
        }

    def reading(self, reading, errors, conditions):
        return reading + errors["creep"] * conditions["time"]
