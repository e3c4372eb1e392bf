"""Shapes to draw with: cylinders along z, arrows, dial gauges, ground and axes, for meshcat."""

from __future__ import annotations

import math
from dataclasses import dataclass

import meshcat.geometry as g
import numpy as np
from numpy.typing import NDArray

from orthocal.viewer.scene import Label, Scene

Array = NDArray[np.float64]
Colour = tuple[float, float, float]

AXIS_COLOURS: tuple[Colour, Colour, Colour] = (
    (0.8, 0.2, 0.15),
    (0.15, 0.55, 0.25),
    (0.15, 0.35, 0.8),
)


class _AlongZ(g.Cylinder):  # type: ignore[misc] # meshcat has no types
    """A cylinder or cone along z.

    Args:
        height: [m].
        bottom: Radius at its lower end, [m].
        top: Radius at its upper end, [m].
        start: z of its lower end, [m].
    """

    def __init__(self, height: float, bottom: float, top: float, *, start: float = 0.0) -> None:
        super().__init__(height, radiusTop=top, radiusBottom=bottom)
        self.start = start

    def intrinsic_transform(self) -> Array:
        """Turns meshcat's y to z; transposed, as three.js stores columns."""
        turn = np.array(
            [
                [1.0, 0.0, 0.0, 0.0],
                [0.0, 0.0, -1.0, 0.0],
                [0.0, 1.0, 0.0, self.start + self.height / 2.0],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
        return turn.T


def cylinder(height: float, radius: float, *, start: float = 0.0) -> g.Geometry:
    """A cylinder along z from z = start on, [m]."""
    return _AlongZ(height, radius, radius, start=start)


def cone(height: float, radius: float, *, start: float = 0.0) -> g.Geometry:
    """A cone along z from its foot at z = start to its tip, [m]."""
    return _AlongZ(height, radius, 0.0, start=start)


def pose_along(origin: Array, direction: Array) -> Array:
    """Poses whose z is along unit vectors, shape (..., 4, 4).

    Args:
        origin: Shape (..., 3), [m].
        direction: Unit vectors, shape (..., 3).
    """
    helper = np.eye(3)[np.abs(direction).argmin(axis=-1)]
    x = np.cross(helper, direction)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    pose = np.zeros((*direction.shape[:-1], 4, 4))
    pose[..., :3, :3] = np.stack([x, np.cross(direction, x), direction], axis=-1)
    pose[..., :3, 3] = origin
    pose[..., 3, 3] = 1.0
    return pose


def to_triple(point: Array) -> tuple[float, float, float]:
    """A point as plain numbers."""
    return float(point[0]), float(point[1]), float(point[2])


def material(colour: Colour, *, opacity: float = 1.0, shiny: bool = False) -> g.Material:
    """A material; what is seen through does not hide what is behind it.

    Args:
        colour: Red, green and blue, 0 to 1.
        opacity: 0 to 1.
        shiny: Whether it is lit; flat otherwise.
    """
    hexadecimal = sum(round(255 * c) << shift for c, shift in zip(colour, (16, 8, 0), strict=True))
    extra: dict[str, object] = {}
    if opacity < 1.0:  # where it lies in what is solid, that is what is seen
        extra = {
            "depthWrite": False,
            "polygonOffset": True,
            "polygonOffsetFactor": 2.0,
            "polygonOffsetUnits": 2.0,
        }
    kind = g.MeshPhongMaterial if shiny else g.MeshLambertMaterial
    return kind(color=hexadecimal, opacity=opacity, **extra)


def head_length(width: float) -> float:
    """Length of an arrow's head by its shaft's diameter, [m]."""
    return 3.5 * width


@dataclass(frozen=True, slots=True)
class ArrowParts:
    """What makes an arrow of a unit shaft and a head, both along z."""

    shaft: tuple[float, float, float]
    """Scale."""
    foot: float
    """Where the head begins, [m]."""
    head: tuple[float, float, float]
    """Scale."""


def arrow_parts(length: float, width: float) -> ArrowParts:
    """Shaft and head that are as long as an arrow together.

    An arrow that is shorter than its head is all head, and a smaller one.

    Args:
        length: Against the arrow's direction where negative, [m].
        width: Of the shaft, [m].
    """
    # nothing at all has no inverse: three.js wants one
    girth = max(min(1.0, abs(length) / head_length(width)), 1e-6)
    head = math.copysign(girth, length)
    foot = length - head * head_length(width)
    rest = math.copysign(max(abs(foot), 1e-9), length)
    return ArrowParts((girth, girth, rest), foot, (girth, girth, head))


def draw_arrow(
    scene: Scene,
    path: str,
    origin: Array,
    direction: Array,
    *,
    length: float,
    width: float,
    colour: Colour,
) -> None:
    """An arrow: a node with its foot at the origin and z along it, and in it shaft and head.

    Args:
        scene: Where to draw.
        path: Of the node.
        origin: Shape (3,), [m].
        direction: Unit vector, shape (3,).
        length: Against the direction where negative, [m].
        width: Of the shaft, [m].
        colour: Red, green and blue, 0 to 1.
    """
    look = material(colour)
    scene.add(f"{path}/shaft", cylinder(1.0, width / 2.0), look)
    scene.add(f"{path}/head", cone(head_length(width), 1.3 * width), look)
    scene.place(path, pose_along(origin, direction))
    parts = arrow_parts(length, width)
    scene.place(f"{path}/shaft", np.diag([*parts.shaft, 1.0]))
    pose = np.diag([*parts.head, 1.0])
    pose[2, 3] = parts.foot
    scene.place(f"{path}/head", pose)


def dial_distance(size: float) -> float:
    """From the tip of a gauge to the middle of its dial, whose radius is given, [m]."""
    return 2.3 * size


def draw_gauge(
    scene: Scene,
    path: str,
    tip: Array,
    direction: Array,
    face: Array,
    size: float,
    *,
    ball: float | None = None,
    edge: Array | None = None,
) -> None:
    """A dial indicator that touches a point, its stem along the measured direction.

    Args:
        scene: Where to draw.
        path: Of the node.
        tip: The point, shape (3,), [m].
        direction: Away from the leg: that of a growing reading, shape (3,).
        face: Which way the dial faces, across the direction, shape (3,).
        size: Radius of the dial, [m].
        ball: Radius of what touches, as it is, [m]: of a ball, or of an edge that is a pin.
        edge: From one end of an edge that touches to the other, shape (3,), [m].
    """
    axes = np.column_stack([np.cross(direction, face), face, direction])
    scene.place(path, np.block([[axes, tip[:, None]], [np.zeros(3), np.ones(1)]]))
    dark, steel, white = (
        material((0.16, 0.17, 0.2), shiny=True),
        material((0.75, 0.76, 0.8), shiny=True),
        material((0.97, 0.97, 0.95)),
    )
    stem, reach = 0.16 * size, dial_distance(size)
    if edge is not None:
        _draw_edge(scene, f"{path}/tip", axes.T @ edge, radius=ball or 0.0, height=stem)
    else:
        scene.add(f"{path}/tip", g.Sphere(ball or stem), dark)
    if ball and edge is None:
        scene.place(f"{path}/tip", pose_along(np.array([0.0, 0.0, ball]), np.eye(3)[2]))
    probe = 0.55 * stem if not ball else min(0.55 * stem, 0.7 * ball)
    above = ball or (stem if edge is not None else 0.0)
    scene.add(f"{path}/probe", cylinder(reach - size - above, probe, start=above), steel)
    scene.add(f"{path}/stem", cylinder(0.75 * size, stem, start=reach - 1.6 * size), dark)
    # the dial's axis, z of a cylinder, along the face: y of the gauge
    turn = np.eye(4)
    turn[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    turn[:3, 3] = [0.0, 0.0, reach]
    thick = 0.45 * size
    scene.add(f"{path}/case", cylinder(thick, size, start=-thick / 2.0), dark)
    scene.add(f"{path}/dial", cylinder(0.04 * size, 0.86 * size, start=thick / 2.0), white)
    for part in ("case", "dial"):
        scene.place(f"{path}/{part}", turn)
    needle = np.eye(4)
    needle[:3, 3] = [0.0, thick / 2.0 + 0.06 * size, reach + 0.3 * size]
    scene.add(f"{path}/needle", g.Box([0.09 * size, 0.04 * size, 0.75 * size]), dark)
    scene.place(f"{path}/needle", needle)


def _draw_edge(scene: Scene, path: str, edge: Array, *, radius: float, height: float) -> None:
    """A blade, or a pin of a radius, above the origin, [m]."""
    steel, length = material((0.75, 0.76, 0.8), shiny=True), float(np.linalg.norm(edge))
    if radius > 0.0:
        scene.add(path, cylinder(length, radius, start=-length / 2.0), steel)
        scene.place(path, pose_along(np.array([0.0, 0.0, radius]), edge / length))
        return
    scene.add(path, g.Box([length, 0.1 * height, height]), steel)
    along, up = edge / length, np.array([0.0, 0.0, 1.0])
    pose = np.eye(4)
    pose[:3] = np.column_stack([along, np.cross(up, along), up, height / 2.0 * up])
    scene.place(path, pose)


def draw_ground(scene: Scene, path: str, *, side: float, pitch: float) -> None:
    """Ground: a pale plate with lines at a pitch, around the node's origin.

    Args:
        scene: Where to draw.
        path: Of the node.
        side: [m].
        pitch: [m].
    """
    count = max(2, math.ceil(side / pitch / 2.0))
    half = count * pitch
    line = np.linspace(-half, half, 2 * count + 1)
    ends = np.array([[-half, v] for v in line] + [[v, -half] for v in line])
    others = np.array([[half, v] for v in line] + [[v, half] for v in line])
    points = np.empty((2 * len(ends), 3), dtype=np.float32)
    points[0::2, :2], points[1::2, :2], points[:, 2] = ends, others, 0.0
    scene.add(f"{path}/plate", g.Box([2.0 * half, 2.0 * half, 0.002]), material((0.93, 0.94, 0.95)))
    lowered = np.eye(4)
    lowered[2, 3] = -0.002
    scene.place(f"{path}/plate", lowered)
    lines = g.LineSegments(g.PointsGeometry(points.T), g.LineBasicMaterial(color=0xB8BEC6))
    scene.visualizer[f"/{path}/lines"].set_object(lines)


def draw_axes(scene: Scene, path: str, *, length: float) -> None:
    """The world's axes: red x, green y and blue z, from the origin."""
    for name, direction, colour in zip("xyz", np.eye(3), AXIS_COLOURS, strict=True):
        draw_arrow(
            scene,
            f"{path}/{name}",
            np.zeros(3),
            direction,
            length=length,
            width=0.05 * length,
            colour=colour,
        )
        scene.labels.append(
            Label((to_triple(1.12 * length * direction),), (name,), f"{path}/{name}", rank=-1.0)
        )


def css(colour: Colour) -> str:
    """A colour as a page has it."""
    return "#" + "".join(f"{round(255 * c):02x}" for c in colour)
