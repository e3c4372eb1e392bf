"""Model discrepancy of the line model, whose gauges measure the centre line of a leg, not a rod."""

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

MAX_READINGS = 60
"""Largest number of compared readings, distributed over the session."""

BLADE = Tip("blade", 0.0, 1.0)
"""Tip for which the line model has the smallest discrepancy."""


@dataclass(frozen=True, slots=True, eq=False)
class Idealised:
    """Largest difference between the line model and a rod that the gauge may touch."""

    setup: str
    """Setup with the largest difference."""
    touches: str
    """Name of the rod that the gauge may touch."""
    size: float
    """RMS difference of a reading over machines drawn from the priors, gauge zeros eliminated,
    [m]."""


def find_idealised(session: Session) -> Idealised | None:
    """Largest difference between readings of the line model and of a rod; None without such."""
    rod_sensors = {
        name: sensors
        for name, s in session.setups.items()
        if (sensors := _rod_sensors(s.sensor, session.robot))
    }
    if not rod_sensors:
        return None
    readings = [r for r in session.readings if r.setup in rod_sensors]
    readings = readings[:: max(-(-len(readings) // MAX_READINGS), 1)]
    if not readings:
        return None
    part = replace(session.select(tuple(readings)), parts=())
    rods = {name: next(iter(rod_sensors[name])) for name in part.setups}
    setups = {n: replace(s, sensor=rod_sensors[n][rods[n]]) for n, s in part.setups.items()}
    difference = _nominal_expansion(replace(part, setups=setups)) - _nominal_expansion(part)
    sizes = np.linalg.norm(difference, axis=1)
    worst = int(sizes.argmax())
    setup = readings[worst].setup
    return Idealised(setup, rods[setup], float(sizes[worst]))


def _nominal_expansion(session: Session) -> Array:
    """Nominal readings, and their changes by one prior standard deviation of each error.

    Returns:
        Gauge zeros eliminated, shape (n_readings, 1 + n_errors), [m].
    """
    problem = build_problem(session, free=machine_errors(session.robot), prior=True)
    h, jacobian = problem.predict_and_jacobian(np.zeros(problem.n_free))
    o = problem.observations
    columns = np.column_stack([h, jacobian[:, : problem.n_machine]])
    return np.asarray(o.rows(project_out_zeros(columns, o)))


def _rod_sensors(sensor: Sensor, robot: Robot) -> dict[str, Sensor]:
    """Sensors on the rods that a gauge of the line model may touch, by rod; else empty."""
    if not isinstance(sensor, LegIndicator) or sensor.rod is not None:
        return {}
    return {rod: sensor.on_rod(rod, BLADE) for rod in robot.legs[sensor.leg].rods}
