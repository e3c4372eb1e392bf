"""Machines with three slides and legs of two rods: linear deltas and the Orthoglide family.

Both have the legs of `leg_urdf`; place and direction of the slides differ.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array
from orthocal.builder.leg_urdf import Body, LegGeometry, Shape, machine_urdf
from orthocal.builder.machine_file import in_mm
from orthocal.units import DEG, MM

COLOURS = ("red", "green", "blue")

ORTHOGONAL = math.asin(1.0 / math.sqrt(3.0))
"""Elevation of the slides of an Orthoglide, [rad]."""

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class LinearDelta:
    """Three vertical slides around a bed."""

    rod: float = 0.28
    """Length of a rod, from hinge to hinge, [m]."""
    radius: float = 0.14
    """Horizontal distance of the hinges on a slide from those on the platform, with the tool in the
    middle, [m]: the delta radius of printers."""
    platform: float = 0.03
    """Distance of the tool centre point from the hinges on the platform, [m]."""
    angles: tuple[float, ...] = (210 * DEG, 330 * DEG, 90 * DEG)
    """Directions of the towers from the middle of the bed, [rad]."""
    travel: tuple[float, float] = (0.03, 0.56)
    """Least and largest height of the hinges on a slide above those on the platform when the tool
    is on the bed, [m]."""
    rods_apart: float = 0.05
    rod_radius: float = 0.003

    @property
    def height(self) -> float:
        """Height of a slide in the mechanical zero: tool in the middle, on the bed, [m]."""
        return math.sqrt(self.rod**2 - self.radius**2)

    def legs(self) -> list[LegGeometry]:
        """Legs a, b and c."""
        legs = []
        for name, angle, colour in zip("abc", self.angles, COLOURS, strict=True):
            outwards = np.array([math.cos(angle), math.sin(angle), 0.0])
            frame = np.column_stack([-outwards, UP, np.cross(-outwards, UP)])
            root = (self.radius + self.platform) * outwards + self.height * UP
            tip = self.platform * outwards
            legs.append(
                LegGeometry(name, frame, UP, self.height, root, root, tip, self.travel, colour)
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
        body = Body(self.rods_apart, self.rod_radius, [*towers, bed], plate)
        return machine_urdf(name, self.legs(), body, comment=f"{self.words}.")

    @property
    def words(self) -> str:
        """Dimensions in words, in mm."""
        return f"Linear delta: rods of {in_mm(self.rod)} mm, radius {in_mm(self.radius)} mm"

    def yaml(self) -> str:
        """Loops, drives, legs and parameters."""
        parts = {
            # outwards; X of a slide's frame points to the middle
            "radius": [f"-{k}_slide.x" for k in "abc"],
            **{f"{k}_tower.tangential": [f"{k}_slide.z"] for k in "abc"},
        }
        box = _box([(-0.5, 0.5), (-0.5, 0.5), (0.0, 1.0)], self.radius)
        return machine_yaml(
            self.legs(),
            self.rod_radius,
            title=f"# {self.words}.",
            parameters=parts,
            workspace=box,
            tolerances="offset_mm: 4, translation_mm: 1, rotation_mrad: 5, scale_ppm: 500",
        )


@dataclass(frozen=True, slots=True)
class InclinedOrthoglide:
    """Three slides that rise from a vertical axis by one angle; at 35.26° they are orthogonal."""

    leg: float = 0.31025
    """Length of a leg, [m]."""
    elevation: float = 45 * DEG
    """Angle of the slides above the horizontal plane, [rad]."""
    attachment: float = 0.04
    """Distance from the tool centre point to the hinges on the platform, [m]."""
    travel: tuple[float, float] = (0.12, 0.39)
    """Least and largest coordinate of a slide: the leg length where the legs are parallel to their
    slides, [m]."""
    rods_apart: float = 0.08
    rod_radius: float = 0.0055

    def legs(self) -> list[LegGeometry]:
        """Legs a, b and c, at 0°, 120° and 240° about the vertical axis."""
        legs = []
        for k, (name, colour) in enumerate(zip("abc", COLOURS, strict=True)):
            angle = 2.0 * math.pi * k / 3.0
            level = np.array([math.cos(angle), math.sin(angle), 0.0])
            outwards = math.cos(self.elevation) * level + math.sin(self.elevation) * UP
            z = np.cross(UP, level)
            frame = np.column_stack([-outwards, np.cross(z, -outwards), z])
            slide, tip = self.leg * outwards, self.attachment * outwards
            root = slide + tip
            legs.append(
                LegGeometry(name, frame, outwards, self.leg, slide, root, tip, self.travel, colour)
            )
        return legs

    def urdf(self, name: str) -> str:
        """URDF of the machine."""
        length = self.travel[1] - self.travel[0] + 0.09
        rails = [
            Shape(
                (length, 0.05, 0.018),
                "frame",
                leg.direction * (0.5 * sum(self.travel) + self.attachment) - 0.06 * leg.frame[:, 1],
                leg.frame,
            )
            for leg in self.legs()
        ]
        platform = [Shape((0.034, 0.034, 0.034), "brass"), Shape((0.004,), "brass")]
        body = Body(self.rods_apart, self.rod_radius, rails, platform)
        return machine_urdf(name, self.legs(), body, comment=f"{self.words}.")

    @property
    def words(self) -> str:
        """Dimensions in words, in mm."""
        return (
            f"Orthoglide with slides inclined by {self.elevation / DEG:g}°: legs of "
            f"{in_mm(self.leg)} mm"
        )

    def yaml(self) -> str:
        """Loops, drives, legs and parameters."""
        return machine_yaml(self.legs(), self.rod_radius, title=f"# {self.words}.")


def machine_yaml(
    legs: Sequence[LegGeometry],
    rod_radius: float,
    *,
    title: str,
    parameters: dict[str, list[str]] | None = None,
    workspace: str | None = None,
    tolerances: str = "offset_mm: 10, translation_mm: 0.2, rotation_mrad: 2, scale_ppm: 200",
) -> str:
    """YAML of a machine with the legs of `leg_urdf`.

    Args:
        legs: The legs; the first one carries the platform.
        rod_radius: Radius of a rod, [m].
        title: Comment above it.
        parameters: Named sums besides the lengths of the legs.
        workspace: Limits as YAML.
        tolerances: Tolerances as YAML.
    """
    names = [leg.name for leg in legs]
    others = names[1:]
    loops = [f"  - [{k}_crossbar_end, {k}_rod_b_tip]" for k in names]
    loops += [f"  - [platform, {k}_foot_end]" for k in others]
    kinds = ["3d"] * len(names) + ["6d"] * len(others)
    sums = {
        **(parameters or {}),
        **{f"{k}_leg.length": [f"{k}_coupler.x", f"frame.{k}_rod_b_tip.x"] for k in names},
    }
    lines = [
        title,
        "closed_loop:",
        *loops,
        f"type: [{', '.join(kinds)}]",
        f"name_mot: [{', '.join(f'{k}_slide' for k in names)}]",
        "",
        "orthocal:",
        *([] if workspace is None else [f"  workspace: {{box_mm: {workspace}}}"]),
        "  closures:",
        *(f"    {k}_parallelogram: {{rows: [x, z]}}" for k in names),
        *(f"    {k}_platform: {{}}" for k in others),
        "  drives:",
        *(f"    {leg.name}_slide: {{zero_mm: {in_mm(leg.zero)}}}" for leg in legs),
        "  legs:",
        *(line for k in names for line in _leg_lines(k, in_mm(rod_radius))),
        "  tcp: {frame: tcp, coordinates: [x, y, z]}",
        "  parameters:",
        *(f"    {name}: [{', '.join(members)}]" for name, members in sums.items()),
        f"  tolerances: {{{tolerances}}}",
        "  models:",
        "    offsets: ['*.offset']",
        "    lengths: ['*.offset', '*_leg.length']",
        "    full: complete",
    ]
    return "\n".join(lines) + "\n"


def _leg_lines(name: str, radius: str) -> list[str]:
    """YAML of a leg with two rods of a radius, in mm."""
    return [
        f"    {name}:",
        f"      root: {name}_leg_root",
        f"      tip: {name}_leg_tip",
        "      rods:",
        f"        a: {{root: {name}_bar_a, tip: {name}_coupler, radius_mm: {radius}}}",
        f"        b: {{root: {name}_bar_b, tip: {name}_rod_b_tip, radius_mm: {radius}}}",
    ]


def _box(limits: Sequence[tuple[float, float]], size: float) -> str:
    """Workspace in multiples of a size, whole centimetres, as YAML."""
    box: Array = np.round(np.array(limits) * size / (10 * MM)) * 10.0
    return f"[{', '.join(f'[{low + 0.0:g}, {high + 0.0:g}]' for low, high in box)}]"
