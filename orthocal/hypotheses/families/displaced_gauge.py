"""Displaced gauge, drift and stuck dial: what changes while a setup is read.

Differences of postures show neither a displaced gauge nor a drift.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from orthocal.hypotheses.anomaly import Explanation, Scope
from orthocal.hypotheses.hypothesis import Family, Patterns, Rows, Tails, marks, sparse_rows

Indices = NDArray[np.int64]

FEWEST = 4
"""Readings of a setup below which a tail or a drift is not distinguished from an outlier."""

FEWEST_STUCK = 3
"""Equal readings in a row from which on a dial may have stuck."""

MOST_STUCK = 16
"""Readings of a run that are used."""


def displaced_gauges(rows: Rows, sigma: float) -> Iterator[Family]:
    """Gauges displaced within a setup or for one cycle, drifts, stuck dials.

    Args:
        rows: The rows.
        sigma: Standard deviation of a reading, [m].
    """
    for family in (_displaced(rows), _cycle_apart(rows), _drift(rows), _stuck(rows, sigma)):
        if family is not None:
            yield family


def _displaced(rows: Rows) -> Family | None:
    segments = [
        (indices, np.ones(indices.size))
        for indices in rows.setups.values()
        if rows.single[indices].all() and indices.size >= FEWEST
    ]
    if not segments:
        return None
    starts = [np.arange(2, indices.size - 1) for indices, _ in segments]
    segment = np.repeat(np.arange(len(segments)), [s.size for s in starts])
    start = np.concatenate(starts)

    def explain(h: int) -> Explanation:
        indices = segments[segment[h]][0]
        setup = rows.session.readings[indices[0]].setup
        later = tuple(indices[start[h] :].tolist())
        return Explanation("displaced gauge", "setup", later, names=(setup,))

    none = sparse_rows([np.empty(0, dtype=np.int64)] * start.size, [], rows.count)
    effects = Patterns(none, Tails(segments, segment, start))
    return Family(explain, start.size, start.size, effects=effects)


def _cycle_apart(rows: Rows) -> Family | None:
    """An inner cycle; before the second and the last one the gauge was displaced for good."""
    groups: list[Indices] = []
    keys: list[tuple[str, int]] = []
    for (name, cycle), indices in rows.cycles.items():
        setup = rows.setups[name]
        inner = indices[0] != setup[0] and indices[-1] != setup[-1]
        if inner and indices.size > 1 and rows.single[indices].all():
            groups.append(indices)
            keys.append((name, cycle))
    if not groups:
        return None

    def explain(h: int) -> Explanation:
        name, cycle = keys[h]
        indices = tuple(groups[h].tolist())
        return Explanation("displaced gauge", "cycle", indices, names=(name,), cycle=cycle)

    return Family(explain, len(groups), len(groups), effects=marks(groups, rows.count))


def _drift(rows: Rows) -> Family | None:
    drifting = {
        name: indices
        for name, indices in rows.setups.items()
        if indices.size >= FEWEST and rows.single[indices].all()
    }
    groups: list[tuple[tuple[str, ...], Indices]] = [
        ((name,), indices) for name, indices in drifting.items()
    ]
    ramps = [np.linspace(0.0, 1.0, indices.size) for indices in drifting.values()]
    if not groups:
        return None
    if len(groups) > 1:
        groups.append((tuple(drifting), np.concatenate(list(drifting.values()))))
        ramps.append(np.concatenate(ramps))

    def explain(h: int) -> Explanation:
        setups, indices = groups[h]
        scope: Scope = "setup" if len(setups) == 1 else "session"
        return Explanation("drift", scope, tuple(indices.tolist()), setups)

    effects = Patterns(sparse_rows([indices for _, indices in groups], ramps, rows.count))
    return Family(explain, len(groups), len(groups), effects=effects)


def _stuck(rows: Rows, sigma: float) -> Family | None:
    runs: list[Indices] = []
    for indices in rows.setups.values():
        if not rows.single[indices].all():
            continue
        ends = np.flatnonzero(np.append(np.diff(rows.values[indices]) != 0.0, True))
        begins = np.append(0, ends[:-1] + 1)
        for k in np.flatnonzero(ends - begins >= FEWEST_STUCK - 1):
            run = indices[begins[k] : ends[k] + 1]
            if len({rows.session.readings[i].posture for i in run}) > 1:
                runs.append(run)
    if not runs:
        return None

    def explain(h: int) -> Explanation:
        setup = rows.session.readings[runs[h][0]].setup
        return Explanation("stuck dial", "setup", tuple(runs[h].tolist()), names=(setup,))

    silent = [run[1 : MOST_STUCK + 1] for run in runs]
    steps = np.array([rows.gauge(int(run[0])).resolution or sigma for run in runs])
    volume = -np.log(steps) * [len(indices) for indices in silent]
    size = rows.count * MOST_STUCK
    return Family(explain, len(runs), size, log_volume=volume, silent=silent)
