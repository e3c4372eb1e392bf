"""Scene of a robot: ground, axes, camera, links and leg lines."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np
from meshcat.transformations import translation_matrix

from orthocal.arrays import Array
from orthocal.robot.model import Robot
from orthocal.units import MM
from orthocal.viewer.motion import Timeline, place_frames
from orthocal.viewer.scene import Camera, Label, LegendEntry, Scene, node_name
from orthocal.viewer.shapes import (
    Colour,
    css,
    cylinder,
    draw_axes,
    draw_ground,
    material,
    pose_along,
    to_triple,
)
from orthocal.viewer.visuals import load_visuals

GROUND = "Ground"
AXES = "Axes x, y, z"
LINES = "Leg lines"

GHOST_COLOUR: Colour = (0.0, 0.62, 0.66)
GHOST_OPACITY = 0.25
LINE_COLOUR: Colour = (0.1, 0.1, 0.12)
SOLID_COLOUR: Colour = (0.5, 0.52, 0.55)
"""Colour of a machine in the legend; its links have the colours of their visuals."""

VIEW = (1.0, 0.72, 0.5)
"""Direction from the machine to the camera."""

EQUAL_POSES = 1e-12
"""Largest difference of equal poses, [m or 1]."""


class MachineScene:
    """Scene with ground, axes and camera for a robot.

    Args:
        robot: The nominal robot.
        title: Title of the scene.
        sensor_frames: Frames that sensors measure.

    Raises:
        RobotError: If the visuals of the robot cannot be loaded.
    """

    def __init__(self, robot: Robot, title: str, *, sensor_frames: Iterable[str] = ()) -> None:
        self.robot = robot
        self.scene = scene = Scene(title)
        self.visuals = load_visuals(robot)
        links = [v.link for v in self.visuals]
        ends = [frame for leg in robot.legs.values() for frame in (leg.root, leg.tip)]
        tool = [robot.tcp.frame] if robot.tcp else []
        self.frames = tuple(dict.fromkeys([*links, *ends, *tool]))
        """Names of the links, ends of the leg lines and tool centre point."""
        self.all_frames = tuple(dict.fromkeys([*self.frames, *sensor_frames]))
        """`frames` and the frames that sensors measure."""
        passive = robot.reference_passive
        corners = self._corners(place_frames(robot, robot.drive_zero, passive, self.frames))
        points = corners.reshape(-1, 3)
        low, high = points.min(axis=0), points.max(axis=0)
        self.size = float((high - low).max())
        """Largest side of the box around the machine in its mechanical zero, [m]."""
        pitch = 10.0 ** math.floor(math.log10(self.size / 2.0))
        self._ground = np.append(np.round((low + high)[:2] / 2.0 / pitch) * pitch, np.inf)
        """Middle of the ground, and height of the lowest shape above it, [m]."""
        for default in ("Grid", "Axes"):
            scene.visualizer[f"/{default}"].delete()
        scene.set_property("Background", "top_color", [1.0, 1.0, 1.0])
        scene.set_property("Background", "bottom_color", [0.80, 0.85, 0.90])
        draw_ground(scene, GROUND, side=2.0 * self.size, pitch=pitch)
        scene.facts.append(f"Squares on the ground: {pitch / MM:g} mm.")
        draw_axes(scene, AXES, length=0.15 * self.size)

    def _corners(self, poses: Mapping[str, Array]) -> Array:
        """Corners of all visuals in F frames, shape (F, n, 3), [m]."""
        corners = []
        for visual in self.visuals:
            pose = poses[visual.link]
            rotated = visual.corners @ pose[:, :3, :3].transpose(0, 2, 1)
            corners.append(rotated + pose[:, None, :3, 3])
        return np.concatenate(corners, axis=1)

    def draw_machine(
        self,
        node: str,
        text: str,
        timeline: Timeline,
        poses: Mapping[str, Array],
        *,
        ghost_of: Mapping[str, Array] | None = None,
    ) -> None:
        """Draw and animate the links of a machine.

        Args:
            node: Name of the node.
            text: Text of the legend.
            timeline: Times of the frames.
            poses: Frame to poses, shape (F, 4, 4), [m].
            ghost_of: Poses of the solid machine, if this machine is its ghost. A ghost has only
                links that deviate.
        """
        counts: dict[str, int] = {}
        for visual in self.visuals:
            link = visual.link
            if ghost_of is not None and np.abs(poses[link] - ghost_of[link]).max() < EQUAL_POSES:
                continue
            counts[link] = counts.get(link, 0) + 1
            look = material(visual.colour, opacity=visual.opacity, shiny=True)
            if ghost_of is not None:
                look = material(GHOST_COLOUR, opacity=GHOST_OPACITY)
            path = f"{node}/{node_name(link)}/part {counts[link]}"
            self.scene.add(path, visual.geometry, look, visual.placement)
        for link in counts:
            self.scene.move(f"{node}/{node_name(link)}", timeline.times, poses[link])
        if counts:
            ghost = ghost_of is not None
            colour = css(GHOST_COLOUR if ghost else SOLID_COLOUR)
            self.scene.explain(LegendEntry(text, (node,), colour, "ghost" if ghost else "solid"))

    def draw_leg_lines(self, timeline: Timeline, poses: Mapping[str, Array]) -> None:
        """Draw, label and animate the lines from the root to the tip of every leg.

        Args:
            timeline: Times of the frames and stops.
            poses: Frame to poses, shape (F, 4, 4), [m].
        """
        for name, leg in self.robot.legs.items():
            path = f"{LINES}/{node_name(f'leg {name}')}"
            roots = poses[leg.root][:, :3, 3]
            along = poses[leg.tip][:, :3, 3] - roots
            length = np.linalg.norm(along, axis=1)
            line = pose_along(roots, along / length[:, None])
            # between two rods it is visible, but a single rod would hide it
            look = material(LINE_COLOUR, in_front=len(leg.rods) < 2)
            self.scene.add(path, cylinder(1.0, 0.0025 * self.size), look)
            self.scene.move(path, timeline.times, line)
            self.scene.place(path, line[0] @ np.diag([1.0, 1.0, length[0], 1.0]))
            scale = np.column_stack([np.ones((len(length), 2)), length])
            self.scene.track(path, "scale", "vector3", timeline.times, scale)
            points = tuple(to_triple(p) for p in roots[timeline.stops])
            texts = (f"leg {name}",) * len(points)
            self.scene.labels.append(Label(points, texts, path, rank=-1.0))
        if self.robot.legs:
            text = "Leg, from its root to its tip"
            self.scene.explain(LegendEntry(text, (LINES,), css(LINE_COLOUR), "line"))

    def look_at(self, *machines: Mapping[str, Array]) -> None:
        """Point the camera at machines and the axes, and put the ground below all frames.

        Args:
            machines: Frame to poses of each machine, shape (F, 4, 4), [m].
        """
        corners = [self._corners(poses) for poses in machines]
        self.lower_ground(min(float(c[..., 2].min()) for c in corners))
        axes = [label.at for label in self.scene.labels if label.node.startswith(f"{AXES}/")]
        points = np.concatenate([*(c[0] for c in corners), *axes])
        middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
        points = np.unique(np.round(points, 4), axis=0)
        self.scene.camera = Camera(to_triple(middle), VIEW, tuple(to_triple(p) for p in points))

    def lower_ground(self, height: float) -> None:
        """Move the ground below a height, [m], if it is not below it."""
        self._ground[2] = min(self._ground[2], height)
        middle = self._ground - [0.0, 0.0, 0.03 * self.size]
        self.scene.place(GROUND, translation_matrix(middle))
