"""Displacement of the drives by a controller that compensates backlash and errors of screws.

A controller adds a trim T to the commanded position of a joint. For a stated backlash b it is
T = s b/2, with s = ±1 the direction of the last motion. A table states the trims T₊ and T₋ for
positions of the joint. They are interpolated linearly, constant beyond the table, and replace the
backlash.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field

from orthocal.arrays import Array
from orthocal.effects.loading import robot_effects
from orthocal.io.documents import Number
from orthocal.io.fields import FileRecord, Matrix
from orthocal.robot.model import Drive, Robot


@dataclass(frozen=True, slots=True, eq=False)
class JointTrim(FileRecord):
    """Trim that a controller adds to the position of one joint, and the joint's home position."""

    backlash: Annotated[Number, Field(ge=0.0)] = 0.0
    """Compensated backlash, [m, rad]; a table replaces it."""
    table: Matrix | None = None
    """Ascending positions of the joint, trims after the position grew, and trims after it fell;
    shape (n, 3), [m, rad]."""
    home: Number | None = None
    """Position of the joint at its home switch (HOME_OFFSET), [m, rad]; None if not stated."""

    def __call__(self, joints: Array) -> Array:
        """Trims T₊ and T₋ in positions of the joint.

        Args:
            joints: Positions, shape (n,), [m, rad].

        Returns:
            Shape (n, 2), [m, rad].
        """
        if self.table is None:
            return np.tile([0.5 * self.backlash, -0.5 * self.backlash], (len(joints), 1))
        columns = [np.interp(joints, self.table[:, 0], self.table[:, k]) for k in (1, 2)]
        return np.stack(columns, axis=1)

    @property
    def lost_motion(self) -> float:
        """Compensated backlash; the mean over the rows of a table, [m, rad]."""
        if self.table is None:
            return self.backlash
        return float((self.table[:, 1] - self.table[:, 2]).mean())


MAX_COMP_FILE_ENTRIES = 256
"""Largest number of entries of a COMP_FILE of LinuxCNC."""

Compensation = tuple[JointTrim, ...]
"""Trim of the joint of each drive, in the robot's order; empty if not stated."""

SAME_TRIM = 1e-8
"""Largest difference between equal trims, [m, rad]. Files state them to 1e-6 mm or 1e-6 deg, which
rounds angles by up to 0.9e-8 rad."""


def compensates_alike(one: Sequence[JointTrim], other: Sequence[JointTrim]) -> bool:
    """True if two controllers have the same compensation; an empty sequence is no compensation."""
    no_trims = (JointTrim(),) * len(one or other)
    for a, b in zip(one or no_trims, other or no_trims, strict=True):
        positions = [t.table[:, 0] for t in (a, b) if t.table is not None]
        joints = np.concatenate([*positions, np.zeros(1)])
        if np.abs(a(joints) - b(joints)).max() > SAME_TRIM:
            return False
    return True


def with_homes(trims: Sequence[JointTrim], homes: Sequence[float | None] | None) -> Compensation:
    """Trims with other home positions, [m, rad]; without any if `homes` is None."""
    stated = [None] * len(trims) if homes is None else homes
    return tuple(replace(trim, home=home) for trim, home in zip(trims, stated, strict=True))


def home_positions(trims: Sequence[JointTrim]) -> tuple[float, ...] | None:
    """Home positions of all joints, [m, rad]; None unless all are stated."""
    homes = tuple(trim.home for trim in trims if trim.home is not None)
    return homes if homes and len(homes) == len(trims) else None


def displace_drives(
    robot: Robot, trims: Sequence[JointTrim], displayed: Array, sides: Array
) -> Array:
    """Displacement of the drives by the controller.

    Only trims of errors that the robot's effects describe are applied: the difference of both sides
    if an effect depends on the approach, the mean of both sides if an effect is periodic. Other
    trims are assumed to correct errors exactly.

    Args:
        robot: The robot with its effects.
        trims: Trim of the joint of each drive.
        displayed: Commanded drive coordinates with the active offsets, as the controller displays
            them, shape (n, n_drives), [m, rad].
        sides: 1 if the coordinate grew in the last motion, -1 if it fell, 0 for the mean of both
            sides, shape (n, n_drives).

    Returns:
        Displacements, shape (n, n_drives), [m, rad].
    """
    effects = robot_effects(robot)
    has_backlash = any("approach" in e.conditions for e in effects)
    is_periodic = any(e.period is not None for e in effects)
    result = np.zeros(displayed.shape)
    for i, (drive, trim) in enumerate(zip(robot.drives, trims, strict=True)):
        values = trim(drive.to_joint(displayed[:, i]))
        if has_backlash:
            result[:, i] += sides[:, i] * 0.5 * (values[:, 0] - values[:, 1])
        if is_periodic:
            result[:, i] += drive.direction * values.mean(axis=1)
    return result


def describe_trims(robot: Robot, trims: Sequence[JointTrim]) -> str:
    """Description of the compensation of each drive; "" if there is none."""
    texts = []
    for drive, trim in zip(robot.drives, trims, strict=False):  # there may be no trims
        if trim.table is not None:
            texts.append(f"{drive.name} by a table")
        elif trim.backlash:
            texts.append(f"{drive.name} {drive.show(trim.backlash)}")
    return ", ".join(texts)


def table_name(joint: int) -> str:
    """File name of the table of a joint (COMP_FILE of LinuxCNC)."""
    return f"joint_{joint}.comp"


def format_table(trim: JointTrim, drive: Drive) -> str:
    """Text of a trim's table in mm or degrees, in the columns of `JointTrim.table`; "" without."""
    if trim.table is None:
        return ""
    rows = trim.table / drive.joint_size
    return "".join(" ".join(f"{v:.6f}" for v in row) + "\n" for row in rows)
