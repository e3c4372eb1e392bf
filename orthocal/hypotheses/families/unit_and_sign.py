"""Whole setups, cycles, legs, gauges or sessions in another unit, or with the wrong sign."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from orthocal.hypotheses.edits import Edit, Family, Table
from orthocal.hypotheses.mistake import MistakeKind
from orthocal.units import MM

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

UNITS = {25.4: "in inches", 1.0 / 25.4: "in mm but taken for inches", 1e3: "in m", 1e-3: "in µm"}
"""Factors that make mm of other units."""

WRONG_PLACES = dict.fromkeys((10.0, 0.1, 100.0, 0.01), "with the decimal point in the wrong place")
"""Factors that put a decimal point right."""

COARSEST = 10.0
"""Standard deviations of a reading that nobody's last figure is worth."""

FINEST = 1e-3
"""Standard deviations of a reading that nobody writes down more finely than: numbers with more
digits are no dial's, and that little is left of them is no mistake."""

MOST_DECIMALS = 9
"""Of numbers in mm that are looked at."""

FINER = 1e-3
"""Part of a step by which numbers may miss it."""

MOST_PAIRED = 24
"""Setups above which pairs of them are not tried."""


def find_scaled(table: Table, sigma: float) -> Iterator[Family]:
    """Signs and units of groups of readings.

    Args:
        table: The readings.
        sigma: Standard deviation of a reading, [m].
    """
    groups = _groups(table)
    yield _turned(table, groups)
    names = list(table.setups)
    if 3 < len(names) <= MOST_PAIRED:
        yield _turned(
            table,
            [
                (f"setups {a} and {b}", (a, b), table.rows_of((a, b)))
                for a, b in combinations(names, 2)
            ],
        )
    groups += [
        (f"setup {name}, cycle {cycle}", (), rows)
        for (name, cycle), rows in table.cycles.items()
        if len(rows) < len(table.setups[name])
    ]
    yield _scaled(table, groups, "wrong unit", UNITS, sigma)
    yield _scaled(table, groups, "decimal place", WRONG_PLACES, sigma)


def _groups(table: Table) -> list[tuple[str, tuple[str, ...], Indices]]:
    every = tuple(table.setups)
    found = [("all readings", every, np.arange(table.count))]
    found += [(f"the readings of {w}", g, table.rows_of(g)) for w, g in table.groups.items()]
    if len(every) > 1:
        found += [(f"setup {name}", (name,), rows) for name, rows in table.setups.items()]
    return found


def _dimensions(table: Table, rows: Indices, whole: bool) -> int:
    """Numbers that are free in some rows: of whole setups less the gauge's zeros."""
    if not whole:
        return rows.size
    raw = {table.session.readings[i].setup for i in rows if table.raw[i]}
    return rows.size - len(raw)


def _turned(table: Table, groups: list[tuple[str, tuple[str, ...], Indices]]) -> Family:
    edits = []
    change = np.zeros((len(groups), table.count))
    for h, (words, setups, rows) in enumerate(groups):
        change[h, rows] = -2.0 * table.values[rows]
        edits.append(
            partial(
                Edit,
                "turned setup",
                f"the sign of {words} was turned",
                "See which way the gauge stood and whether a minus was forgotten; then turn the "
                "signs, or `direction`.",
                tuple(rows.tolist()),
                setups,
                -1.0,
            )
        )
    return Family(edits, change, len(groups))


def _scaled(
    table: Table,
    groups: list[tuple[str, tuple[str, ...], Indices]],
    kind: MistakeKind,
    factors: dict[float, str],
    sigma: float,
) -> Family:
    edits: list[Callable[[], Edit]] = []
    written = [_written(table.values[group[2]]) for group in groups]
    pairs = [
        (factor, group)
        for factor in factors
        for group, step in zip(groups, written, strict=True)
        if factor < 1.0 or FINEST * sigma <= factor * step <= COARSEST * sigma
    ]
    change = np.zeros((len(pairs), table.count))
    volume = np.zeros(len(pairs))
    for factor, (words, setups, rows) in pairs:
        how = factors[factor]
        h = len(edits)
        change[h, rows] = (factor - 1.0) * table.values[rows]
        volume[h] = _dimensions(table, rows, bool(setups)) * np.log(factor)
        be = "were" if words.startswith(("all", "the")) else "was"
        edits.append(
            partial(
                Edit,
                kind,
                f"{words} {be} written {how}",
                f"If so, multiply these by {factor:.6g}.",
                tuple(rows.tolist()),
                setups,
                factor,
            )
        )
    return Family(edits, change, len(groups) * len(factors), log_volume=volume)


def _written(values: Array) -> float:
    """The step that numbers were written in, [m]: a power of ten of mm."""
    for decimals in range(MOST_DECIMALS):
        step = 10.0**-decimals * MM
        if np.abs(values / step - np.round(values / step)).max() < FINER:
            return step
    return 0.0
