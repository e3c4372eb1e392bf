"""Single readings: outlier, reversed sign, decimal point, misread dial; also in all cycles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from orthocal.hypotheses.anomaly import AnomalyKind, Explanation, Scope
from orthocal.hypotheses.families.unit_and_sign import DECIMAL_POINTS
from orthocal.hypotheses.hypothesis import Family, Patterns, Rows, marks, sparse_rows

Indices = NDArray[np.int64]

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
    yield _misread(rows, single)
    several = [
        indices
        for (setup, *_), indices in rows.repeated.items()
        if len(indices) > 1 and len(rows.setups[setup]) >= FEWEST_POSTURES * len(indices)
    ]
    if several:
        yield _outliers(rows, several)
        yield _multiplied(rows, several, (-1.0,), "reversed sign")
        yield _multiplied(rows, several, DECIMAL_POINTS, "decimal point")


def explain_rows(
    rows: Rows, indices: Indices, kind: AnomalyKind, *, factor: float | None = None
) -> Explanation:
    """Explanation that concerns one reading, or one posture in all cycles."""
    scope: Scope = "reading" if len(indices) == 1 else "posture"
    names = (rows.posture(int(indices[0])),)
    return Explanation(kind, scope, tuple(indices.tolist()), names=names, factor=factor)


def _outliers(rows: Rows, groups: Sequence[Indices]) -> Family:
    kind: AnomalyKind = "outlier" if len(groups[0]) == 1 else "inconsistent posture"
    return Family(
        lambda h: explain_rows(rows, groups[h], kind),
        len(groups),
        len(groups),
        effects=marks(groups, rows.count),
    )


def _multiplied(
    rows: Rows, groups: Sequence[Indices], factors: Sequence[float], kind: AnomalyKind
) -> Family:
    tried = [(factor, indices) for factor in factors for indices in groups]
    change = [(factor - 1.0) * rows.values[indices] for factor, indices in tried]
    return Family(
        lambda h: explain_rows(rows, tried[h][1], kind, factor=tried[h][0]),
        len(tried),
        len(tried),
        Patterns(sparse_rows([indices for _, indices in tried], change, rows.count)),
        log_volume=np.array([len(indices) * np.log(abs(factor)) for factor, indices in tried]),
    )


def _misread(rows: Rows, groups: Sequence[Indices]) -> Family:
    steps = [sign * size for size in MISREAD for sign in (1.0, -1.0)]
    tried = [(step, indices) for step in steps for indices in groups]
    change = [np.full(len(indices), step) for step, indices in tried]

    def explain(h: int) -> Explanation:
        step, indices = tried[h]
        return Explanation(
            "misread dial",
            "reading",
            tuple(indices.tolist()),
            names=(rows.posture(int(indices[0])),),
            amount=-step,
        )

    return Family(
        explain,
        len(tried),
        len(tried),
        Patterns(sparse_rows([indices for _, indices in tried], change, rows.count)),
    )
