"""Row offset: a step was missed or written twice, so that later readings are one row off."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from orthocal.hypotheses.anomaly import Explanation
from orthocal.hypotheses.hypothesis import Family, Patterns, Rows, Tails, sparse_rows

Indices = NDArray[np.int64]

FEWEST = 3
"""Rows of a setup below which a row offset is a swap."""


def row_offsets(rows: Rows) -> Iterator[Family]:
    """A step missed or written twice in a setup or in one cycle of it.

    If a step is missed, the last row is empty or holds what belongs into the first of the rows;
    if one is written twice, the last reading is lost. The lost reading is of unknown size.
    """
    segments = [own for own in rows.setups.values() if own.size >= FEWEST]
    segments += [
        own for (name, _), own in rows.cycles.items() if FEWEST <= own.size < rows.setups[name].size
    ]
    if not segments:
        return
    tails: list[tuple[Indices, NDArray[np.float64]]] = []
    segment, start, at, lost, value = [], [], [], [], []
    missing, first = [], []
    for own in segments:
        v = rows.values[own]
        before, after = np.append(0.0, v[:-1]) - v, np.append(v[1:], v[-1]) - v
        before[0] = 0.0
        k = np.arange(own.size - 1)
        tails += [(own, before), (own, after)]
        # a missed step: rows after k get the reading before; row k gets the last one
        segment.append(np.full(k.size, len(tails) - 2))
        start.append(k + 1)
        at.append(own[k])
        value.append(v[-1] - v[k])
        lost.append(own[k])
        missing.append(np.ones(k.size, dtype=bool))
        first.append(k)
        # a step written twice: rows from k on get the reading after; the last is lost
        twice = k[k > 0]
        segment.append(np.full(twice.size, len(tails) - 1))
        start.append(twice)
        at.append(own[twice])
        value.append(np.zeros(twice.size))
        lost.append(np.full(twice.size, own[-1]))
        missing.append(np.zeros(twice.size, dtype=bool))
        first.append(twice)
    segment_of, position = np.concatenate(segment), np.concatenate(first)
    missed = np.concatenate(missing)
    singles = np.concatenate(at)[:, None], np.concatenate(value)[:, None]

    def explain(h: int) -> Explanation:
        own = tails[segment_of[h]][0][position[h] :]
        cycles = {rows.session.readings[i].cycle for i in own}
        return Explanation(
            "row offset",
            "setup",
            tuple(own.tolist()),
            names=(rows.session.readings[own[0]].setup,),
            cycle=cycles.pop() if len(cycles) == 1 else None,
            missing=bool(missed[h]),
        )

    count = segment_of.size
    yield Family(
        explain,
        count,
        count,
        Patterns(
            sparse_rows(list(singles[0]), list(singles[1]), rows.count),
            Tails(tails, segment_of, np.concatenate(start)),
        ),
        Patterns(
            sparse_rows(list(np.concatenate(lost)[:, None]), list(np.ones((count, 1))), rows.count)
        ),
    )
