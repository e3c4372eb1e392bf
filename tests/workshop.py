"""Readings of a dial that stands crooked beside a rod: the plunger moves until two solids touch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from machines import frames
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from orthocal.sensors.leg_indicator import DIRECTIONS


@dataclass(frozen=True)
class Crooked:
    """How a gauge stands, beside what is said of it."""

    roll: float = 0.0
    """About the leg, from its root to its tip, [rad]."""
    pitch: float = 0.0
    """Of the plunger towards the leg's tip, [rad]."""
    section: float = 0.0
    """Along the leg, [m]."""
    lateral: float = 0.0
    """Across leg and plunger, from the rod as drawn, [m]."""
    scale: float = 0.0
    zero: float = 0.0
    """[m]"""


def draw_crooked(rng, *, direction=10e-3, place=0.5e-3):
    """A mounting aligned by eye; the scale belongs to the dial."""
    roll, pitch = direction * rng.normal(size=2)
    section, lateral = place * rng.normal(size=2)
    return Crooked(roll, pitch, section, lateral)


class Workshop:
    """A machine with errors, [SI], and what dials of a session show of its rods."""

    def __init__(self, session, errors):
        self.session = session
        self.machine = session.robot.with_errors(errors)
        self.frames = {n: frames(self.machine, p.drives) for n, p in session.postures.items()}
        self.stands = {}
        self.zero_drives = session.robot.drive_zero - session.active_offsets
        self.at_zero = frames(self.machine, self.zero_drives)

    def beside(self, setup):
        """How far the rod lies beside its drawing where the setup begins, across leg and plunger.

        A hand that puts a ball over the rod puts it there, [m].
        """
        sensor, robot = self.session.setups[setup].sensor, self.session.robot
        leg = robot.legs[sensor.leg]
        rod, _, side = leg.rods[sensor.rod], *_across(sensor, leg)
        first = next(r.posture for r in self.session.readings if r.setup == setup)
        commanded, active = self.session.postures[first].drives, self.session.active_offsets
        found = []
        for machine, more in ((self.machine, 0.0), (robot, active)):  # as it is, and as drawn
            places = frames(machine, commanded + more)
            root, way = places[rod.root], places[rod.tip] - places[rod.root]
            zero = frames(machine, self.zero_drives + more)[leg.root]
            plane = leg.axis @ zero + sensor.section.value * leg.length
            share = (plane - leg.axis @ root) / (leg.axis @ way)
            found.append(side @ (root + share * way))
        return found[0] - found[1]

    def read(self, setup, posture, crooked):
        """What a dial shows, [m]."""
        key = setup, crooked
        if key not in self.stands:
            self.stands[key] = self._stand(setup, crooked)
        rod, touching, ball, start, plunger, edge = self.stands[key]
        places = self.frames[posture]
        root, end = places[rod.root], places[rod.tip]
        distance = _to_axis(root, end) if ball else _between(root, end, edge)
        h = _touch(lambda h: distance(start + h * plunger), touching)
        return (1.0 + crooked.scale) * h + crooked.zero

    def _stand(self, setup, crooked):
        """What a gauge touches, and how it stands."""
        sensor = self.session.setups[setup].sensor
        leg = self.session.robot.legs[sensor.leg]
        rod, axis = leg.rods[sensor.rod], leg.axis
        said, side = _across(sensor, leg)
        rolled = Rotation.from_rotvec(crooked.roll * axis)
        pitched = Rotation.from_rotvec(-crooked.pitch * side)
        plunger, edge = rolled.apply(pitched.apply(said)), rolled.apply(side)
        # in the rod as drawn, where the ruler says from this machine's root
        drawn = rod.reference_root + 0.5 * (rod.reference_tip - rod.reference_root)
        drawn = drawn - (drawn @ axis) * axis + sensor.beside
        assert sensor.section.form == "fraction"
        along = axis @ self.at_zero[leg.root] + sensor.section.value * leg.length
        start = (along + crooked.section) * axis + drawn + crooked.lateral * side
        touching = rod.radius + sensor.tip.radius
        return rod, touching, sensor.tip.form == "ball", start, plunger, edge


def _across(sensor, leg):
    """Of a plunger as it is said to stand: its direction, and what is across leg and plunger."""
    given = sensor.direction
    said = np.array(DIRECTIONS[given] if isinstance(given, str) else given)
    side = np.cross(leg.axis, said)
    return said / np.linalg.norm(said), side / np.linalg.norm(side)


def _to_axis(root, end):
    """Distance of a point from a line."""
    unit = (end - root) / np.linalg.norm(end - root)

    def distance(point):
        apart = point - root
        return np.sqrt(max(apart @ apart - (apart @ unit) ** 2, 0.0))

    return distance


def _between(root, end, edge):
    """Distance of two lines, one through a point along the edge."""
    across = np.cross(end - root, edge)
    across /= np.linalg.norm(across)
    return lambda point: abs((point - root) @ across)


def _touch(distance, touching):
    """How far a plunger is out when its tip touches (NaN: passes). The distance is convex."""
    low, far = -0.1, 0.1
    high = far
    for _ in range(80):
        a, b = low + (high - low) / 3.0, high - (high - low) / 3.0
        to_a, to_b = distance(a), distance(b)
        inner = a if to_a < to_b else b
        if min(to_a, to_b) < touching:
            break
        low, high = (low, b) if to_a < to_b else (a, high)
    else:
        return np.nan
    assert distance(far) > touching
    return brentq(lambda h: distance(h) - touching, inner, far, xtol=1e-13)
