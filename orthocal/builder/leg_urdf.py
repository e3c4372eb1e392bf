"""URDF of a machine with slides and legs of rods that carry a platform.

Legs of the Orthoglide have a slide, a swivel, a parallelogram of two rods, a wrist and a fork.
Planar legs have a slide and a parallelogram, or a slide and one rod. Slides may have any position
and direction. The first leg carries the platform; loop closures join it to the others.

Frame of a leg: X points from the hinge on the slide to the hinge on the platform. Z points from rod
b to rod a. Y = Z × X is the axis of the rods' hinges.
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
"""Names of materials, mapped to red, green and blue, from 0 to 1."""

LEG_COLOURS = ("red", "green", "blue")
"""Colours of the legs, in their order."""

_, Y, Z = np.eye(3)
"""Axes of the hinges in the frame of a leg."""

QUARTER_TURN = 0.5 * np.pi

HINGE_RANGE = (-1.3, 1.3)
"""Limits of a hinge, [rad]."""

ROUNDING = 1e-14
"""Largest rounding error of an angle, [rad]."""

LIMITS = {"effort": 1000.0, "velocity": 2.0}
"""Limits of all joints in addition to their travel, [N or N m, m/s or rad/s]."""


@dataclass(frozen=True, slots=True, eq=False)
class LegGeometry:
    """A leg and its slide in the mechanical zero, in world coordinates."""

    name: str
    frame: Array
    """Axes of the slide's frame as columns, shape (3, 3); its Z is also the Z of the leg."""
    direction: Array
    """Unit vector of the slide's motion if its coordinate grows, shape (3,)."""
    zero: float
    """Coordinate of the slide in the mechanical zero, [m]."""
    slide: Array
    """Origin of the slide's frame, shape (3,), [m]."""
    root: Array
    """Middle of the hinge on the slide, shape (3,), [m]."""
    tip: Array
    """Middle of the hinge on the platform, shape (3,), [m]."""
    travel: tuple[float, float]
    """Smallest and largest coordinate of the slide, [m]."""
    colour: str = "red"

    @property
    def axes(self) -> Array:
        """Axes of the leg's frame as columns, shape (3, 3)."""
        x = (self.tip - self.root) / np.linalg.norm(self.tip - self.root)
        z = self.frame[:, 2]
        return np.column_stack([x, np.cross(z, x), z])

    @property
    def length(self) -> float:
        """Length of the rods, [m]."""
        return float(np.linalg.norm(self.tip - self.root))


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """A drawn box, cylinder or sphere of a link."""

    sizes: tuple[float, ...]
    """Edges of a box (3), radius and length of a cylinder along Z (2), radius of a sphere (1); all
    in [m]."""
    material: str
    """Name of a colour in COLOURS."""
    position: Array = field(default_factory=lambda: np.zeros(3))
    """Position of the centre in the link's frame, shape (3,), [m]."""
    rotation: Array = field(default_factory=lambda: np.eye(3))
    """Orientation in the link's frame, shape (3, 3)."""


FOOT = Shape((0.018, 0.018, 0.018), "dark")


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """Dimensions of the rods, and drawn shapes of base, slides and platform."""

    rods_apart: float
    """Distance between the axes of a leg's two rods, [m]; 0 for legs of one rod."""
    rod_radius: float
    """Radius of a rod, [m]."""
    base: Sequence[Shape]
    """Shapes of the base, in world coordinates."""
    slider: Sequence[Shape]
    """Shapes of a slide, in the slide's frame relative to the middle of its hinge."""
    platform: Sequence[Shape]
    """Shapes of the platform, in the tool's frame, which is parallel to the world."""
    foot: Shape = FOOT
    """Hinge on the platform, in the leg's frame."""


def machine_urdf(name: str, legs: Sequence[LegGeometry], body: Body, *, comment: str) -> str:
    """URDF of a machine whose tool centre point is at the origin in the mechanical zero.

    Args:
        name: Name of the robot.
        legs: The legs; the first one carries the platform.
        body: Rods and drawn shapes.
        comment: Comment in the first line.
    """
    root = _robot(name, body)
    first = legs[0]
    for leg in legs:
        _add_leg(root, leg, body)
        if leg is not first:
            _add_fixed(root, f"{leg.name}_foot_end", f"{leg.name}_foot", _tool_placement(leg))
    _add_platform(root, f"{first.name}_foot", first, body)
    return _text(root, comment)


