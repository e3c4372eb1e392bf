"""Groups of sensors with the same expression, and nuisance parameters of a session."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.effects.loading import reading_effects
from orthocal.observation.observations import Observations
from orthocal.robot.parameters import Parameter
from orthocal.sensors.compiled import CompiledReading, compile_reading
from orthocal.sensors.protocol import NuisanceParameter, mirrored_parameters
from orthocal.session.session import Session, Setup, split_label

OF_GAUGE = "gauge."
"""Beginning of the names of parameters of a gauge. All setups of the gauge share them, and so do
all sessions that state the same nominal value."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorGroup:
    """Entries whose sensors have the same expression."""

    reading: CompiledReading
    """Functions of the sensors."""
    entries: Indices
    """Indices of the entries, shape (n,)."""
    setups: Indices
    """Index of the setup of each entry, shape (n,)."""
    constants: Array
    """Constants of the sensor, then conditions on which the reading depends, for each entry, shape
    (n, n_constants)."""
    nuisance: Indices
    """Indices of the nuisance parameters of each entry, shape (n, n_nuisance)."""


@dataclass(frozen=True, slots=True, eq=False)
class NuisanceParameters:
    """Nuisance parameters of the sensors of a session, and of effects on its setups."""

    parameters: tuple[Parameter, ...]
    """Parameters, named after their setup or after the object that several setups share."""
    of_setup: tuple[tuple[int, ...], ...]
    """Indices of the parameters of each setup, those of the sensor first."""
    mirrored: tuple[tuple[int, ...], ...]
    """Indices of the parameters of each vector that readings may determine only up to a sign."""


def nuisance_parameters(session: Session) -> NuisanceParameters:
    """Nuisance parameters of all setups with readings."""
    parameters: dict[str, Parameter] = {}
    of_setup: list[tuple[int, ...]] = []
    index: dict[str, int] = {}
    mirrored: dict[tuple[str, ...], None] = {}
    read = {r.setup for r in session.readings}
    for setup in session.setups.values():
        if setup.name not in read:
            of_setup.append(())
            continue
        setup_parameters = [
            Parameter(_full_name(p, setup, session), p.unit, p.prior_std, ())
            for p in setup.sensor.nuisance_parameters
        ]
        setup_parameters += [
            Parameter(f"setup.{setup.name}.{e.name}", e.unit, e.prior_std, (), e.positive)
            for effect in reading_effects(session.robot)
            for e in effect.setup_errors
        ]
        for parameter in setup_parameters:
            parameters.setdefault(parameter.name, parameter)
            index.setdefault(parameter.name, len(index))
        of_setup.append(tuple(index[p.name] for p in setup_parameters))
        vector = mirrored_parameters(setup.sensor)
        if vector:
            mirrored[tuple(_full_name(p, setup, session) for p in vector)] = None
    return NuisanceParameters(
        tuple(parameters.values()),
        tuple(of_setup),
        tuple(tuple(index[name] for name in vector) for vector in mirrored),
    )


def nominal_values(session: Session) -> dict[str, float]:
    """Names of nuisance parameters, mapped to the nominal values of their quantities unless 0."""
    return {name: p.nominal for _, p, name in _list_parameters(session) if p.nominal}


def _list_parameters(session: Session) -> Iterator[tuple[Setup, NuisanceParameter, str]]:
    """Nuisance parameters of the sensors of all setups, with their names in the session."""
    for setup in session.setups.values():
        for p in setup.sensor.nuisance_parameters:
            yield setup, p, _full_name(p, setup, session)


def shared_gauge_parameters(session: Session, measured: Session) -> dict[str, str]:
    """Parameters of gauges that a session shares with existing readings that it is joined with.

    Returns:
        Names in the session, mapped to the names in the existing readings.
    """
    existing = dict(_gauge_parameters(measured))
    return {name: existing[key] for key, name in _gauge_parameters(session) if key in existing}


def _gauge_parameters(session: Session) -> Iterator[tuple[tuple[str, str, float], str]]:
    """Parameters of the gauges with readings.

    Yields:
        Gauge, parameter and nominal value, which are equal for all sessions that share the
        parameter; and its name in the session.
    """
    read = {r.setup for r in session.readings}
    for setup, p, name in _list_parameters(session):
        if p.of_gauge and setup.name in read:
            _, gauge = split_label(setup.gauge, joined=session.joined)
            yield (gauge, p.name, p.nominal), name


def _full_name(parameter: NuisanceParameter, setup: Setup, session: Session) -> str:
    """Name after the owner of a parameter: a gauge, an object that setups share, or the setup."""
    label, base = split_label(setup.name, joined=session.joined)
    owner = f"setup.{setup.name}"
    if parameter.of_gauge:
        gauge = _shared_gauge(parameter, setup, session)
        owner = f"gauge.{gauge}" if gauge else "gauge"
    elif parameter.shared_by is not None:
        owner = f"{label}/{parameter.shared_by}" if label else parameter.shared_by
    elif parameter.fixed and session.firmware is not None:
        owner = f"setup.{base}"
    return f"{owner}.{parameter.name}"


def fixed_parameters(session: Session) -> set[str]:
    """Names of nuisance parameters of fixed parts of a printer, which all its logs share."""
    if session.firmware is None:
        return set()
    return {name for _, p, name in _list_parameters(session) if p.fixed}


def _shared_gauge(parameter: NuisanceParameter, setup: Setup, session: Session) -> str:
    """Name of the gauge that owns a parameter of a gauge.

    Joined sessions share the gauge if they state the same nominal value, such as the length of a
    bar. If a session states another value than the first one, its gauge has the label of the
    session.
    """
    _, gauge = split_label(setup.gauge, joined=session.joined)
    if not session.joined:
        return gauge
    owner_of_value: dict[float, str] = {}
    for other in session.setups.values():
        if split_label(other.gauge, joined=True)[1] == gauge:
            for p in other.sensor.nuisance_parameters:
                if p.of_gauge and p.name == parameter.name:
                    owner_of_value.setdefault(p.nominal, other.gauge if owner_of_value else gauge)
    return owner_of_value[parameter.nominal]


def group_sensors(session: Session, observations: Observations) -> tuple[SensorGroup, ...]:
    """Groups of entries whose sensors have the same expression."""
    robot = session.robot
    setups = list(session.setups.values())
    nuisance = nuisance_parameters(session).of_setup
    by_reading: dict[int, tuple[CompiledReading, list[int]]] = {}
    for i in np.unique(observations.setup).tolist():
        reading = compile_reading(robot, setups[i].sensor)
        by_reading.setdefault(id(reading), (reading, []))[1].append(i)
    groups = []
    for reading, members in by_reading.values():
        entries = np.flatnonzero(np.isin(observations.setup, members))
        constants = {i: setups[i].sensor.constants(robot) for i in members}
        setup_of = observations.setup[entries]
        table = np.array([constants[i] for i in setup_of.tolist()])
        conditions = [observations.conditions[c][entries] for c in reading.pattern.conditions]
        table = np.hstack([table.reshape(entries.size, -1), *conditions])
        indices = np.array([nuisance[i] for i in setup_of.tolist()], dtype=np.int64)
        indices = indices.reshape(entries.size, -1)
        groups.append(SensorGroup(reading, entries, setup_of, table, indices))
    return tuple(groups)
