"""URDF of a machine with three slides and legs of two parallel rods that carry a platform.

The legs are those of the Orthoglide: prismatic slide, swivel, a parallelogram of two rods, wrist
and fork. Slides may have any place and direction. The platform hangs on the first leg; loop
closures join it to the others.

Frames of a leg: Z along the two hinge axes that are as far apart as the rods; X from the hinge on
the slide to the hinge on the platform; Y = Z × X.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
from lxml import etree

from orthocal.arrays import Array

COLOURS = {
    "frame": (0.36, 0.38, 0.42),
    "steel": (0.72, 0.74, 0.78),
    "dark": (0.20, 0.21, 0.24),
    "brass": (0.83, 0.66, 0.28),
    "red": (0.80, 0.27, 0.22),
    "green": (0.25, 0.58, 0.32),
    "blue": (0.22, 0.41, 0.75),
}

QUARTER = 0.5 * np.pi

LIMITS = {"effort": 1000.0, "velocity": 2.0}


@dataclass(frozen=True, slots=True, eq=False)
class LegGeometry:
    """A leg and its slide in the mechanical zero, in the world."""

    name: str
    frame: Array
    """Axes of the slide's frame as columns, shape (3, 3); its Z is that of the leg."""
    direction: Array
    """Unit vector in which the slide moves as its coordinate grows, shape (3,)."""
    zero: float
    """Coordinate of the slide, [m]."""
    slide: Array
    """Origin of the slide's frame, shape (3,), [m]."""
    root: Array
    """Middle of the hinge on the slide, shape (3,), [m]."""
    tip: Array
    """Middle of the hinge on the platform, shape (3,), [m]."""
    travel: tuple[float, float]
    """Least and largest coordinate of the slide, [m]."""
    colour: str = "red"

    @property
    def axes(self) -> Array:
        """Axes of the leg's frame as columns, shape (3, 3)."""
        x = (self.tip - self.root) / np.linalg.norm(self.tip - self.root)
        z = self.frame[:, 2]
        return np.column_stack([x, np.cross(z, x), z])

    @property
    def length(self) -> float:
        """Length of its rods, [m]."""
        return float(np.linalg.norm(self.tip - self.root))


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """A drawn box, cylinder or sphere of a link."""

    sizes: tuple[float, ...]
    """Edges of a box (3), radius and length of a cylinder along Z (2), radius of a sphere (1)."""
    material: str
    at: Array = field(default_factory=lambda: np.zeros(3))
    turned: Array = field(default_factory=lambda: np.eye(3))


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """Dimensions of the rods, and what is drawn of base and platform."""

    rods_apart: float
    rod_radius: float
    base: Sequence[Shape]
    """In the world."""
    platform: Sequence[Shape]
    """In the tool's frame, which is parallel to the world."""


def machine_urdf(name: str, legs: Sequence[LegGeometry], body: Body, *, comment: str) -> str:
    """URDF of a machine whose tool centre point is at the origin in the mechanical zero.

    Args:
        name: Name of the robot.
        legs: Its legs; the first one carries the platform.
        body: Rods and drawings.
        comment: First line.
    """
    root = etree.Element("robot", name=name)
    for colour, rgb in COLOURS.items():
        material = etree.SubElement(root, "material", name=colour)
        etree.SubElement(material, "color", rgba=_numbers([*rgb, 1.0]))
    _link(root, "base", body.base)
    for i, leg in enumerate(legs):
        _add_leg(root, leg, body, end=i > 0)
    _link(root, "platform", body.platform)
    first = legs[0]
    _fixed(root, "platform_mount", f"{first.name}_foot", "platform", _to_tool(first))
    _link(root, "tcp")
    _fixed(root, "tcp_mount", "platform", "tcp", (np.zeros(3), np.eye(3)))
    etree.indent(root)
    text = str(etree.tostring(root, encoding="unicode"))
    return f'<?xml version="1.0"?>\n<!-- {comment} -->\n{text}\n'


