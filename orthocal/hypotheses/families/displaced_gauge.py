"""Displaced gauge and stuck dial: changes while a setup is read.

A displaced gauge is invisible in rows that are differences of postures.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from orthocal.arrays import Indices
from orthocal.hypotheses.anomaly import Explanation
from orthocal.hypotheses.hypothesis import Family, Patterns, Rows, Tails, sparse_rows
from orthocal.sensors.protocol import equal_readings

MIN_READINGS = 4
"""Fewest readings of a setup in which a displacement differs from an outlier."""

MIN_STUCK = 2
"""Fewest equal consecutive readings of a stuck dial, or of a reading that was written twice."""

MAX_STUCK = 16
"""Number of lengths of a stuck run that the prior counts; longer runs are possible, too."""


def displaced_gauges(rows: Rows) -> Iterator[Family]:
    """Gauges displaced within a setup or for one cycle, stuck dials."""
    yield _displaced(rows)
    yield _cycle_apart(rows)
    yield _stuck(rows)


def _displaced(rows: Rows) -> Family:
    """A gauge displaced within a setup: all later rows change by the same amount."""
    segments = [
        (indices, np.ones(indices.size))
        for indices in rows.setups.values()
        if rows.single[indices].all() and indices.size >= MIN_READINGS
    ]
    places = [(s, k) for s, (i, _) in enumerate(segments) for k in range(2, i.size - 1)]
    segment, start = np.array(places, dtype=np.int64).reshape(-1, 2).T

    def explain(h: int) -> Explanation:
        indices = segments[segment[h]][0]
        setup = rows.session.readings[indices[0]].setup
        later = tuple(indices[start[h] :].tolist())
        return Explanation("displaced gauge", "setup", later, names=(setup,))

    none = sparse_rows([np.empty(0, dtype=np.int64)] * start.size, [], rows.count)
    effects = Patterns(none, Tails(segments, segment, start))
    return Family(explain, start.size, start.size, effects=effects)


def _cycle_apart(rows: Rows) -> Family:
    """A gauge displaced for one inner cycle; at the first and last cycle `_displaced` applies."""
    explanations = []
    for (name, cycle), indices in rows.cycles.items():
        setup = rows.setups[name]
        inner = indices[0] != setup[0] and indices[-1] != setup[-1]
        if inner and indices.size > 1 and rows.single[indices].all():
            concerned = tuple(indices.tolist())
            explanations.append(
                Explanation("displaced gauge", "cycle", concerned, names=(name,), cycle=cycle)
            )
    return Family.with_effects(rows, explanations)


def _stuck(rows: Rows) -> Family:
    """Runs of equal readings of different postures; all but the first carry no information."""
    runs: list[Indices] = []
    for indices in rows.setups.values():
        setup = rows.session.setups[rows.session.readings[indices[0]].setup]
        if not rows.single[indices].all() or equal_readings(setup.sensor):
            continue
        ends = np.flatnonzero(np.append(np.diff(rows.values[indices]) != 0.0, True))
        begins = np.append(0, ends[:-1] + 1)
        for k in np.flatnonzero(ends - begins >= MIN_STUCK - 1):
            run = indices[begins[k] : ends[k] + 1]
            if len({rows.session.readings[i].posture for i in run}) > 1:
                runs.append(run)
    firsts = [int(run[0]) for run in runs]
    explanations = [
        Explanation(
            "stuck dial", "setup", tuple(run.tolist()), names=(rows.session.readings[i].setup,)
        )
        for run, i in zip(runs, firsts, strict=True)
    ]
    silent = [run[1:] for run in runs]
    steps = np.array([rows.gauge(i).resolution or rows.sigma(i) for i in firsts])
    volume = -np.log(steps) * [len(indices) for indices in silent]
    return Family.of(explanations, size=rows.count * MAX_STUCK, log_volume=volume, silent=silent)
