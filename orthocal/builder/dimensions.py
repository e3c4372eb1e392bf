"""Dimensions of machines: one class per kind of machine, one key per dimension."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from orthocal.units import DEG, MM

SHORTEST_LEG, LONGEST_LEG = 0.02, 5.0
"""Limits of the length of a leg or rod, [m]."""

UNITS = {"mm": MM, "deg": DEG}
"""Units of dimensions in machine.yaml, mapped to their factors to SI."""


@dataclass(frozen=True, slots=True)
class Dimension:
    """Dimension of a machine, with its key in machine.yaml and its description."""

    name: str
    """Name of the field of `Dimensions`."""
    question: str
    """Template of a question to the user; {zero} is the coordinate of the slides in the mechanical
    zero, [mm]."""
    comment: str
    """Comment in machine.yaml, of one or more lines."""
    unit: str = "mm"
    """Unit in machine.yaml."""
    form: str = ""
    """Form of several numbers, such as LEAST:LARGEST, with their separator; "" for one number."""
    usual: str | None = None
    """Default answer, in the unit of the key; None if the user must state it."""

    @property
    def key(self) -> str:
        """Key in machine.yaml."""
        return f"{self.name}_{self.unit}"

    @property
    def separator(self) -> str:
        """Character between several numbers; "" for one number."""
        return next((c for c in ":," if c in self.form), "")

    @property
    def count(self) -> int:
        """Count of numbers in a value."""
        return self.form.count(self.separator) + 1 if self.separator else 1

    def to_si(self, numbers: Sequence[float]) -> Any:  # noqa: ANN401 - a float or a tuple
        """Value of the field in SI units, from numbers in the unit of the key: one, or a tuple."""
        values = tuple(v * UNITS[self.unit] for v in numbers)
        return values if self.separator else values[0]

    def show(self, value: float | Sequence[float]) -> str:
        """Value of the field as YAML, in the unit of the key."""
        if isinstance(value, Sequence):
            return f"[{', '.join(in_unit(v, self.unit) for v in value)}]"
        return in_unit(value, self.unit)


LEG = Dimension(
    "leg", "Leg length, from hinge to hinge of a rod, mm", "From hinge to hinge of a rod."
)
TRAVEL = Dimension(
    "travel",
    "Lowest and highest coordinate of a slide, LEAST:LARGEST, mm. The coordinate is {zero} (the "
    "leg length) where the legs are parallel to their axes, and grows outwards",
    "Coordinates of a slide: the leg length where the legs are parallel to their axes,\n"
    "more further out.",
    form="LEAST:LARGEST",
)
ATTACHMENT = Dimension(
    "attachment",
    "Distance from the tool centre point to the hinges on the platform, mm",
    "From the tool centre point to the hinges on the platform, along the axis.",
)
RODS_APART = Dimension(
    "rods_apart",
    "Distance between the two rods of a leg, from axis to axis, mm",
    "The two rods of a leg, from axis to axis.",
)
ROD_RADIUS = Dimension("rod_radius", "Radius of a rod, mm", "Radius of a rod.")


@dataclass(frozen=True, slots=True, kw_only=True)
class Dimensions(ABC):
    """Dimensions of a machine of one kind, and the files that describe it.

    Defaults are those of the paper's Orthoglide, unless a kind states others.
    """

    rods_apart: float = 0.08
    """Distance between the axes of a leg's two rods, [m]."""
    rod_radius: float = 0.0055
    """Radius of a rod, [m]."""
    workspace: tuple[tuple[float, float], ...] | None = None
    """Stated limits of the workspace relative to the mechanical zero, one pair for each coordinate,
    [m]; None for those of the kind."""

    kind: ClassVar[str]
    """Name of the kind in machine.yaml and on the command line."""
    keys: ClassVar[tuple[Dimension, ...]]
    """Dimensions of the kind, in the order of the questions."""
    letters: ClassVar[str]
    """Names of the legs, one letter each; the drive of leg x is x_slide."""
    coordinates: ClassVar[str] = "xyz"
    """Coordinates of the tool that the drives command."""
    at_zero: ClassVar[str] = "where the legs are parallel to their axes"
    """Description of the mechanical zero."""
    usual_workspace: ClassVar[str] = "the largest cube of at most ±60 mm that the machine reaches"
    """Description of the default workspace."""
    growing: ClassVar[str] = "outwards"
    """Direction of a slide's motion if its coordinate grows."""
    legs_determine_offsets: ClassVar[bool] = True
    """Whether readings of the legs determine the offsets of the drives."""

    @classmethod
    def drives_of(cls) -> tuple[str, ...]:
        """Names of the drives."""
        return tuple(f"{k}_slide" for k in cls.letters)

    @property
    @abstractmethod
    def zero(self) -> float:
        """Coordinate of the slides in the mechanical zero, [m]."""

    @abstractmethod
    def find_problem(self) -> tuple[str, str] | None:
        """Name and problem of the first impossible dimension; None if all are possible.

        Each dimension is compared with earlier ones, in the order of `keys`.
        """

    @property
    def box(self) -> tuple[tuple[float, float], ...] | None:
        """Limits of the workspace, [m]; None for the largest cube that the machine reaches.

        They are the stated ones, or those of the kind.
        """
        return self.workspace

    @property
    @abstractmethod
    def summary(self) -> str:
        """Dimensions in mm as a sentence part, such as "legs of 250 mm, travel 100 to 325 mm"."""

    @property
    def title(self) -> str:
        """Description of the kind and the dimensions."""
        return f"A machine of the kind {self.kind}: {self.summary}."

    @abstractmethod
    def urdf(self, name: str) -> str:
        """URDF of the machine."""

    @abstractmethod
    def yaml(self) -> str:
        """YAML of the machine: loops, drives, legs, parameters, tolerances and models."""

    def adjustments(self) -> str:
        """Mechanical adjustments as YAML lines below `orthocal`; "" by default."""
        return ""


