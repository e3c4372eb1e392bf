"""URDF of a machine with slides and legs of rods that carry a platform.

Legs of the Orthoglide have a slide, a swivel, a parallelogram of two rods, a wrist and a fork.
Planar legs have a slide and a parallelogram, or a slide and one rod. Slides may have any place and
direction. The platform hangs on the first leg; loop closures join it to the others.

Frames of a leg: Z along the two hinge axes that are as far apart as the rods; X from the hinge on
the slide to the hinge on the platform; Y = Z × X, the axis of the rods' hinges.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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

LEG_COLOURS = ("red", "green", "blue")

QUARTER = 0.5 * np.pi

ROUNDING = 1e-14
"""Largest rounding error of an angle, [rad]."""

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


FOOT = Shape((0.018, 0.018, 0.018), "dark")


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """Dimensions of the rods, and what is drawn of base, slides and platform."""

    rods_apart: float
    rod_radius: float
    base: Sequence[Shape]
    """In the world."""
    slider: Sequence[Shape]
    """In the slide's frame, from the middle of its hinge."""
    platform: Sequence[Shape]
    """In the tool's frame, which is parallel to the world."""
    foot: Shape = FOOT
    """Hinge on the platform, in the leg's frame."""


def coloured(letters: str) -> Iterable[tuple[str, str]]:
    """Names of legs with their colours."""
    return zip(letters, LEG_COLOURS, strict=False)


def machine_urdf(name: str, legs: Sequence[LegGeometry], body: Body, *, comment: str) -> str:
    """URDF of a machine whose tool centre point is at the origin in the mechanical zero.

    Args:
        name: Name of the robot.
        legs: Its legs; the first one carries the platform.
        body: Rods and drawings.
        comment: First line.
    """
    root = _robot(name, body)
    first = legs[0]
    for leg in legs:
        _add_leg(root, leg, body)
        if leg is not first:
            k = leg.name
            _link(root, f"{k}_foot_end")
            _fixed(root, f"{k}_foot_end_mount", f"{k}_foot", f"{k}_foot_end", _to_tool(leg))
    _add_platform(root, f"{first.name}_foot", first, body)
    return _text(root, comment)


def planar_urdf(name: str, legs: Sequence[LegGeometry], body: Body, *, comment: str) -> str:
    """URDF of a machine whose legs move in a plane, of two rods or, if these are 0 apart, of one.

    Legs of two rods keep the platform from turning: the first one carries it, the others end in
    pins on it. Of legs of one rod, the last one carries the platform, and the first one ends in a
    pin on it, the tool centre point.

    Args:
        name: Name of the robot.
        legs: Its legs.
        body: Rods and drawings.
        comment: First line.
    """
    root = _robot(name, body)
    first, *others = legs
    if body.rods_apart:
        for leg in legs:
            _add_slide(root, leg, body)
            k = leg.name
            _link(root, f"{k}_yoke", _yoke(body))
            _fixed(root, f"{k}_yoke_mount", f"{k}_slider", f"{k}_yoke", _root(leg))
            _add_parallelogram(root, leg, body)
        _add_platform(root, f"{first.name}_leg_tip", first, body)
        for leg in others:
            _mounted(root, f"{leg.name}_pin", "platform", leg.tip)
        return _text(root, comment)
    for leg in legs:
        k = leg.name
        _add_slide(root, leg, body)
        _link(root, f"{k}_leg_root")
        _fixed(root, f"{k}_leg_root_mount", f"{k}_slider", f"{k}_leg_root", _root(leg))
        _link(root, f"{k}_rod", _rod(leg, body))
        _hinge(root, f"{k}_bar", f"{k}_slider", f"{k}_rod", _root(leg), np.eye(3)[1])
        _link(root, f"{k}_foot")
        end = np.array([leg.length, 0.0, 0.0]), np.eye(3)
        if leg is first:
            _hinge(root, f"{k}_end", f"{k}_rod", f"{k}_foot", end, np.eye(3)[1])
            continue
        _fixed(root, f"{k}_foot_mount", f"{k}_rod", f"{k}_foot", end)
        _link(root, f"{k}_end")
        _fixed(root, f"{k}_end_mount", f"{k}_foot", f"{k}_end", _to_tool(leg))
    _add_platform(root, f"{first.name}_foot", first, body)
    return _text(root, comment)


def _robot(name: str, body: Body) -> etree._Element:
    """Robot with materials and base."""
    root = etree.Element("robot", name=name)
    for colour, rgb in COLOURS.items():
        material = etree.SubElement(root, "material", name=colour)
        etree.SubElement(material, "color", rgba=_numbers([*rgb, 1.0]))
    _link(root, "base", body.base)
    return root


def _text(root: etree._Element, comment: str) -> str:
    etree.indent(root)
    text = str(etree.tostring(root, encoding="unicode"))
    return f'<?xml version="1.0"?>\n<!-- {comment} -->\n{text}\n'


def _add_platform(root: etree._Element, parent: str, leg: LegGeometry, body: Body) -> None:
    """Platform and tool centre point, on the frame in which a leg ends."""
    _link(root, "platform", body.platform)
    _fixed(root, "platform_mount", parent, "platform", _to_tool(leg))
    _link(root, "tcp")
    _fixed(root, "tcp_mount", "platform", "tcp", (np.zeros(3), np.eye(3)))


