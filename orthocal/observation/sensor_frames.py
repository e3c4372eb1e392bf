"""What sensors see: readings foretold, and where they touch."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from orthocal.kinematics.compiled import compiled_robot, zero_poses
from orthocal.kinematics.loop_closure import Assembly, nominal_assembly
from orthocal.observation.manual_alignment import find_setting
from orthocal.observation.observations import Observations, drive_table
from orthocal.observation.sensor_groups import group_sensors
from orthocal.sensors.protocol import Contact
from orthocal.session.session import Session

Array = NDArray[np.float64]


def predict_entries(
    session: Session,
    observations: Observations,
    errors: Mapping[str, float] | None = None,
    *,
    passive: Array | None = None,
    unknowns: Array | None = None,
) -> Array:
    """Readings that a machine with given errors shows, gauge zeros at 0, shape (n,), [m].

    Args:
        session: Postures, setups and robot.
        observations: Which setup is read in which posture.
        errors: Parameter name to value, [unit of the parameter].
        passive: Passive coordinates of every posture, if they are known, [m, rad].
        unknowns: Those of the sensors, in the order of `sensor_unknowns`, [SI]; 0 by default.

    Raises:
        ClosureError: If the machine cannot reach a posture.
    """
    robot = session.robot
    drives = drive_table(session)
    assembly = Assembly(robot, fixed=errors)
    if passive is None:
        passive = assembly.close(drives, names=list(session.postures))
    machine = assembly.machine()
    actuated, zero = machine.drives(drives), machine.drives(session.zero_drives)
    setting = find_setting(session)(assembly.errors())
    stood = setting if unknowns is None else setting + unknowns
    result = np.empty(observations.size)
    for group in group_sensors(session, observations):
        at = observations.posture[group.entries]
        (h,) = group.reading.value(
            actuated[at],
            passive[at],
            machine.placements,
            zero[group.setups],
            group.constants,
            stood[group.unknowns],
        )
        result[group.entries] = h[:, 0]
    return result


def locate_contacts(session: Session) -> dict[str, tuple[list[str], Contact]]:
    """Where sensors touch the nominal machine.

    Returns:
        Setup to the postures that it is read in, and where it touches in them.
    """
    robot = session.robot
    nominal = drive_table(session) + session.active_offsets
    assembly = nominal_assembly(robot)
    passive = assembly.close(nominal, names=list(session.postures))
    machine, compiled = assembly.machine(), compiled_robot(robot)

    def poses(frame: str, drives: Array, passive: Array) -> Array:
        (found,) = compiled.pose(frame)(drives, passive, machine.placements)
        return found

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
            zero_poses(robot, frames.at_zero),
            robot,
        )
        result[setup.name] = names, contact
    return result
