"""Conditions of the readings of a session: times and temperatures of a day of measurement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime, timedelta
from itertools import pairwise

import numpy as np

from orthocal.effects.loading import neutral_values, robot_effects
from orthocal.effects.protocol import Condition
from orthocal.robot.model import Robot
from orthocal.session.points import gather_points, names_in_files
from orthocal.session.session import Conditions, Session

MINUTES_PER_SETUP = 10.0
"""Usual time to mount a gauge, [min]."""

MINUTES_PER_READING = 0.5
"""Usual time of a reading, [min]."""

MORNING = datetime(2025, 1, 6, 9, 0)
"""Time of the first reading of a day without a date."""

COLUMNS_OF_CONDITIONS: dict[Condition, str] = {
    "approach": "approach",
    "temperature": "temperature_C",
    "time": "time",
}
"""Conditions of a reading, mapped to their columns of readings.csv. Other conditions belong to the
machine or to the session."""


def needed_conditions(robot: Robot) -> tuple[Condition, ...]:
    """Conditions of a reading on which effects of a robot depend, in the order of their columns."""
    needed = {c for effect in robot_effects(robot) for c in effect.conditions}
    return tuple(c for c in COLUMNS_OF_CONDITIONS if c in needed)


def schedule_readings(
    session: Session,
    *,
    temperatures: tuple[float, float] | None = None,
    durations: Mapping[str, tuple[float, float]] | None = None,
) -> Session:
    """Session with times of successive readings, and temperatures that change linearly with time.

    Approaches are unchanged. Differences have no conditions. All coordinates of a point have the
    same time.

    Args:
        session: The session.
        temperatures: Temperature of the first and of the last reading, [°C]; the neutral
            temperature by default.
        durations: Names of gauges, mapped to the time to mount the gauge and the time of a reading,
            [min]; usual times by default.
    """
    lines = gather_points(session.readings, session.setups)
    names = {n: names_in_files(s) for n, s in session.setups.items()}
    setups = [names[line[0].setup][0] for line in lines]
    if not setups:
        return session
    usual, durations = (MINUTES_PER_SETUP, MINUTES_PER_READING), durations or {}
    duration_of = {name: durations.get(gauge, usual) for name, gauge in names.values()}
    # the gauge is mounted again between readings of different setups
    steps = [duration_of[a][1] + duration_of[b][0] * (a != b) for a, b in pairwise(setups)]
    minutes = np.repeat(np.cumsum([0.0, *steps]), [len(line) for line in lines])
    neutral = neutral_values(session.robot)["temperature"]
    end = max(float(minutes[-1]), 1e-9)  # above 0 also for a single reading
    at_readings = np.interp(minutes, [0.0, end], temperatures or (neutral, neutral))
    readings = []
    for reading, minute, temperature in zip(session.readings, minutes, at_readings, strict=True):
        if reading.minus is None:
            conditions = Conditions(
                None if reading.conditions is None else reading.conditions.approach,
                round(float(temperature), 1),
                MORNING + timedelta(minutes=float(minute)),
            )
            reading = replace(reading, conditions=conditions)
        readings.append(reading)
    return replace(session, readings=tuple(readings), sha256="")
