"""Mistakes in a single reading, or in one posture of a setup in all its cycles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from orthocal.arrays import Indices
from orthocal.hypotheses.anomaly import AnomalyKind, Explanation, Scope
from orthocal.hypotheses.families.unit_and_sign import DECIMAL_POINTS, multiplied
from orthocal.hypotheses.hypothesis import Family, Rows

MISREAD = (1e-3, 0.5e-3, 0.2e-3, 0.1e-3)
"""Typical misreading of a dial: one turn, half a turn, one turn of a fine dial, one numbered mark,
[m]."""

MIN_POSTURES = 3
"""Fewest postures of a setup of which one may be wrong in all cycles."""


def wrong_readings(rows: Rows) -> Iterator[Family]:
    """Mistakes in one reading, or in one posture of a setup in all cycles."""
    yield _outliers(rows, [np.array([i]) for i in range(rows.count)])
    if written := [np.array([i]) for i in np.flatnonzero(rows.written)]:
        yield _multiplied(rows, written, (-1.0,), "reversed sign")
        yield _multiplied(rows, written, DECIMAL_POINTS, "decimal point")
    if dials := [i for i in written if not rows.paired[i].any()]:
        yield _misread(rows, dials)
    in_all_cycles = [
        indices
        for (setup, *_), indices in rows.repeated.items()
        if len(indices) > 1 and len(rows.setups[setup]) >= MIN_POSTURES * len(indices)
    ]
    if in_all_cycles:
        yield _outliers(rows, in_all_cycles)
    if written := [i for i in in_all_cycles if rows.written[i].all()]:
        yield _multiplied(rows, written, (-1.0,), "reversed sign")
        yield _multiplied(rows, written, DECIMAL_POINTS, "decimal point")


def _explain(
    rows: Rows,
    indices: Indices,
    kind: AnomalyKind,
    *,
    factor: float | None = None,
    amount: float | None = None,
) -> Explanation:
    """Explanation of one wrong reading, or of one posture that is wrong in all cycles."""
    scope: Scope = "reading" if len(indices) == 1 else "posture"
    names = (rows.posture(int(indices[0])),)
    concerned = tuple(indices.tolist())
    return Explanation(kind, scope, concerned, names=names, factor=factor, amount=amount)


def _outliers(rows: Rows, groups: Sequence[Indices]) -> Family:
    kind: AnomalyKind = "outlier" if len(groups[0]) == 1 else "inconsistent posture"
    return Family.with_effects(rows, [_explain(rows, indices, kind) for indices in groups])


def _multiplied(
    rows: Rows, groups: Sequence[Indices], factors: Sequence[float], kind: AnomalyKind
) -> Family:
    explanations = [_explain(rows, i, kind, factor=factor) for factor in factors for i in groups]
    return multiplied(rows, explanations)


def _misread(rows: Rows, groups: Sequence[Indices]) -> Family:
    amounts = [sign * size for size in MISREAD for sign in (-1.0, 1.0)]
    explanations = [_explain(rows, i, "misread dial", amount=a) for a in amounts for i in groups]
    return Family.edited(rows, explanations, [np.array([-(e.amount or 0.0)]) for e in explanations])
