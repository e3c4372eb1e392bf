"""First plan of a machine: sections clear of the hinges, and the paper's plan."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import ParameterError, RobotError
from orthocal.kinematics.workspace import tool_at_zero
from orthocal.measurement.motion.approach import state_common_approach
from orthocal.planning.equipment import Equipment, choose_box, place_tool
from orthocal.robot.model import Robot
from orthocal.sensors.mounting import EXACT
from orthocal.session.session import Gauge, Reading, Session, Setup
from orthocal.units import MM

CLEAR = 0.02
"""Least distance of a tip from a hinge, [m]; less on legs shorter than five times that."""

STEP = 5e-3
"""Step of the postures, [m]."""

SECTIONS = (0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65)
"""Possible sections of a first plan, as fractions of the leg."""

LEAST = 0.01
"""Least reach of the tool to either side of the mechanical zero, [m]."""

PAPER_GAUGE = Gauge(20e-6, 10e-6, None)
"""Repeatability 0.02 mm, resolution 10 µm (paper, section 4)."""


class Displacements(NamedTuple):
    """Tool displacements in the paper's maximum and minimum postures, [m].

    The paper does not state them; the project inferred the defaults.
    """

    maximum: float = 0.06
    minimum: float = -0.1


def first_equipment(robot: Robot, equipment: Equipment) -> Equipment:
    """Equipment with sections and postures in which the tip stays clear of the hinges.

    Raises:
        RobotError: If the tool of the machine hardly moves.
    """
    box = choose_box(robot, equipment.box)
    middle = tool_at_zero(robot)
    low, high = (box - middle[:, None]).T
    if low.max() > -LEAST or high.min() < LEAST:
        reach = " × ".join(f"{a / MM:g} … {b / MM:g}" for a, b in box)
        raise RobotError(
            f"the tool reaches {reach} mm; expected {LEAST / MM:g} mm to either side of the "
            "mechanical zero, at least; check the travel",
            where=robot.name,
        )
    least = min(leg.length for leg in robot.legs.values())
    room = 0.5 * least - min(CLEAR, 0.2 * least)
    # whole steps, rounded towards zero
    steps = (np.trunc(np.clip(v, -room, room) / STEP + np.sign(v) * 1e-9) for v in (low, high))
    low, high = (STEP * v for v in steps)
    clear = min(CLEAR, 0.2 * least)
    sections = tuple(
        s
        for s in SECTIONS
        if s * least + high.max() <= least - clear + 1e-9 and s * least + low.min() >= clear - 1e-9
    )
    some = dict.fromkeys((sections[0], sections[len(sections) // 2], sections[-1]))
    return replace(
        equipment, box=middle[:, None] + np.stack([low, high], axis=1), sections=tuple(some)
    )


def paper_plan(robot: Robot, equipment: Equipment) -> Session:
    """The paper's plan (section 3.1) within the reach of a machine of any dimensions.

    Each leg is read at its middle in two directions, in the mechanical zero and at both ends. On an
    Orthoglide these are six setups and seven postures, +60 and −100 mm. Each setup ends with the
    zero, where it began.

    Args:
        robot: The robot.
        equipment: Gauge and tip; its box limits the postures.

    Raises:
        RobotError: If the tool of the machine hardly moves.
    """
    equipment = first_equipment(robot, equipment)
    usual = Displacements()
    box = np.asarray(equipment.box) - tool_at_zero(robot)[:, None]
    ends = np.clip(box, usual.minimum, usual.maximum)
    return _read_legs(robot, equipment, ends, "Zero, largest and least of each leg", closing=True)


def build_paper_plan(robot: Robot, displacements: Displacements, gauge: Gauge) -> Session:
    """The paper's plan on a machine of the Orthoglide type, with an exact gauge on the legs' lines.

    Raises:
        ParameterError: If the machine is not of the Orthoglide type.
        ClosureError: If it cannot reach a posture.
    """
    legs = list(robot.legs.values())
    fits = [leg.name for leg in legs] == list("xyz") and robot.tcp is not None
    if not (fits and all(np.abs(leg.axis[i]) > 0.999 for i, leg in enumerate(legs))):
        raise ParameterError(
            "has no legs x, y, z along these axes, which the paper's plan needs; name a session",
            where=robot.name,
        )
    equipment = Equipment(gauge=gauge, tip=None, mounting=EXACT)
    ends = np.tile([displacements.minimum, displacements.maximum], (3, 1))
    session = _read_legs(robot, equipment, ends, "The paper's plan", closing=False)
    return session.with_controller(np.zeros(len(robot.drives)))


def _read_legs(
    robot: Robot, equipment: Equipment, ends: Array, title: str, *, closing: bool
) -> Session:
    """Session in which each leg is read in the mechanical zero and at both ends of its axis.

    Args:
        robot: The robot.
        equipment: Gauge and tip.
        ends: Least and largest displacement along each axis, shape (n_coordinates, 2), [m].
        title: Title of the session.
        closing: Whether each setup ends with the zero, where it began.
    """
    middle = tool_at_zero(robot)
    points, setups, readings = {"zero": middle}, {}, []
    for leg in robot.legs.values():
        axis = int(np.abs(leg.axis).argmax())
        extremes = {f"{'xyz'[axis]}_{name}": ends[axis, i] for name, i in (("max", 1), ("min", 0))}
        for name, shift in extremes.items():
            points[name] = middle + shift * np.eye(len(middle))[axis]
        for k in (k for k in range(3) if k != axis):
            setup = f"{'xyz'[k]}{leg.name}"
            setups[setup] = Setup(setup, equipment.list_sensors(leg, "xyz"[k], 0.5)[0])
            readings += [Reading(setup, posture) for posture in ("zero", *extremes)]
            readings += [Reading(setup, "zero", cycle=2)] if closing else []
    session = Session(
        robot=robot,
        robot_reference=robot.name,
        title=title,
        gauges={"": equipment.gauge},
        postures=place_tool(robot, list(points), np.array(list(points.values()))),
        setups=setups,
        readings=tuple(readings),
    )
    return state_common_approach(session)
