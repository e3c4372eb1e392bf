"""First plan of a machine: sections clear of the hinges, and the paper's plan."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import RobotError
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.kinematics.workspace import tool_at_zero
from orthocal.planning.equipment import Equipment, choose_box
from orthocal.robot.model import Leg, Robot
from orthocal.sensors.leg_indicator import LegIndicator, Section
from orthocal.sensors.protocol import Sensor
from orthocal.sensors.rod_indicator import RodByBall, RodByBlade
from orthocal.session.session import Posture, Reading, Session, Setup
from orthocal.units import MM

Array = NDArray[np.float64]

CLEAR = 0.02
"""Least distance of a tip from a hinge, [m]; less on legs shorter than five times that."""

STEP = 5e-3
"""Step of the postures, [m]."""

SECTIONS = (0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65)
"""Possible sections of a first plan, as fractions of the leg."""

LEAST = 0.01
"""Least reach of the tool to either side of the mechanical zero, [m]."""

PAPER = (-0.1, 0.06)
"""Least and largest displacement along an axis in the paper, [m]; the project inferred them."""


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
    low, high = (_whole(np.clip(v, -room, room)) for v in (low, high))
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


def paper_plan(robot: Robot, equipment: Equipment, *, reference: str = "") -> Session:
    """The paper's plan: each leg in the mechanical zero and at both ends, in two directions.

    Six setups at mid-leg and seven postures on an Orthoglide: +60 and −100 mm, or the reach of a
    machine of other dimensions. Each setup ends with the zero, where it began.

    Args:
        robot: The robot.
        equipment: Gauge and tip; its box limits the postures.
        reference: Name of the robot in the session; by default its own.

    Raises:
        RobotError: If the tool of the machine hardly moves.
    """
    equipment = first_equipment(robot, equipment)
    middle, box = tool_at_zero(robot), equipment.box
    low, high = (np.zeros_like(middle), np.zeros_like(middle)) if box is None else box.T - middle
    points, setups, readings = {"zero": middle}, {}, []
    for leg in robot.legs.values():
        own = int(np.abs(leg.axis).argmax())
        names = ["zero"]
        for end, most, reach in (("max", PAPER[1], high), ("min", -PAPER[0], -low)):
            name = f"{'xyz'[own]}_{end}"
            shift = np.zeros_like(middle)
            shift[own] = min(most, float(reach[own])) * (1.0 if end == "max" else -1.0)
            points[name] = middle + shift
            names.append(name)
        for k in (k for k in range(3) if k != own):
            setup = f"{'xyz'[k]}{leg.name}"
            setups[setup] = Setup(setup, _sensor(leg, "xyz"[k], equipment))
            readings += [Reading(setup, p, None, 1, 0.0, None) for p in names]
            readings.append(Reading(setup, "zero", None, 2, 0.0, None))
    drives = nominal_closure(robot).inverse(np.array(list(points.values())), names=list(points))
    return Session(
        robot=robot,
        robot_reference=reference or robot.name,
        title="Zero, largest and least of each leg",
        source="",
        gauges={"": equipment.gauge},
        postures={
            n: Posture(n, "tcp_mm", p, d) for (n, p), d in zip(points.items(), drives, strict=True)
        },
        setups=setups,
        readings=tuple(readings),
        controller_offsets=None,
        path=None,
        readings_path=None,
        sha256="",
    )


def _sensor(leg: Leg, direction: str, equipment: Equipment) -> Sensor:
    """Indicator at mid-leg, on the leg's first rod if it has a tip."""
    section = Section("fraction", 0.5)
    if equipment.tip is None or not leg.rods:
        return LegIndicator(leg.name, direction, section, equipment.mounting)
    rod = next((r for r in equipment.rods if r in leg.rods), next(iter(leg.rods)))
    kind = RodByBall if equipment.tip.form == "ball" else RodByBlade
    return kind(leg.name, rod, direction, section, equipment.tip, equipment.mounting)


def _whole(values: Array) -> Array:
    """Values rounded towards zero to whole steps, [m]."""
    steps = np.array([math.floor(abs(v) / STEP + 1e-9) for v in values])
    return np.asarray(np.sign(values) * steps * STEP)
