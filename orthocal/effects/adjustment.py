"""Mechanical adjustments: feet and shims under a slide, and threads that lengthen a rod.

A foot moves one point of a slide's rail by a known amount. The rail turns about a second point, the
pivot, or shifts as a whole where no pivot is stated:

    twist per metre   ω = (r × d)/|r|²,  v = −ω × pivot,  r = at − pivot, its part across d
                      ω = 0,             v = d            without a pivot

A thread lengthens one rod. The amount of an adjustment is a sum of elementary errors of the
geometry, `<name>.adjustment`: 0 for the machine as it is. Sessions before and after an adjustment
differ by its amount and by the error with which it was set, `<name>.setting`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import casadi as ca
import numpy as np
import pinocchio as pin

from orthocal.arrays import Array
from orthocal.effects.protocol import Effect, EffectKeys, Placement, Symbols
from orthocal.effects.rods import stretch_rod
from orthocal.errors import OrthocalError, RobotError
from orthocal.io.documents import Name, Number, PositiveNumber, validate
from orthocal.io.fields import read_only
from orthocal.robot.frames import carriers
from orthocal.robot.model import Robot, joint_axis
from orthocal.robot.parameters import AXES, ElementaryError, Parameter
from orthocal.units import MM, read_limit

SUFFIX = ".adjustment"
"""Suffix of the amount of an adjustment, a parameter that is never free in a model."""

SETTING = ".setting"
"""Suffix of the error with which an adjustment was set."""

SHORTEST_LEVER = 1e-3
"""Shortest distance of a foot from its pivot, across its direction, [m]."""

LEVER_SHARE = 0.05
"""Standard deviation of an amount relative to itself: lever arms are known to one part in ten."""

NEGLIGIBLE = 1e-12
"""Component of a twist per metre that is rounding, [1, rad/m]."""

LARGEST_AMOUNT_MM = 50.0
"""Largest sum of the adjustments of one foot, shim or thread."""

SAME_AMOUNT = 1e-9
"""Difference of two amounts that counts as none, [m]."""

Vector = tuple[Number, Number, Number]


class AdjustmentKeys(EffectKeys):
    """Keys of one adjustment under `orthocal.adjustments`."""

    moves: Name | None = None
    """Drive whose slide it moves."""
    at_mm: Vector | None = None
    """Point of the slide's rail that moves, in the world frame of the nominal machine."""
    direction: Vector | None = None
    """Direction in which that point moves for a positive amount, in the world frame."""
    pivot_mm: Vector | None = None
    """Point about which the rail turns; without it the rail shifts as a whole."""
    lengthens: Name | None = None
    """Rod that it lengthens, as LEG.ROD."""
    pitch_mm: PositiveNumber | None = None
    """Displacement in one turn of its thread; without it the amount is the thickness of shims."""
    step_mm: PositiveNumber = 0.01
    """Smallest amount that can be set: of shims their grading."""
    largest_mm: PositiveNumber = 1.0
    """Largest amount in either direction."""


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """A mechanical adjustment of a machine."""

    name: str
    keys: AdjustmentKeys
    twists: Mapping[Placement, Array]
    """Placements that it displaces, each with its twist per metre, shape (6,), [1, rad/m]."""

    @property
    def parameter(self) -> str:
        """Name of the parameter that is its amount."""
        return f"{self.name}{SUFFIX}"

    @property
    def step(self) -> float:
        """Smallest amount that can be set, [m]."""
        return self.keys.step_mm * MM

    @property
    def largest(self) -> float:
        """Largest amount in either direction, [m]."""
        return self.keys.largest_mm * MM

    @property
    def rounding_std(self) -> float:
        """Standard deviation of an amount that is right to half a step, [m]."""
        return self.step / math.sqrt(12.0)

    def setting_std(self, amount: float) -> float:
        """Standard deviation of an amount as it is set, rounding and lever arm, [m].

        Args:
            amount: [m].
        """
        return math.hypot(self.rounding_std, LEVER_SHARE * amount) if amount else 0.0


