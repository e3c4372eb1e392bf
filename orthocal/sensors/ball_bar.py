"""Ball bar: distance between a ball at the tool and a fixed ball.

With b the position of the ball at the tool and c that of the fixed ball, the reading is

    h = (1 + s) (|b − c| − L)

L is the length of the bar at reading 0, and s the error of the dial's scale. Position c, length L
and s are nuisance parameters. All setups with one bar share L and s, which belong to the gauge. If
L is known or has a tolerance, the gauge zero is known. Otherwise each setup has a free gauge zero,
or the setups share an unknown length.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import casadi as ca
import numpy as np
from pydantic import Field

from orthocal.arrays import Array, triple
from orthocal.io.documents import Name, Number
from orthocal.robot.model import Robot
from orthocal.sensors.mounting import SCALE_STD, ScaleTolerance
from orthocal.sensors.protocol import (
    DIMENSION_STEP,
    Contact,
    GaugeZero,
    NuisanceParameter,
    Sensor,
    SetupKeys,
    ToolSensor,
    View,
    place_point,
)
from orthocal.units import MM, read_tolerance, show_mm, show_tolerance, to_mm

CENTRE_STD = 1.0 * MM
"""Prior standard deviation of a coordinate of a fixed ball to which the tool was jogged, [m]."""

UNKNOWN_LENGTH_STD = 1.0 * MM
"""Prior standard deviation of an unknown length, which was measured with a ruler only, [m]."""

SAGITTA = 5e-6
"""Largest deviation of a chord from the arc between two readings, [m]."""

SHORTEST_MM = 5.0
"""Smallest accepted length, [mm]; a smaller one has a wrong unit."""

LARGEST_MM = 5000.0
"""Largest accepted length and coordinate, [mm]; a larger one has a wrong unit."""

Coordinate = Annotated[Number, Field(ge=-LARGEST_MM, le=LARGEST_MM)]
Point = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
Tolerance = Annotated[Number, Field(ge=0.0, le=LARGEST_MM)]


class BallBarKeys(SetupKeys):
    """Keys of a setup with a ball bar, as in a session.yaml."""

    centre_mm: Point
    """Nominal position of the fixed ball in the world frame."""
    ball: Name | None = None
    """Name of the fixed ball, if it stays in its place for several setups."""
    centre_tolerance_mm: Tolerance = show_tolerance(CENTRE_STD, MM)
    """Tolerance of each coordinate of the fixed ball; 0 if the position is known."""
    tool_mm: Point = Field(default_factory=lambda: [0.0, 0.0, 0.0])
    """Position of the ball at the tool, from the tool centre point, in the tool's frame."""
    length_mm: Annotated[Number, Field(ge=SHORTEST_MM, le=LARGEST_MM)]
    """Distance of the balls at reading 0."""
    length_tolerance_mm: Tolerance | Literal["unknown"] = 0.0
    """Tolerance of the length; 0 if it is known."""
    scale_tolerance: ScaleTolerance = show_tolerance(SCALE_STD)
    """Tolerance of the dial's scale, dimensionless."""


