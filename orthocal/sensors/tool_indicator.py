"""Indicator at the tool, on a straightedge, a square, a surface plate or a gauge block.

The artefact is clamped to the table. Its surface is a plane with normal n, nominally the direction
d of the plunger in the reference posture. The tip q and the plunger's direction u move with the
tool. q₀ is a point of the nominal surface: the tip in the reference posture of the nominal machine,
or for a probe the origin of the world frame. The reading is

    h = (1 + s) ((n · (q - q₀) + H) / (n · u) + f(q))

s is the scale error of the dial. H is the height of a gauge block under the tip, and 0 beside the
block. Yaw, about the axis square to artefact and plunger, and roll, about the artefact, turn n. f
is a deviation from straight or flat: Legendre polynomials of degree 2 and 3 along an edge, of
degree 2 over a plate. Yaw, roll, f and the errors of H and s are nuisance parameters, and the gauge
zero is free.

The arms of one square share its yaw. Their angle differs from a right angle by an error. A square
or a straightedge that is turned over shows its errors with the opposite sign (reversal).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import casadi as ca
import numpy as np
from pydantic import Field

from orthocal.arrays import Array, triple
from orthocal.errors import SessionError
from orthocal.io.documents import Keys, Name, Number, PositiveNumber
from orthocal.robot.model import Robot, require_tcp
from orthocal.sensors.direction import direction_vector
from orthocal.sensors.mounting import SCALE_STD, Millimetres, Milliradians, ScaleTolerance, rotate
from orthocal.sensors.protocol import (
    DIMENSION_STEP,
    Contact,
    NuisanceParameter,
    Sensor,
    SetupKeys,
    ToolSensor,
    View,
    default_zero,
    place_point,
)
from orthocal.units import MM, MRAD, read_tolerance, show_mm, show_tolerance, to_mm

ALIGNMENT_STD = 5.0 * MRAD
"""Prior standard deviation of the direction of an artefact aligned by eye, [rad]."""

LENGTH_MM = 200.0
"""Default of the used length of an artefact, [mm]."""

BLADE, BLOCK = 20 * MM, 35 * MM
"""Width of a blade and of a gauge block in pictures, [m]."""

LARGEST_MM = 2000.0
"""Largest accepted length and coordinate, [mm]; a larger one has a wrong unit."""

Kind = Literal["straightedge", "square", "plate", "gauge_block"]
Axis = Literal["x", "y", "z"]
Point = Annotated[
    list[Annotated[Number, Field(ge=-LARGEST_MM, le=LARGEST_MM)]], Field(min_length=3, max_length=3)
]
Length = Annotated[PositiveNumber, Field(le=LARGEST_MM)]

STRAIGHT = ("straight_2", "straight_3")
"""Deviations of an edge: Legendre polynomials of degree 2 and 3."""


def flat_terms(degree: int) -> tuple[str, ...]:
    """Names of the deviations of a plane: products of Legendre polynomials along both axes.

    Args:
        degree: Largest sum of the degrees of both polynomials; the smallest is 2.
    """
    return tuple(f"flat_{n - j}{j}" for n in range(2, degree + 1) for j in range(n + 1))


class _ArtefactKeys(Keys):
    """Keys of every artefact."""

    direction_tolerance_mrad: Milliradians = show_tolerance(ALIGNMENT_STD, MRAD)


class _EdgeKeys(_ArtefactKeys):
    """Keys of an artefact with an edge along an axis."""

    along: Axis
    length_mm: Length = LENGTH_MM
    straight_tolerance_mm: Millimetres = 0.0
    reversed: bool = False
    """Whether the artefact is turned over relative to its other setups."""


class StraightedgeKeys(_EdgeKeys):
    """Straightedge along an axis."""

    kind: Literal["straightedge"]
    name: Name | None = None
    """Name of the straightedge, if several setups share its deviations."""


class SquareKeys(_EdgeKeys):
    """Arm of a square along an axis."""

    kind: Literal["square"]
    name: Name
    """Name of the square, which the setups on its arms share."""
    square_tolerance_mrad: Milliradians = 0.0
    """Tolerance of the right angle."""


class PlateKeys(_ArtefactKeys):
    """Surface plate, or the bed of the machine."""

    kind: Literal["plate"]
    length_mm: Length = LENGTH_MM
    flat_tolerance_mm: Millimetres = 0.0
    bed: bool = False
    """True for the bed of the machine."""


class GaugeBlockKeys(_ArtefactKeys):
    """Gauge block on a plane."""

    kind: Literal["gauge_block"]
    height_mm: Annotated[PositiveNumber, Field(ge=1.0, le=LARGEST_MM)]
    height_tolerance_mm: Millimetres = 0.0
    table_mm: Annotated[Number, Field(ge=-LARGEST_MM, le=LARGEST_MM)]
    """Coordinate of the tool centre point along the plunger while the tip touches the plane beside
    the block."""


ArtefactKeys = Annotated[
    StraightedgeKeys | SquareKeys | PlateKeys | GaugeBlockKeys, Field(discriminator="kind")
]


class ToolIndicatorKeys(SetupKeys):
    """Keys of a setup with an indicator at the tool, as in a session.yaml."""

    direction: Literal["x", "y", "z", "-x", "-y", "-z"]
    """Direction of the plunger in the reference posture, in the world frame; the reading grows when
    the tool moves in this direction."""
    artefact: ArtefactKeys
    tool_mm: Point = Field(default_factory=lambda: [0.0, 0.0, 0.0])
    """Tip of the plunger at reading 0, from the tool centre point, in the tool's frame."""
    scale_tolerance: ScaleTolerance = show_tolerance(SCALE_STD)


