"""Pictures of the sheet: the machine with its gauge, and the section through the rods of a leg.

They are line drawings in SVG, in mm on paper: they need no browser, print and copy well. Labels
are placed last, where they cover neither each other nor, if possible, what is drawn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import meshcat.geometry as g
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull, QhullError

from orthocal.arrays import Array
from orthocal.assessment.wording import axis_name, name_direction
from orthocal.io.html import escape
from orthocal.output.sheet.gauge_position import ABOUT_ALONG, GaugePosition
from orthocal.output.text.layout import short_name
from orthocal.robot.model import Robot
from orthocal.sensors.protocol import has_dial
from orthocal.units import MM
from orthocal.viewer.machine import VIEW
from orthocal.viewer.visuals import Visual

BLUE, ORANGE, GREEN, GREY = "#0063a6", "#c55a00", "#007a4d", "#8a8f98"
BLACK, DARK, TOUCHED = "#222", "#4d5661", "#9cc7e6"

MACHINE_SIZE = (104.0, 80.0)
"""Width and height of the picture of the machine, [mm]."""

SECTION_SIZE = (68.0, 68.0)
"""Width and height of the picture of the rods, [mm]."""

MARGIN = 7.0
"""Free border of a picture, [mm]."""

MESH_POINTS = 400
"""Largest number of vertices from which the outline of a mesh is drawn."""

TEXT_SIZE = 3.1
"""Font size of labels, [mm]."""

LINE_HEIGHT = 1.25
"""Height of a line of a label, in font sizes."""

GAP = 0.6
"""Smallest distance between two labels, and of a label from the border, [mm]."""

COVERING = 5.0
"""Distance that a label moves to uncover 1 mm of a line, [mm]."""

REACHES = (8.0, 32.0, math.inf)
"""Distances within which the place of a label is sought, one after the other, [mm]."""

CELL = 0.5
"""Side of the cells in which drawn points are counted, [mm]."""

STEP = 0.8
"""Distance between the places that are compared for a label, [mm]."""

LONGEST_NAME = 14
"""Characters of a leg's or rod's name in a label."""

LEADER = 5.0
"""Distance from its point above which a label has a leader line, [mm]."""

_NARROW, _WIDE = frozenset(" .,:;'|!()[]ijltfr"), frozenset("mwMW@%&+−<>=~…QO")


@dataclass(frozen=True, slots=True, eq=False)
class _Label:
    """One or several lines of text, and the point that they name."""

    point: ArrayLike
    """The point, shape (2,), [mm]."""
    text: str
    shift: ArrayLike = (0.0, 0.0)
    """From the point to the wanted middle of the text, shape (2,), [mm]."""
    colour: str = "#111"
    size: float = TEXT_SIZE
    """Font size, [mm]."""
    bold: bool = False
    leader: bool = True
    """Whether a line leads to the point if the label is far from it."""

    @property
    def wanted(self) -> Array:
        """Wanted middle of the text, shape (2,), [mm]."""
        return np.add(self.point, np.asarray(self.shift, dtype=np.float64))

    @property
    def half(self) -> Array:
        """Half the width and half the height of the text, in any common font, [mm]."""
        lines = self.text.split("\n")
        width = max(sum(_character_width(c, self.bold) for c in line) for line in lines)
        return 0.5 * self.size * np.array([width, LINE_HEIGHT * len(lines)])


def _character_width(character: str, bold: bool) -> float:
    """Upper bound of a character's width in a sans-serif font, in font sizes."""
    if ord(character) > 0x2FF and character not in "−…σµ":
        return 1.05
    narrow, wide, other = (0.46, 1.05, 0.74) if bold else (0.42, 0.98, 0.68)
    return narrow if character in _NARROW else wide if character in _WIDE else other


