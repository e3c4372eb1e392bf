"""Pictures of a sheet: where the gauge stands on the machine, and the rods cut across.

The robot's own shapes are drawn as their convex outlines, those further away first: line drawings
that need no browser, and can be printed and copied.
"""

from __future__ import annotations

from collections.abc import Sequence

import meshcat.geometry as g
import numpy as np
from numpy.typing import NDArray

from orthocal.output.sheet.gauge_position import Standing, axis_name, direction_words
from orthocal.output.sheet.strokes import Drawing, circle_points, outline
from orthocal.robot.model import Robot
from orthocal.units import MM
from orthocal.viewer.stage import VIEW
from orthocal.viewer.visuals import Visual

Array = NDArray[np.float64]

BLUE, ORANGE, GREEN, GREY = "#0063a6", "#c55a00", "#007a4d", "#8a8f98"
PALE = "#f1f2f4"

WIDE, HIGH = 104.0, 88.0
"""Picture of the machine, [mm on paper]."""

CUT = 68.0
"""Side of the picture of the rods, [mm on paper]."""

MARGIN = 7.0
"""[mm on paper]"""

SOME_POINTS = 400
"""Of a mesh, that its outline is drawn through."""


class _View:
    """From the world to paper, along a direction.

    Args:
        toward: From the eye, shape (3,).
        up: What is up on paper, shape (3,).
        points: What is to be on it, shape (n, 3), [m].
        size: Of the paper, width and height, [mm].
    """

    def __init__(self, toward: Array, up: Array, points: Array, size: tuple[float, float]) -> None:
        self.toward = toward / np.linalg.norm(toward)
        right = np.cross(self.toward, up)
        self.right = right / np.linalg.norm(right)
        self.up = np.cross(self.right, self.toward)
        flat = points @ np.column_stack([self.right, self.up])
        low, high = flat.min(axis=0), flat.max(axis=0)
        room = np.array(size) - 2.0 * MARGIN
        self.scale = float((room / np.maximum(high - low, 1e-6)).min())
        self.shift = np.array(size) / 2.0 - self.scale * np.array([1.0, -1.0]) * (low + high) / 2.0

    def flat(self, points: Array) -> Array:
        """Points on paper, shape (..., 2), [mm]."""
        u, v = points @ self.right, points @ self.up
        return np.asarray(self.scale * np.stack([u, -v], axis=-1) + self.shift)

    def way(self, direction: Array) -> Array:
        """A direction on paper, shape (2,), as long as it is seen."""
        return np.array([direction @ self.right, -(direction @ self.up)])

    def depth(self, points: Array) -> float:
        """How far away points are, on average, [m]."""
        return float((points @ self.toward).mean())


def draw_machine(robot: Robot, visuals: Sequence[Visual], standing: Standing) -> str:
    """The machine in the setup's first posture with the gauge: the touched rod blue."""
    shapes = [(visual, _corners(visual, standing.poses[visual.link])) for visual in visuals]
    reach = 0.32 * float(np.ptp(np.concatenate([p for _, p in shapes]), axis=0).max())
    dial = standing.point + reach * standing.contact.direction
    every = np.concatenate([*(p for _, p in shapes), dial[None], standing.tool_points])
    view = _View(-np.array(VIEW), np.array([0.0, 0.0, 1.0]), every, (WIDE, HIGH))
    drawing = Drawing(WIDE, HIGH)
    touched, beside = _joints(robot, standing)
    for visual, points in sorted(shapes, key=lambda s: -view.depth(s[1])):
        joint = robot.model.frames[robot.frame_id(visual.link)].parentJoint
        fill, stroke = PALE, "#9aa0a8"
        if joint == touched:
            fill, stroke = "#9cc7e6", BLUE
        elif joint in beside:
            fill, stroke = "#d6dde5", "#4d5661"
        drawing.polygon(outline(view.flat(points)), fill=fill, stroke=stroke)
    _draw_legs(drawing, view, robot, standing)
    _draw_gauge(drawing, view, standing, reach)
    _draw_tool(drawing, view, standing, reach)
    _draw_axes(drawing, view, np.array([14.0, 18.0]))
    words = f"Setup {standing.setup.name}: where the gauge stands on the machine"
    return drawing.to_svg(words)


