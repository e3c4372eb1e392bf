"""Readings in each other's place: two rows, two postures, two setups, two legs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from orthocal.hypotheses.edits import Edit, Family, Table

Indices = NDArray[np.int64]

FAR_APART = 400
"""Rows above which only neighbours in a setup are tried."""

MOST = 4000
"""Pairs of a kind above which none is tried."""

Pair = tuple[Callable[[], str], Indices, Indices, tuple[str, ...]]


def find_exchanged(table: Table) -> Iterator[Family]:
    """All pairs of a kind."""
    for pairs in (
        _rows(table),
        _across(table),
        _postures(table),
        _postures_everywhere(table),
        _setups(table),
        _legs(table),
        _reversed(table),
    ):
        if 0 < len(pairs) <= MOST:
            yield _exchanged(table, pairs)


def _exchanged(table: Table, pairs: Sequence[Pair]) -> Family:
    change = np.zeros((len(pairs), table.count))
    edits = []
    for h, (words, one, other, setups) in enumerate(pairs):
        change[h, one] = table.values[other] - table.values[one]
        change[h, other] = table.values[one] - table.values[other]
        edits.append(partial(_edit, words, one, other, setups))
    return Family(edits, change, len(pairs))


def _edit(words: Callable[[], str], one: Indices, other: Indices, setups: tuple[str, ...]) -> Edit:
    return Edit(
        "exchanged readings",
        f"{words()} were exchanged",
        "If so, exchange them again.",
        (*one.tolist(), *other.tolist()),
        setups,
    )


def _two_rows(table: Table, one: int, other: int) -> str:
    return f"the readings {table.label(one)} and {table.label(other)}"


def _rows(table: Table) -> list[Pair]:
    found: list[Pair] = []
    for rows in table.cycles.values():
        near = table.count > FAR_APART
        pairs = pairwise(rows) if near else combinations(rows, 2)
        found += [
            (
                partial(_two_rows, table, int(i), int(j)),
                np.array([i]),
                np.array([j]),
                (),
            )
            for i, j in pairs
        ]
    return found


def _across(table: Table) -> list[Pair]:
    """The same posture in two setups: a column slipped in one line of the sheet."""
    found: dict[tuple[str, int], list[int]] = {}
    for i, r in enumerate(table.session.readings):
        found.setdefault((f"{r.posture}/{r.minus}", r.cycle), []).append(i)
    return [
        (partial(_two_rows, table, int(i), int(j)), np.array([i]), np.array([j]), ())
        for rows in found.values()
        for i, j in combinations(rows, 2)
    ]


def _postures(table: Table) -> list[Pair]:
    """Two postures of a setup, in all cycles."""
    by_setup: dict[str, list[Indices]] = {}
    for (setup, _), rows in table.repeated.items():
        by_setup.setdefault(setup, []).append(rows)
    return [
        (
            partial(_two_postures, table, a, b, setup),
            a,
            b,
            (),
        )
        for setup, groups in by_setup.items()
        for a, b in combinations(groups, 2)
        if len(a) == len(b) > 1
    ]


def _two_postures(table: Table, one: Indices, other: Indices, setup: str) -> str:
    return f"{_label(table, one)} and {_label(table, other)} in all cycles of setup {setup}"


def _label(table: Table, rows: Indices) -> str:
    r = table.session.readings[int(rows[0])]
    return r.posture + (f" − {r.minus}" if r.minus else "")


def _postures_everywhere(table: Table) -> list[Pair]:
    """Two postures in all setups that were read in both."""
    by_label: dict[str, dict[tuple[str, int], int]] = {}
    for i, r in enumerate(table.session.readings):
        label = r.posture + (f" − {r.minus}" if r.minus else "")
        by_label.setdefault(label, {})[r.setup, r.cycle] = i
    found: list[Pair] = []
    for a, b in combinations(by_label, 2):
        both = [k for k in by_label[a] if k in by_label[b]]
        if len({setup for setup, _ in both}) > 1:
            one, other = (np.array([by_label[x][k] for k in both]) for x in (a, b))
            words = f"the readings of postures {a} and {b} in all setups"
            found.append((partial(str, words), one, other, ()))
    return found


def _setups(table: Table) -> list[Pair]:
    return [
        (
            partial(str, f"the readings of setups {a} and {b}"),
            table.setups[a],
            table.setups[b],
            (a, b),
        )
        for a, b in combinations(table.setups, 2)
        if table.setups[a].size == table.setups[b].size
    ]


def _legs(table: Table) -> list[Pair]:
    """All setups of two legs, in their order."""
    legs = {w: g for w, g in table.groups.items() if w.startswith("leg ")}
    found: list[Pair] = []
    for a, b in combinations(legs, 2):
        sizes = [[table.setups[s].size for s in legs[x]] for x in (a, b)]
        if sizes[0] == sizes[1]:
            one, other = table.rows_of(legs[a]), table.rows_of(legs[b])
            words = f"the readings of {a.replace('leg', 'legs')} and {b.removeprefix('leg ')}"
            found.append((partial(str, words), one, other, (*legs[a], *legs[b])))
    return found


def _reversed(table: Table) -> list[Pair]:
    """The rows of a setup written from the last to the first."""
    found: list[Pair] = []
    for name, rows in table.setups.items():
        half = rows.size // 2
        if half > 1:
            words = f"the first and the last rows of setup {name}, which was written backwards,"
            found.append((partial(str, words), rows[:half], rows[::-1][:half], (name,)))
    return found
