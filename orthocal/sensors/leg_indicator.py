"""Indicator on the base that measures the centre line of a leg, or a rod with a blade or a ball.

The line model is that of the paper. The gauge touches the leg where its centre line, from root to
tip, crosses the plane of the section. For a plunger square to the leg the reading is the coordinate
of this point along the plunger:

    h = d · (root + t (tip − root)),  t = (c − a · root)/(a · (tip − root))

with d the direction of the plunger, a the nominal axis of the leg and c the coordinate of the plane
along a. c refers to the world origin, or to the root in the reference posture (the paper's X-leg
midpoint, section 3.2). The model equals a blade on a rod of radius 0. At reading 0 the tip is on
the axis of the nominal rod in the mechanical zero, at the section of the setup. The gauge zero
contains the actual distance of the tip from this point along the plunger.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, Any, ClassVar, Literal, cast, get_args

import casadi as ca
import numpy as np
from pydantic import Field, field_validator

from orthocal.arrays import Array, triple
from orthocal.errors import SessionError
from orthocal.io.documents import Name, Number, OneKey
from orthocal.robot.model import Leg, Robot, Rod
from orthocal.sensors.direction import (
    DIRECTIONS,
    Direction,
    check_direction,
    direction_name,
    direction_vector,
    side_vector,
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
from orthocal.units import MM, show_mm, to_mm

Matrix = Any
"""Matrix of CasADi, of symbols or numbers, or array of NumPy."""

SectionForm = Literal["coordinate_mm", "from_root_mm", "fraction"]
"""Key that states a section."""

OBLIQUITY_DEG = {"line": 1.0, "ball": 30.0, "blade": 10.0}
"""Largest deviation of a plunger from square to the nominal leg in the mechanical zero, [°]. A line
has no surface for an oblique plunger. At larger angles a rod pushes the plunger aside, and a blade
touches with its back."""

LARGEST_BESIDE_MM = 500.0
"""Largest accepted displacement across the leg, [mm]; a larger one has a wrong unit."""

EDGE = Tip("blade", 0.0)
"""Tip of the line model and of virtual sensors: an edge across leg and plunger."""

BESIDE_ROUNDING = 1e-5
"""Largest component of `beside` along leg or plunger that may be a rounding error, [m]."""

LATERAL_DECIMALS = 9
"""Decimals of the lateral position of a centred ball in m; further ones are rounding errors."""

Displacement = Annotated[Number, Field(ge=-LARGEST_BESIDE_MM, le=LARGEST_BESIDE_MM)]


class SectionKeys(OneKey):
    """Section: position along the leg's nominal axis at which the gauge touches."""

    coordinate_mm: Number | None = None
    """World coordinate along the axis of the leg."""
    from_root_mm: Number | None = None
    """Distance from the root in the mechanical zero."""
    fraction: Number | None = None
    """Distance from the root in the mechanical zero, as a fraction of the leg length."""


class LegIndicatorKeys(MountingKeys, SetupKeys):
    """Keys of a setup with an indicator on a leg, as in a session.yaml."""

    leg: Name
    direction: str | Annotated[list[Number], Field(min_length=3, max_length=3)]
    section: SectionKeys
    touches: str | None = None
    """Rod of the leg that the tip touches; None for the centre line between the rods."""
    tip: TipKeys | None = None
    beside_mm: Annotated[list[Displacement], Field(min_length=3, max_length=3)] | None = None
    """Displacement of the tip from the rod in the mechanical zero, across leg and plunger, in the
    world frame. By default a ball is centred on the rod in the alignment posture; a blade is not
    displaced."""

    @field_validator("direction", mode="before")
    @classmethod
    def _require_name_or_vector(cls, value: object) -> object:
        """Refuse a direction that is neither text nor three numbers."""
        is_vector = isinstance(value, list) and len(value) == 3 and all(map(_is_number, value))
        if not is_vector and not isinstance(value, str):
            raise ValueError(
                f"found {value}; expected one of {', '.join(DIRECTIONS)}, or a vector of three "
                "numbers such as [0, 1, 1]"
            )
        return value


