"""Contact of the sensors with the nominal machine."""

from __future__ import annotations

from orthocal.arrays import Array
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.kinematics.robot_functions import reference_poses, robot_functions
from orthocal.observation.observations import drive_table
from orthocal.sensors.protocol import Contact
from orthocal.session.session import Session


def locate_contacts(session: Session) -> dict[str, tuple[list[str], Contact]]:
    """Contacts of all sensors with the nominal machine.

    Returns:
        Setup to the postures of its readings, and its contact in them.
    """
    robot = session.robot
    nominal = drive_table(session) + session.active_offsets
    closure = nominal_closure(robot)
    passive = closure.close(nominal, names=list(session.postures))
    geometry, functions = closure.geometry(), robot_functions(robot)

    def poses(frame: str, drives: Array, passive: Array) -> Array:
        return functions.pose(frame)(drives, passive, geometry.placements)[0]

    postures = {name: i for i, name in enumerate(session.postures)}
    read: dict[str, set[str]] = {name: set() for name in session.setups}
    for reading in session.readings:
        read[reading.setup].update(p for p in (reading.posture, reading.minus) if p is not None)
    result = {}
    for setup in session.setups.values():
        names = sorted(read[setup.name], key=postures.__getitem__)
        rows, frames = [postures[n] for n in names], setup.sensor.frames(robot)
        contact = setup.sensor.contact(
            [poses(f, nominal[rows], passive[rows]) for f in frames.in_posture],
            reference_poses(robot, frames.at_zero),
            robot,
        )
        result[setup.name] = names, contact
    return result
