"""Equipment of a plan: gauge, possible sections, and region of the postures."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from orthocal.arrays import Array, Mask
from orthocal.errors import ParameterError, SessionError
from orthocal.io.documents import read_yaml, validate
from orthocal.io.fields import read_only
from orthocal.kinematics.continuation import Failures
from orthocal.kinematics.function_cache import cached_per_robot
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.kinematics.workspace import find_below_bed, grid_points, tool_at_zero
from orthocal.measurement.files.session_keys import GaugeKeys
from orthocal.measurement.motion.approach import USUAL_LENGTH, approach_steps, usual_approaches
from orthocal.observation.conditions import (
    MINUTES_PER_READING,
    MINUTES_PER_SETUP,
    schedule_readings,
)
from orthocal.planning.expected_error import state_noise
from orthocal.planning.owned_sensors import Duration, OwnedSensor
from orthocal.robot.model import Leg, Robot, require_commanded_tool, require_tcp
from orthocal.sensors.direction import Direction
from orthocal.sensors.leg_indicator import LegIndicator, Section
from orthocal.sensors.mounting import USUAL, Mounting, MountingKeys
from orthocal.sensors.tips import Tip
from orthocal.session.points import names_in_files, one_row_per_point
from orthocal.session.session import Gauge, Posture, Session
from orthocal.units import MM

DEFAULT_REACH = 0.1
"""Largest default distance of the tool from the mechanical zero, along each coordinate, [m]."""

REACH_MARGIN = 0.005
"""Distance of postures from the end of the reach, which offsets of the machine reduce, [m]."""

ROOM_POINTS = 5
"""Positions along each side of the box at which the motion of the tool in an approach is found."""

BOX_STEP = 0.01
"""Step of the limits of the box, [m]."""

SECTIONS = (0.25, 0.5, 0.75)
"""Default sections, as fractions of a leg's length from its root."""

ACROSS = 0.02
"""Default displacement of the tool across a leg's direction, [m]."""

SPARE_RANGE = 3.0
"""Default of `Equipment.spare_range`."""

USUAL_DIAL = Gauge(5e-6, 10e-6, (-5e-3, 5e-3))
"""Dial indicator of ±5 mm with a resolution of 10 µm."""

USUAL_BALL = Tip("ball", 1.5e-3)
"""Ball of 3 mm diameter."""

MOUNTING_KEYS = ("direction_tolerance_mrad", "section_tolerance_mm", "lateral_tolerance_mm")
"""Keys of dial.yaml that describe the mounting."""


