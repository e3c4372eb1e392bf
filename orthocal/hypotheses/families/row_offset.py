"""Row offset: a reading was skipped or written twice, so that later readings are one row off."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.hypotheses.anomaly import Explanation
from orthocal.hypotheses.hypothesis import Family, Patterns, Rows, Tails, sparse_rows

MIN_ROWS = 3
"""Fewest rows of a setup; a row offset of two rows is a swap."""


class _Offsets(NamedTuple):
    """Row offsets of one kind in a setup or cycle."""

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
    """A reading skipped or written twice, in a setup or in one of its cycles.

    If a reading was skipped, the last row contains the reading of the first wrong row, or another
    one. If a reading was written twice, the last one is lost. The lost reading has an unknown
    value.
    """
    dials = rows.written & ~rows.paired
    setups = {n: i for n, i in rows.setups.items() if dials[i].all()}
    segments = [indices for indices in setups.values() if indices.size >= MIN_ROWS]
    segments += [
        indices
        for (name, _), indices in rows.cycles.items()
        if name in setups and MIN_ROWS <= indices.size < setups[name].size
    ]
    if not segments:
        return
    offsets = [_offsets(i, rows.values[i], missing=m) for i in segments for m in (True, False)]
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
            "setup",
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


def _offsets(indices: Indices, values: Array, *, missing: bool) -> _Offsets:
    """Row offsets of one kind in some rows, one per row in which it may begin."""
    k = np.arange(0 if missing else 1, indices.size - 1)
    if missing:  # rows after k get the reading of the row before, row k gets the last one
        base = np.append(0.0, values[:-1] - values[1:])
        return _Offsets(indices, base, k, k + 1, indices[k], values[-1] - values[k], indices[k])
    # rows from k on get the reading of the row after, the last one is lost
    base = np.append(values[1:] - values[:-1], 0.0)
    return _Offsets(indices, base, k, k, indices[k], np.zeros(k.size), np.full(k.size, indices[-1]))
