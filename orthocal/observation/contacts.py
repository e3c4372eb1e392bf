"""Contacts of the sensors with the nominal machine."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache

import numpy as np

from orthocal.arrays import Array
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.kinematics.robot_functions import reference_poses, robot_functions
from orthocal.observation.observations import drive_table
from orthocal.sensors.leg_indicator import BallIndicator
from orthocal.sensors.protocol import Contact, Frames
from orthocal.session.session import Session

NEARBY = 1e-9
"""Largest distance of a posture from the mechanical zero that may be a rounding error, [m, rad]."""


def locate_contacts(session: Session) -> dict[str, tuple[list[str], Contact]]:
    """Contacts of all sensors with the nominal machine in the postures of their readings.

    Returns:
        Names of setups with readings, mapped to the names of the postures and the contacts in them.

    Raises:
        ClosureError: If the nominal machine cannot reach a posture.
    """
    place = _nominal_places(session)
    postures = {name: i for i, name in enumerate(session.postures)}
    read: dict[str, set[str]] = {}  # postures by setup
    for reading in session.readings:
        names_of_row = (p for p in (reading.posture, reading.minus) if p is not None)
        read.setdefault(reading.setup, set()).update(names_of_row)
    result = {}
    for setup in (s for s in session.setups.values() if s.name in read):
        names = sorted(read[setup.name], key=postures.__getitem__)
        frames, at_zero = place(setup.sensor.frames(session.robot), [postures[n] for n in names])
        result[setup.name] = names, setup.sensor.contact(frames, at_zero, session.robot)
    return result


def centre_balls(session: Session, setups: Iterable[str]) -> Session:
    """Session whose balls are centred on the nominal rods in their alignment postures.

    Args:
        session: The session.
        setups: Names of setups. A ball that is aligned in the mechanical zero keeps its position.

    Raises:
        ClosureError: If the nominal machine cannot reach a posture.
    """
    balls = balls_aligned_elsewhere(session)
    chosen = [name for name in setups if name in balls]
    if not chosen:
        return session
    postures = list(session.postures)
    place, centred = _nominal_places(session), dict(session.setups)
    for name in chosen:
        ball, posture = balls[name]
        frames, at_zero = place(ball.frames(session.robot), [postures.index(posture)])
        sensor = ball.centred(frames, at_zero, session.robot)
        centred[name] = replace(session.setups[name], sensor=sensor)
    return replace(session, setups=centred)


def balls_aligned_elsewhere(session: Session) -> dict[str, tuple[BallIndicator, str]]:
    """Setups with a ball that is not aligned in the mechanical zero.

    Returns:
        Names of setups, mapped to the indicator and the name of its alignment posture.
    """
    aligned_at = session.alignment_postures
    return {
        setup.name: (setup.sensor, posture)
        for setup, zero in zip(session.setups.values(), session.zero_drives, strict=True)
        if isinstance(setup.sensor, BallIndicator)
        and np.abs(session.postures[posture := aligned_at[setup.name]].drives - zero).max() > NEARBY
    }


def _nominal_places(
    session: Session,
) -> Callable[[Frames, list[int]], tuple[list[Array], list[Array]]]:
    """Function that places frames of a sensor on the nominal machine.

    Its arguments are the frames and the indices of K postures. It returns poses in these postures,
    shape (K, 4, 4) each, and poses in the reference posture, shape (4, 4) each.
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

    def place(frames: Frames, rows: list[int]) -> tuple[list[Array], list[Array]]:
        return [poses(f)[rows] for f in frames.in_posture], [at_zero(f) for f in frames.at_zero]

    return place
