"""Compensation of the drives' backlash and periodic errors by LinuxCNC: BACKLASH and COMP_FILE.

LinuxCNC adds a trim T to the commanded position j of a joint, on the side s = ±1 of its last
motion:

    motor = j + T_s(j) − T_l(h) + constant,  T_s(j) = s b/2 with BACKLASH = b.

Homing latches the switch in the direction l and displays HOME_OFFSET h there, so that the trim of
that direction does not change the motor's position at the switch. With the wanted displacement Δ of
the display HOME_OFFSET is therefore

    h_new = h_old + Δ − T_l(h_new).

A table of COMP_FILE (type 1) lists T₊ and T₋ over the travel and replaces BACKLASH.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.calibration.calibration import Calibration
from orthocal.effects.backlash import Backlash
from orthocal.effects.loading import robot_effects
from orthocal.effects.screw import KINDS, Screw
from orthocal.errors import ExportError, ParameterError
from orthocal.io.fields import read_only
from orthocal.robot.model import Robot
from orthocal.units import DRIVE_UNITS, UM

SMALLEST = 0.1 * UM
"""Smallest backlash and amplitude that is compensated, [m or rad]."""

MOST_ENTRIES = 256
"""Largest number of entries of a COMP_FILE."""

MOST_ITERATIONS = 20

CHECKED_BETWEEN = 8
"""Positions between two entries at which a table is compared with the exact trim."""


@dataclass(frozen=True, slots=True, eq=False)
class PeriodicErrors:
    """Periodic errors of the drives' screws: A sin(2πρ/lead) + B cos(2πρ/lead)."""

    lead: float
    """[m]."""
    sine: Array
    cosine: Array
    """A and B, shape (n_drives,), [m]; 0 for drives without one."""

    def __call__(self, coordinates: ArrayLike) -> Array:
        """Errors at commanded coordinates, shape (..., n_drives), [m]."""
        phase = 2.0 * np.pi * np.asarray(coordinates, dtype=np.float64) / self.lead
        return np.asarray(self.sine * np.sin(phase) + self.cosine * np.cos(phase))

    def invert(self, positions: ArrayLike) -> Array:
        """Commanded coordinates at which the screws are at positions, shape (..., n_drives)."""
        wanted = np.asarray(positions, dtype=np.float64)
        coordinates = wanted
        for _ in range(MOST_ITERATIONS):
            coordinates = wanted - self(coordinates)
        return np.asarray(coordinates)


def find_periodic_errors(robot: Robot, errors: Mapping[str, float]) -> PeriodicErrors | None:
    """Periodic errors of a machine; None if there are none.

    Args:
        robot: The robot.
        errors: Parameter to value, [SI].
    """
    screw = next((e for e in robot_effects(robot) if isinstance(e, Screw)), None)
    if screw is None:
        return None
    sine, cosine = (
        np.array([errors.get(f"{d.name}.{kind}", 0.0) for d in robot.drives]) for kind in KINDS
    )
    if np.hypot(sine, cosine).max() < SMALLEST:
        return None
    return PeriodicErrors(screw.lead, read_only(sine), read_only(cosine))


def without_periodic_errors(robot: Robot, errors: Mapping[str, float]) -> dict[str, float]:
    """Errors of a machine whose screws have no periodic error."""
    screws = [e for e in robot_effects(robot) if isinstance(e, Screw)]
    periodic = {error.name for screw in screws for error in screw.errors}
    return {name: value for name, value in errors.items() if name not in periodic}


def find_backlash(robot: Robot, errors: Mapping[str, float]) -> Array:
    """Backlash of each drive, 0 where none is worth compensating, shape (n_drives,), [m, rad]."""
    if not any(isinstance(e, Backlash) for e in robot_effects(robot)):
        return np.zeros(len(robot.drives))
    values = np.array([errors.get(f"{d.name}.backlash", 0.0) for d in robot.drives])
    return np.where(values < SMALLEST, 0.0, values)


@dataclass(frozen=True, slots=True, eq=False)
class JointCompensation:
    """Compensation of one joint."""

    backlash: float
    """BACKLASH, [m, rad]; with a table the part of its columns."""
    latched: int
    """Sign of HOME_LATCH_VEL; 0 where it does not matter."""
    table: Array | None = None
    """Position, forward trim and reverse trim, shape (n, 3), [m]."""
    error: float = 0.0
    """Largest error of the table between its entries, [m]."""

    def trim_at_home(self, home: float | None) -> float:
        """T_l: trim in the latching direction at HOME_OFFSET, [m, rad].

        Args:
            home: HOME_OFFSET, [m, rad]; it only matters for a table.
        """
        if self.table is None or home is None:
            return 0.5 * self.backlash * self.latched
        column = 1 if self.latched > 0 else 2
        return float(np.interp(home, self.table[:, 0], self.table[:, column]))


