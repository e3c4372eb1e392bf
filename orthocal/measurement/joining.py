"""Several sessions as one: each keeps its zeros, its gauges and the offsets that were active."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

from orthocal.arguments import require_kind
from orthocal.effects.adjustment import subtract_amounts
from orthocal.effects.loading import with_adjustments
from orthocal.errors import SessionError
from orthocal.measurement.files.session_file import load_session
from orthocal.session.session import Posture, Session, Setup
from orthocal.text import composed

KEPT = 4
"""Joined sessions whose parts are kept."""

Value = TypeVar("Value")

Given = Session | str | Path
"""A session, or the path to one."""


def gather_sessions(given: Given | Sequence[Given]) -> list[Session]:
    """List of one or several sessions; paths are loaded.

    Raises:
        SessionError: If a path is none of a session.
        TypeError: If an argument is of another kind.
    """
    several = [given] if isinstance(given, Session | str | Path) else given
    require_kind(several, (list, tuple), expected="a Session, the path to one, or a list of them")
    for one in several:
        require_kind(one, (Session, str, Path), expected="a Session, or the path to one")
    return [one if isinstance(one, Session) else load_session(one) for one in several]


def join_sessions(sessions: Sequence[Session]) -> Session:
    """One session of all readings of several on the same robot.

    Setups, postures and gauges are named after their session. The active offsets and the mechanical
    adjustments are those of the last session: the errors of the machine are those that it has then.

    Args:
        sessions: In the order in which they were measured, joined ones among them or not; a single
            one is returned unchanged.

    Raises:
        SessionError: If there are none, or of different robots or effects.
    """
    if not sessions:
        raise SessionError("there is no session to join")
    if len(sessions) == 1:
        return sessions[0]
    last = sessions[-1]
    for session in sessions:
        if session.robot.sha256 != last.robot.sha256:
            raise SessionError(
                f"is of robot '{session.robot.name}'; another session is of '{last.robot.name}', "
                "or of another version of it",
                where=None if session.path is None else str(session.path),
            )
        if session.robot.effect_names != last.robot.effect_names:
            names = (", ".join(s.robot.effect_names) or "none" for s in (session, last))
            raise SessionError(
                "states the effects {}; another session has {}: choose them".format(*names),
                where=f"{session.path or 'session'}: calibration.effects",
            )
        if session.firmware != last.firmware:
            raise SessionError(
                "states other settings of the firmware than another session; expected readings "
                "with the same settings",
                where=f"{session.path or 'session'}: controller.firmware",
            )
    tolerances = _join_tolerances(sessions)
    purposes = {s.purpose for s in sessions} - {None}
    parts = [_rename(s, labels) for s, labels in zip(sessions, _labels(sessions), strict=True)]
    setups = _merged(p.setups for p in parts)
    if any(subtract_amounts(s.adjusted or {}, last.adjusted) for s in setups.values()):
        last = replace(last, robot=with_adjustments(last.robot))
    return replace(
        last.with_tolerances(tolerances),
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


def _join_tolerances(sessions: Sequence[Session]) -> dict[str, float]:
    """Tolerances that sessions on one machine state.

    Raises:
        SessionError: If they do not agree.
    """
    tolerances: dict[str, float] = {}
    of: dict[str, Session] = {}
    for session in sessions:
        for key, value in session.robot.parameters.stated.items():
            if tolerances.setdefault(key, value) != value:
                other = tolerances[key]
                raise SessionError(
                    f"is {value:g}; it is {other:g} in {of[key].path or 'another session'}, and "
                    "the machine is the same; expected one value. "
                    f"--tolerance '{key}={other:g}' states it for all sessions",
                    where=f"{session.path or 'session'}: calibration.tolerances.{key}",
                )
            of.setdefault(key, session)
    return tolerances


@lru_cache(maxsize=KEPT)
def split_sessions(session: Session) -> tuple[Session, ...]:
    """Parts of a joined session, with their names in it; another session is its only part.

    The parts of the last sessions are kept, and with them what is known of the same parts.
    """
    if not session.joined:
        return (session,)
    label = [r.setup.partition("/")[0] for r in session.readings]
    return tuple(
        replace(
            session,
            setups={k: v for k, v in session.setups.items() if k.partition("/")[0] == part},
            readings=tuple(r for r, of in zip(session.readings, label, strict=True) if of == part),
        )
        for part in dict.fromkeys(label)
    )


def name_within(name: str, *, joined: bool) -> str:
    """A setup's or posture's name in its own session, where sessions were joined or not."""
    return name.partition("/")[2] or name if joined else name


def _merged(mappings: Iterable[Mapping[str, Value]]) -> dict[str, Value]:
    return {name: value for mapping in mappings for name, value in mapping.items()}


def _labels(sessions: Sequence[Session]) -> list[dict[str, str]]:
    """Names of the sessions in the joined one, all different.

    Returns:
        For each session its present label ("" unless it was joined before) and the new one: the
        name of its directory, or its number.
    """
    names: list[tuple[int, str, str]] = []
    for i, session in enumerate(sessions):
        if session.joined:
            old = dict.fromkeys(name.partition("/")[0] for name in session.setups)
            names += [(i, label, label) for label in old]
            continue
        folder = "" if session.path is None else session.path.resolve().parent.name
        plain = "".join("_" if c.isspace() or c in ',;"/' else c for c in composed(folder))
        names.append((i, "", plain or f"session-{len(names) + 1}"))
    if len({new for _, _, new in names}) < len(names):
        names = [(i, old, f"{new}-{k}") for k, (i, old, new) in enumerate(names, start=1)]
    return [{old: new for k, old, new in names if k == i} for i in range(len(sessions))]


def _rename(session: Session, labels: Mapping[str, str]) -> Session:
    """The session with setups, postures and gauges that carry its labels, and with its offsets.

    Args:
        session: A session, joined before or not.
        labels: Present labels to new ones, as of `_labels`.
    """

    def named(name: str) -> str:
        if not session.joined:
            return f"{labels['']}/{name}" if name else labels[""]
        old, slash, within = name.partition("/")
        return f"{labels.get(old, old)}{slash}{within}"

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

    def posture(p: Posture) -> Posture:
        return replace(p, name=named(p.name))

    return replace(
        session,
        gauges={named(name): gauge for name, gauge in session.gauges.items()},
        setups={named(s.name): setup(s) for s in session.setups.values()},
        postures={named(p.name): posture(p) for p in session.postures.values()},
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