@dataclass(slots=True, eq=False)
class Picture:
    """A line drawing; points are in mm from its upper left corner, y downwards."""

    width: float
    height: float
    parts: list[str] = field(default_factory=list)
    labels: list[_Label] = field(default_factory=list)
    _drawn: list[Array] = field(default_factory=list)
    """Points of what labels should not cover, a point about every millimetre, shape (n, 2)."""

    def polygon(self, points: Array, *, fill: str, stroke: str, width: float = 0.2) -> None:
        """A closed outline that labels may cover, points of shape (n, 2)."""
        self.parts.append(
            f'<polygon points="{_pairs(points)}" fill="{fill}" stroke="{stroke}" '
            f'stroke-width="{width:g}" stroke-linejoin="round"/>'
        )

    def line(
        self, points: ArrayLike, *, stroke: str = BLACK, width: float = 0.4, dash: str = ""
    ) -> None:
        """A line through points, shape (n, 2)."""
        points = np.asarray(points, dtype=np.float64)
        for start, end in pairwise(points):
            count = 2 + int(np.linalg.norm(end - start))
            self._drawn.append(np.linspace(start, end, count))
        dashed = f' stroke-dasharray="{dash}"' if dash else ""
        self.parts.append(
            f'<polyline points="{_pairs(points)}" fill="none" stroke="{stroke}" '
            f'stroke-width="{width:g}"{dashed}/>'
        )

    def circle(
        self,
        centre: ArrayLike,
        radius: float,
        *,
        fill: str = "none",
        stroke: str = BLACK,
        width: float = 0.3,
    ) -> None:
        """A circle."""
        x, y = np.asarray(centre)
        rings = [s * radius * circle_points() for s in np.arange(0.2, 1.01, 0.2)]
        self._drawn.append(np.concatenate(rings) + np.asarray(centre))
        self.parts.append(
            f'<circle cx="{x:.2f}" cy="{y:.2f}" r="{radius:.2f}" fill="{fill}" '
            f'stroke="{stroke}" stroke-width="{width:g}"/>'
        )

    def arrow(
        self,
        foot: ArrayLike,
        tip: ArrayLike,
        *,
        stroke: str,
        width: float = 0.6,
        both: bool = False,
    ) -> None:
        """An arrow with a head at its tip, or at both ends; nothing below 0.5 mm."""
        a, b = np.asarray(foot, dtype=np.float64), np.asarray(tip, dtype=np.float64)
        length = float(np.linalg.norm(b - a))
        if length < 0.5:
            return
        along = (b - a) / length
        head = min(2.2 + width, 0.6 * length)
        inset = 0.8 * head * along
        self._drawn.append(np.linspace(a, b, 2 + int(length)))
        self.line([a + inset if both else a, b - inset], stroke=stroke, width=width)
        side = 0.38 * head * np.array([-along[1], along[0]])
        for end, way in ((b, along), (a, -along))[: 1 + both]:
            corners = np.array([end, end - head * way + side, end - head * way - side])
            self.polygon(corners, fill=stroke, stroke=stroke, width=0.1)

    def label(self, point: ArrayLike, text: str, **look: Any) -> None:  # noqa: ANN401 - of _Label
        """A label for a point; see `_Label`."""
        self.labels.append(_Label(point, text, **look))

    def place_labels(self) -> list[tuple[_Label, Array]]:
        """Labels and their middles, disjoint and on the paper, in the order of their importance.

        Each label gets the free place nearest to where it is wanted; what it would cover counts
        as distance. A label without any free place is left out.
        """
        count = self._count_drawn()
        placed: list[tuple[_Label, Array]] = []
        for label in self.labels:
            for reach in REACHES:
                middle, cost = self._place(label, placed, count, reach)
                if cost <= reach:  # farther places cost more
                    break
            if middle is not None:
                placed.append((label, middle))
        return placed

    def _place(
        self, label: _Label, placed: Sequence[tuple[_Label, Array]], count: Array, reach: float
    ) -> tuple[Array | None, float]:
        """Best free middle of a label and its cost, [mm]; None without a place within reach."""
        half = label.half
        low, high = half + GAP, np.array([self.width, self.height]) - half - GAP
        if (low > high).any():
            return None, math.inf
        wanted = np.clip(label.wanted, low, high)
        lines = [np.r_[w, np.arange(a, b, STEP)] for w, a, b in zip(wanted, low, high, strict=True)]
        x, y = (v[np.abs(v - w) <= reach] for v, w in zip(lines, label.wanted, strict=True))
        centres = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        for other, middle in placed:
            apart = (np.abs(centres - middle) >= half + other.half + GAP).any(axis=1)
            centres = centres[apart]
        if not len(centres):
            return None, math.inf
        first = np.floor((centres - half) / CELL).astype(int)
        last = np.ceil((centres + half) / CELL).astype(int)
        (a, b), (c, d) = first.T, last.T
        covered = count[c, d] - count[a, d] - count[c, b] + count[a, b]
        cost = np.linalg.norm(centres - label.wanted, axis=1) + COVERING * covered
        best = int(cost.argmin())
        return centres[best], float(cost[best])

    def _count_drawn(self) -> Array:
        """Number of drawn points between the upper left corner and each corner of the cells."""
        points = np.concatenate([np.zeros((0, 2)), *self._drawn])
        edges = [np.arange(0.0, side + 2.0 * CELL, CELL) for side in (self.width, self.height)]
        counts = np.histogram2d(points[:, 0], points[:, 1], bins=edges)[0]
        return np.asarray(np.pad(counts.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0))))

    def to_svg(self, title: str) -> str:
        """The picture as an element of a page.

        Args:
            title: Description for those who do not see the picture.
        """
        placed = self.place_labels()
        texts = "".join(_leader(*label) + _text(*label) for label in placed)
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width:g} '
            f'{self.height:g}" style="width:{self.width:g}mm;max-width:100%;height:auto" '
            f'role="img" aria-label="{escape(title)}" font-family="Helvetica, Arial, sans-serif">'
            f"<title>{escape(title)}</title>{''.join(self.parts)}{texts}</svg>"
        )


