"""Klipper's coordinate descent to the settings of a delta printer (its Delta_Calibrate.md).

A parameter's step grows by a tenth where it helps and shrinks by a tenth where it does not, until
the steps add up to 1e-5 mm and degrees. With `extended` the three rods are free as well.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from simulated_printer import Firmware

from orthocal.printers.settings import DeltaSettings
from orthocal.units import DEG, MM

ENOUGH = 1e-5
MOST_ROUNDS = 10_000


def descend(cost, start, most):
    """Coordinate descent from a start in at most so many rounds; the values, and their number."""
    values, steps = np.array(start), np.ones(len(start))
    least, rounds = cost(values), 0
    while steps.sum() > ENOUGH and rounds < most:
        rounds += 1
        for k in range(len(values)):
            for sign in (1.0, -1.0):
                tried = values.copy()
                tried[k] += sign * steps[k]
                found = cost(tried)
                if found < least:
                    least, values = found, tried
                    steps[k] *= 1.1
                    break
            else:
                steps[k] *= 0.9
    return values, rounds


def calibrate_as_klipper(settings, travel, trigger, *, extended=False, most=MOST_ROUNDS):
    """New settings from travels below the endstops at triggers of a height, shape (K, 3), [mm]."""

    def unpack(values):
        rods = values[6:9] if extended else settings.rods
        angles = np.array([values[1], values[2], settings.angles[2]])
        return Firmware(values[0], np.array(rods), angles, values[3:6])

    def cost(values):
        s = unpack(values)
        if s.radius <= 0.0 or (s.rods <= s.radius).any():
            return np.inf
        with np.errstate(invalid="ignore"):
            z = locate(s, travel)[:, 2]
        return float(((z - trigger) ** 2).sum()) if np.isfinite(z).all() else np.inf

    start = [settings.radius, *settings.angles[:2], *settings.endstops]
    start += list(settings.rods) if extended else []
    values, rounds = descend(cost, start, most)
    return unpack(values), rounds


def locate(settings, travel):
    """Where a firmware believes its nozzle, shape (K, 3), [mm]."""
    middle = np.sqrt(settings.rods**2 - settings.radius**2)
    delta = DeltaSettings("klipper", settings.radius * MM, tuple(settings.rods * MM), (0.0,) * 3)
    delta = replace(delta, angles=tuple(np.array(settings.angles) * DEG))
    return delta.forward((settings.endstops + middle - travel) * MM) / MM
