"""Something else: a whole setup, or a posture in all setups, that goes its own way.

What these can be wrong by is so much that any more particular mistake is likelier, where it fits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from orthocal.hypotheses.edits import Edit, Family, Table

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MOST = 12
"""Amounts of one setup or posture that are looked at."""


def find_loose(table: Table) -> Iterator[Family]:
    """Setups, and postures of several setups, of which nothing is believed."""
    for edits, groups in (_setups(table), _postures(table)):
        if edits:
            loose = [_marks(table, g) for g in groups]
            yield Family(edits, np.zeros((len(edits), table.count)), len(edits), loose=loose)


def _marks(table: Table, groups: Sequence[Indices]) -> Array:
    result = np.zeros((len(groups), table.count))
    for k, rows in enumerate(groups):
        result[k, rows] = 1.0
    return result


def _setups(table: Table) -> tuple[list[Callable[[], Edit]], list[list[Indices]]]:
    edits: list[Callable[[], Edit]] = []
    found = []
    for name, rows in table.setups.items():
        groups = [r for (setup, _), r in table.repeated.items() if setup == name]
        own = groups if not table.raw[rows].all() else groups[1:]  # the gauge's zero is unknown
        if len(table.setups) > 2 and 1 < len(own) <= MOST:
            found.append(own)
            edits.append(
                partial(
                    Edit,
                    "suspicious setup",
                    f"setup {name} was another one than is said",
                    "Look at its leg, direction and section, and at how its gauge stood; then "
                    "read it again, or leave it out.",
                    tuple(rows.tolist()),
                    (name,),
                )
            )
    return edits, found


def _postures(table: Table) -> tuple[list[Callable[[], Edit]], list[list[Indices]]]:
    by_label: dict[str, list[Indices]] = {}
    for rows in table.repeated.values():
        r = table.session.readings[int(rows[0])]
        by_label.setdefault(f"{r.posture}/{r.minus or ''}", []).append(rows)
    edits: list[Callable[[], Edit]] = []
    found = []
    for label, groups in by_label.items():
        if 1 < len(groups) <= MOST and len(by_label) > 2:
            name = label.rstrip("/").replace("/", " − ")
            found.append(groups)
            edits.append(
                partial(
                    Edit,
                    "suspicious posture",
                    f"the machine was elsewhere than in posture {name} whenever that was read",
                    "Look at its coordinates, and read it again.",
                    tuple(np.concatenate(groups).tolist()),
                )
            )
    return edits, found
