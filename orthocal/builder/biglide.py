"""Dimensions of a biglide, the planar counterpart of the Orthoglide."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from orthocal.arrays import Array
from orthocal.builder.dimensions import (
    ATTACHMENT,
    LEG,
    ROD_RADIUS,
    TRAVEL,
    Dimension,
    in_mm,
)
from orthocal.builder.leg_urdf import Body, Shape, planar_urdf
from orthocal.builder.orthoglide import DRAWN_PLATFORM, DRAWN_SLIDE, SlidingLegs
from orthocal.builder.robot_yaml import (
    ONE_ROD,
    TWO_RODS,
    Loop,
    length_sums,
    parallelogram_loop,
    robot_yaml,
)

PLANAR_ROWS = ("x", "z")
"""Rows of a planar loop closure in the frame of a leg, whose Y is normal to the plane."""

PLATE = np.array([0.02, 0.02, 0.012])
"""Widths and thickness of a drawn arm of the platform, without its length, [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Biglide(SlidingLegs):
    """Dimensions of two crossed slides with legs that move the tool in their plane, [m].

    Legs of one rod have `rods_apart` 0.
    """

    attachment: float = 0.06

    kind: ClassVar[str] = "biglide"
    keys: ClassVar[tuple[Dimension, ...]] = (
        LEG,
        TRAVEL,
        ATTACHMENT,
        Dimension(
            "rods_apart",
            "Distance between the two rods of a leg, from axis to axis, mm; 0 for legs of one rod",
            "The two rods of a leg, from axis to axis; 0 for legs of one rod.",
        ),
        ROD_RADIUS,
    )
    letters: ClassVar[str] = "xy"
    coordinates: ClassVar[str] = "xy"

    @property
    def single(self) -> bool:
        """True if a leg has one rod."""
        return self.rods_apart == 0.0

    def find_problem(self) -> tuple[str, str] | None:
        """Name and problem of the first impossible dimension; None if all are possible."""
        if not self.single:
            return SlidingLegs.find_problem(self)
        # a plausible distance in place of the 0, because a single rod has no other one beside it
        apart = 4.0 * abs(self.rod_radius)
        problem = SlidingLegs.find_problem(replace(self, rods_apart=apart))
        if problem is None and self.attachment:
            return "rods_apart", (
                "legs of one rod meet in the tool centre point, but their hinges are "
                f"{in_mm(self.attachment)} mm from it; change one of both"
            )
        return problem

    def frames(self) -> list[Array]:
        """Frames of the slides along x and y, with Y downwards, shape (3, 3) each."""
        axes = np.eye(3)
        return [np.column_stack([-a, -axes[2], np.cross(-a, -axes[2])]) for a in axes[:2]]

    def urdf(self, name: str) -> str:
        """URDF of the machine."""
        apart, radius = self.rods_apart, self.rod_radius
        pin = Shape((radius + 0.002, 0.05), "steel")
        arms = [
            Shape(tuple(np.abs(leg.tip) + PLATE), "brass", 0.5 * leg.tip) for leg in self.legs()
        ]
        ball = DRAWN_PLATFORM[-1]
        platform = (ball, pin) if self.single else (*arms, ball, pin)
        body = Body(apart, radius, self.rails(), DRAWN_SLIDE, platform)
        return planar_urdf(name, self.legs(), body, comment=self.title)

    def yaml(self) -> str:
        """YAML of the machine."""
        if self.single:
            loops = [Loop("platform", ("platform", "y_end"), "6d", ("x", "y", "rz"))]
            sums = {"x_leg.length": ["x_end.x"], "y_leg.length": ["-frame.y_end.y"]}
        else:
            loops = [parallelogram_loop(k) for k in self.letters]
            loops.append(Loop("platform", ("y_leg_tip", "y_pin"), "3d", PLANAR_ROWS))
            sums = length_sums(self.letters)
        return robot_yaml(
            self,
            loops=loops,
            parameters=sums,
            tip="{k}_end" if self.single else "{k}_leg_tip",
            rods=ONE_ROD if self.single else TWO_RODS,
        )
