"""Drives that lose steps while a session is measured: an offset changes from some reading on."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from orthocal.arrays import Indices
from orthocal.hypotheses.anomaly import Explanation
from orthocal.hypotheses.hypothesis import Family, MachineShift, Rows
from orthocal.hypotheses.linear_model import LinearModel

MIN_READINGS = 4
"""Fewest readings of a session before and after a loss; wrong readings explain fewer."""

LOG_PROBABILITY = -3.0
"""Logarithm of the prior probability relative to other families. Drives lose steps more rarely than
a gauge is displaced, which looks the same in the last setup."""

MAX_SCORED = 2_000_000
"""Most readings of all hypotheses together. In larger sessions fewer readings are considered."""


def lost_steps(model: LinearModel, rows: Rows) -> Iterator[Family]:
    """Loss of steps of a drive within a session; none if no offset is identified.

    Large single sessions have none (see `LinearModel.has_shifts`).

    Args:
        model: The linearised model.
        rows: The rows.
    """
    if not model.has_shifts:
        return
    problem, explanations, shifts = model.problem, [], []
    plus, minus = problem.observations.plus, problem.observations.minus
    session_of_row = model.session_of_entry[plus]
    for drive, i in model.offsets.items():
        direction = np.zeros(problem.n_free)
        direction[i] = 1.0 / problem.theta_scale[i]
        for k, label in enumerate(model.labels):
            of_session = np.flatnonzero(session_of_row == k)
            for first in _first_readings(of_session, len(model.offsets) * rows.count):
                later = of_session[of_session >= first]
                entries = np.zeros(problem.observations.size, dtype=np.bool_)
                entries[plus[later]] = True
                entries[minus[later][minus[later] >= 0]] = True
                explanations.append(
                    Explanation(
                        "lost steps",
                        "session",
                        first=int(first),
                        drives=(drive,),
                        parameters=(problem.free[i],),
                        sessions=tuple(filter(None, (label,))),
                    )
                )
                shifts.append(MachineShift(entries, direction))
    rarity = np.full(len(shifts), LOG_PROBABILITY)
    yield Family.of(explanations, shifts=shifts, known=False, log_volume=rarity)


def _first_readings(rows: Indices, size: int) -> Indices:
    """First readings after a loss that are considered, evenly spaced in large sessions.

    Args:
        rows: Rows of the session, in the order of measuring.
        size: Number of readings in the hypotheses of one place.
    """
    possible = rows[MIN_READINGS : rows.size - MIN_READINGS + 1]
    step = max(1, -(-possible.size * size // MAX_SCORED))
    return possible[::step]