@dataclass(frozen=True, slots=True)
class Artefact:
    """Artefact that the indicator touches, with the prior standard deviations of its errors."""

    kind: Kind
    along: str | None = None
    """Axis of an edge."""
    name: str | None = None
    """Name of an artefact that several setups share."""
    length: float = LENGTH_MM * MM
    """Used length, [m]."""
    direction_std: float = ALIGNMENT_STD
    """Prior standard deviation of yaw and roll, [rad]."""
    form_std: float = 0.0
    """Prior standard deviation of the deviation from straight or flat at the ends, [m]."""
    form_degree: int = 2
    """Largest degree n of the deviations from flat. Their prior standard deviations decrease as
    1/n², because the surface is smooth."""
    square_std: float = 0.0
    """Prior standard deviation of the right angle of a square, [rad]."""
    reversed: bool = False
    """True if the artefact is turned over relative to its other setups."""
    bed: bool = False
    """True for a plate that is the bed of the machine."""
    height: float = 0.0
    """Height of a gauge block, [m]."""
    height_std: float = 0.0
    """Prior standard deviation of this height, [m]."""
    table: float = 0.0
    """Coordinate of the tool centre point along the plunger while the tip touches the plane beside
    the block, [m]."""

    @property
    def noun(self) -> str:
        """Noun for the artefact in descriptions."""
        return "bed" if self.bed else self.kind.replace("_", " ")

    @property
    def nuisance_parameters(self) -> tuple[NuisanceParameter, ...]:
        """Direction and errors, if their standard deviation is above 0.

        Both arms of a square share its yaw. A square that is turned over has another yaw.
        """
        owner = None if self.name is None else f"{self.kind}.{self.name}"
        placement = f"{owner}.reversed" if owner and self.reversed else owner
        arm = None if owner is None else f"{owner}.{self.along}"
        is_edge = self.along is not None
        forms = STRAIGHT if is_edge else flat_terms(self.form_degree)
        # the last two characters of flat_JK are the degrees along both axes
        share = np.array([1.0 if is_edge else 1.0 / sum(map(int, f[-2:])) ** 2 for f in forms])
        form_std = self.form_std * share / np.linalg.norm(share)
        yaw_owner = placement if self.kind == "square" else None
        parameters = (
            NuisanceParameter("yaw", "rad", self.direction_std, yaw_owner),
            NuisanceParameter("roll", "rad", self.direction_std),
            NuisanceParameter("square", "rad", self.square_std, owner),
            *(
                NuisanceParameter(name, "m", float(std), arm)
                for name, std in zip(forms, form_std, strict=True)
            ),
            NuisanceParameter("height", "m", self.height_std),
        )
        return tuple(p for p in parameters if p.prior_std > 0.0)