def find_length_problem(name: str, part: str, value: float) -> tuple[str, str] | None:
    """Problem of an implausible length of a leg or rod; None if it is plausible.

    Args:
        name: Name of the dimension.
        part: Name of the part in the plural, for messages.
        value: Length, [m].
    """
    if SHORTEST_LEG <= value <= LONGEST_LEG:
        return None
    return name, (
        f"{part} of {in_mm(value)} mm; expected {in_mm(SHORTEST_LEG)} to {in_mm(LONGEST_LEG)} mm"
    )


def find_rods_problem(apart: float, radius: float, leg: float) -> tuple[str, str] | None:
    """Problem of the two rods of a leg; None without one.

    Args:
        apart: Distance between the axes of the rods, [m].
        radius: Radius of a rod, [m].
        leg: Length of the leg, [m].
    """
    if radius > 0.0 and 2.0 * radius < apart <= leg:
        return None
    name = "rod_radius" if 0.0 < apart <= leg else "rods_apart"
    return name, (
        f"rods of radius {in_mm(radius)} mm, {in_mm(apart)} mm apart; "
        f"expected a radius above 0, and a distance above twice the radius and at most "
        f"{in_mm(leg)} mm"
    )


def in_mm(value: float) -> str:
    """Length, [m], in mm as text (see `in_unit`)."""
    return in_unit(value, "mm")


def in_unit(value: float, unit: str) -> str:
    """Number in mm or degrees as text, without the rounding error of the factor.

    Args:
        value: Length or angle, [m, rad].
        unit: mm or deg.
    """
    return f"{round(value / UNITS[unit], 9) + 0.0:.12g}"


def box_text(box: Sequence[Sequence[float]] | None) -> str:
    """YAML of a box in mm from its limits, [m]; "" if it is None."""
    if box is None:
        return ""
    return f"[{', '.join(f'[{in_mm(a)}, {in_mm(b)}]' for a, b in box)}]"
