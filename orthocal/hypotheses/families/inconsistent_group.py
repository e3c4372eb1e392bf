"""Inconsistent setup or posture: all its readings are wrong by independent amounts.

These hypotheses have many free amounts. So any more specific hypothesis that fits has more
evidence.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from orthocal.arrays import Indices
from orthocal.hypotheses.anomaly import Explanation
from orthocal.hypotheses.hypothesis import Family, Rows

MAX_AMOUNTS = 12
"""Most independent amounts of a setup or posture that is considered."""

MAX_GROUPS = 100
"""Most setups or postures of a session in which these hypotheses are considered."""


def inconsistent_groups(rows: Rows) -> Iterator[Family]:
    """Setups, and postures of several setups, whose readings carry no information."""
    for family in (_setups(rows), _postures(rows)):
        if family is not None and 0 < family.count <= MAX_GROUPS:
            yield family


def _setups(rows: Rows) -> Family | None:
    """Setups whose readings are wrong by independent amounts; None with fewer than 3 setups."""
    if not 2 < len(rows.setups) <= MAX_GROUPS:
        return None
    explanations, groups = [], []
    for name, indices in rows.setups.items():
        amounts = [r for (setup, *_), r in rows.repeated.items() if setup == name]
        if rows.single[indices].all():  # the gauge zero is free
            amounts = amounts[1:]
        if 1 < len(amounts) <= MAX_AMOUNTS:
            concerned = tuple(indices.tolist())
            explanations.append(Explanation("inconsistent setup", "setup", concerned, (name,)))
            groups.append(amounts)
    return Family.of(explanations, groups=groups)


def _postures(rows: Rows) -> Family | None:
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