@dataclass(frozen=True, slots=True)
class ToolIndicator(ToolSensor):
    """Indicator at the tool whose plunger touches an artefact on the table."""

    direction: str
    """Direction of the plunger: x, y, z, -x, -y or -z."""
    artefact: Artefact
    tool: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Tip of the plunger at reading 0, from the tool centre point, in the tool's frame, [m]."""
    scale_std: float = SCALE_STD
    """Prior standard deviation of the dial's scale, [1]."""

    kind: ClassVar[str] = "tool_indicator"
    noun: ClassVar[str] = "an indicator"
    keys: ClassVar[type[SetupKeys]] = ToolIndicatorKeys
    ideal: ClassVar[str] = "the artefact"

    @classmethod
    def from_keys(cls, keys: ToolIndicatorKeys) -> ToolIndicator:
        """Build from the keys of a session.yaml.

        Raises:
            SessionError: If an edge is parallel to the plunger.
        """
        a = keys.artefact
        fields: dict[str, Any] = {"direction_std": read_tolerance(a.direction_tolerance_mrad, MRAD)}
        if isinstance(a, StraightedgeKeys | SquareKeys):
            if a.along == keys.direction.lstrip("-"):
                raise SessionError(
                    f"found {a.along}, the direction of the plunger; expected an axis across it",
                    where="artefact.along",
                )
            fields |= {
                "along": a.along,
                "name": a.name,
                "length": a.length_mm * MM,
                "form_std": read_tolerance(a.straight_tolerance_mm, MM),
                "reversed": a.reversed,
            }
            if isinstance(a, SquareKeys):
                fields["square_std"] = read_tolerance(a.square_tolerance_mrad, MRAD)
        elif isinstance(a, PlateKeys):
            fields |= {
                "length": a.length_mm * MM,
                "form_std": read_tolerance(a.flat_tolerance_mm, MM),
                "bed": a.bed,
            }
        else:
            fields |= {
                "height": a.height_mm * MM,
                "height_std": read_tolerance(a.height_tolerance_mm, MM),
                "table": a.table_mm * MM,
            }
        tool, artefact = triple(keys.tool_mm, MM), Artefact(a.kind, **fields)
        return cls(keys.direction, artefact, tool, read_tolerance(keys.scale_tolerance))

    def to_keys(self) -> dict[str, Any]:
        """Keys for a session.yaml."""
        a = self.artefact
        artefact: dict[str, Any] = {"kind": a.kind}
        if a.along is not None:
            artefact |= {"along": a.along, **({} if a.name is None else {"name": a.name})}
        if a.kind == "gauge_block":
            artefact |= {
                "height_mm": to_mm(a.height),
                "height_tolerance_mm": show_tolerance(a.height_std, MM),
                "table_mm": to_mm(a.table),
            }
        else:
            form = "flat" if a.kind == "plate" else "straight"
            artefact |= {"length_mm": to_mm(a.length)}
            artefact |= {f"{form}_tolerance_mm": show_tolerance(a.form_std, MM)}
        if a.kind == "square":
            artefact["square_tolerance_mrad"] = show_tolerance(a.square_std, MRAD)
        artefact |= {key: True for key in ("bed", "reversed") if getattr(a, key)}
        artefact["direction_tolerance_mrad"] = show_tolerance(a.direction_std, MRAD)
        keys: dict[str, Any] = {"direction": self.direction, "artefact": artefact}
        if any(self.tool):
            keys["tool_mm"] = [to_mm(v) for v in self.tool]
        if self.scale_std != SCALE_STD:
            keys["scale_tolerance"] = show_tolerance(self.scale_std)
        return keys

    def describe(self) -> str:
        """Short description with the direction of the plunger and the artefact."""
        a = self.artefact
        words = a.noun
        if a.kind == "gauge_block":
            words += f" of {show_mm(a.height)} mm"
        along = "" if a.along is None else f" along {a.along}"
        turned = ", turned over" if a.reversed else ""
        return f"indicator at the tool towards {self.direction}, {words}{along}{turned}"

    @property
    def mounting_steps(self) -> tuple[str, ...]:
        """Instructions for mounting the indicator and its artefact."""
        a = self.artefact
        words = a.noun
        if a.kind == "gauge_block":
            place = "Prepare a flat surface on the table."
            block = f"the {words} of {show_mm(a.height)} mm"
            words = f"flat surface. Where the posture is higher, put {block} under the tip"
        elif a.bed:
            place = "Use no plate: the plunger touches the bed itself."
        elif a.along is None:
            place = f"Put the {words} on the table, square to the plunger by eye."
        else:
            place = f"Put the {words} on the table, along {a.along} of the machine by eye."
        over = " Turn it over since its other setup." if a.reversed else ""
        clamp = "" if a.bed or a.kind == "gauge_block" else " Clamp it."
        return (
            f"{place}{over}{clamp} It must not move until all its readings are taken.",
            f"Mount the indicator at the tool. Its plunger points to {self.direction} and touches "
            f"the {words}.",
            "Push the plunger in with a finger. The reading must grow. If it falls, enter "
            "every reading of this setup with the opposite sign.",
        )

    def constants(self, robot: Robot) -> Array:
        """Constants of the expression, shape (26,), [m].

        Directions of plunger (3) and artefact (3), axis of yaw (3), position of the tip (3), half
        length (1), share of a square's error in the yaw (1), sign of the form errors (1), height of
        a block (1), coordinate of the plane along the plunger (1), direction of the plunger in the
        tool's frame (3), position of the tool centre point in the reference posture of the nominal
        machine (3), and a point of the surface (3).
        """
        reference = robot.reference_pose(require_tcp(robot).frame)
        a = self.artefact
        d, along = direction_vector(self.direction), self._along
        square_to_both = np.abs(np.cross(along, d))
        sign = -1.0 if a.reversed else 1.0
        # half of the error of the right angle is assigned to each arm, with opposite signs
        is_first_arm = np.cross(along, np.abs(d)).sum() > 0.0
        share = sign * (-0.5 if is_first_arm else 0.5) * (a.kind == "square")
        level = a.table * float(d.sum())
        numbers = [0.5 * a.length, share, sign, a.height, level]
        plunger_in_tool = reference.rotation.T @ d
        tip = reference.translation + reference.rotation @ np.array(self.tool)
        on_surface = tip if default_zero(self) == "free" else np.zeros(3)  # 0 for a probe
        places = [*plunger_in_tool, *reference.translation, *on_surface]
        return np.array([*d, *along, *square_to_both, *self.tool, *numbers, *places])

    @property
    def dimensions(self) -> Mapping[str, Sensor]:
        """Gauge block with a height that is larger by DIMENSION_STEP."""
        if self.artefact.kind != "gauge_block":
            return {}
        higher = replace(self.artefact, height=self.artefact.height + DIMENSION_STEP)
        return {"artefact.height_mm": replace(self, artefact=higher)}

    @property
    def nuisance_parameters(self) -> tuple[NuisanceParameter, ...]:
        """Direction and errors of the artefact and scale of the dial, if their std is above 0."""
        scale = NuisanceParameter("scale", "1", self.scale_std, of_gauge=True)
        parameters = (*self.artefact.nuisance_parameters, scale)
        return tuple(p for p in parameters if p.prior_std > 0.0)

    def expression(self, view: View, robot: Robot) -> ca.SX:
        """Reading with the gauge zero at 0, [m]."""
        del robot
        errors = {p.name: view.nuisance[i] for i, p in enumerate(self.nuisance_parameters)}
        c = view.constants
        plunger, along, across, tip = (c[i : i + 3] for i in (0, 3, 6, 9))
        half, share, sign, height, level = (c[i] for i in range(12, 17))
        plunger_in_tool, reference, on_surface = (c[i : i + 3] for i in (17, 20, 23))
        (tool,) = view.frames
        q = tool.position + tool.rotation @ tip
        yaw = errors.get("yaw", 0.0) + share * errors.get("square", 0.0)
        normal = rotate(rotate(plunger, along, ca.SX(errors.get("roll", 0.0))), across, ca.SX(yaw))
        # above half of the block's height the tip is on the block, below beside it
        on_block = level - ca.dot(plunger, tool.position) > 0.5 * height
        block = ca.if_else(on_block, height + errors.get("height", 0.0), 0.0)
        block = ca.if_else(height > 0.0, block, 0.0)
        s, t = (ca.dot(axis, q - reference) / half for axis in (along, across))
        distance = ca.dot(normal, q - on_surface) + block
        along_plunger = distance / ca.dot(normal, tool.rotation @ plunger_in_tool)
        reading = along_plunger + sign * _form(errors, s, t)
        return ca.SX((1.0 + errors.get("scale", 0.0)) * reading)

    def contact(self, frames: Sequence[Array], at_zero: Sequence[Array], robot: Robot) -> Contact:
        """Positions of the plunger's tip in K postures."""
        del at_zero, robot
        tips = place_point(frames[0], self.tool)
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
        """Corners of the touched surface, shape (4, 3), [m]; of a gauge block, of its front.

        A surface is centred at the tips. A block stands on the surface that the plunger touches in
        its most advanced posture.

        Args:
            tips: Positions of the tip, shape (K, 3), [m].
        """
        a, plunger = self.artefact, direction_vector(self.direction)
        across = np.cross(self._along, plunger)
        middle = 0.5 * (tips.min(axis=0) + tips.max(axis=0))
        length, width = a.length, a.length if a.kind == "plate" else BLADE
        if a.kind == "gauge_block":
            across, length, width = plunger, BLOCK, a.height
            middle = middle + ((tips @ plunger).max() - middle @ plunger - 0.5 * width) * plunger
        return np.array(
            [
                middle + 0.5 * (u * length * self._along + v * width * across)
                for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1))
            ]
        )

    @property
    def _along(self) -> Array:
        """Unit vector along the artefact, shape (3,); for a plane, the axis after the plunger's."""
        if self.artefact.along is not None:
            return direction_vector(self.artefact.along)
        return np.roll(np.abs(direction_vector(self.direction)), 1)


def _form(errors: Mapping[str, ca.SX], s: ca.SX, t: ca.SX) -> ca.SX:
    """Deviation f of an artefact from straight or flat, [m].

    Args:
        errors: Nuisance parameters by name.
        s: Position along the artefact, in half lengths.
        t: Position across the artefact, in half lengths.
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
    """Legendre polynomial of a degree at x, by Bonnet's recursion."""
    previous, current = ca.SX(0.0), ca.SX(1.0)
    for n in range(degree):
        previous, current = current, ((2 * n + 1) * x * current - n * previous) / (n + 1)
    return current
