"""Mechanical adjustments: feet and shims under a slide, and threads that lengthen a rod.

A foot moves one point of a slide's rail, `at`, by a known amount along the unit vector d. The rail
turns about a second point, the pivot. Without a pivot it is translated. With r the component of
at − pivot normal to d, the rotation ω and the translation v at the world origin are

    per metre   ω = (r × d)/|r|²,  v = −ω × pivot
                ω = 0,             v = d             without a pivot

A thread lengthens one rod. The amount of an adjustment is a sum of elementary errors of the
geometry, `<name>.adjustment`, and 0 for the present machine. Sessions before and after an
adjustment differ by its amount and by the setting error of the operator, `<name>.setting`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Self

import casadi as ca
import numpy as np
import pinocchio as pin
from pydantic import Field

from orthocal.arrays import Array
from orthocal.effects.protocol import Effect, EffectKeys, Placement, Symbols, add_twist
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
"""Suffix of the setting error of an adjustment."""

SHORTEST_LEVER = 1e-3
"""Shortest accepted lever arm of a foot about its pivot, normal to its direction, [m]."""

LEVER_SHARE = 0.05
"""Relative standard deviation of an amount, which is that of its lever arm (tolerance 10 %)."""

NEGLIGIBLE = 1e-12
"""Components of a twist per metre below this are rounding errors, [1, rad/m]."""

LARGEST_AMOUNT_MM = 50.0
"""Largest sum of the adjustments of one foot, shim or thread."""

SAME_AMOUNT = 1e-9
"""Largest difference between equal amounts, [m]."""

Vector = tuple[Number, Number, Number]
"""Coordinates x, y and z in the world frame, in the unit of the key."""


class AdjustmentKeys(EffectKeys):
    """Keys of one adjustment under `orthocal.adjustments`."""

    moves: Name | None = None
    """Drive whose slide is moved."""
    at_mm: Vector | None = None
    """Point of the slide's rail that moves, in the world frame of the nominal machine."""
    direction: Vector | None = None
    """Direction in which the point moves for a positive amount, in the world frame."""
    pivot_mm: Vector | None = None
    """Point about which the rail turns; without it the rail is translated."""
    lengthens: Name | None = None
    """Rod that is lengthened, as LEG.ROD."""
    pitch_mm: PositiveNumber | None = None
    """Displacement per turn of the thread; without it the amount is the thickness of shims."""
    step_mm: PositiveNumber = 0.01
    """Smallest amount that can be set: a division of the thread, or the grading of shims."""
    largest_mm: Annotated[PositiveNumber, Field(le=LARGEST_AMOUNT_MM)] = 1.0
    """Largest amount in either direction."""


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """Mechanical adjustment of a machine."""

    name: str
    keys: AdjustmentKeys
    twists: Mapping[Placement, Array]
    """Displaced placements, mapped to their twist per metre, shape (6,), [1, rad/m]."""

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
        """Standard deviation of an amount that is rounded to a step, [m]."""
        return self.step / math.sqrt(12.0)

    def setting_std(self, amount: float) -> float:
        """Standard deviation of an amount from rounding and lever arm, [m]; 0 for no amount.

        Args:
            amount: Amount that is set, [m].
        """
        return math.hypot(self.rounding_std, LEVER_SHARE * amount) if amount else 0.0


@lru_cache(maxsize=64)
def find_adjustments(robot: Robot) -> tuple[Adjustment, ...]:
    """Mechanical adjustments declared in the robot's YAML, in their order.

    Raises:
        RobotError: If a key does not fit the robot.
    """
    where, result = str(robot.yaml), []
    for name, data in robot.declared.adjustments.items():
        prefix = f"orthocal.adjustments.{name}"
        keys = validate(AdjustmentKeys, data, where=where, error=RobotError, under=prefix)
        try:
            compute_twists = _foot_twists if keys.lengthens is None else _rod_twists
            twists = compute_twists(keys, robot)
            if keys.largest_mm < keys.step_mm:
                found, bound = f"{keys.step_mm:g}", f"largest_mm, {keys.largest_mm:g}"
                raise RobotError(f"found {found}; expected at most {bound}", where="step_mm")
        except RobotError as e:
            key = ".".join(part for part in (prefix, e.where) if part)
            raise RobotError(e.problem, where=f"{where}: {key}") from None
        result.append(Adjustment(name, keys, twists))
    return tuple(result)


