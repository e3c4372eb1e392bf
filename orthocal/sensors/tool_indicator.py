"""Indicator at the tool, on a straightedge, a square, a surface plate or a gauge block.

The artefact lies on the table. Its surface is a plane with normal n, nominally the direction d of
the plunger. The tip q and the plunger's direction u move with the tool:

    h = (1 + s) ((n · q + H) / (n · u) + f(q))

H is the height of a gauge block under the tip, and 0 beside it. Yaw, about the axis square to
artefact and plunger, and roll, about the artefact, turn n. f is a deviation from straight or flat:
Legendre polynomials of degree 2 and 3 along an edge, of degree 2 over a plate. All are nuisance
parameters, and the gauge zero is free.

The arms of one square share its yaw, and enclose a right angle with an error. A square, or a
straightedge, that is turned over shows its errors with the opposite sign (reversal).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import casadi as ca
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from orthocal.arrays import Array
from orthocal.errors import SessionError
from orthocal.io.documents import Name, Number, PositiveNumber
from orthocal.robot.model import Robot, require_tcp
from orthocal.sensors.direction import direction_vector
from orthocal.sensors.mounting import SCALE, rotate
from orthocal.sensors.protocol import (
    DIMENSION_STEP,
    Contact,
    Frames,
    NuisanceParameter,
    Sensor,
    SetupKeys,
    ToolSensor,
    View,
)
from orthocal.units import MM, MRAD, read_limit, show_limit, tidy, to_mm

ALIGNMENT = 5.0 * MRAD
"""Direction of an artefact that was aligned by eye along an axis of the machine, [rad]."""

LENGTH_MM = 200.0
"""Length of the artefact that is used, by default."""

BLADE, BLOCK = 20 * MM, (35 * MM, 9 * MM)
"""Width of a blade, length and width of a gauge block in pictures, [m]."""

LARGEST_MM = 2000.0

Kind = Literal["straightedge", "square", "plate", "gauge_block"]
Axis = Literal["x", "y", "z"]
Point = Annotated[
    list[Annotated[Number, Field(ge=-LARGEST_MM, le=LARGEST_MM)]], Field(min_length=3, max_length=3)
]
Millimetres = Annotated[Number, Field(ge=0.0, le=40.0)]
Milliradians = Annotated[Number, Field(ge=0.0, le=400.0)]
Length = Annotated[PositiveNumber, Field(le=LARGEST_MM)]

STRAIGHT = ("straight_2", "straight_3")
"""Deviations of an edge: Legendre polynomials of degree 2 and 3."""


def flat_terms(degree: int) -> tuple[str, ...]:
    """Deviations of a plane: products of Legendre polynomials along its axes, degree 2 or more."""
    return tuple(f"flat_{n - j}{j}" for n in range(2, degree + 1) for j in range(n + 1))


class _Lying(BaseModel):
    """Keys of every artefact."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    direction_tolerance_mrad: Milliradians = show_limit(ALIGNMENT) / MRAD


class _EdgeKeys(_Lying):
    along: Axis
    length_mm: Length = LENGTH_MM
    straight_tolerance_mm: Millimetres = 0.0
    reversed: bool = False
    """Turned over since the other setups with it."""


class StraightedgeKeys(_EdgeKeys):
    """Straightedge along an axis."""

    kind: Literal["straightedge"]
    name: Name | None = None
    """For setups that share its deviations."""


class SquareKeys(_EdgeKeys):
    """An arm of a square, along an axis."""

    kind: Literal["square"]
    name: Name
    """Name of the square: the setups on its arms share it."""
    square_tolerance_mrad: Milliradians = 0.0


class PlateKeys(_Lying):
    """Surface plate."""

    kind: Literal["plate"]
    length_mm: Length = LENGTH_MM
    flat_tolerance_mm: Millimetres = 0.0


class GaugeBlockKeys(_Lying):
    """Gauge block on a plane."""

    kind: Literal["gauge_block"]
    height_mm: Annotated[PositiveNumber, Field(ge=1.0, le=LARGEST_MM)]
    height_tolerance_mm: Millimetres = 0.0
    table_mm: Annotated[Number, Field(ge=-LARGEST_MM, le=LARGEST_MM)]
    """Coordinate of the tool centre point along the plunger with the tip on the plane without the
    block."""