@dataclass(frozen=True, slots=True)
class BallBar(ToolSensor):
    """Ball bar between the tool and a fixed ball."""

    centre: tuple[float, float, float]
    """Nominal position of the fixed ball in the world frame, [m]."""
    length: float
    """Nominal distance of the balls at reading 0, [m]."""
    centre_std: float = CENTRE_STD
    """Prior standard deviation of each coordinate of the fixed ball, [m]."""
    length_std: float = 0.0
    """Prior standard deviation of the length, [m]; 0 if it is known."""
    scale_std: float = SCALE_STD
    """Prior standard deviation of the dial's scale, [1]."""
    tool: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the ball at the tool, from the tool centre point, in the tool's frame, [m]."""
    ball: str | None = None
    """Name of the fixed ball that several setups share."""

    kind: ClassVar[str] = "ball_bar"
    noun: ClassVar[str] = "a ball bar"
    instrument: ClassVar[str] = "ball bar"
    keys: ClassVar[type[SetupKeys]] = BallBarKeys
    ideal: ClassVar[str] = "its sphere"
    zero: ClassVar[GaugeZero] = "known"
    mirrored: ClassVar[tuple[str, ...]] = ("centre_x", "centre_y", "centre_z")

    @classmethod
    def from_keys(cls, keys: BallBarKeys) -> BallBar:
        """Build from the keys of a session.yaml."""
        tolerance = keys.length_tolerance_mm
        length_std = UNKNOWN_LENGTH_STD
        if tolerance != "unknown":
            length_std = read_tolerance(tolerance, MM)
        return cls(
            centre=triple(keys.centre_mm, MM),
            length=keys.length_mm * MM,
            centre_std=read_tolerance(keys.centre_tolerance_mm, MM),
            length_std=length_std,
            scale_std=read_tolerance(keys.scale_tolerance),
            tool=triple(keys.tool_mm, MM),
            ball=keys.ball,
        )

    def to_keys(self) -> dict[str, Any]:
        """Keys for a session.yaml."""
        keys: dict[str, Any] = {
            "centre_mm": [to_mm(v) for v in self.centre],
            "centre_tolerance_mm": show_tolerance(self.centre_std, MM),
            "length_mm": to_mm(self.length),
        }
        if self.ball is not None:
            keys["ball"] = self.ball
        if any(self.tool):
            keys["tool_mm"] = [to_mm(v) for v in self.tool]
        if self.length_std:
            unknown = self.length_std == UNKNOWN_LENGTH_STD
            tolerance = "unknown" if unknown else show_tolerance(self.length_std, MM)
            keys["length_tolerance_mm"] = tolerance
        if self.scale_std != SCALE_STD:
            keys["scale_tolerance"] = show_tolerance(self.scale_std)
        return keys

    def describe(self) -> str:
        """Short description with length and fixed ball."""
        x, y, z = map(show_mm, self.centre)
        return f"ball bar of {show_mm(self.length)} mm about X{x} Y{y} Z{z} mm"

    @property
    def mounting_steps(self) -> tuple[str, ...]:
        """Instructions for mounting the bar."""
        x, y, z = map(show_mm, self.centre)
        length = f"{show_mm(self.length)} mm"
        known = "It is known" if not self.length_std else "Its true length need not be known"
        stays = ""
        if self.ball is not None:
            stays = (
                " If it stays from an earlier setup, leave it, and jog around ball and post to the "
                "alignment posture before you start."
            )
        return (
            "Mount one ball at the tool. Place the other, the fixed ball, on its post only after "
            f"the tool is in the alignment posture: at about X{x} Y{y} Z{z} mm from the tool "
            f"centre point at the mechanical zero, by eye.{stays}",
            "Before you connect the bar, hold it at the tool's ball and turn it by hand through "
            "the directions of this setup. It must touch neither the platform nor a rod.",
            f"Put the bar between the balls. Its dial shows 0 at a length of {length}. {known}. If "
            "the dial comes to an end of its range in a posture, move the fixed ball along the "
            "bar, write its new place into centre_mm, make this sheet again, and begin the setup "
            "again.",
            "Make the bar longer with your hand. The reading must grow. If it falls, enter "
            "every reading of this setup with the opposite sign.",
        )

    def path(
        self, start: Array, end: Array, normal: Array | None = None, *, above: bool = False
    ) -> Array:
        """Corners of a path on which the bar keeps its length: an arc about the fixed ball.

        Args:
            start: First tool centre point, shape (3,), [m].
            end: Last tool centre point, shape (3,), [m].
            normal: Unit normal of the plane in which the tool moves, shape (3,); None for a tool
                that moves in space, along a great arc.
            above: Whether the path must not be lower than its lower end, unlike the shorter arc. In
                space azimuth and elevation then change evenly; in a plane it is the other arc.

        Returns:
            Tool centre points, shape (n, 3), [m]. Chords deviate from the arc by at most `SAGITTA`.
        """
        # from the fixed ball to the ball at the tool
        offset = np.array(self.tool) - np.array(self.centre)
        ends = np.array([start + offset, end + offset])
        if normal is not None:  # the arc is about the foot of the fixed ball in the plane
            height = (ends[0] @ normal) * normal
            ends, offset = ends - height, offset - height
        radii = np.linalg.norm(ends, axis=1)
        first, last = ends / np.maximum(radii, 1e-12)[:, None]
        step = 2.0 * np.arccos(1.0 - min(SAGITTA / radii.max(), 1.0))

        def shares(angle: float) -> Array:
            """Fractions of an arc at which its corners are, shape (n, 1)."""
            return np.linspace(0.0, 1.0, max(math.ceil(angle / step), 1) + 1)[:, None]

        if above and normal is None:
            angles = np.array([[np.arctan2(y, x), np.arcsin(z)] for x, y, z in (first, last)])
            motion = angles[1] - angles[0]
            motion[0] = math.remainder(motion[0], 2.0 * np.pi)  # the shorter way round
            share = shares(float(np.linalg.norm(motion)))
            azimuth, elevation = (angles[0] + share * motion).T
            level = np.cos(elevation)
            unit = np.stack(
                [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1
            )
        else:
            across = last - (first @ last) * first
            if np.linalg.norm(across) < 1e-9:  # equal or opposite: any direction across
                across = np.linalg.svd(first[None])[2][-1]
                if normal is not None:
                    across = np.cross(normal, first)
            across /= np.linalg.norm(across)
            angle = np.arctan2(abs(last @ across), first @ last)  # rounding may be negative
            if above:
                angle -= 2.0 * np.pi  # the other way round
            share = shares(abs(angle))
            unit = np.cos(share * angle) * first + np.sin(share * angle) * across
        return np.asarray((radii[0] + share * (radii[1] - radii[0])) * unit - offset)

    def constants(self, robot: Robot) -> Array:
        """Position of the fixed ball (3), length (1), position of the ball at the tool (3), [m]."""
        del robot
        return np.array([*self.centre, self.length, *self.tool])

    @property
    def dimensions(self) -> Mapping[str, Sensor]:
        """Bar with a length that is larger by DIMENSION_STEP."""
        return {"length_mm": replace(self, length=self.length + DIMENSION_STEP)}

    @property
    def nuisance_parameters(self) -> tuple[NuisanceParameter, ...]:
        """Position of the fixed ball, length and scale, if their standard deviation is above 0."""
        shared = None if self.ball is None else f"ball.{self.ball}"
        parameters = (
            *(
                NuisanceParameter(f"centre_{k}", "m", self.centre_std, shared, nominal=c)
                for k, c in zip("xyz", self.centre, strict=True)
            ),
            NuisanceParameter("length", "m", self.length_std, of_gauge=True, nominal=self.length),
            NuisanceParameter("scale", "1", self.scale_std, of_gauge=True),
        )
        return tuple(p for p in parameters if p.prior_std > 0.0)

    def expression(self, view: View, robot: Robot) -> ca.SX:
        """Reading with the gauge zero at 0, [m]."""
        del robot
        errors = {p.name: view.nuisance[i] for i, p in enumerate(self.nuisance_parameters)}
        centre = view.constants[:3] + ca.vertcat(*(errors.get(f"centre_{k}", 0.0) for k in "xyz"))
        (tool,) = view.frames
        ball = tool.position + tool.rotation @ view.constants[4:7]
        length = view.constants[3] + errors.get("length", 0.0)
        return ca.SX((1.0 + errors.get("scale", 0.0)) * (ca.norm_2(ball - centre) - length))

    def contact(self, frames: Sequence[Array], at_zero: Sequence[Array], robot: Robot) -> Contact:
        """Positions of the ball at the tool in K postures.

        The direction of a growing reading is that of the bar in the first posture.
        """
        del at_zero, robot
        balls = place_point(frames[0], self.tool)
        bars = balls - np.array(self.centre)
        distances = np.linalg.norm(bars, axis=1)
        units = bars / np.maximum(distances, 1e-12)[:, None]
        direction = units[0]
        along = np.linalg.svd(direction[None])[2][-1]
        problems = [
            ""
            if abs(d - self.length) <= 0.5 * self.length
            else f"the balls would be {d / MM:.1f} mm apart; the bar has {show_mm(self.length)} mm"
            for d in distances.tolist()
        ]
        centre = np.array(self.centre)
        return Contact(balls, direction, along, problems, "centre_mm", fixed=centre)
