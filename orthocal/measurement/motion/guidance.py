"""Guidance for the operator: joint coordinates, contact points, and settings of the gauge."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.observation.contacts import locate_contacts
from orthocal.observation.observations import drive_table
from orthocal.robot.model import Robot
from orthocal.sensors.protocol import Contact, has_dial
from orthocal.session.session import Gauge, Reading, Session
from orthocal.units import MM


@dataclass(frozen=True, slots=True, eq=False)
class Guidance:
    """Joints, tool and contacts of the nominal machine in the postures of a session."""

    joints: dict[str, Array]
    """Joint coordinates that the controller displays, shape (n_drives,), [m, rad], by posture."""
    passive: dict[str, Array]
    """Passive coordinates, shape (n_passive,), [m, rad], by posture."""
    tool: dict[str, Array]
    """Tool centre points, shape (3,), [m], by posture; empty for a robot without a tool."""
    contacts: dict[str, tuple[list[str], Contact]]
    """Postures in which a gauge is aligned or read, and its contact there, by setup."""
    aligned_at: dict[str, str]
    """Alignment postures by setup."""

    def contact_point(self, setup: str) -> tuple[Array, str]:
        """Contact point in the alignment posture, from the tool centre point in that posture.

        Returns:
            The point in the axes of the world, shape (3,), [m]; and the origin in words.
        """
        postures, contact = self.contacts[setup]
        aligned = self.aligned_at[setup]
        point = np.asarray(contact.points[postures.index(aligned)])
        if aligned not in self.tool:
            return point, "the origin of the machine's model"
        return point - self.tool[aligned], "the tool centre point"


def guide(session: Session) -> Guidance:
    """Guidance for the operator who measures a session.

    A controller displays the coordinates that it commands. It adds its active offsets to them
    without displaying them.
    """
    robot = session.robot
    commanded = drive_table(session) + session.active_offsets
    aligned_at = session.alignment_postures
    alignment = tuple(Reading(setup, posture) for setup, posture in aligned_at.items())
    closure = nominal_closure(robot)
    passive = closure.close(commanded, names=list(session.postures))
    tool: dict[str, Array] = {}
    if robot.tcp is not None:
        tool = dict(zip(session.postures, closure.tcp(commanded, passive), strict=True))
    return Guidance(
        joints=dict(zip(session.postures, shown_joints(robot, commanded), strict=True)),
        passive=dict(zip(session.postures, passive, strict=True)),
        tool=tool,
        contacts=locate_contacts(replace(session, readings=(*session.readings, *alignment))),
        aligned_at=aligned_at,
    )


def dial_zero(gauge: Gauge) -> str:
    """Text of the reading in the middle of a gauge's range, to which its dial is set, in mm."""
    return f"{gauge.middle / MM + 0.0:g}"


def range_of_expected(gauge: Gauge, *, differences: bool) -> tuple[float, float]:
    """Lowest and highest expected reading within the range of a gauge, [m].

    Args:
        gauge: The gauge.
        differences: True if readings are differences, which begin at 0 in the middle of the range.
    """
    if differences:
        return -gauge.half_range, gauge.half_range
    return gauge.range or (-np.inf, np.inf)


def set_dial(session: Session, setup: str) -> str:
    """Instruction for setting the gauge zero of a setup."""
    of_setup = session.setups[setup]
    gauge = session.gauges[of_setup.gauge]
    if of_setup.zero == "known":
        return "Do not set the gauge zero on the machine: it is known, and readings are absolute."
    if not has_dial(of_setup.sensor):
        return "The gauge zero is not set: the calibration estimates it."
    travel = ""
    if gauge.range is not None:
        travel = f", about {gauge.half_range / MM:g} mm"
    return (
        f"Set the gauge so that its plunger is pressed in by half of its travel{travel}. Then turn "
        f"the bezel until the dial shows {dial_zero(gauge)}."
    )


def shown_joints(robot: Robot, drives: ArrayLike) -> Array:
    """Joint coordinates that the controller displays, shape (..., n_drives), [m, rad].

    Args:
        robot: The robot.
        drives: Drive coordinates, shape (..., n_drives), [m, rad].
    """
    values = np.asarray(drives, dtype=np.float64)
    columns = [d.to_joint(values[..., i]) for i, d in enumerate(robot.drives)]
    return np.stack(columns, axis=-1)
