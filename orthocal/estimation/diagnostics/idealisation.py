"""Model discrepancy of the line model: a gauge touches a rod, not the line between two rods."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from orthocal.arrays import Array
from orthocal.estimation.diagnostics.unmodelled import machine_errors
from orthocal.estimation.problem import build_problem
from orthocal.robot.model import Robot
from orthocal.sensors.leg_indicator import LegIndicator
from orthocal.sensors.protocol import Sensor
from orthocal.sensors.tips import Tip
from orthocal.session.session import Session
from orthocal.statistics.zeros import project_out_zeros

MOST_READINGS = 60
"""Largest number of readings that are compared, spread over the session."""

EDGE = Tip("blade", 0.0, 1.0)
"""Tip that differs least from one that touches a line."""


@dataclass(frozen=True, slots=True, eq=False)
class Idealised:
    """Largest difference between the line model and a rod that the gauge may touch."""

    setup: str
    """Setup with the largest difference."""
    touches: str
    """Name of the rod that the gauge may touch."""
    size: float
    """Difference of a reading, gauge zeros eliminated: one standard deviation over machines drawn
    from the priors, [m]."""


def find_idealised(session: Session) -> Idealised | None:
    """Largest difference of a session's readings from those of a rod; None without a line model."""
    rods = {
        name: sensors
        for name, s in session.setups.items()
        if (sensors := _rod_sensors(s.sensor, session.robot))
    }
    if not rods:
        return None
    chosen = [r for r in session.readings if r.setup in rods]
    few = tuple(chosen[:: -(-len(chosen) // MOST_READINGS)])
    if not few:
        return None
    part = replace(session.select(few), parts=())
    of_line = _first_order(part)
    touched = {n: next(iter(rods[n])) for n in part.setups}
    setups = {n: replace(s, sensor=rods[n][touched[n]]) for n, s in part.setups.items()}
    sizes = np.linalg.norm(_first_order(replace(part, setups=setups)) - of_line, axis=1)
    worst = int(sizes.argmax())
    return Idealised(few[worst].setup, touched[few[worst].setup], float(sizes[worst]))


def _first_order(session: Session) -> Array:
    """Nominal readings and their change by one standard deviation of each error, [m].

    Gauge zeros are eliminated.

    Shape (n_readings, 1 + n_errors).
    """
    problem = build_problem(session, free=machine_errors(session.robot), prior=True)
    h, jacobian = problem.predict_and_jacobian(np.zeros(problem.n_free))
    o = problem.observations
    columns = np.column_stack([h, jacobian[:, : problem.n_machine]])
    return np.asarray(o.rows(project_out_zeros(columns, o)))


def _rod_sensors(sensor: Sensor, robot: Robot) -> dict[str, Sensor]:
    """Sensors on the rods that a gauge of the line model may touch, by rod; empty for others."""
    if not isinstance(sensor, LegIndicator) or sensor.rod is not None:
        return {}
    return {rod: sensor.on_rod(rod, EDGE) for rod in robot.legs[sensor.leg].rods}
