"""An indicator on the base that measures a leg: its line, or a round rod with a blade or a ball.

The line model is the paper's. The gauge touches the leg where its line, from root to tip, crosses
the plane of the section, like an edge across leg and plunger. If the plunger is square to the leg,
the reading is the coordinate of that point along the direction of the plunger:

    h = d · (root + t (tip − root)),  t = (c − a · root)/(a · (tip − root))

with a the leg's nominal axis and c the plane: a world coordinate, or counted from the root in the
reference posture (the paper's X-leg midpoint, section 3.2). It is a blade on a rod without a
radius. At reading 0 the tip on a rod is on the axis of the nominal rod in the mechanical zero, at
the section of the setup; the gauge zero contains its distance from there along the plunger.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, ClassVar, Literal, get_args

import casadi as ca
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from orthocal.arrays import Array
from orthocal.errors import SessionError
from orthocal.io.documents import Name, Number
from orthocal.robot.model import Leg, Robot
from orthocal.sensors.direction import (
    DIRECTIONS,
    Direction,
    check_direction,
    direction_name,
    direction_vector,
)
from orthocal.sensors.mounting import EXACT, USUAL, Mounting, MountingKeys, mount
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

Matrix = Any
"""Symbols or numbers of CasADi, or arrays."""

SectionForm = Literal["coordinate_mm", "from_root_mm", "fraction"]
"""Key that states a section."""

OBLIQUITY_DEG = {"line": 1.0, "ball": 30.0, "blade": 10.0}
"""Largest deviation of a plunger from square to the nominal leg at the mechanical zero. A line has
no surface for an oblique plunger. A rod pushes the plunger aside, and a blade touches with its
back."""

LARGEST_BESIDE_MM = 500.0
"""Largest displacement across the leg; a larger one has a wrong unit."""

EDGE = Tip("blade", 0.0)
"""Tip of the line model and of virtual sensors: a view along the plunger."""

NOT_ACROSS = 1e-5
"""Largest component of `beside` along leg or plunger, [m]: rounding."""

Millimetres = Annotated[Number, Field(ge=-LARGEST_BESIDE_MM, le=LARGEST_BESIDE_MM)]


class SectionKeys(BaseModel):
    """Section: position along the leg's nominal axis at which the gauge touches."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    coordinate_mm: Number | None = None
    from_root_mm: Number | None = None
    fraction: Number | None = None

    @model_validator(mode="after")
    def _one_form(self) -> SectionKeys:
        forms = get_args(SectionForm)
        stated = [k for k in forms if getattr(self, k) is not None]
        if len(stated) != 1:
            text = " and ".join(stated) if stated else "none"
            raise ValueError(f"found {text}; expected one of {', '.join(forms)}")
        return self


class LegKeys(MountingKeys, SetupKeys):
    """Keys of a setup with an indicator on a leg, as in a session.yaml."""

    leg: Name
    direction: str | Annotated[list[Number], Field(min_length=3, max_length=3)]
    section: SectionKeys
    touches: str | None = None
    """Rod of the leg that the tip touches; by default the line between the rods."""
    tip: TipKeys | None = None
    beside_mm: Annotated[list[Millimetres], Field(min_length=3, max_length=3)] | None = None
    """Displacement of the tip from the rod in the mechanical zero: across leg and plunger, in the
    world. For readings in postures in which the rod lies elsewhere."""

    @field_validator("direction", mode="before")
    @classmethod
    def _name_or_vector(cls, value: object) -> object:
        vector = isinstance(value, list) and len(value) == 3 and all(map(_is_number, value))
        if not vector and not isinstance(value, str):
            raise ValueError(
                f"found {value}; expected one of {', '.join(DIRECTIONS)}, or a vector of three "
                "numbers such as [0, 1, 1]"
            )
        return value


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