ArtefactKeys = Annotated[
    StraightedgeKeys | SquareKeys | PlateKeys | GaugeBlockKeys, Field(discriminator="kind")
]


class ToolIndicatorKeys(SetupKeys):
    """Keys of a setup with an indicator at the tool, as in a session.yaml."""

    direction: Literal["x", "y", "z", "-x", "-y", "-z"]
    """Direction in which the plunger points; the reading grows when the tool moves there."""
    artefact: ArtefactKeys
    tool_mm: Point = Field(default_factory=lambda: [0.0, 0.0, 0.0])
    """Tip of the plunger at reading 0, from the tool centre point, in the tool's frame."""
    scale_tolerance: Annotated[Number, Field(ge=0.0, le=0.4)] = show_limit(SCALE)


@dataclass(frozen=True, slots=True)
class Artefact:
    """Artefact that the indicator touches, with the standard deviations of its errors."""

    kind: Kind
    along: str | None = None
    """Axis of an edge."""
    name: str | None = None
    length: float = LENGTH_MM * MM
    """Length that is used, [m]."""
    direction_std: float = ALIGNMENT
    """Yaw and roll, [rad]."""
    form_std: float = 0.0
    """Deviation from straight or flat at its ends, [m]."""
    form_degree: int = 2
    """Largest degree of the deviations from flat; those of degree n have a standard deviation
    that falls as 1/n², a smooth surface."""
    square_std: float = 0.0
    """Angle of a square, [rad]."""
    reversed: bool = False
    height: float = 0.0
    """Height of a gauge block, [m]."""
    height_std: float = 0.0
    table: float = 0.0
    """Coordinate of the tool centre point along the plunger, with the tip on the plane without the
    block, [m]."""


