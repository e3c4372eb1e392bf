"""Touch probe or nozzle on a bed: height of the tip above the surface.

In a plan the reading is the coordinate of the posture minus that at the trigger. If the posture
consists of the drive coordinates at the trigger, as in a printer's log, the reading is 0. The
surface is a plane of unknown tilt, with or without a smooth deviation from flat. Heights are
positive against the direction of the probe:

    h = −(n · q)/(n · u) − f(q) − o

with the notation of `tool_indicator`, and o the trigger height of the probe.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import casadi as ca
from pydantic import Field

from orthocal.arrays import Triple, triple
from orthocal.io.documents import Keys
from orthocal.robot.model import Robot
from orthocal.sensors.direction import direction_vector
from orthocal.sensors.mounting import Millimetres, Milliradians
from orthocal.sensors.protocol import (
    PROBING_DISTANCE,
    GaugeZero,
    NuisanceParameter,
    SetupKeys,
    View,
)
from orthocal.sensors.tool_indicator import (
    ALIGNMENT_STD,
    LENGTH_MM,
    Artefact,
    Length,
    Point,
    ToolIndicator,
)
from orthocal.units import MM, MRAD, read_tolerance, show_tolerance, to_mm

TRIGGER_STD = 0.5 * MM
"""Prior standard deviation of the trigger height, [m]."""

FORM_DEGREE = 4
"""Largest degree of the polynomial deviations of a bed from flat."""


class SurfaceKeys(Keys):
    """Keys of a surface that is not flat."""

    flat_tolerance_mm: Millimetres
    length_mm: Length = LENGTH_MM


class ProbeKeys(SetupKeys):
    """Keys of a setup with a probe, as in a session.yaml."""

    direction: Literal["x", "y", "z", "-x", "-y", "-z"] = "-z"
    surface: Literal["plane"] | SurfaceKeys = "plane"
    direction_tolerance_mrad: Milliradians = show_tolerance(ALIGNMENT_STD, MRAD)
    trigger_tolerance_mm: Millimetres = show_tolerance(TRIGGER_STD, MM)
    """Tolerance of the trigger height."""
    tool_mm: Point = Field(default_factory=lambda: [0.0, 0.0, 0.0])
    """Tip of the probe, from the tool centre point, in the tool's frame."""


@dataclass(frozen=True, slots=True)
class Probe(ToolIndicator):
    """Probe at the tool that triggers at a surface."""

    trigger_std: float = TRIGGER_STD
    """Prior standard deviation of the trigger height, [m]."""

    kind: ClassVar[str] = "probe"
    keys: ClassVar[type[SetupKeys]] = ProbeKeys
    ideal: ClassVar[str] = "the surface"
    zero: ClassVar[GaugeZero] = "known"
    states_readings: ClassVar[bool] = True
    instrument: ClassVar[str] = "probe"

    @classmethod
    def from_keys(cls, keys: Any) -> Probe:  # noqa: ANN401 - of `keys`
        """Build from the keys of a session.yaml."""
        flat = SurfaceKeys(flat_tolerance_mm=0.0)
        surface = flat if keys.surface == "plane" else keys.surface
        plate = Artefact(
            "plate",
            length=surface.length_mm * MM,
            direction_std=read_tolerance(keys.direction_tolerance_mrad, MRAD),
            form_std=read_tolerance(surface.flat_tolerance_mm, MM),
            form_degree=FORM_DEGREE,
        )
        trigger = read_tolerance(keys.trigger_tolerance_mm, MM)
        return cls(keys.direction, plate, triple(keys.tool_mm, MM), trigger_std=trigger)

    def to_keys(self) -> dict[str, Any]:
        """Keys for a session.yaml."""
        a = self.artefact
        surface: Any = "plane"
        if a.form_std:
            surface = {
                "flat_tolerance_mm": show_tolerance(a.form_std, MM),
                "length_mm": to_mm(a.length),
            }
        keys = {
            "direction": self.direction,
            "surface": surface,
            "direction_tolerance_mrad": show_tolerance(a.direction_std, MRAD),
            "trigger_tolerance_mm": show_tolerance(self.trigger_std, MM),
        }
        if any(self.tool):
            keys["tool_mm"] = [to_mm(v) for v in self.tool]
        return keys

    def describe(self) -> str:
        """Short description with the direction of the probe."""
        return f"probe towards {self.direction}"

    @property
    def mounting_steps(self) -> tuple[str, ...]:
        """Instructions for the operator."""
        axis, posture, trigger = self.direction[-1], "that of the posture", "that at the trigger"
        first, second = (posture, trigger) if self.direction.startswith("-") else (trigger, posture)
        return (
            f"At each posture begin {PROBING_DISTANCE / MM:g} mm before the surface. Move the "
            f"probe slowly towards {self.direction} until it triggers, note the coordinate {axis} "
            "of the tool, and move back.",
            "The reading is the height of the tip above the surface in the posture: the coordinate "
            f"{axis}, {first} minus {second}. It is negative if the probe triggers before the "
            "posture.",
        )

    @property
    def probing(self) -> Triple:
        """Direction of the probe, a unit vector."""
        return triple(direction_vector(self.direction))

    @property
    def nuisance_parameters(self) -> tuple[NuisanceParameter, ...]:
        """Direction and form of the surface and trigger height, if their std is above 0."""
        surface = (replace(p, fixed=True) for p in self.artefact.nuisance_parameters)
        trigger = NuisanceParameter("trigger", "m", self.trigger_std)
        return tuple(p for p in (*surface, trigger) if p.prior_std > 0.0)

    def expression(self, view: View, robot: Robot) -> ca.SX:
        """Height of the tip above the surface, [m]."""
        errors = {p.name: view.nuisance[i] for i, p in enumerate(self.nuisance_parameters)}
        indicated = ToolIndicator.expression(self, view, robot)
        return ca.SX(-indicated - errors.get("trigger", 0.0))
