"""An indicator that follows a coordinate of the tool; setups of the same `dial` share its scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import casadi as ca
import numpy as np

from orthocal.errors import SessionError
from orthocal.io.documents import Name, PositiveNumber
from orthocal.sensors.protocol import Contact, Frames, NuisanceParameter, SetupKeys
from orthocal.units import read_limit


class ToolKeys(SetupKeys):
    tool: Literal["x", "y", "z"]
    slope_tolerance: PositiveNumber
    dial: Name | None = None


@dataclass(frozen=True, slots=True)
class ToolCoordinate:
    axis: str
    slope_tolerance: float
    dial: str | None

    kind: ClassVar[str] = "tool"
    keys: ClassVar[type[SetupKeys]] = ToolKeys
    ideal: ClassVar[str] = "where it should be"

    @classmethod
    def from_keys(cls, keys):
        return cls(keys.tool, keys.slope_tolerance, keys.dial)

    def to_keys(self):
        dial = {} if self.dial is None else {"dial": self.dial}
        return {"tool": self.axis, "slope_tolerance": self.slope_tolerance, **dial}

    def require_fit(self, robot, *, where):
        if robot.tcp is None:
            raise SessionError(f"{robot.name} has no tool", where=f"{where}.tool")

    @property
    def place(self):
        return "tool", ""

    def describe(self):
        return f"tool, {self.axis}"

    def frames(self, robot):
        return Frames((robot.tcp.frame,))

    def constants(self, robot):
        return self._axis

    @property
    def nuisance_parameters(self):
        shared = None if self.dial is None else f"dial.{self.dial}"
        return (NuisanceParameter("slope", "1", read_limit(self.slope_tolerance), shared),)

    def aligned_to(self, robot):
        return {}

    def expression(self, view, robot):
        return ca.dot(view.constants, view.frames[0].position) * (1.0 + view.nuisance[0])

    def contact(self, frames, at_zero, robot):
        points = frames[0][:, :3, 3]
        return Contact(points, self._axis, np.roll(self._axis, 1), [""] * len(points), "tool")

    @property
    def _axis(self):
        return np.eye(3)["xyz".index(self.axis)]
