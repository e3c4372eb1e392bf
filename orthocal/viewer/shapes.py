"""Shapes of scenes: cylinders along z, arrows, dial gauges, ground and axes."""

from __future__ import annotations

import math

import meshcat.geometry as g
import numpy as np
from meshcat.transformations import translation_matrix
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.viewer.scene import Label, Scene

Colour = tuple[float, float, float]

AXIS_COLOURS: tuple[Colour, Colour, Colour] = (
    (0.8, 0.2, 0.15),
    (0.15, 0.55, 0.25),
    (0.15, 0.35, 0.8),
)


class _AlongZ(g.Cylinder):  # type: ignore[misc] # meshcat has no types
    """Cylinder or cone along z.

    Args:
        height: Height, [m].
        bottom: Radius at the lower end, [m].
        top: Radius at the upper end, [m].
        start: z of the lower end, [m].
    """

    def __init__(self, height: float, bottom: float, top: float, *, start: float = 0.0) -> None:
        super().__init__(height, radiusTop=top, radiusBottom=bottom)
        self.start = start

    def intrinsic_transform(self) -> Array:
        """Transform from meshcat's y to z, transposed because three.js stores columns."""
        transform = np.array(
            [
                [1.0, 0.0, 0.0, 0.0],
                [0.0, 0.0, -1.0, 0.0],
                [0.0, 1.0, 0.0, self.start + self.height / 2.0],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
        return transform.T


def cylinder(height: float, radius: float, *, start: float = 0.0) -> g.Geometry:
    """Cylinder along z that begins at z = start, [m]."""
    return _AlongZ(height, radius, radius, start=start)


def pose_along(origin: Array, direction: Array) -> Array:
    """Poses with z along unit vectors, shape (..., 4, 4), [m].

    Args:
        origin: Origins, shape (..., 3), [m].
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
    """Coordinates of a point as plain numbers."""
    return float(point[0]), float(point[1]), float(point[2])


def material(
    colour: Colour, *, opacity: float = 1.0, shiny: bool = False, in_front: bool = False
) -> g.Material:
    """Material; a transparent material does not hide shapes behind it.

    Args:
        colour: Red, green and blue, 0 to 1.
        opacity: Opacity, 0 to 1.
        shiny: Whether the surface has highlights.
        in_front: Whether nearer shapes do not hide it.
    """
    hexadecimal = sum(round(255 * c) << shift for c, shift in zip(colour, (16, 8, 0), strict=True))
    extra: dict[str, object] = {}
    if opacity < 1.0:  # a solid shape in the same place appears in front
        extra = {
            "depthWrite": False,
            "polygonOffset": True,
            "polygonOffsetFactor": 2.0,
            "polygonOffsetUnits": 2.0,
        }
    if in_front:  # three.js draws transparent shapes last; only front sides, which hide the others
        extra |= {"depthTest": False, "transparent": True, "side": 0}
    kind = g.MeshPhongMaterial if shiny else g.MeshLambertMaterial
    return kind(color=hexadecimal, opacity=opacity, **extra)


def head_length(width: float) -> float:
    """Length of an arrow's head for a shaft of diameter `width`, [m]."""
    return 3.5 * width


def arrow_parts(lengths: ArrayLike, width: float) -> tuple[Array, Array, Array]:
    """Parts of arrows along z; an arrow shorter than its head has a smaller head.

    Args:
        lengths: Lengths, shape (F,), [m]; negative if an arrow points against z.
        width: Diameter of the shafts, [m].

    Returns:
        Scales of a shaft of unit length, starts of the heads, [m], and scales of the heads, each of
        shape (F, 3).
    """
    length = np.asarray(lengths, dtype=np.float64)
    # three.js needs scales that can be inverted
    girth = np.clip(np.abs(length) / head_length(width), 1e-6, 1.0)
    head = np.copysign(girth, length)
    foot = length - head * head_length(width)
    shaft = np.copysign(np.maximum(np.abs(foot), 1e-9), length)
    none = np.zeros_like(length)
    parts = (girth, girth, shaft), (none, none, foot), (girth, girth, head)
    shafts, feet, heads = (np.column_stack(part) for part in parts)
    return shafts, feet, heads


def draw_arrow(
    scene: Scene,
    path: str,
    pose: Array,
    lengths: ArrayLike,
    *,
    width: float,
    colour: Colour,
    times: Array | None = None,
    in_front: bool = False,
) -> None:
    """Draw an arrow along z of its node.

    Args:
        scene: The scene.
        path: Path of the node.
        pose: Pose of the node, shape (4, 4), or poses at all times, shape (F, 4, 4), [m].
        lengths: Length, or lengths at all times, shape (F,), [m]; negative against z.
        width: Diameter of the shaft, [m].
        colour: Red, green and blue, 0 to 1.
        times: Times of the poses and lengths, shape (F,), [frames].
        in_front: Whether nearer shapes do not hide it.
    """
    look = material(colour, in_front=in_front)
    if times is None:
        scene.place(path, pose)
    else:
        scene.move(path, times, pose)
    shafts, feet, heads = arrow_parts(lengths, width)
    shaft = np.diag([*shafts[0], 1.0])
    head = translation_matrix(feet[0]) @ np.diag([*heads[0], 1.0])
    scene.add(f"{path}/shaft", cylinder(1.0, width / 2.0), look, shaft)
    scene.add(f"{path}/head", _AlongZ(head_length(width), 1.3 * width, 0.0), look, head)
    if times is not None:
        scene.track(f"{path}/shaft", "scale", "vector3", times, shafts)
        scene.track(f"{path}/head", "position", "vector3", times, feet)
        scene.track(f"{path}/head", "scale", "vector3", times, heads)


def dial_distance(size: float) -> float:
    """Distance from the tip of a gauge to the middle of its dial, with radius `size`, [m]."""
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
    with_dial: bool = True,
) -> None:
    """Draw a dial indicator, or a probe, with its stem along the measured direction.

    Args:
        scene: The scene.
        path: Path of the node.
        tip: Point of contact, shape (3,), [m].
        direction: Direction of a growing reading, shape (3,).
        face: Normal of the dial, perpendicular to `direction`, shape (3,).
        size: Radius of the dial, [m].
        ball: Radius of a ball or pin at the tip, [m].
        edge: Vector from one end of a blade or pin to the other, shape (3,), [m].
        with_dial: Whether it has a dial; a probe has none.
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
        scene.add(
            f"{path}/tip", g.Sphere(ball or stem), dark, translation_matrix((0.0, 0.0, ball or 0.0))
        )
    probe = 0.55 * stem if not ball else min(0.55 * stem, 0.7 * ball)
    above = ball or (stem if edge is not None else 0.0)
    scene.add(f"{path}/probe", cylinder(reach - size - above, probe, start=above), steel)
    scene.add(f"{path}/stem", cylinder(0.75 * size, stem, start=reach - 1.6 * size), dark)
    if not with_dial:
        return
    # from the axis of a cylinder, z, to the axis of the dial, y of the gauge
    dial = translation_matrix((0.0, 0.0, reach))
    dial[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    thick = 0.45 * size
    scene.add(f"{path}/case", cylinder(thick, size, start=-thick / 2.0), dark, dial)
    scene.add(f"{path}/dial", cylinder(0.04 * size, 0.86 * size, start=thick / 2.0), white, dial)
    hand = translation_matrix((0.0, thick / 2.0 + 0.06 * size, reach + 0.3 * size))
    scene.add(f"{path}/needle", g.Box([0.09 * size, 0.04 * size, 0.75 * size]), dark, hand)


BAR = "bar"
"""Name of the node of the bar in the node of a ball bar."""


def draw_bar(scene: Scene, path: str, fixed: Array, ball: Array, size: float) -> None:
    """Draw a ball bar: a fixed ball on a post, and a bar with a ball at its other end.

    Args:
        scene: The scene.
        path: Path of the node.
        fixed: Centre of the fixed ball, shape (3,), [m].
        ball: Centre of the other ball, shape (3,), [m].
        size: Radius of the balls, [m].
    """
    steel, dark = material((0.75, 0.76, 0.8), shiny=True), material((0.16, 0.17, 0.2), shiny=True)
    length = float(np.linalg.norm(ball - fixed))
    foot = translation_matrix(fixed)
    scene.add(f"{path}/post", cylinder(3.0 * size, 0.5 * size, start=-3.0 * size), dark, foot)
    scene.add(f"{path}/fixed", g.Sphere(size), steel, foot)
    scene.add(f"{path}/{BAR}/rod", cylinder(length, 0.35 * size), dark)
    scene.add(f"{path}/{BAR}/ball", g.Sphere(size), steel, translation_matrix((0.0, 0.0, length)))
    scene.place(f"{path}/{BAR}", pose_along(fixed, (ball - fixed) / max(length, 1e-9)))


def _draw_edge(scene: Scene, path: str, edge: Array, *, radius: float, height: float) -> None:
    """Draw a blade, or a pin with a radius, above the origin, [m]."""
    steel, length = material((0.75, 0.76, 0.8), shiny=True), float(np.linalg.norm(edge))
    along, up = edge / length, np.array([0.0, 0.0, 1.0])
    if radius > 0.0:
        pin = cylinder(length, radius, start=-length / 2.0)
        scene.add(path, pin, steel, pose_along(radius * up, along))
        return
    pose = np.eye(4)
    pose[:3] = np.column_stack([along, np.cross(up, along), up, height / 2.0 * up])
    scene.add(path, g.Box([length, 0.1 * height, height]), steel, pose)


def draw_ground(scene: Scene, path: str, *, side: float, pitch: float) -> None:
    """Draw a pale plate with grid lines around the origin of its node.

    Args:
        scene: The scene.
        path: Path of the node.
        side: Side of the plate, [m].
        pitch: Distance of the lines, [m].
    """
    count = max(2, math.ceil(side / pitch / 2.0))
    half = count * pitch
    line = np.linspace(-half, half, 2 * count + 1)
    far = np.full_like(line, half)
    ends = [np.stack([-far, line, far, line], axis=1), np.stack([line, -far, line, far], axis=1)]
    points = np.zeros((8 * count + 4, 3), dtype=np.float32)
    points[:, :2] = np.concatenate(ends).reshape(-1, 2)
    plate = g.Box([2.0 * half, 2.0 * half, 0.002])
    scene.add(
        f"{path}/plate", plate, material((0.93, 0.94, 0.95)), translation_matrix((0.0, 0.0, -0.002))
    )
    lines = g.LineSegments(g.PointsGeometry(points.T), g.LineBasicMaterial(color=0xB8BEC6))
    scene.visualizer[f"/{path}/lines"].set_object(lines)


def draw_axes(scene: Scene, path: str, *, length: float) -> None:
    """Draw the axes of the world: x red, y green, z blue."""
    for name, direction, colour in zip("xyz", np.eye(3), AXIS_COLOURS, strict=True):
        pose = pose_along(np.zeros(3), direction)
        draw_arrow(scene, f"{path}/{name}", pose, [length], width=0.05 * length, colour=colour)
        scene.labels.append(
            Label((to_triple(1.12 * length * direction),), (name,), f"{path}/{name}", rank=-1.0)
        )


def css(colour: Colour) -> str:
    """Colour in CSS."""
    return "#" + "".join(f"{round(255 * c):02x}" for c in colour)