@dataclass(frozen=True, slots=True, eq=False)
class Equipment:
    """Available gauges, tip and time, and the region of possible readings."""

    gauge: Gauge = USUAL_DIAL
    tip: Tip | None = USUAL_BALL
    """Tip of the gauge; None for readings of a leg's centre line, as in the paper."""
    without_tip: Path | None = None
    """File of the gauge if it states no tip, so that `tip` is assumed."""
    mounting: Mounting = USUAL
    """Mounting uncertainty of the gauge."""
    rods: tuple[str, ...] = ()
    """Rods of each leg that the gauge can touch; by default the first one."""
    sections: tuple[float, ...] = SECTIONS
    """Possible sections, as fractions of a leg's length from its root."""
    box: Array | None = None
    """Limits of the tool's coordinates, shape (n_coordinates, 2), [m]; by default `find_box`."""
    along: int = 9
    """Number of positions along a leg's direction."""
    across: float = ACROSS
    """Largest displacement of the tool to either side across a leg's direction, [m]."""
    spare_range: float = SPARE_RANGE
    """Prior standard deviations of readings that must fit into the gauge's range."""
    minutes_per_setup: float = MINUTES_PER_SETUP
    minutes_per_reading: float = MINUTES_PER_READING
    temperatures: tuple[float, float] | None = None
    """Temperatures at the first and at the last reading, [°C]; by default the reference temperature
    of the nominal dimensions."""
    owned: tuple[OwnedSensor, ...] = ()
    """Available sensors at the tool."""
    soft_limits: tuple[tuple[float, float], ...] = ()
    """Limits of each joint that the controller accepts, [m, rad]; by default the travel."""

    def list_sensors(self, leg: Leg, direction: Direction, fraction: float) -> list[LegIndicator]:
        """Indicators at a section of a leg, one for each rod that the tip can touch.

        Raises:
            ParameterError: If the leg has no such rod.
        """
        section = Section("fraction", fraction)
        line = LegIndicator(leg.name, direction, section, self.mounting)
        if self.tip is None or not (leg.rods or self.rods):
            return [line]
        for rod in self.rods:
            if rod not in leg.rods:
                known = ", ".join(leg.rods) or "none"
                raise ParameterError(
                    f"'{rod}' is not a rod of leg {leg.name}; rods: {known}", where="touches"
                )
        return [line.on_rod(rod, self.tip) for rod in self.rods or tuple(leg.rods)[:1]]

    def within_limits(
        self,
        robot: Robot,
        joints: Sequence[tuple[float, float]],
        axes: Sequence[tuple[float, float]],
    ) -> Equipment:
        """Equipment whose postures are within soft limits of a controller.

        Args:
            robot: The robot.
            joints: MIN_LIMIT and MAX_LIMIT of each joint, [m, rad].
            axes: Those of the axes X, Y and Z in tool coordinates, [m].

        Raises:
            ParameterError: If the limits of an axis leave no room.
        """
        limited = replace(self, soft_limits=tuple(joints))
        if not robot.commands_tool or not np.isfinite(axes).any():
            return limited
        coordinates = require_tcp(robot).coordinates
        low, high = np.array([axes[c] for c in coordinates]).T
        box = choose_box(robot, self.box)
        box = np.column_stack([np.maximum(box[:, 0], low), np.minimum(box[:, 1], high)])
        room = _approach_room(robot, box)
        box = np.column_stack(
            [np.maximum(box[:, 0], low + room), np.minimum(box[:, 1], high - room)]
        )
        for c, (first, last) in zip(coordinates, box.tolist(), strict=True):
            if first > last:
                raise ParameterError(
                    f"MIN_LIMIT and MAX_LIMIT of [AXIS_{'XYZ'[c]}] leave no room for postures",
                    where="--ini",
                )
        return replace(limited, box=box)

    def limit_travel(self, robot: Robot) -> Robot:
        """Robot whose travel is within the soft limits.

        If no effect depends on the approach, programs choose its side. The limits then have room
        for an approach from either side.
        """
        if not self.soft_limits:
            return robot
        room = approach_steps(robot, "p" * len(robot.drives)) * (not usual_approaches(robot))
        drives = []
        for drive, limits, length in zip(robot.drives, self.soft_limits, room, strict=True):
            low, high = sorted(drive.from_joint(limits).tolist())
            travel = max(drive.lower, low + length), min(drive.upper, high - length)
            drives.append(replace(drive, lower=travel[0], upper=travel[1]))
        return replace(robot, drives=tuple(drives))

    def minutes(self, setups: int, readings: int) -> float:
        """Minutes of setups at legs and their readings."""
        return setups * self.minutes_per_setup + readings * self.minutes_per_reading

    def durations(self, session: Session) -> dict[str, Duration]:
        """Durations of a setup and a reading with each gauge of a session."""
        at_legs = Duration(self.minutes_per_setup, self.minutes_per_reading)
        at_tool = {sensor.name: sensor.duration for sensor in self.owned}
        in_files = [names_in_files(setup)[1] for setup in session.setups.values()]
        return {name: at_tool.get(name, at_legs) for name in (*session.gauges, *in_files)}

    @property
    def once(self) -> frozenset[str]:
        """Names of the sensors with at most one setup in a plan: they see the same in each."""
        return frozenset(s.name for s in self.owned if s.keys["sensor"] in ("probe", "points"))

    def minutes_of(self, plan: Session) -> float:
        """Minutes of all setups and readings of a session."""
        durations, plan = self.durations(plan), one_row_per_point(plan)
        of_setup = {n: durations[names_in_files(s)[1]] for n, s in plan.setups.items()}
        setups = sum(duration.setup for duration in of_setup.values())
        return setups + sum(of_setup[r.setup].reading for r in plan.readings)

    def schedule(self, plan: Session) -> Session:
        """Planned readings with their expected times and temperatures."""
        return schedule_readings(
            plan, temperatures=self.temperatures, durations=self.durations(plan)
        )


def indicators(session: Session) -> dict[str, LegIndicator]:
    """Indicators at the legs, by setup."""
    sensors = {name: setup.sensor for name, setup in session.setups.items()}
    return {name: s for name, s in sensors.items() if isinstance(s, LegIndicator)}


@cached_per_robot
def find_box(robot: Robot) -> Array:
    """Limits of the tool along each coordinate through the mechanical zero, at most ±100 mm.

    The shape is (n_coordinates, 2), [m].

    Raises:
        RobotError: If the robot's drives do not command its tool.
    """
    require_commanded_tool(robot)
    middle = tool_at_zero(robot)
    return read_only(
        [
            [middle[k] - _reach(robot, middle, k, -1.0), middle[k] + _reach(robot, middle, k, 1.0)]
            for k in range(middle.size)
        ]
    )


