"""A step that was missed or doubled: all later readings stand a row too high or too low."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from orthocal.hypotheses.edits import Edit, Family, Table

FEWEST = 3
"""Rows of a setup below which a shift is an exchange."""


def find_shifted(table: Table) -> Iterator[Family]:
    """A step missed or doubled in a setup, or in one cycle of it; and rows gone round by one."""
    segments = [(name, rows) for name, rows in table.setups.items() if rows.size >= FEWEST]
    segments += [
        (name, rows)
        for (name, _), rows in table.cycles.items()
        if FEWEST <= rows.size < table.setups[name].size
    ]
    moves: list[tuple[Callable[[], Edit], list[int], list[int], int]] = []
    for name, rows in segments:
        for k in range(rows.size - 1):
            to, last = rows[k:].tolist(), int(rows[-1])
            # what was read next stands in the row of the step that was missed
            moves.append((partial(_missed, table, name, to), to[1:] + to[:1], to, to[0]))
            if k > 0:
                moves.append((partial(_doubled, table, name, to), to, [*to[1:], last], last))
    if not moves:
        return
    change = np.zeros((len(moves), table.count))
    wrong = np.zeros_like(change)
    for h, (_, to, source, lost) in enumerate(moves):
        change[h, to] = table.values[source] - table.values[to]
        wrong[h, lost] = 1.0
    yield Family([m[0] for m in moves], change, len(moves), wrong=wrong)


def _missed(table: Table, setup: str, rows: list[int]) -> Edit:
    return Edit(
        "shifted rows",
        f"{table.label(rows[0])} was not read, and all later readings of setup {setup} stand in "
        "the row before their own",
        "If so, move them down by a row and read what is missing.",
        tuple(rows),
    )


def _doubled(table: Table, setup: str, rows: list[int]) -> Edit:
    return Edit(
        "shifted rows",
        f"the reading before {table.label(rows[0])} was written twice, and all later readings of "
        f"setup {setup} stand in the row after their own",
        "If so, move them up by a row and read the last one again.",
        tuple(rows),
    )
