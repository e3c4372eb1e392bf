"""Calibrated machines as Pinocchio alone sees them: errors in placements, loops closed by it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pinocchio as pin

from orthocal.robot.loading import packaged_robots
from orthocal.sensors.leg_indicator import DIRECTIONS


def place(machine, drives, frame, *, start=None):
    """Position of a frame, loops closed by Pinocchio's constraint models, shape (3,), [m]."""
    start = machine.reference_passive if start is None else start
    data = _closed(machine, tuple(np.ravel(drives).tolist()), tuple(np.ravel(start).tolist()))
    return np.array(data.oMf[machine.frame_id(frame)].translation)


def frame_pose(machine, drives, frame):
    """Pose of a frame, loops closed by Pinocchio."""
    start = machine.reference_passive
    data = _closed(machine, tuple(np.ravel(drives).tolist()), tuple(np.ravel(start).tolist()))
    return data.oMf[machine.frame_id(frame)].copy()


def frames(machine, drives):
    """Positions of all frames by name, loops closed by Pinocchio, [m]."""
    start = machine.reference_passive
    data = _closed(machine, tuple(np.ravel(drives).tolist()), tuple(np.ravel(start).tolist()))
    return {f.name: np.array(data.oMf[i].translation) for i, f in enumerate(machine.model.frames)}


@lru_cache(maxsize=256)
def _closed(machine, drives, start):
    """Placements of all frames of a machine, closed once for all that are asked for."""
    passive = machine.close_with_pinocchio(drives, start)
    data = machine.model.createData()
    q = machine.configuration(machine.joint_coordinates(drives, passive))
    pin.framesForwardKinematics(machine.model, data, q)
    return data


def reading_by_pinocchio(session, machine, setup, posture):
    """The gauge's reading from placements of a calibrated Pinocchio model, in plain NumPy."""
    sensor = setup.sensor
    leg = machine.legs[sensor.leg]
    root, tip = (place(machine, posture.drives, f) for f in (leg.root, leg.tip))
    plane, from_root = sensor.plane(machine)
    if from_root:
        zero = session.zero_drives[list(session.setups).index(setup.name)]
        plane = plane + leg.axis @ place(machine, zero, leg.root)
    along = (plane - leg.axis @ root) / (leg.axis @ (tip - root))
    return float(np.dot(DIRECTIONS[sensor.direction], root + along * (tip - root)))


def write_orthoglide(folder, length, *, travel=None):
    """An Orthoglide of another leg length and travel, by default in proportion, [m]."""
    source = packaged_robots()["orthoglide"]
    low, high = travel or (length * 0.12 / 0.31025, length * 0.39 / 0.31025)
    urdf = (source / "orthoglide.urdf").read_text()
    urdf = urdf.replace('"0.155125 ', f'"{length / 2:.9g} ').replace('"0.31025', f'"{length:.9g}')
    urdf = urdf.replace('lower="0.12" upper="0.39"', f'lower="{low:.9g}" upper="{high:.9g}"')
    text = (source / "orthoglide.yaml").read_text()
    folder.mkdir(parents=True)
    (folder / "machine.urdf").write_text(urdf)
    (folder / "machine.yaml").write_text(text.replace("310.25", f"{length * 1e3:.9g}"))
    return folder
