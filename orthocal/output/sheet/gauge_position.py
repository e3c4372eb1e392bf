"""Position of a gauge on the machine, as the sheet's pictures and steps show it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Array
from orthocal.measurement.motion.guidance import Guidance
from orthocal.measurement.motion.stops import SetupMotion
from orthocal.robot.model import Leg, Robot, Rod
from orthocal.sensors.protocol import Contact, TouchingTip
from orthocal.sensors.tips import Tip
from orthocal.session.session import Session, Setup
from orthocal.units import MM
from orthocal.viewer.motion import place_frames

ABOUT_ALONG = 0.97
"""Cosine above which the direction of a small offset is named after an axis of the world."""

NEAR_HINGE = 0.012
"""Smallest distance of a tip from the end of a rod that needs no warning, [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class GaugePosition:
    """Position of a gauge in the alignment posture and in those that it reads."""

    setup: Setup
    leg: Leg | None
    """The measured leg, if the sensor is at a leg."""
    rod: Rod | None
    """The touched rod; None for the line between the rods and for other sensors."""
    contact: Contact
    """Contact in the K postures of the setup, the alignment posture included."""
    poses: Mapping[str, Array]
    """Poses of the links and of the leg's frames in the alignment posture, shape (4, 4), [m]."""
    alignment: str
    """Posture in which the operator aligns the gauge."""
    drives: Array
    """Nominal drive coordinates of the alignment posture, shape (n_drives,), [m, rad]."""
    aligned: int
    """Index of the alignment posture in `contact`."""
    coordinates: Array
    """Point of contact in the alignment posture from `origin_name`, shape (3,), [m]."""
    origin_name: str
    """Origin of `coordinates`: the tool centre point in the alignment posture."""
    tool_path: Array
    """Tool points of all stops, in order, shape (n, 3); (0, 3) without a tool, [m]."""
    hinge_distances: Array
    """Distance of the contact from the rod's hinge at the drive, shape (K,), [m]."""
    lateral_offset: Array
    """From the rod's axis to the tip, across rod and plunger, in the alignment posture, shape
    (3,), [m]."""

    @property
    def tip(self) -> TouchingTip | None:
        """The tip of the gauge."""
        return self.contact.tip

    @property
    def point(self) -> Array:
        """Point of contact in the alignment posture, shape (3,), [m]."""
        return np.asarray(self.contact.points[self.aligned])

    def origin(self, frame: str) -> Array:
        """Origin of a frame in the alignment posture, shape (3,), [m]."""
        return np.asarray(self.poses[frame][:3, 3])

    @property
    def near_hinge(self) -> float | None:
        """Distance of the tip from a hinge, if it is too small, [m]."""
        if self.rod is None:
            return None
        distances = np.minimum(self.hinge_distances, self.rod.length - self.hinge_distances)
        smallest = float(distances.min())
        return smallest if smallest < max(NEAR_HINGE, 2.0 * self.rod.radius) else None


def find_gauge_position(
    session: Session,
    motion: SetupMotion,
    guidance: Guidance,
    links: tuple[str, ...],
) -> GaugePosition:
    """Position of the gauge of one setup.

    Args:
        session: The plan.
        motion: The motion through the setup.
        guidance: Guidance for the plan.
        links: Frames whose poses are needed.
    """
    robot, setup = session.robot, session.setups[motion.setup]
    leg, rod = _find_touched(robot, setup)
    names, contact = guidance.contacts[motion.setup]
    alignment = session.alignment_postures[motion.setup]
    aligned = names.index(alignment)
    drives, q = _coordinates(session, guidance, names)
    rods = [] if leg is None else list(leg.rods.values())
    ends = [frame for r in rods for frame in (r.root, r.tip)]
    ends += [] if leg is None else [leg.root, leg.tip]
    wanted = tuple(dict.fromkeys([*links, *ends]))
    poses = place_frames(robot, drives[aligned][None], q[aligned][None], wanted)
    distances, lateral_offset = np.full(len(names), np.nan), np.zeros(3)
    if rod is not None:
        distances, normals, axes = _locate_on_rod(robot, rod, drives, q, contact)
        lateral_offset = _find_lateral_offset(rod, contact, normals[aligned], axes[aligned])
    coordinates, origin_name = guidance.contact_point(motion.setup)
    tool_path = np.zeros((0, 3))
    if robot.tcp is not None:
        way = np.array([s.drives for s in motion.stops])
        on_way = np.array([guidance.passive[s.posture] for s in motion.stops])
        tool = robot.tcp.frame
        tool_path = place_frames(robot, way, on_way, (tool,))[tool][:, :3, 3]
    return GaugePosition(
        setup=setup,
        leg=leg,
        rod=rod,
        contact=contact,
        poses={name: pose[0] for name, pose in poses.items()},
        alignment=alignment,
        drives=drives[aligned],
        aligned=aligned,
        coordinates=coordinates,
        origin_name=origin_name,
        tool_path=tool_path,
        hinge_distances=distances,
        lateral_offset=lateral_offset,
    )


def hinge_distances(session: Session, setup: str, guidance: Guidance) -> dict[str, float]:
    """Posture to the distance of a gauge's contact from the rod's hinge on the slide, [m].

    It is empty for a gauge that touches no rod.
    """
    _, rod = _find_touched(session.robot, session.setups[setup])
    if rod is None:
        return {}
    names, contact = guidance.contacts[setup]
    distances, _, _ = _locate_on_rod(
        session.robot, rod, *_coordinates(session, guidance, names), contact
    )
    return dict(zip(names, distances.tolist(), strict=True))


def _coordinates(session: Session, guidance: Guidance, names: Sequence[str]) -> tuple[Array, Array]:
    """Drive and passive coordinates of the nominal machine in postures, [m, rad]."""
    drives = np.array([session.postures[n].drives + session.active_offsets for n in names])
    return drives, np.array([guidance.passive[n] for n in names])


def _locate_on_rod(
    robot: Robot, rod: Rod, drives: Array, passive: Array, contact: Contact
) -> tuple[Array, Array, Array]:
    """Contact points relative to a rod, in K postures.

    Returns:
        Distances from the rod's hinge at the drive along its axis, shape (K,), [m]; vectors from
        the axis to the points, shape (K, 3), [m]; unit vectors along the rod, shape (K, 3).
    """
    frames = place_frames(robot, drives, passive, (rod.root, rod.tip))
    roots, tips = (frames[f][:, :3, 3] for f in (rod.root, rod.tip))
    axes = (tips - roots) / np.linalg.norm(tips - roots, axis=1)[:, None]
    distances = np.einsum("ki,ki->k", contact.points - roots, axes)
    return distances, contact.points - roots - distances[:, None] * axes, axes


def _find_lateral_offset(rod: Rod, contact: Contact, normal: Array, axis: Array) -> Array:
    """Vector from the plane of rod and plunger to the centre of the tip, shape (3,), [m].

    Args:
        rod: The touched rod.
        contact: The contact.
        normal: Vector from the rod's axis to the point of contact, shape (3,), [m].
        axis: Unit vector along the rod, shape (3,).
    """
    if contact.tip is not None and contact.tip.edge is not None:
        return np.zeros(3)
    across = np.cross(axis, contact.direction)
    across /= np.linalg.norm(across)
    # the centre of a ball is both radii away from the rod's axis
    radius = 0.0 if contact.tip is None else contact.tip.radius
    return np.asarray((1.0 + radius / rod.radius) * float(normal @ across) * across)


def _find_touched(robot: Robot, setup: Setup) -> tuple[Leg | None, Rod | None]:
    """The leg and the rod whose ends the sensor measures."""
    frames = setup.sensor.frames(robot).in_posture[:2]
    for leg in robot.legs.values():
        for rod in leg.rods.values():
            if frames == (rod.root, rod.tip):
                return leg, rod
    for leg in robot.legs.values():
        if frames == (leg.root, leg.tip):
            return leg, None
    kind, name = setup.sensor.place
    return (robot.legs.get(name) if kind == "leg" else None), None


def name_tip(tip: Tip | TouchingTip | None) -> str:
    """Kind and dimensions of a tip."""
    if tip is None:
        return "tip"
    if tip.width == 0.0:
        return f"ball of {2.0 * tip.radius / MM:g} mm diameter"
    if tip.radius > 0.0:
        return f"pin of {2.0 * tip.radius / MM:g} mm diameter, {tip.width / MM:g} mm wide"
    return f"blade {tip.width / MM:g} mm wide"