def _text(label: _Label, middle: Array) -> str:
    weight = ' font-weight="bold"' if label.bold else ""
    top, step = middle[1] - label.half[1], LINE_HEIGHT * label.size
    lines = "".join(
        f'<tspan x="{middle[0]:.2f}" y="{top + (i + 0.78) * step:.2f}">{escape(line)}</tspan>'
        for i, line in enumerate(label.text.split("\n"))
    )
    return (
        f'<text font-size="{label.size:g}" fill="{label.colour}" text-anchor="middle"{weight} '
        f'stroke="#fff" stroke-width="0.8" paint-order="stroke" stroke-linejoin="round">{lines}'
        "</text>"
    )


def _leader(label: _Label, middle: Array) -> str:
    """A thin line from a label to its point, if they are far apart."""
    point = np.asarray(label.point, dtype=np.float64)
    edge = np.clip(point, middle - label.half, middle + label.half)
    wanted = float(np.linalg.norm(label.wanted - point))
    if not label.leader or np.linalg.norm(edge - point) < max(LEADER, wanted):
        return ""
    return f'<polyline points="{_pairs([edge, point])}" stroke="{GREY}" stroke-width="0.2"/>'


def _pairs(points: ArrayLike) -> str:
    return " ".join(f"{x:.2f},{y:.2f}" for x, y in np.asarray(points))


def outline(points: Array) -> Array:
    """Convex hull of points in the plane, shape (n, 2); two ends for points in a line."""
    try:
        corners = ConvexHull(points).vertices
    except (QhullError, ValueError):
        corners = np.lexsort(points.T)[[0, -1]]
    return np.asarray(points[corners])


def _is_inside(point: Array, corners: Array) -> bool:
    """True if a point is inside a convex polygon with corners as of `outline`, shape (n, 2)."""
    sides, away = np.roll(corners, -1, axis=0) - corners, point - corners
    return bool((sides[:, 0] * away[:, 1] > sides[:, 1] * away[:, 0]).all())


def circle_points() -> Array:
    """24 points of the unit circle, shape (24, 2)."""
    angles = np.arange(24) * 2.0 * math.pi / 24
    return np.column_stack([np.cos(angles), np.sin(angles)])