def require_adjustment(robot: Robot, name: str, *, where: str, error: type[OrthocalError]) -> None:
    """Refuse a name that is not an adjustment of a robot.

    Raises:
        OrthocalError: If the robot does not declare it, as `error`; lists the adjustments.
    """
    names = robot.declared.adjustments
    if name not in names:
        declared = f"adjustments: {', '.join(names)}" if names else "the robot declares none"
        problem = f"'{name}' is not an adjustment of robot '{robot.name}'; {declared}"
        raise error(problem, where=where)


def add_amounts(before: Mapping[str, float], more: Mapping[str, float]) -> dict[str, float]:
    """Sums of two sets of amounts, by the name of the adjustment, [m]."""
    names = dict.fromkeys([*before, *more])
    return {name: before.get(name, 0.0) + more.get(name, 0.0) for name in names}


def subtract_amounts(after: Mapping[str, float], before: Mapping[str, float]) -> dict[str, float]:
    """Amounts after minus before, by the name of the adjustment, [m]; equal ones are omitted."""
    changes = {n: after.get(n, 0.0) - before.get(n, 0.0) for n in {**before, **after}}
    return {name: change for name, change in changes.items() if abs(change) > SAME_AMOUNT}


def adjustment_parameters(
    robot: Robot, elementary: Mapping[str, ElementaryError]
) -> tuple[Parameter, ...]:
    """Amounts of a robot's adjustments as sums of elementary errors of its geometry.

    Args:
        robot: The robot.
        elementary: Elementary errors of drives and geometry, by name.

    Raises:
        RobotError: If an adjustment displaces a placement that has no errors.
    """
    parameters, frames = [], {robot.frame_id(f) for f in robot.frames}
    for adjustment in find_adjustments(robot):
        terms: dict[str, float] = {}
        for carrier, carrier_twist in adjustment.twists.items():
            for placement, twist in _on_frames(robot, carrier, carrier_twist, frames):
                for name, coefficient in _terms(robot, placement, twist):
                    if name not in elementary:
                        raise RobotError(
                            f"displaces '{name.rpartition('.')[0]}', which has no errors",
                            where=f"{robot.yaml}: orthocal.adjustments.{adjustment.name}",
                        )
                    terms[name] = terms.get(name, 0.0) + coefficient
        std = read_limit(adjustment.largest)
        parameters.append(Parameter(adjustment.parameter, "m", std, tuple(terms.items())))
    return tuple(parameters)


def _on_frames(
    robot: Robot, placement: Placement, twist: Array, frames: set[int]
) -> list[tuple[Placement, Array]]:
    """Express the twist of a frame without errors by twists of the frames with errors on it.

    These are the nearest such frames that the displaced frame carries. The twist of another
    placement is returned unchanged.

    Args:
        robot: The robot.
        placement: The displaced placement.
        twist: Its twist per metre, shape (6,), [1, rad/m].
        frames: Indices of the frames with errors.
    """
    model = robot.model
    if not placement.of_frame or placement.index in frames:
        return [(placement, twist)]
    carrier = model.frames[placement.index].placement
    result = []
    for frame in sorted(frames):
        above = list(carriers(model, frame))[1:]
        if placement.index in above and frames.isdisjoint(above[: above.index(placement.index)]):
            relative = carrier.actInv(model.frames[frame].placement)
            local = np.asarray(relative.actInv(pin.Motion(twist)).vector, dtype=np.float64)
            result.append((Placement(frame, of_frame=True), local))
    return result or [(placement, twist)]


def _terms(robot: Robot, placement: Placement, twist: Array) -> list[tuple[str, float]]:
    """Elementary errors that produce a placement's twist, with coefficients.

    A displacement of a drive's placement along or about the axis of the drive is its offset.
    """
    model = robot.model
    terms: list[tuple[str, float]] = []
    if placement.of_frame:
        owner = f"frame.{model.frames[placement.index].name}"
    else:
        owner = str(model.names[placement.index])
        if owner in {d.name for d in robot.drives}:
            axis = joint_axis(model, placement.index)
            k = int(np.abs(axis).argmax())
            offset = float(twist[k] / axis[k])
            twist = np.where(np.arange(6) == k, 0.0, twist - offset * axis)
            terms.append((f"{owner}.offset", offset))
    terms += [(f"{owner}.{a}", float(v)) for a, v in zip(AXES, twist, strict=True)]
    return [(name, v) for name, v in terms if abs(v) > NEGLIGIBLE]


