"""Motion of a machine between stops, and the poses of its frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from orthocal.arrays import Array
from orthocal.robot.model import Robot
from orthocal.viewer.scene import FRAME_RATE


@dataclass(frozen=True, slots=True, eq=False)
class Timeline:
    """Frames of a motion with stops."""

    drives: Array
    """Commanded drive coordinates of every frame, shape (F, n_drives), [m, rad]."""
    times: Array
    """Times of the frames, shape (F,), [1/30 s]."""
    stops: NDArray[np.int64]
    """First frame of every stop, shape (S,); the machine is at rest until the next frame."""

    @property
    def rests(self) -> Array:
        """Start and end times of all stops, alternating, shape (2 S,), [1/30 s]."""
        return np.asarray(self.times[np.stack([self.stops, self.stops + 1], axis=1).reshape(-1)])

    def interval(self, stop: int) -> tuple[float, float]:
        """Start and end time of a stop, [s]."""
        start, end = self.rests[2 * stop : 2 * stop + 2] / FRAME_RATE
        return float(start), float(end)


def plan_motion(stops: ArrayLike, *, count: int | None = None) -> Timeline:
    """Smooth motion from stop to stop; it is faster with more stops.

    Args:
        stops: Drive coordinates of the stops, shape (S, n_drives), [m, rad].
        count: Number of stops that determines the speed; S by default.
    """
    points = np.atleast_2d(np.asarray(stops, dtype=np.float64))
    count = len(points) if count is None else count
    pause, move, between = (
        (45, 24, 8) if count <= 12 else (24, 15, 4) if count <= 40 else (12, 9, 2)
    )
    fraction = np.arange(1, between + 1) / (between + 1)
    eased = fraction**2 * (3.0 - 2.0 * fraction)
    moves = points[:-1, None] + eased[:, None] * np.diff(points, axis=0)[:, None]
    pauses = np.repeat(points[:, None], 2, axis=1)
    drives = np.concatenate(
        [np.concatenate([pauses[:-1], moves], axis=1).reshape(-1, points.shape[1]), pauses[-1]]
    )
    cycle = np.concatenate([[0.0, pause], pause + move * fraction])
    starts = (pause + move) * np.arange(len(points))
    times = (starts[:, None] + cycle).reshape(-1)[: len(drives)]
    return Timeline(drives, times, (2 + between) * np.arange(len(points)))


def place_frames(
    robot: Robot, drives: ArrayLike, passive: ArrayLike, frames: Sequence[str]
) -> dict[str, Array]:
    """Poses of frames, computed by Pinocchio.

    Args:
        robot: The robot; a calibrated machine has its errors in the placements.
        drives: Drive coordinates, shape (K, n_drives), [m, rad].
        passive: Passive coordinates, shape (K, n_passive), [m, rad].
        frames: Names of the frames.

    Returns:
        Frame to poses, shape (K, 4, 4), [m].
    """
    coordinates = np.atleast_2d(robot.joint_coordinates(drives, passive))
    indices = {name: robot.frame_id(name) for name in frames}
    poses = {name: np.empty((len(coordinates), 4, 4)) for name in frames}
    data = robot.model.createData()
    for k, q in enumerate(coordinates):
        pin.framesForwardKinematics(robot.model, data, robot.configuration(q))
        for name, index in indices.items():
            poses[name][k] = data.oMf[index].homogeneous
    return poses


def exaggerate(nominal: Array, real: Array, factor: float) -> Array:
    """Poses with an enlarged deviation from nominal ones, shape (F, 4, 4), [m].

    p = p₀ + f (p₁ − p₀), R = R₀ exp(f log(R₀ᵀ R₁)). The factor f = 1 yields the real poses.

    Args:
        nominal: Nominal poses (p₀, R₀), shape (F, 4, 4), [m].
        real: Real poses (p₁, R₁), shape (F, 4, 4), [m].
        factor: Factor f.
    """
    if factor == 1.0:
        return real
    from scipy.spatial.transform import Rotation

    enlarged = nominal.copy()
    enlarged[:, :3, 3] += factor * (real[:, :3, 3] - nominal[:, :3, 3])
    start = Rotation.from_matrix(nominal[:, :3, :3])
    rotation = (start.inv() * Rotation.from_matrix(real[:, :3, :3])).as_rotvec()
    enlarged[:, :3, :3] = (start * Rotation.from_rotvec(factor * rotation)).as_matrix()
    return enlarged


def find_largest_shift(
    nominal: Mapping[str, Array], real: Mapping[str, Array]
) -> tuple[float, str]:
    """Largest distance between the frames of two machines, [m], and the name of that frame."""
    shifts = {
        name: float(np.linalg.norm(real[name][..., :3, 3] - pose[..., :3, 3], axis=-1).max())
        for name, pose in nominal.items()
    }
    worst = max(shifts, key=lambda name: shifts[name])
    return shifts[worst], worst