class _View:
    """Parallel projection of the world to paper.

    Args:
        forward: Direction of view, shape (3,).
        up: Direction that is up on paper, shape (3,).
        points: Points that must be on the paper, shape (n, 3), [m].
        size: Width and height of the paper, [mm].
    """

    def __init__(self, forward: Array, up: Array, points: Array, size: tuple[float, float]) -> None:
        self.forward = forward / np.linalg.norm(forward)
        right = np.cross(self.forward, up)
        right /= np.linalg.norm(right)
        self.axes = np.column_stack([right, -np.cross(right, self.forward)])
        flat = points @ self.axes
        low, high = flat.min(axis=0), flat.max(axis=0)
        room = np.array(size) - 2.0 * MARGIN
        self.scale = float((room / np.maximum(high - low, 1e-6)).min())
        self.shift = np.array(size) / 2.0 - self.scale * (low + high) / 2.0

    def project(self, points: ArrayLike) -> Array:
        """Points on paper, shape (..., 2), [mm]."""
        return np.asarray(self.scale * (np.asarray(points) @ self.axes) + self.shift)

    def direction(self, vector: Array) -> Array:
        """A vector on paper, in its own unit, shape (2,)."""
        return np.asarray(vector @ self.axes)


def draw_machine(robot: Robot, visuals: Sequence[Visual], gauge: GaugePosition) -> str:
    """Picture of the machine in the alignment posture of a setup, with its gauge."""
    shapes = [(visual, _visual_points(visual, gauge.poses[visual.link])) for visual in visuals]
    reach = 0.32 * float(np.ptp(np.concatenate([p for _, p in shapes]), axis=0).max())
    dial = _gauge_end(gauge, reach)
    surface = np.zeros((0, 3)) if gauge.surface is None else gauge.surface
    points = np.concatenate([*(p for _, p in shapes), dial[None], gauge.tool_path, surface])
    view = _View(-np.array(VIEW), np.eye(3)[2], points, MACHINE_SIZE)
    picture = Picture(*MACHINE_SIZE)

    def joint(frame: str) -> int:
        return int(robot.model.frames[robot.frame_id(frame)].parentJoint)

    rods = {} if gauge.leg is None else gauge.leg.rods
    looks = {joint(rod.root): ("#d6dde5", DARK) for rod in rods.values()}
    if gauge.rod is not None:
        looks[joint(gauge.rod.root)] = (TOUCHED, BLUE)
    shapes.sort(key=lambda s: -float((s[1] @ view.forward).mean()))
    parts = [
        (outline(view.project(p)), *looks.get(joint(v.link), ("#f1f2f4", "#9aa0a8")))
        for v, p in shapes
    ]
    # the longest part of the touched rod; parts in front of it do not hide the place of contact
    sizes = [np.ptp(e, axis=0).max() * (fill == TOUCHED) for e, fill, _ in parts]
    rod, contact = int(np.argmax(sizes)), view.project(gauge.point)
    for k, (edge, fill, stroke) in enumerate(parts):
        hides = sizes[rod] > 0.0 and k > rod and _is_inside(contact, edge)
        picture.polygon(edge, fill="none" if hides else fill, stroke=stroke)
    if len(surface):
        picture.polygon(view.project(surface), fill="#dbe9d8", stroke=GREEN, width=0.4)
    _draw_tool_path(picture, view, gauge)
    _draw_sensor(picture, view, gauge, dial)
    _draw_axes(picture, view, np.array([14.0, 18.0]))
    _label_leg(picture, view, gauge)
    return picture.to_svg(f"Setup {gauge.setup.name}: the gauge on the machine")


def _gauge_end(gauge: GaugePosition, reach: float) -> Array:
    """Fixed end of a bar, or the centre of a dial, in the alignment posture, shape (3,), [m]."""
    contact = gauge.contact
    if contact.fixed is not None:
        return contact.fixed
    if gauge.facing is not None:  # between two rods
        reach = min(reach, 0.5 * gauge.facing[1])
    return np.asarray(gauge.point + (-reach if contact.at_tool else reach) * contact.direction)


def _draw_sensor(picture: Picture, view: _View, gauge: GaugePosition, end: Array) -> None:
    """A dial or a bar up to its end, shape (3,), [m], and its contact in the alignment posture."""
    foot, far = view.project(gauge.point), view.project(end)
    if gauge.contact.fixed is None:
        _draw_dial(picture, view, gauge, foot, far, radius=5.0)
    else:
        _draw_bar(picture, foot, far)
    picture.circle(foot, 1.1, fill=BLACK, stroke="#fff")


