"""Swapped rows: two readings, postures, setups or legs.

In sessions of more than MAX_ROWS_FOR_ALL_PAIRS rows, rows of a setup are paired with their
neighbours only. A family of more than MAX_PAIRS pairs is not considered.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, pairwise

import numpy as np

from orthocal.arrays import Indices
from orthocal.hypotheses.anomaly import Explanation, Scope
from orthocal.hypotheses.hypothesis import Family, Rows, group_rows

MAX_ROWS_FOR_ALL_PAIRS = 400
"""Most rows of a session in which all pairs of rows of a setup are considered."""

MAX_PAIRS = 60_000
"""Most pairs of a family that is considered."""


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
    """Pairs of rows of a setup and cycle."""
    neighbours_only = rows.count > MAX_ROWS_FOR_ALL_PAIRS
    return [
        _rows(i, j)
        for indices in rows.cycles.values()
        for i, j in (pairwise(indices) if neighbours_only else combinations(indices, 2))
    ]


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
