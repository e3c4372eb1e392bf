"""Guidance for the operator: joint coordinates, contact points, and settings of the gauge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.kinematics.continuation import Failures
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.kinematics.workspace import find_below_bed, tool_at_zero
from orthocal.observation.contacts import locate_contacts
from orthocal.observation.observations import drive_table
from orthocal.robot.model import Robot
from orthocal.sensors.leg_indicator import LegIndicator
from orthocal.sensors.protocol import Contact, Sensor, has_dial
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


def describe_mounting(robot: Robot, sensor: Sensor, aligned_at: str, *, brief: bool = False) -> str:
    """Description of a sensor for the operator who mounts it.

    A tip that is beside its rod in the mechanical zero is described in the alignment posture.

    Args:
        robot: The robot.
        sensor: The sensor.
        aligned_at: Name of its alignment posture.
        brief: Whether to omit that a section is stated for the mechanical zero.
    """
    if not isinstance(sensor, LegIndicator):
        return sensor.describe()
    driven = robot.driven_noun + " at the mechanical zero" * (not brief)
    words = replace(sensor, beside=(0.0, 0.0, 0.0)).describe_from(driven)
    return f"{words}, aligned in {aligned_at}" if any(sensor.beside) else words


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
    travel = "" if gauge.range is None else f", about {gauge.half_range / MM:g} mm"
    return (
        f"Set the gauge so that its plunger is pressed in by half of its travel{travel}. Then turn "
        f"the bezel until the dial shows {dial_zero(gauge)}."
    )


def shown_tool(session: Session, points: Array) -> Array:
    """Tool coordinates that the controller displays, shape (n, n_coordinates), [m].

    The firmware of a printer computes them by its settings, which differ from the nominal machine.
    They are without `controller_origin`.

    Args:
        session: The session.
        points: Tool coordinates of the nominal machine, shape (n, n_coordinates), [m].
    """
    if session.firmware is None:
        return points
    # a point out of reach is refused elsewhere
    drives = nominal_closure(session.robot).inverse(points, failures=Failures())
    return session.firmware.forward(drives)


def below_bed(session: Session, points: Array, names: Sequence[str] | None = None) -> Failures:
    """Rows of tool positions that the controller displays below the bed of the machine."""
    if session.robot.bed is None:
        return {}
    return find_below_bed(session.robot, shown_tool(session, points), names)


def start_point(session: Session) -> Array:
    """Tool coordinates of the nominal machine where programs start, shape (n_coordinates,), [m].

    This is the mechanical zero; on a printer the position that its firmware displays as 0.
    """
    if session.firmware is None:
        return tool_at_zero(session.robot)
    drives = session.firmware.inverse(np.zeros(3))
    return np.asarray(nominal_closure(session.robot).forward(drives)[0])


def shown_joints(robot: Robot, drives: ArrayLike) -> Array:
    """Joint coordinates that the controller displays, shape (..., n_drives), [m, rad].

    Args:
        robot: The robot.
        drives: Drive coordinates, shape (..., n_drives), [m, rad].
    """
    values = np.asarray(drives, dtype=np.float64)
    columns = [d.to_joint(values[..., i]) for i, d in enumerate(robot.drives)]
    return np.stack(columns, axis=-1)