@dataclass(frozen=True, slots=True)
class Section:
    """Section: position along the leg's nominal axis at which the gauge touches."""

    form: SectionForm
    value: float
    """World coordinate [m], distance from the root at the mechanical zero [m], or fraction [1]."""

    @staticmethod
    def from_keys(keys: SectionKeys) -> Section:
        """Build from the keys of a session.yaml."""
        form = next(f for f in get_args(SectionForm) if getattr(keys, f) is not None)
        value = getattr(keys, form)
        return Section(form, value if form == "fraction" else value * MM)

    def to_keys(self) -> dict[str, float]:
        """Keys for a session.yaml."""
        return {self.form: self.value if self.form == "fraction" else to_mm(self.value)}

    def describe(self) -> str:
        """The position in words."""
        if self.form == "fraction":
            return f"{self.value:g} of its length from the slide"
        from_root = " from its hinge on the slide" if self.form == "from_root_mm" else ""
        return f"{'' if from_root else 'coordinate '}{self.value / MM:g} mm{from_root}"


@dataclass(frozen=True, slots=True)
class LegIndicator:
    """An indicator on the line of a leg, or with a blade on one of its rods."""

    leg: str
    direction: Direction
    """Direction of a growing reading: x, y, z, -x, -y or -z of the world, or a vector."""
    section: Section
    mounting: Mounting = USUAL
    rod: str | None = None
    """Rod that it touches; None for the line of the leg."""
    tip: Tip = EDGE
    beside: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Displacement of the tip from the nominal rod in the mechanical zero, [m]."""

    kind: ClassVar[str] = "leg"
    keys: ClassVar[type[SetupKeys]] = LegKeys
    ideal: ClassVar[str] = "parallel"
    touch: ClassVar[Callable[..., ca.SX]] = touch_by_blade
    """Reading of its tip on a rod."""

    def __post_init__(self) -> None:
        if (self.tip.form == "ball") != isinstance(self, BallIndicator):
            raise ValueError(f"tip: found a {self.tip.form}; `on_rod` makes an indicator with it")

    @classmethod
    def from_keys(cls, keys: LegKeys) -> LegIndicator:
        """Build from the keys of a session.yaml.

        Raises:
            SessionError: If a rod is touched without a tip, or a line is displaced.
        """
        d = keys.direction
        direction = d if isinstance(d, str) else (d[0], d[1], d[2])
        section, mounting = Section.from_keys(keys.section), Mounting.from_keys(keys)
        indicator = LegIndicator(keys.leg, direction, section, mounting)
        if keys.touches is None:
            if keys.beside_mm is not None:
                raise SessionError(
                    "found without `touches`, a rod; expected one", where="beside_mm"
                )
            return indicator
        if keys.tip is None:
            raise SessionError("is missing; expected ball or blade", where="tip")
        x, y, z = keys.beside_mm or (0.0, 0.0, 0.0)
        return indicator.on_rod(keys.touches, Tip.from_keys(keys.tip), (x * MM, y * MM, z * MM))

    def on_rod(
        self, rod: str, tip: Tip, beside: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> LegIndicator:
        """The indicator with a tip on one of the leg's rods."""
        kind = BallIndicator if tip.form == "ball" else LegIndicator
        return kind(self.leg, self.direction, self.section, self.mounting, rod, tip, beside)

    def to_keys(self) -> dict[str, Any]:
        """Keys for a session.yaml."""
        direction = self.direction if isinstance(self.direction, str) else list(self.direction)
        keys: dict[str, Any] = {"leg": self.leg, "direction": direction}
        keys |= {"section": self.section.to_keys(), **self.mounting.to_keys()}
        if self.rod is not None:
            keys |= {"touches": self.rod, "tip": self.tip.to_keys()}
        if any(self.beside):
            keys["beside_mm"] = [to_mm(v) for v in self.beside]
        return keys

    def require_fit(self, robot: Robot, *, where: str) -> None:
        """Refuse a leg, rod, direction or section that the robot does not have.

        Raises:
            SessionError: Naming the key.
        """
        if not robot.legs:
            raise SessionError(
                f"'{robot.name}' has no legs for a gauge to touch; add orthocal.legs to "
                f"{robot.yaml}",
                where=f"{where}.leg",
            )
        if self.leg not in robot.legs:
            raise SessionError(
                f"'{self.leg}' is not a leg of {robot.name}; legs: {', '.join(robot.legs)}",
                where=f"{where}.leg",
            )
        form = "line" if self.rod is None else self.tip.form
        check_direction(
            self.direction, robot.legs[self.leg], OBLIQUITY_DEG[form], where=f"{where}.direction"
        )
        if self.section.form == "fraction" and not 0.0 <= self.section.value <= 1.0:
            raise SessionError(
                f"found {self.section.value:g}; expected 0 (root) to 1 (tip)",
                where=f"{where}.section.fraction",
            )
        self.plane(robot, where=f"{where}.section")
        if self.rod is not None:
            self._require_rod(self.rod, robot, where)

    def _require_rod(self, rod: str, robot: Robot, where: str) -> None:
        rods, side = robot.legs[self.leg].rods, self._side(robot)
        if rod not in rods:
            hint = f"; rods: {', '.join(rods)}" if rods else ": it has none in the robot's YAML"
            raise SessionError(
                f"'{rod}' is not a rod of leg {self.leg}{hint}", where=f"{where}.touches"
            )
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
        """Leg, direction and section; rod and tip."""
        direction = direction_name(self.direction)
        words = f"leg {self.leg}, gauge in {direction}, at {self.section.describe()}"
        if self.rod is not None:
            words += f", {self.tip.form} on rod {self.rod}"
        if any(self.beside):
            offset = " ".join(
                f"{axis} {v / MM:+g}" for axis, v in zip("xyz", self.beside, strict=True) if v
            )
            words += f", beside the rod at the mechanical zero: {offset} mm"
        return words

    def frames(self, robot: Robot) -> Frames:
        """Ends of the line; the leg's root in the reference posture for sections from the root."""
        leg = robot.legs[self.leg]
        line = leg if self.rod is None else leg.rods[self.rod]
        return Frames((line.root, line.tip), (leg.root,) if leg.root_driven else ())

    def constants(self, robot: Robot) -> Array:
        """Direction (3), plane (1), 1 if it counts from the root else 0, axis of the leg (3).

        Then blade edge (3), tip across the leg (3) and radii of rod and tip (1).
        """
        leg = robot.legs[self.leg]
        plane, from_root = self.plane(robot)
        across, radius = np.zeros(3), 0.0
        if self.rod is not None:
            rod = leg.rods[self.rod]
            radius = rod.radius + self.tip.radius
            # on the nominal rod in the mechanical zero
            at = plane + (float(leg.axis @ leg.reference_root) if from_root else 0.0)
            along = rod.reference_tip - rod.reference_root
            share = (at - leg.axis @ rod.reference_root) / (leg.axis @ along)
            point = rod.reference_root + share * along
            across = point - (leg.axis @ point) * leg.axis + self.beside
        direction, side = direction_vector(self.direction), self._side(robot)
        return np.array([*direction, plane, float(from_root), *leg.axis, *side, *across, radius])

    @property
    def nuisance_parameters(self) -> tuple[NuisanceParameter, ...]:
        """Nuisance parameters of the mounting."""
        return self.mounting.nuisance_parameters(ball=self.tip.form == "ball")

    def aligned_to(self, robot: Robot) -> Mapping[str, Sensor]:
        """Virtual sensor of the lateral position: the operator centres a ball on the rod."""
        if self.tip.form != "ball":
            return {}
        x, y, z = self._side(robot).tolist()
        return {"lateral": LegIndicator(self.leg, (x, y, z), self.section, EXACT, self.rod)}

    def expression(self, view: View, robot: Robot) -> ca.SX:
        """Reading with the gauge zero at 0, [m]."""
        del robot
        root, end = (pose.position for pose in view.frames)
        c = view.constants
        direction, axis, side, start = _place(c, [pose.position for pose in view.at_zero])
        gauge = mount(
            self.nuisance_parameters, view.nuisance, direction=direction, side=side, axis=axis
        )
        reading = type(self).touch(
            root, end - root, c[14], start + gauge.displacement, gauge.direction, gauge.edge
        )
        return ca.SX(gauge.scale * reading)

    def contact(self, frames: Sequence[Array], at_zero: Sequence[Array], robot: Robot) -> Contact:
        """Points in which the tip touches the rod's surface, or the line the section's plane."""
        constants = self.constants(robot)
        direction, axis, side, start = _place(constants, [pose[:3, 3] for pose in at_zero])
        roots, ends = (pose[:, :3, 3] for pose in frames)
        if self.rod is None:
            share = ((start - roots) @ axis) / ((ends - roots) @ axis)
            points, tip = roots + share[:, None] * (ends - roots), None
            length = robot.legs[self.leg].length / MM
            problems = [
                ""
                if 0.0 <= t <= 1.0
                else f"the gauge would touch at {t * length:.1f} mm from the root; the leg reaches "
                f"from 0 to {length:.1f} mm"
                for t in share.tolist()
            ]
        else:
            tip = TouchingTip(
                self.tip.radius, None if self.tip.form == "ball" else side, self.tip.width
            )
            points, problems = self._meet(roots, ends, start, direction, side, constants[14])
        return Contact(points, direction, axis, problems, "section", tip)

    def _meet(
        self,
        roots: Array,
        ends: Array,
        start: Array,
        direction: Array,
        side: Array,
        radius: float,
    ) -> tuple[Array, list[str]]:
        """Points of contact in K postures, (K, 3), and reasons why the tip cannot touch."""
        along = ends - roots
        lengths = np.linalg.norm(along, axis=1)
        units = along / lengths[:, None]
        h = np.asarray(_touching(self.tip.form)(roots.T, along.T, radius, start, direction, side))[
            0
        ]
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
        surface = feet + (radius - self.tip.radius) * normals
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

    def plane(self, robot: Robot, *, where: str = "") -> tuple[float, bool]:
        """Plane of the section across the leg, a · p = plane (+ a · root).

        Args:
            robot: The robot.
            where: File and key, for messages.

        Returns:
            Coordinate of the plane along the leg's axis a (from root to tip), [m], and whether it
            counts from the root in the reference posture.

        Raises:
            SessionError: If the section's form does not fit the leg.
        """
        leg = robot.legs[self.leg]
        form, value = self.section.form, self.section.value
        if form == "coordinate_mm":
            return _coordinate_plane(leg, value, where), False
        if not leg.root_driven:
            raise SessionError(
                f"the root of leg {leg.name} moves with passive joints; give coordinate_mm",
                where=where,
            )
        return (value * leg.length if form == "fraction" else value), True

    def _side(self, robot: Robot) -> Array:
        """Unit vector across leg and plunger: the edge of a blade."""
        side = np.cross(robot.legs[self.leg].axis, direction_vector(self.direction))
        return np.asarray(side / np.linalg.norm(side))


