"""An indicator on a round rod of a leg, with a ball or a blade.

At reading 0 the tip is on the axis of the nominal rod in the mechanical zero, at the section of the
setup. The gauge zero of the setup contains its distance from there along the plunger.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any, ClassVar, Self

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from orthocal.errors import SessionError
from orthocal.io.documents import Number
from orthocal.robot.model import Robot, Rod
from orthocal.sensors.leg_indicator import (
    Direction,
    LegIndicator,
    LegKeys,
    Section,
    direction_vector,
    read_direction,
)
from orthocal.sensors.mounting import EXACT, USUAL, Mounting, mount
from orthocal.sensors.protocol import (
    Contact,
    Frames,
    NuisanceParameter,
    Sensor,
    SetupKeys,
    TouchingTip,
    View,
)
from orthocal.sensors.tips import Tip, TipKeys, touch_by_ball, touch_by_blade
from orthocal.units import MM, to_mm

Array = NDArray[np.float64]
Matrix = Any
"""Symbols or numbers of CasADi."""


OBLIQUITY_DEG = {"ball": 30.0, "blade": 10.0}
"""Largest deviation of a plunger from square to the leg: beyond it the rod pushes the plunger
aside, and a blade touches with its back."""


LARGEST_BESIDE_MM = 500.0
"""Largest displacement across the leg; a larger one has a wrong unit."""

EDGE = Tip("blade", 0.0)
"""Tip of the virtual sensor: a view along the plunger."""

NOT_ACROSS = 1e-5
"""Largest component of `beside` along leg or plunger, [m]: rounding."""

Millimetres = Annotated[Number, Field(ge=-LARGEST_BESIDE_MM, le=LARGEST_BESIDE_MM)]


class RodKeys(LegKeys):
    """A setup of an indicator on a leg, as in a session.yaml."""

    touches: str | None = None
    """Which of the leg's rods; the line between them where not given."""
    tip: TipKeys | None = None
    beside_mm: Annotated[list[Millimetres], Field(min_length=3, max_length=3)] | None = None
    """Where the tip begins, from where the rod lies in the mechanical zero: across leg and plunger,
    in the world. For readings in postures in which the rod lies elsewhere."""


def read_leg(keys: RodKeys) -> LegIndicator | RodIndicator:
    """The indicator that a setup's keys describe.

    Raises:
        SessionError: If a rod is touched with nothing, or a line with something.
    """
    if keys.touches is None:
        if keys.beside_mm is not None:
            raise SessionError("found without `touches`, a rod; expected one", where="beside_mm")
        return LegIndicator.from_keys(keys)
    if keys.tip is None:
        raise SessionError("is missing; expected ball or blade", where="tip")
    return (RodByBall if keys.tip.ball is not None else RodByBlade).from_keys(keys)