def _is_number(value: object) -> bool:
    """True for a finite number; a bool, which Python counts as an integer, is none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


@dataclass(frozen=True, slots=True)
class Section:
    """Section: position along the leg's nominal axis at which the gauge touches."""

    form: SectionForm
    """Key that states the section."""
    value: float
    """World coordinate [m], distance from the root at the mechanical zero [m], or fraction [1]."""

    def __post_init__(self) -> None:
        if self.form not in get_args(SectionForm):
            expected = ", ".join(get_args(SectionForm))
            raise ValueError(f"form: found {self.form!r}; expected one of {expected}")

    @staticmethod
    def from_keys(keys: SectionKeys) -> Section:
        """Build from the keys of a session.yaml."""
        form, value = keys.stated
        return Section(cast(SectionForm, form), value if form == "fraction" else value * MM)

    def to_keys(self) -> dict[str, float]:
        """Keys for a session.yaml."""
        return {self.form: self.value if self.form == "fraction" else to_mm(self.value)}

    def describe(self, driven: str) -> str:
        """Description of the position.

        Args:
            driven: Noun for the part that the drive moves, with a reference to the mechanical zero.
        """
        if self.form == "coordinate_mm":
            return f"coordinate {show_mm(self.value)} mm"
        if self.form == "fraction":
            return f"{self.value:.3g} of its length from the {driven}"
        return f"{show_mm(self.value)} mm from its hinge on the {driven}"


