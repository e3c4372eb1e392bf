"""Distance between two positions at which the tool printed or marked, measured by a calliper.

A reading belongs to a pair of postures: the posture of its row and the one in the column `minus`.
With p and q the tool positions in both,

    h = (1 + s) (|p − q| + w)

w is the width of the pillar that the calliper includes. s is the scale error of calliper and print,
which includes the shrinkage of the print. The distance is absolute.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from orthocal.arrays import Array
from orthocal.robot.model import Robot, require_tcp
from orthocal.sensors.ball_bar import LARGEST_MM, Coordinate, Tolerance
from orthocal.sensors.mounting import SCALE_STD, ScaleTolerance
from orthocal.sensors.protocol import (
    Contact,
    Frames,
    GaugeZero,
    NuisanceParameter,
    SetupKeys,
    ToolSensor,
    View,
)
from orthocal.units import MM, read_tolerance, show_mm, show_tolerance, to_mm


class DistanceKeys(SetupKeys):
    """Keys of a setup of distances, as in a session.yaml."""

    width_mm: Coordinate = 0.0
    """Measured width of the pillar that the calliper includes."""
    width_tolerance_mm: Tolerance = 0.0
    """Tolerance of the width; 0 if it is known."""
    scale_tolerance: ScaleTolerance = show_tolerance(SCALE_STD)
    """Tolerance of the scale of calliper and print, dimensionless; setups with one gauge share the
    error."""


@dataclass(frozen=True, slots=True)
class Distance(ToolSensor):
    """Distance between the tool positions in two postures."""

    width: float = 0.0
    """Width of the pillar, [m]."""
    width_std: float = 0.0
    """Prior standard deviation of the width, [m]; 0 if it is known."""
    scale_std: float = SCALE_STD
    """Prior standard deviation of the scale, [1]."""

    kind: ClassVar[str] = "distance"
    noun: ClassVar[str] = "a printed distance"
    instrument: ClassVar[str] = "calliper"
    keys: ClassVar[type[SetupKeys]] = DistanceKeys
    ideal: ClassVar[str] = "its nominal length"
    zero: ClassVar[GaugeZero] = "known"
    reads_pairs: ClassVar[bool] = True
    equal_readings: ClassVar[bool] = True
    largest_reading: ClassVar[float] = LARGEST_MM * MM

    @classmethod
    def from_keys(cls, keys: DistanceKeys) -> Distance:
        """Build from the keys of a session.yaml."""
        return cls(
            width=keys.width_mm * MM,
            width_std=read_tolerance(keys.width_tolerance_mm, MM),
            scale_std=read_tolerance(keys.scale_tolerance),
        )

    def to_keys(self) -> dict[str, Any]:
        """Keys for a session.yaml."""
        keys: dict[str, Any] = {}
        if self.width:
            keys["width_mm"] = to_mm(self.width)
        if self.width_std:
            keys["width_tolerance_mm"] = show_tolerance(self.width_std, MM)
        if self.scale_std != SCALE_STD:
            keys["scale_tolerance"] = show_tolerance(self.scale_std)
        return keys

    def describe(self) -> str:
        """Short description with the width of the pillar."""
        beyond = f", over a pillar of {show_mm(self.width)} mm" if self.width else ""
        return f"printed distance{beyond}"

    @property
    def mounting_steps(self) -> tuple[str, ...]:
        """Instructions for the operator."""
        enter = "Enter the value that it shows, the width of the pillar included."
        if not self.width:
            enter = "Subtract the width of a pillar that the value includes, then enter it."
        return (
            "Print or mark the object at the positions of both postures, and let it cool down.",
            f"Measure the distance between both marks with a calliper. {enter}",
        )

    def frames(self, robot: Robot) -> Frames:
        """Frame of the tool in both postures."""
        tool = (require_tcp(robot).frame,)
        return Frames(tool, in_second=tool)

    def constants(self, robot: Robot) -> Array:
        """Width of the pillar (1), [m]."""
        del robot
        return np.array([self.width])

    @property
    def nuisance_parameters(self) -> tuple[NuisanceParameter, ...]:
        """Width and scale, if their standard deviation is above 0."""
        parameters = (
            NuisanceParameter("width", "m", self.width_std, nominal=self.width),
            NuisanceParameter("scale", "1", self.scale_std, of_gauge=True),
        )
        return tuple(p for p in parameters if p.prior_std > 0.0)

    def expression(self, view: View, robot: Robot) -> ca.SX:
        """Reading of the calliper, [m]."""
        del robot
        errors = {p.name: view.nuisance[i] for i, p in enumerate(self.nuisance_parameters)}
        (here,), (there,) = view.frames, view.second
        length = ca.norm_2(here.position - there.position)
        shown = length + view.constants[0] + errors.get("width", 0.0)
        return ca.SX((1.0 + errors.get("scale", 0.0)) * shown)

    def contact(self, frames: Sequence[Array], at_zero: Sequence[Array], robot: Robot) -> Contact:
        """Tool positions in K postures; nothing is touched."""
        del at_zero, robot
        points = frames[0][:, :3, 3]
        problems = [""] * len(points)
        up, across = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
        return Contact(points, up, across, problems, "width_mm", at_tool=True)
