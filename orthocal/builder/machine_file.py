"""machine.yaml: the dimensions of an Orthoglide, in one place.

The URDF and YAML of its directory are made from it, and again after a change.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from orthocal.errors import RobotError
from orthocal.io.documents import Number, read_yaml, validate
from orthocal.robot.description import WorkspaceBox
from orthocal.units import MM

MACHINE = "machine.yaml"

SHORTEST_LEG, LONGEST_LEG = 0.02, 5.0
"""[m]"""

STEEPEST = 0.9
"""Sine of the largest angle by which legs turn at the ends of a drive's travel."""

LARGEST_SHOWN = 100.0
"""Largest coordinate of a controller's joint in the mechanical zero, [m]."""


@dataclass(frozen=True, slots=True)
class Dimensions:
    """Dimensions of an Orthoglide, [m]."""

    leg: float = 0.31025
    """Length of a leg, from hinge to hinge of a rod."""
    lower: float = 0.12
    """Least coordinate of a drive. A drive's coordinate is the distance of a leg's root from the
    intersection of the drive axes, plus the offset: the leg length in the mechanical zero."""
    upper: float = 0.39
    """Largest coordinate of a drive."""
    attachment: float = 0.04
    """Distance from the tool centre point to the hinges on the platform, along the axis. The
    slide's coordinate does not depend on it: it is the leg length in the mechanical zero."""
    rods_apart: float = 0.08
    """Distance of the axes of a leg's two rods."""
    rod_radius: float = 0.0055
    workspace: tuple[tuple[float, float], ...] | None = None
    """Limits of x, y and z relative to the mechanical zero; by default the largest cube of at most
    ±60 mm that the machine reaches."""

    def find_problem(self) -> tuple[str, str] | None:
        """Name of the first impossible dimension, and why; None if all are possible.

        A dimension is compared with the ones before it: leg, travel, attachment, rods_apart,
        rod_radius.
        """
        leg = self.leg
        if not SHORTEST_LEG <= leg <= LONGEST_LEG:
            return "leg", (
                f"legs of {in_mm(leg)} mm; expected {in_mm(SHORTEST_LEG)} to "
                f"{in_mm(LONGEST_LEG)} mm"
            )
        travel = f"travel from {in_mm(self.lower)} to {in_mm(self.upper)} mm"
        if not self.lower < leg < self.upper:
            return "travel", (
                f"{travel} does not include {in_mm(leg)} mm, the leg length, where the mechanical "
                "zero is; check both numbers"
            )
        if max(leg - self.lower, self.upper - leg) > STEEPEST * leg:
            return "travel", (
                f"{travel}; legs of {in_mm(leg)} mm reach {in_mm((1.0 - STEEPEST) * leg)} to "
                f"{in_mm((1.0 + STEEPEST) * leg)} mm"
            )
        if not 0.0 <= self.attachment <= leg:
            return "attachment", (
                f"hinges {in_mm(self.attachment)} mm from the tool centre point; expected 0 to the "
                f"leg length, {in_mm(leg)} mm"
            )
        if not self.rod_radius > 0.0 or not 2.0 * self.rod_radius < self.rods_apart <= leg:
            return "rod_radius" if 0.0 < self.rods_apart <= leg else "rods_apart", (
                f"rods of radius {in_mm(self.rod_radius)} mm, {in_mm(self.rods_apart)} mm apart; "
                f"expected them to clear each other, within {in_mm(leg)} mm"
            )
        return None

    @property
    def words(self) -> str:
        """Dimensions in words, in mm."""
        return (
            f"legs of {in_mm(self.leg)} mm, travel {in_mm(self.lower)} to {in_mm(self.upper)} mm, "
            f"hinges {in_mm(self.attachment)} mm from the tool centre point, rods of radius "
            f"{in_mm(self.rod_radius)} mm, {in_mm(self.rods_apart)} mm apart"
        )


@dataclass(frozen=True, slots=True)
class Counting:
    """Relation of a controller's joint to the drive's coordinate."""

    up: bool = True
    """Whether it grows as the slide moves away from the intersection of the drive axes."""
    at_zero: float | None = None
    """Coordinate in the mechanical zero, [m]; None for the leg length, as in orthocal."""


AS_DRIVE = Counting()
"""Joint coordinate equal to the drive's coordinate."""


def find_counting_problem(counting: Sequence[Counting], count: int = 3) -> str | None:
    """Reason why joints cannot count like this; None if they can."""
    if len(counting) != count:
        return f"has {len(counting)} joints; expected {count}"
    for joint in counting:
        at = joint.at_zero
        if at is not None and not (math.isfinite(at) and abs(at) <= LARGEST_SHOWN):
            return f"{in_mm(at)} mm in the mechanical zero; expected within ±{LARGEST_SHOWN:g} m"
    return None


