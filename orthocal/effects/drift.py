"""Drift of a gauge: the gauge zero of each setup changes linearly with time.

    displayed reading = reading + rate · t

with the time t since the first reading of the setup.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import casadi as ca

from orthocal.effects.protocol import Condition, Effect, EffectKeys, Symbols
from orthocal.io.documents import PositiveNumber
from orthocal.robot.model import Robot
from orthocal.robot.parameters import ElementaryError
from orthocal.units import UM, read_limit, show_limit


class DriftKeys(EffectKeys):
    """Keys under `orthocal.effects.drift`."""

    tolerance_um_per_min: PositiveNumber = 0.5
    """Tolerance of the rate."""


@dataclass(frozen=True, eq=False)
class Drift(Effect):
    """Linear drift of the gauge in each setup."""

    name = "drift"
    keys = DriftKeys
    conditions = ("time",)

    setup_errors: tuple[ElementaryError, ...]
    """Rate of the drift in each setup, `drift`, [m/s]."""

    @classmethod
    def from_keys(cls, keys: DriftKeys, robot: Robot) -> Self:
        """Build the effect for a robot (see `Effect.from_keys`)."""
        std = read_limit(keys.tolerance_um_per_min) * UM / 60.0
        rate = ElementaryError(name="drift", kind=cls.name, owner="", unit="m/s", prior_std=std)
        return cls((rate,))

    def describe(self) -> str:
        """Description in a few words."""
        return "drift of the gauge in each setup"

    def reading(self, reading: ca.SX, errors: Symbols, conditions: Symbols) -> ca.SX:
        """Reading of the gauge (see `Effect.reading`)."""
        return reading + errors["drift"] * conditions["time"]

    def negligible_difference(self, condition: Condition, change: float) -> float:
        """Difference of time at the largest rate (see `Effect.negligible_difference`), [s]."""
        (rate,) = self.setup_errors
        return change / show_limit(rate.prior_std)
