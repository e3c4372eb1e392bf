"""Dimensions of the Orthoglide, and of an Orthoglide with inclined slides."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from orthocal.arrays import Array
from orthocal.builder.dimensions import (
    ATTACHMENT,
    LEG,
    ROD_RADIUS,
    RODS_APART,
    TRAVEL,
    Dimension,
    Dimensions,
    find_length_problem,
    find_rods_problem,
    in_mm,
    in_unit,
)
from orthocal.builder.leg_urdf import LEG_COLOURS, Body, LegGeometry, Shape, machine_urdf
from orthocal.builder.robot_yaml import length_sums, platform_loops, robot_yaml
from orthocal.units import DEG

MAX_SINE = 0.9
"""Sine of the largest angle between a leg and its axis at the ends of a drive's travel."""

SLIDER_DISTANCE = 0.03
"""Distance from a leg's hinge on the slide to the centre of the drawn slide, [m]."""

RAIL_OVERHANG = 0.09
"""Length of a rail minus the travel, [m]."""

MIN_ELEVATION, MAX_ELEVATION = 20.0 * DEG, 70.0 * DEG
"""Limits of the elevation of the slides of an inclined Orthoglide, [rad]."""

FEET = "Feet of the rails, made from machine.yaml until this line is removed."
"""Comment above the adjustments of a machine if its feet depend on the dimensions."""

DRAWN_SLIDE = (
    Shape((0.07, 0.03, 0.06), "dark", np.array([-SLIDER_DISTANCE, 0.036, 0.0])),
    Shape((0.02, 0.03, 0.034), "dark", np.array([-0.005, 0.012, 0.0])),
)
"""Shapes of a slide, in its frame relative to the middle of its hinge."""

DRAWN_FOOT = Shape((0.028, 0.018, 0.018), "dark", np.array([0.014, 0.0, 0.0]))
"""Shape of a foot, in the leg's frame."""

