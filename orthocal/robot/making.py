"""A machine of the Orthoglide's kind in other sizes: URDF and YAML, made from the packaged ones.

Leg length, travel, how far a leg's hinge is from slider and platform, and its two rods; everything
else, joints, loops, legs, error parameters and models, is as there.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from lxml import etree

from orthocal.errors import RobotError
from orthocal.files import read_file, write_files
from orthocal.robot.loading import load_robot, packaged_robots
from orthocal.robot.model import Robot
from orthocal.units import MM

PATTERN = "orthoglide"
"""The packaged robot that others are made from."""

AXES = "xyz"

SHORTEST_LEG, LONGEST_LEG = 0.02, 5.0
"""[m]"""

STEEPEST = 0.9
"""Sine of the largest angle that legs turn by at the ends of a drive's travel."""

SLIDER = 0.03
"""From a leg's hinge axis on the slider to the middle of what is drawn of it, less the offset, [m].
"""

RAIL = 0.09
"""What a rail is longer than the travel, [m]."""


@dataclass(frozen=True, slots=True)
class Sizes:
    """Of a machine of the Orthoglide's kind, [m]."""

    leg: float = 0.31025
    """Length of a leg, from hinge to hinge of a rod."""
    lower: float = 0.12
    """Least coordinate of a drive: distance of a leg's root from where the axes meet, plus the
    offset; the leg's own length in the mechanical zero."""
    upper: float = 0.39
    attachment: float = 0.04
    """From slider to hinge, and as much from hinge to tool: cancels out of where the tool is."""
    rods_apart: float = 0.08
    """Distance of the two rods of a leg."""
    rod_radius: float = 0.0055

    def require_machine(self, where: str) -> None:
        """Refuse sizes that make no machine.

        Raises:
            RobotError: Naming the size, in mm.
        """
        leg = self.leg
        problem = None
        if not SHORTEST_LEG <= leg <= LONGEST_LEG:
            problem = (
                f"legs of {_mm(leg)} mm; expected {_mm(SHORTEST_LEG)} to {_mm(LONGEST_LEG)} mm"
            )
        elif not self.lower < leg < self.upper:
            problem = (
                f"travel from {_mm(self.lower)} to {_mm(self.upper)} mm; expected the mechanical "
                f"zero in it, which is at the leg's length, {_mm(leg)} mm"
            )
        elif max(leg - self.lower, self.upper - leg) > STEEPEST * leg:
            problem = (
                f"travel from {_mm(self.lower)} to {_mm(self.upper)} mm; legs of {_mm(leg)} mm "
                f"reach {_mm((1.0 - STEEPEST) * leg)} to {_mm((1.0 + STEEPEST) * leg)} mm"
            )
        elif not 0.0 <= self.attachment <= leg:
            problem = (
                f"an attachment offset of {_mm(self.attachment)} mm; expected 0 to the leg's "
                f"length, {_mm(leg)} mm"
            )
        elif not self.rod_radius > 0.0 or not 2.0 * self.rod_radius < self.rods_apart <= leg:
            problem = (
                f"rods of radius {_mm(self.rod_radius)} mm, {_mm(self.rods_apart)} mm apart; "
                f"expected them to clear each other, within {_mm(leg)} mm"
            )
        if problem:
            raise RobotError(problem, where=where)


def describe_machine(sizes: Sizes, *, name: str, where: str = "sizes") -> dict[str, str]:
    """The files of a machine: name to text.

    Args:
        sizes: Of the machine.
        name: Of its folder and files.
        where: For messages.

    Raises:
        RobotError: If the sizes make no machine.
    """
    sizes.require_machine(where)
    folder = packaged_robots()[PATTERN]
    urdf, description = (
        read_file(folder / f"{PATTERN}.{kind}", error=RobotError) for kind in ("urdf", "yaml")
    )
    return {
        f"{name}.yaml": _describe(description.decode(), sizes),
        f"{name}.urdf": _draw(urdf, sizes),
    }


def make_robot(sizes: Sizes, folder: Path) -> Robot:
    """Write the folder of a machine, and load it.

    Raises:
        RobotError: If the sizes make no machine.
        OrthocalError: If the folder cannot be written.
    """
    write_files(folder, describe_machine(sizes, name=folder.resolve().name))
    return load_robot(folder.resolve())


