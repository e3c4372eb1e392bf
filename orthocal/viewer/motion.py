"""How links are placed and moved: Pinocchio's poses, made larger where they deviate, in frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from meshcat.animation import Animation, AnimationClip, AnimationTrack
from meshcat.path import Path as NodePath
from numpy.typing import ArrayLike, NDArray

from orthocal.robot.model import Robot

Array = NDArray[np.float64]

FRAMES_A_SECOND = 30

STILL = 1e-12
"""What changes by less does not move, [m or 1]."""


@dataclass(frozen=True, slots=True, eq=False)
class Timeline:
    """Frames of a motion that stops again and again."""

    drives: Array
    """Commanded drive coordinates of every frame, shape (F, n_drives), [m, rad]."""
    times: Array
    """Of every frame, in frames of 1/30 s, shape (F,)."""
    stops: NDArray[np.int64]
    """First frame of every stop, shape (S,); it stands until the next frame."""

    def interval(self, stop: int) -> tuple[float, float]:
        """When a stop begins and ends, [s]."""
        first = self.stops[stop]
        last = min(first + 1, len(self.times) - 1)
        return self.times[first] / FRAMES_A_SECOND, self.times[last] / FRAMES_A_SECOND


def plan_motion(stops: ArrayLike, *, count: int | None = None) -> Timeline:
    """Frames of a machine that goes from stop to stop, gently; the more stops, the faster.

    Args:
        stops: Drive coordinates of the stops, shape (S, n_drives), [m, rad].
        count: How many stops to be as fast as for; by default as many as there are.
    """
    points = np.atleast_2d(np.asarray(stops, dtype=np.float64))
    count = len(points) if count is None else count
    hold, move, between = (45, 24, 8) if count <= 12 else (24, 15, 4) if count <= 40 else (12, 9, 2)
    drives: list[Array] = []
    times: list[float] = []
    first: list[int] = []
    now = 0
    for i, point in enumerate(points):
        first.append(len(times))
        drives += [point, point]
        times += [now, now + hold]
        now += hold
        if i + 1 < len(points):
            share = np.arange(1, between + 1) / (between + 1)
            eased = share**2 * (3.0 - 2.0 * share)
            drives += list(point + eased[:, None] * (points[i + 1] - point))
            times += [now + move * s for s in share]
            now += move
    return Timeline(np.array(drives), np.array(times, dtype=np.float64), np.array(first))


def place_frames(
    robot: Robot, drives: ArrayLike, passive: ArrayLike, frames: Sequence[str]
) -> dict[str, Array]:
    """Poses of frames by Pinocchio.

    Args:
        robot: The robot; one with errors in its placements for a calibrated machine.
        drives: Shape (K, n_drives), [m, rad].
        passive: Shape (K, n_passive), [m, rad].
        frames: Names.

    Returns:
        Frame to poses, shape (K, 4, 4), [m].
    """
    coordinates = np.atleast_2d(robot.joint_coordinates(drives, passive))
    indices = {name: robot.frame_id(name) for name in frames}
    result = {name: np.empty((len(coordinates), 4, 4)) for name in frames}
    data = robot.model.createData()
    for k, q in enumerate(coordinates):
        pin.framesForwardKinematics(robot.model, data, robot.configuration(q))
        for name, index in indices.items():
            result[name][k] = data.oMf[index].homogeneous
    return result


def exaggerate(nominal: Array, real: Array, factor: float) -> Array:
    """Poses whose deviation from nominal ones is drawn larger.

    p = p₀ + f (p₁ − p₀), R = R₀ exp(f log(R₀ᵀ R₁)): every frame's origin is moved by f times its
    deviation. With f = 1 they are the real ones.

    Args:
        nominal: Shape (..., 4, 4), [m].
        real: Shape (..., 4, 4), [m].
        factor: f.
    """
    if factor == 1.0:
        return real
    from scipy.spatial.transform import Rotation

    shape = nominal.shape
    flat, other = nominal.reshape(-1, 4, 4), real.reshape(-1, 4, 4)
    result = np.array(flat)
    result[:, :3, 3] += factor * (other[:, :3, 3] - flat[:, :3, 3])
    start = Rotation.from_matrix(flat[:, :3, :3])
    turn = (start.inv() * Rotation.from_matrix(other[:, :3, :3])).as_rotvec()
    result[:, :3, :3] = (start * Rotation.from_rotvec(factor * turn)).as_matrix()
    return result.reshape(shape)


def find_largest_shift(
    nominal: Mapping[str, Array], real: Mapping[str, Array]
) -> tuple[float, str]:
    """Largest distance between two machines' frames, [m], and which frame that is."""
    sizes = {
        name: float(np.linalg.norm(real[name][..., :3, 3] - pose[..., :3, 3], axis=-1).max())
        for name, pose in nominal.items()
    }
    worst = max(sizes, key=lambda name: sizes[name])
    return sizes[worst], worst


class Film:
    """meshcat's animation of nodes, all on one timeline."""

    def __init__(self) -> None:
        self._clips: dict[NodePath, AnimationClip] = {}

    def move(self, path: str, times: Array, poses: Array) -> None:
        """Move a node from its first pose through all others, shape (F, 4, 4), [m]."""
        from scipy.spatial.transform import Rotation

        if np.ptp(poses[:, :3, 3], axis=0).max() > STILL:
            self.track(path, "position", "vector3", times, poses[:, :3, 3])
        if np.ptp(poses[:, :3, :3], axis=0).max() > STILL:
            turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
            self.track(path, "quaternion", "quaternion", times, turns)

    def track(self, path: str, name: str, kind: str, times: Array, values: Array) -> None:
        """Change a property of a node: one row of values a time, shape (F, n)."""
        node = NodePath(tuple(path.split("/")))
        clip = self._clips.setdefault(node, AnimationClip(fps=FRAMES_A_SECOND))
        track = AnimationTrack(name, kind, times.tolist(), values.tolist())
        clip.tracks[name] = track

    @property
    def animation(self) -> Animation:
        """All of it."""
        return Animation(self._clips, default_framerate=FRAMES_A_SECOND)
