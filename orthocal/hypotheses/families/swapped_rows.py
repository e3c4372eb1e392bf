"""Swapped rows: two readings, postures, setups or legs swapped.

In sessions of more than `FAR_APART` rows two rows of a setup are considered only if they are
neighbours, and a family of more than `MOST` pairs is not considered at all.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, pairwise

import numpy as np

from orthocal.arrays import Indices
from orthocal.hypotheses.anomaly import Explanation, Scope
from orthocal.hypotheses.hypothesis import Family, Rows, group_rows

FAR_APART = 400
"""Rows of a session above which only neighbours in a setup are considered."""

MOST = 60_000
"""Pairs of a family above which none is considered."""


def swapped_rows(rows: Rows) -> Iterator[Family]:
    """Swapped rows of every scope, one family each."""
    for pairs in (
        _of_setup(rows),
        _across_setups(rows),
        _postures_of_setup(rows),
        _postures(rows),
        _setups(rows),
        _legs(rows),
        _backwards(rows),
    ):
        if 0 < len(pairs) <= MOST:
            yield _swapped(rows, pairs)


def _swapped(rows: Rows, pairs: Sequence[Explanation]) -> Family:
    change = []
    for pair in pairs:
        one, other = np.array(pair.rows).reshape(2, -1)
        gain = rows.values[other] - rows.values[one]
        change.append(np.concatenate([gain, -gain]))
    return Family.edited(rows, pairs, change)


def _pair(
    scope: Scope,
    one: Indices,
    other: Indices,
    setups: tuple[str, ...] = (),
    names: tuple[str, ...] = (),
) -> Explanation:
    """Rows that may be swapped."""
    both = (*one.tolist(), *other.tolist())
    return Explanation("swapped rows", scope, both, setups, names)


def _rows(one: int, other: int) -> Explanation:
    return Explanation("swapped rows", "reading", (int(one), int(other)))


def _of_setup(rows: Rows) -> list[Explanation]:
    near = rows.count > FAR_APART
    return [
        _rows(i, j)
        for indices in rows.cycles.values()
        for i, j in (pairwise(indices) if near else combinations(indices, 2))
    ]


def _across_setups(rows: Rows) -> list[Explanation]:
    """Pairs of the same posture in two setups, as in a line of the sheet with slipped columns."""
    by_state = group_rows((r.postures, r.cycle) for r in rows.session.readings)
    if sum(len(indices) ** 2 for indices in by_state.values()) > 2 * MOST:
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
    if sum(len(groups) ** 2 for groups in by_setup.values()) > 2 * MOST:
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
    if len(by_label) ** 2 > 2 * MOST or len(by_label) * rows.count > 100 * MOST:
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
    if len(rows.setups) ** 2 > 2 * MOST:
        return []

    def session(setup: str) -> str:
        return setup.partition("/")[0] if rows.session.joined else ""

    return [
        _pair("setups", rows.setups[a], rows.setups[b], (a, b))
        for a, b in combinations(rows.setups, 2)
        if rows.setups[a].size == rows.setups[b].size and session(a) == session(b)
    ]


def _legs(rows: Rows) -> list[Explanation]:
    """All setups of two legs, in their order."""
    legs = {name: setups for (scope, name), setups in rows.groups.items() if scope == "leg"}
    explanations: list[Explanation] = []
    for a, b in combinations(legs, 2):
        sizes = [[rows.setups[s].size for s in legs[x]] for x in (a, b)]
        if sizes[0] == sizes[1]:
            one, other = rows.of_setups(legs[a]), rows.of_setups(legs[b])
            explanations.append(_pair("legs", one, other, (*legs[a], *legs[b]), (a, b)))
    return explanations


def _backwards(rows: Rows) -> list[Explanation]:
    """The rows of a setup written from the last to the first."""
    explanations: list[Explanation] = []
    for name, indices in rows.setups.items():
        half = indices.size // 2
        if half > 1:
            explanations.append(_pair("setup", indices[:half], indices[::-1][:half], (name,)))
    return explanations