def _add_leg(root: etree._Element, leg: LegGeometry, body: Body) -> None:
    """Slide and leg in space."""
    k = leg.name
    y, z = np.eye(3)[1], np.eye(3)[2]
    _add_slide(root, leg, body)
    _link(root, f"{k}_yoke", _yoke(body))
    _hinge(root, f"{k}_swivel", f"{k}_slider", f"{k}_yoke", _root(leg), z)
    _add_parallelogram(root, leg, body)
    _link(root, f"{k}_knuckle", [Shape((0.012, 0.024), "dark")])
    down = np.array([0.0, 0.0, -0.5 * body.rods_apart])
    _hinge(root, f"{k}_wrist", f"{k}_crossbar", f"{k}_knuckle", (down, np.eye(3)), z)
    _link(root, f"{k}_foot", [body.foot])
    _hinge(root, f"{k}_fork", f"{k}_knuckle", f"{k}_foot", (np.zeros(3), np.eye(3)), y)


def _add_slide(root: etree._Element, leg: LegGeometry, body: Body) -> None:
    k, (to_root, _) = leg.name, _root(leg)
    slider = [Shape(s.sizes, s.material, to_root + s.at, s.turned) for s in body.slider]
    _link(root, f"{k}_slider", slider)
    _joint(
        root,
        f"{k}_slide",
        "prismatic",
        ("base", f"{k}_slider"),
        (leg.slide - leg.zero * leg.direction, leg.frame),
        leg.frame.T @ leg.direction,
        leg.travel,
    )


def _add_parallelogram(root: etree._Element, leg: LegGeometry, body: Body) -> None:
    """Two rods between yoke and crossbar."""
    k, half = leg.name, 0.5 * body.rods_apart
    y, tip = np.eye(3)[1], np.array([leg.length, 0.0, 0.0])
    up, down = np.array([0.0, 0.0, half]), np.array([0.0, 0.0, -half])
    for name, side in (("a", up), ("b", down)):
        _link(root, f"{k}_rod_{name}", _rod(leg, body))
        _hinge(root, f"{k}_bar_{name}", f"{k}_yoke", f"{k}_rod_{name}", (side, np.eye(3)), y)
    _mounted(root, f"{k}_rod_b_tip", f"{k}_rod_b", tip)
    crossbar = [Shape((0.009, body.rods_apart + 0.02), "steel", down)]
    _link(root, f"{k}_crossbar", crossbar)
    _hinge(root, f"{k}_coupler", f"{k}_rod_a", f"{k}_crossbar", (tip, np.eye(3)), y)
    _mounted(root, f"{k}_crossbar_end", f"{k}_crossbar", 2.0 * down)
    _mounted(root, f"{k}_leg_root", f"{k}_yoke", np.zeros(3))
    _mounted(root, f"{k}_leg_tip", f"{k}_crossbar", down)


def _yoke(body: Body) -> list[Shape]:
    return [Shape((0.01, body.rods_apart + 0.03), "steel"), Shape((0.014, 0.022), "dark")]


def _rod(leg: LegGeometry, body: Body) -> list[Shape]:
    """Rod with the hinges at both ends."""
    across = pin.rpy.rpyToMatrix(QUARTER, 0.0, 0.0)
    lying = pin.rpy.rpyToMatrix(0.0, QUARTER, 0.0)
    r, length = body.rod_radius, leg.length
    hinge = (r + 0.0035, 4.0 * r)
    return [
        Shape((r, length), leg.colour, np.array([0.5 * length, 0.0, 0.0]), lying),
        Shape(hinge, "steel", turned=across),
        Shape(hinge, "steel", np.array([length, 0.0, 0.0]), across),
    ]


def _root(leg: LegGeometry) -> tuple[Array, Array]:
    """Middle of the hinge on the slide, and axes of the leg, in the slide's frame."""
    return leg.frame.T @ (leg.root - leg.slide), leg.frame.T @ leg.axes


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
    roll, pitch, yaw = (_exact_angle(float(v)) for v in pin.rpy.matrixToRpy(turned))
    if abs(pitch) == QUARTER:  # only yaw ∓ roll matters
        roll, yaw = 0.0, _exact_angle(yaw - roll if pitch > 0.0 else yaw + roll)
    rpy = " ".join(f"{v + 0.0:.17g}" for v in (roll, pitch, yaw))
    etree.SubElement(owner, "origin", xyz=_numbers(at), rpy=rpy)


def _exact_angle(angle: float) -> float:
    """Angle, [rad]; a quarter turn exactly where it is one but for rounding; π for −π."""
    quarters = round(angle / QUARTER)
    exact = (2 if quarters == -2 else quarters) * QUARTER
    return exact if abs(angle - quarters * QUARTER) < ROUNDING else angle


def _numbers(values: Sequence[float] | Array) -> str:
    return " ".join(_number(float(v)) for v in values)


def _number(value: float) -> str:
    return f"{round(value, 15) + 0.0:.15g}"
