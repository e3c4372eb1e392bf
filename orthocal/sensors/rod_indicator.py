"""An indicator on a round rod of a leg, with a ball or a blade: what a dial really touches.

The tip begins beside the rod as it lies in the mechanical zero of the nominal machine, at the
setup's section along the leg; the zero of the setup takes what it is off along the plunger.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocal.errors import SessionError
from orthocal.robot.model import Robot, Rod
from orthocal.sensors.leg_indicator import DIRECTIONS, LegIndicator, LegKeys, Section
from orthocal.sensors.protocol import Contact, Frames, SetupKeys, Unknown, View
from orthocal.sensors.standing import USUAL, Standing, stand
from orthocal.sensors.tips import Tip, TipKeys, touch_by_ball, touch_by_blade
from orthocal.units import MM

Array = NDArray[np.float64]
Matrix = Any
"""Symbols or numbers of CasADi."""


class RodKeys(LegKeys):
    """A setup of an indicator on a leg, as in a session.yaml."""

    touches: str | None = None
    """Which of the leg's rods; the line between them where not given."""
    tip: TipKeys | None = None


def read_leg(keys: RodKeys) -> LegIndicator | RodIndicator:
    """The indicator that a setup's keys describe.

    Raises:
        SessionError: If a rod is touched with nothing, or a line with something.
    """
    if keys.touches is None:
        return LegIndicator.from_keys(keys)
    if keys.tip is None:
        raise SessionError("is missing; expected ball or blade", where="tip")
    return (RodByBall if keys.tip.ball is not None else RodByBlade).from_keys(keys)