def planar_urdf(name: str, legs: Sequence[LegGeometry], body: Body, *, comment: str) -> str:
    """URDF of a machine whose legs move in a plane, with one or two rods each.

    Legs of two rods keep the orientation of the platform: the first leg carries it, the others end
    in pins on it. Legs of one rod (`rods_apart` is 0) meet in the tool centre point. The foot of
    the first leg turns on its rod and carries the platform. A closure joins it to the last rod.

    Args:
        name: Name of the robot.
        legs: The legs.
        body: Rods and drawn shapes.
        comment: Comment in the first line.
    """
    root = _robot(name, body)
    first, *others = legs
    if body.rods_apart:
        for leg in legs:
            _add_slide(root, leg, body)
            _add_fixed(
                root, f"{leg.name}_yoke", f"{leg.name}_slider", _root_placement(leg), _yoke(body)
            )
            _add_parallelogram(root, leg, body)
        _add_platform(root, f"{first.name}_leg_tip", first, body)
        for leg in others:
            _add_fixed(root, f"{leg.name}_pin", "platform", _at(leg.tip))
        return _text(root, comment)
    for leg in legs:
        k = leg.name
        _add_slide(root, leg, body)
        _add_fixed(root, f"{k}_leg_root", f"{k}_slider", _root_placement(leg))
        _add_hinge(
            root, f"{k}_bar", f"{k}_slider", f"{k}_rod", _root_placement(leg), Y, _rod(leg, body)
        )
        end = _at(np.array([leg.length, 0.0, 0.0]))
        if leg is first:
            _add_hinge(root, f"{k}_end", f"{k}_rod", f"{k}_foot", end, Y)
            continue
        _add_fixed(root, f"{k}_foot", f"{k}_rod", end)
        _add_fixed(root, f"{k}_end", f"{k}_foot", _tool_placement(leg))
    _add_platform(root, f"{first.name}_foot", first, body)
    return _text(root, comment)


def _robot(name: str, body: Body) -> etree._Element:
    """Robot element with materials and base."""
    root = etree.Element("robot", name=name)
    for colour, rgb in COLOURS.items():
        material = etree.SubElement(root, "material", name=colour)
        etree.SubElement(material, "color", rgba=_numbers([*rgb, 1.0]))
    _add_link(root, "base", body.base)
    return root


def _text(root: etree._Element, comment: str) -> str:
    """Document with a comment in the first line."""
    etree.indent(root)
    text = str(etree.tostring(root, encoding="unicode"))
    return f'<?xml version="1.0"?>\n<!-- {comment} -->\n{text}\n'


def _add_platform(root: etree._Element, parent: str, leg: LegGeometry, body: Body) -> None:
    """Add platform and tool centre point to the link at the end of a leg."""
    _add_fixed(root, "platform", parent, _tool_placement(leg), body.platform)
    _add_fixed(root, "tcp", "platform", _at(np.zeros(3)))


def _add_leg(root: etree._Element, leg: LegGeometry, body: Body) -> None:
    """Add slide and leg of a spatial machine."""
    k = leg.name
    _add_slide(root, leg, body)
    _add_hinge(
        root, f"{k}_swivel", f"{k}_slider", f"{k}_yoke", _root_placement(leg), Z, _yoke(body)
    )
    _add_parallelogram(root, leg, body)
    knuckle, down = [Shape((0.012, 0.024), "dark")], -0.5 * body.rods_apart * Z
    _add_hinge(root, f"{k}_wrist", f"{k}_crossbar", f"{k}_knuckle", _at(down), Z, knuckle)
    _add_hinge(root, f"{k}_fork", f"{k}_knuckle", f"{k}_foot", _at(np.zeros(3)), Y, [body.foot])


def _add_slide(root: etree._Element, leg: LegGeometry, body: Body) -> None:
    """Add the slide of a leg."""
    k, (to_root, _) = leg.name, _root_placement(leg)
    slider = [Shape(s.sizes, s.material, to_root + s.position, s.rotation) for s in body.slider]
    place = (leg.slide - leg.zero * leg.direction, leg.frame)
    joint = _add_joint(root, f"{k}_slide", "prismatic", ("base", f"{k}_slider"), place, slider)
    _add_limit(joint, leg.frame.T @ leg.direction, leg.travel)


def _add_parallelogram(root: etree._Element, leg: LegGeometry, body: Body) -> None:
    """Add two rods between yoke and crossbar."""
    k, half = leg.name, 0.5 * body.rods_apart
    tip, down = _at(np.array([leg.length, 0.0, 0.0])), -half * Z
    for rod, side in (("a", half * Z), ("b", down)):
        name, shapes = f"{k}_rod_{rod}", _rod(leg, body)
        _add_hinge(root, f"{k}_bar_{rod}", f"{k}_yoke", name, _at(side), Y, shapes)
    _add_fixed(root, f"{k}_rod_b_tip", f"{k}_rod_b", tip)
    crossbar = [Shape((0.009, body.rods_apart + 0.02), "steel", down)]
    _add_hinge(root, f"{k}_coupler", f"{k}_rod_a", f"{k}_crossbar", tip, Y, crossbar)
    _add_fixed(root, f"{k}_crossbar_end", f"{k}_crossbar", _at(2.0 * down))
    _add_fixed(root, f"{k}_leg_root", f"{k}_yoke", _at(np.zeros(3)))
    _add_fixed(root, f"{k}_leg_tip", f"{k}_crossbar", _at(down))


def _yoke(body: Body) -> list[Shape]:
    """Shapes of the yoke on a slide."""
    return [Shape((0.01, body.rods_apart + 0.03), "steel"), Shape((0.014, 0.022), "dark")]


