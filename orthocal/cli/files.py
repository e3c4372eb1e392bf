"""Loading of sessions for commands."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import orthocal
from orthocal.cli.options import state_tolerances
from orthocal.errors import SessionError

FEWEST_DIFFERENT = 4
"""Fewest different values with which equal readings show that a session is a copy."""


def load_each_once(
    paths: Sequence[Path],
    *,
    effects: Sequence[str] | None = None,
    tolerance: Sequence[str] | None = None,
    partial: bool = False,
) -> list[orthocal.Session]:
    """Load sessions, and refuse those whose readings would count twice.

    Args:
        paths: Their paths.
        effects: Effects beside geometry that replace those of the sessions.
        tolerance: Values of `--tolerance` that replace tolerances of the sessions.
        partial: Whether some of the readings may be missing.

    Raises:
        SessionError: If two sessions are the same, or have the same readings.
        ParameterError: If an effect does not exist, or a tolerance is invalid.
    """
    sessions: list[orthocal.Session] = []
    for path in paths:
        session = orthocal.load_session(path, partial=partial)
        if any(session.was_read_from(other.sha256) for other in sessions):
            raise SessionError(
                "is the same session as one before it; its readings would count twice",
                where=str(path),
            )
        original = next((other for other in sessions if _same_readings(session, other)), None)
        if original is not None:
            raise SessionError(
                f"has the same readings as {original.path}: a copy that was not measured again?",
                where=str(session.readings_path or path),
            )
        sessions.append(session)
    if effects is not None:
        from orthocal.robot.parameters import errors_at

        with errors_at("--effects"):
            sessions = [session.with_effects(effects) for session in sessions]
    return [state_tolerances(session, tolerance) for session in sessions]


def load_joined(
    paths: Sequence[Path],
    *,
    effects: Sequence[str] | None = None,
    tolerance: Sequence[str] | None = None,
    partial: bool = False,
) -> orthocal.Session:
    """Load sessions and join them into one; for arguments and errors see `load_each_once`."""
    return orthocal.join_sessions(
        load_each_once(paths, effects=effects, tolerance=tolerance, partial=partial)
    )


def _same_readings(one: orthocal.Session, other: orthocal.Session) -> bool:
    """True for equal rows with equal values, which two measurements do not have."""
    rows = [
        [(r.setup, r.posture, r.minus, r.cycle, r.value) for r in s.readings] for s in (one, other)
    ]
    return rows[0] == rows[1] and len({r[-1] for r in rows[0]}) >= FEWEST_DIFFERENT


def state_conditions(
    plan: orthocal.Session, temperatures: tuple[float, float] | None
) -> orthocal.Session:
    """Plan whose readings state the conditions that the effects of its machine need.

    Args:
        plan: The plan.
        temperatures: Temperatures at the first and the last reading, [°C]; by default those of the
            plan.
    """
    from orthocal.measurement.motion.approach import state_common_approach
    from orthocal.observation.conditions import needed_conditions, schedule_readings

    needed = {"temperature", "time"} & set(needed_conditions(plan.robot))
    stated = any(getattr(r.conditions, name, None) for r in plan.readings for name in needed)
    if temperatures is not None or (needed and not stated):
        plan = schedule_readings(plan, temperatures=temperatures)
    return state_common_approach(plan)
