"""machine.yaml: kind and dimensions of a machine.

The URDF and YAML in the same directory are generated from it, and updated after a change.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, create_model

from orthocal.builder.biglide import Biglide
from orthocal.builder.dimensions import Dimension, Dimensions, box_text, in_mm
from orthocal.builder.linear_delta import LinearDelta
from orthocal.builder.orthoglide import InclinedOrthoglide, Orthoglide
from orthocal.errors import RobotError
from orthocal.io.documents import Keys, Number, read_yaml, validate
from orthocal.robot.description import WorkspaceBox
from orthocal.units import MM

MACHINE = "machine.yaml"
"""Name of the file."""

KINDS: dict[str, type[Dimensions]] = {
    k.kind: k for k in (Orthoglide, InclinedOrthoglide, LinearDelta, Biglide)
}
"""Names of kinds in machine.yaml and on the command line, mapped to their classes."""

USUAL = Orthoglide.kind
"""Default kind."""

MAX_COORDINATE = 100.0
"""Largest coordinate of a controller's joint in the mechanical zero, [m]."""


@dataclass(frozen=True, slots=True)
class Counting:
    """Relation of a controller's joint to the drive coordinate."""

    up: bool = True
    """True if the joint coordinate grows with the drive coordinate."""
    at_zero: float | None = None
    """Joint coordinate in the mechanical zero, [m]; None if it equals the drive coordinate."""


AS_DRIVE = Counting()
"""Joint coordinate that equals the drive coordinate."""


def find_counting_problem(counting: Sequence[Counting], count: int) -> str | None:
    """Problem of the stated joints of a machine; None without one.

    Args:
        counting: Stated joints.
        count: Number of drives.
    """
    if len(counting) != count:
        return f"has {len(counting)} joints; expected {count}"
    for joint in counting:
        zero = joint.at_zero
        if zero is not None and not (math.isfinite(zero) and abs(zero) <= MAX_COORDINATE):
            return f"{in_mm(zero)} mm in the mechanical zero; expected within ±{MAX_COORDINATE:g} m"
    return None


class CountingKeys(Keys):
    """Keys of a controller's joint."""

    counts: Literal["up", "down"] = "up"
    at_zero_mm: Number | None = None

    def to_counting(self) -> Counting:
        """Relation to the drive coordinate."""
        zero = self.at_zero_mm
        return Counting(self.counts == "up", None if zero is None else zero * MM)


def read_machine(path: Path) -> tuple[Dimensions, tuple[Counting, ...]]:
    """Read the dimensions of a machine and its joints.

    Raises:
        RobotError: If a key is invalid or a dimension is impossible; names file and key.
    """
    data = read_yaml(path, error=RobotError)
    name = data.get("kind", USUAL) if isinstance(data, dict) else USUAL
    kind = KINDS.get(name) if isinstance(name, str) else None
    if kind is None:
        raise RobotError(f"found {name!r}; expected {', '.join(KINDS)}", where=f"{path}: kind")
    keys: Any = validate(_keys_of(kind), data, where=str(path), error=RobotError)
    box, stated = keys.workspace_mm, {d: getattr(keys, d.key) for d in kind.keys}
    dimensions = kind(
        workspace=None if box is None else tuple((low * MM, high * MM) for low, high in box),
        **{d.name: d.to_si(v if d.separator else [v]) for d, v in stated.items()},
    )
    if problem := dimensions.find_problem():
        key = next(d.key for d in kind.keys if d.name == problem[0])
        raise RobotError(problem[1], where=f"{path}: {key}")
    counting = tuple(getattr(keys.joints, drive).to_counting() for drive in kind.drives_of())
    if joints_problem := find_counting_problem(counting, len(counting)):
        raise RobotError(joints_problem, where=f"{path}: joints")
    return dimensions, counting


def _keys_of(kind: type[Dimensions]) -> type[BaseModel]:
    """Model of the keys in the machine.yaml of a kind."""
    joints: dict[str, Any] = {d: (CountingKeys, CountingKeys()) for d in kind.drives_of()}
    count = len(kind.coordinates)
    box = Annotated[WorkspaceBox, Field(min_length=count, max_length=count)]
    joints_keys = create_model("JointsKeys", __base__=Keys, **joints)
    fields: dict[str, Any] = {
        "kind": (str, USUAL),
        **{d.key: (_type_of(d), ...) for d in kind.keys},
        "workspace_mm": (box | None, None),
        "joints": (joints_keys, joints_keys()),
    }
    return create_model("MachineKeys", __base__=Keys, **fields)


def _type_of(dimension: Dimension) -> Any:  # noqa: ANN401 - a type
    """Type of the value of a key in machine.yaml: a number, or a list of them."""
    if not dimension.separator:
        return Number
    count = dimension.count
    return Annotated[list[Number], Field(min_length=count, max_length=count)]


def machine_text(dimensions: Dimensions, counting: tuple[Counting, ...]) -> str:
    """Text of the machine.yaml of a machine, with the joints of its controller."""
    kind = type(dimensions)
    lines = [
        "# Dimensions of this machine, in mm. After a change, run in this directory:",
        "#   orthocal new . --again",
        f"kind: {kind.kind}",
    ]
    for d in kind.keys:
        lines += [f"# {line}" for line in d.comment.split("\n")]
        lines.append(f"{d.key}: {d.show(getattr(dimensions, d.name))}")
    box = box_text(dimensions.workspace)
    usual = box_text([(-0.06, 0.06)] * len(kind.coordinates))
    axes = f"{', '.join(kind.coordinates[:-1])} and {kind.coordinates[-1]}"
    lines += [
        f"# Limits of {axes} relative to the mechanical zero, where the tool works.",
        f"# Without them: {kind.usual_workspace}.",
        f"workspace_mm: {box}" if box else f"# workspace_mm: {usual}",
        "# Joints of the controller: whether they count up or down as the coordinate of a slide",
        f"# grows, and what they show {kind.at_zero}",
        f"# (by default {in_mm(dimensions.zero)}).",
        "joints:",
        *(
            f"  {drive}: {{{joint_text(joint)}}}"
            for drive, joint in zip(kind.drives_of(), counting, strict=True)
        ),
    ]
    return "\n".join(lines) + "\n"


def joint_text(joint: Counting) -> str:
    """YAML of a joint, for use within braces."""
    counts = f"counts: {'up' if joint.up else 'down'}"
    return counts if joint.at_zero is None else f"{counts}, at_zero_mm: {in_mm(joint.at_zero)}"


def drive_text(dimensions: Dimensions, joint: Counting) -> str:
    """YAML of a drive with its zero and joint, for use within braces."""
    zero = f"zero_mm: {in_mm(dimensions.zero)}"
    return zero if joint == AS_DRIVE else f"{zero}, joint: {{{joint_text(joint)}}}"
