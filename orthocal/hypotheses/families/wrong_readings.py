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
    return factor_family(rows, explanations)


def _misread(rows: Rows, groups: Sequence[Indices]) -> Family:
    amounts = [sign * size for size in MISREAD for sign in (-1.0, 1.0)]
    explanations = [_explain(rows, i, "misread dial", amount=a) for a in amounts for i in groups]
    return Family.edited(rows, explanations, [np.array([-(e.amount or 0.0)]) for e in explanations])


def inconsistent_groups(rows: Rows) -> Iterator[Family]:
    """Setups, and postures of several setups, whose readings carry no information.

    These hypotheses have many free amounts. So any more specific hypothesis that fits has more
    evidence.
    """
    for family in (_inconsistent_setups(rows), _inconsistent_postures(rows)):
        if family is not None and 0 < family.count <= MAX_GROUPS:
            yield family


def _inconsistent_setups(rows: Rows) -> Family | None:
    """Setups whose readings are wrong by independent amounts; None with fewer than 3 setups."""
    if not 2 < len(rows.setups) <= MAX_GROUPS:
        return None
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


def _inconsistent_postures(rows: Rows) -> Family | None:
    """Postures whose readings in all setups are wrong by independent amounts; None with few."""
    by_label: dict[str, list[Indices]] = {}
    for indices in rows.repeated.values():
        by_label.setdefault(rows.posture(int(indices[0])), []).append(indices)
    if len(by_label) < 3:
        return None
    groups = {k: v for k, v in by_label.items() if 1 < len(v) <= MAX_AMOUNTS}
    explanations = [
        Explanation(
            "inconsistent posture", "postures", tuple(np.concatenate(g).tolist()), names=(label,)
        )
        for label, g in groups.items()
    ]
    return Family.of(explanations, groups=list(groups.values()))