def _rod(leg: LegGeometry, body: Body) -> list[Shape]:
    """Shapes of a rod and the hinges at both ends."""
    across = pin.rpy.rpyToMatrix(QUARTER_TURN, 0.0, 0.0)
    along = pin.rpy.rpyToMatrix(0.0, QUARTER_TURN, 0.0)
    r, length = body.rod_radius, leg.length
    hinge = (r + 0.0035, 4.0 * r)
    return [
        Shape((r, length), leg.colour, np.array([0.5 * length, 0.0, 0.0]), along),
        Shape(hinge, "steel", rotation=across),
        Shape(hinge, "steel", np.array([length, 0.0, 0.0]), across),
    ]


def _at(position: Array) -> tuple[Array, Array]:
    """Placement at a position, parallel to the parent link."""
    return position, np.eye(3)


def _root_placement(leg: LegGeometry) -> tuple[Array, Array]:
    """Placement of the leg's frame, at the middle of its hinge, in the slide's frame."""
    return leg.frame.T @ (leg.root - leg.slide), leg.frame.T @ leg.axes


def _tool_placement(leg: LegGeometry) -> tuple[Array, Array]:
    """Placement of the tool's frame, which is that of the world, in the frame of the leg's foot."""
    return -leg.axes.T @ leg.tip, leg.axes.T


def _add_link(root: etree._Element, name: str, shapes: Sequence[Shape]) -> None:
    """Add a link with its shapes."""
    link = etree.SubElement(root, "link", name=name)
    for shape in shapes:
        visual = etree.SubElement(link, "visual")
        _add_origin(visual, shape.position, shape.rotation)
        geometry = etree.SubElement(visual, "geometry")
        if len(shape.sizes) == 3:
            etree.SubElement(geometry, "box", size=_numbers(shape.sizes))
        elif len(shape.sizes) == 2:
            radius, length = map(_number, shape.sizes)
            etree.SubElement(geometry, "cylinder", radius=radius, length=length)
        else:
            etree.SubElement(geometry, "sphere", radius=_number(shape.sizes[0]))
        etree.SubElement(visual, "material", name=shape.material)


def _add_joint(
    root: etree._Element,
    name: str,
    kind: str,
    links: tuple[str, str],
    placement: tuple[Array, Array],
    shapes: Sequence[Shape],
) -> etree._Element:
    """Add a link with its shapes, and the joint between another link and it."""
    _add_link(root, links[1], shapes)
    joint = etree.SubElement(root, "joint", name=name, type=kind)
    etree.SubElement(joint, "parent", link=links[0])
    etree.SubElement(joint, "child", link=links[1])
    _add_origin(joint, *placement)
    return joint


def _add_fixed(
    root: etree._Element,
    name: str,
    parent: str,
    placement: tuple[Array, Array],
    shapes: Sequence[Shape] = (),
) -> None:
    """Add a link that is fixed to another one."""
    _add_joint(root, f"{name}_mount", "fixed", (parent, name), placement, shapes)


def _add_hinge(
    root: etree._Element,
    name: str,
    parent: str,
    child: str,
    placement: tuple[Array, Array],
    axis: Array,
    shapes: Sequence[Shape] = (),
) -> None:
    """Add a link on a revolute joint with the limits HINGE_RANGE."""
    joint = _add_joint(root, name, "revolute", (parent, child), placement, shapes)
    _add_limit(joint, axis, HINGE_RANGE)


def _add_limit(joint: etree._Element, axis: Array, limits: tuple[float, float]) -> None:
    """Add axis and limits, [m, rad], to a joint."""
    etree.SubElement(joint, "axis", xyz=_numbers(axis))
    low, high = map(_number, limits)
    others = {key: _number(v) for key, v in LIMITS.items()}
    etree.SubElement(joint, "limit", lower=low, upper=high, **others)


def _add_origin(owner: etree._Element, position: Array, rotation: Array) -> None:
    """Add the origin of a joint or a visual."""
    roll, pitch, yaw = (_exact_angle(float(v)) for v in pin.rpy.matrixToRpy(rotation))
    if abs(pitch) == QUARTER_TURN:  # then only yaw ∓ roll is determined
        roll, yaw = 0.0, _exact_angle(yaw - roll if pitch > 0.0 else yaw + roll)
    rpy = " ".join(f"{v + 0.0:.17g}" for v in (roll, pitch, yaw))
    etree.SubElement(owner, "origin", xyz=_numbers(position), rpy=rpy)


def _exact_angle(angle: float) -> float:
    """Angle, [rad], without the rounding error of a multiple of a quarter turn; π instead of −π."""
    quarters = round(angle / QUARTER_TURN)
    exact = (2 if quarters == -2 else quarters) * QUARTER_TURN
    return exact if abs(angle - quarters * QUARTER_TURN) < ROUNDING else angle


def _numbers(values: Sequence[float] | Array) -> str:
    """Numbers of an attribute, separated by spaces."""
    return " ".join(_number(float(v)) for v in values)


def _number(value: float) -> str:
    """Number with at most 15 decimals and 15 significant digits, without a negative zero."""
    return f"{round(value, 15) + 0.0:.15g}"
