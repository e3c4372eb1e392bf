"""Joined sessions: their settings of the controller, their order, and divisions of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array, Indices, Mask
from orthocal.measurement.joining import settings_of_sessions
from orthocal.session.session import Session, split_label

MAX_DIVIDED = 5
"""Most sessions of which all divisions into two groups are considered, in any order."""


@dataclass(frozen=True, slots=True, eq=False)
class JoinedSessions:
    """Sessions with readings, in the order in which they were joined."""

    session: Session
    """All of them together."""
    labels: tuple[str, ...]
    """Names of the sessions; a single "" without joined sessions."""
    of_entry: Indices
    """Session of each entry, shape (n_entries,)."""
    first_setups: Indices
    """First setup of each session, shape (n_sessions,)."""

    @classmethod
    def of(cls, session: Session, setup: Indices) -> JoinedSessions:
        """Sessions of the entries of a session.

        Args:
            session: A session, or several joined ones.
            setup: Setup of each entry, shape (n_entries,).
        """
        if not session.joined:
            return cls(session, ("",), np.zeros(setup.size, dtype=np.int64), setup[:1])
        label_of_setup = session.labels
        with_readings = {label_of_setup[i] for i in np.unique(setup)}
        labels = tuple(n for n in dict.fromkeys(label_of_setup) if n in with_readings)
        place = np.array([labels.index(n) if n in labels else -1 for n in label_of_setup])
        of_entry = place[setup]
        return cls(session, labels, of_entry, setup[np.unique(of_entry, return_index=True)[1]])

    @property
    def active(self) -> Array:
        """Offsets stated as active in the controller, shape (n_sessions, n_drives), [m, rad]."""
        session = self.session
        return self._of_sessions([session.active_during(name) for name in session.setups])

    @property
    def compensated(self) -> Array:
        """Backlashes that the controller compensates as stated, (n_sessions, n_drives), [m, rad].

        They are 0 if not stated.
        """
        session = self.session
        none = [0.0] * len(session.robot.drives)
        by_setup = [
            session.compensation if s.compensation is None else s.compensation
            for s in session.setups.values()
        ]
        return self._of_sessions([[t.lost_motion for t in c] or none for c in by_setup])

    def _of_sessions(self, by_setup: Sequence[ArrayLike]) -> Array:
        """Values of the first setup of each session, from those of all setups."""
        return np.array([by_setup[i] for i in self.first_setups])

    @property
    def corrections(self) -> tuple[tuple[bool, bool], ...]:
        """Flags of each session: offsets are active, and the controller compensates.

        Settings of single towers are the offsets of a printer.
        """
        settings = settings_of_sessions(self.session)
        towers = [n in settings and settings[n].corrects_towers for n in self.labels]
        offsets, backlashes = self.active.tolist(), self.compensated.tolist()
        rows = zip(offsets, towers, backlashes, strict=True)
        return tuple((any(values) or tower, any(others)) for values, tower, others in rows)

    @property
    def times(self) -> dict[str, datetime]:
        """Time of the first reading of each joined session; empty unless all readings state it."""
        times: dict[str, list[datetime]] = {}
        for r in self.session.readings:
            if not self.session.joined or r.conditions is None or r.conditions.time is None:
                return {}
            label, _ = split_label(r.setup, joined=True)
            time = r.conditions.time
            times.setdefault(label, []).append(time.replace(tzinfo=time.tzinfo or UTC))
        return {label: min(of_session) for label, of_session in times.items()}

    @property
    def order(self) -> Indices:
        """Sessions in the order of measuring, shape (n_sessions,).

        The times of the readings determine the order if all readings state them. Without times, or
        at equal times, sessions with `corrections` come later; all others have the order in which
        they were joined.
        """
        times = self.times or dict.fromkeys(self.labels, datetime.min.replace(tzinfo=UTC))
        keys = [(times[n], c) for n, c in zip(self.labels, self.corrections, strict=True)]
        return np.array(sorted(range(len(self.labels)), key=keys.__getitem__))

    @property
    def ordered_labels(self) -> list[str]:
        """Names of the sessions in the order of measuring."""
        return [self.labels[k] for k in self.order]

    def are_in(self, group: Sequence[int]) -> Mask:
        """Mask of the sessions of a group, shape (n_sessions,)."""
        return np.isin(np.arange(len(self.labels)), group)


def divide_sessions(order: Indices) -> Iterator[tuple[list[int], bool]]:
    """Divide sessions into two groups between which the machine may differ.

    Args:
        order: Sessions in the order of measuring, shape (n_sessions,).

    Yields:
        Sessions of one group, and False for all sessions from one on. With at most MAX_DIVIDED
        sessions also True for any other group of at most half of them, because the order may be
        stated wrongly.
    """
    sessions, n = order.tolist(), len(order)
    for k in range(1, n):
        yield sessions[k:], False
    if n > MAX_DIVIDED:
        return
    steps = [set(sessions[k:]) for k in range(1, n)] + [set(sessions[:k]) for k in range(1, n)]
    yielded: list[set[int]] = []
    for size in range(1, n // 2 + 1):
        for group in map(list, combinations(sessions, size)):
            others = set(sessions) - set(group)
            if set(group) not in steps and others not in yielded:
                yielded.append(set(group))
                yield group, True
