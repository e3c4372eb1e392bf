"""Dimensions of a linear delta."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from orthocal.builder.dimensions import (
    ROD_RADIUS,
    RODS_APART,
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

UP = np.array([0.0, 0.0, 1.0])

MAX_RELATIVE_DISTANCE = 0.95
"""Largest horizontal distance between the hinges of a rod, relative to its length."""

MIN_TOWER_ANGLE = 60.0 * DEG
"""Smallest angle between two towers, [rad]."""

DELTA_MODEL = ("*.offset", "radius", "*_tower.tangential", "*_rod_a.length", "*_rod_b.length")
"""Free errors of the model `delta`: the errors that delta firmware corrects, with all six rods."""

ROUNDING = 1e-9
"""Tolerance for rounding errors, relative to a step or in [rad]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearDelta(Dimensions):
    """Dimensions of three vertical slides around a bed, [m, rad]."""

    rod: float = 0.28
    """Length of a rod, from hinge to hinge."""
    radius: float = 0.14
    """Delta radius: horizontal distance between the hinges on a slide and on the platform, with the
    tool in the middle."""
    angles: tuple[float, ...] = (210 * DEG, 330 * DEG, 90 * DEG)
    """Directions of the towers from the middle of the bed."""
    travel: tuple[float, float] = (0.03, 0.56)
    """Smallest and largest height of the hinges on a slide above those on the platform, with the
    tool on the bed."""
    platform: float = 0.03
    """Horizontal distance of the tool centre point from the hinges on the platform, which are at
    its height."""
    rods_apart: float = 0.05
    rod_radius: float = 0.003

    kind: ClassVar[str] = "linear-delta"
    keys: ClassVar[tuple[Dimension, ...]] = (
        Dimension(
            "rod",
            "Length of a rod, from hinge to hinge, mm",
            "Length of a rod (diagonal), from hinge to hinge.",
        ),
        Dimension(
            "radius",
            "Delta radius: horizontal distance of the hinges on a slide from those on the platform "
            "with the tool in the middle, mm",
            "Delta radius: horizontal distance of the hinges on a slide from those on the\n"
            "platform with the tool in the middle of the bed.",
        ),
        Dimension(
            "angles",
            "Directions of the towers from the middle of the bed, A,B,C, degrees",
            "Directions of the towers from the middle of the bed.",
            unit="deg",
            form="A,B,C",
            usual="210,330,90",
        ),
        Dimension(
            "travel",
            "Lowest and highest position of a slide, LEAST:LARGEST, mm: height of its hinges above "
            "those of the platform on the bed. It is {zero} with the tool in the middle of the bed",
            "Lowest and highest position of a slide: height of its hinges above those of the\n"
            "platform when the tool is on the bed.",
            form="LEAST:LARGEST",
        ),
        Dimension(
            "platform",
            "Horizontal distance of the tool centre point from the hinges on the platform, mm",
            "Horizontal distance of the hinges on the platform from the tool centre point, which\n"
            "is at their height.",
            usual="30",
        ),
        RODS_APART,
        ROD_RADIUS,
    )
    letters: ClassVar[str] = "abc"
    at_zero: ClassVar[str] = "with the tool in the middle of the bed"
    usual_workspace: ClassVar[str] = "half the delta radius to each side, and up to the radius"
    growing: ClassVar[str] = "upwards"
    legs_determine_offsets: ClassVar[bool] = False

    @property
    def zero(self) -> float:
        """Height of a slide with the tool in the middle of the bed (the mechanical zero), [m]."""
        # a dialogue asks for it before both dimensions are known and checked
        return math.sqrt(max(self.rod**2 - self.radius**2, 0.0))

    @property
    def box(self) -> tuple[tuple[float, float], ...]:
        """Limits of the workspace, [m]: the stated ones, or those of a box that the rods reach.

        The box extends about half the radius to each side. Its limits are whole centimetres, or
        whole millimetres in small boxes.
        """
        if self.workspace is not None:
            return self.workspace
        # a corner of the box is √2 half from the middle, and may be opposite a tower
        half = min(
            0.5 * self.radius, (MAX_RELATIVE_DISTANCE * self.rod - self.radius) / math.sqrt(2.0)
        )
        step = 0.01 if half >= 0.05 else 0.001
        half = step * math.floor(half / step + 0.5)
        # a slide is highest with the steepest rod: with the tool in the corner near its tower
        near = max(self.radius - math.sqrt(2.0) * half, 0.0)
        top = min(self.radius, self.travel[1] - math.sqrt(self.rod**2 - near**2))
        top = step * math.floor(top / step + ROUNDING)
        return (-half, half), (-half, half), (0.0, max(top, step))

    def find_problem(self) -> tuple[str, str] | None:
        """Name and problem of the first impossible dimension; None if all are possible."""
        problem = find_length_problem("rod", "rods", self.rod)
        if problem:
            return problem
        if not 0.2 * self.rod <= self.radius <= 0.9 * self.rod:
            return "radius", (
                f"delta radius of {in_mm(self.radius)} mm; expected {in_mm(0.2 * self.rod)} to "
                f"{in_mm(0.9 * self.rod)} mm with rods of {in_mm(self.rod)} mm"
            )
        gaps = [
            abs(math.remainder(a - b, 2.0 * math.pi))
            for i, a in enumerate(self.angles)
            for b in self.angles[:i]
        ]
        if not min(gaps) >= MIN_TOWER_ANGLE - ROUNDING:
            shown = ", ".join(in_unit(a, "deg") for a in self.angles)
            return "angles", (
                f"towers at {shown}°; expected three directions, at least "
                f"{MIN_TOWER_ANGLE / DEG:g}° apart"
            )
        lower, upper = self.travel
        if not 0.0 < lower < self.zero < upper <= self.zero + 20.0 * self.rod:
            return "travel", (
                f"travel from {in_mm(lower)} to {in_mm(upper)} mm; expected it to be above 0 and "
                f"to include {in_mm(self.zero)} mm, the position with the tool in the middle of "
                "the bed"
            )
        if not 0.0 < self.platform <= self.rod:
            return "platform", (
                f"hinges {in_mm(self.platform)} mm from the tool centre point; expected more than "
                f"0, to the rod length, {in_mm(self.rod)} mm"
            )
        return find_rods_problem(self.rods_apart, self.rod_radius, self.rod)

    @property
    def summary(self) -> str:
        """Description of the dimensions, in mm."""
        lower, upper = self.travel
        return (
            f"rods of {in_mm(self.rod)} mm, radius {in_mm(self.radius)} mm, slides "
            f"{in_mm(lower)} to {in_mm(upper)} mm above the platform on the bed"
        )

    def legs(self) -> list[LegGeometry]:
        """Legs a, b and c in the mechanical zero."""
        legs = []
        for name, colour, angle in zip(self.letters, LEG_COLOURS, self.angles, strict=True):
            outwards = np.array([math.cos(angle), math.sin(angle), 0.0])
            frame = np.column_stack([-outwards, UP, np.cross(-outwards, UP)])
            root = (self.radius + self.platform) * outwards + self.zero * UP
            tip = self.platform * outwards
            legs.append(
                LegGeometry(name, frame, UP, self.zero, root, root, tip, self.travel, colour)
            )
        return legs

    def urdf(self, name: str) -> str:
        """URDF of the machine."""
        tower, middle = self.travel[1] + 0.1, 0.5 * self.travel[1]
        towers = [
            Shape(
                (0.02, 0.02, tower),
                "frame",
                (self.radius + self.platform + 0.03) * -leg.frame[:, 0] + middle * UP,
            )
            for leg in self.legs()
        ]
        bed = Shape((0.9 * self.radius, 0.006), "dark", -0.003 * UP)
        plate = [Shape((self.platform, 0.008), "brass", 0.004 * UP), Shape((0.003,), "brass")]
        slider = [Shape((0.03, 0.03, self.rods_apart), "dark")]
        body = Body(self.rods_apart, self.rod_radius, [*towers, bed], slider, plate)
        return machine_urdf(name, self.legs(), body, comment=self.title)

    def yaml(self) -> str:
        """YAML of the machine, with the parameters of delta firmware as named sums."""
        towers = self.letters
        parameters = {
            # positive outwards, because X of a slide's frame points to the middle
            "radius": [f"-{k}_slide.x" for k in towers],
            **{f"{k}_tower.radial": [f"-{k}_slide.x"] for k in towers},
            **{f"{k}_tower.tangential": [f"{k}_slide.z"] for k in towers},
            "rods.length": [
                name for k in towers for name in (f"{k}_coupler.x", f"frame.{k}_rod_b_tip.x")
            ],
            **length_sums(towers),
            # rotation of the effector about the rods of an arm
            **{f"{k}_effector.tilt": [f"{k}_fork.rx"] for k in towers},
            **{f"{k}_rod_a.length": [f"{k}_coupler.x"] for k in towers},
            **{f"{k}_rod_b.length": [f"frame.{k}_rod_b_tip.x"] for k in towers},
        }
        return robot_yaml(
            self,
            loops=platform_loops(towers),
            parameters=parameters,
            models={"delta": DELTA_MODEL},
            bed=0.0,
            tolerances="offset_mm: 4, translation_mm: 1, rotation_mrad: 5, scale_ppm: 500",
        )
