"""Candidate setups of sensors at the tool: placements of bars and artefacts with their postures."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array, Mask
from orthocal.errors import ParameterError, SessionError
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.kinematics.robot_functions import robot_functions
from orthocal.kinematics.tool_rotation import place_turning
from orthocal.kinematics.workspace import grid_points, position_at_zero, tool_at_zero
from orthocal.measurement.motion.approach import (
    name_approach,
    possible_approaches,
    probing_starts,
)
from orthocal.planning.equipment import choose_box, place_reachable, posture_name
from orthocal.planning.owned_sensors import DIAL, OwnedSensor
from orthocal.robot.model import Robot, require_tcp
from orthocal.sensors.ball_bar import BallBar
from orthocal.sensors.points import Points
from orthocal.sensors.protocol import (
    Sensor,
    Triple,
    default_zero,
    place_point,
    probing_direction,
    tool_path,
)
from orthocal.sensors.registry import read_setup
from orthocal.session.points import names_in_files, split_setup
from orthocal.session.session import Conditions, Gauge, Posture, Reading, Setup
from orthocal.units import MM

CIRCLE_POINTS = 24
"""Positions on a circle of a ball bar."""

LATITUDES = (0.0, 0.5, -0.5)
"""Distances of the planes of circles from the fixed ball, in bar lengths."""

EDGE_POINTS = 9
"""Positions along an edge."""

PLATE_POINTS = 5
"""Positions along each side of a plate."""

BED_POINTS = 11
"""Positions along each side of a bed."""

LINE_POINTS = 5
"""Positions of a target along each side of the box."""

IN_PLANE = ("ball_bar", "points")
"""Kinds of sensor for a tool that moves in a plane."""

LEVELS = (-0.5, 0.0, 0.5)
"""Positions of an artefact across its surface, relative to the box: middle 0, faces ±1."""

BALLS = (
    *((0.0, 0.0, level) for level in LEVELS),
    *itertools.product((-0.5, 0.5), repeat=3),
)
"""Positions of a fixed ball, relative to the box: middle 0, faces ±1."""

PARALLEL = 1e-12
"""Largest squared sine of the angle between segments that count as parallel."""

SAME_ANGLE = 1e-6
"""Rounding error of an angle that is accepted, [rad]."""

STEP = 5 * MM
"""Step of the positions, [m]."""

PLACE = "@"
"""Mark before the place of a sensor in the name of a candidate setup."""

Placements = Iterator[tuple[str, dict[str, Any], Array]]
"""Name, keys and tool positions, shape (n, n_coordinates), [m], of each placement of a sensor."""


def list_tool_candidates(
    robot: Robot, owned: Sequence[OwnedSensor], box: Array | None
) -> tuple[dict[str, Gauge], dict[str, Posture], dict[str, Setup], list[Reading]]:
    """Gauges, postures, setups and readings of every placement of the sensors.

    Args:
        robot: The robot, with two or three tool coordinates.
        owned: The available sensors.
        box: Limits of the tool's coordinates, shape (n_coordinates, 2), [m]. The default is the
            workspace that the robot states, because a tool must not go below a bed, or else
            `choose_box`.

    Raises:
        ParameterError: If the machine has no two or three tool coordinates, or no place for a
            sensor.
        SessionError: If the keys of a sensor are invalid.
    """
    if not owned:
        return {}, {}, {}, []
    _require_usable(robot, owned)
    stated = robot.workspace if box is None else box
    limits, middle = choose_box(robot, stated), tool_at_zero(robot)
    gauges = {sensor.name: sensor.gauge for sensor in owned}
    places = [
        (sensor, *place) for sensor in owned for place in _places(sensor, robot, middle, limits)
    ]
    positions = _Positions.of(robot, middle, np.concatenate([points for *_, points in places]))
    postures: dict[str, Posture] = {}
    setups: dict[str, Setup] = {}
    readings: list[Reading] = []
    for sensor, name, keys, points in places:
        reached = positions.names(points)
        checked, built = read_setup(
            {**sensor.keys, **keys}, where=str(sensor.file), under="", error=SessionError
        )
        if isinstance(built, BallBar):
            reached = positions.select_clear(reached, built, sensor.radius)
        if len(reached) < 2:
            continue
        postures.update((n, positions.postures[n]) for n in reached)
        setup = Setup(name, built, sensor.name, zero=checked.zero or default_zero(built))
        parts = {name: setup}
        if isinstance(built, Points):
            parts, further = split_setup(setup, sensor.gauge)
            gauges |= further
        setups |= parts
        readings += [
            Reading(part, n, conditions=c)
            for n, c in positions.approached(built, reached)
            for part in parts
        ]
    placed = {names_in_files(setup)[1] for setup in setups.values()}
    for sensor in owned:
        if sensor.name not in placed:
            problem = "the machine reaches no place for it that is clear of its rods"
            raise ParameterError(problem, where=str(sensor.file))
    return gauges, postures, setups, readings


def _require_usable(robot: Robot, owned: Sequence[OwnedSensor]) -> None:
    """Refuse sensors of the same name, and those that need a tool that moves in space.

    Raises:
        SessionError: If two gauges have one name; names the file of the sensor.
        ParameterError: If the tool does not move in space; names the file of the sensor.
    """
    names = [DIAL, *(sensor.name for sensor in owned)]
    for sensor in owned:
        if names.count(sensor.name) > 1:
            raise SessionError(
                f"two gauges are named '{sensor.name}'; rename the file", where=str(sensor.file)
            )
    count = 0 if robot.tcp is None else len(robot.tcp.coordinates)
    for sensor in owned:
        if count < (2 if sensor.keys["sensor"] in IN_PLANE else 3):
            raise ParameterError(
                "needs a tool that moves along x, y and z; in a plane: " + " or ".join(IN_PLANE),
                where=str(sensor.file),
            )


@dataclass(frozen=True, slots=True, eq=False)
class _Positions:
    """Reachable tool positions of all placements, with loops closed at once."""

    robot: Robot
    middle: Array
    """Position of the tool in the mechanical zero, shape (n_coordinates,), [m]."""
    postures: dict[str, Posture]
    by_approach: dict[str, frozenset[str]]
    """Approach that effects distinguish, to the names of the postures that allow it."""

    @staticmethod
    def of(robot: Robot, middle: Array, points: Array) -> _Positions:
        """Reachable positions among tool positions of shape (n, n_coordinates), [m]."""
        unique = np.unique(points.round(9), axis=0)
        postures = place_reachable(robot, unique, middle)
        return _Positions(robot, middle, postures, possible_approaches(robot, postures))

    def names(self, points: Array) -> list[str]:
        """Names of the reachable ones of some positions, each once."""
        names = dict.fromkeys(posture_name(self.robot, p, self.middle) for p in points)
        return [name for name in names if name in self.postures]

    def select_clear(self, names: Sequence[str], bar: BallBar, radius: float) -> list[str]:
        """Postures of the nominal machine in which a ball bar is clear of all rods.

        Args:
            names: Names of postures.
            bar: The bar between the tool and its fixed ball.
            radius: Radius about the axis of the bar in which no rod may be, [m].
        """
        if not names or not self.robot.rods:
            return list(names)
        drives = np.array([self.postures[n].drives for n in names])
        closure, functions = nominal_closure(self.robot), robot_functions(self.robot)
        passive, placements = closure.close(drives), closure.geometry().placements

        def poses(frame: str) -> Array:
            return functions.pose(frame)(drives, passive, placements)[0]

        ball = place_point(poses(require_tcp(self.robot).frame), bar.tool)
        fixed = np.broadcast_to(bar.centre, ball.shape)
        clear = np.ones(len(names), dtype=np.bool_)
        for rod in self.robot.rods.values():
            ends = (poses(frame)[:, :3, 3] for frame in (rod.root, rod.tip))
            clear &= segment_distances(ball, fixed, *ends) >= rod.radius + radius
        return list(itertools.compress(names, clear))

    def approached(
        self, sensor: Sensor, names: Sequence[str]
    ) -> Iterator[tuple[str, Conditions | None]]:
        """Postures with each approach that effects of the machine distinguish.

        For a sensor that prescribes the tool path, the approaches follow from the complete plan. A
        probe approaches each posture towards its surface.
        """
        direction = probing_direction(sensor)
        if direction is not None:
            yield from self._probed(names, direction)
            return
        if not self.by_approach or tool_path(sensor) is not None:
            yield from ((name, None) for name in names)
            return
        for approach, possible in self.by_approach.items():
            yield from ((name, Conditions(approach)) for name in names if name in possible)

    def _probed(
        self, names: Sequence[str], direction: Triple
    ) -> Iterator[tuple[str, Conditions | None]]:
        """Postures that can be probed, with the approach of the motion towards the surface."""
        points = np.array([self.postures[name].values for name in names])
        starts = probing_starts(self.robot, points, direction)
        reached = place_reachable(self.robot, starts, self.middle)
        for name, start in zip(names, starts, strict=True):
            begin = reached.get(posture_name(self.robot, start, self.middle))
            if begin is not None:
                motion = self.postures[name].drives - begin.drives
                yield name, Conditions(name_approach(motion))


def segment_distances(start: Array, end: Array, other_start: Array, other_end: Array) -> Array:
    """Distances of pairs of segments, shape (n,), [m].

    The nearest points are x = a + s u and y = b + t v with s, t in [0, 1]. Source: Ericson,
    Real-Time Collision Detection, 5.1.9.

    Args:
        start: Start a of each first segment, shape (n, 3), [m].
        end: Its end a + u, shape (n, 3), [m].
        other_start: Start b of each second segment, shape (n, 3), [m].
        other_end: Its end b + v, shape (n, 3), [m].
    """
    u, v, between = end - start, other_end - other_start, start - other_start
    uu, vv, uv = np.vecdot(u, u), np.vecdot(v, v), np.vecdot(u, v)
    ub, vb = np.vecdot(u, between), np.vecdot(v, between)
    determinant = uu * vv - uv**2
    parallel = determinant <= PARALLEL * uu * vv  # then any s, here 0, has a nearest t
    s = np.where(parallel, 0.0, (uv * vb - ub * vv) / np.where(parallel, 1.0, determinant))
    s = np.clip(s, 0.0, 1.0)
    t = np.clip((uv * s + vb) / vv, 0.0, 1.0)
    s = np.clip((uv * t - ub) / uu, 0.0, 1.0)
    nearest = between + s[:, None] * u - t[:, None] * v
    return np.asarray(np.linalg.norm(nearest, axis=1))


def _places(sensor: OwnedSensor, robot: Robot, middle: Array, box: Array) -> Placements:
    """Placements of a sensor, with positions in the box, except for the height of a bed."""
    if sensor.keys["sensor"] == "ball_bar":
        return _bars(sensor, robot, box)
    places = {
        "probe": _beds,
        "points": _points,
        "square": _edges,
        "straightedge": _edges,
        "plate": _plates,
        "gauge_block": _blocks,
    }
    kind = sensor.keys.get("artefact", {}).get("kind", sensor.keys["sensor"])
    return places[kind](sensor, np.clip(middle, *box.T), box)


def _bars(sensor: OwnedSensor, robot: Robot, box: Array) -> Placements:
    """Ball bars about fixed balls: circles in planes through the ball and at both sides of it.

    A tool that moves in a plane has one circle about a ball in this plane.
    """
    coordinates, fixed = require_tcp(robot).coordinates, position_at_zero(robot)
    unit, n = np.eye(3)[:, : len(coordinates)], len(coordinates)
    places = np.array(BALLS) if n > 2 else np.unique(np.array(BALLS)[:, :n], axis=0)
    planes = list(itertools.product(range(3), LATITUDES)) if n > 2 else [(2, 0.0)]
    length = float(sensor.keys.get("length_mm", 0.0)) * MM
    tool = np.array(sensor.keys.get("tool_mm", (0.0, 0.0, 0.0))) * MM
    half, centre = 0.5 * (box[:, 1] - box[:, 0]), box.mean(axis=1)
    angle = 2.0 * np.pi * np.arange(CIRCLE_POINTS) / CIRCLE_POINTS
    for k, place in enumerate(places):
        ball = np.round((centre + place * half) / STEP) * STEP
        circles = []
        for axis, share in planes:
            radius = length * np.sqrt(1.0 - share**2)
            first, second = unit[(axis + 1) % 3], unit[(axis + 2) % 3]
            around = np.outer(np.cos(angle), first) + np.outer(np.sin(angle), second)
            circles.append(ball + share * length * unit[axis] + radius * around)
        points = np.unique(np.concatenate(circles).round(9), axis=0)
        inclined = _is_inclined(sensor, (ball - points) @ np.eye(3)[list(coordinates)])
        points = place_turning(robot, points[inclined], tool)
        inside = ((points >= box[:, 0]) & (points <= box[:, 1])).all(axis=1)
        in_space = np.array(fixed)
        in_space[list(coordinates)] = ball
        keys = {
            "centre_mm": ((in_space + tool) / MM).round(6).tolist(),
            "ball": f"{sensor.name}_ball_{k + 1}",
        }
        yield f"{sensor.name}{PLACE}{k}", keys, points[inside]


def _is_inclined(sensor: OwnedSensor, bars: Array) -> Mask:
    """Mask of bars whose elevation is within the range that the sensor's file states.

    Args:
        sensor: The ball bar.
        bars: Vectors from the tool's ball to the fixed ball, shape (n, 3), [m].
    """
    low, high = sensor.elevation
    elevation = np.arctan2(bars[:, 2], np.hypot(bars[:, 0], bars[:, 1]))
    return np.asarray((elevation >= low - SAME_ANGLE) & (elevation <= high + SAME_ANGLE))


def _beds(sensor: OwnedSensor, middle: Array, box: Array) -> Placements:
    """Points on a bed through the origin of the world."""
    axis = "xyz".index(str(sensor.keys.get("direction", "-z"))[-1])
    tip = np.array(sensor.keys.get("tool_mm", (0.0, 0.0, 0.0)))[axis] * MM
    points = _grid(middle, box, axis, 2.0 * float(np.ptp(box, axis=1).max()), BED_POINTS)
    points[:, axis] = -tip
    yield sensor.name, {}, points


def _points(sensor: OwnedSensor, middle: Array, box: Array) -> Placements:
    """Positions of a target in a box."""
    del middle
    lines = [_round(np.linspace(low, high, LINE_POINTS), low, high) for low, high in box.tolist()]
    yield sensor.name, {}, grid_points(*lines)


def _edges(sensor: OwnedSensor, middle: Array, box: Array) -> Placements:
    """Edges along each axis, touched across it; both arms of a square share its plane."""
    artefact = dict(sensor.keys["artefact"])
    length = float(artefact.get("length_mm", 200.0)) * MM
    for along, direction in itertools.permutations(range(3), 2):
        normal = 3 - along - direction
        for k, level in enumerate(LEVELS):
            line = _line(middle, box, along, length)
            points = np.repeat(_at_level(middle, box, normal, level)[None], len(line), axis=0)
            points[:, along] = line
            plane = "".join(sorted("xyz"[along] + "xyz"[direction]))
            name = f"{sensor.name}_{plane}_{k + 1}"
            keys = {
                "direction": "xyz"[direction],
                "artefact": {**artefact, "along": "xyz"[along], "name": name},
            }
            yield f"{sensor.name}{'xyz'[along]}{'xyz'[direction]}{PLACE}{k}", keys, points


def _plates(sensor: OwnedSensor, middle: Array, box: Array) -> Placements:
    """Plates across each axis."""
    length = float(sensor.keys["artefact"].get("length_mm", 200.0)) * MM
    for axis in range(3):
        for k, level in enumerate(LEVELS):
            points = _grid(middle, box, axis, length, PLATE_POINTS)
            points[:, axis] = _at_level(middle, box, axis, level)[axis]
            yield f"{sensor.name}{'xyz'[axis]}{PLACE}{k}", {"direction": f"-{'xyz'[axis]}"}, points


def _blocks(sensor: OwnedSensor, middle: Array, box: Array) -> Placements:
    """Positions beside a gauge block and on it, along each axis in which it fits into the box."""
    artefact = dict(sensor.keys["artefact"])
    height = float(artefact.get("height_mm", 0.0)) * MM
    for axis in np.flatnonzero(np.ptp(box, axis=1) >= height).tolist():
        low = _round(middle[axis] - 0.5 * height, box[axis, 0], box[axis, 1] - height)
        points = np.repeat(_grid(middle, box, axis, 60 * MM, 3), 2, axis=0)
        points[0::2, axis], points[1::2, axis] = low, low + height
        keys = {
            "direction": f"-{'xyz'[axis]}",
            "artefact": {**artefact, "table_mm": float(low / MM)},
        }
        yield f"{sensor.name}{'xyz'[axis]}", keys, points


def _at_level(middle: Array, box: Array, axis: int, level: float) -> Array:
    """Position displaced along an axis to a level of the box, shape (3,), [m]."""
    place = np.array(middle)
    half = 0.5 * (box[axis, 1] - box[axis, 0])
    place[axis] = _round(box[axis].mean() + level * half, *box[axis])
    return place


def _line(middle: Array, box: Array, axis: int, length: float, count: int = EDGE_POINTS) -> Array:
    """Coordinates along an axis on an artefact about a position, shape (n,), [m]."""
    low = max(float(box[axis, 0]), float(middle[axis]) - 0.5 * length)
    high = min(float(box[axis, 1]), float(middle[axis]) + 0.5 * length)
    return np.unique(_round(np.linspace(low, high, count), low, high))


def _round(positions: ArrayLike, low: float, high: float) -> Array:
    """Positions rounded to STEP, but within limits, [m]."""
    return np.clip(np.round(np.asarray(positions) / STEP) * STEP, low, high)


def _grid(middle: Array, box: Array, axis: int, length: float, count: int) -> Array:
    """Positions on a square perpendicular to an axis, shape (n, 3), [m]."""
    sides = [_line(middle, box, k, length, count) for k in range(3) if k != axis]
    return np.insert(grid_points(*sides), axis, middle[axis], axis=1)
