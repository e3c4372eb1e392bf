"""Wrong units, decimal points and signs of setups, cycles, legs, gauges or all readings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from orthocal.arrays import Array, Indices
from orthocal.hypotheses.anomaly import AnomalyKind, Explanation, Scope
from orthocal.hypotheses.hypothesis import Family, Rows
from orthocal.units import MM

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


def wrong_units_and_signs(rows: Rows, sigma: float) -> Iterator[Family]:
    """Factors that groups of readings share.

    Args:
        rows: The rows.
        sigma: Standard deviation of a reading, [m].
    """
    groups = _groups(rows)
    yield multiplied(rows, groups)
    names = list(rows.setups)
    if 3 < len(names) <= MOST_PAIRED:
        pairs = combinations(names, 2)
        yield multiplied(rows, [_reversed("setups", rows.of_setups(p), p) for p in pairs])
    groups += [
        _reversed("cycle", indices, names=(name,), cycle=cycle)
        for (name, cycle), indices in rows.cycles.items()
        if len(indices) < len(rows.setups[name])
    ]
    yield _scaled(rows, groups, "wrong unit", UNITS, sigma)
    yield _scaled(rows, groups, "decimal point", DECIMAL_POINTS, sigma)


def multiplied(rows: Rows, found: Sequence[Explanation], *, size: int | None = None) -> Family:
    """Readings that the factors of explanations correct.

    Args:
        rows: The rows.
        found: The explanations.
        size: Number of ways in which it could have happened; by default as many as explanations.
    """
    factors = np.array([e.factor for e in found], dtype=np.float64)
    change = [(f - 1.0) * rows.values[list(e.rows)] for f, e in zip(factors, found, strict=True)]
    dimensions = np.array([_dimensions(rows, e) for e in found])
    volume = dimensions * np.log(np.abs(factors))
    return Family.edited(rows, found, change, size=size, log_volume=volume)


def _reversed(
    scope: Scope,
    indices: Indices,
    setups: tuple[str, ...] = (),
    names: tuple[str, ...] = (),
    cycle: int | None = None,
) -> Explanation:
    at = tuple(indices.tolist())
    return Explanation("reversed sign", scope, at, setups, names, cycle, factor=-1.0)


def _groups(rows: Rows) -> list[Explanation]:
    """Groups of readings that may share a factor, with their signs reversed."""
    every = tuple(rows.setups)
    explanations = [_reversed("session", np.arange(rows.count), every)]
    for (scope, name), setups in rows.groups.items():
        kind: Scope = "leg" if scope == "leg" else "gauge"
        explanations.append(_reversed(kind, rows.of_setups(setups), setups, (name,)))
    if len(every) > 1:
        explanations += [
            _reversed("setup", indices, (name,)) for name, indices in rows.setups.items()
        ]
    return explanations


def _scaled(
    rows: Rows,
    groups: Sequence[Explanation],
    kind: AnomalyKind,
    factors: tuple[float, ...],
    sigma: float,
) -> Family:
    steps = [_step(rows.values[list(g.rows)]) for g in groups]
    tried = [
        replace(g, kind=kind, factor=factor)
        for factor in factors
        for g, step in zip(groups, steps, strict=True)
        if factor < 1.0 or FINEST * sigma <= factor * step <= COARSEST * sigma
    ]
    return multiplied(rows, tried, size=len(groups) * len(factors))


def _dimensions(rows: Rows, group: Explanation) -> int:
    """Independent numbers in a group of rows: those of whole setups less their gauge zeros."""
    if not group.setups:
        return len(group.rows)
    readings = rows.session.readings
    return len(group.rows) - len({readings[i].setup for i in group.rows if rows.single[i]})


def _step(values: Array) -> float:
    """Step in which numbers are written, a power of ten of 1 mm, [m]."""
    for decimals in range(MOST_DECIMALS):
        step = 10.0**-decimals * MM
        if np.abs(values / step - np.round(values / step)).max() < FINER:
            return step
    return 0.0
