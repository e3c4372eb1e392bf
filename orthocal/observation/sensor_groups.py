"""Sensors of a session, by the expressions that they have, and what is not known of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.observation.observations import Observations
from orthocal.robot.parameters import Parameter
from orthocal.sensors.compiled import CompiledReading, compile_reading
from orthocal.sensors.protocol import Unknown
from orthocal.session.session import Session, Setup

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class SensorGroup:
    """Entries whose sensors have one expression."""

    reading: CompiledReading
    entries: Indices
    """Shape (n,)."""
    setups: Indices
    """Their setups, shape (n,)."""
    constants: Array
    """Of their setups, shape (n, n_constants)."""
    unknowns: Indices
    """Which of the session's unknowns are theirs, shape (n, n_unknowns)."""

    def parts(self, size: int) -> Iterator[tuple[Indices, slice]]:
        """Entries, and where they are in the group, not more than so many at a time."""
        for first in range(0, self.entries.size, size):
            part = slice(first, first + size)
            yield self.entries[part], part


@dataclass(frozen=True, slots=True, eq=False)
class SensorUnknowns:
    """What of a session's sensors is not known exactly."""

    parameters: tuple[Parameter, ...]
    """Named after their setups, or after what several share; they add to no error of a machine."""
    of_setup: tuple[tuple[int, ...], ...]
    """Which of them each setup has, in the order of its sensor's."""


def sensor_unknowns(session: Session) -> SensorUnknowns:
    """The unknowns of all setups that are read."""
    found: dict[str, Parameter] = {}
    places = []
    read = {r.setup for r in session.readings}
    for setup in session.setups.values():
        own = []
        for unknown in setup.sensor.unknowns if setup.name in read else ():
            name = f"{_owner(unknown, setup, session)}.{unknown.name}"
            found.setdefault(name, Parameter(name, unknown.unit, unknown.tolerance, ()))
            own.append(list(found).index(name))
        places.append(tuple(own))
    return SensorUnknowns(tuple(found.values()), tuple(places))


def _owner(unknown: Unknown, setup: Setup, session: Session) -> str:
    """Whose it is: a gauge's of that name in every session, a session's, or the setup's own."""
    label, joined, _ = setup.name.partition("/") if session.joined else ("", "", "")
    if unknown.of_gauge:
        gauge = setup.gauge if not label else setup.gauge.partition("/")[2]
        return f"gauge.{gauge}" if gauge else "gauge"
    if unknown.shared_by is not None:
        return f"{label}{joined}{unknown.shared_by}"
    return f"setup.{setup.name}"


def group_sensors(session: Session, observations: Observations) -> tuple[SensorGroup, ...]:
    """Entries by the expression that they are readings of."""
    robot = session.robot
    setups = list(session.setups.values())
    unknowns = sensor_unknowns(session).of_setup
    found: dict[int, tuple[CompiledReading, list[int]]] = {}
    for i in np.unique(observations.setup).tolist():
        reading = compile_reading(robot, setups[i].sensor)
        found.setdefault(id(reading), (reading, []))[1].append(i)
    groups = []
    for reading, members in found.values():
        entries = np.flatnonzero(np.isin(observations.setup, members))
        constants = {i: setups[i].sensor.constants(robot) for i in members}
        of_entry = observations.setup[entries]
        table = np.array([constants[i] for i in of_entry.tolist()])
        own = np.array([unknowns[i] for i in of_entry.tolist()], dtype=np.int64)
        own = own.reshape(entries.size, -1)
        groups.append(SensorGroup(reading, entries, of_entry, table, own))
    return tuple(groups)
