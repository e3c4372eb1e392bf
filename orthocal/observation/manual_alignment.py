"""Manual alignment of gauges: the operator centres a ball on the actual rod, by eye.

A nuisance parameter that the operator aligns counts from where the actual machine has the rod in
the posture in which the gauge was aligned (`Session.alignment_postures`):

    c = c_nominal + ν + S (θ − θ_active)

with S the sensitivity of the rod's position in that posture and θ_active the offsets that the
controller already applies. S is taken at the nominal machine. The terms of second order are some
hundredths of a millimetre for offsets of millimetres, far less than the alignment tolerance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthocal.io.fields import read_only
from orthocal.kinematics.compiled import compiled_robot
from orthocal.kinematics.loop_closure import nominal_assembly
from orthocal.observation.expansion import Expander
from orthocal.observation.observations import build_observations, drive_table
from orthocal.observation.sensor_groups import SensorUnknowns, group_sensors, sensor_unknowns
from orthocal.session.session import Posture, Reading, Session, Setup

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


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """What a hand sees while it sets one unknown."""

    unknown: int
    setup: Setup
    """With the sensor that shows it."""
    posture: Posture
    """As drawn: offsets that the controller corrects are in it."""
    corrected: Array
    """Those, shape (n_drives,), [m, rad]."""


def find_setting(session: Session) -> Setting:
    """How the gauges of a session were set.

    Raises:
        ClosureError: If the nominal machine cannot reach an alignment posture.
    """
    known, errors = sensor_unknowns(session), compiled_robot(session.robot).errors
    slopes = np.zeros((len(known.parameters), len(errors.names)))
    start = np.zeros(len(known.parameters))
    looks = list(_list_looks(session, known))
    if looks:
        index = [look.unknown for look in looks]
        slopes[index] = found = slopes_by_errors(_seen(session, looks))
        by_offsets = found @ errors.columns([f"{d.name}.offset" for d in session.robot.drives])
        start[index] = -(by_offsets * [look.corrected for look in looks]).sum(axis=1)
    return Setting(read_only(slopes), read_only(start))


def _list_looks(session: Session, known: SensorUnknowns) -> Iterator[_Look]:
    aligned_at = session.alignment_postures
    active = session.robot.drive_zero - session.zero_drives
    for i, setup in enumerate(session.setups.values()):
        if not known.of_setup[i]:  # it has no readings
            continue
        seen = setup.sensor.set_by(session.robot)
        for index, unknown in zip(known.of_setup[i], setup.sensor.unknowns, strict=True):
            if unknown.name in seen:
                posture = session.postures[aligned_at[setup.name]]
                yield _Look(
                    unknown=index,
                    setup=replace(setup, sensor=seen[unknown.name], active=None),
                    posture=replace(posture, drives=posture.drives + active[i]),
                    corrected=active[i],
                )


def slopes_by_errors(session: Session) -> Array:
    """What errors do to a session's readings on the nominal machine, its gauges as they are said.

    Shape (n_entries, n_errors), [m/SI].

    Raises:
        ClosureError: If the nominal machine cannot reach a posture.
    """
    robot, observations, drives = session.robot, build_observations(session), drive_table(session)
    compiled, assembly = compiled_robot(robot), nominal_assembly(robot)
    expander = Expander(
        compiled,
        observations,
        group_sensors(session, observations),
        drives=drives,
        zero_drives=session.zero_drives,
        used=np.ones(6 * len(compiled.errors.moved), dtype=np.bool_),
    )
    every = np.eye(len(compiled.errors.names))
    found = expander(
        assembly.machine(),
        compiled.errors.slopes(assembly.errors(), every),
        assembly.close(drives, names=[p.name for p in session.postures.values()]),
        np.zeros(len(sensor_unknowns(session).parameters)),
    )
    return found.jacobian[:, : len(every)]


def _seen(session: Session, looks: Sequence[_Look]) -> Session:
    """What is seen as readings, one a setup."""
    names = [str(i) for i in range(len(looks))]
    return replace(
        session,
        setups={n: replace(k.setup, name=n) for n, k in zip(names, looks, strict=True)},
        postures={n: k.posture for n, k in zip(names, looks, strict=True)},
        readings=tuple(Reading(n, n, None, 1, 0.0, None) for n in names),
        controller_offsets=None,
    )
