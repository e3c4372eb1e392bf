"""First plan of a machine: the paper's plan clear of the hinges, or a plan over a bed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from orthocal.arrays import Array
from orthocal.assessment.effect_limits import EffectLimits
from orthocal.errors import ParameterError, RobotError
from orthocal.estimation.choice import Choice
from orthocal.kinematics.reachable_box import find_workspace
from orthocal.kinematics.workspace import tool_at_zero
from orthocal.measurement.motion.motion import state_program_approaches
from orthocal.planning.candidates import ON_AXIS, directions_across
from orthocal.planning.equipment import Equipment, choose_box, place_tool, posture_name
from orthocal.planning.expected_error import Expected, ToolForecast
from orthocal.planning.further_readings import FurtherReadings
from orthocal.planning.sensor_gains import SensorGain, find_sensor_gains
from orthocal.robot.model import Leg, Robot, require_tcp
from orthocal.sensors.mounting import EXACT
from orthocal.sensors.tool_indicator import Artefact, ToolIndicator
from orthocal.session.session import Conditions, Gauge, Reading, Session, Setup
from orthocal.units import MM, read_limit

CLEARANCE = 0.02
"""Smallest distance of a tip from a hinge, [m]; a fifth of the length on shorter legs."""

POSTURE_STEP = 5e-3
"""Step of the postures, [m]."""

SECTIONS = (0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65)
"""Possible sections of a first plan, as fractions of the leg."""

MIN_REACH = 0.01
"""Smallest reach of the tool to either side of the mechanical zero, [m]."""

BED_SETUP = "bed"
"""Name of the setup over a bed."""

BED_POINTS = 5
"""Number of positions along each side of a bed."""

BED_FLATNESS = 0.02 * MM
"""Tolerance of the flatness of a bed of glass, or of a ground plate, [m]."""

PAPER_GAUGE = Gauge(20e-6, 10e-6, None)
"""Repeatability 0.02 mm, resolution 10 µm (paper, section 4)."""


@dataclass(frozen=True, slots=True, eq=False)
class FixedPlan:
    """Readings of a fixed plan, and the expected tool error after the calibration.

    The fields correspond to those of `MeasuringPlan`.
    """

    session: Session
    forecast: ToolForecast
    minutes: float
    before: Expected
    expected: Expected
    first_round: Expected
    effects: tuple[EffectLimits, ...]
    further: tuple[FurtherReadings, ...] = ()
    complements_session: bool = False

    def find_sensor_gains(self) -> tuple[SensorGain, ...]:
        """Gains of an hour with each usual sensor, the largest first."""
        return find_sensor_gains(self.forecast, self.session, self.expected)


def expect_fixed(session: Session, choice: Choice, equipment: Equipment) -> FixedPlan:
    """Expected tool error after a calibration from a session's readings.

    Args:
        session: The readings, of a robot with its tolerances.
        choice: Errors to identify.
        equipment: Gauge and time.

    Raises:
        ParameterError: If the model is unknown.
    """
    forecast = ToolForecast(session.robot, choice.select(session.robot.parameters))
    scheduled = equipment.schedule(session)
    return FixedPlan(
        session=session,
        forecast=forecast,
        minutes=equipment.minutes_of(session),
        before=forecast.before,
        expected=forecast.after(scheduled),
        first_round=forecast.after(scheduled, entered=False),
        effects=forecast.limits(scheduled),
    )


class Displacements(NamedTuple):
    """Tool displacements in the paper's maximum and minimum postures, [m].

    The paper does not state them; the project inferred the defaults.
    """

    maximum: float = 0.06
    minimum: float = -0.1


def first_equipment(robot: Robot, equipment: Equipment) -> Equipment:
    """Equipment with sections and postures in which the tip is clear of the hinges.

    Raises:
        RobotError: If the tool reaches less than MIN_REACH to a side of the mechanical zero where
            no bed is.
    """
    box = choose_box(robot, equipment.box)
    middle = tool_at_zero(robot)
    low, high = (box - middle[:, None]).T
    on_bed = np.array([c == 2 and robot.bed is not None for c in require_tcp(robot).coordinates])
    if low[~on_bed].max() > -MIN_REACH or high.min() < MIN_REACH:
        reach = " × ".join(f"{a / MM:g} … {b / MM:g}" for a, b in box)
        raise RobotError(
            f"the tool reaches {reach} mm; expected at least {MIN_REACH / MM:g} mm to either side "
            "of the mechanical zero; check the travel",
            where=robot.name,
        )
    length = min(leg.length for leg in robot.legs.values())
    clear = min(CLEARANCE, 0.2 * length)
    limit = 0.5 * length - clear
    low, high = (  # rounded towards zero to multiples of the step
        POSTURE_STEP * np.trunc(np.clip(v, -limit, limit) / POSTURE_STEP + np.sign(v) * 1e-9)
        for v in (low, high)
    )
    sections = tuple(
        s
        for s in SECTIONS
        if s * length + high.max() <= length - clear + 1e-9
        and s * length + low.min() >= clear - 1e-9
    )
    chosen = dict.fromkeys((sections[0], sections[len(sections) // 2], sections[-1]))
    return replace(
        equipment, box=middle[:, None] + np.stack([low, high], axis=1), sections=tuple(chosen)
    )


def paper_plan(robot: Robot, equipment: Equipment) -> Session:
    """The paper's plan (section 3.1) within the reach of a machine of any dimensions.

    Each leg is read at its middle in two directions, in the mechanical zero and at both ends. On an
    Orthoglide the plan has six setups and seven postures, +60 and −100 mm. Each setup begins and
    ends in the mechanical zero.

    Args:
        robot: The robot.
        equipment: Gauge and tip; its box limits the postures.

    Raises:
        RobotError: If the tool reaches less than MIN_REACH to a side of the mechanical zero.
    """
    equipment = first_equipment(robot, equipment)
    title = "Zero, largest and least of each leg"
    box = np.asarray(equipment.box) - tool_at_zero(robot)[:, None]
    return _read_legs(robot, equipment, box, title, closing=True)


def bed_plan(robot: Robot, equipment: Equipment) -> Session:
    """Plan with a dial at the tool over the bed, if readings at the legs do not determine offsets.

    The tool moves on a square grid on the bed, without one in the lowest plane of the workspace. It
    approaches the bed from above, because its drive coordinates grow upwards. The setup begins and
    ends in one posture.

    Args:
        robot: The robot, with a tool that moves along x, y and z.
        equipment: Gauge.

    Raises:
        ClosureError: If the machine does not reach a posture.
    """
    middle, box = tool_at_zero(robot), find_workspace(robot).limits
    columns, rows = (
        (POSTURE_STEP * np.round(np.linspace(low, high, BED_POINTS) / POSTURE_STEP)).tolist()
        for low, high in box[:2]
    )
    grid = [(x, y) for i, y in enumerate(rows) for x in columns[:: (-1) ** i] if x or y]
    height = box[2, 0] if robot.bed is None else robot.bed
    points = np.array([(x, y, height) for x, y in ((0.0, 0.0), *grid)])
    points = (points + middle).round(9) + 0.0
    names = [posture_name(robot, p, middle) for p in points]
    length = float(np.ptp(box[:2], axis=1).max())
    bed = Artefact("plate", length=length, form_std=read_limit(BED_FLATNESS), bed=True)
    above = Conditions("n" * len(robot.drives))
    readings = [Reading(BED_SETUP, name, conditions=above) for name in names]
    return Session(
        robot=robot,
        robot_reference=robot.name,
        title="Dial at the tool over the bed",
        gauges={"": equipment.gauge},
        postures=place_tool(robot, names, points),
        setups={BED_SETUP: Setup(BED_SETUP, ToolIndicator("-z", bed))},
        readings=(*readings, replace(readings[0], cycle=2)),
    )


def build_paper_plan(robot: Robot, displacements: Displacements, gauge: Gauge) -> Session:
    """The paper's plan on a machine of the Orthoglide type.

    The gauge is exactly mounted and reads the centre lines of the legs.

    Raises:
        ParameterError: If the machine is not of the Orthoglide type.
        ClosureError: If the machine cannot reach a posture.
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
    session = _read_legs(robot, equipment, ends, "The paper's plan", displacements, closing=False)
    return session.with_controller(np.zeros(len(robot.drives)))