@lru_cache(maxsize=64)
def find_adjustments(robot: Robot) -> tuple[Adjustment, ...]:
    """Mechanical adjustments that the robot's YAML declares, in its order.

    Raises:
        RobotError: If a key does not fit the robot.
    """
    where, result = str(robot.yaml), []
    for name, data in robot.declared.adjustments.items():
        under = f"orthocal.adjustments.{name}"
        keys = validate(AdjustmentKeys, data, where=where, error=RobotError, under=under)
        try:
            read = _foot_twists if keys.lengthens is None else _rod_twists
            twists = read(keys, robot)
            if keys.largest_mm < keys.step_mm:
                raise RobotError(
                    f"found {keys.largest_mm:g}; expected at least step_mm, {keys.step_mm:g}",
                    where="largest_mm",
                )
        except RobotError as e:
            key = ".".join(part for part in (under, e.where) if part)
            raise RobotError(e.problem, where=f"{where}: {key}") from None
        result.append(Adjustment(name, keys, twists))
    return tuple(result)


def require_adjustment(robot: Robot, name: str, *, where: str, error: type[OrthocalError]) -> None:
    """Refuse a name that is not that of an adjustment of a robot.

    Raises:
        OrthocalError: Of kind `error`, with the names of the adjustments.
    """
    names = robot.declared.adjustments
    if name not in names:
        known = f"adjustments: {', '.join(names)}" if names else "the robot declares none"
        raise error(f"'{name}' is not an adjustment of robot '{robot.name}'; {known}", where=where)


def add_amounts(before: Mapping[str, float], more: Mapping[str, float]) -> dict[str, float]:
    """Adjustments of a machine after further ones, name to amount, [m]."""
    names = dict.fromkeys([*before, *more])
    return {name: before.get(name, 0.0) + more.get(name, 0.0) for name in names}


def subtract_amounts(after: Mapping[str, float], before: Mapping[str, float]) -> dict[str, float]:
    """Adjustments from one state of a machine to another, name to amount, [m]; no zeros."""
    changes = {n: after.get(n, 0.0) - before.get(n, 0.0) for n in {**before, **after}}
    return {name: change for name, change in changes.items() if abs(change) > SAME_AMOUNT}


def adjustment_parameters(
    robot: Robot, elementary: Mapping[str, ElementaryError]
) -> tuple[Parameter, ...]:
    """Amounts of a robot's adjustments as sums of elementary errors of its geometry.

    A displacement of a drive's placement along or about its axis is its offset.

    Args:
        robot: The robot.
        elementary: Elementary errors of drives and geometry, by name.

    Raises:
        RobotError: If an adjustment displaces a placement that has no errors.
    """
    parameters, frames = [], {robot.frame_id(f) for f in robot.frames}
    for one in find_adjustments(robot):
        terms: dict[str, float] = {}
        for placement, twist in one.twists.items():
            for part, moved in _on_frames(robot, placement, twist, frames):
                for name, coefficient in _terms(robot, part, moved):
                    if name not in elementary:
                        raise RobotError(
                            f"displaces '{name.rpartition('.')[0]}', which has no errors",
                            where=f"{robot.yaml}: orthocal.adjustments.{one.name}",
                        )
                    terms[name] = terms.get(name, 0.0) + coefficient
        std = read_limit(one.largest)
        parameters.append(Parameter(one.parameter, "m", std, tuple(terms.items())))
    return tuple(parameters)


def _on_frames(
    robot: Robot, placement: Placement, twist: Array, frames: set[int]
) -> list[tuple[Placement, Array]]:
    """Twists of the frames with errors that a frame without errors carries; others stay."""
    model = robot.model
    if not placement.of_frame or placement.index in frames:
        return [(placement, twist)]
    carrier = model.frames[placement.index].placement
    result = []
    for frame in sorted(frames):
        above = list(carriers(model, frame))[1:]
        if placement.index in above and frames.isdisjoint(above[: above.index(placement.index)]):
            relative = carrier.actInv(model.frames[frame].placement)
            moved = np.asarray(relative.actInv(pin.Motion(twist)).vector, dtype=np.float64)
            result.append((Placement(frame, of_frame=True), moved))
    return result or [(placement, twist)]


