"""How far readings of what is really touched may be from those of a line in the air."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.estimation.problem import build_problem
from orthocal.sensors.idealised import real_sensors
from orthocal.session.session import Session
from orthocal.statistics.zeros import project_out_zeros

Array = NDArray[np.float64]

MOST_READINGS = 60
"""Of a session that are looked at, spread over it."""


@dataclass(frozen=True, slots=True, eq=False)
class Idealised:
    """Readings of something that nothing touches."""

    setup: str
    """Where that matters most."""
    touches: str
    """What may be touched there, the first of its kind."""
    size: float
    """How far a reading of it may be from what is modelled: one standard deviation of a machine
    within its tolerances, gauge zeros taken off, [m]."""


def find_idealised(session: Session) -> Idealised | None:
    """Where a session's sensors are idealised most, and how much that may be; None where not."""
    real = {
        name: found
        for name, s in session.setups.items()
        if (found := real_sensors(s.sensor, session.robot))
    }
    if not real:
        return None
    chosen = [r for r in session.readings if r.setup in real]
    few = tuple(chosen[:: -(-len(chosen) // MOST_READINGS)])
    if not few:
        return None
    part = replace(session.select(few), parts=())
    as_said = _first_order(part)
    touched = {n: next(iter(real[n])) for n in part.setups}
    setups = {n: replace(s, sensor=real[n][touched[n]]) for n, s in part.setups.items()}
    sizes = np.linalg.norm(_first_order(replace(part, setups=setups)) - as_said, axis=1)
    worst = int(sizes.argmax())
    return Idealised(few[worst].setup, touched[few[worst].setup], float(sizes[worst]))


def _first_order(session: Session) -> Array:
    """Readings of the nominal machine, and of one tolerance of each error, zeros taken off, [m].

    Shape (n_readings, 1 + n_errors).
    """
    problem = build_problem(session, free=machine_errors(session.robot), prior=True)
    h, jacobian = problem.linearise(np.zeros(problem.n_free))
    o = problem.observations
    columns = np.column_stack([h, jacobian[:, : problem.n_machine]])
    return np.asarray(o.rows(project_out_zeros(columns, o)))