@dataclass(frozen=True, slots=True)
class LegIndicator:
    """Indicator on the centre line of a leg, or with a blade on one of its rods.

    Raises:
        ValueError: If the tip is a ball, which needs a `BallIndicator`, or the reverse.
    """

    leg: str
    """Name of the measured leg."""
    direction: Direction
    """Direction of a growing reading: x, y, z, -x, -y or -z of the world frame, or a vector."""
    section: Section
    """Section in which the gauge touches."""
    mounting: Mounting = USUAL
    """Mounting uncertainty."""
    rod: str | None = None
    """Rod that the tip touches; None for the centre line of the leg."""
    tip: Tip = EDGE
    """Tip of the plunger; EDGE for the centre line."""
    beside: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Displacement of the tip from the nominal rod in the mechanical zero, shape (3,), [m]."""

    kind: ClassVar[str] = "leg"
    keys: ClassVar[type[SetupKeys]] = LegIndicatorKeys
    ideal: ClassVar[str] = "parallel"
    touch: ClassVar[Callable[..., ca.SX]] = touch_by_blade
    """Function of a rod and the tip that returns the reading, such as `touch_by_blade`."""

    def __post_init__(self) -> None:
        if (self.tip.form == "ball") != isinstance(self, BallIndicator):
            raise ValueError(f"tip: found a {self.tip.form}; `on_rod` makes an indicator with it")

    @classmethod
    def from_keys(cls, keys: LegIndicatorKeys) -> LegIndicator:
        """Build from the keys of a session.yaml.

        Raises:
            SessionError: If a rod is stated without a tip, or a displacement without a rod.
        """
        stated = keys.direction
        direction = stated if isinstance(stated, str) else triple(stated)
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
        beside = triple(keys.beside_mm or (0.0, 0.0, 0.0), MM)
        return indicator.on_rod(keys.touches, Tip.from_keys(keys.tip), beside)

    def on_rod(
        self, rod: str, tip: Tip, beside: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> LegIndicator:
        """Indicator with a tip on one of the leg's rods.

        Args:
            rod: Name of the rod.
            tip: The tip.
            beside: Displacement of the tip from the nominal rod, shape (3,), [m].
        """
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
        """Refuse a leg, rod, direction or section that does not fit the robot.

        Raises:
            SessionError: If the setup does not fit; names the key.
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
        """Refuse an unknown rod, and a displacement that is not across leg and plunger.

        Raises:
            SessionError: If one of them does not fit; names the key.
        """
        rods, side = robot.legs[self.leg].rods, self._side(robot)
        if rod not in rods:
            hint = f"; rods: {', '.join(rods)}" if rods else ": it has none in the robot's YAML"
            raise SessionError(
                f"'{rod}' is not a rod of leg {self.leg}{hint}", where=f"{where}.touches"
            )
        if np.abs(np.cross(self.beside, side)).max() > BESIDE_ROUNDING:
            stated = ", ".join(f"{v / MM:g}" for v in self.beside)
            across = ", ".join(f"{v:.3g}" for v in side)
            raise SessionError(
                f"found [{stated}]; expected a multiple of ({across}), across leg and plunger",
                where=f"{where}.beside_mm",
            )

    @property
    def place(self) -> tuple[str, str]:
        """Measured leg."""
        return "leg", self.leg

    def describe(self) -> str:
        """Short description with leg, direction and section, and with rod and tip."""
        return self.describe_from("slide")

    def describe_from(self, driven: str) -> str:
        """Short description with a noun for the part from which the section is counted.

        Args:
            driven: Noun for the part that the drive moves, with a reference to the mechanical zero.
        """
        direction = direction_name(self.direction)
        words = f"leg {self.leg}, gauge in {direction}, at {self.section.describe(driven)}"
        if self.rod is not None:
            words += f", {self.tip.form} on rod {self.rod}"
        offsets = [
            f"{show_mm(abs(v))} mm towards {'+' if v > 0.0 else '−'}{axis}"
            for axis, v in zip("xyz", self.beside, strict=True)
            if show_mm(v) != "0"
        ]
        if offsets:
            words += f", off its centre line by {' and '.join(offsets)}"
        return words

    def frames(self, robot: Robot) -> Frames:
        """Ends of the leg or rod, and the leg's root in the reference posture.

        The root is included only if drives alone move it.
        """
        leg = robot.legs[self.leg]
        line = leg if self.rod is None else leg.rods[self.rod]
        return Frames((line.root, line.tip), (leg.root,) if leg.root_driven else ())

    def constants(self, robot: Robot) -> Array:
        """Constants of the expression, shape (15,), [m].

        Direction (3); plane of the section (1); 1 if the plane refers to the root, else 0 (1);
        axis of the leg (3); edge of the blade (3); position of the tip across the leg (3); sum of
        the radii of rod and tip (1).
        """
        leg = robot.legs[self.leg]
        plane, from_root = self.plane(robot)
        across, radius = np.zeros(3), 0.0
        if self.rod is not None:
            rod = leg.rods[self.rod]
            radius = rod.radius + self.tip.radius
            fraction = self.fraction_at_zero(robot, rod)
            point = rod.reference_root + fraction * (rod.reference_tip - rod.reference_root)
            across = point - (leg.axis @ point) * leg.axis + self.beside
        direction, side = direction_vector(self.direction), self._side(robot)
        return np.array([*direction, plane, float(from_root), *leg.axis, *side, *across, radius])

    @property
    def nuisance_parameters(self) -> tuple[NuisanceParameter, ...]:
        """Nuisance parameters of the mounting."""
        return self.mounting.nuisance_parameters(ball=self.tip.form == "ball")

    def aligned_to(self, robot: Robot) -> Mapping[str, Sensor]:
        """Virtual sensor of the lateral position of a ball; empty for other tips."""
        if self.tip.form != "ball":
            return {}
        side = triple(self._side(robot))
        return {"lateral": LegIndicator(self.leg, side, self.section, EXACT, self.rod)}

    def expression(self, view: View, robot: Robot) -> ca.SX:
        """Reading with the gauge zero at 0, [m]."""
        del robot
        root, end = (pose.position for pose in view.frames)
        c = view.constants
        direction, axis, side, start = _place_gauge(c, [pose.position for pose in view.at_zero])
        shift, plunger, edge, scale = mount(
            self.nuisance_parameters, view.nuisance, direction=direction, side=side, axis=axis
        )
        reading = type(self).touch(root, end - root, c[14], start + shift, plunger, edge)
        return ca.SX(scale * reading)

    def contact(self, frames: Sequence[Array], at_zero: Sequence[Array], robot: Robot) -> Contact:
        """Points of contact in K postures.

        These are points of the rod's surface, or of the centre line in the plane of the section.
        """
        constants = self.constants(robot)
        direction, axis, side, start = _place_gauge(constants, [pose[:3, 3] for pose in at_zero])
        roots, ends = (pose[:, :3, 3] for pose in frames)
        if self.rod is None:
            fraction = ((start - roots) @ axis) / ((ends - roots) @ axis)
            points, tip = roots + fraction[:, None] * (ends - roots), None
            length = robot.legs[self.leg].length
            problems = [_end_problem("leg", t * length, length) for t in fraction.tolist()]
        else:
            tip = TouchingTip(
                self.tip.radius, None if self.tip.form == "ball" else side, self.tip.width
            )
            points, problems = self._rod_contact(roots, ends, start, direction, side, constants[14])
        return Contact(points, direction, axis, problems, "section", tip)

    def _rod_contact(
        self,
        roots: Array,
        ends: Array,
        start: Array,
        direction: Array,
        side: Array,
        radius: float,
    ) -> tuple[Array, list[str]]:
        """Points of contact with a rod in K postures.

        Args:
            roots: Roots of the rod, shape (K, 3), [m].
            ends: Far ends of the rod, shape (K, 3), [m].
            start: Position of the tip at reading 0, shape (3,), [m].
            direction: Unit vector of the plunger, shape (3,).
            side: Unit vector across leg and plunger, shape (3,).
            radius: Sum of the radii of rod and tip, [m].

        Returns:
            Points of the rod's surface, shape (K, 3), [m], and reasons why the tip cannot touch.
        """
        along = ends - roots
        lengths = np.linalg.norm(along, axis=1)
        units = along / lengths[:, None]
        touch = _touch_function(type(self).touch)
        h = np.asarray(touch(roots.T, along.T, radius, start, direction, side))[0]
        across = np.cross(units, direction)
        lateral = np.einsum("ki,ki->k", across, start - roots) / np.linalg.norm(across, axis=1)
        centres = start + h[:, None] * direction
        if self.tip.form == "blade":
            # The edge is a radius away from the rod's axis, along the normal n of both. With the
            # edge e and the axis u, the root is centre + s₀ e − s₁ u + s₂ n: the contact is s₀ from
            # the middle of the blade and s₁ from the root.
            normals = np.cross(side, units)
            normals *= (np.sign(normals @ direction) / np.linalg.norm(normals, axis=1))[:, None]
            edges = np.broadcast_to(side, units.shape)
            frames = np.stack([edges, -units, normals], axis=2)
            shifts = np.linalg.solve(frames, (roots - centres)[:, :, None])[:, :, 0]
            feet, off_middle = roots + shifts[:, 1:2] * units, np.abs(shifts[:, 0])
        else:
            feet = roots + np.einsum("ki,ki->k", centres - roots, units)[:, None] * units
            normals, off_middle = centres - feet, np.zeros(len(roots))
            normals /= np.linalg.norm(normals, axis=1)[:, None]
        surface = feet + (radius - self.tip.radius) * normals
        distances = np.einsum("ki,ki->k", feet - roots, units)
        problems = []
        for k, distance in enumerate(distances.tolist()):
            if not np.isfinite(h[k]):  # of a ball that passes the rod
                surface[k] = start
                problems.append(
                    f"the ball would pass the rod: it is {abs(lateral[k]) / MM:.1f} mm beside its "
                    f"axis, and they touch up to {radius / MM:.1f} mm"
                )
            else:
                problems.append(self._contact_problem(off_middle[k], distance, lengths[k]))
        return surface, problems

    def _contact_problem(self, off_middle: float, distance: float, length: float) -> str:
        """Reason why the tip cannot touch a rod; empty if it can.

        Args:
            off_middle: Distance of the contact from the middle of the blade, [m].
            distance: Distance of the contact from the root of the rod, [m].
            length: Length of the rod, [m].
        """
        if off_middle > 0.5 * self.tip.width and self.tip.form == "blade":
            return (
                f"the blade would slide off: it would touch {off_middle / MM:.1f} mm from its "
                f"middle, and is {self.tip.width / MM:.1f} mm wide"
            )
        return _end_problem("rod", distance, length)

    def plane(self, robot: Robot, *, where: str = "") -> tuple[float, bool]:
        """Plane of the section across the leg, a · p = c or a · p = c + a · root.

        Args:
            robot: The robot.
            where: File and key, for messages.

        Returns:
            Coordinate c of the plane along the leg's axis a (from root to tip), [m], and whether it
            refers to the root in the reference posture.

        Raises:
            SessionError: If the form of the section does not fit the leg.
        """
        leg = robot.legs[self.leg]
        form, value = self.section.form, self.section.value
        if form == "coordinate_mm":
            return _coordinate_plane(leg, value, where), False
        if not leg.root_driven:
            raise SessionError(
                f"the root of leg {leg.name} moves with passive joints; state coordinate_mm",
                where=where,
            )
        return (value * leg.length if form == "fraction" else value), True

    def fraction_at_zero(self, robot: Robot, rod: Rod) -> float:
        """Position of the section along a nominal rod in the mechanical zero, from 0 to 1 (tip)."""
        leg = robot.legs[self.leg]
        plane, from_root = self.plane(robot)
        coordinate = plane + (float(leg.axis @ leg.reference_root) if from_root else 0.0)
        along = rod.reference_tip - rod.reference_root
        return float((coordinate - leg.axis @ rod.reference_root) / (leg.axis @ along))

    def _side(self, robot: Robot) -> Array:
        """Unit vector across leg and plunger, shape (3,): the direction of a blade's edge."""
        return side_vector(triple(robot.legs[self.leg].axis), self.direction)


