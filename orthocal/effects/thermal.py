"""Thermal expansion of legs and screws.

    length of a rod     L (1 + α_legs (T − T0))
    actual coordinate   ρ + α_screws (T − T0) (ρ − ρ_fixed)

Both coefficients are stated with a tolerance; the parameters are the deviations from the stated
values. A screw expands from the coordinate ρ_fixed of its fixed bearing. By default this is the
point nearest to all drive axes, where they meet on an Orthoglide. A base that expands about this
point together with the screws changes only the scale of the machine.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Self

import casadi as ca
import numpy as np
import pinocchio as pin
from pydantic import Field

from orthocal.effects.protocol import Condition, Effect, EffectKeys, Symbols
from orthocal.errors import RobotError
from orthocal.io.documents import Name, Number, PositiveNumber
from orthocal.robot.description import HIGHEST_C, LOWEST_C
from orthocal.robot.model import Robot, joint_axis
from orthocal.robot.parameters import ElementaryError
from orthocal.units import MM, PPM, read_limit

PARALLEL = 1e-6
"""Ratio of smallest to largest eigenvalue below which drive axes are parallel."""


class ThermalKeys(EffectKeys):
    """Keys under `orthocal.effects.thermal`; the defaults are for steel."""

    reference_C: Annotated[Number, Field(ge=LOWEST_C, le=HIGHEST_C)] = 20.0
    """Temperature of the nominal dimensions."""
    legs_ppm: Annotated[Number, Field(ge=-10.0, le=100.0)] = 11.5
    """Coefficient of expansion of the rods, per kelvin."""
    screws_ppm: Annotated[Number, Field(ge=-10.0, le=100.0)] = 11.5
    """Coefficient of expansion of the screws, per kelvin."""
    tolerance_ppm: PositiveNumber = 3.0
    """Tolerance of both coefficients, per kelvin."""
    fixed_mm: dict[Name, Number] = Field(default_factory=dict)
    """Names of drives, mapped to the coordinate of the fixed bearing of their screw."""


@dataclass(frozen=True, eq=False)
class Thermal(Effect):
    """Thermal expansion of legs and screws."""

    name = "thermal"
    keys = ThermalKeys
    conditions = ("temperature",)

    robot: Robot
    reference: float
    """Temperature T0 of the nominal dimensions, [°C]."""
    expansion: Mapping[str, float]
    """Stated coefficients of `legs` and `screws`, [1/K]."""
    fixed: tuple[float | None, ...]
    """Coordinate of the fixed bearing of each drive's screw, [m]; None for a revolute drive."""
    errors: tuple[ElementaryError, ...]
    """Deviations of `legs.expansion` and `screws.expansion` from the stated values, [1/K]."""

    @classmethod
    def from_keys(cls, keys: ThermalKeys, robot: Robot) -> Self:
        """Build the effect for a robot (see `Effect.from_keys`)."""
        stated = {"legs": keys.legs_ppm * PPM, "screws": keys.screws_ppm * PPM}
        std = read_limit(keys.tolerance_ppm) * PPM
        errors = tuple(
            ElementaryError(
                name=f"{part}.expansion", kind=cls.name, owner=part, unit="1/K", prior_std=std
            )
            for part in stated
        )
        return cls(robot, keys.reference_C, stated, _fixed_points(keys, robot), errors)

    @property
    def neutral(self) -> Mapping[Condition, float]:
        """Reference temperature for readings without a temperature."""
        return {"temperature": self.reference}

    def describe(self) -> str:
        """Description in a few words."""
        return "thermal expansion of legs and screws"

    def _growth(self, part: str, errors: Symbols, conditions: Symbols) -> ca.SX:
        """Relative expansion of `legs` or `screws`."""
        coefficient = self.expansion[part] + errors[f"{part}.expansion"]
        return coefficient * (conditions["temperature"] - self.reference)

    def drives(self, coordinates: ca.SX, errors: Symbols, conditions: Symbols) -> ca.SX:
        """Actual drive coordinates (see `Effect.drives`)."""
        lengths = ca.vertcat(
            *(0.0 if f is None else coordinates[i] - f for i, f in enumerate(self.fixed))
        )
        return coordinates + self._growth("screws", errors, conditions) * lengths

    def rods(self, errors: Symbols, conditions: Symbols) -> Mapping[tuple[str, str], ca.SX]:
        """Changes of the lengths of rods (see `Effect.rods`)."""
        growth = self._growth("legs", errors, conditions)
        return {name: growth * rod.length for name, rod in self.robot.rods.items()}

    def negligible_difference(self, condition: Condition, change: float) -> float:
        """Difference of temperature (see `Effect.negligible_difference`), [K].

        The largest change of a reading is assumed to be the growth of the longest rod and of the
        longest screw, both coefficients at their upper limits. A screw is as long as from its fixed
        bearing to the mechanical zero; readings beyond it change slightly more.
        """
        drives = zip(self.robot.drives, self.fixed, strict=True)
        rods = (rod.length for rod in self.robot.rods.values())
        screws = (abs(d.zero - f) for d, f in drives if f is not None)
        growth = 0.0
        for error, lengths in zip(self.errors, (rods, screws), strict=True):
            limit = abs(self.expansion[error.owner]) + 2.0 * error.prior_std
            growth += limit * max(lengths, default=0.0)
        return change / growth if growth else math.inf


def _fixed_points(keys: ThermalKeys, robot: Robot) -> tuple[float | None, ...]:
    """Coordinate of the fixed bearing of each screw, [m]; None for a revolute drive.

    Raises:
        RobotError: If a named drive is not linear, or if a coordinate is needed and not stated.
    """
    linear = [d.name for d in robot.drives if d.unit == "m"]
    for name in keys.fixed_mm:
        if name not in linear:
            expected = f"expected one of {', '.join(linear)}" if linear else "the robot has none"
            raise RobotError(f"'{name}' is not a linear drive; {expected}", where="fixed_mm")
    fixed = {name: value * MM for name, value in keys.fixed_mm.items()}
    if len(fixed) < len(linear):
        fixed = _common_point(robot, linear) | fixed
    return tuple(fixed.get(d.name) for d in robot.drives)


def _common_point(robot: Robot, drives: list[str]) -> dict[str, float]:
    """Commanded coordinate of each linear drive at the point nearest to all their axes, [m].

    Raises:
        RobotError: If the axes are parallel, so that no point is nearest.
    """
    model, data = robot.model, robot.model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    joints = [model.getJointId(name) for name in drives]
    origins = np.array([data.oMi[j].translation for j in joints])
    axes = np.array([data.oMi[j].rotation @ joint_axis(model, j)[:3] for j in joints])
    projections = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # normal to each axis
    normal = projections.sum(axis=0)
    eigenvalues = np.linalg.eigvalsh(normal)
    if eigenvalues[0] < PARALLEL * eigenvalues[-1]:
        raise RobotError(
            "the drive axes are parallel; state the coordinate of the fixed bearing of each screw",
            where="fixed_mm",
        )
    point = np.linalg.solve(normal, np.einsum("kij,kj->i", projections, origins))
    gain = dict(zip((d.name for d in robot.drives), robot.drive_gain, strict=True))
    along = ((point - origins) * axes).sum(axis=1)
    return {name: float(x / gain[name]) for name, x in zip(drives, along, strict=True)}
