"""Gains by an additional hour with each usual sensor, after a plan or a session."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from orthocal.errors import ParameterError
from orthocal.planning.candidates import list_candidates, measure_candidates
from orthocal.planning.cost_curve import HOUR, find_scale
from orthocal.planning.equipment import Equipment
from orthocal.planning.expected_error import Expected, ToolForecast
from orthocal.planning.owned_sensors import DIAL, DURATIONS, OwnedSensor
from orthocal.planning.selection import SetupSearch
from orthocal.planning.timed_search import TimedSearch
from orthocal.planning.tool_candidates import list_tool_candidates
from orthocal.robot.model import Robot
from orthocal.runtime.threads import one_thread
from orthocal.session.session import Gauge, Session
from orthocal.units import UM

FINE, ORDINARY = Gauge(2.0 * UM, 1.0 * UM), Gauge(5.0 * UM, 10.0 * UM)
"""Dials of the ball bar and of the other sensors. Their ranges suffice on a machine with entered
offsets."""

BAR = "usual_bar"

DESCRIPTIONS = {
    BAR: "a ball bar of 50 mm",
    "usual_square": "a square and a dial at the tool",
    "usual_plate": "a surface plate and a dial at the tool",
    DIAL: "a dial at the {legs}",
}
"""Descriptions of the usual sensors, by the names of their gauges."""

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
    """Expected result of an additional hour with a sensor."""

    words: str
    """Description of the sensor."""
    setups: int
    readings: int
    """Number of readings, including those that close a setup."""
    minutes: float
    rms: float
    """Expected RMS tool error after the additional readings, [m]."""


def find_sensor_gains(
    forecast: ToolForecast, session: Session, expected: Expected
) -> tuple[SensorGain, ...]:
    """Gains by an additional hour with each usual sensor, the largest first.

    Setups are chosen as in a plan, to first order about the nominal machine. Sensors that cannot be
    placed on the machine are omitted.

    Args:
        forecast: Expected errors of the robot.
        session: Readings of a plan or a session.
        expected: Expected tool error after these readings.
    """
    robot = forecast.robot
    usual = [
        OwnedSensor(
            name, FINE if name == BAR else ORDINARY, keys, Path(name), DURATIONS[keys["sensor"]]
        )
        for name, keys in KEYS.items()
    ]
    try:
        equipment, listed = _list_candidates(robot, usual)
    except ParameterError:  # a sensor cannot be placed
        try:
            equipment, listed = _list_candidates(robot, [s for s in usual if _can_place(robot, s)])
        except ParameterError:  # the machine has no legs, and no sensor can be placed
            return ()
    candidates = measure_candidates(listed, forecast.problem(listed), spare_range=0.0)
    prior = forecast.prior_information(candidates.problem, candidates.state, session)
    weight = forecast.weight_of("aligned", len(candidates.state))
    search = SetupSearch.of(candidates, prior, weight)
    nominal = forecast.about_nominal(session)
    factor, constant = find_scale(search.empty.error, expected, nominal, "aligned")
    gains = []
    for name, duration in equipment.durations(listed).items():
        timed = TimedSearch(search, {name: duration})
        with one_thread():
            plan = timed.fill(search.empty, HOUR)
        if plan.setups:
            gains.append(
                SensorGain(
                    words=DESCRIPTIONS[name or DIAL].format(legs=robot.leg_noun),
                    setups=len(plan.setups),
                    readings=sum(len(s.chosen) + 1 for s in plan.setups),
                    minutes=timed.minutes(plan.setups),
                    rms=factor * math.hypot(plan.error, constant),
                )
            )
    return tuple(sorted(gains, key=lambda gain: gain.rms))


def _list_candidates(robot: Robot, owned: Sequence[OwnedSensor]) -> tuple[Equipment, Session]:
    """Equipment with a dial and sensors, and the session of its candidate readings."""
    equipment = Equipment(
        gauge=ORDINARY, along=5, across=0.0, sections=(0.5,), spare_range=0.0, owned=tuple(owned)
    )
    return equipment, list_candidates(robot, equipment)


def _can_place(robot: Robot, sensor: OwnedSensor) -> bool:
    """True if a sensor can be placed on the machine."""
    try:
        *_, readings = list_tool_candidates(robot, [sensor], None)
        return bool(readings)
    except ParameterError:
        return False