def choose_box(robot: Robot, requested: Array | None) -> Array:
    """Box of the candidate postures: `find_box`, or the reachable part of a requested one.

    Postures are evenly spaced in the box. Limits beyond the reach would lose many of them.

    Args:
        robot: The robot.
        requested: Limits of the tool's coordinates, shape (n_coordinates, 2), [m].

    Returns:
        Reachable limits, shape (n_coordinates, 2), [m]. Changed ones are multiples of BOX_STEP from
        the mechanical zero.

    Raises:
        RobotError: If the robot's drives do not command its tool.
    """
    if requested is None:
        return find_box(robot)
    ranges, middle = np.array(requested, dtype=np.float64), tool_at_zero(robot)
    for k, way in itertools.product(range(middle.size), (-1.0, 1.0)):
        end = 0 if way < 0.0 else 1
        point = np.array(middle)
        point[k] = ranges[k, end]
        if way * (point[k] - middle[k]) <= 0.0 or reachable(robot, point[None])[0]:
            continue
        near, far = 0.0, abs(point[k] - middle[k])
        while far - near > REACH_MARGIN:
            half = 0.5 * (near + far)
            point[k] = middle[k] + way * half
            near, far = (half, far) if reachable(robot, point[None])[0] else (near, half)
        steps = math.floor(max(near - REACH_MARGIN, 0.0) / BOX_STEP + 1e-9)
        ranges[k, end] = middle[k] + way * BOX_STEP * steps
    beyond = ranges[:, 0] > ranges[:, 1]  # nothing is reachable: no postures will result
    ranges[beyond] = requested[beyond]
    return read_only(ranges)


def _approach_room(robot: Robot, box: Array) -> Array:
    """Largest motion of the tool in an approach within a box, in whole millimetres.

    All drives move from the same side, each by its usual length. Along the path of a sensor the
    tool moves by the usual length.

    Args:
        robot: The robot.
        box: Limits of the tool's coordinates, shape (n_coordinates, 2), [m].

    Returns:
        Shape (n_coordinates,), [m].
    """
    points = grid_points(*(np.linspace(low, high, ROOM_POINTS) for low, high in box.tolist()))
    drives, reached = _reach_points(robot, points)
    coordinates, closure = list(require_tcp(robot).coordinates), nominal_closure(robot)
    room = np.full(len(box), USUAL_LENGTH)
    for side in "pn":
        begin = drives[reached] - approach_steps(robot, side * len(robot.drives))
        tool = closure.forward(begin, failures=Failures())[:, coordinates]
        room = np.fmax(room, np.nanmax(np.abs(tool - points[reached]), axis=0, initial=0.0))
    return np.asarray(np.ceil(room / MM - 1e-6) * MM)


def _reach(robot: Robot, middle: Array, coordinate: int, way: float) -> float:
    """Reach of the tool along a coordinate in one direction, rounded down to BOX_STEP, [m]."""
    steps = np.arange(1, round((DEFAULT_REACH + REACH_MARGIN) / REACH_MARGIN) + 1)
    points = np.repeat(middle[None], steps.size, axis=0)
    points[:, coordinate] += way * REACH_MARGIN * steps
    reached = reachable(robot, points)
    far = REACH_MARGIN * float(np.argmin(np.append(reached, False))) - REACH_MARGIN
    return max(math.floor(far / BOX_STEP + 1e-9) * BOX_STEP, 0.0)


def reachable(robot: Robot, points: Array) -> Mask:
    """Mask of tool positions that the nominal machine reaches, shape (n,).

    They are within its travel and not below its bed.

    Args:
        robot: The robot.
        points: Coordinates of the tool, shape (n, n_coordinates), [m].
    """
    return _reach_points(robot, points)[1]


def _reach_points(robot: Robot, points: Array) -> tuple[Array, Mask]:
    """Drive coordinates of tool positions, and the mask of those that `reachable` accepts."""
    failures = Failures()
    drives = nominal_closure(robot).inverse(points, failures=failures)
    lower, upper = np.array([(d.lower, d.upper) for d in robot.drives]).T
    reached = np.asarray(((drives >= lower) & (drives <= upper)).all(axis=1))
    reached[[*failures, *find_below_bed(robot, points)]] = False
    return drives, reached


