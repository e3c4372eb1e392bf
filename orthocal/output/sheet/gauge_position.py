"""Position of a gauge on the machine, as the sheet's pictures and steps show it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from orthocal.arrays import Array
from orthocal.measurement.motion.guidance import Guidance
from orthocal.measurement.motion.stops import SetupMotion
from orthocal.robot.model import Leg, Line, Robot, Rod
from orthocal.sensors.leg_indicator import LegIndicator
from orthocal.sensors.protocol import Contact, TouchingTip
from orthocal.sensors.tips import Tip
from orthocal.session.session import Session, Setup
from orthocal.units import MM
from orthocal.viewer.motion import place_frames

ABOUT_ALONG = 0.97
"""Cosine above which the direction of a small offset is named after an axis of the world."""

NEAR_HINGE = 0.012
"""Smallest distance of a tip from the end of a rod that needs no warning, [m]."""

SAME_HEIGHT = 1e-3
"""Largest difference of heights along a plunger that counts as none, [m]."""

DIAL_LENGTH, DIAL_WIDTH = 120 * MM, 60 * MM
"""Room that a dial indicator with its plunger needs along and across the plunger, [m]."""


class GaugePosition:
    """Position of a gauge in the alignment posture of its setup and in those that it reads.

    Args:
        session: The plan.
        motion: The motion through the setup.
        guidance: Guidance for the plan.
        links: Frames whose poses are needed.
    """

    def __init__(
        self, session: Session, motion: SetupMotion, guidance: Guidance, links: tuple[str, ...]
    ) -> None:
        robot, setup = session.robot, session.setups[motion.setup]
        self.setup = setup
        self.leg, self.rod = _find_touched(robot, setup)
        """The measured leg, if the sensor is at a leg, and the touched rod; no rod for the line
        between the rods."""
        names, self.contact = guidance.contacts[setup.name]
        """Contact in the K postures of the setup, the alignment posture included."""
        self.alignment = session.alignment_postures[setup.name]
        """Posture in which the operator aligns the gauge."""
        self.aligned = names.index(self.alignment)
        """Index of the alignment posture in `contact`."""
        drives, q = _coordinates(session, guidance, names)
        self.drives = drives[self.aligned]
        """Nominal drive coordinates of the alignment posture, shape (n_drives,), [m, rad]."""
        parts = [] if self.leg is None else [*self.leg.rods.values(), self.leg]
        wanted = dict.fromkeys([*links, *(frame for p in parts for frame in (p.root, p.tip))])
        poses = place_frames(robot, self.drives[None], q[self.aligned][None], tuple(wanted))
        self.poses: Mapping[str, Array] = {name: pose[0] for name, pose in poses.items()}
        """Poses of the links and of the leg's frames in the alignment posture, shape (4, 4),
        [m]."""
        self.driven_noun = robot.driven_noun
        """Noun for the part that the drive moves."""
        self.hinge_distances, self.lateral_offset = np.full(len(names), np.nan), np.zeros(3)
        """Distance of the contact from the rod's hinge at the drive, shape (K,), and vector from
        the rod's axis to the tip, across rod and plunger, in the alignment posture, shape (3,),
        [m]."""
        if self.rod is not None:
            self.hinge_distances, normals, axes = _locate_on_rod(
                robot, self.rod, drives, q, self.contact
            )
            self.lateral_offset = _find_lateral_offset(
                self.rod, self.contact, normals[self.aligned], axes[self.aligned]
            )
        self.zero_distance: float | None = None
        """Distance of a stated section from the rod's hinge at the drive, in the mechanical zero,
        [m]."""
        if self.rod is not None and isinstance(setup.sensor, LegIndicator):
            self.zero_distance = setup.sensor.fraction_at_zero(robot, self.rod) * self.rod.length
        self.coordinates, self.origin_name = guidance.contact_point(setup.name)
        """Point of contact in the alignment posture, shape (3,), [m], from an origin: the tool
        centre point in the alignment posture."""
        self.tool_path = np.zeros((0, 3))
        """Tool points of all stops, in order, shape (n, 3); (0, 3) without a tool, [m]."""
        if robot.tcp is not None:
            way = np.array([s.drives for s in motion.stops])
            on_way = np.array([guidance.passive[s.posture] for s in motion.stops])
            tool = robot.tcp.frame
            self.tool_path = place_frames(robot, way, on_way, (tool,))[tool][:, :3, 3]

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
    def surface(self) -> Array | None:
        """Corners of the artefact in the alignment posture, shape (4, 3), [m]; None without one.

        A gauge block that only other postures need is beside the tip.
        """
        surface = self.contact.surface
        if surface is None:
            return None
        height = (self.point - surface) @ self.contact.direction
        if np.ptp(height) < SAME_HEIGHT or height.max() < SAME_HEIGHT:
            return surface
        return np.asarray(surface + surface[1] - surface[0])

    def cut(self, line: Line, axis: Array) -> Array:
        """Point of a line in the plane through the contact, in the alignment posture.

        Args:
            line: A leg or a rod.
            axis: Normal of the plane, shape (3,).

        Returns:
            Shape (3,), [m].
        """
        a, b = self.origin(line.root), self.origin(line.tip)
        share = (self.point - a) @ axis / ((b - a) @ axis)
        return np.asarray(a + share * (b - a))

    @property
    def facing(self) -> tuple[Rod, float] | None:
        """Nearest rod of the leg behind the gauge, and the free distance to the touched rod, [m].

        None if a dial indicator fits between both.
        """
        if self.leg is None or self.rod is None:
            return None
        facing, direction, along = [], self.contact.direction, self.contact.along
        for rod in self.leg.rods.values():
            across = self.cut(rod, along) - self.cut(self.rod, along)
            distance = float(across @ direction)
            aside = float(np.linalg.norm(across - distance * direction))
            room = distance - rod.radius - self.rod.radius
            if 0.0 < room < DIAL_LENGTH and aside < 0.5 * DIAL_WIDTH + rod.radius:
                facing.append((rod, room))
        return min(facing, key=lambda rod_and_room: rod_and_room[1], default=None)

    @property
    def near_hinge(self) -> float | None:
        """Distance of the tip from a hinge, if it is too small, [m]."""
        if self.rod is None:
            return None
        distances = np.minimum(self.hinge_distances, self.rod.length - self.hinge_distances)
        smallest = float(distances.min())
        return smallest if smallest < max(NEAR_HINGE, 2.0 * self.rod.radius) else None


def hinge_distances(session: Session, setup: str, guidance: Guidance) -> dict[str, float]:
    """Posture to the distance of a gauge's contact from the rod's hinge at the drive, [m].

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
