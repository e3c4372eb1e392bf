"""Wrong readings: one, those of a posture, or those of a setup."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from orthocal.arrays import Indices
from orthocal.hypotheses.anomaly import AnomalyKind, Explanation, Scope
from orthocal.hypotheses.families.unit_and_sign import DECIMAL_POINTS, factor_family
from orthocal.hypotheses.hypothesis import Family, Rows

MISREAD = (1e-3, 0.5e-3, 0.2e-3, 0.1e-3)
"""Typical misreading of a dial: one turn, half a turn, one turn of a fine dial, one numbered mark,
[m]."""

MIN_POSTURES = 3
"""Fewest postures of a setup of which one may be wrong in all cycles."""

MAX_AMOUNTS = 12
"""Most independent amounts of a setup or posture that is considered."""

MAX_GROUPS = 100
"""Most setups or postures of a session in which these hypotheses are considered."""


def wrong_readings(rows: Rows) -> Iterator[Family]:
    """Mistakes in one reading, or in one posture of a setup in all cycles."""
    single = [np.array([i]) for i in range(rows.count)]
    yield _outliers(rows, single, "outlier")
    yield from _miswritten(rows, single)
    yield _misread(rows, [i for i in single if rows.written[i].all() and not rows.paired[i].any()])
    in_all_cycles = [
        indices
        for (setup, *_), indices in rows.repeated.items()
        if len(indices) > 1 and len(rows.setups[setup]) >= MIN_POSTURES * len(indices)
    ]
    yield _outliers(rows, in_all_cycles, "inconsistent posture")
    yield from _miswritten(rows, in_all_cycles)


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


def _outliers(rows: Rows, groups: Sequence[Indices], kind: AnomalyKind) -> Family:
    return Family.with_effects(rows, [_explain(rows, indices, kind) for indices in groups])


def _miswritten(rows: Rows, groups: Sequence[Indices]) -> Iterator[Family]:
    """Reversed signs and misplaced decimal points of groups of written readings."""
    written = [i for i in groups if rows.written[i].all()]
    signs = [_explain(rows, i, "reversed sign", factor=-1.0) for i in written]
    yield factor_family(rows, signs)
    points = [_explain(rows, i, "decimal point", factor=f) for f in DECIMAL_POINTS for i in written]
    yield factor_family(rows, points)


def _misread(rows: Rows, groups: Sequence[Indices]) -> Family:
    amounts = [sign * size for size in MISREAD for sign in (-1.0, 1.0)]
    explanations = [_explain(rows, i, "misread dial", amount=a) for a in amounts for i in groups]
    return Family.edited(rows, explanations, [np.array([-(e.amount or 0.0)]) for e in explanations])


def inconsistent_groups(rows: Rows) -> Iterator[Family]:
    """Setups, and postures of several setups, whose readings carry no information.

    These hypotheses have many free amounts. So any more specific hypothesis that fits has more
    evidence.
    """
    if 2 < len(rows.setups) <= MAX_GROUPS:
        yield _inconsistent_setups(rows)
    by_label: dict[str, list[Indices]] = {}
    for indices in rows.repeated.values():
        by_label.setdefault(rows.posture(int(indices[0])), []).append(indices)
    groups = {k: v for k, v in by_label.items() if 1 < len(v) <= MAX_AMOUNTS}
    explanations = [
        Explanation(
            "inconsistent posture", "postures", tuple(np.concatenate(g).tolist()), names=(label,)
        )
        for label, g in groups.items()
    ]
    if len(by_label) > 2 and len(groups) <= MAX_GROUPS:
        yield Family.of(explanations, groups=list(groups.values()))


def _inconsistent_setups(rows: Rows) -> Family:
    """Setups whose readings are wrong by independent amounts."""
    explanations, groups = [], []
    for name, indices in rows.setups.items():
        amounts = [r for (setup, *_), r in rows.repeated.items() if setup == name]
        if rows.single[indices].all() and rows.session.setups[name].zero == "free":
            amounts = amounts[1:]
        if 1 < len(amounts) <= MAX_AMOUNTS:
            concerned = tuple(indices.tolist())
            explanations.append(Explanation("inconsistent setup", "setup", concerned, (name,)))
            groups.append(amounts)
    return Family.of(explanations, groups=groups)
