"""How a gauge is to stand, from its contacts: numbers that pictures and words share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.measurement.motion.motion import SetupMotion
from orthocal.robot.model import Leg, Robot, Rod
from orthocal.sensors.protocol import Contact, TouchingTip
from orthocal.session.session import Session, Setup
from orthocal.units import MM
from orthocal.viewer.motion import place_frames

Array = NDArray[np.float64]

ALONG_AXIS = 0.9999
"""Cosine above which a direction is called by an axis of the world."""

NEAR_HINGE = 0.012
"""From a rod's end to where a tip comes into the way of the hinge, at least, [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """How a gauge stands, in the postures that it is read in."""

    setup: Setup
    leg: Leg | None
    """The leg that it touches, where it touches one."""
    rod: Rod | None
    """The rod; None for the line between the rods, or something else."""
    postures: tuple[str, ...]
    contact: Contact
    """In these postures."""
    poses: Mapping[str, Array]
    """Poses of all links and of what is touched in the first posture, shape (4, 4), [m]."""
    first: int
    """Which of the postures is the first."""
    tool_points: Array
    """Where the tool is in the stops, in order, shape (n, 3); (0, 3) without a tool, [m]."""
    from_root: Array
    """From the hinge at the drive's end to where the rod is touched, shape (K,), [m]."""
    aside: Array
    """From the middle of the rod, across it and the plunger, to the tip in the first posture,
    shape (3,), [m]."""

    @property
    def tip(self) -> TouchingTip | None:
        """What touches."""
        return self.contact.tip

    @property
    def point(self) -> Array:
        """Where it touches in the first posture, shape (3,), [m]."""
        return np.asarray(self.contact.points[self.first])

    @property
    def near_hinge(self) -> float | None:
        """How near it comes to a hinge, where that is too near, [m]."""
        if self.rod is None:
            return None
        ends = np.minimum(self.from_root, self.rod.length - self.from_root)
        least = float(ends.min())
        return least if least < max(NEAR_HINGE, 2.0 * self.rod.radius) else None


def find_touched(robot: Robot, setup: Setup) -> tuple[Leg | None, Rod | None]:
    """The leg and rod whose ends a sensor looks at."""
    looked = setup.sensor.frames(robot).in_posture
    for leg in robot.legs.values():
        for rod in leg.rods.values():
            if looked[:2] == (rod.root, rod.tip):
                return leg, rod
    for leg in robot.legs.values():
        if looked[:2] == (leg.root, leg.tip):
            return leg, None
    kind, name = setup.sensor.place
    return (robot.legs.get(name) if kind == "leg" else None), None


def find_standing(
    session: Session,
    motion: SetupMotion,
    contacts: Mapping[str, tuple[list[str], Contact]],
    passive: Mapping[str, Array],
    links: tuple[str, ...],
) -> Standing:
    """How the gauge of a setup stands.

    Args:
        session: The plan.
        motion: The way through the setup.
        contacts: Setup to postures, and where it touches in them (`locate_contacts`).
        passive: Posture to passive coordinates of the nominal machine.
        links: Frames whose poses are wanted.
    """
    robot, setup = session.robot, session.setups[motion.setup]
    leg, rod = find_touched(robot, setup)
    names, contact = contacts[motion.setup]
    ends = [f for r in ([] if leg is None else leg.rods.values()) for f in (r.root, r.tip)]
    ends += [] if leg is None else [leg.root, leg.tip]
    wanted = tuple(dict.fromkeys([*links, *ends]))
    first = motion.stops[0]
    found = place_frames(robot, first.drives[None], passive[first.posture][None], wanted)
    from_root = np.full(len(names), np.nan)
    aside = np.zeros(3)
    if rod is not None:
        drives = np.array([session.postures[n].drives + session.active_offsets for n in names])
        q = np.array([passive[n] for n in names])
        of_rod = place_frames(robot, drives, q, (rod.root, rod.tip))
        roots, tips = (of_rod[f][:, :3, 3] for f in (rod.root, rod.tip))
        units = (tips - roots) / np.linalg.norm(tips - roots, axis=1)[:, None]
        from_root = np.einsum("ki,ki->k", contact.points - roots, units)
        k = names.index(first.posture)
        normal = contact.points[k] - roots[k] - from_root[k] * units[k]
        across = np.cross(units[k], contact.direction)
        across /= np.linalg.norm(across)
        touching = 0.0 if contact.tip is None or contact.tip.edge is not None else 1.0
        radius = 0.0 if contact.tip is None else contact.tip.radius
        # a ball's centre is as far from the rod's axis as both radii
        aside = touching * (1.0 + radius / rod.radius) * float(normal @ across) * across
    points = np.zeros((0, 3))
    if robot.tcp is not None:
        drives = np.array([s.drives for s in motion.stops])
        q = np.array([passive[s.posture] for s in motion.stops])
        points = place_frames(robot, drives, q, (robot.tcp.frame,))[robot.tcp.frame][:, :3, 3]
    return Standing(
        setup=setup,
        leg=leg,
        rod=rod,
        postures=tuple(names),
        contact=contact,
        poses={name: pose[0] for name, pose in found.items()},
        first=names.index(first.posture),
        tool_points=points,
        from_root=from_root,
        aside=aside,
    )


def direction_words(direction: Array) -> str:
    """A direction by an axis of the world, or as a vector."""
    name = axis_name(direction)
    if name:
        return name
    return "(" + ", ".join(f"{round(v, 2) + 0.0:.2f}".replace("-", "−") for v in direction) + ")"


def axis_name(direction: Array) -> str:
    """The axis of the world that a direction is along, such as −y; empty where it is along none."""
    k = int(np.abs(direction).argmax())
    if abs(direction[k]) <= ALONG_AXIS * np.linalg.norm(direction):
        return ""
    return f"{'+' if direction[k] > 0.0 else '−'}{'xyz'[k]}"


def tip_words(tip: TouchingTip | None) -> str:
    """What touches."""
    if tip is None:
        return "tip"
    if tip.edge is None:
        return f"ball of {2.0 * tip.radius / MM:g} mm diameter"
    if tip.radius > 0.0:
        return f"pin of {2.0 * tip.radius / MM:g} mm diameter, {tip.width / MM:g} mm wide"
    return f"blade {tip.width / MM:g} mm wide"
