"""Readings in other rows: two swapped, or all one row off.

Readings, postures, setups or legs are swapped. A row offset follows from a reading that was skipped
or written twice.

In sessions of more than MAX_ROWS_FOR_ALL_PAIRS rows, rows of a setup are paired with their
neighbours only. A family of more than MAX_PAIRS pairs is not considered.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.hypotheses.anomaly import Explanation, Scope
from orthocal.hypotheses.hypothesis import Family, Patterns, Rows, Tails, group_rows, sparse_rows
from orthocal.observation.gauge_noise import ROUNDING_ERROR, usual_difference
from orthocal.session.session import Gauge

MAX_ROWS_FOR_ALL_PAIRS = 400
"""Most rows of a session in which all pairs of rows of a setup are considered."""

MAX_PAIRS = 60_000
"""Most pairs of a family that is considered."""

MIN_ROWS = 3
"""Fewest rows of a setup; a row offset of two rows is a swap."""


def swapped_rows(rows: Rows) -> Iterator[Family]:
    """Swapped rows, one family per scope."""
    for listed in (
        _of_setup(rows),
        _across_setups(rows),
        _postures_of_setup(rows),
        _postures(rows),
        _setups(rows),
        _legs(rows),
        _backwards(rows),
    ):
        pairs = [p for p in listed if rows.written[list(p.rows)].all()]
        if 0 < len(pairs) <= MAX_PAIRS:
            yield _swapped(rows, pairs)


def _swapped(rows: Rows, pairs: Sequence[Explanation]) -> Family:
    """Corrections that swap the rows back."""
    changes = []
    for pair in pairs:
        one, other = np.array(pair.rows).reshape(2, -1)
        difference = rows.values[other] - rows.values[one]
        changes.append(np.concatenate([difference, -difference]))
    return Family.edited(rows, pairs, changes)


def _pair(
    scope: Scope,
    one: Indices,
    other: Indices,
    setups: tuple[str, ...] = (),
    names: tuple[str, ...] = (),
) -> Explanation:
    """Explanation of two swapped groups of rows."""
    both = (*one.tolist(), *other.tolist())
    return Explanation("swapped rows", scope, both, setups, names)


def _rows(one: int, other: int) -> Explanation:
    return Explanation("swapped rows", "reading", (int(one), int(other)))


def _of_setup(rows: Rows) -> list[Explanation]:
    """Pairs of rows of a setup and cycle, and of its closing reading with the others."""
    neighbours_only = rows.count > MAX_ROWS_FOR_ALL_PAIRS
    pairs = [
        (i, j)
        for indices in rows.cycles.values()
        for i, j in (pairwise(indices) if neighbours_only else combinations(indices, 2))
    ]
    for (setup, _), indices in rows.cycles.items():
        if indices.size == 1 and not neighbours_only:
            (closing,) = indices
            others = (i for i in rows.setups[setup] if rows.posture(i) != rows.posture(closing))
            pairs += [(i, closing) for i in others if i < closing]
    return [_rows(i, j) for i, j in pairs]


def _across_setups(rows: Rows) -> list[Explanation]:
    """One posture in two setups, as if a number was written into the wrong column of the sheet."""
    by_state = group_rows((r.postures, r.cycle) for r in rows.session.readings)
    if sum(len(indices) ** 2 for indices in by_state.values()) > 2 * MAX_PAIRS:
        return []
    return [
        _rows(i, j)
        for indices in by_state.values()
        for i, j in combinations(indices, 2)
        if rows.session.readings[i].setup != rows.session.readings[j].setup
    ]


def _postures_of_setup(rows: Rows) -> list[Explanation]:
    """Two postures of a setup, in all cycles."""
    by_setup: dict[str, list[Indices]] = {}
    for (setup, *_), indices in rows.repeated.items():
        if len(indices) > 1:
            by_setup.setdefault(setup, []).append(indices)
    if sum(len(groups) ** 2 for groups in by_setup.values()) > 2 * MAX_PAIRS:
        return []
    return [
        _pair("posture", a, b, names=(setup, rows.posture(int(a[0])), rows.posture(int(b[0]))))
        for setup, groups in by_setup.items()
        for a, b in combinations(groups, 2)
        if len(a) == len(b)
    ]


def _postures(rows: Rows) -> list[Explanation]:
    """Two postures in all setups that read both."""
    by_label: dict[str, dict[tuple[str, int], int]] = {}
    for i, r in enumerate(rows.session.readings):
        by_label.setdefault(rows.posture(i), {})[r.setup, r.cycle] = i
    if len(by_label) ** 2 > 2 * MAX_PAIRS or len(by_label) * rows.count > 100 * MAX_PAIRS:
        return []
    explanations: list[Explanation] = []
    for a, b in combinations(by_label, 2):
        both = [k for k in by_label[a] if k in by_label[b]]
        if len({setup for setup, _ in both}) > 1:
            one, other = (np.array([by_label[x][k] for k in both]) for x in (a, b))
            explanations.append(_pair("postures", one, other, names=(a, b)))
    return explanations


def _setups(rows: Rows) -> list[Explanation]:
    """Two setups of one session."""
    if len(rows.setups) ** 2 > 2 * MAX_PAIRS:
        return []
    label = dict(zip(rows.session.setups, rows.session.labels, strict=True))
    return [
        _pair("setups", rows.setups[a], rows.setups[b], (a, b))
        for a, b in combinations(rows.setups, 2)
        if rows.setups[a].size == rows.setups[b].size and label[a] == label[b]
    ]


def _legs(rows: Rows) -> list[Explanation]:
    """All setups of two legs, in the order of the setups."""
    legs = {name: setups for (scope, name), setups in rows.groups.items() if scope == "leg"}
    explanations: list[Explanation] = []
    for a, b in combinations(legs, 2):
        sizes = [[rows.setups[s].size for s in legs[x]] for x in (a, b)]
        if sizes[0] == sizes[1]:
            one, other = rows.of_setups(legs[a]), rows.of_setups(legs[b])
            explanations.append(_pair("legs", one, other, (*legs[a], *legs[b]), (a, b)))
    return explanations


def _backwards(rows: Rows) -> list[Explanation]:
    """All rows of a setup, written in reverse order."""
    explanations: list[Explanation] = []
    for name, indices in rows.setups.items():
        half = indices.size // 2
        if half > 1:
            explanations.append(_pair("setup", indices[:half], indices[::-1][:half], (name,)))
    return explanations


class _Offsets(NamedTuple):
    """Row offsets of one kind in a setup, a cycle or a session."""

    rows: Indices
    """Rows in the order of measuring, shape (m,)."""
    base: Array
    """Correction of each row from the start on, shape (m,), [m]."""
    position: Indices
    """Place in `rows` of the first wrong row, shape (h,)."""
    start: Indices
    """Place in `rows` from which on `base` applies, shape (h,)."""
    corrected: Indices
    """Row with a separate correction, shape (h,)."""
    correction: Array
    """Separate correction of that row, shape (h,), [m]."""
    lost: Indices
    """Row whose reading is lost, shape (h,)."""


def row_offsets(rows: Rows) -> Iterator[Family]:
    """A reading skipped or written twice: in a setup or one of its cycles, and beyond a setup.

    If a reading was skipped, the last row contains the reading of the first wrong row, or another
    one. If a reading was written twice, the last one is lost. The lost reading has an unknown
    value.
    """
    dials = rows.written & ~rows.paired
    setups = {n: i for n, i in rows.setups.items() if dials[i].all()}
    segments = [*setups.values()]
    segments += [
        indices
        for (name, _), indices in rows.cycles.items()
        if name in setups and indices.size < setups[name].size
    ]
    yield from _row_offsets(rows, "setup", [(i, i.size - 1) for i in segments])
    label = dict(zip(rows.session.setups, rows.session.labels, strict=True))
    sessions = group_rows(label[r.setup] for r in rows.session.readings)
    read = [i[dials[i]] for i in sessions.values()]
    # an offset that begins in the last setup is one of that setup
    last = [[rows.session.readings[k].setup for k in i] for i in read]
    yield from _row_offsets(
        rows, "session", [(i, s.index(s[-1])) for i, s in zip(read, last, strict=True) if s]
    )


def _row_offsets(
    rows: Rows, scope: Scope, segments: Sequence[tuple[Indices, int]]
) -> Iterator[Family]:
    """Family of the row offsets of some segments; none if all segments are short.

    Args:
        rows: The rows.
        scope: Scope of the offsets.
        segments: Rows in the order of measuring, and the number of rows in which an offset may
            begin.
    """
    offsets = [
        _offsets(i, rows.values[i], begins, _largest_repeat(rows.gauge(i[0])), missing=missing)
        for i, begins in segments
        if i.size >= MIN_ROWS and begins
        for missing in (True, False)
    ]
    if not any(o.position.size for o in offsets):
        return
    sizes = [o.position.size for o in offsets]
    group = np.repeat(np.arange(len(offsets)), sizes)
    position, start, corrected, correction, lost = (
        np.concatenate([getattr(o, name) for o in offsets]) for name in _Offsets._fields[2:]
    )

    def explain(h: int) -> Explanation:
        indices = offsets[group[h]].rows[position[h] :]
        cycles = {rows.session.readings[i].cycle for i in indices}
        return Explanation(
            "row offset",
            scope,
            tuple(indices.tolist()),
            names=(rows.session.readings[indices[0]].setup,),
            cycle=cycles.pop() if len(cycles) == 1 else None,
            missing=int(group[h]) % 2 == 0,
        )

    count, ones = group.size, np.ones((group.size, 1))
    tails = Tails([(o.rows, o.base) for o in offsets], group, start)
    separate = sparse_rows(list(corrected[:, None]), list(correction[:, None]), rows.count)
    edits = Patterns(separate, tails)
    effects = Patterns(sparse_rows(list(lost[:, None]), list(ones), rows.count))
    yield Family(explain, count, count, edits, effects)


def _largest_repeat(gauge: Gauge) -> float:
    """Largest difference of two readings of one posture, [m]; infinite if unknown."""
    usual = usual_difference(gauge)
    return usual + ROUNDING_ERROR if usual else math.inf


def _offsets(
    indices: Indices, values: Array, begins: int, repeat: float, *, missing: bool
) -> _Offsets:
    """Row offsets of one kind in some rows, one per row in which it may begin.

    Args:
        indices: The rows, shape (m,).
        values: Their readings, shape (m,), [m].
        begins: Number of first rows that may be skipped, or written twice.
        repeat: Largest difference of a reading that was written twice, [m].
        missing: Whether a reading was skipped, not written twice.
    """
    k = np.arange(begins) if missing else np.arange(1, min(begins + 1, indices.size - 1))
    if missing:  # rows after k get the reading of the row before, row k gets the last one
        base = np.append(0.0, values[:-1] - values[1:])
        return _Offsets(indices, base, k, k + 1, indices[k], values[-1] - values[k], indices[k])
    k = k[np.abs(values[k] - values[k - 1]) <= repeat]
    # rows from k on get the reading of the row after, the last one is lost
    base = np.append(values[1:] - values[:-1], 0.0)
    return _Offsets(indices, base, k, k, indices[k], np.zeros(k.size), np.full(k.size, indices[-1]))