def _draw(pattern: bytes, sizes: Sizes) -> str:
    """The URDF: every number that a size stands for, by the joint or link that it stands in."""
    parser = etree.XMLParser(resolve_entities=False, no_network=True)
    root = etree.fromstring(pattern, parser)
    half = sizes.rods_apart / 2.0
    joints = {j.get("name"): j for j in root.findall("joint")}
    links = {link.get("name"): link for link in root.findall("link")}

    def place(owner: etree._Element, x: float, y: float, z: float) -> None:
        owner.find("origin").set("xyz", " ".join(_number(v) for v in (x, y, z)))

    def visual(link: str, index: int) -> etree._Element:
        return links[link].findall("visual")[index]

    for k in AXES:
        limit = joints[f"{k}_slide"].find("limit")
        limit.set("lower", _number(sizes.lower))
        limit.set("upper", _number(sizes.upper))
        place(joints[f"{k}_swivel"], -sizes.attachment, 0.0, 0.0)
        place(joints[f"{k}_bar_a"], 0.0, 0.0, half)
        place(joints[f"{k}_bar_b"], 0.0, 0.0, -half)
        place(joints[f"{k}_rod_b_tip_mount"], sizes.leg, 0.0, 0.0)
        place(joints[f"{k}_coupler"], sizes.leg, 0.0, 0.0)
        place(joints[f"{k}_crossbar_end_mount"], 0.0, 0.0, -sizes.rods_apart)
        place(joints[f"{k}_leg_tip_mount"], 0.0, 0.0, -half)
        place(joints[f"{k}_wrist"], 0.0, 0.0, -half)
        place(visual(f"{k}_slider", 0), -sizes.attachment - SLIDER, 0.036, 0.0)
        place(visual(f"{k}_slider", 1), -sizes.attachment - 0.005, 0.012, 0.0)
        _set_cylinder(visual(f"{k}_yoke", 0), length=sizes.rods_apart + 0.03)
        for rod in "ab":
            body, near, far = (visual(f"{k}_rod_{rod}", i) for i in range(3))
            place(body, sizes.leg / 2.0, 0.0, 0.0)
            _set_cylinder(body, length=sizes.leg, radius=sizes.rod_radius)
            place(far, sizes.leg, 0.0, 0.0)
            for joint in (near, far):
                _set_cylinder(
                    joint, length=4.0 * sizes.rod_radius, radius=sizes.rod_radius + 0.0035
                )
        place(visual(f"{k}_crossbar", 0), 0.0, 0.0, -half)
        _set_cylinder(visual(f"{k}_crossbar", 0), length=sizes.rods_apart + 0.02)
    for mount in ("platform_mount", "y_foot_end_mount", "z_foot_end_mount"):
        place(joints[mount], sizes.attachment, 0.0, 0.0)
    middle = 0.5 * (sizes.lower + sizes.upper) + sizes.attachment + SLIDER
    rail = sizes.upper - sizes.lower + RAIL
    for i in range(3):
        origin = visual("base", i).find("origin")
        places = origin.get("xyz").split()
        places[i] = _number(middle)
        origin.set("xyz", " ".join(places))
        box = visual("base", i).find("geometry/box")
        box.set("size", re.sub(r"0\.36\b", _number(rail), box.get("size")))
    text = str(etree.tostring(root, encoding="unicode"))
    return f'<?xml version="1.0"?>\n<!-- {_words(sizes)} -->\n{text}\n'


def _describe(pattern: str, sizes: Sizes) -> str:
    """The YAML: zeros and radii in mm, and where the sizes stand."""
    leg, radius = _mm(sizes.leg), _mm(sizes.rod_radius)
    text = re.sub(r"zero_mm: [0-9.]+", f"zero_mm: {leg}", pattern)
    text = re.sub(r"radius_mm: [0-9.]+", f"radius_mm: {radius}", text)
    head = f"# {_words(sizes)}\n# Sizes stand in the URDF, too.\n"
    return head + text


def _words(sizes: Sizes) -> str:
    return (
        f"A machine of the Orthoglide's kind: legs of {_mm(sizes.leg)} mm, travel "
        f"{_mm(sizes.lower)} to {_mm(sizes.upper)} mm, attachment offset "
        f"{_mm(sizes.attachment)} mm, rods of radius {_mm(sizes.rod_radius)} mm, "
        f"{_mm(sizes.rods_apart)} mm apart."
    )


def _set_cylinder(visual: etree._Element, *, length: float, radius: float | None = None) -> None:
    cylinder = visual.find("geometry/cylinder")
    cylinder.set("length", _number(length))
    if radius is not None:
        cylinder.set("radius", _number(radius))


def _number(value: float) -> str:
    return f"{round(value, 12) + 0.0:.12g}"


def _mm(value: float) -> str:
    return f"{round(value / MM, 9):.9g}"
