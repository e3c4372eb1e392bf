"""Wrong units, decimal points and signs of setups, cycles, legs, gauges or all readings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from orthocal.hypotheses.anomaly import AnomalyKind, Explanation, Scope
from orthocal.hypotheses.hypothesis import Family, Patterns, Rows, sparse_rows
from orthocal.units import MM

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

UNITS = (25.4, 1.0 / 25.4, 1e3, 1e-3)
"""Factors that correct inches, mm taken for inches, m, and µm."""

DECIMAL_POINTS = (10.0, 0.1, 100.0, 0.01)
"""Factors that correct a misplaced decimal point."""

COARSEST = 10.0
"""Step of the corrected numbers, over the noise, beyond which a unit is not considered."""

FINEST = 1e-3
"""Step of the corrected numbers, over the noise, below which a unit is not considered: computed
numbers have more digits than any dial."""

MOST_DECIMALS = 9
"""Decimals of numbers in mm that are considered."""

FINER = 1e-3
"""Part of a step by which numbers may miss it."""

MOST_PAIRED = 24
"""Setups above which pairs of them are not considered."""


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    """Rows that may share a factor."""

    scope: Scope
    rows: Indices
    setups: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    cycle: int | None = None

    def explain(self, kind: AnomalyKind, factor: float) -> Explanation:
        return Explanation(
            kind,
            self.scope,
            tuple(self.rows.tolist()),
            self.setups,
            self.names,
            cycle=self.cycle,
            factor=factor,
        )


def wrong_units_and_signs(rows: Rows, sigma: float) -> Iterator[Family]:
    """Factors that groups of readings share.

    Args:
        rows: The rows.
        sigma: Standard deviation of a reading, [m].
    """
    groups = _groups(rows)
    yield _reversed(rows, groups)
    names = list(rows.setups)
    if 3 < len(names) <= MOST_PAIRED:
        pairs = combinations(names, 2)
        yield _reversed(rows, [_Group("setups", rows.of_setups(p), p) for p in pairs])
    groups += [
        _Group("cycle", indices, names=(name,), cycle=cycle)
        for (name, cycle), indices in rows.cycles.items()
        if len(indices) < len(rows.setups[name])
    ]
    yield _scaled(rows, groups, "wrong unit", UNITS, sigma)
    yield _scaled(rows, groups, "decimal point", DECIMAL_POINTS, sigma)


def _groups(rows: Rows) -> list[_Group]:
    every = tuple(rows.setups)
    found = [_Group("session", np.arange(rows.count), every)]
    for (scope, name), setups in rows.groups.items():
        kind: Scope = "leg" if scope == "leg" else "gauge"
        found.append(_Group(kind, rows.of_setups(setups), setups, (name,)))
    if len(every) > 1:
        found += [_Group("setup", indices, (name,)) for name, indices in rows.setups.items()]
    return found


def _reversed(rows: Rows, groups: list[_Group]) -> Family:
    change = [-2.0 * rows.values[g.rows] for g in groups]
    edits = Patterns(sparse_rows([g.rows for g in groups], change, rows.count))
    return Family(
        lambda h: groups[h].explain("reversed sign", -1.0), len(groups), len(groups), edits
    )


def _scaled(
    rows: Rows,
    groups: list[_Group],
    kind: AnomalyKind,
    factors: tuple[float, ...],
    sigma: float,
) -> Family:
    steps = [_step(rows.values[g.rows]) for g in groups]
    tried = [
        (factor, g)
        for factor in factors
        for g, step in zip(groups, steps, strict=True)
        if factor < 1.0 or FINEST * sigma <= factor * step <= COARSEST * sigma
    ]
    change = [(factor - 1.0) * rows.values[g.rows] for factor, g in tried]
    return Family(
        lambda h: tried[h][1].explain(kind, tried[h][0]),
        len(tried),
        len(groups) * len(factors),
        Patterns(sparse_rows([g.rows for _, g in tried], change, rows.count)),
        log_volume=np.array([_dimensions(rows, g) * np.log(factor) for factor, g in tried]),
    )


def _dimensions(rows: Rows, group: _Group) -> int:
    """Independent numbers in a group of rows: those of whole setups less their gauge zeros."""
    if not group.setups:
        return group.rows.size
    readings = rows.session.readings
    return group.rows.size - len({readings[i].setup for i in group.rows if rows.single[i]})


def _step(values: Array) -> float:
    """Step in which numbers are written, a power of ten of 1 mm, [m]."""
    for decimals in range(MOST_DECIMALS):
        step = 10.0**-decimals * MM
        if np.abs(values / step - np.round(values / step)).max() < FINER:
            return step
    return 0.0
