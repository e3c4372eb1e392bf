"""How gauges are set by what is there: a ball is put over the rod that one sees, on no drawing.

What a hand sets by its eye counts from where the real machine has it in the first posture of the
setup. How far that is from the drawing follows the machine's errors, to first order: what is left
of that, some hundredths of a millimetre for offsets of millimetres, is far less than a hand's
tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthocal.fields import read_only
from orthocal.kinematics.assembly import nominal_assembly
from orthocal.kinematics.compiled import compiled_robot
from orthocal.measurement.expansion import Expander
from orthocal.measurement.observations import build_observations, drive_table
from orthocal.measurement.sensor_groups import group_sensors, sensor_unknowns
from orthocal.measurement.session import Posture, Reading, Session, Setup

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """What unknowns of a session's sensors begin at, by the errors of the machine."""

    slopes: Array
    """By all elementary errors, shape (n_unknowns, n_errors), [SI]."""
    start: Array
    """Without errors: less than 0 by what the controller corrects, shape (n_unknowns,), [SI]."""

    def __call__(self, errors: Array) -> Array:
        """Shape (..., n_unknowns) of (..., n_errors), [SI]."""
        return np.asarray(errors @ self.slopes.T + self.start)

    @property
    def follows(self) -> NDArray[np.bool_]:
        """Which unknowns count from anything but the drawing, shape (n_unknowns,)."""
        return np.asarray(self.slopes.any(axis=1))


def find_setting(session: Session) -> Setting:
    """How the gauges of a session were set.

    Raises:
        ClosureError: If the nominal machine cannot reach a setup's first posture.
    """
    known, errors = sensor_unknowns(session), compiled_robot(session.robot).errors
    slopes = np.zeros((len(known.parameters), len(errors.names)))
    start = np.zeros(len(known.parameters))
    first = {r.setup: r.posture for r in reversed(session.readings)}
    active = session.robot.drive_zero - session.zero_drives
    setups: dict[str, Setup] = {}
    postures: dict[str, Posture] = {}
    places: list[int] = []
    corrected: list[Array] = []
    for setup, of_setup, offsets in zip(
        session.setups.values(), known.of_setup, active, strict=True
    ):
        by = setup.sensor.set_by(session.robot) if of_setup else {}
        for place, unknown in zip(of_setup, setup.sensor.unknowns, strict=bool(of_setup)):
            if unknown.name in by:
                name, posture = str(len(places)), session.postures[first[setup.name]]
                setups[name] = replace(setup, name=name, sensor=by[unknown.name], active=None)
                postures[name] = replace(posture, name=name, drives=posture.drives + offsets)
                places.append(place)
                corrected.append(offsets)
    if places:
        seen = replace(
            session,
            setups=setups,
            postures=postures,
            readings=tuple(Reading(n, n, None, 1, 0.0, None) for n in setups),
            controller_offsets=None,
        )
        found = _slopes(seen)
        slopes[places] = found
        # by an offset as by all errors that move its drive alike
        by_offsets = found @ errors.columns([f"{d.name}.offset" for d in session.robot.drives])
        start[places] = -(by_offsets * np.array(corrected)).sum(axis=1)
    return Setting(read_only(slopes), read_only(start))


def _slopes(session: Session) -> Array:
    """What errors do to readings on the nominal machine, shape (n_readings, n_errors), [m/SI]."""
    robot, observations = session.robot, build_observations(session)
    assembly, errors = nominal_assembly(robot), compiled_robot(robot).errors
    every = np.eye(len(errors.names))
    drives = drive_table(session)
    expander = Expander(
        compiled_robot(robot),
        observations,
        group_sensors(session, observations),
        drives=drives,
        zero_drives=session.zero_drives,
        used=np.ones(6 * len(errors.moved), dtype=np.bool_),
    )
    found = expander(
        assembly.machine(),
        errors.slopes(assembly.errors(), every),
        assembly.close(drives, names=list(session.postures)),
        np.zeros(0),
    )
    return found.jacobian
