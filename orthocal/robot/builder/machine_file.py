"""machine.yaml: every size of a machine of the Orthoglide's kind in one place.

URDF and YAML of its folder are made from it, and made again after a change.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from orthocal.errors import RobotError
from orthocal.io.documents import Number, read_yaml, validate
from orthocal.robot.builder.dimensions import (
    AS_DRIVE,
    Counting,
    Sizes,
    find_counting_problem,
    in_mm,
)
from orthocal.units import MM

MACHINE = "machine.yaml"

KEYS = {
    "leg": "leg_mm",
    "travel": "travel_mm",
    "attachment": "attachment_mm",
    "rods_apart": "rods_apart_mm",
    "rod_radius": "rod_radius_mm",
}
"""What `Sizes.find_problem` names, to the key that says it."""


class _Keys(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


class CountingKeys(_Keys):
    """A controller's joint."""

    counts: Literal["up", "down"] = "up"
    at_zero_mm: Number | None = None


class JointsKeys(_Keys):
    """Those of all drives."""

    x_slide: CountingKeys = CountingKeys()
    y_slide: CountingKeys = CountingKeys()
    z_slide: CountingKeys = CountingKeys()


class MachineKeys(_Keys):
    """A whole machine.yaml."""

    leg_mm: Number
    travel_mm: Annotated[list[Number], Field(min_length=2, max_length=2)]
    attachment_mm: Number
    rods_apart_mm: Number
    rod_radius_mm: Number
    joints: JointsKeys = JointsKeys()


def read_machine(path: Path) -> tuple[Sizes, tuple[Counting, ...]]:
    """Sizes of a machine, and how its joints count.

    Raises:
        RobotError: Naming file and key, also where the sizes make no machine.
    """
    keys = validate(
        MachineKeys, read_yaml(path, error=RobotError), where=str(path), error=RobotError
    )
    sizes = Sizes(
        leg=keys.leg_mm * MM,
        lower=keys.travel_mm[0] * MM,
        upper=keys.travel_mm[1] * MM,
        attachment=keys.attachment_mm * MM,
        rods_apart=keys.rods_apart_mm * MM,
        rod_radius=keys.rod_radius_mm * MM,
    )
    found = sizes.find_problem()
    if found:
        raise RobotError(found[1], where=f"{path}: {KEYS[found[0]]}")
    joints = (keys.joints.x_slide, keys.joints.y_slide, keys.joints.z_slide)
    counting = tuple(
        Counting(j.counts == "up", None if j.at_zero_mm is None else j.at_zero_mm * MM)
        for j in joints
    )
    problem = find_counting_problem(counting)
    if problem:
        raise RobotError(problem, where=f"{path}: joints")
    return sizes, counting


def machine_text(sizes: Sizes, counting: tuple[Counting, ...]) -> str:
    """The machine.yaml of a machine."""
    joints = "".join(
        f"  {axis}_slide: {{{joint_text(joint)}}}\n"
        for axis, joint in zip("xyz", counting, strict=True)
    )
    return (
        "# Every size of this machine, in mm. After a change, in this folder:\n"
        "#   orthocal new . --again\n"
        "# From hinge to hinge of a rod.\n"
        f"leg_mm: {in_mm(sizes.leg)}\n"
        "# Coordinates of a slider: the leg's length where the legs are parallel to their axes,\n"
        "# more further out.\n"
        f"travel_mm: [{in_mm(sizes.lower)}, {in_mm(sizes.upper)}]\n"
        "# From slider to hinge, and from hinge to tool.\n"
        f"attachment_mm: {in_mm(sizes.attachment)}\n"
        "# The two rods of a leg, from axis to axis, and how thick they are.\n"
        f"rods_apart_mm: {in_mm(sizes.rods_apart)}\n"
        f"rod_radius_mm: {in_mm(sizes.rod_radius)}\n"
        "# What the controller shows: up or down as a slider moves outwards, and its number where\n"
        "# the legs are parallel to their axes (without it the leg's length).\n"
        f"joints:\n{joints}"
    )


def joint_text(joint: Counting) -> str:
    """What is said of a joint, as YAML within braces."""
    counts = f"counts: {'up' if joint.up else 'down'}"
    return counts if joint.at_zero is None else f"{counts}, at_zero_mm: {in_mm(joint.at_zero)}"


def drive_text(sizes: Sizes, joint: Counting) -> str:
    """A drive in the robot's YAML, within braces."""
    zero = f"zero_mm: {in_mm(sizes.leg)}"
    return zero if joint == AS_DRIVE else f"{zero}, joint: {{{joint_text(joint)}}}"