def _read_legs(
    robot: Robot,
    equipment: Equipment,
    box: Array,
    title: str,
    usual: Displacements | None = None,
    *,
    closing: bool,
) -> Session:
    """Session in which each leg is read in the mechanical zero and at both ends of its axis.

    Args:
        robot: The robot.
        equipment: Gauge and tip.
        box: Limits of the displacements, shape (n_coordinates, 2), [m].
        title: Title of the session.
        usual: Displacements along each axis if these limits allow them; by default the paper's.
        closing: Whether each setup ends with a reading in the mechanical zero.
    """
    middle, usual = tool_at_zero(robot), usual or Displacements()
    points, setups, readings = {"zero": middle}, {}, []
    for leg in robot.legs.values():
        name, along = _axis_of(leg)
        along = along[list(require_tcp(robot).coordinates)]
        with np.errstate(divide="ignore"):
            limits = np.sort(box / along[:, None], axis=1)
        least, largest = float(np.nanmax(limits[:, 0])), float(np.nanmin(limits[:, 1]))
        ends = {"max": min(usual.maximum, largest), "min": max(usual.minimum, least)}
        points |= {f"{name}_{end}": middle + shift * along for end, shift in ends.items()}
        for i, direction in enumerate(directions_across(leg), 1):
            setup = f"{direction}{leg.name}" if isinstance(direction, str) else f"{leg.name}_{i}"
            setups[setup] = Setup(setup, equipment.list_sensors(leg, direction, 0.5)[0])
            readings += [Reading(setup, p) for p in ("zero", *(f"{name}_{end}" for end in ends))]
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
    return state_program_approaches(session)


def _axis_of(leg: Leg) -> tuple[str, Array]:
    """Name and unit vector of the axis of a leg, outwards.

    It is exactly an axis of the world if the leg is nearly parallel to it. Then the coordinates of
    postures are whole numbers.
    """
    axis = int(np.abs(leg.axis).argmax())
    if abs(leg.axis[axis]) > ON_AXIS:
        return "xyz"[axis], np.eye(3)[axis]
    return leg.name, -leg.axis