def _draw_bar(picture: Picture, ball: Array, fixed: Array) -> None:
    """A ball bar on paper, from its fixed ball to the ball at the tool, which is drawn later."""
    picture.line([fixed, ball], stroke="#fff", width=2.4)
    picture.line([fixed, ball], width=0.9)
    picture.circle(fixed, 1.6, fill=BLUE, stroke="#fff")
    picture.label(fixed, "fixed ball", shift=(0.0, 4.5), colour=BLUE, bold=True)
    way = ball - fixed
    length = float(np.linalg.norm(way))
    if length < 4.0:
        return
    side = 2.6 * np.array([-way[1], way[0]]) / length
    foot, tip = fixed + 0.3 * way + side, fixed + 0.9 * way + side
    picture.arrow(foot, tip, stroke=ORANGE, width=0.9)
    picture.label(0.5 * (foot + tip), "dial grows", shift=2.0 * side, colour=ORANGE, bold=True)


def _visual_points(visual: Visual, pose: Array) -> Array:
    """World points whose convex hull is that of a visual, shape (n, 3), [m]."""
    points, placement = visual.corners, visual.placement
    local = (points - placement[:3, 3]) @ placement[:3, :3]
    low, high = local.min(axis=0), local.max(axis=0)
    if isinstance(visual.geometry, g.Cylinder):
        ring = circle_points() * (high[:2] - low[:2]) / 2.0 + (high[:2] + low[:2]) / 2.0
        local = np.concatenate([np.insert(ring, 2, z, axis=1) for z in (low[2], high[2])])
    elif isinstance(visual.geometry, g.Sphere):
        rings = [np.insert(circle_points(), k, 0.0, axis=1) for k in range(3)]
        local = np.concatenate(rings) * (high[0] - low[0]) / 2.0
    elif isinstance(visual.geometry, g.TriangularMeshGeometry):
        vertices = np.asarray(visual.geometry.vertices, dtype=np.float64)
        vertices = vertices if vertices.shape[1] == 3 else vertices.T
        local = vertices[:: max(1, len(vertices) // MESH_POINTS)]
    points = local @ placement[:3, :3].T + placement[:3, 3]
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def _label_leg(picture: Picture, view: _View, gauge: GaugePosition) -> None:
    """Names of the leg and of its rods; the leg's line if no rod is touched."""
    leg = gauge.leg
    if leg is None:
        return
    root, tip = gauge.origin(leg.root), gauge.origin(leg.tip)
    if gauge.rod is None:
        picture.line(view.project([root, tip]), stroke=BLUE, width=0.7, dash="2.5 1.2")
    for name, rod in leg.rods.items():
        start, end = gauge.origin(rod.root), gauge.origin(rod.tip)
        at = 0.8 * start + 0.2 * end
        side = view.direction(at - 0.5 * (root + tip) - ((at - root) @ leg.axis) * leg.axis)
        side /= max(float(np.linalg.norm(side)), 1e-9)
        touched = gauge.rod is not None and name == gauge.rod.name
        picture.label(
            view.project(at),
            short_name(name, LONGEST_NAME),
            shift=4.0 * side,
            colour=BLUE if touched else DARK,
            bold=True,
            size=4.0,
        )
    outwards = view.direction(root - tip)
    outwards /= max(float(np.linalg.norm(outwards)), 1e-9)
    name = f"leg {short_name(leg.name, LONGEST_NAME)}"
    picture.label(view.project(root), name, shift=13.0 * outwards, bold=True, size=3.6)


def _draw_tool_path(picture: Picture, view: _View, gauge: GaugePosition) -> None:
    """Path of the tool through the postures, with a dot at the first."""
    if not len(gauge.tool_path):
        return
    points = view.project(gauge.tool_path)
    centred = points - points.mean(axis=0)
    along = np.linalg.svd(centred, full_matrices=False)[2][0]
    ends = points[np.argsort(centred @ along)][[0, -1]]
    picture.line(points, stroke=GREEN, width=0.35)
    picture.arrow(ends[0], ends[1], stroke=GREEN, width=0.7, both=True)
    picture.circle(points[0], 1.2, fill=GREEN, stroke="#fff")
    picture.label(ends[0], "tool", shift=(0.0, 4.0), colour=GREEN, bold=True)


def _draw_dial(
    picture: Picture, view: _View, gauge: GaugePosition, top: Array, dial: Array, *, radius: float
) -> None:
    """Plunger, dial or probe, and an arrow in the direction in which readings grow; not for points.

    Args:
        picture: The picture.
        view: Its projection.
        gauge: The gauge.
        top: Lower end of the plunger on paper, [mm].
        dial: Centre of the dial on paper, [mm].
        radius: Largest radius of the dial on paper, [mm].
    """
    if not np.any(gauge.contact.direction):
        return
    radius = min(radius, 0.45 * float(np.linalg.norm(dial - top)))
    picture.line([top, dial], stroke="#fff", width=2.4)
    picture.line([top, dial], width=0.9)
    shown = "dial" if has_dial(gauge.setup.sensor) else "reading"
    if shown == "dial":
        picture.circle(dial, radius, fill="#fff", width=0.9)
        picture.line([dial, dial + 0.7 * radius * np.array([0.5, -0.86])], width=0.6)
    else:
        picture.line([top + 0.6 * (dial - top), dial], width=5.0)
    text = f"{shown} grows {axis_name(gauge.contact.direction)}".strip()
    way = view.direction(gauge.contact.direction)
    length = float(np.linalg.norm(way))
    if length < 0.1:
        picture.label(dial, text, shift=(0.0, radius + 3.0), colour=ORANGE, bold=True)
        return
    way /= length
    side = 0.65 * radius * np.array([-way[1], way[0]])
    span = float(np.linalg.norm(dial - top)) - radius
    foot, tip = (top + side + share * span * way for share in (0.12, 0.95))
    picture.arrow(foot, tip, stroke=ORANGE, width=0.9)
    middle = 0.5 * (foot + tip)
    picture.label(middle, text, shift=side, colour=ORANGE, bold=True, leader=False)


def _draw_axes(picture: Picture, view: _View, origin: Array) -> None:
    """The axes of the world, without those seen end on."""
    for name, axis in zip("xyz", np.eye(3), strict=True):
        way = view.direction(axis)
        if np.linalg.norm(way) < 0.35:
            continue
        picture.arrow(origin, origin + 9.0 * way, stroke=GREY, width=0.5)
        tip = origin + 9.0 * way
        picture.label(tip, name, shift=2.8 * way, colour="#444", size=3.4, leader=False)


def draw_tool(gauge: GaugePosition) -> str:
    """Picture of a sensor at the tool: its contacts, the bar or the artefact, without the machine.

    The view is along the axis of the world that shows most, or oblique for contacts in space.
    """
    contact = gauge.contact
    parts = [contact.points, *([] if gauge.surface is None else [gauge.surface])]
    parts += [] if contact.fixed is None else [contact.fixed[None]]
    size = max(float(np.ptp(np.concatenate(parts), axis=0).max()), 0.02)
    end = _gauge_end(gauge, 0.35 * size)
    # the arrow at a dial points beyond its foot
    ahead = 2.0 * contact.points[gauge.aligned] - end if contact.fixed is None else end
    around = np.concatenate([*parts, [end, ahead]])
    spread = np.linalg.svd(around - around.mean(axis=0))
    flat = len(around) > 2 and spread[1][-1] < 0.02 * spread[1][0]
    forward = -np.array(VIEW)
    if flat:
        normal = spread[2][-1]
        forward = normal * np.sign(normal @ forward)
    up = np.eye(3)[2] if abs(forward[2]) < 0.9 * np.linalg.norm(forward) else np.eye(3)[1]
    view = _View(forward, up, around, SECTION_SIZE)
    picture = Picture(*SECTION_SIZE)
    if gauge.surface is not None:
        picture.polygon(view.project(gauge.surface), fill="#dbe9d8", stroke=GREEN, width=0.4)
    for place in view.project(contact.points):
        picture.circle(place, 0.9, fill=GREEN, stroke="#fff")
    _draw_sensor(picture, view, gauge, end)
    _draw_axes(picture, view, _free_corner(view.project(around)))
    return picture.to_svg(f"Setup {gauge.setup.name}: the places of its readings")


def draw_section(gauge: GaugePosition) -> str:
    """Picture of the rods of a leg, cut at the contact and seen along the leg from its drive.

    Returns:
        "" if the sensor is at no leg.
    """
    leg = gauge.leg
    if leg is None:
        return ""
    axis = gauge.origin(leg.tip) - gauge.origin(leg.root)
    axis /= np.linalg.norm(axis)
    rods = {name: gauge.cut(rod, axis) for name, rod in leg.rods.items()}
    line = gauge.cut(leg, axis)
    direction = gauge.contact.direction
    spread = max([0.0, *(float(np.linalg.norm(p - line)) for p in rods.values())])
    dial = _gauge_end(gauge, 0.75 * max(0.02, 2.0 * spread))
    around = [line, gauge.point, 1.25 * dial - 0.25 * gauge.point, *rods.values()]
    if gauge.tip is not None and gauge.tip.edge is not None:
        half = 0.5 * gauge.tip.width * gauge.tip.edge
        around += [gauge.point - half, gauge.point + half]
    radius = max([0.0, *(rod.radius for rod in leg.rods.values())])
    points = np.array([p + s * radius * e for p in around for e in np.eye(3) for s in (-1, 1)])
    up = np.eye(3)[2] if abs(axis[2]) < 0.9 else np.eye(3)[1]
    view = _View(axis, up, points, SECTION_SIZE)
    picture = Picture(*SECTION_SIZE)
    _draw_axes(picture, view, _free_corner(view.project(np.array(around))))
    for name, place in rods.items():
        rod, centre = leg.rods[name], view.project(place)
        touched = gauge.rod is not None and name == gauge.rod.name
        fill, stroke = (TOUCHED, BLUE) if touched else ("#e3e7ec", DARK)
        size = view.scale * rod.radius
        picture.circle(centre, size, fill=fill, stroke=stroke, width=0.5)
        text = f"rod {short_name(name, LONGEST_NAME)}"
        picture.label(centre, text, shift=(0.0, size + 3.8), colour=stroke, bold=touched, size=3.6)
    if gauge.rod is None:
        at = view.project(line)
        picture.circle(at, 0.8, fill=BLUE, stroke=BLUE)
        picture.label(at, "line between\nthe rods", shift=(0.0, 5.0), colour=BLUE)
    top = view.project(_tip_centre(gauge))
    if gauge.rod is not None and np.linalg.norm(gauge.lateral_offset) > 0.05 * MM:
        offset = f"{np.linalg.norm(gauge.lateral_offset) / MM:.1f} mm off centre"
        text = f"{offset},\ntowards {name_direction(gauge.lateral_offset, cosine=ABOUT_ALONG)}"
        picture.label(top, text, shift=(0.0, -6.0), size=2.8)
    way = view.direction(direction)
    way /= max(float(np.linalg.norm(way)), 1e-9)
    end = top + ((view.project(dial) - top) @ way) * way
    _draw_dial(picture, view, gauge, top, end, radius=6.5)
    _draw_tip(picture, view, gauge, top)
    return picture.to_svg(f"Setup {gauge.setup.name}: the rods seen along leg {leg.name}")


def _free_corner(points: Array) -> Array:
    """The corner of the section that is furthest from all points, shape (2,), [mm]."""
    low, high = 13.0, SECTION_SIZE[0] - 13.0
    corners = np.array([[x, y] for y in (high, low) for x in (low, high)])
    distance = np.linalg.norm(corners[:, None] - points, axis=2).min(axis=1)
    return np.asarray(corners[int(distance.argmax())])


def _tip_centre(gauge: GaugePosition) -> Array:
    """Centre of a ball, else the point of contact, in the alignment posture, shape (3,), [m]."""
    if gauge.rod is None or gauge.tip is None or gauge.tip.edge is not None:
        return gauge.point
    axis = gauge.cut(gauge.rod, gauge.contact.along)
    return np.asarray(axis + (1.0 + gauge.tip.radius / gauge.rod.radius) * (gauge.point - axis))


def _draw_tip(picture: Picture, view: _View, gauge: GaugePosition, top: Array) -> None:
    """Draw a ball or an edge to scale."""
    if gauge.tip is None:
        return
    if gauge.tip.edge is None:
        radius = max(view.scale * gauge.tip.radius, 0.6)
        picture.circle(top, radius, fill=BLACK, stroke=BLACK)
        return
    half = 0.5 * gauge.tip.width * gauge.tip.edge
    picture.line(view.project([gauge.point - half, gauge.point + half]), width=1.2)
