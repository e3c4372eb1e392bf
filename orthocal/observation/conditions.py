"""Conditions of the readings of a session in the course of a day."""

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

MINUTES_A_SETUP = 10.0
"""Usual time to mount a gauge."""

MINUTES_A_READING = 0.5

MORNING = datetime(2025, 1, 6, 9, 0)
"""Time of the first reading of a day that is not dated."""


STATED: tuple[Condition, ...] = ("approach", "temperature", "time")
"""Conditions that a reading states; others belong to the machine or to the session."""


def needed_conditions(robot: Robot) -> tuple[Condition, ...]:
    """Conditions of a reading on which effects of a robot depend, in the order of their columns."""
    needed = {c for effect in robot_effects(robot) for c in effect.conditions}
    return tuple(c for c in STATED if c in needed)


def in_course(
    session: Session,
    *,
    temperatures: tuple[float, float] | None = None,
    durations: Mapping[str, tuple[float, float]] | None = None,
    start: datetime = MORNING,
) -> Session:
    """Session whose readings were taken one after the other on a day that warms or cools evenly.

    Differences have no conditions. The coordinates of a point are read at once.

    Args:
        session: The session; approaches stay what they are.
        temperatures: Temperature of the first and the last reading, [°C]; by default the neutral
            one.
        durations: Minutes to mount a gauge and to read it, by its name; by default usual ones.
        start: Time of the first reading.
    """
    lines = gather_points(session.readings, session.setups)
    names = {n: names_in_files(s) for n, s in session.setups.items()}
    setups = [names[line[0].setup][0] for line in lines]
    if not setups:
        return session
    usual, known = (MINUTES_A_SETUP, MINUTES_A_READING), durations or {}
    of_setup = {name: known.get(gauge, usual) for name, gauge in names.values()}
    steps = [of_setup[a][1] + of_setup[b][0] * (a != b) for a, b in pairwise(setups)]
    minutes = np.repeat(np.cumsum([0.0, *steps]), [len(line) for line in lines])
    neutral = neutral_values(session.robot)["temperature"]
    first, last = temperatures or (neutral, neutral)
    warmth = np.interp(minutes, [0.0, max(float(minutes[-1]), 1e-9)], [first, last])
    readings = []
    for reading, minute, temperature in zip(session.readings, minutes, warmth, strict=True):
        if reading.minus is None:
            stated = Conditions(
                None if reading.conditions is None else reading.conditions.approach,
                round(float(temperature), 1),
                start + timedelta(minutes=float(minute)),
            )
            reading = replace(reading, conditions=stated)
        readings.append(reading)
    return replace(session, readings=tuple(readings), sha256="")
