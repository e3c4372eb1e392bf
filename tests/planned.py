"""Plans that several files of tests share; each is computed once in a process."""

from __future__ import annotations

from functools import cache

from uncompared import uncompared

from orthocal import load_robot, plan_readings
from orthocal.planning.equipment import Equipment

FEW = {"along": 3, "across": 0.0, "sections": (0.5,)}
"""Arguments of Equipment with the fewest candidate readings."""

QUICK = {"along": 5, "across": 0.0, "sections": (0.5,)}
"""Arguments of Equipment with few candidate readings."""


def entered(robot):
    """A packaged robot whose offsets were entered: ±1 mm remain."""
    return load_robot(robot).with_tolerances({"*.offset_mm": 1.0})


@cache
def quick_plan(robot="orthoglide"):
    """Plan with a dial at the legs of a packaged robot."""
    with uncompared():
        return plan_readings(entered(robot), equipment=Equipment(**FEW), starts=1)
