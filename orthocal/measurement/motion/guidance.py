"""Where machine and gauge go while a session is measured: what somebody beside it needs to know."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.kinematics.loop_closure import nominal_assembly
from orthocal.observation.contacts import locate_contacts
from orthocal.observation.observations import drive_table
from orthocal.sensors.protocol import Contact
from orthocal.session.session import Session

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Guidance:
    """Postures and setups of a session, as its machine would be without errors."""

    joints: dict[str, Array]
    """Posture to what the controller's joints show when they are there, [m, rad]."""
    tool: dict[str, Array]
    """Posture to the tool's place, shape (3,), [m]; empty where the robot has no tool."""
    contacts: dict[str, tuple[list[str], Contact]]
    """Setup to the postures that it is read in, and where it touches there."""

    def touched(self, setup: str, posture: str) -> Array:
        """Where a setup's gauge touches in a posture, shape (3,), [m]."""
        postures, contact = self.contacts[setup]
        return np.asarray(contact.points[postures.index(posture)])


def guide(session: Session) -> Guidance:
    """What to command, and where gauges stand.

    A controller shows the coordinates that it commands: offsets that are active in it come on top
    of them, and are not seen.
    """
    robot = session.robot
    commanded = drive_table(session) + session.active_offsets
    shown = np.column_stack([d.to_joint(commanded[:, i]) for i, d in enumerate(robot.drives)])
    tool: dict[str, Array] = {}
    if robot.tcp is not None:
        assembly = nominal_assembly(robot)
        passive = assembly.close(commanded, names=list(session.postures))
        tool = dict(zip(session.postures, assembly.tcp(commanded, passive), strict=True))
    return Guidance(
        joints=dict(zip(session.postures, shown, strict=True)),
        tool=tool,
        contacts=locate_contacts(session),
    )