def place_reachable(robot: Robot, points: Array, middle: Array) -> dict[str, Posture]:
    """Postures of the tool positions that `reachable` accepts, by name.

    Args:
        robot: The robot.
        points: Coordinates of the tool, shape (n, n_coordinates), [m].
        middle: Coordinates in the mechanical zero, shape (n_coordinates,), [m].
    """
    drives, reached = _reach_points(robot, points)
    postures = {}
    for point, coordinates in zip(points[reached], drives[reached], strict=True):
        name = posture_name(robot, point, middle)
        postures[name] = Posture(name, "tcp", point, coordinates)
    return postures


def place_tool(robot: Robot, names: Sequence[str], points: Array) -> dict[str, Posture]:
    """Postures of the nominal machine with its tool at points, by name.

    Args:
        robot: The robot.
        names: Names of the postures.
        points: Coordinates of the tool, shape (n_postures, n_coordinates), [m].

    Raises:
        ClosureError: If a point cannot be reached; names the posture.
    """
    drives = nominal_closure(robot).inverse(points, names=names)
    return {n: Posture(n, "tcp", p, d) for n, p, d in zip(names, points, drives, strict=True)}


def posture_name(robot: Robot, point: Array, middle: Array) -> str:
    """Name of a posture: displacement from the mechanical zero, such as x+60_y-10.

    Args:
        robot: The robot.
        point: Coordinates of the tool, shape (n_coordinates,), [m].
        middle: Coordinates in the mechanical zero, shape (n_coordinates,), [m].
    """
    letters = "" if robot.tcp is None else ["xyz"[c] for c in robot.tcp.coordinates]
    parts = [
        f"{letter}{round(v / MM, 3):+g}"
        for letter, v in zip(letters, point - middle, strict=True)
        if abs(v) > 1e-9
    ]
    return "_".join(parts) or "zero"


def load_dial(path: str | Path, equipment: Equipment) -> Equipment:
    """Equipment with the dial indicator that a file describes.

    Args:
        path: YAML with `sigma_mm`, `resolution_mm`, `range_mm`, `tip` and `scale_tolerance` as
            under `gauge` in a session.yaml, and `direction_tolerance_mrad`, `section_tolerance_mm`
            and `lateral_tolerance_mm` as in its setups. Without `tip` the gauge has the tip of
            the other equipment.
        equipment: The other equipment.

    Raises:
        SessionError: If the file is invalid; names file and key.
    """
    file = Path(path)
    document = read_yaml(file, error=SessionError)
    if not isinstance(document, dict):
        raise SessionError("expected keys and values, such as sigma_mm: 0.005", where=str(file))
    data: dict[str, Any] = dict(document)
    mounting_keys = {k: data.pop(k) for k in MOUNTING_KEYS if k in data}
    gauge = validate(GaugeKeys, data, where=str(file), error=SessionError)
    if gauge.scale_tolerance is not None:
        mounting_keys["scale_tolerance"] = gauge.scale_tolerance
    mounting = Mounting.from_keys(
        validate(MountingKeys, mounting_keys, where=str(file), error=SessionError)
    )
    if gauge.sigma_mm is None and gauge.resolution_mm is None:
        raise SessionError(
            "is missing; a plan needs the repeatability of the readings",
            where=f"{file}: sigma_mm",
        )
    return replace(
        equipment,
        gauge=gauge.to_gauge(),
        tip=equipment.tip if gauge.tip is None else Tip.from_keys(gauge.tip),
        without_tip=file if gauge.tip is None else None,
        mounting=mounting,
    )


def equipment_of(session: Session, equipment: Equipment) -> Equipment:
    """Equipment with the gauge, the tip and the rods of a session.

    Args:
        session: The session; of several indicators at legs the first is used, one at a rod first.
        equipment: The other equipment.

    Raises:
        SessionError: If the repeatability of the readings is unknown.
    """
    session = state_noise(session)
    at_legs = indicators(session)
    if not at_legs:
        return equipment
    # sensors that touch rods come first
    names = sorted(at_legs, key=lambda name: at_legs[name].rod is None)
    sensors = [at_legs[name] for name in names]
    gauge = session.gauges[session.setups[names[0]].gauge]
    equipment = replace(equipment, gauge=gauge, tip=None)
    equipment = replace(equipment, mounting=replace(sensors[0].mounting, stand=None))
    rods = tuple(dict.fromkeys(s.rod for s in sensors if s.rod is not None))
    if not rods:
        return equipment
    return replace(equipment, tip=sensors[0].tip, rods=equipment.rods or rods)