@dataclass(frozen=True, slots=True)
class RodIndicator:
    """An indicator on a rod of a leg."""

    leg: str
    rod: str
    direction: Direction
    """Direction of a growing reading: x, y, z, -x, -y or -z of the world, or a vector."""
    section: Section
    tip: Tip
    mounting: Mounting = USUAL
    beside: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Displacement of the tip from the nominal rod in the mechanical zero, [m]."""

    kind: ClassVar[str] = "leg"
    keys: ClassVar[type[SetupKeys]] = RodKeys
    ideal: ClassVar[str] = "parallel"

    @classmethod
    def from_keys(cls, keys: Any) -> Self:  # noqa: ANN401 - RodKeys that name a rod and a tip
        """Build from the keys of a session.yaml."""
        section, tip = Section.from_keys(keys.section), Tip.from_keys(keys.tip)
        mounting = Mounting.from_keys(keys)
        x, y, z = keys.beside_mm or (0.0, 0.0, 0.0)
        beside = (x * MM, y * MM, z * MM)
        return cls(keys.leg, keys.touches, read_direction(keys), section, tip, mounting, beside)

    def to_keys(self) -> dict[str, Any]:
        """Keys for a session.yaml."""
        beside = {"beside_mm": [to_mm(v) for v in self.beside]} if any(self.beside) else {}
        return {**self._line.to_keys(), "touches": self.rod, "tip": self.tip.to_keys(), **beside}

    def require_fit(self, robot: Robot, *, where: str) -> None:
        """Refuse a leg, rod, direction or section that the robot does not have.

        Raises:
            SessionError: Naming the key.
        """
        self._line.require_fit_within(OBLIQUITY_DEG[self.tip.form], robot, where=where)
        rods = robot.legs[self.leg].rods
        if self.rod not in rods:
            hint = f"; rods: {', '.join(rods)}" if rods else ": it has none in the robot's YAML"
            raise SessionError(
                f"'{self.rod}' is not a rod of leg {self.leg}{hint}", where=f"{where}.touches"
            )
        side = self._side(robot)
        if np.abs(np.cross(self.beside, side)).max() > NOT_ACROSS:
            stated = ", ".join(f"{v / MM:g}" for v in self.beside)
            across = ", ".join(f"{v:.3g}" for v in side)
            raise SessionError(
                f"found [{stated}]; expected a multiple of ({across}), across leg and plunger",
                where=f"{where}.beside_mm",
            )

    @property
    def place(self) -> tuple[str, str]:
        """The leg."""
        return "leg", self.leg

    def describe(self) -> str:
        """Leg, rod, direction, section and tip."""
        words = f"{self._line.describe()}, {self.tip.form} on rod {self.rod}"
        if not any(self.beside):
            return words
        return f"{words}, ({', '.join(f'{v / MM:g}' for v in self.beside)}) mm beside its zero"

    def frames(self, robot: Robot) -> Frames:
        """Ends of the rod; the leg's root in the reference posture for sections from the root."""
        rod = self._rod(robot)
        return Frames((rod.root, rod.tip), self._line.frames(robot).at_zero)

    def constants(self, robot: Robot) -> Array:
        """Constants of the line model (8), blade edge (3), tip across the leg (3), radii (1)."""
        rod = self._rod(robot)
        across, radius = self._across(robot, rod), rod.radius + self.tip.radius
        return np.array([*self._line.constants(robot), *self._side(robot), *across, radius])

    @property
    def nuisance_parameters(self) -> tuple[NuisanceParameter, ...]:
        """Nuisance parameters of the mounting."""
        return self.mounting.nuisance_parameters(ball=self.tip.form == "ball")

    def aligned_to(self, robot: Robot) -> Mapping[str, Sensor]:
        """Virtual sensor of the lateral position: the operator centres a ball on the rod."""
        if self.tip.form != "ball":
            return {}
        x, y, z = self._side(robot).tolist()
        return {"lateral": RodByBlade(self.leg, self.rod, (x, y, z), self.section, EDGE, EXACT)}

    def expression(self, view: View, robot: Robot) -> ca.SX:
        """Reading with the gauge zero at 0, [m]."""
        del robot
        root, end = (pose.position for pose in view.frames)
        c = view.constants
        direction, plane, axis, side = c[:3], c[3], c[5:8], c[8:11]
        if view.at_zero:
            plane += c[4] * ca.dot(axis, view.at_zero[0].position)
        gauge = mount(
            self.nuisance_parameters, view.nuisance, direction=direction, side=side, axis=axis
        )
        reading = _touch(
            self.tip.form,
            at=root,
            along=end - root,
            radius=c[14],
            tip=plane * axis + c[11:14] + gauge.displacement,
            direction=gauge.direction,
            side=gauge.edge,
        )
        return ca.SX(gauge.scale * reading)

    def contact(self, frames: Sequence[Array], at_zero: Sequence[Array], robot: Robot) -> Contact:
        """Points in which the tip touches the rod's surface."""
        rod, constants = self._rod(robot), self.constants(robot)
        direction, plane, axis, side = (
            constants[:3],
            constants[3],
            constants[5:8],
            constants[8:11],
        )
        if at_zero:
            plane += constants[4] * float(axis @ at_zero[0][:3, 3])
        roots, ends = (pose[:, :3, 3] for pose in frames)
        start = plane * axis + constants[11:14]
        points, problems = self._meet(roots, ends, start, direction, side, rod)
        return Contact(
            points=points,
            direction=direction,
            along=axis,
            problems=problems,
            key="section",
            tip=TouchingTip(
                self.tip.radius, None if self.tip.form == "ball" else side, self.tip.width
            ),
        )

    def _meet(
        self, roots: Array, ends: Array, start: Array, direction: Array, side: Array, rod: Rod
    ) -> tuple[Array, list[str]]:
        """Points of contact in K postures, (K, 3), and reasons why the tip cannot touch."""
        along = ends - roots
        lengths = np.linalg.norm(along, axis=1)
        units = along / lengths[:, None]
        radius = rod.radius + self.tip.radius
        h = _touching(self.tip.form)(roots.T, along.T, radius, start, direction, side)
        h = np.asarray(h)[0]
        apart = start - roots
        across = np.cross(units, direction)
        lateral = np.einsum("ki,ki->k", across, apart) / np.linalg.norm(across, axis=1)
        centres = start + h[:, None] * direction
        if self.tip.form == "blade":
            # the edge passes a radius from the rod's axis, along both their normal
            normals = np.cross(side, units)
            normals *= (np.sign(normals @ direction) / np.linalg.norm(normals, axis=1))[:, None]
            edges = np.broadcast_to(side, units.shape)
            frames = np.stack([edges, -units, normals], axis=2)
            shifts = np.linalg.solve(frames, (roots - centres)[:, :, None])[:, :, 0]
            feet, off = roots + shifts[:, 1:2] * units, np.abs(shifts[:, 0])
        else:
            feet = roots + np.einsum("ki,ki->k", centres - roots, units)[:, None] * units
            normals, off = centres - feet, np.zeros(len(roots))
            normals /= np.linalg.norm(normals, axis=1)[:, None]
        surface = feet + rod.radius * normals
        distances = np.einsum("ki,ki->k", feet - roots, units)
        problems = []
        for k, distance in enumerate(distances.tolist()):
            problem = ""
            if not np.isfinite(h[k]):
                surface[k] = start
                problem = (
                    f"the ball would pass the rod: it is {abs(lateral[k]) / MM:.1f} mm beside its "
                    f"axis, and they touch up to {radius / MM:.1f} mm"
                )
            elif off[k] > 0.5 * self.tip.width and self.tip.form == "blade":
                problem = (
                    f"the blade would slide off: it would touch {off[k] / MM:.1f} mm from its "
                    f"middle, and is {self.tip.width / MM:.1f} mm wide"
                )
            elif not 0.0 <= distance <= lengths[k]:
                problem = (
                    f"the gauge would touch at {distance / MM:.1f} mm from the root; the rod "
                    f"reaches from 0 to {lengths[k] / MM:.1f} mm"
                )
            problems.append(problem)
        return surface, problems

    @property
    def _line(self) -> LegIndicator:
        return LegIndicator(self.leg, self.direction, self.section, self.mounting)

    def _rod(self, robot: Robot) -> Rod:
        return robot.legs[self.leg].rods[self.rod]

    def _side(self, robot: Robot) -> Array:
        """Unit vector across leg and plunger: the edge of a blade."""
        side = np.cross(robot.legs[self.leg].axis, direction_vector(self.direction))
        return np.asarray(side / np.linalg.norm(side))

    def _across(self, robot: Robot, rod: Rod) -> Array:
        """Initial position of the tip across the leg: on the nominal rod in the mechanical zero."""
        axis = robot.legs[self.leg].axis
        plane, from_root = self._line.plane(robot)
        if from_root:
            plane += float(axis @ robot.legs[self.leg].reference_root)
        along = rod.reference_tip - rod.reference_root
        share = (plane - axis @ rod.reference_root) / (axis @ along)
        point = rod.reference_root + share * along
        return np.asarray(point - (axis @ point) * axis + self.beside)


def _touch(
    form: str,
    *,
    at: ca.SX,
    along: ca.SX,
    radius: ca.SX,
    tip: ca.SX,
    direction: ca.SX,
    side: ca.SX,
) -> ca.SX:
    """Reading of a ball or a blade on a rod, [m]."""
    if form == "ball":
        return touch_by_ball(at=at, along=along, radius=radius, tip=tip, direction=direction)
    return touch_by_blade(
        at=at, along=along, radius=radius, edge=side, tip=tip, direction=direction
    )


@lru_cache
def _touching(form: str) -> ca.Function:
    """Reading as a function of rods, one per column."""
    names = ("at", "along", "radius", "tip", "direction", "side")
    symbols = {n: ca.SX.sym(n, 1 if n == "radius" else 3) for n in names}
    return ca.Function("touching", list(symbols.values()), [_touch(form, **symbols)])


class RodByBall(RodIndicator):
    """Rod indicator with a ball. Sensors of one class share one expression."""

    __slots__ = ()


class RodByBlade(RodIndicator):
    """Rod indicator with a blade."""

    __slots__ = ()