class _Keys(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


class CountingKeys(_Keys):
    """Joint of a controller."""

    counts: Literal["up", "down"] = "up"
    at_zero_mm: Number | None = None


class JointsKeys(_Keys):
    """Joints of all drives."""

    x_slide: CountingKeys = CountingKeys()
    y_slide: CountingKeys = CountingKeys()
    z_slide: CountingKeys = CountingKeys()


class MachineKeys(_Keys):
    """Keys of machine.yaml."""

    leg_mm: Number
    travel_mm: Annotated[list[Number], Field(min_length=2, max_length=2)]
    attachment_mm: Number
    rods_apart_mm: Number
    rod_radius_mm: Number
    workspace_mm: Annotated[WorkspaceBox, Field(min_length=3)] | None = None
    joints: JointsKeys = JointsKeys()


def read_machine(path: Path) -> tuple[Dimensions, tuple[Counting, ...]]:
    """Dimensions of a machine, and how its joints count.

    Raises:
        RobotError: Naming file and key, also where the dimensions are impossible.
    """
    keys = validate(
        MachineKeys, read_yaml(path, error=RobotError), where=str(path), error=RobotError
    )
    box = keys.workspace_mm
    dimensions = Dimensions(
        leg=keys.leg_mm * MM,
        lower=keys.travel_mm[0] * MM,
        upper=keys.travel_mm[1] * MM,
        attachment=keys.attachment_mm * MM,
        rods_apart=keys.rods_apart_mm * MM,
        rod_radius=keys.rod_radius_mm * MM,
        workspace=None if box is None else tuple((low * MM, high * MM) for low, high in box),
    )
    problem = dimensions.find_problem()
    if problem:
        raise RobotError(problem[1], where=f"{path}: {problem[0]}_mm")
    joints = (keys.joints.x_slide, keys.joints.y_slide, keys.joints.z_slide)
    counting = tuple(
        Counting(j.counts == "up", None if j.at_zero_mm is None else j.at_zero_mm * MM)
        for j in joints
    )
    wrong = find_counting_problem(counting)
    if wrong:
        raise RobotError(wrong, where=f"{path}: joints")
    return dimensions, counting


def machine_text(dimensions: Dimensions, counting: tuple[Counting, ...]) -> str:
    """Text of machine.yaml."""
    joints = "".join(
        f"  {axis}_slide: {{{joint_text(joint)}}}\n"
        for axis, joint in zip("xyz", counting, strict=True)
    )
    box = workspace_text(dimensions)
    stated = f"workspace_mm: {box}" if box else "# workspace_mm: [[-60, 60], [-60, 60], [-60, 60]]"
    return (
        "# Dimensions of this machine, in mm. After a change, run in this directory:\n"
        "#   orthocal new . --again\n"
        "# From hinge to hinge of a rod.\n"
        f"leg_mm: {in_mm(dimensions.leg)}\n"
        "# Coordinates of a slide: the leg length where the legs are parallel to their axes,\n"
        "# more further out.\n"
        f"travel_mm: [{in_mm(dimensions.lower)}, {in_mm(dimensions.upper)}]\n"
        "# From the tool centre point to the hinges on the platform, along the axis.\n"
        f"attachment_mm: {in_mm(dimensions.attachment)}\n"
        "# The two rods of a leg, from axis to axis, and their radius.\n"
        f"rods_apart_mm: {in_mm(dimensions.rods_apart)}\n"
        f"rod_radius_mm: {in_mm(dimensions.rod_radius)}\n"
        "# Limits of x, y and z relative to the mechanical zero, where the tool works. Without\n"
        "# them: the largest cube of at most ±60 mm that the machine reaches.\n"
        f"{stated}\n"
        "# Joints of the controller: whether they count up or down as a slide moves outwards,\n"
        "# and what they show where the legs are parallel to their axes (by default the leg\n"
        "# length).\n"
        f"joints:\n{joints}"
    )


def workspace_text(dimensions: Dimensions) -> str:
    """Box of the workspace as YAML; "" where none is stated."""
    if dimensions.workspace is None:
        return ""
    return f"[{', '.join(f'[{in_mm(a)}, {in_mm(b)}]' for a, b in dimensions.workspace)}]"


def joint_text(joint: Counting) -> str:
    """Joint as YAML within braces."""
    counts = f"counts: {'up' if joint.up else 'down'}"
    return counts if joint.at_zero is None else f"{counts}, at_zero_mm: {in_mm(joint.at_zero)}"


def drive_text(dimensions: Dimensions, joint: Counting) -> str:
    """Drive in the robot's YAML, within braces."""
    zero = f"zero_mm: {in_mm(dimensions.leg)}"
    return zero if joint == AS_DRIVE else f"{zero}, joint: {{{joint_text(joint)}}}"


def in_mm(value: float) -> str:
    """Length in mm, without the rounding error of the factor."""
    return f"{round(value / MM, 9):.9g}"
