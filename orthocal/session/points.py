"""Setups of points in a session: three setups, one for each coordinate, that share their lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from typing import cast

from orthocal.sensors.points import Points
from orthocal.session.session import Gauge, Reading, Session, Setup


def base_name(name: str) -> str:
    """Name of a setup in the files, without the bracket of a split setup of points."""
    return name.partition("[")[0]


def names_in_files(setup: Setup) -> tuple[str, str]:
    """Names in the files of a setup and of its gauge."""
    if not isinstance(setup.sensor, Points):
        return setup.name, setup.gauge
    return base_name(setup.name), base_name(setup.gauge)


def split_setup(
    base: Setup, gauge: Gauge, number: int = 0
) -> tuple[dict[str, Setup], dict[str, Gauge]]:
    """Split a setup of points into three setups, with the gauges that they need in addition.

    Args:
        base: The setup as a session.yaml states it.
        gauge: Its gauge.
        number: Number of the covariance among those of the setup's rows; 0 for the covariance that
            the setup states.
    """
    setups, gauges = {}, {}
    sensor = cast(Points, base.sensor)
    sensor = replace(sensor, station=sensor.station or base.name)
    for label, (axis, std) in sensor.split().items():
        name = f"{base.name}[{label}{number + 1 if number else ''}]"
        setups[name] = replace(base, name=name, sensor=axis)
        if std is not None:
            gauge_name = f"{base_name(base.gauge)}[{name}]"
            setups[name] = replace(setups[name], gauge=gauge_name)
            gauges[gauge_name] = replace(gauge, sigma=std, range=None)
    return setups, gauges


def gather_points(readings: Sequence[Reading], setups: Mapping[str, Setup]) -> list[list[Reading]]:
    """Readings of each line: three for a point, one for another sensor."""

    def line_key(item: tuple[int, Reading]) -> object:
        i, r = item
        if not isinstance(setups[r.setup].sensor, Points):
            return i
        return base_name(r.setup), r.posture, r.cycle, r.conditions, r.line

    return [[r for _, r in group] for _, group in groupby(enumerate(readings), line_key)]


def count_readings(session: Session, readings: Sequence[Reading] | None = None) -> int:
    """Number of readings as in the files: a point is one reading.

    Args:
        session: The session.
        readings: Some of its readings in their order; by default all.
    """
    return len(gather_points(session.readings if readings is None else readings, session.setups))


def one_row_per_point(session: Session) -> Session:
    """Session in which a setup of points and each of its lines are one, as in its files.

    It says where the machine stops, not what the instrument shows: its points have no readings.
    """
    setups: dict[str, Setup] = {}
    for setup in session.setups.values():
        if isinstance(setup.sensor, Points):
            name, _ = names_in_files(setup)
            setups.setdefault(name, replace(setup, name=name, sensor=setup.sensor.in_file))
        else:
            setups[setup.name] = setup
    if len(setups) == len(session.setups):
        return session
    lines = gather_points(session.readings, session.setups)
    readings = tuple(
        replace(r, setup=base_name(r.setup)) if r.setup not in setups else r for r, *_ in lines
    )
    return replace(session, setups=setups, readings=readings, sha256="")