@dataclass(frozen=True, slots=True)
class RodIndicator:
    """An indicator on a rod of a leg."""

    leg: str
    rod: str
    direction: str
    """x, y, z, -x, -y or -z of the world: the direction of a growing reading."""
    section: Section
    tip: Tip
    standing: Standing = USUAL

    kind: ClassVar[str] = "leg"
    keys: ClassVar[type[SetupKeys]] = RodKeys
    ideal: ClassVar[str] = "parallel"

    @classmethod
    def from_keys(cls, keys: Any) -> Self:  # noqa: ANN401 - RodKeys that name a rod and a tip
        """As in a session.yaml."""
        section, tip = Section.from_keys(keys.section), Tip.from_keys(keys.tip)
        standing = Standing.from_keys(keys)
        return cls(keys.leg, keys.touches, keys.direction, section, tip, standing)

    def to_keys(self) -> dict[str, Any]:
        """As in a session.yaml."""
        return {**self._line.to_keys(), "touches": self.rod, "tip": self.tip.to_keys()}

    def require_fit(self, robot: Robot, *, where: str) -> None:
        """Refuse a leg, rod, direction or section that the robot does not have.

        Raises:
            SessionError: Naming the key.
        """
        self._line.require_fit(robot, where=where)
        rods = robot.legs[self.leg].rods
        if self.rod not in rods:
            known = f"; rods: {', '.join(rods)}" if rods else ": it has none in the robot's YAML"
            raise SessionError(
                f"'{self.rod}' is not a rod of leg {self.leg}{known}", where=f"{where}.touches"
            )

    @property
    def place(self) -> tuple[str, str]:
        """The leg."""
        return "leg", self.leg

    def describe(self) -> str:
        """Leg, rod, direction, section and tip."""
        return f"{self._line.describe()}, {self.tip.form} on rod {self.rod}"

    def frames(self, robot: Robot) -> Frames:
        """Ends of the rod; the leg's root at zero, where a section may count from it."""
        rod = self._rod(robot)
        return Frames((rod.root, rod.tip), self._line.frames(robot).at_zero)

    def constants(self, robot: Robot) -> Array:
        """As of the line (8); where the tip is across the leg, and the radius of the contact."""
        rod, axis = self._rod(robot), robot.legs[self.leg].axis
        side = self._side(robot)
        return np.array(
            [
                *self._line.constants(robot),
                *side,
                self._lateral(robot, rod, axis, side),
                rod.radius + self.tip.radius,
            ]
        )

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """How it stands."""
        return self.standing.unknowns(ball=self.tip.form == "ball")

    def expression(self, view: View, robot: Robot) -> ca.SX:
        """What it shows, [m]."""
        del robot
        root, end = (pose.position for pose in view.frames)
        c = view.constants
        direction, plane, axis, side = c[:3], c[3], c[5:8], c[8:11]
        if view.at_zero:
            plane += c[4] * ca.dot(axis, view.at_zero[0].position)
        stood = stand(self.unknowns, view.unknowns, direction=direction, side=side, axis=axis)
        found: ca.SX = self._touch(
            at=root,
            along=end - root,
            radius=c[12],
            tip=plane * axis + c[11] * side + stood.moved,
            direction=stood.direction,
            side=stood.edge,
        )
        return ca.SX(stood.scale * found)

    def contact(self, frames: Sequence[Array], at_zero: Sequence[Array], robot: Robot) -> Contact:
        """Where the tip touches the rod's surface."""
        rod, constants = self._rod(robot), self.constants(robot)
        direction, plane, axis, side = (
            constants[:3],
            constants[3],
            constants[5:8],
            constants[8:11],
        )
        if at_zero:
            plane += constants[4] * float(axis @ at_zero[0][:3, 3])
        start = plane * axis + constants[11] * side
        points, problems = [], []
        for root, end in zip(*(pose[:, :3, 3] for pose in frames), strict=True):
            point, problem = self._meet(root, end, start, direction, side, rod)
            points.append(point)
            problems.append(problem)
        return Contact(
            points=np.array(points),
            direction=direction,
            along=axis,
            problems=problems,
            key="section",
        )

    def _meet(
        self, root: Array, end: Array, start: Array, direction: Array, side: Array, rod: Rod
    ) -> tuple[Array, str]:
        """Where the tip touches in one posture, and why it cannot."""
        along = end - root
        length = float(np.linalg.norm(along))
        unit = along / length
        radius = rod.radius + self.tip.radius
        h = float(
            self._touch(
                at=ca.DM(root),
                along=ca.DM(along),
                radius=ca.DM(radius),
                tip=ca.DM(start),
                direction=ca.DM(direction),
                side=ca.DM(side),
            )
        )
        if not np.isfinite(h):
            apart = start - root
            lateral = np.cross(unit, direction) @ apart / np.linalg.norm(np.cross(unit, direction))
            return start, (
                f"the ball would pass the rod: it is {abs(lateral) / MM:.1f} mm beside its axis, "
                f"and they touch up to {radius / MM:.1f} mm"
            )
        centre = start + h * direction
        if self.tip.form == "blade":
            normal = np.cross(side, unit)
            normal *= np.sign(normal @ direction) / np.linalg.norm(normal)
            shift = np.linalg.lstsq(
                np.column_stack([side, -unit, normal]), root - centre, rcond=None
            )[0]
            foot, off = root + shift[1] * unit, abs(float(shift[0]))
            surface = foot + rod.radius * normal
            if off > 0.5 * self.tip.width:
                return surface, (
                    f"the blade would slide off: it would touch {off / MM:.1f} mm from its "
                    f"middle, and is {self.tip.width / MM:.1f} mm wide"
                )
        else:
            foot = root + float((centre - root) @ unit) * unit
            surface = foot + rod.radius * (centre - foot) / np.linalg.norm(centre - foot)
        way = float((foot - root) @ unit)
        if 0.0 <= way <= length:
            return surface, ""
        return surface, (
            f"the gauge would touch at {way / MM:.1f} mm from the root; the rod reaches from 0 "
            f"to {length / MM:.1f} mm"
        )

    def _touch(
        self,
        *,
        at: Matrix,
        along: Matrix,
        radius: Matrix,
        tip: Matrix,
        direction: Matrix,
        side: Matrix,
    ) -> Matrix:
        """What it reads where a rod lies; of each form its own expression."""
        if self.tip.form == "ball":
            return touch_by_ball(at=at, along=along, radius=radius, tip=tip, direction=direction)
        return touch_by_blade(
            at=at, along=along, radius=radius, edge=side, tip=tip, direction=direction
        )

    @property
    def _line(self) -> LegIndicator:
        return LegIndicator(self.leg, self.direction, self.section, self.standing)

    def _rod(self, robot: Robot) -> Rod:
        return robot.legs[self.leg].rods[self.rod]

    def _side(self, robot: Robot) -> Array:
        """Across leg and plunger: the blade's edge, unit vector."""
        side = np.cross(robot.legs[self.leg].axis, DIRECTIONS[self.direction])
        return np.asarray(side / np.linalg.norm(side))

    def _lateral(self, robot: Robot, rod: Rod, axis: Array, side: Array) -> float:
        """Where the rod lies across the leg in the mechanical zero, at the section, [m]."""
        plane, from_root = self._line.plane(robot)
        if from_root:
            plane += float(axis @ robot.legs[self.leg].zero_root)
        along = rod.zero_tip - rod.zero_root
        share = (plane - axis @ rod.zero_root) / (axis @ along)
        return float(side @ (rod.zero_root + share * along))


class RodByBall(RodIndicator):
    """With a ball: a class of its own, for sensors of one class share one expression."""

    __slots__ = ()


class RodByBlade(RodIndicator):
    """With a blade."""

    __slots__ = ()
