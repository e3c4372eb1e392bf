"""Entries of a session: its readings as single ones with gauge zeros."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthocal.session.session import Session

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Readings as the gauge showed them, one an entry; differences are split.

    Differences of one setup and cycle that share postures are equivalent to readings with one free
    zero: eliminating it gives their covariance, σ² [[2, 1], [1, 2]] for two differences from one
    posture. So every entry is a single reading with standard deviation σ.
    """

    setup: Indices
    """Index of the setup, shape (n,)."""
    posture: Indices
    """Index of the posture, shape (n,)."""
    zero: Indices
    """Index of the gauge zero, shape (n,)."""
    n_zeros: int
    zero_setup: tuple[str, ...]
    """Setup of each zero."""
    zero_real: tuple[bool, ...]
    """True for the zero of a gauge, False for one that replaces differences."""
    zero_known: NDArray[np.bool_]
    """Mask of the zeros that are known to be 0, shape (n_zeros,)."""
    plus: Indices
    """Entry of each row of the session, shape (n_rows,)."""
    minus: Indices
    """Entry taken off, or -1, shape (n_rows,)."""

    @property
    def n_free_zeros(self) -> int:
        """Number of zeros that are estimated."""
        return self.n_zeros - int(self.zero_known.sum())

    @property
    def size(self) -> int:
        """Number of entries."""
        return self.setup.size

    def only(self, chosen: NDArray[np.bool_]) -> Observations:
        """Some of the entries, without rows."""
        none = np.empty(0, dtype=np.int64)
        return replace(
            self,
            setup=self.setup[chosen],
            posture=self.posture[chosen],
            zero=self.zero[chosen],
            plus=none,
            minus=none,
        )

    def sum_by_zero(self, values: Array, weights: Array) -> Array:
        """Weighted sums of the values with the same zero, shape (n_zeros, m) of (n, m)."""
        order = np.argsort(self.zero, kind="stable")
        starts = np.searchsorted(self.zero[order], np.arange(self.n_zeros))
        result = np.zeros((self.n_zeros, values.shape[1]))
        used = np.append(starts[1:], self.size) > starts
        weighted = (values * weights[:, None])[order]
        if weighted.size:
            result[used] = np.add.reduceat(weighted, starts[used], axis=0)
        return result

    def rows(self, entries: Array) -> Array:
        """Rows of the session from values of the entries, shape (n_rows, ...)."""
        taken = np.where(
            (self.minus >= 0).reshape(-1, *(1,) * (entries.ndim - 1)), entries[self.minus], 0.0
        )
        return np.asarray(entries[self.plus] - taken)

    def values(self, rows: Array) -> Array:
        """Values of the entries from rows of the session, shape (n,) of (n_rows,), [m].

        Where rows are differences, the first posture of each group is given the value 0.
        """
        result = np.zeros(self.size)
        known = np.zeros(self.size, dtype=bool)
        raw = self.minus < 0
        result[self.plus[raw]] = rows[raw]
        known[self.plus[raw]] = True
        pending = list(np.flatnonzero(~raw))
        while pending:
            left = []
            for row in pending:
                p, m = self.plus[row], self.minus[row]
                if known[p]:
                    result[m] = result[p] - rows[row]
                elif known[m]:
                    result[p] = result[m] + rows[row]
                else:
                    left.append(row)
                    continue
                known[p] = known[m] = True
            if len(left) == len(pending):  # nothing touches a known one: begin a new group
                known[self.minus[left[0]]] = True
            pending = left
        return result


def build_observations(session: Session) -> Observations:
    """Split a session's readings into single ones with gauge zeros."""
    setups = {name: i for i, name in enumerate(session.setups)}
    postures = {name: i for i, name in enumerate(session.postures)}
    entries: list[tuple[int, int, int]] = []
    zeros: dict[tuple[object, ...], int] = {}
    zero_setup: list[str] = []
    zero_real: list[bool] = []
    nodes: dict[tuple[str, int, str], int] = {}
    plus, minus = [], []
    groups = _difference_groups(session)

    def zero_index(key: tuple[object, ...], setup: str, real: bool) -> int:
        if key not in zeros:
            zeros[key] = len(zeros)
            zero_setup.append(setup)
            zero_real.append(real)
        return zeros[key]

    for reading in session.readings:
        setup = setups[reading.setup]
        if reading.minus is None:
            zero = zero_index((reading.setup,), reading.setup, True)
            plus.append(len(entries))
            minus.append(-1)
            entries.append((setup, postures[reading.posture], zero))
            continue
        ends = []
        for posture in (reading.posture, reading.minus):
            node = (reading.setup, reading.cycle, posture)
            if node not in nodes:
                key = (reading.setup, reading.cycle, groups[node])
                nodes[node] = len(entries)
                entries.append((setup, postures[posture], zero_index(key, reading.setup, False)))
            ends.append(nodes[node])
        plus.append(ends[0])
        minus.append(ends[1])
    table = np.array(entries, dtype=np.int64).reshape(-1, 3)
    return Observations(
        setup=table[:, 0],
        posture=table[:, 1],
        zero=table[:, 2],
        n_zeros=len(zeros),
        zero_setup=tuple(zero_setup),
        zero_real=tuple(zero_real),
        zero_known=np.array(
            [
                r and session.setups[s].zero == "known"
                for s, r in zip(zero_setup, zero_real, strict=True)
            ],
            dtype=np.bool_,
        ),
        plus=np.array(plus, dtype=np.int64),
        minus=np.array(minus, dtype=np.int64),
    )


def _difference_groups(session: Session) -> dict[tuple[str, int, str], str]:
    """Posture of a setup and cycle to a name of its group of differences."""
    leader: dict[tuple[str, int, str], tuple[str, int, str]] = {}

    def find(node: tuple[str, int, str]) -> tuple[str, int, str]:
        while (above := leader.setdefault(node, node)) != node:
            leader[node] = leader.setdefault(above, above)  # half the way next time
            node = above
        return node

    for r in session.readings:
        if r.minus is not None:
            leader[find((r.setup, r.cycle, r.posture))] = find((r.setup, r.cycle, r.minus))
    return {node: find(node)[2] for node in list(leader)}


def drive_table(session: Session) -> Array:
    """Commanded drive coordinates of all postures, shape (n_postures, n_drives), [m, rad]."""
    return np.array([p.drives for p in session.postures.values()])
