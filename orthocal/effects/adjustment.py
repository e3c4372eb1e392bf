"""Mechanical adjustments: feet and shims under a slide, and threads that lengthen a rod.

A foot moves one point of a slide by a known amount. The slide turns about a second point, the
pivot, or shifts as a whole where no pivot is stated. A thread lengthens one rod. Each adjustment is
one parameter: the displacement of its point, or the change of the rod's length, 0 for the machine
as it was calibrated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from orthocal.effects.protocol import Effect, EffectKeys, Placement, Symbols
from orthocal.errors import RobotError
from orthocal.io.documents import Name, Number, PositiveNumber, validate
from orthocal.robot.model import Robot
from orthocal.robot.parameters import ElementaryError
from orthocal.units import MM, read_limit

Array = NDArray[np.float64]

SUFFIX = ".adjustment"
"""Suffix of the parameter of an adjustment."""

SHORTEST_LEVER = 1e-3
"""Shortest distance of a foot from its pivot, across its direction, [m]."""

Vector = tuple[Number, Number, Number]


class AdjustmentKeys(EffectKeys):
    """Keys of one adjustment under `orthocal.adjustments`."""

    moves: Name | None = None
    """Drive whose slide it moves."""
    at_mm: Vector | None = None
    """Point of the slide that moves, in the world frame of the nominal machine."""
    direction: Vector | None = None
    """Direction in which that point moves for a positive amount, in the world frame."""
    pivot_mm: Vector | None = None
    """Point about which the slide turns; without it the slide shifts as a whole."""
    lengthens: Name | None = None
    """Rod that it lengthens, as LEG.ROD."""
    pitch_mm: PositiveNumber | None = None
    """Displacement in one turn of its thread; without it the amount is a shim."""
    step_mm: PositiveNumber = 0.01
    """Smallest amount that can be set: of a shim its grading."""
    largest_mm: PositiveNumber = 1.0
    """Largest amount in either direction."""


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """One adjustment that a machine has."""

    name: str
    keys: AdjustmentKeys

    @property
    def parameter(self) -> str:
        """Name of its parameter."""
        return f"{self.name}{SUFFIX}"


@dataclass(frozen=True, eq=False)
class Adjustments(Effect):
    """The adjustments of a machine, each with one parameter."""

    name = "adjustments"

    robot: Robot
    adjustments: tuple[Adjustment, ...]
    twists: Mapping[str, tuple[Placement, Array]]
    """Parameter to the placement of its slide, and the twist per metre, shape (6,)."""
    lengthened: Mapping[str, tuple[str, str]]
    """Parameter to the leg and rod that it lengthens."""
    errors: tuple[ElementaryError, ...]

    @classmethod
    def from_keys(cls, keys: Mapping[str, Mapping[str, Any]], robot: Robot) -> Self:
        """The adjustments of a robot.

        Args:
            keys: Plain data under `orthocal.adjustments`: name to its keys.
            robot: The robot, without error parameters.

        Raises:
            RobotError: If a key does not fit the robot.
        """
        where, twists, lengthened, adjustments = str(robot.yaml), {}, {}, []
        for name, data in keys.items():
            under = f"orthocal.adjustments.{name}"
            one = Adjustment(
                name,
                validate(AdjustmentKeys, data, where=where, error=RobotError, under=under),
            )
            try:
                if one.keys.lengthens is not None:
                    lengthened[one.parameter] = _read_rod(one.keys, robot)
                else:
                    twists[one.parameter] = _read_foot(one.keys, robot)
            except RobotError as e:
                key = ".".join(part for part in (under, e.where) if part)
                raise RobotError(e.problem, where=f"{where}: {key}") from None
            adjustments.append(one)
        errors = (
            ElementaryError(a.parameter, "adjustment", a.name, "m", read_limit(a.keys.step_mm) * MM)
            for a in adjustments
        )
        return cls(robot, tuple(adjustments), twists, lengthened, tuple(errors))

    def describe(self) -> str:
        """Description in a few words."""
        return "mechanical adjustments"

    def placements(self, errors: Symbols, conditions: Symbols) -> Mapping[Placement, ca.SX]:
        """Twists of slides; arguments as for `Effect.placements`."""
        result: dict[Placement, ca.SX] = {}
        for name, (placement, twist) in self.twists.items():
            change = ca.sparsify(ca.SX(twist)) * errors[name]
            result[placement] = result[placement] + change if placement in result else change
        return result

    def rods(self, errors: Symbols, conditions: Symbols) -> Mapping[tuple[str, str], ca.SX]:
        """Changes of the lengths of rods; arguments as for `Effect.rods`."""
        result: dict[tuple[str, str], ca.SX] = {}
        for name, rod in self.lengthened.items():
            result[rod] = result.get(rod, ca.SX(1, 1)) + errors[name]
        return result


def _read_rod(keys: AdjustmentKeys, robot: Robot) -> tuple[str, str]:
    """Leg and rod that a thread lengthens."""
    for key in ("moves", "at_mm", "direction", "pivot_mm"):
        if getattr(keys, key) is not None:
            raise RobotError("found with 'lengthens', which needs no other place", where=key)
    rods = [f"{leg.name}.{rod}" for leg in robot.legs.values() for rod in leg.rods]
    if keys.lengthens not in rods:
        expected = f"one of {', '.join(rods)}" if rods else "a robot with rods"
        raise RobotError(f"found '{keys.lengthens}'; expected {expected}", where="lengthens")
    leg, rod = str(keys.lengthens).split(".", 1)
    return leg, rod


def _read_foot(keys: AdjustmentKeys, robot: Robot) -> tuple[Placement, Array]:
    """Placement of the slide that a foot moves, and its twist per metre in the joint's axes."""
    drives = [d.name for d in robot.drives]
    if keys.moves not in drives:
        raise RobotError(
            f"found {keys.moves!r}; expected one of the drives {', '.join(drives)}",
            where="moves",
        )
    for key in ("at_mm", "direction"):
        if getattr(keys, key) is None:
            raise RobotError("is missing; expected three numbers", where=key)
    direction = np.array(keys.direction)
    size = float(np.linalg.norm(direction))
    if size == 0.0:
        raise RobotError("found 0, 0, 0; expected a direction", where="direction")
    direction /= size
    at, turn, shift = np.array(keys.at_mm) * MM, np.zeros(3), direction
    if keys.pivot_mm is not None:
        pivot = np.array(keys.pivot_mm) * MM
        arm = at - pivot
        arm -= (arm @ direction) * direction
        lever = float(np.linalg.norm(arm))
        if lever < SHORTEST_LEVER:
            raise RobotError(
                f"is {lever / MM:.3g} mm from the line of the foot; expected at least "
                f"{SHORTEST_LEVER / MM:g} mm",
                where="pivot_mm",
            )
        turn = np.cross(arm, direction) / lever**2
        shift = -np.cross(turn, pivot)
    model, data = robot.model, robot.model.createData()
    pin.framesForwardKinematics(model, data, robot.configuration(robot.reference_posture))
    joint = int(model.getJointId(keys.moves))
    placement = data.oMi[int(model.parents[joint])] * model.jointPlacements[joint]
    twist = np.asarray(placement.actInv(pin.Motion(shift, turn)).vector, dtype=np.float64)
    twist[np.abs(twist) < 1e-12] = 0.0
    return Placement(joint, of_frame=False), twist