class BallIndicator(LegIndicator):
    """Indicator with a ball on a rod of a leg.

    It has its own class, because sensors of one class share one expression.
    """

    __slots__ = ()
    touch = touch_by_ball

    def centred(
        self, frames: Sequence[Array], at_zero: Sequence[Array], robot: Robot
    ) -> LegIndicator:
        """Indicator whose ball is in the plane of plunger and rod.

        Args:
            frames: Poses of the rod's ends in the alignment posture, shape (1, 4, 4) each.
            at_zero: Pose of the leg's root in the reference posture, if drives alone move it.
            robot: The robot.
        """
        at_rod = replace(self, beside=(0.0, 0.0, 0.0))
        direction, _, side, start = _place_gauge(
            at_rod.constants(robot), [pose[:3, 3] for pose in at_zero]
        )
        root, end = (pose[0, :3, 3] for pose in frames)
        normal = np.cross(end - root, direction)
        distance = float((root - start) @ normal / (side @ normal))
        beside = triple([round(distance * v, LATERAL_DECIMALS) for v in side.tolist()])
        return replace(self, beside=beside)


def _end_problem(part: str, distance: float, length: float) -> str:
    """Reason why a gauge cannot touch beyond an end of a leg or rod; empty between its ends.

    Args:
        part: Leg or rod.
        distance: Distance of the contact from the root, [m].
        length: Length of the part, [m].
    """
    if 0.0 <= distance <= length:
        return ""
    return (
        f"the gauge would touch at {distance / MM:.1f} mm from the root; the {part} reaches from 0 "
        f"to {length / MM:.1f} mm"
    )


