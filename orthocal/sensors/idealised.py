"""What a sensor stands for: the real thing that its model leaves out."""

from __future__ import annotations

from collections.abc import Mapping

from orthocal.robot.model import Robot
from orthocal.sensors.leg_indicator import LegIndicator
from orthocal.sensors.protocol import Sensor
from orthocal.sensors.rod_indicator import RodByBlade
from orthocal.sensors.tips import Tip

EDGE = Tip("blade", 0.0, 1.0)
"""The tip that differs least from one that touches a line."""


def real_sensors(sensor: Sensor, robot: Robot) -> Mapping[str, Sensor]:
    """What a sensor may really touch, by its name; empty where it is what it says.

    A line between two rods is drawn in the air: a gauge touches one of them.
    """
    if not isinstance(sensor, LegIndicator):
        return {}
    return {
        rod: RodByBlade(sensor.leg, rod, sensor.direction, sensor.section, EDGE, sensor.standing)
        for rod in robot.legs[sensor.leg].rods
    }
