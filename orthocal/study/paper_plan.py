"""The paper's measurement plan for an Orthoglide-type machine (section 3.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from orthocal.errors import ParameterError
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.robot.model import Robot
from orthocal.sensors.leg_indicator import LegIndicator, Section
from orthocal.sensors.mounting import EXACT
from orthocal.session.session import Gauge, Posture, Reading, Session, Setup


@dataclass(frozen=True, slots=True)
class Displacements:
    """Tool displacements in the paper's maximum and minimum postures, [m]."""

    maximum: float = 0.06
    minimum: float = -0.1


PAPER_GAUGE = Gauge(20e-6, 10e-6, None)
"""Repeatability 0.02 mm, resolution 10 µm (paper, section 4)."""


def build_paper_plan(robot: Robot, displacements: Displacements, gauge: Gauge) -> Session:
    """The paper's plan (section 3.1): each leg is read at its middle, in two directions.

    The postures are zero, maximum and minimum along the axis of the leg.

    Raises:
        ParameterError: If the machine is not of the Orthoglide type.
        ClosureError: If it cannot reach a posture.
    """
    axes = "xyz"
    legs = list(robot.legs.values())
    fits = [leg.name for leg in legs] == list(axes) and robot.tcp is not None
    fits = fits and all(np.abs(leg.axis[i]) > 0.999 for i, leg in enumerate(legs))
    if not fits:
        raise ParameterError(
            "has no legs x, y, z along these axes, which the paper's plan needs; name a session",
            where=robot.name,
        )
    points = {"zero": np.zeros(3)}
    for i, axis in enumerate(axes):
        points[f"{axis}_max"] = displacements.maximum * np.eye(3)[i]
        points[f"{axis}_min"] = displacements.minimum * np.eye(3)[i]
    drives = nominal_closure(robot).inverse(np.array(list(points.values())), names=list(points))
    postures = {
        name: Posture(name, "tcp_mm", point, coordinates)
        for (name, point), coordinates in zip(points.items(), drives, strict=True)
    }
    setups, readings = {}, []
    for leg in axes:
        for direction in axes.replace(leg, ""):
            name = direction + leg
            sensor = LegIndicator(leg, direction, Section("fraction", 0.5), EXACT)
            setups[name] = Setup(name, sensor)
            readings += [
                Reading(name, posture, None, 1, 0.0, None)
                for posture in ("zero", f"{leg}_max", f"{leg}_min")
            ]
    return Session(
        robot=robot,
        robot_reference=robot.name,
        title="The paper's plan",
        source="",
        gauges={"": gauge},
        postures=postures,
        setups=setups,
        readings=tuple(readings),
        controller_offsets=np.zeros(len(robot.drives)),
        path=None,
        readings_path=None,
        sha256="",
    )