def _coordinate_plane(leg: Leg, value: float, where: str) -> float:
    """Coordinate along the leg's axis of a plane at a world coordinate, [m].

    Raises:
        SessionError: If the leg is not along a world axis.
    """
    axis = int(np.abs(leg.axis).argmax())
    if abs(leg.axis[axis]) < 1.0 - 1e-9:
        raise SessionError(
            f"leg {leg.name} is not along a world axis; state from_root_mm or fraction",
            where=where,
        )
    return float(np.sign(leg.axis[axis]) * value)


def _place_gauge(
    constants: Matrix, at_zero: Sequence[Matrix]
) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Nominal gauge from the constants of its expression.

    Args:
        constants: Result of `LegIndicator.constants`.
        at_zero: Root of the leg in the reference posture, shape (3,), [m], if drives alone move it;
            otherwise empty.

    Returns:
        Unit vectors of plunger, leg and blade's edge, and position of the tip at reading 0, [m];
        shape (3,) each.
    """
    direction, plane, axis = constants[:3], constants[3], constants[5:8]
    for root in at_zero:
        plane = plane + constants[4] * (axis.T @ root)
    return direction, axis, constants[8:11], plane * axis + constants[11:14]


@cache
def _touch_function(touch: Callable[..., ca.SX]) -> ca.Function:
    """Numeric function of the reading of a tip; arguments may have a column for each posture."""
    symbols = [ca.SX.sym("s", n) for n in (3, 3, 1, 3, 3, 3)]  # as in `touch_by_blade`
    return ca.Function("touching", symbols, [touch(*symbols)])