def _corners(visual: Visual, pose: Array) -> Array:
    """Points whose outline is that of a shape, in the world, shape (n, 3), [m]."""
    points = visual.corners
    own = visual.placement
    local = (points - own[:3, 3]) @ own[:3, :3]
    low, high = local.min(axis=0), local.max(axis=0)
    if isinstance(visual.geometry, g.Cylinder):
        ring = circle_points() * (high[:2] - low[:2]) / 2.0 + (high[:2] + low[:2]) / 2.0
        ends = [np.column_stack([ring, np.full(len(ring), z)]) for z in (low[2], high[2])]
        points = np.concatenate(ends) @ own[:3, :3].T + own[:3, 3]
    elif isinstance(visual.geometry, g.Sphere):
        rings = [np.insert(circle_points(), k, 0.0, axis=1) for k in range(3)]
        points = np.concatenate(rings) * (high[0] - low[0]) / 2.0 + own[:3, 3]
    elif isinstance(visual.geometry, g.TriangularMeshGeometry):
        vertices = np.asarray(visual.geometry.vertices, dtype=np.float64)
        vertices = vertices if vertices.shape[1] == 3 else vertices.T
        some = vertices[:: max(1, len(vertices) // SOME_POINTS)]
        points = some @ own[:3, :3].T + own[:3, 3]
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def _joints(robot: Robot, standing: Standing) -> tuple[int, set[int]]:
    """Joint that carries the touched rod, and those of the leg's other rods."""

    def joint(frame: str) -> int:
        return int(robot.model.frames[robot.frame_id(frame)].parentJoint)

    rods = {} if standing.leg is None else standing.leg.rods
    touched = -1 if standing.rod is None else joint(standing.rod.root)
    return touched, {joint(r.root) for r in rods.values()} - {touched}


def _place(standing: Standing, frame: str) -> Array:
    return np.asarray(standing.poses[frame][:3, 3])


def _draw_legs(drawing: Drawing, view: _View, robot: Robot, standing: Standing) -> None:
    """Names of the leg and of its rods; the line itself where that is what is touched."""
    del robot
    leg = standing.leg
    if leg is None:
        return
    root, tip = _place(standing, leg.root), _place(standing, leg.tip)
    if standing.rod is None:
        drawing.line(view.flat(np.array([root, tip])), stroke=BLUE, width=0.7, dash="2.5 1.2")
    outwards = view.way(root - tip)
    outwards /= max(float(np.linalg.norm(outwards)), 1e-9)
    drawing.text(view.flat(root) + 13.0 * outwards, f"leg {leg.name}", bold=True, size=3.6)
    for rod in leg.rods.values():
        ends = [_place(standing, f) for f in (rod.root, rod.tip)]
        at = 0.8 * ends[0] + 0.2 * ends[1]
        own = standing.rod is not None and rod.name == standing.rod.name
        aside = view.way(at - 0.5 * (root + tip) - ((at - root) @ leg.axis) * leg.axis)
        size = float(np.linalg.norm(aside))
        shift = 3.4 * aside / size if size > 1e-9 else np.zeros(2)
        colour = BLUE if own else "#4d5661"
        drawing.text(view.flat(at) + shift, rod.name, colour=colour, bold=True, size=4.0)


def _draw_tool(drawing: Drawing, view: _View, standing: Standing, reach: float) -> None:
    """The tool's way through the postures, and the first of them."""
    if not len(standing.tool_points):
        return
    points = view.flat(standing.tool_points)
    centre = points.mean(axis=0)
    ends = points[np.argsort((points - centre) @ _main_way(points - centre))][[0, -1]]
    drawing.line(points, stroke=GREEN, width=0.35)
    drawing.arrow(ends[0], ends[1], stroke=GREEN, width=0.7, both=True)
    drawing.circle(points[0], 1.2, fill=GREEN, stroke="#fff")
    busy = view.flat(standing.point + reach * standing.contact.direction)
    free = max(ends, key=lambda end: float(np.linalg.norm(end - busy)))
    drawing.text(free + np.array([0.0, 4.0]), "tool", colour=GREEN, bold=True)


def _main_way(points: Array) -> Array:
    """Direction in which points are spread most, shape (2,)."""
    return np.asarray(np.linalg.svd(points, full_matrices=False)[2][0])


def _draw_gauge(drawing: Drawing, view: _View, standing: Standing, reach: float) -> None:
    """Plunger and dial, and the way in which the dial grows."""
    direction, foot = standing.contact.direction, view.flat(standing.point)
    dial = view.flat(standing.point + reach * direction)
    drawing.line([foot, dial], stroke="#fff", width=2.4)
    drawing.line([foot, dial], stroke="#222", width=0.9)
    radius = 5.0
    drawing.circle(dial, radius, fill="#fff", stroke="#222", width=0.9)
    drawing.line([dial, dial + 0.7 * radius * np.array([0.5, -0.86])], stroke="#222", width=0.6)
    drawing.circle(foot, 1.1, fill="#222", stroke="#fff")
    way = view.way(direction)
    length = float(np.linalg.norm(way))
    words = f"dial grows {axis_name(direction)}".strip()
    # beyond the dial, where the plunger is not
    below = 8.0 if way[1] > -0.05 else -8.0
    drawing.text(dial + np.array([0.0, below]), words, colour=ORANGE, bold=True)
    if length < 0.1:
        return
    way /= length
    side = 3.2 * np.array([-way[1], way[0]])
    span = float(np.linalg.norm(dial - foot)) - radius
    drawing.arrow(
        foot + side + 0.15 * span * way, foot + side + 0.95 * span * way, stroke=ORANGE, width=0.9
    )


def _draw_axes(drawing: Drawing, view: _View, origin: Array) -> None:
    """The world's axes; those that are seen from their ends are left out."""
    for name, axis in zip("xyz", np.eye(3), strict=True):
        way = view.way(axis)
        if np.linalg.norm(way) < 0.35:
            continue
        drawing.arrow(origin, origin + 9.0 * way, stroke=GREY, width=0.5)
        drawing.text(origin + 11.5 * way, name, colour="#444", size=3.4)


def draw_cut(standing: Standing) -> str:
    """The rods of the leg cut where the tip touches, seen along the leg from its drive.

    Empty where no leg is touched.
    """
    leg = standing.leg
    if leg is None:
        return ""
    root, tip = _place(standing, leg.root), _place(standing, leg.tip)
    axis = (tip - root) / np.linalg.norm(tip - root)
    cuts = {name: _cut(standing, r.root, r.tip, axis) for name, r in leg.rods.items()}
    line = _cut(standing, leg.root, leg.tip, axis)
    direction = standing.contact.direction
    spread = [np.linalg.norm(p - line) for p in cuts.values()]
    far = 0.75 * max([0.02, *[2.0 * float(v) for v in spread]])
    dial = standing.point + far * direction
    around = [line, standing.point, dial + 0.25 * far * direction, *cuts.values()]
    if standing.tip is not None and standing.tip.edge is not None:
        edge = 0.5 * standing.tip.width * standing.tip.edge
        around += [standing.point - edge, standing.point + edge]
    radius = max([0.0, *[r.radius for r in leg.rods.values()]])
    every = np.array([p + s * radius * e for p in around for e in np.eye(3) for s in (-1, 1)])
    up = np.eye(3)[2] if abs(axis[2]) < 0.9 else np.eye(3)[1]
    view = _View(axis, up, every, (CUT, CUT))
    drawing = Drawing(CUT, CUT)
    for name, place in cuts.items():
        rod = leg.rods[name]
        own = standing.rod is not None and name == standing.rod.name
        centre = view.flat(place)
        drawing.circle(
            centre,
            view.scale * rod.radius,
            fill="#9cc7e6" if own else "#e3e7ec",
            stroke=BLUE if own else "#4d5661",
            width=0.5,
        )
        drawing.text(
            centre + _beside_rod(view, direction, rod.radius),
            f"rod {name}",
            colour=BLUE if own else "#4d5661",
            bold=own,
            size=3.6,
        )
    if standing.rod is None:
        drawing.circle(view.flat(line), 0.8, fill=BLUE, stroke=BLUE)
        # where neither the plunger nor the arrow beside it is
        way = view.way(direction)
        shift = -np.array([-way[1], way[0]]) if abs(way[0]) > abs(way[1]) else -way
        drawing.text(view.flat(line) + 4.5 * shift, "the line between", colour=BLUE)
    _draw_plunger(drawing, view, standing, dial)
    _draw_axes(drawing, view, _free_corner(view.flat(np.array(around))))
    return drawing.to_svg(f"Setup {standing.setup.name}: the rods seen along leg {leg.name}")


def _beside_rod(view: _View, direction: Array, radius: float) -> Array:
    """From a rod's middle to its name on paper: where neither plunger nor arrow is."""
    way = view.way(direction)
    height = -way[1] if abs(way[1]) > abs(way[0]) else -way[0]
    return np.array([0.0, np.copysign(view.scale * radius + 3.8, height)])


def _free_corner(taken: Array) -> Array:
    """Where axes stand on paper: in the corner that is furthest from all places."""
    near, far, below = 13.0, CUT - 13.0, 18.0  # below the line of words at the top
    corners = np.array([[near, far], [far, far], [near, below], [far, below]])
    distance = np.linalg.norm(corners[:, None] - taken[None], axis=2).min(axis=1)
    return np.asarray(corners[int(distance.argmax())])


def _cut(standing: Standing, root: str, tip: str, axis: Array) -> Array:
    """Where a line crosses the plane square to the leg in which it is touched, shape (3,), [m]."""
    a, b = _place(standing, root), _place(standing, tip)
    share = (standing.point - a) @ axis / ((b - a) @ axis)
    return np.asarray(a + share * (b - a))


def _draw_plunger(drawing: Drawing, view: _View, standing: Standing, dial: Array) -> None:
    """Tip, plunger and dial, to scale where they touch."""
    direction, touch = standing.contact.direction, standing.tip
    foot, end = view.flat(standing.point), view.flat(dial)
    way = view.way(direction)
    way /= max(float(np.linalg.norm(way)), 1e-9)
    across = np.array([-way[1], way[0]])
    top = foot
    if touch is not None and touch.edge is None:
        rim = view.scale * touch.radius
        place = standing.point
        if standing.rod is not None:
            centre = _cut(standing, standing.rod.root, standing.rod.tip, standing.contact.along)
            normal = place - centre
            place = centre + (1.0 + touch.radius / standing.rod.radius) * normal
        top = view.flat(place)
        drawing.circle(top, max(rim, 0.6), fill="#222", stroke="#222")
    elif touch is not None:
        half = 0.5 * view.scale * touch.width * across
        drawing.line([foot - half, foot + half], stroke="#222", width=1.2)
    drawing.line([top, top + ((end - top) @ way) * way], stroke="#222", width=0.9)
    end = top + ((end - top) @ way) * way
    drawing.circle(end, 6.5, fill="#fff", stroke="#222", width=0.9)
    drawing.line([end, end + 4.6 * np.array([0.5, -0.86])], stroke="#222", width=0.6)
    side = 4.5 * across
    span = float(np.linalg.norm(end - top)) - 6.5
    drawing.arrow(
        top + side + 0.1 * span * way, top + side + 0.95 * span * way, stroke=ORANGE, width=0.9
    )
    words = f"grows {axis_name(direction)}".strip()
    room = 3.0 + 0.28 * 3.1 * len(words) * abs(float(across[0]))
    drawing.text(top + 0.5 * span * way + side + room * across, words, colour=ORANGE, bold=True)
    if standing.rod is not None and np.linalg.norm(standing.aside) > 0.05 * MM:
        drawing.text(
            np.array([CUT / 2.0, 4.0]),
            f"{np.linalg.norm(standing.aside) / MM:.1f} mm beside the middle, towards "
            f"{direction_words(standing.aside)}",
            size=2.8,
        )
