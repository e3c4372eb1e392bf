"""Contacts of the sensors with the nominal machine."""

from __future__ import annotations

from functools import cache

from orthocal.arrays import Array
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.kinematics.robot_functions import reference_poses, robot_functions
from orthocal.observation.observations import drive_table
from orthocal.sensors.protocol import Contact
from orthocal.session.session import Session


def locate_contacts(session: Session) -> dict[str, tuple[list[str], Contact]]:
    """Contacts of all sensors with the nominal machine in the postures of their readings.

    Returns:
        Names of setups, mapped to the names of the postures and the contacts in them.
    """
    robot = session.robot
    drives = drive_table(session) + session.active_offsets
    closure = nominal_closure(robot)
    passive = closure.close(drives, names=list(session.postures))
    geometry, functions = closure.geometry(), robot_functions(robot)

    @cache
    def poses(frame: str) -> Array:
        return functions.pose(frame)(drives, passive, geometry.placements)[0]

    @cache
    def at_zero(frame: str) -> Array:
        return reference_poses(robot, [frame])[0]

    postures = {name: i for i, name in enumerate(session.postures)}
    read: dict[str, set[str]] = {name: set() for name in session.setups}  # postures by setup
    for reading in session.readings:
        read[reading.setup].update(p for p in (reading.posture, reading.minus) if p is not None)
    result = {}
    for setup in session.setups.values():
        names = sorted(read[setup.name], key=postures.__getitem__)
        rows, frames = [postures[n] for n in names], setup.sensor.frames(robot)
        contact = setup.sensor.contact(
            [poses(f)[rows] for f in frames.in_posture],
            [at_zero(f) for f in frames.at_zero],
            robot,
        )
        result[setup.name] = names, contact
    return result
