"""Gains of an hour with each usual sensor, beside the readings of a plan or a session."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from orthocal.errors import ParameterError
from orthocal.planning.candidates import list_candidates, measure_candidates
from orthocal.planning.cost_curve import HOUR, find_scale
from orthocal.planning.equipment import Equipment
from orthocal.planning.expected_error import Expected, ToolForecast
from orthocal.planning.owned_sensors import DIAL, DURATIONS, Duration, OwnedSensor
from orthocal.planning.selection import SetupSearch
from orthocal.planning.timed_search import TimedSearch
from orthocal.planning.tool_candidates import list_tool_candidates
from orthocal.robot.model import Robot
from orthocal.session.session import Gauge, Session
from orthocal.units import UM

FINE, ORDINARY = Gauge(2.0 * UM, 1.0 * UM), Gauge(5.0 * UM, 10.0 * UM)
"""Dials of the ball bar, and of the others; their ranges suffice on a machine with entered
offsets."""

BAR = "usual_bar"

WORDS = {
    BAR: "a ball bar of 50 mm",
    "usual_square": "a square and a dial at the tool",
    "usual_plate": "a surface plate and a dial at the tool",
    DIAL: "a dial at the legs",
}
"""Usual sensors in words, by the names of their gauges."""

KEYS: Mapping[str, Mapping[str, Any]] = {
    BAR: {"sensor": "ball_bar", "length_mm": 50.0, "length_tolerance_mm": "unknown"},
    "usual_square": {
        "sensor": "tool_indicator",
        "artefact": {
            "kind": "square",
            "length_mm": 150.0,
            "straight_tolerance_mm": 0.002,
            "square_tolerance_mrad": 0.02,
        },
    },
    "usual_plate": {
        "sensor": "tool_indicator",
        "artefact": {"kind": "plate", "flat_tolerance_mm": 0.003},
    },
}
"""Keys of the setups of usual sensors."""


@dataclass(frozen=True, slots=True)
class SensorGain:
    """An hour with a sensor, beside other readings."""

    words: str
    setups: int
    readings: int
    """With those that close a setup."""
    minutes: float
    rms: float
    """Expected tool error with these readings added, [m]."""


def find_sensor_gains(
    forecast: ToolForecast, session: Session, expected: Expected
) -> tuple[SensorGain, ...]:
    """Gains of an hour with each usual sensor, the largest first.

    The same choice of setups as in a plan, to first order about the nominal machine. Sensors for
    which the machine has no place are left out.

    Args:
        forecast: Expected errors of the robot.
        session: Readings of a plan or a session.
        expected: Expected tool error after them.
    """
    robot = forecast.robot
    usual = [
        OwnedSensor(name, FINE if name == BAR else ORDINARY, keys, Path(name), _duration(keys))
        for name, keys in KEYS.items()
    ]
    try:
        equipment, listed = _list_candidates(robot, usual)
    except ParameterError:  # a sensor without a place
        try:
            equipment, listed = _list_candidates(robot, [s for s in usual if _has_place(robot, s)])
        except ParameterError:  # neither legs nor places
            return ()
    candidates = measure_candidates(listed, forecast.problem(listed), spare_range=0.0)
    prior = forecast.prior_of(candidates.problem, candidates.state, session)
    search = SetupSearch.of(candidates, prior, forecast.weigh("aligned", len(candidates.state)))
    nominal = forecast.about_nominal(session)
    scale = find_scale(search.empty.error, expected, nominal, "aligned")
    gains = []
    for name, duration in equipment.durations(listed).items():
        timed = TimedSearch(search, {name: duration})
        with threadpool_limits(1):
            plan = timed.fill(HOUR)
        if plan.setups:
            gains.append(
                SensorGain(
                    words=WORDS[name or DIAL],
                    setups=len(plan.setups),
                    readings=sum(len(s.chosen) + 1 for s in plan.setups),
                    minutes=timed.minutes(plan.setups),
                    rms=scale[0] * math.hypot(plan.error, scale[1]),
                )
            )
    return tuple(sorted(gains, key=lambda gain: gain.rms))


def _list_candidates(robot: Robot, owned: Sequence[OwnedSensor]) -> tuple[Equipment, Session]:
    """Equipment of a dial and sensors, and the session of its candidates."""
    equipment = Equipment(
        gauge=ORDINARY, along=5, across=0.0, sections=(0.5,), spare_range=0.0, owned=tuple(owned)
    )
    return equipment, list_candidates(robot, equipment)


def _duration(keys: Mapping[str, Any]) -> Duration:
    return DURATIONS[keys["sensor"]]


def _has_place(robot: Robot, sensor: OwnedSensor) -> bool:
    """True if the machine has a place for a sensor."""
    try:
        return bool(list_tool_candidates(robot, [sensor], None)[3])
    except ParameterError:
        return False
