"""What one has to measure with, and where the machine may stand meanwhile."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import ClosureError, ParameterError
from orthocal.io.fields import read_only
from orthocal.kinematics.function_cache import cached_per_robot
from orthocal.kinematics.loop_closure import nominal_assembly
from orthocal.kinematics.workspace import tool_at_zero
from orthocal.robot.model import Robot
from orthocal.sensors.mounting import USUAL, Standing
from orthocal.sensors.tips import Tip
from orthocal.session.session import Gauge
from orthocal.units import MM

Array = NDArray[np.float64]

REACH = 0.1
"""How far from the mechanical zero the tool goes by default, where it gets so far, [m]."""

ROOM = 0.005
"""What is left of the way to where the tool still gets: the machine's offsets take some, [m]."""

STEP = 0.01
"""Ends of the default box are multiples of this, [m]."""

SECTIONS = (0.25, 0.5, 0.75)
"""Where along a leg a gauge may touch by default, from its root, as a part of its length."""

ACROSS = 0.02
"""How far from a leg's own way the tool goes by default, [m]."""

SPARE_RANGE = 3.0

MINUTES_A_SETUP = 10.0
MINUTES_A_READING = 0.5

USUAL_DIAL = Gauge(5e-6, 10e-6, (-5e-3, 5e-3))
"""Of ±5 mm, read to 10 µm."""

USUAL_BALL = Tip("ball", 1.5e-3)


@dataclass(frozen=True, slots=True, eq=False)
class Means:
    """What one has to measure with, and how far one goes."""

    gauge: Gauge = USUAL_DIAL
    tip: Tip | None = USUAL_BALL
    """What touches; None for readings of the line between a leg's rods, as in the paper."""
    standing: Standing = USUAL
    rods: tuple[str, ...] = ()
    """Rods of each leg that can be touched; its first by default."""
    sections: tuple[float, ...] = SECTIONS
    """As parts of a leg's length, from its root."""
    box: Array | None = None
    """Least and largest tool coordinates, shape (n_coordinates, 2), [m]; `choose_box` cuts it off
    where the tool does not get, and has one of its own where none is given."""
    along: int = 9
    """Places on a leg's way."""
    across: float = ACROSS
    """How far from it the tool goes to either side, [m]."""
    spare_range: float = SPARE_RANGE
    """Standard deviations of a machine within its tolerances for which the gauge's range is kept
    free."""
    minutes_a_setup: float = MINUTES_A_SETUP
    minutes_a_reading: float = MINUTES_A_READING

    def minutes(self, setups: int, readings: int) -> float:
        """How long a plan takes."""
        return setups * self.minutes_a_setup + readings * self.minutes_a_reading


@cached_per_robot(maxsize=8)
def find_box(robot: Robot) -> Array:
    """How far the tool gets from the mechanical zero along each coordinate, at most 100 mm.

    Shape (n_coordinates, 2), [m].

    Raises:
        ParameterError: If the robot's drives do not command its tool.
    """
    if robot.tcp is None or len(robot.tcp.coordinates) != len(robot.drives):
        raise ParameterError(
            "the drives do not command the tool: there are no postures to choose from",
            where=str(robot.yaml),
        )
    middle = tool_at_zero(robot)
    return read_only(
        [
            [middle[k] - _reach(robot, middle, k, -1.0), middle[k] + _reach(robot, middle, k, 1.0)]
            for k in range(middle.size)
        ]
    )


def choose_box(robot: Robot, asked: Array | None) -> Array:
    """The box of the tool to choose postures from: `find_box`, or what is reached of another.

    Postures lie evenly between its ends: ends that the tool never gets to would leave few of them.

    Args:
        robot: The robot.
        asked: Least and largest tool coordinates, shape (n_coordinates, 2), [m].

    Returns:
        The same, its ends no farther than the tool gets from the mechanical zero along each
        coordinate, in whole steps.

    Raises:
        ParameterError: If the robot's drives do not command its tool.
    """
    if asked is None:
        return find_box(robot)
    found, middle = np.array(asked, dtype=np.float64), tool_at_zero(robot)
    for k, way in itertools.product(range(middle.size), (-1.0, 1.0)):
        end = 0 if way < 0.0 else 1
        point = np.array(middle)
        point[k] = found[k, end]
        if way * (point[k] - middle[k]) <= 0.0 or reachable(robot, point[None])[0]:
            continue
        near, far = 0.0, abs(point[k] - middle[k])
        while far - near > ROOM:
            point[k] = middle[k] + way * 0.5 * (near + far)
            reached = reachable(robot, point[None])[0]
            near, far = (0.5 * (near + far), far) if reached else (near, 0.5 * (near + far))
        steps = math.floor(max(near - ROOM, 0.0) / STEP + 1e-9)
        found[k, end] = middle[k] + way * STEP * steps
    beyond = found[:, 0] > found[:, 1]  # all of it: there will be no postures
    found[beyond] = asked[beyond]
    return read_only(found)


def _reach(robot: Robot, middle: Array, coordinate: int, way: float) -> float:
    """How far the tool gets along a coordinate, in whole steps, [m]."""
    steps = np.arange(1, round((REACH + ROOM) / ROOM) + 1)
    points = np.repeat(middle[None], steps.size, axis=0)
    points[:, coordinate] += way * ROOM * steps
    reached = reachable(robot, points)
    far = ROOM * float(np.argmin(np.append(reached, False))) - ROOM
    return max(math.floor(far / STEP + 1e-9) * STEP, 0.0)


def reachable(robot: Robot, points: Array) -> NDArray[np.bool_]:
    """Whether the nominal machine gets to tool positions within the travel of its drives, (n,)."""
    assembly = nominal_assembly(robot)
    try:
        drives = assembly.inverse(points)
    except ClosureError:
        if len(points) == 1:
            return np.array([False])
        half = len(points) // 2
        return np.concatenate([reachable(robot, points[:half]), reachable(robot, points[half:])])
    lower = np.array([d.lower for d in robot.drives])
    upper = np.array([d.upper for d in robot.drives])
    return np.asarray(((drives >= lower) & (drives <= upper)).all(axis=1))


def describe_box(box: Array) -> str:
    """A box in words, in mm."""
    return " × ".join(f"{low / MM:g} … {high / MM:g}" for low, high in box)
