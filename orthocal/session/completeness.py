"""Checks of sessions that are made in Python; those in files are checked as they are read."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from numbers import Integral, Real
from typing import get_args

import numpy as np

from orthocal.effects.adjustment import require_adjustment
from orthocal.errors import SessionError, errors_at
from orthocal.io.documents import MOST_SHOWN
from orthocal.kinematics.conditions import find_approach_problem
from orthocal.sensors.protocol import GaugeZero
from orthocal.session.differences import IndependentReadings
from orthocal.session.session import Conditions, Gauge, Posture, Reading, ReadingKey, Session, Setup
from orthocal.text import list_some


def require_complete(session: Session) -> None:
    """Refuse a session that cannot be calibrated.

    Raises:
        SessionError: If a part is of another kind, a sensor does not fit the robot, a reading has
            no value or repeats another one, or a name is unknown.
    """
    _require_named(session.postures, Posture, "postures")
    _require_named(session.setups, Setup, "setups")
    for name, gauge in session.gauges.items():
        _require_kind(gauge, Gauge, f"gauges.{name}")
    for name, posture in session.postures.items():
        _require_drives(session, posture.drives, f"postures.{name}.drives")
    if session.controller_offsets is not None:
        _require_drives(session, session.controller_offsets, "controller_offsets")
    _require_adjustments(session, session.adjusted, "adjusted")
    for setup in session.setups.values():
        _require_setup(session, setup)
    _require_readings(session)


def _require_named(parts: object, kind: type, where: str) -> None:
    """Refuse parts that are not a mapping from their names.

    Raises:
        SessionError: If they are not.
    """
    if not isinstance(parts, Mapping):
        raise SessionError(
            f"found a {type(parts).__name__}; expected a mapping of names", where=where
        )
    for name, part in parts.items():
        _require_kind(part, kind, f"{where}.{name}")
        if part.name != name:
            raise SessionError(f"has the name '{part.name}'", where=f"{where}.{name}")


def _require_kind(value: object, kind: type, where: str | None = None) -> None:
    if not isinstance(value, kind):
        found, expected = type(value).__name__, kind.__name__
        raise SessionError(f"found a {found}; expected a {expected}", where=where)


def _require_drives(session: Session, values: object, where: str) -> None:
    """Refuse drive coordinates or offsets that are not one number for each drive."""
    count = len(session.robot.drives)
    if not (
        isinstance(values, np.ndarray) and values.shape == (count,) and np.isfinite(values).all()
    ):
        raise SessionError(
            f"found {values!r}; expected an array of {count} numbers, in m or rad", where=where
        )


def _require_adjustments(session: Session, adjusted: Mapping[str, float], where: str) -> None:
    for name in adjusted:
        require_adjustment(session.robot, name, where=where, error=SessionError)


def _require_setup(session: Session, setup: Setup) -> None:
    """Refuse a setup that does not fit its session.

    Raises:
        SessionError: If a part of it is invalid; names the key.
    """
    where = f"setups.{setup.name}"
    if not hasattr(setup.sensor, "require_fit"):
        raise SessionError(f"found {setup.sensor!r}; expected a sensor", where=f"{where}.sensor")
    setup.sensor.require_fit(session.robot, where=where)
    require_name(setup.gauge, session.gauges, "gauge", where=where)
    if setup.aligned_at is not None:
        require_name(setup.aligned_at, session.postures, "posture", where=f"{where}.aligned_at")
    if setup.zero not in get_args(GaugeZero):
        expected = " or ".join(get_args(GaugeZero))
        raise SessionError(f"found {setup.zero!r}; expected {expected}", where=f"{where}.zero")
    if not 0.0 <= setup.payload < math.inf:
        raise SessionError(
            f"found {setup.payload}; expected 0 or a positive number, in kg",
            where=f"{where}.payload",
        )
    if setup.active is not None:
        _require_drives(session, setup.active, f"{where}.active")
    _require_adjustments(session, setup.adjusted or {}, f"{where}.adjusted")


def _require_readings(session: Session) -> None:
    """Refuse readings without a value, of unknown names, or that follow from others of their cycle.

    Raises:
        SessionError: If there are such readings, or none.
    """
    if not session.readings:
        raise SessionError("there are none; expected at least one", where="readings")
    keys, independent = set[ReadingKey](), IndependentReadings()
    zoned: dict[str, bool] = {}
    for r in session.readings:
        _require_kind(r, Reading, "readings")
        require_name(r.setup, session.setups, "setup", where="readings")
        for posture in (r.posture, *([] if r.minus is None else [r.minus])):
            require_name(posture, session.postures, "posture", where="readings")
        with errors_at(session.where(r)):
            if not isinstance(r.value, Real) or math.isinf(r.value):
                raise SessionError(f"found {r.value!r}; expected a finite number, in m")
            if not isinstance(r.cycle, Integral) or r.cycle < 1:
                raise SessionError(f"found the cycle {r.cycle!r}; expected a whole number from 1")
            if r.conditions is not None:
                _require_conditions(session, r, r.conditions, zoned)
            if r.key in keys:
                raise SessionError(f"repeats cycle {r.cycle}; count the repetitions: cycle 1, 2, …")
            keys.add(r.key)
            if r.minus is None or session.is_difference(r):
                independent.add(r)
    missing = sum(not r.is_read for r in session.readings)
    if missing:
        count = len(session.readings)
        raise SessionError(
            f"{missing} of {count} readings have no value; expected readings, in m",
            where="readings",
        )


def _require_conditions(
    session: Session, reading: Reading, conditions: Conditions, zoned: dict[str, bool]
) -> None:
    """Refuse conditions that do not fit the session.

    Args:
        session: The session.
        reading: The reading with the conditions.
        conditions: Its conditions.
        zoned: Setups, mapped to whether their times have a time zone. A first time is added.
    """
    _require_kind(conditions, Conditions)
    approach, time = conditions.approach, conditions.time
    if approach is not None and (problem := find_approach_problem(approach, session.robot)):
        raise SessionError(f"approach: found {problem}")
    if not math.isfinite(conditions.temperature or 0.0):
        raise SessionError(
            f"temperature: found {conditions.temperature}; expected a finite number, in °C"
        )
    if time is not None:
        has_zone = time.tzinfo is not None
        if zoned.setdefault(reading.setup, has_zone) != has_zone:
            raise SessionError(
                f"time: found {time}; expected all times of setup '{reading.setup}' with a time "
                "zone, or all without one"
            )


def require_name(name: str, known: Collection[str], noun: str, *, where: str | None = None) -> None:
    """Refuse an unknown name of a setup, a posture or a gauge.

    Raises:
        SessionError: If the name is unknown; lists the known ones.
    """
    if name not in known:
        listed = list_some(list(known), MOST_SHOWN)
        raise SessionError(f"'{name}' is not a {noun}; {noun}s: {listed}", where=where)