def _terms(robot: Robot, placement: Placement, twist: Array) -> list[tuple[str, float]]:
    """Elementary errors of a placement's twist, with coefficients."""
    model = robot.model
    terms: list[tuple[str, float]] = []
    if placement.of_frame:
        owner, remainder = f"frame.{model.frames[placement.index].name}", twist
    else:
        owner, remainder = str(model.names[placement.index]), twist
        if owner in {d.name for d in robot.drives}:
            axis = joint_axis(model, placement.index)
            k = int(np.abs(axis).argmax())
            offset = float(twist[k] / axis[k])
            remainder = np.where(np.arange(6) == k, 0.0, twist - offset * axis)
            terms.append((f"{owner}.offset", offset))
    terms += [(f"{owner}.{a}", float(v)) for a, v in zip(AXES, remainder, strict=True)]
    return [(name, v) for name, v in terms if abs(v) > NEGLIGIBLE]


@dataclass(frozen=True, eq=False)
class AdjustmentChanges(Effect):
    """Differences of a machine's adjustments between the sessions that are calibrated together.

    In a session before, an adjustment differs by c from the amount that it has at last, and by the
    error with which it was set: the machine is displaced by

        twist · (c + e √(1 + (share c/rounding)²)),  without e where c = 0

    with e of the standard deviation `rounding_std`, and `share` the LEVER_SHARE.
    """

    name = "adjustment"
    conditions = ("adjustment",)

    adjustments: tuple[Adjustment, ...]
    errors: tuple[ElementaryError, ...]
    """`<name>.setting` of each: e, [m]."""

    @classmethod
    def of_robot(cls, robot: Robot) -> Self:
        """The effect of a robot with adjustments."""
        adjustments = find_adjustments(robot)
        errors = (
            ElementaryError(
                f"{a.name}{SETTING}", cls.name, a.name, "m", a.rounding_std, complete=True
            )
            for a in adjustments
        )
        return cls(adjustments, tuple(errors))

    def describe(self) -> str:
        """Description in a few words."""
        return "mechanical adjustments between sessions"

    def placements(self, errors: Symbols, conditions: Symbols) -> Mapping[Placement, ca.SX]:
        """Twists of placements; arguments as for `Effect.placements`."""
        changes, result = conditions["adjustment"], dict[Placement, ca.SX]()
        for i, (one, error) in enumerate(zip(self.adjustments, self.errors, strict=True)):
            change = changes[i]
            relative = LEVER_SHARE / one.rounding_std * change
            amount = change + ca.sqrt(ca.sign(change) ** 2 + relative**2) * errors[error.name]
            for placement, twist in one.twists.items():
                part = ca.sparsify(ca.SX(twist)) * amount
                before = result.get(placement)
                result[placement] = part if before is None else before + part
        return result


def _rod_twists(keys: AdjustmentKeys, robot: Robot) -> dict[Placement, Array]:
    """Twists of the placements on the rod that a thread lengthens."""
    for key in ("moves", "at_mm", "direction", "pivot_mm"):
        if getattr(keys, key) is not None:
            raise RobotError("found with 'lengthens', which needs no other place", where=key)
    legs = robot.legs.values()
    rods = {f"{leg.name}.{rod.name}": rod for leg in legs for rod in leg.rods.values()}
    if keys.lengthens not in rods:
        expected = f"one of {', '.join(rods)}" if rods else "a robot with rods"
        raise RobotError(f"found '{keys.lengthens}'; expected {expected}", where="lengthens")
    twists = stretch_rod(robot, rods[keys.lengthens], ca.SX(1.0))
    return {
        placement: read_only(np.asarray(ca.DM(twist).full()).ravel())
        for placement, twist in twists.items()
    }


def _foot_twists(keys: AdjustmentKeys, robot: Robot) -> dict[Placement, Array]:
    """Placement of the slide that a foot moves, with its twist in the joint's axes."""
    drives = [d.name for d in robot.drives]
    if keys.moves not in drives:
        problem = "is missing" if keys.moves is None else f"found '{keys.moves}'"
        raise RobotError(
            f"{problem}; expected one of the drives {', '.join(drives)}, or 'lengthens' and a rod",
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
    turn, shift = np.zeros(3), direction
    if keys.pivot_mm is not None:
        pivot = np.array(keys.pivot_mm) * MM
        arm = np.array(keys.at_mm) * MM - pivot
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
    twist[np.abs(twist) < NEGLIGIBLE] = 0.0
    return {Placement(joint, of_frame=False): read_only(twist)}
