"""Loading of sessions for commands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import orthocal
from orthocal.cli.options import read_temperatures, split_effects, state_tolerances
from orthocal.errors import ParameterError, SessionError, errors_at
from orthocal.io.files import exists
from orthocal.text import spans

ROUNDING = 1e-9
"""Rounding error of readings, and of travels that follow from other settings, [m]."""

FEWEST_DIFFERENT = 4
"""Fewest different values with which equal readings show that a session is a copy."""

FEWEST_COMPARED = 8
"""Fewest compared readings of which most, not all, are equal in a copy."""

COPY_CHANCE = 1e-4
"""Chance of equal readings below which a session is a copy. It is an upper limit: it assumes that
the gauges were mounted exactly as before."""


def load_each_once(
    paths: Sequence[Path],
    *,
    effects: str | None = None,
    tolerance: Sequence[str] | None,
    partial: bool = False,
) -> list[orthocal.Session]:
    """Load sessions, and refuse those whose readings would count twice.

    Args:
        paths: Their paths.
        effects: Value of `--effects` that replaces the effects of the sessions.
        tolerance: Values of `--tolerance` that replace tolerances of the sessions.
        partial: Whether some of the readings may be missing.

    Raises:
        SessionError: If two sessions are the same, or have the same readings, or nearly so.
        ParameterError: If an effect does not exist, or a tolerance is invalid.
    """
    from orthocal.measurement.joining import require_another

    sessions: list[orthocal.Session] = []
    for path in paths:
        session = orthocal.load_session(path, partial=partial)
        require_another(session, sessions)
        for other in sessions:
            _require_measured_again(session, other)
        sessions.append(session)
    sessions = [_state_effects(session, effects) for session in sessions]
    return [state_tolerances(session, tolerance) for session in sessions]


def _state_effects(session: orthocal.Session, text: str | None) -> orthocal.Session:
    """Session in which the effects of `--effects` replace its own.

    Raises:
        ParameterError: If an effect does not exist.
    """
    names = split_effects(text)
    with errors_at("--effects"):
        return session if names is None else session.with_effects(names)


def require_not_calibrated(
    sessions: Sequence[orthocal.Session], calibration: orthocal.Calibration
) -> None:
    """Refuse copies of the sessions of a calibration, which would confirm it.

    Raises:
        SessionError: If a session is a copy; names both sessions and the lines that differ.
    """
    from orthocal.calibration.refit import restore_session
    from orthocal.measurement.joining import split_sessions

    record_of_all, parts = calibration.session, split_sessions(restore_session(calibration))
    records = record_of_all.parts
    if len(records) != len(parts):  # one session, or joined ones whose files are unknown
        records = (record_of_all,) * len(parts)
    for record, part in zip(records, parts, strict=True):
        other = replace(part, path=None if record.path is None else Path(record.path))
        for session in sessions:
            if not session.was_read_from(record.sha256):  # `validate_calibration` refuses it
                _require_measured_again(session, other)


def _key_in_session(reading: orthocal.Reading, *, joined: bool) -> tuple[object, ...]:
    """Key of a reading of a session that may be joined, with the names of its own session."""
    from orthocal.session.session import split_label

    *names, cycle = reading.key[:4]
    names_in_session = (None if n is None else split_label(n, joined=joined)[1] for n in names)
    return (*names_in_session, cycle, *reading.key[4:])


def _require_measured_again(session: orthocal.Session, other: orthocal.Session) -> None:
    """Refuse a session that is a copy of another one, with no or few readings changed.

    Raises:
        SessionError: If it is a copy; names both sessions and the lines that differ.
    """
    values = {
        _key_in_session(r, joined=other.joined): _measured(other, r)
        for r in other.readings
        if r.is_read
    }
    common = [r for r in session.readings if r.is_read and r.key in values]
    equal = [r for r in common if _are_equal(_measured(session, r), values[r.key])]
    complete = len(equal) == len(session.readings) == len(other.readings)
    if len({values[r.key] for r in equal}) < FEWEST_DIFFERENT or not (
        complete or _are_copied(session, common, equal)
    ):
        return
    copied = {r.key for r in equal}
    lines = sorted({r.line for r in common if r.key not in copied and r.line is not None})
    exception = f" except {spans(lines, 'line')}" if lines else ""
    raise SessionError(
        f"has the same readings as {other.path}{exception}: a copy that was not measured again?",
        where=str(session.readings_path or session.path),
    )


def _measured(session: orthocal.Session, reading: orthocal.Reading) -> tuple[float, ...]:
    """Numbers that a measurement determines: the reading, and the postures of a printer's log.

    Those are the travels of the carriages below their endstops, which no setting changes.
    """
    if session.firmware is None:
        return (reading.value,)
    postures = [p for p in (reading.posture, reading.minus) if p is not None]
    travels = [session.firmware.homed - session.postures[p].drives for p in postures]
    return reading.value, *(v for travel in travels for v in travel.tolist())


def _are_equal(one: Sequence[float], other: Sequence[float]) -> bool:
    """True if numbers are equal except for rounding errors."""
    return all(abs(a - b) <= ROUNDING for a, b in zip(one, other, strict=True))


def _are_copied(
    session: orthocal.Session, common: Sequence[orthocal.Reading], equal: Sequence[orthocal.Reading]
) -> bool:
    """True if the noise of the gauges excludes so many equal readings in two measurements.

    The first reading of a setup does not count, because the dial is set there. Gauges must have
    been mounted again: there are several setups, and their mounting has tolerances. Most readings
    must differ from each other: readings near 0 on an exact machine hardly depend on the mounting.

    Args:
        session: One of the sessions.
        common: Readings of the session that the other one has, too.
        equal: Those of them that are equal in both.
    """
    from orthocal.statistics.chance import chance_of_equal_readings

    first = {r.setup: r.key for r in reversed(common)}
    setups = [session.setups[name] for name in first]
    gauges = [session.gauges[s.gauge] for s in setups]
    steps = [(g.sigma, g.resolution) for g in gauges if g.sigma and g.resolution]
    count, n_equal = (sum(r.key != first[r.setup] for r in rows) for rows in (common, equal))
    mounted_anew = len(setups) > 1 and all(
        any(n.prior_std > 0.0 and not n.of_gauge for n in s.sensor.nuisance_parameters)
        for s in setups
    )
    varied = 2 * len({r.value for r in equal}) >= count
    if not (mounted_anew and varied) or len(steps) < len(gauges) or count < FEWEST_COMPARED:
        return False
    sigma, step = min(steps, key=lambda s: s[0] / s[1])
    return chance_of_equal_readings(n_equal, count, sigma=sigma, step=step) < COPY_CHANCE


def load_stated_plan(
    path: Path, *, effects: str | None, temperature: str | None
) -> orthocal.Session:
    """Plan with stated effects, whose readings state the conditions that these effects need.

    Args:
        path: Path of its session.
        effects: Value of `--effects`; by default the effects of the plan.
        temperature: Value of `--temperature`; by default the temperatures of the plan.

    Raises:
        OrthocalError: If the plan does not load, or an option is invalid.
    """
    from orthocal.robot.loading import packaged_robots

    if not exists(path) and str(path) in packaged_robots():
        raise ParameterError(
            f"is a robot; expected a session.yaml, which `orthocal plan {path} --out ...` writes",
            where=str(path),
        )
    plan = _state_effects(orthocal.load_plan(path), effects)
    return state_conditions(plan, read_temperatures(temperature))


def state_conditions(
    plan: orthocal.Session, temperatures: tuple[float, float] | None
) -> orthocal.Session:
    """Plan whose readings state the conditions that the effects of its machine need.

    Args:
        plan: The plan.
        temperatures: Temperatures at the first and the last reading, [°C]; by default those of the
            plan.
    """
    from orthocal.measurement.motion.motion import state_program_approaches
    from orthocal.observation.conditions import needed_conditions, schedule_readings

    needed = {"temperature", "time"} & set(needed_conditions(plan.robot))
    stated = any(getattr(r.conditions, name, None) for r in plan.readings for name in needed)
    if temperatures is not None or (needed and not stated):
        plan = schedule_readings(plan, temperatures=temperatures)
    return state_program_approaches(plan)