@dataclass(frozen=True, eq=False)
class AdjustmentChanges(Effect):
    """Differences between the adjustments of sessions that are calibrated together.

    In an earlier session an adjustment differs by c from its last amount, and by its setting error
    e. The machine is displaced by

        twist · (c + e √(1 + (LEVER_SHARE c/rounding_std)²)),  0 for c = 0

    The prior standard deviation of e is `rounding_std`. The root scales e to the standard deviation
    `setting_std(c)`.
    """

    name = "adjustment"
    conditions = ("adjustment",)

    adjustments: tuple[Adjustment, ...]
    errors: tuple[ElementaryError, ...]
    """Setting error e of each adjustment, `<name>.setting`, [m]."""

    @classmethod
    def of_robot(cls, robot: Robot) -> Self:
        """Build the effect for a robot with adjustments."""
        adjustments = find_adjustments(robot)
        errors = (
            ElementaryError(
                name=f"{a.name}{SETTING}",
                kind=cls.name,
                owner=a.name,
                unit="m",
                prior_std=a.rounding_std,
            )
            for a in adjustments
        )
        return cls(adjustments, tuple(errors))

    def describe(self) -> str:
        """Description in a few words."""
        return "mechanical adjustments between sessions"

    def placements(self, errors: Symbols, conditions: Symbols) -> Mapping[Placement, ca.SX]:
        """Twists of placements (see `Effect.placements`)."""
        changes, result = conditions["adjustment"], dict[Placement, ca.SX]()
        for i, (adjustment, error) in enumerate(zip(self.adjustments, self.errors, strict=True)):
            change = changes[i]
            relative = LEVER_SHARE / adjustment.rounding_std * change
            # the square of the sign is 1, or 0 without a change, which has no setting error
            amount = change + ca.sqrt(ca.sign(change) ** 2 + relative**2) * errors[error.name]
            for placement, unit_twist in adjustment.twists.items():
                twist = ca.sparsify(ca.SX(unit_twist)) * amount
                add_twist(result, placement, twist)
        return result


def _rod_twists(keys: AdjustmentKeys, robot: Robot) -> dict[Placement, Array]:
    """Twists per metre of the placements on the rod that a thread lengthens.

    Raises:
        RobotError: If the rod does not exist, or keys of a foot are stated, too.
    """
    for key in ("moves", "at_mm", "direction", "pivot_mm"):
        if getattr(keys, key) is not None:
            raise RobotError("found with 'lengthens', which excludes it", where=key)
    rods = {f"{leg}.{name}": rod for (leg, name), rod in robot.rods.items()}
    if keys.lengthens not in rods:
        expected = f"one of {', '.join(rods)}" if rods else "a robot with rods"
        raise RobotError(f"found '{keys.lengthens}'; expected {expected}", where="lengthens")
    twists = stretch_rod(robot, rods[keys.lengthens], ca.SX(1.0))
    return {
        placement: read_only(np.asarray(ca.DM(twist).full()).ravel())
        for placement, twist in twists.items()
    }


def _foot_twists(keys: AdjustmentKeys, robot: Robot) -> dict[Placement, Array]:
    """Placement of the slide that a foot moves, with its twist per metre in the joint's axes.

    Raises:
        RobotError: If a key is missing or does not fit; names the key.
    """
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
    norm = float(np.linalg.norm(direction))
    if norm == 0.0:
        raise RobotError("found 0, 0, 0; expected a direction", where="direction")
    direction /= norm
    rotation, translation = np.zeros(3), direction
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
        rotation = np.cross(arm, direction) / lever**2
        translation = -np.cross(rotation, pivot)
    model, data = robot.model, robot.model.createData()
    pin.framesForwardKinematics(model, data, robot.configuration(robot.reference_posture))
    joint = int(model.getJointId(keys.moves))
    placement = data.oMi[int(model.parents[joint])] * model.jointPlacements[joint]
    twist = np.asarray(placement.actInv(pin.Motion(translation, rotation)).vector, dtype=np.float64)
    twist[np.abs(twist) < NEGLIGIBLE] = 0.0
    return {Placement(joint, of_frame=False): read_only(twist)}