@dataclass(frozen=True, slots=True)
class ToolIndicator(ToolSensor):
    """An indicator at the tool whose plunger touches an artefact on the table."""

    direction: str
    """Direction in which the plunger points: x, y, z, -x, -y or -z."""
    artefact: Artefact
    tool: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Tip of the plunger at reading 0, from the tool centre point, in the tool's frame, [m]."""
    scale_std: float = SCALE
    """Prior standard deviation of the dial's scale, [1]."""

    kind: ClassVar[str] = "tool_indicator"
    noun: ClassVar[str] = "an indicator"
    keys: ClassVar[type[SetupKeys]] = ToolIndicatorKeys
    ideal: ClassVar[str] = "the artefact"

    @classmethod
    def from_keys(cls, keys: ToolIndicatorKeys) -> ToolIndicator:
        """Build from the keys of a session.yaml.

        Raises:
            SessionError: If an edge lies along the plunger.
        """
        a = keys.artefact
        common: dict[str, Any] = {"direction_std": _std(a.direction_tolerance_mrad, MRAD)}
        if isinstance(a, StraightedgeKeys | SquareKeys):
            if a.along == keys.direction.lstrip("-"):
                raise SessionError(
                    f"found {a.along}, the direction of the plunger; expected an axis across it",
                    where="artefact.along",
                )
            common |= {
                "along": a.along,
                "name": a.name,
                "length": a.length_mm * MM,
                "form_std": _std(a.straight_tolerance_mm, MM),
                "reversed": a.reversed,
            }
            if isinstance(a, SquareKeys):
                common["square_std"] = _std(a.square_tolerance_mrad, MRAD)
        elif isinstance(a, PlateKeys):
            common |= {"length": a.length_mm * MM, "form_std": _std(a.flat_tolerance_mm, MM)}
        else:
            common |= {
                "height": a.height_mm * MM,
                "height_std": _std(a.height_tolerance_mm, MM),
                "table": a.table_mm * MM,
            }
        x, y, z = (v * MM for v in keys.tool_mm)
        artefact = Artefact(a.kind, **common)
        return cls(keys.direction, artefact, (x, y, z), read_limit(keys.scale_tolerance))

    def to_keys(self) -> dict[str, Any]:
        """Keys for a session.yaml."""
        a = self.artefact
        artefact: dict[str, Any] = {"kind": a.kind}
        if a.along is not None:
            artefact |= {"along": a.along, **({} if a.name is None else {"name": a.name})}
        if a.kind == "gauge_block":
            artefact |= {
                "height_mm": to_mm(a.height),
                "height_tolerance_mm": _limit(a.height_std, MM),
                "table_mm": to_mm(a.table),
            }
        else:
            form = "flat" if a.kind == "plate" else "straight"
            artefact |= {"length_mm": to_mm(a.length)}
            artefact |= {f"{form}_tolerance_mm": _limit(a.form_std, MM)}
        if a.kind == "square":
            artefact["square_tolerance_mrad"] = _limit(a.square_std, MRAD)
        if a.reversed:
            artefact["reversed"] = True
        artefact["direction_tolerance_mrad"] = _limit(a.direction_std, MRAD)
        keys: dict[str, Any] = {"direction": self.direction, "artefact": artefact}
        if any(self.tool):
            keys["tool_mm"] = [to_mm(v) for v in self.tool]
        if self.scale_std != SCALE:
            keys["scale_tolerance"] = show_limit(self.scale_std)
        return keys

    def describe(self) -> str:
        """Direction of the plunger and artefact."""
        a = self.artefact
        words = a.kind.replace("_", " ")
        if a.kind == "gauge_block":
            words += f" of {a.height / MM:g} mm"
        along = "" if a.along is None else f" along {a.along}"
        turned = ", turned over" if a.reversed else ""
        return f"indicator at the tool towards {self.direction}, {words}{along}{turned}"

    @property
    def mounting_steps(self) -> tuple[str, ...]:
        """Steps that mount the indicator and its artefact."""
        a = self.artefact
        words = a.kind.replace("_", " ")
        if a.kind == "gauge_block":
            place = (
                "Prepare a flat surface on the table. Where the posture is higher, put the gauge "
                f"block of {a.height / MM:g} mm under the tip."
            )
        elif a.along is None:
            place = f"Put the {words} on the table, square to the plunger by eye."
        else:
            place = f"Put the {words} on the table, along {a.along} of the machine by eye."
        over = " Turn it over since its other setup." if a.reversed else ""
        return (
            place + over + " Clamp it: it must stay until all its readings are taken.",
            f"Mount the indicator at the tool. Its plunger points to {self.direction} and touches "
            f"the {words}.",
            "Push the plunger in with a finger. The reading must grow. If it falls, reverse the "
            "sign of every reading of this setup.",
        )

    def frames(self, robot: Robot) -> Frames:
        """The tool's frame."""
        return Frames((require_tcp(robot).frame,))

    def constants(self, robot: Robot) -> Array:
        """Plunger (3), artefact (3), axis of its yaw (3), tip (3), half its length (1).

        Then the share of a square's error that is yaw (1), sign of its errors (1), height of a
        block (1) and level of the plane (1).
        """
        del robot
        a = self.artefact
        d, along = direction_vector(self.direction), self._along
        square_to_both = np.abs(np.cross(along, d))
        sign = -1.0 if a.reversed else 1.0
        # in the order of the axes x, y, z, x the second arm of a square is turned from the first
        first = np.cross(along, np.abs(d)).sum() > 0.0
        share = sign * (-0.5 if first else 0.5) * (a.kind == "square")
        level = a.table * float(d.sum())
        numbers = [0.5 * a.length, share, sign, a.height, level]
        return np.array([*d, *along, *square_to_both, *self.tool, *numbers])

    @property
    def dimensions(self) -> Mapping[str, Sensor]:
        """A gauge block of another height."""
        if self.artefact.kind != "gauge_block":
            return {}
        higher = replace(self.artefact, height=self.artefact.height + DIMENSION_STEP)
        return {"artefact.height_mm": replace(self, artefact=higher)}

    @property
    def nuisance_parameters(self) -> tuple[NuisanceParameter, ...]:
        """Direction and errors of the artefact, scale of the dial; those with a deviation above 0.

        The placement of a square is that of both its arms, until it is turned over.
        """
        a = self.artefact
        owner = None if a.name is None else f"{a.kind}.{a.name}"
        placed = f"{owner}.reversed" if owner and a.reversed else owner
        of_arm = None if owner is None else f"{owner}.{a.along}"
        edge = a.along is not None
        forms = STRAIGHT if edge else flat_terms(a.form_degree)
        share = np.array([1.0 if edge else 1.0 / sum(map(int, f[-2:])) ** 2 for f in forms])
        form_std = a.form_std * share / np.linalg.norm(share)
        yaw_of = placed if a.kind == "square" else None
        parameters = (
            NuisanceParameter("yaw", "rad", a.direction_std, yaw_of),
            NuisanceParameter("roll", "rad", a.direction_std),
            NuisanceParameter("square", "rad", a.square_std, owner),
            *(
                NuisanceParameter(name, "m", float(std), of_arm)
                for name, std in zip(forms, form_std, strict=True)
            ),
            NuisanceParameter("height", "m", a.height_std),
            NuisanceParameter("scale", "1", self.scale_std, of_gauge=True),
        )
        return tuple(p for p in parameters if p.prior_std > 0.0)

    def expression(self, view: View, robot: Robot) -> ca.SX:
        """Reading with the gauge zero at 0, [m]."""
        del robot
        errors = {p.name: view.nuisance[i] for i, p in enumerate(self.nuisance_parameters)}
        c = view.constants
        plunger, along, across, tip = (c[i : i + 3] for i in (0, 3, 6, 9))
        half, share, sign, height, level = (c[i] for i in range(12, 17))
        (tool,) = view.frames
        q = tool.position + tool.rotation @ tip
        yaw = errors.get("yaw", 0.0) + share * errors.get("square", 0.0)
        normal = rotate(rotate(plunger, along, ca.SX(errors.get("roll", 0.0))), across, ca.SX(yaw))
        above = level - ca.dot(plunger, tool.position) > 0.5 * height
        raised = ca.if_else(above, height + errors.get("height", 0.0), 0.0)
        raised = ca.if_else(height > 0.0, raised, 0.0)
        form = sign * _form(errors, ca.dot(along, q) / half, ca.dot(across, q) / half)
        reading = (ca.dot(normal, q) + raised) / ca.dot(normal, tool.rotation @ plunger) + form
        return ca.SX((1.0 + errors.get("scale", 0.0)) * reading)

    def contact(self, frames: Sequence[Array], at_zero: Sequence[Array], robot: Robot) -> Contact:
        """Tips of the plunger in K postures."""
        del at_zero, robot
        poses = frames[0]
        tips = poses[:, :3, 3] + poses[:, :3, :3] @ np.array(self.tool)
        d = direction_vector(self.direction)
        return Contact(
            tips,
            d,
            self._along,
            [""] * len(tips),
            "artefact",
            at_tool=True,
            surface=self._surface(tips),
        )

    def _surface(self, tips: Array) -> Array:
        """Corners of the touched surface, under the middle of the tips, shape (4, 3), [m]."""
        a = self.artefact
        across = np.cross(self._along, direction_vector(self.direction))
        length, width = {
            "gauge_block": BLOCK,
            "plate": (a.length, a.length),
        }.get(a.kind, (a.length, BLADE))
        middle = 0.5 * (tips.min(axis=0) + tips.max(axis=0))
        ways = [(u, v) for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        return np.array(
            [middle + 0.5 * (u * length * self._along + v * width * across) for u, v in ways]
        )

    @property
    def _along(self) -> Array:
        """Unit vector along the artefact; for a plane, the axis after the plunger's."""
        if self.artefact.along is not None:
            return direction_vector(self.artefact.along)
        return np.roll(np.abs(direction_vector(self.direction)), 1)


def _form(errors: Mapping[str, ca.SX], s: ca.SX, t: ca.SX) -> ca.SX:
    """Deviation of an artefact from straight or flat.

    Args:
        errors: Nuisance parameters by name.
        s: Position along it, in half lengths.
        t: Position across it, in half lengths.
    """
    deviation = ca.SX(0.0)
    for name, value in errors.items():
        kind, _, degrees = name.partition("_")
        if kind == "straight":
            deviation += value * _legendre(int(degrees), s)
        elif kind == "flat":
            deviation += value * _legendre(int(degrees[0]), s) * _legendre(int(degrees[1]), t)
    return deviation


def _legendre(degree: int, x: ca.SX) -> ca.SX:
    """Legendre polynomial, by the recursion of Bonnet."""
    before, present = ca.SX(0.0), ca.SX(1.0)
    for n in range(degree):
        before, present = present, ((2 * n + 1) * x * present - n * before) / (n + 1)
    return present


def _std(tolerance: float, unit: float) -> float:
    return tidy(read_limit(tolerance) * unit)


def _limit(std: float, unit: float) -> float:
    return tidy(show_limit(std) / unit)
