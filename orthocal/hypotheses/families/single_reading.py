"""Single readings: outlier, reversed sign, decimal point, misread dial; also in all cycles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from orthocal.arrays import Indices
from orthocal.hypotheses.anomaly import AnomalyKind, Explanation, Scope
from orthocal.hypotheses.families.unit_and_sign import DECIMAL_POINTS, multiplied
from orthocal.hypotheses.hypothesis import Family, Rows

MISREAD = (1e-3, 0.5e-3, 0.2e-3, 0.1e-3)
"""Amounts by which a dial is misread: a turn, half a turn, a turn of a fine dial, a numbered mark,
[m]."""

FEWEST_POSTURES = 3
"""Postures of a setup from which on one may be wrong in all cycles."""


def wrong_readings(rows: Rows) -> Iterator[Family]:
    """Errors of one reading, or of one posture of a setup in all cycles."""
    single = [np.array([i]) for i in range(rows.count)]
    yield _outliers(rows, single)
    yield _multiplied(rows, single, (-1.0,), "reversed sign")
    yield _multiplied(rows, single, DECIMAL_POINTS, "decimal point")
    if dials := [np.array([i]) for i in np.flatnonzero(~rows.paired)]:
        yield _misread(rows, dials)
    several = [
        indices
        for (setup, *_), indices in rows.repeated.items()
        if len(indices) > 1 and len(rows.setups[setup]) >= FEWEST_POSTURES * len(indices)
    ]
    if several:
        yield _outliers(rows, several)
        yield _multiplied(rows, several, (-1.0,), "reversed sign")
        yield _multiplied(rows, several, DECIMAL_POINTS, "decimal point")


def _explain(
    rows: Rows,
    indices: Indices,
    kind: AnomalyKind,
    *,
    factor: float | None = None,
    amount: float | None = None,
) -> Explanation:
    """Explanation that concerns one reading, or one posture in all cycles."""
    scope: Scope = "reading" if len(indices) == 1 else "posture"
    names = (rows.posture(int(indices[0])),)
    at = tuple(indices.tolist())
    return Explanation(kind, scope, at, names=names, factor=factor, amount=amount)


def _outliers(rows: Rows, groups: Sequence[Indices]) -> Family:
    kind: AnomalyKind = "outlier" if len(groups[0]) == 1 else "inconsistent posture"
    return Family.with_effects(rows, [_explain(rows, indices, kind) for indices in groups])


def _multiplied(
    rows: Rows, groups: Sequence[Indices], factors: Sequence[float], kind: AnomalyKind
) -> Family:
    tried = [_explain(rows, i, kind, factor=factor) for factor in factors for i in groups]
    return multiplied(rows, tried)


def _misread(rows: Rows, groups: Sequence[Indices]) -> Family:
    amounts = [sign * size for size in MISREAD for sign in (-1.0, 1.0)]
    tried = [_explain(rows, i, "misread dial", amount=a) for a in amounts for i in groups]
    return Family.edited(rows, tried, [np.array([-(e.amount or 0.0)]) for e in tried])
