"""Sensors of a session by their expression, and their nuisance parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.effects.loading import reading_effects
from orthocal.observation.observations import Observations
from orthocal.robot.parameters import Parameter
from orthocal.sensors.compiled import CompiledReading, compile_reading
from orthocal.sensors.protocol import NuisanceParameter
from orthocal.session.session import Session, Setup


@dataclass(frozen=True, slots=True, eq=False)
class SensorGroup:
    """Entries whose sensors have the same expression."""

    reading: CompiledReading
    entries: Indices
    """Shape (n,)."""
    setups: Indices
    """Setup of each entry, shape (n,)."""
    constants: Array
    """Constants of each entry's sensor, then the conditions of the entry on which its reading
    depends, shape (n, n_constants)."""
    nuisance: Indices
    """Indices of their nuisance parameters among the session's, shape (n, n_nuisance)."""


@dataclass(frozen=True, slots=True, eq=False)
class NuisanceParameters:
    """Nuisance parameters of a session's sensors, and those of effects on each setup."""

    parameters: tuple[Parameter, ...]
    """Named after their setup, or after what several setups share; no errors of the machine."""
    of_setup: tuple[tuple[int, ...], ...]
    """Their indices by setup, those of the sensor first."""


def nuisance_parameters(session: Session) -> NuisanceParameters:
    """Nuisance parameters of all setups with readings."""
    parameters: dict[str, Parameter] = {}
    of_setup: list[tuple[int, ...]] = []
    read = {r.setup for r in session.readings}
    for setup in session.setups.values():
        indices = []
        if setup.name not in read:
            of_setup.append(())
            continue
        of_sensor = [
            Parameter(f"{_owner(u, setup, session)}.{u.name}", u.unit, u.prior_std, ())
            for u in setup.sensor.nuisance_parameters
        ]
        of_sensor += [
            Parameter(f"setup.{setup.name}.{e.name}", e.unit, e.prior_std, (), e.positive)
            for effect in reading_effects(session.robot)
            for e in effect.setup_errors
        ]
        for parameter in of_sensor:
            parameters.setdefault(parameter.name, parameter)
            indices.append(list(parameters).index(parameter.name))
        of_setup.append(tuple(indices))
    return NuisanceParameters(tuple(parameters.values()), tuple(of_setup))


def _owner(unknown: NuisanceParameter, setup: Setup, session: Session) -> str:
    """Owner of a nuisance parameter: a gauge, a session's shared object, or the setup itself."""
    label, joined, _ = setup.name.partition("/") if session.joined else ("", "", "")
    if unknown.of_gauge:
        gauge = setup.gauge if not label else setup.gauge.partition("/")[2]
        return f"gauge.{gauge}" if gauge else "gauge"
    if unknown.shared_by is not None:
        return f"{label}{joined}{unknown.shared_by}"
    return f"setup.{setup.name}"


def group_sensors(session: Session, observations: Observations) -> tuple[SensorGroup, ...]:
    """Entries by the expression of their sensors."""
    robot = session.robot
    setups = list(session.setups.values())
    nuisance = nuisance_parameters(session).of_setup
    members_of: dict[int, tuple[CompiledReading, list[int]]] = {}
    for i in np.unique(observations.setup).tolist():
        reading = compile_reading(robot, setups[i].sensor)
        members_of.setdefault(id(reading), (reading, []))[1].append(i)
    groups = []
    for reading, members in members_of.values():
        entries = np.flatnonzero(np.isin(observations.setup, members))
        constants = {i: setups[i].sensor.constants(robot) for i in members}
        of_entry = observations.setup[entries]
        table = np.array([constants[i] for i in of_entry.tolist()])
        conditions = [observations.conditions[c][entries] for c in reading.conditions]
        table = np.hstack([table.reshape(entries.size, -1), *conditions])
        indices = np.array([nuisance[i] for i in of_entry.tolist()], dtype=np.int64)
        indices = indices.reshape(entries.size, -1)
        groups.append(SensorGroup(reading, entries, of_entry, table, indices))
    return tuple(groups)