DRAWN_PLATFORM = (Shape((0.034, 0.034, 0.034), "brass"), Shape((0.004,), "brass"))
"""Shapes of the platform and of a ball at the tool centre point, in the tool's frame."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SlidingLegs(Dimensions):
    """Dimensions of a machine with legs parallel to their slides in the mechanical zero, [m]."""

    leg: float = 0.31025
    """Length of a leg, from hinge to hinge of a rod."""
    travel: tuple[float, float] = (0.12, 0.39)
    """Smallest and largest drive coordinate. It is the distance of a leg's root from the
    intersection of the drive axes minus the attachment: the leg length in the mechanical zero."""
    attachment: float = 0.04
    """Distance from the tool centre point to the hinges on the platform, along the axis."""

    @property
    def zero(self) -> float:
        """Coordinate of the slides in the mechanical zero, [m]."""
        return self.leg

    def find_problem(self) -> tuple[str, str] | None:
        """Name and problem of the first impossible dimension; None if all are possible."""
        problem = find_length_problem("leg", "legs", self.leg)
        if problem:
            return problem
        leg, (lower, upper) = self.leg, self.travel
        travel = f"travel from {in_mm(lower)} to {in_mm(upper)} mm"
        if lower >= upper:
            return "travel", f"{travel}; expected the lowest coordinate first"
        if not lower < leg < upper:
            return "travel", (
                f"{travel} does not include {in_mm(leg)} mm, the leg length, where the mechanical "
                "zero is; check both numbers"
            )
        if max(leg - lower, upper - leg) > MAX_SINE * leg:
            return "travel", (
                f"{travel}; legs of {in_mm(leg)} mm reach {in_mm((1.0 - MAX_SINE) * leg)} to "
                f"{in_mm((1.0 + MAX_SINE) * leg)} mm"
            )
        if not 0.0 <= self.attachment <= leg:
            return "attachment", (
                f"hinges {in_mm(self.attachment)} mm from the tool centre point; expected 0 to the "
                f"leg length, {in_mm(leg)} mm"
            )
        return find_rods_problem(self.rods_apart, self.rod_radius, leg)

    @property
    def summary(self) -> str:
        """Description of the dimensions, in mm."""
        return self.summary_of_legs()

    def summary_of_legs(self) -> str:
        """Description of the dimensions of slides and legs, in mm."""
        lower, upper = self.travel
        return (
            f"legs of {in_mm(self.leg)} mm, travel {in_mm(lower)} to {in_mm(upper)} mm, "
            f"hinges {in_mm(self.attachment)} mm from the tool centre point, rods of radius "
            f"{in_mm(self.rod_radius)} mm, {in_mm(self.rods_apart)} mm apart"
        )

    @abstractmethod
    def frames(self) -> list[Array]:
        """Frames of the slides, shape (3, 3) each: X from slide to tool, Z that of the leg."""

    def legs(self) -> list[LegGeometry]:
        """Legs in the mechanical zero."""
        legs = []
        # a biglide has two legs, fewer than colours
        for name, colour, frame in zip(self.letters, LEG_COLOURS, self.frames(), strict=False):
            outwards = -frame[:, 0]
            slide, tip = self.leg * outwards, self.attachment * outwards
            root = slide + tip
            legs.append(
                LegGeometry(name, frame, outwards, self.leg, slide, root, tip, self.travel, colour)
            )
        return legs

    def rails(self) -> list[Shape]:
        """Drawn shapes of the rails."""
        middle, length = self.rail
        return [
            Shape(
                (length, 0.018, 0.05),
                "frame",
                leg.direction * middle + 0.062 * leg.frame[:, 1],
                leg.frame,
            )
            for leg in self.legs()
        ]

    @property
    def rail(self) -> tuple[float, float]:
        """Position of a drawn rail's middle along its axis, and its length, [m]."""
        lower, upper = self.travel
        middle = 0.5 * (lower + upper) + self.attachment + SLIDER_DISTANCE
        return middle, upper - lower + RAIL_OVERHANG

    def drawn_platform(self) -> Sequence[Shape]:
        """Shapes of the platform in the tool's frame."""
        return DRAWN_PLATFORM

    def urdf(self, name: str) -> str:
        """URDF of the machine."""
        body = Body(
            self.rods_apart,
            self.rod_radius,
            self.rails(),
            DRAWN_SLIDE,
            self.drawn_platform(),
            DRAWN_FOOT,
        )
        return machine_urdf(name, self.legs(), body, comment=self.title)

    def yaml(self) -> str:
        """YAML of the machine."""
        return robot_yaml(
            self, loops=platform_loops(self.letters), parameters=length_sums(self.letters)
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Orthoglide(SlidingLegs):
    """Dimensions of an Orthoglide with slides along x, y and z, [m]."""

    kind: ClassVar[str] = "orthoglide"
    keys: ClassVar[tuple[Dimension, ...]] = (LEG, TRAVEL, ATTACHMENT, RODS_APART, ROD_RADIUS)
    letters: ClassVar[str] = "xyz"

    def frames(self) -> list[Array]:
        """Frames of the slides; Z is the axis before that of the slide in the cycle x, y, z."""
        axes = np.eye(3)
        return [
            np.column_stack([-axes[i], np.cross(axes[i - 1], -axes[i]), axes[i - 1]])
            for i in range(3)
        ]

    def drawn_platform(self) -> Sequence[Shape]:
        """Shapes of a platform with a spindle."""
        box, ball = DRAWN_PLATFORM
        return box, Shape((0.006, 0.04), "steel", np.full(3, -0.025)), ball

    def adjustments(self) -> str:
        """Adjustments at both ends of each rail, across it, and at one of its sides, as YAML."""
        middle, length = self.rail
        inner, outer = middle - 0.5 * length, middle + 0.5 * length
        half = 0.5 * self.rods_apart

        def point(axis: int, along: float, beside: float = 0.0) -> str:
            """Point on the axis of a rail, or beside it along the next axis, [m]."""
            values = [0.0, 0.0, 0.0]
            values[axis] = along
            values[(axis + 1) % 3] = beside
            return f"[{', '.join(in_mm(v) for v in values)}]"

        def unit(axis: int) -> str:
            """Unit vector of an axis."""
            return f"[{', '.join('1' if k == axis else '0' for k in range(3))}]"

        lines = []
        for axis, letter in enumerate(self.letters):
            moves = f"{{moves: {letter}_slide, at_mm:"
            for end, position, pivot in (("inner", inner, outer), ("outer", outer, inner)):
                for k in ((axis + 1) % 3, (axis + 2) % 3):
                    lines.append(
                        f"{letter}_{end}_foot_{self.letters[k]}: {moves} {point(axis, position)}, "
                        f"direction: {unit(k)}, pivot_mm: {point(axis, pivot)}}}"
                    )
            side, other = (point(axis, 0.5 * (inner + outer), s * half) for s in (1.0, -1.0))
            k = (axis + 2) % 3
            lines.append(
                f"{letter}_side_foot_{self.letters[k]}: {moves} {side}, direction: {unit(k)}, "
                f"pivot_mm: {other}}}"
            )
        body = "".join(f"    {line}\n" for line in lines)
        return (
            f"  # {FEET}\n"
            "  # Shims move the ends of a rail, and raise one of its sides, as far apart as two "
            f"rods.\n  adjustments:\n{body}"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class InclinedOrthoglide(SlidingLegs):
    """Dimensions of three slides around a vertical axis with equal elevation, [m, rad]."""

    elevation: float = 45 * DEG
    """Angle of the slides above the horizontal plane; at 35.26° they are orthogonal."""

    kind: ClassVar[str] = "inclined-orthoglide"
    keys: ClassVar[tuple[Dimension, ...]] = (
        Dimension(
            "elevation",
            "Angle of the slides above the horizontal plane, degrees",
            "Angle of the slides above the horizontal plane; at 35.264 they are orthogonal.",
            unit="deg",
        ),
        LEG,
        TRAVEL,
        ATTACHMENT,
        RODS_APART,
        ROD_RADIUS,
    )
    letters: ClassVar[str] = "abc"

    def find_problem(self) -> tuple[str, str] | None:
        """Name and problem of the first impossible dimension; None if all are possible."""
        if not MIN_ELEVATION <= self.elevation <= MAX_ELEVATION:
            return "elevation", (
                f"slides at {in_unit(self.elevation, 'deg')}°; expected {MIN_ELEVATION / DEG:g} to "
                f"{MAX_ELEVATION / DEG:g}°"
            )
        return SlidingLegs.find_problem(self)

    @property
    def summary(self) -> str:
        """Description of the dimensions, in mm and degrees."""
        angle = in_unit(self.elevation, "deg")
        return f"slides at {angle}°, {self.summary_of_legs()}"

    def frames(self) -> list[Array]:
        """Frames of the slides, at 0°, 120° and 240° about the vertical axis; Z is horizontal."""
        up, frames = np.array([0.0, 0.0, 1.0]), []
        for k in range(3):
            angle = 2.0 * math.pi * k / 3.0
            level = np.array([math.cos(angle), math.sin(angle), 0.0])
            outwards = math.cos(self.elevation) * level + math.sin(self.elevation) * up
            z = np.cross(up, level)
            frames.append(np.column_stack([-outwards, np.cross(z, -outwards), z]))
        return frames
