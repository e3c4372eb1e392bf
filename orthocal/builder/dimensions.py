"""Dimensions of machines: one class for each kind of machine, one key for each dimension."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from orthocal.units import DEG, MM

SHORTEST_LEG, LONGEST_LEG = 0.02, 5.0
"""[m]"""

UNITS = {"mm": MM, "deg": DEG}


@dataclass(frozen=True, slots=True)
class Dimension:
    """A dimension: its key in machine.yaml, and what it means."""

    name: str
    """Name of the field of the dimensions."""
    question: str
    """Question to the owner; {zero} is the coordinate of the slides in the mechanical zero, mm."""
    comment: str
    """Comment in machine.yaml; it may have several lines."""
    unit: str = "mm"
    form: str = ""
    """Form of several numbers, such as LEAST:LARGEST, with their separator; "" for one number."""
    usual: str | None = None
    """Answer that is assumed where nothing is stated; None if the owner must state it."""

    @property
    def key(self) -> str:
        """Key in machine.yaml."""
        return f"{self.name}_{self.unit}"

    @property
    def separator(self) -> str:
        """Character between several numbers."""
        return next((c for c in ":," if c in self.form), "")

    @property
    def count(self) -> int:
        """Number of values."""
        return self.form.count(self.separator) + 1 if self.separator else 1

    def to_si(self, numbers: Sequence[float]) -> Any:  # noqa: ANN401 - a float or a tuple
        """Value of the field, of numbers in its unit."""
        values = tuple(v * UNITS[self.unit] for v in numbers)
        return values if self.separator else values[0]

    def show(self, value: float | Sequence[float]) -> str:
        """Value of the field as YAML, in its unit."""
        if isinstance(value, Sequence):
            return f"[{', '.join(in_unit(v, self.unit) for v in value)}]"
        return in_unit(value, self.unit)


LEG = Dimension(
    "leg", "Leg length, from hinge to hinge of a rod, mm", "From hinge to hinge of a rod."
)
TRAVEL = Dimension(
    "travel",
    "Lowest and highest coordinate of a slide, LEAST:LARGEST, mm. It is {zero} (the leg) where the "
    "legs are parallel to their axes, and grows outwards",
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
    """Dimensions of a machine of one kind."""

    rods_apart: float = 0.08
    """Distance of the axes of a leg's two rods, [m]."""
    rod_radius: float = 0.0055
    """[m]"""
    workspace: tuple[tuple[float, float], ...] | None = None
    """Limits of the tool's coordinates relative to the mechanical zero, [m]; by default those of
    the kind."""

    kind: ClassVar[str]
    """Name in machine.yaml and on the command line."""
    keys: ClassVar[tuple[Dimension, ...]]
    """Its dimensions, in the order in which they are asked for."""
    letters: ClassVar[str]
    """Names of the legs; the drive of leg x is x_slide."""
    coordinates: ClassVar[str] = "xyz"
    """Coordinates of the tool that the drives control."""
    at_zero: ClassVar[str] = "where the legs are parallel to their axes"
    """The mechanical zero, in words."""
    usual_workspace: ClassVar[str] = "the largest cube of at most ±60 mm that the machine reaches"
    """Workspace where none is stated, in words."""
    growing: ClassVar[str] = "outwards"
    """Direction in which a slide moves as its coordinate grows."""
    read_legs: ClassVar[bool] = True
    """Whether readings of the legs determine offsets of the drives."""

    @classmethod
    def drives_of(cls) -> tuple[str, ...]:
        """Names of the drives."""
        return tuple(f"{k}_slide" for k in cls.letters)

    @classmethod
    def axes_words(cls) -> str:
        """Coordinates of the tool in words."""
        return f"{', '.join(cls.coordinates[:-1])} and {cls.coordinates[-1]}"

    @property
    @abstractmethod
    def zero(self) -> float:
        """Coordinate of the slides in the mechanical zero, [m]."""

    @abstractmethod
    def find_problem(self) -> tuple[str, str] | None:
        """Name of the first impossible dimension, and why; None if all are possible.

        A dimension is compared with the ones before it, in the order of `keys`.
        """

    @property
    @abstractmethod
    def words(self) -> str:
        """Dimensions in words, in mm."""

    @property
    def title(self) -> str:
        """Kind and dimensions in words."""
        return f"A machine of the kind {self.kind}: {self.words}."

    @abstractmethod
    def urdf(self, name: str) -> str:
        """URDF of the machine."""

    @abstractmethod
    def yaml(self) -> str:
        """YAML of the machine: loops, drives, legs, parameters, tolerances and models."""

    def adjustments(self) -> str:
        """Mechanical adjustments, as lines below `orthocal`; "" by default."""
        return ""

    @classmethod
    def find_key(cls, key: str) -> Dimension | None:
        """The dimension of a key."""
        return next((d for d in cls.keys if d.key == key), None)

    @classmethod
    def of_keys(cls, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Fields of the dimensions, [m, rad], of keys of machine.yaml."""
        return {
            d.name: d.to_si(values[d.key] if d.separator else [values[d.key]]) for d in cls.keys
        }


def find_length_problem(name: str, what: str, value: float) -> tuple[str, str] | None:
    """Problem of a leg or rod that no machine has."""
    if SHORTEST_LEG <= value <= LONGEST_LEG:
        return None
    return name, (
        f"{what} of {in_mm(value)} mm; expected {in_mm(SHORTEST_LEG)} to {in_mm(LONGEST_LEG)} mm"
    )


def find_rods_problem(apart: float, radius: float, leg: float) -> tuple[str, str] | None:
    """Problem of the two rods of a leg."""
    if radius > 0.0 and 2.0 * radius < apart <= leg:
        return None
    return "rod_radius" if 0.0 < apart <= leg else "rods_apart", (
        f"rods of radius {in_mm(radius)} mm, {in_mm(apart)} mm apart; "
        f"expected them to clear each other, within {in_mm(leg)} mm"
    )


def in_mm(value: float) -> str:
    """Length in mm, without the rounding error of the factor."""
    return in_unit(value, "mm")


def in_unit(value: float, unit: str) -> str:
    """Number in mm or degrees, without the rounding error of the factor."""
    return f"{round(value / UNITS[unit], 9) + 0.0:.12g}"


def box_text(box: Sequence[Sequence[float]] | None) -> str:
    """Box in mm as YAML; "" for none."""
    if box is None:
        return ""
    return f"[{', '.join(f'[{in_mm(a)}, {in_mm(b)}]' for a, b in box)}]"