def require_latched(
    robot: Robot, backlash: Array, latched: Sequence[int] | None
) -> tuple[int, ...]:
    """Directions in which homing latches the switches, where backlash needs them.

    Args:
        robot: The robot.
        backlash: Backlash of each drive, [m, rad].
        latched: Stated directions, 1 or -1.

    Raises:
        ParameterError: If they are missing, or not as many as the drives.
    """
    drives = robot.drives
    if latched is None and not backlash.any():
        return (0,) * len(drives)
    names = ", ".join(d.name for d in drives)
    expected = f"expected the sign of HOME_LATCH_VEL of each joint ({names}), such as +,+,-"
    if latched is None:
        unit, size = DRIVE_UNITS[drives[0].unit]
        listed = ", ".join(f"{v / size:.3f}" for v in backlash)
        raise ParameterError(
            f"is missing; the drives have backlash ({listed} {unit}), and HOME_OFFSET depends on "
            f"the direction in which homing latches the switch; {expected}",
            where="--latched",
        )
    if len(latched) != len(drives):
        raise ParameterError(f"found {len(latched)} signs; {expected}", where="--latched")
    return tuple(latched)


def find_compensation(
    calibration: Calibration, latched: Sequence[int] | None
) -> tuple[JointCompensation, ...]:
    """Compensation of backlash alone, in the order of the drives.

    Raises:
        ParameterError: As `require_latched`.
    """
    robot = calibration.robot
    backlash = find_backlash(robot, calibration.errors)
    signs = require_latched(robot, backlash, latched)
    return tuple(
        JointCompensation(float(b), sign if b else 0)
        for b, sign in zip(backlash, signs, strict=True)
    )


def tabulate(
    calibration: Calibration,
    compensation: Sequence[JointCompensation],
    offsets: Array,
    *,
    latched: Sequence[int] | None,
) -> tuple[JointCompensation, ...]:
    """Tables of backlash and periodic errors, for joints whose screws have periodic errors.

    Args:
        calibration: The calibration.
        compensation: Compensation of backlash.
        offsets: Offsets in the controller with which the tables are used, (n_drives,), [m, rad].
        latched: Stated latching directions.

    Raises:
        ParameterError: If these are missing.
        ExportError: If a drive with a periodic error has no limits of travel.
    """
    robot = calibration.robot
    periodic = find_periodic_errors(robot, calibration.errors)
    if periodic is None:
        return tuple(compensation)
    signs = require_latched(robot, np.hypot(periodic.sine, periodic.cosine), latched)
    result = []
    for i, (d, joint) in enumerate(zip(robot.drives, compensation, strict=True)):
        if not (periodic.sine[i] or periodic.cosine[i]):
            result.append(joint)
            continue
        if not np.isfinite([d.lower, d.upper]).all():
            raise ExportError(
                f"{d.name} has no limits of travel over which a table of its periodic error "
                "extends; state them in the URDF"
            )

        def trims(joints: Array, i: int = i, half: float = 0.5 * joint.backlash) -> Array:
            """Trims of both sides of the joint, shape (n, 2), [m]."""
            drive = robot.drives[i]
            wanted = np.tile(robot.drive_zero, (len(joints), 1))
            wanted[:, i] = drive.from_joint(joints) - offsets[i]
            columns = []
            for side in (1.0, -1.0):
                at = np.array(wanted)
                at[:, i] += drive.direction * side * half
                columns.append(drive.direction * (periodic.invert(at) - wanted)[:, i])
            return np.stack(columns, axis=1)

        low, high = np.sort(d.to_joint(np.array([d.lower, d.upper]) + offsets[i])).tolist()
        places = np.linspace(low, high, MOST_ENTRIES)
        between = np.linspace(low, high, CHECKED_BETWEEN * (MOST_ENTRIES - 1) + 1)
        table = np.column_stack([places, trims(places)])
        exact = trims(between)
        linear = np.stack([np.interp(between, places, table[:, k]) for k in (1, 2)], axis=1)
        error = float(np.abs(linear - exact).max())
        result.append(JointCompensation(joint.backlash, signs[i], read_only(table), error))
    return tuple(result)


def write_table(joint: JointCompensation) -> str:
    """Text of a COMP_FILE of type 1: position, forward and reverse trim, in mm."""
    if joint.table is None:
        return ""
    rows = (" ".join(f"{v / DRIVE_UNITS['m'][1]:.6f}" for v in row) for row in joint.table)
    return "".join(f"{row}\n" for row in rows)
