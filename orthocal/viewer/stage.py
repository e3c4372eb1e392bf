"""A robot's scene: ground, axes and camera, and the robot's links and leg lines at any poses."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from orthocal.robot.model import Robot
from orthocal.units import MM
from orthocal.viewer.motion import Film, place_frames
from orthocal.viewer.scene import Camera, Label, Scene, node_name
from orthocal.viewer.shapes import (
    Colour,
    cylinder,
    draw_axes,
    draw_ground,
    material,
    pose_along,
    to_triple,
)
from orthocal.viewer.visuals import Visual, load_visuals

Array = NDArray[np.float64]

GROUND = "Ground"
AXES = "Axes x, y, z"
LINES = "Leg lines"

GHOST_COLOUR: Colour = (0.0, 0.62, 0.66)
GHOST_OPACITY = 0.25
LINE_COLOUR: Colour = (0.1, 0.1, 0.12)

VIEW = (1.0, 0.72, 0.5)
"""From the machine to the camera."""

SAME = 1e-12
"""Poses that differ by less are the same, [m or 1]."""


class Stage:
    """A scene with a robot's ground, axes and camera.

    Args:
        robot: The nominal robot.
        title: Of the scene.
        looked_at: Further frames whose poses are wanted.

    Raises:
        RobotError: If the robot's visuals cannot be loaded.
    """

    def __init__(self, robot: Robot, title: str, *, looked_at: Iterable[str] = ()) -> None:
        self.robot = robot
        self.scene = Scene(title)
        self.visuals = load_visuals(robot)
        self.links = tuple(dict.fromkeys(v.link for v in self.visuals))
        ends = [frame for leg in robot.legs.values() for frame in (leg.root, leg.tip)]
        tool = [robot.tcp.frame] if robot.tcp else []
        self.frames = tuple(dict.fromkeys([*self.links, *ends, *tool]))
        """Links, ends of leg lines and tool centre point."""
        self.followed = tuple(dict.fromkeys([*self.frames, *looked_at]))
        """These, and the further ones."""
        passive = robot.zero[robot.passive_index]
        self.zero = place_frames(robot, robot.drive_zero, passive, self.frames)
        """Frame to its pose in the nominal mechanical zero, shape (1, 4, 4), [m]."""
        points = np.concatenate([self._corners(v) for v in self.visuals])
        self.low, self.high = points.min(axis=0), points.max(axis=0)
        self.size = float((self.high - self.low).max())
        """Largest side of the box around the machine, [m]."""
        self.pitch = 10.0 ** math.floor(math.log10(self.size / 2.0))
        """Of the lines on the ground, [m]."""
        self._furnish()

    def _corners(self, visual: Visual) -> Array:
        pose = self.zero[visual.link][0]
        return np.asarray(visual.corners @ pose[:3, :3].T + pose[:3, 3])

    def _furnish(self) -> None:
        scene, size = self.scene, self.size
        for default in ("Grid", "Axes"):
            scene.visualizer[f"/{default}"].delete()
        scene.set_property("Background", "top_color", [1.0, 1.0, 1.0])
        scene.set_property("Background", "bottom_color", [0.80, 0.85, 0.90])
        draw_ground(scene, GROUND, side=2.0 * size, pitch=self.pitch)
        scene.facts.append(f"Squares on the ground: {self.pitch / MM:g} mm.")
        draw_axes(scene, AXES, length=0.15 * size)
        self.lowest = float(self.low[2])
        """Of all that is drawn and does not lie on the ground, [m]."""
        self.look_at(self.zero)

    def draw_links(
        self,
        node: str,
        poses: Mapping[str, Array],
        *,
        ghost_of: Mapping[str, Array] | None = None,
    ) -> None:
        """Draw links where their first poses are.

        Args:
            node: What the machine is called.
            poses: Frame to poses, shape (F, 4, 4), [m].
            ghost_of: Poses of the solid machine that this is a ghost of: links that are where
                those are, are left out.
        """
        counts: dict[str, int] = {}
        for visual in self.visuals:
            link = visual.link
            if ghost_of is not None and np.abs(poses[link] - ghost_of[link]).max() < SAME:
                continue
            counts[link] = counts.get(link, 0) + 1
            path = f"{node}/{node_name(link)}/part {counts[link]}"
            look = material(visual.colour, opacity=visual.opacity, shiny=True)
            if ghost_of is not None:
                look = material(GHOST_COLOUR, opacity=GHOST_OPACITY)
            self.scene.add(path, visual.geometry, look)
            self.scene.place(path, visual.placement)
        for link in counts:
            self.scene.place(f"{node}/{node_name(link)}", poses[link][0])

    def draw_leg_lines(
        self, poses: Mapping[str, Array], stops: Sequence[int] | NDArray[np.int64]
    ) -> None:
        """Draw every leg's line, from its root to its tip, where their first poses are.

        Args:
            poses: Frame to poses, shape (F, 4, 4), [m].
            stops: Frames of the stops, at each of which the leg's name is by its root.
        """
        for name, leg in self.robot.legs.items():
            path = f"{LINES}/{node_name(f'leg {name}')}"
            self.scene.add(path, cylinder(1.0, 0.0025 * self.size), material(LINE_COLOUR))
            line, length = _line_poses(poses[leg.root], poses[leg.tip])
            self.scene.place(path, line[0] @ np.diag([1.0, 1.0, length[0], 1.0]))
            roots = tuple(to_triple(poses[leg.root][f][:3, 3]) for f in stops)
            texts = (f"leg {name}",) * len(roots)
            self.scene.labels.append(Label(roots, texts, path, rank=-1.0))

    def look_at(self, *machines: Mapping[str, Array]) -> None:
        """Have what is drawn in view, and the ground below all that it does.

        Args:
            machines: Frame to poses, shape (F, 4, 4), [m], of all machines that are drawn.
        """
        first, lowest = [], []
        for poses in machines:
            for visual in self.visuals:
                pose = poses[visual.link]
                corners = visual.corners @ pose[:, :3, :3].transpose(0, 2, 1) + pose[:, None, :3, 3]
                first.append(corners[0])
                lowest.append(corners[..., 2].min())
        points = np.concatenate(first)
        self.lowest = float(min(lowest))
        self._place_ground()
        middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
        points = np.unique(np.round(points, 4), axis=0)
        self.scene.camera = Camera(to_triple(middle), VIEW, tuple(to_triple(p) for p in points))

    def lower_ground(self, height: float) -> None:
        """Have the ground below a height, too, [m]."""
        self.lowest = min(self.lowest, height)
        self._place_ground()

    def _place_ground(self) -> None:
        """The ground below all that is drawn, its lines at multiples of their pitch."""
        pose = np.eye(4)
        middle = (self.low + self.high)[:2] / 2.0
        height = self.lowest - 0.03 * self.size
        pose[:3, 3] = [*np.round(middle / self.pitch) * self.pitch, height]
        self.scene.place(GROUND, pose)

    def move_links(self, film: Film, node: str, times: Array, poses: Mapping[str, Array]) -> None:
        """Move what `draw_links` drew; frames of poses at times."""
        drawn = {path.split("/")[1] for path in self.scene.nodes if path.startswith(f"{node}/")}
        for link in self.links:
            if node_name(link) in drawn:
                film.move(f"{node}/{node_name(link)}", times, poses[link])

    def move_leg_lines(self, film: Film, times: Array, poses: Mapping[str, Array]) -> None:
        """Move what `draw_leg_lines` drew."""
        for name, leg in self.robot.legs.items():
            line, length = _line_poses(poses[leg.root], poses[leg.tip])
            film.move(f"{LINES}/{node_name(f'leg {name}')}", times, line)
            scale = np.column_stack([np.ones((len(length), 2)), length])
            film.track(f"{LINES}/{node_name(f'leg {name}')}", "scale", "vector3", times, scale)


def _line_poses(root: Array, tip: Array) -> tuple[Array, Array]:
    """Poses with z from root to tip, shape (F, 4, 4), and the distances, shape (F,), [m]."""
    along = tip[:, :3, 3] - root[:, :3, 3]
    length = np.linalg.norm(along, axis=1)
    return pose_along(root[:, :3, 3], along / length[:, None]), length