class BallIndicator(LegIndicator):
    """An indicator with a ball on a rod of a leg. Sensors of one class share one expression."""

    __slots__ = ()
    touch = touch_by_ball


def _coordinate_plane(leg: Leg, value: float, where: str) -> float:
    axis = int(np.abs(leg.axis).argmax())
    if abs(leg.axis[axis]) < 1.0 - 1e-9:
        raise SessionError(
            f"leg {leg.name} does not lie along a world axis; give from_root_mm or fraction",
            where=where,
        )
    return float(np.sign(leg.axis[axis]) * value)


def _place(constants: Matrix, at_zero: Sequence[Matrix]) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Direction, axis of the leg, edge, and tip at reading 0, shape (3,) each.

    Args:
        constants: As `LegIndicator.constants` returns them.
        at_zero: Root of the leg in the reference posture, shape (3,), [m], if drives alone move it.
    """
    direction, plane, axis = constants[:3], constants[3], constants[5:8]
    for root in at_zero:
        plane = plane + constants[4] * (axis.T @ root)
    return direction, axis, constants[8:11], plane * axis + constants[11:14]


@cache
def _touching(form: str) -> ca.Function:
    """Reading as a function of rods, one per column."""
    symbols = [ca.SX.sym("s", n) for n in (3, 3, 1, 3, 3, 3)]
    touch = touch_by_ball if form == "ball" else touch_by_blade
    return ca.Function("touching", symbols, [touch(*symbols)])