def _add_leg(root: etree._Element, leg: LegGeometry, body: Body, *, end: bool) -> None:
    """Slide and leg; with `end`, the frame that a loop closure joins to the platform."""
    k, half, length = leg.name, 0.5 * body.rods_apart, leg.length
    inwards = leg.frame.T @ leg.direction
    origin = leg.slide - leg.zero * leg.direction
    across = pin.rpy.rpyToMatrix(QUARTER, 0.0, 0.0)
    lying = pin.rpy.rpyToMatrix(0.0, QUARTER, 0.0)
    r = body.rod_radius
    hinge = (r + 0.0035, 4.0 * r)
    rod = [
        Shape((r, length), leg.colour, np.array([0.5 * length, 0.0, 0.0]), lying),
        Shape(hinge, "steel", turned=across),
        Shape(hinge, "steel", np.array([length, 0.0, 0.0]), across),
    ]
    to_root = leg.frame.T @ (leg.root - leg.slide)
    slider = [Shape((0.03, 0.03, body.rods_apart), "dark", 0.5 * to_root)]
    yoke = [Shape((0.01, body.rods_apart + 0.03), "steel"), Shape((0.014, 0.022), "dark")]
    crossbar = [Shape((0.009, body.rods_apart + 0.02), "steel", np.array([0.0, 0.0, -half]))]
    tip = np.array([length, 0.0, 0.0])
    up, down = np.array([0.0, 0.0, half]), np.array([0.0, 0.0, -half])

    _link(root, f"{k}_slider", slider)
    _joint(
        root,
        f"{k}_slide",
        "prismatic",
        ("base", f"{k}_slider"),
        (origin, leg.frame),
        inwards,
        leg.travel,
    )
    _link(root, f"{k}_yoke", yoke)
    turned = leg.frame.T @ leg.axes
    y, z = np.eye(3)[1], np.eye(3)[2]
    _hinge(root, f"{k}_swivel", f"{k}_slider", f"{k}_yoke", (to_root, turned), z)
    for name, side in (("a", up), ("b", down)):
        _link(root, f"{k}_rod_{name}", rod)
        _hinge(root, f"{k}_bar_{name}", f"{k}_yoke", f"{k}_rod_{name}", (side, np.eye(3)), y)
    _mounted(root, f"{k}_rod_b_tip", f"{k}_rod_b", tip)
    _link(root, f"{k}_crossbar", crossbar)
    _hinge(root, f"{k}_coupler", f"{k}_rod_a", f"{k}_crossbar", (tip, np.eye(3)), y)
    _mounted(root, f"{k}_crossbar_end", f"{k}_crossbar", 2.0 * down)
    _mounted(root, f"{k}_leg_root", f"{k}_yoke", np.zeros(3))
    _mounted(root, f"{k}_leg_tip", f"{k}_crossbar", down)
    _link(root, f"{k}_knuckle", [Shape((0.012, 0.024), "dark")])
    _hinge(root, f"{k}_wrist", f"{k}_crossbar", f"{k}_knuckle", (down, np.eye(3)), z)
    _link(root, f"{k}_foot", [Shape((0.018, 0.018, 0.018), "dark")])
    _hinge(root, f"{k}_fork", f"{k}_knuckle", f"{k}_foot", (np.zeros(3), np.eye(3)), y)
    if end:
        _link(root, f"{k}_foot_end")
        _fixed(root, f"{k}_foot_end_mount", f"{k}_foot", f"{k}_foot_end", _to_tool(leg))


def _to_tool(leg: LegGeometry) -> tuple[Array, Array]:
    """Tool centre point and axes of the world, in the frame of the leg's foot."""
    return -leg.axes.T @ leg.tip, leg.axes.T


def _link(root: etree._Element, name: str, shapes: Sequence[Shape] = ()) -> None:
    link = etree.SubElement(root, "link", name=name)
    for shape in shapes:
        visual = etree.SubElement(link, "visual")
        _origin(visual, shape.at, shape.turned)
        geometry = etree.SubElement(visual, "geometry")
        if len(shape.sizes) == 3:
            etree.SubElement(geometry, "box", size=_numbers(shape.sizes))
        elif len(shape.sizes) == 2:
            radius, length = map(_number, shape.sizes)
            etree.SubElement(geometry, "cylinder", radius=radius, length=length)
        else:
            etree.SubElement(geometry, "sphere", radius=_number(shape.sizes[0]))
        etree.SubElement(visual, "material", name=shape.material)


def _mounted(root: etree._Element, name: str, parent: str, at: Array) -> None:
    """Link without extent that is fixed to another, with its axes."""
    _link(root, name)
    _fixed(root, f"{name}_mount", parent, name, (at, np.eye(3)))


def _fixed(
    root: etree._Element, name: str, parent: str, child: str, place: tuple[Array, Array]
) -> None:
    joint = etree.SubElement(root, "joint", name=name, type="fixed")
    etree.SubElement(joint, "parent", link=parent)
    etree.SubElement(joint, "child", link=child)
    _origin(joint, *place)


def _hinge(
    root: etree._Element,
    name: str,
    parent: str,
    child: str,
    place: tuple[Array, Array],
    axis: Array,
) -> None:
    _joint(root, name, "revolute", (parent, child), place, axis, (-1.3, 1.3))


def _joint(
    root: etree._Element,
    name: str,
    kind: str,
    links: tuple[str, str],
    place: tuple[Array, Array],
    axis: Array,
    limits: tuple[float, float],
) -> None:
    joint = etree.SubElement(root, "joint", name=name, type=kind)
    etree.SubElement(joint, "parent", link=links[0])
    etree.SubElement(joint, "child", link=links[1])
    _origin(joint, *place)
    etree.SubElement(joint, "axis", xyz=_numbers(axis))
    low, high = map(_number, limits)
    others = {key: _number(v) for key, v in LIMITS.items()}
    etree.SubElement(joint, "limit", lower=low, upper=high, **others)


def _origin(owner: etree._Element, at: Array, turned: Array) -> None:
    rpy = pin.rpy.matrixToRpy(turned)
    etree.SubElement(
        owner, "origin", xyz=_numbers(at), rpy=" ".join(f"{v + 0.0:.17g}" for v in rpy)
    )


def _numbers(values: Sequence[float] | Array) -> str:
    return " ".join(_number(float(v)) for v in values)


def _number(value: float) -> str:
    return f"{round(value, 15) + 0.0:.15g}"
