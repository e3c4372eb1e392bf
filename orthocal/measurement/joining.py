"""Joining of sessions: each keeps its gauge zeros, its gauges and its active offsets."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import numpy as np

from orthocal.arguments import require_kind
from orthocal.effects.adjustment import subtract_amounts
from orthocal.effects.loading import with_adjustments
from orthocal.errors import SessionError
from orthocal.measurement.files.session_file import load_session
from orthocal.printers.settings import DeltaSettings
from orthocal.robot.model import Robot
from orthocal.session.session import Session, Setup, split_label
from orthocal.text import composed

CACHE_SIZE = 4
"""Number of joined sessions whose parts are cached."""

Value = TypeVar("Value")

Given = Session | str | Path
"""A session, or the path to one."""


def gather_sessions(sources: Given | Sequence[Given]) -> list[Session]:
    """List of one or several sessions; paths are loaded.

    Raises:
        SessionError: If a path does not lead to a valid session, or two sessions are the same.
        TypeError: If an argument has another type.
    """
    listed = [sources] if isinstance(sources, Session | str | Path) else sources
    require_kind(listed, (list, tuple), expected="a Session, the path to one, or a list of them")
    for source in listed:
        require_kind(source, (Session, str, Path), expected="a Session, or the path to one")
    sessions = [s if isinstance(s, Session) else load_session(s) for s in listed]
    for i, session in enumerate(sessions):
        require_another(session, sessions[:i])
    return sessions


def join_sessions(sessions: Sequence[Session]) -> Session:
    """Join sessions on the same robot into one session with all their readings.

    Setups, postures and gauges are named after their session. Active offsets, adjustments and
    settings of a firmware are those of the last session. So the errors are those of the machine at
    that time. The nominal dimensions of a printer are those of the first session.

    Args:
        sessions: Sessions in the order of measurement, each joined before or not. A single one is
            returned unchanged.

    Raises:
        SessionError: If there is no session, or if robots, effects, firmware or tolerances differ.
        TypeError: If an argument has another type.
    """
    require_kind(sessions, (list, tuple), expected="a list of Sessions, as load_session returns")
    for session in sessions:
        require_kind(session, Session, expected="a Session, as load_session returns")
    if not sessions:
        raise SessionError("there is no session to join")
    if len(sessions) == 1:
        return sessions[0]
    if settings := sessions[0].firmware:
        sessions = [s.on_printer(sessions[0].robot, settings.homed) for s in sessions]
    last = sessions[-1]
    _require_same_machine(sessions)
    purposes = {s.purpose for s in sessions} - {None}
    parts = [_rename(s, labels) for s, labels in zip(sessions, _labels(sessions), strict=True)]
    setups = _merged(p.setups for p in parts)
    if any(subtract_amounts(s.adjusted or {}, last.adjusted) for s in setups.values()):
        last = replace(last, robot=with_adjustments(last.robot))
    return replace(
        last,
        title=" + ".join(dict.fromkeys(s.title for s in sessions if s.title)),
        source="; ".join(dict.fromkeys(s.source for s in sessions if s.source)),
        gauges=_merged(p.gauges for p in parts),
        postures=_merged(p.postures for p in parts),
        setups=setups,
        readings=tuple(r for p in parts for r in p.readings),
        path=None,
        readings_path=None,
        sha256="",
        seed=None,
        parts=tuple(sessions),
        joined=True,
        purpose=purposes.pop() if len(purposes) == 1 else None,
    )


def list_members(session: Session) -> list[Session]:
    """List of a session and, if it has the readings of sessions that were joined, of these."""
    values = [r.value for part in session.parts for r in part.readings]
    parts = session.parts if values == [r.value for r in session.readings] else ()
    return [session, *(member for part in parts for member in list_members(part))]


def require_another(session: Session, sessions: Sequence[Session]) -> None:
    """Refuse a session that is one of those before it, or joined from one.

    Raises:
        SessionError: If it is.
    """
    before = [member for other in sessions for member in list_members(other)]
    for member in list_members(session):
        if any(member is other or member.was_read_from(other.sha256) for other in before):
            raise SessionError(
                "is the same session as one before it; its readings would count twice",
                where=str(member.path or "session"),
            )


def _require_same_machine(sessions: Sequence[Session]) -> None:
    """Refuse sessions of different robots, effects, firmware or tolerances.

    Raises:
        SessionError: If they differ; names the session and the key.
    """
    first, last = sessions[0], sessions[-1]
    for session in sessions:
        require_same_robot(session, last)
        if session.robot.effect_names != last.robot.effect_names:
            names = (", ".join(s.robot.effect_names) or "none" for s in (session, last))
            raise SessionError(
                "states the effects {}; another session has {}: state the same effects in all of "
                "them, or choose by --effects".format(*names),
                where=f"{session.path or 'session'}: calibration.effects",
            )
        if (session.firmware is None) != (last.firmware is None):
            stating, other = (session, last) if last.firmware is None else (last, session)
            raise SessionError(
                "is missing, but another session of this printer states it. If the firmware had "
                "the same settings, copy the block controller of "
                f"{stating.path or 'that session'} into this file",
                where=f"{other.path or 'session'}: controller.firmware",
            )
        source = str(first.path or first.title or "another session")
        require_same_tolerances(first.robot, session, source=source)


def require_same_robot(session: Session, other: Session) -> None:
    """Refuse a session of another robot than that of another session.

    Raises:
        SessionError: If URDF or YAML of the robots differ; names both robots.
    """
    if session.robot.sha256 != other.robot.sha256:
        raise SessionError(
            f"is of robot '{session.robot.name}'; another session is of '{other.robot.name}', "
            "or of another version of it",
            where=None if session.path is None else str(session.path),
        )


def require_same_tolerances(robot: Robot, session: Session, *, source: str) -> None:
    """Refuse a session with other tolerances of the same machine.

    A session that states no tolerance of an error has that of the robot's YAML.

    Args:
        robot: The robot with its tolerances.
        session: The session.
        source: Name of the session or calibration with the first tolerances, for messages.

    Raises:
        SessionError: Naming both and an error whose tolerances differ.
    """
    one, other = robot.parameters, session.robot.parameters
    differing = (
        p for p in one if p.name in other and not math.isclose(p.prior_std, other[p.name].prior_std)
    )
    p = next(differing, None)
    if p is None:
        return
    here, there = (f"{q.limit_of(p.name):g}" for q in (other, one))
    options = {}
    for glob in (other.read_glob(key)[0] for key in other.stated):
        name = other.select([glob])[0]
        options[f"{glob}_{other[name].edge_unit}"] = one.limit_of(name)
    words = " ".join(f"--tolerance '{k}={v:g}'" for k, v in {**options, **one.stated}.items())
    raise SessionError(
        f"'{p.name}' is within ±{here} {p.edge_unit}, but within ±{there} {p.edge_unit} in "
        f"{source}; expected one value, because the machine is the same. A session without "
        f"`tolerances` has those of the robot's YAML. For all: {words}",
        where=f"{session.path or session.title or 'session'}: calibration.tolerances",
    )


@lru_cache(maxsize=CACHE_SIZE)
def split_sessions(session: Session) -> tuple[Session, ...]:
    """Sessions of which a joined session consists; any other session is its only part.

    Names in a part are those of the joined session. The parts are cached, so that results that are
    cached for a part are found again.
    """
    if not session.joined:
        return (session,)
    label_of = dict(zip(session.setups, session.labels, strict=True))
    labels = dict.fromkeys(label_of[r.setup] for r in session.readings)
    parts = []
    for label in labels:
        setups = {name: s for name, s in session.setups.items() if label_of[name] == label}
        used = {s.gauge for s in setups.values()}
        parts.append(
            replace(
                session,
                gauges={name: g for name, g in session.gauges.items() if name in used},
                setups=setups,
                readings=tuple(r for r in session.readings if label_of[r.setup] == label),
            )
        )
    return tuple(parts)


def settings_of_sessions(session: Session) -> dict[str, DeltaSettings]:
    """Stated settings of joined sessions by label, in the coordinates of the joined session.

    Those of a session that was joined before and has no parts are unknown, except of its last one.
    """
    if session.firmware is None:
        return {}
    settings = _list_settings(session)
    labels = list(dict.fromkeys(session.labels))
    if len(settings) != len(labels):
        return {}
    homed = np.array(session.firmware.homed)
    return {
        label: s.moved(homed - s.homed)
        for label, s in zip(labels, settings, strict=True)
        if s is not None
    }


def _list_settings(session: Session) -> list[DeltaSettings | None]:
    """Stated settings of the sessions of which a session consists."""
    if session.joined and session.parts:
        return [s for part in session.parts for s in _list_settings(part)]
    unknown = len(set(session.labels)) - 1
    return [*[None] * unknown, session.firmware]


def _merged(mappings: Iterable[Mapping[str, Value]]) -> dict[str, Value]:
    return {name: value for mapping in mappings for name, value in mapping.items()}


def _labels(sessions: Sequence[Session]) -> list[dict[str, str]]:
    """Unique labels of the sessions to be joined.

    Returns:
        Mapping of present to new labels for each session. The present label is "" unless the
        session was joined before. The new one is the name of its directory, or its number.
    """
    names: list[tuple[int, str, str]] = []
    for i, session in enumerate(sessions):
        if session.joined:
            names += [(i, label, label) for label in dict.fromkeys(session.labels)]
            continue
        folder = "" if session.path is None else session.path.resolve().parent.name
        label = "".join("_" if c.isspace() or c in ',;"/[]' else c for c in composed(folder))
        names.append((i, "", label or f"session-{len(names) + 1}"))
    if len({new for _, _, new in names}) < len(names):
        names = [(i, old, f"{new}-{k}") for k, (i, old, new) in enumerate(names, start=1)]
    return [{old: new for k, old, new in names if k == i} for i in range(len(sessions))]


def _rename(session: Session, labels: Mapping[str, str]) -> Session:
    """Session whose setups, postures and gauges have names with labels.

    Active offsets, adjustments and compensation become those of the setups.

    Args:
        session: A session, joined before or not.
        labels: Present labels, mapped to new ones; see `_labels`.
    """

    def named(name: str) -> str:
        old, within = split_label(name, joined=session.joined)
        label = labels.get(old, old)
        return f"{label}/{within}" if within else label

    active, aligned_at = session.active_offsets, session.alignment_postures

    def setup(s: Setup) -> Setup:
        return replace(
            s,
            name=named(s.name),
            gauge=named(s.gauge),
            active=active if s.active is None else s.active,
            aligned_at=named(aligned_at[s.name]),
            adjusted=session.adjusted if s.adjusted is None else s.adjusted,
            compensation=session.compensation if s.compensation is None else s.compensation,
        )

    return replace(
        session,
        gauges={named(name): gauge for name, gauge in session.gauges.items()},
        setups={named(s.name): setup(s) for s in session.setups.values()},
        postures={named(n): replace(p, name=named(n)) for n, p in session.postures.items()},
        readings=tuple(
            replace(
                r,
                setup=named(r.setup),
                posture=named(r.posture),
                minus=None if r.minus is None else named(r.minus),
                file=r.file or session.readings_path,
            )
            for r in session.readings
        ),
    )
