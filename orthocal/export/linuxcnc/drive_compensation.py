"""Compensation of the drives' backlash and periodic errors by LinuxCNC: BACKLASH and COMP_FILE.

LinuxCNC adds a trim T to the commanded position j of a joint, on the side s = ±1 of its last
motion:

    motor = j + T_s(j) − T_l(h) + constant,  T_s(j) = s b/2 with BACKLASH = b.

Homing latches the switch in the direction l and displays HOME_OFFSET h there. The motor's position
at the switch does not depend on the trim, because T_l(h) is subtracted. To shift the display by Δ,
enter

    h_new = h_old + Δ + T_l(h_old) − T_l(h_new),

where T_l(h_old) is the trim of the compensation that was active during the measurement.

A table of COMP_FILE (type 1) lists T₊ and T₋ over the travel and replaces BACKLASH. It has at most
256 entries. If a kinematics module is exported, it corrects the mean of T₊ and T₋, which contains
the periodic errors. BACKLASH or COMP_FILE then contain only the difference of the two sides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array
from orthocal.assessment.controller_entries import (
    ENTERED_DECIMALS,
    find_backlash,
    find_screw_effect,
    find_screws,
    offsets_to_enter,
)
from orthocal.calibration.calibration import Calibration
from orthocal.effects.backlash import Backlash
from orthocal.effects.compensation import MAX_COMP_FILE_ENTRIES, JointTrim, table_name
from orthocal.effects.loading import robot_effects
from orthocal.effects.screw import SCREW_COMPONENTS, Screw
from orthocal.errors import ExportError, ParameterError
from orthocal.io.fields import read_only
from orthocal.robot.model import Drive, Robot
from orthocal.units import UM

NEGLIGIBLE = 0.1 * UM
"""Smallest backlash and amplitude that are compensated, [m or rad]."""

MAX_ITERATIONS = 20
"""Number of fixed-point iterations of `PeriodicErrors.invert`."""

CHECKS_PER_INTERVAL = 8
"""Number of intervals between two entries at whose ends a table is compared with exact trims."""


@dataclass(frozen=True, slots=True, eq=False)
class PeriodicErrors:
    """Periodic errors of the drives' screws: A sin(2πρ/lead) + B cos(2πρ/lead)."""

    lead: float
    """Lead of the screws, [m]."""
    sine: Array
    """A, shape (n_drives,), [m]; 0 for drives without a periodic error."""
    cosine: Array
    """B, shape (n_drives,), [m]; 0 for drives without a periodic error."""

    def of_drive(self, i: int) -> PeriodicErrors:
        """Periodic errors of one drive, whose coordinates have any shape."""
        return PeriodicErrors(self.lead, self.sine[i], self.cosine[i])

    def __call__(self, coordinates: ArrayLike) -> Array:
        """Errors at commanded coordinates, shape (..., n_drives), [m]."""
        phase = 2.0 * np.pi * np.asarray(coordinates, dtype=np.float64) / self.lead
        return np.asarray(self.sine * np.sin(phase) + self.cosine * np.cos(phase))

    def invert(self, positions: ArrayLike) -> Array:
        """Commanded coordinates that bring the screws to positions, shape (..., n_drives), [m]."""
        target = np.asarray(positions, dtype=np.float64)
        coordinates = target
        for _ in range(MAX_ITERATIONS):
            coordinates = target - self(coordinates)
        return np.asarray(coordinates)


def find_periodic_errors(robot: Robot, errors: Mapping[str, float]) -> PeriodicErrors | None:
    """Periodic errors of a machine; None without any.

    Args:
        robot: The robot.
        errors: Values by parameter name, [SI].
    """
    screw = find_screw_effect(robot)
    if screw is None:
        return None
    sine, cosine = (
        np.array([errors.get(f"{d.name}.{kind}", 0.0) for d in robot.drives])
        for kind in SCREW_COMPONENTS
    )
    if np.hypot(sine, cosine).max() < NEGLIGIBLE:
        return None
    return PeriodicErrors(screw.lead, read_only(sine), read_only(cosine))


def without_periodic_errors(robot: Robot, errors: Mapping[str, float]) -> dict[str, float]:
    """Errors of a machine without the periodic errors of its screws."""
    screw = find_screw_effect(robot)
    periodic = set() if screw is None else {error.name for error in screw.errors}
    return {name: value for name, value in errors.items() if name not in periodic}


@dataclass(frozen=True, slots=True, eq=False)
class JointCompensation(JointTrim):
    """Compensation of one joint, with the direction in which homing latches its switch."""

    latched: int = 0
    """Sign of HOME_LATCH_VEL, 1 or -1; 0 if unknown, which counts as 1."""
    error: float = 0.0
    """Largest error of the joint after compensation, [m, rad]: interpolation error of a table, or
    error of a constant BACKLASH, because backlash shifts the phase of a periodic error."""
    with_module: bool = False
    """True if a kinematics module corrects the periodic errors."""

    def file_name(self, joint: int) -> str:
        """File name of the table of joint number `joint`."""
        name = table_name(joint)
        return name.replace(".comp", "_module.comp") if self.with_module else name

    def trim_at_home(self, home: float | None, *, opposite: bool = False) -> float:
        """T_l: trim in the latching direction at HOME_OFFSET, [m, rad].

        Args:
            home: HOME_OFFSET, [m, rad]; if it is None, the trim of a table is 0.
            opposite: Whether homing latches in the other direction.
        """
        if self.table is not None and home is None:
            return 0.0
        positive = self.latches_upwards != opposite
        return float(self(np.array([home or 0.0]))[0, 0 if positive else 1])

    @property
    def latches_upwards(self) -> bool:
        """True if homing latches the switch while the joint counts up, or by assumption."""
        return self.latched >= 0


def find_active_compensation(
    calibration: Calibration,
    latched: Sequence[int] | None,
    trims: Sequence[JointTrim] | None = None,
) -> tuple[JointCompensation, ...]:
    """Compensation of joints whose homing latches in some direction, in the order of the drives.

    Args:
        calibration: The calibration.
        latched: Sign of HOME_LATCH_VEL of each joint; 0 or None if unknown, which counts as 1.
        trims: Compensation of the joints, empty for none; by default the one that was active during
            the measurement.

    Raises:
        ParameterError: If the numbers of directions and drives differ.
    """
    drives, stated = calibration.robot.drives, calibration.session.compensation
    trims = (stated if trims is None else trims) or (JointTrim(),) * len(drives)
    signs = (0,) * len(drives) if latched is None else tuple(latched)
    if len(signs) != len(drives):
        names = ", ".join(d.name for d in drives)
        raise ParameterError(
            f"found {len(signs)} signs; expected the sign of HOME_LATCH_VEL of each joint "
            f"({names}), such as +,+,-",
            where="--latched",
        )
    return tuple(
        JointCompensation(trim.backlash, trim.table, trim.home, latched=sign)
        for trim, sign in zip(trims, signs, strict=True)
    )


def find_compensation(
    calibration: Calibration, latched: Sequence[int] | None
) -> tuple[JointCompensation, ...]:
    """Compensation of backlash to enter, in the order of the drives.

    If the model has neither backlash nor periodic errors, the active compensation is unchanged.

    Raises:
        ParameterError: If the numbers of directions and drives differ.
        ExportError: If tables were active, and the model has only one of both effects.
    """
    robot, active = calibration.robot, find_active_compensation(calibration, latched)
    modelled = {type(e) for e in robot_effects(robot)} & {Backlash, Screw}
    if not modelled:
        return active
    if len(modelled) < 2 and any(joint.table is not None for joint in active):
        raise ExportError(
            "the controller has tables (comp_file) of backlash and periodic errors; identify both "
            "with --effects backlash,screw"
        )
    if Backlash not in modelled:
        return active
    enter = {e.drive: e.enter for e in find_backlash(calibration)}
    backlash = [
        enter.get(d.name, joint.backlash) for d, joint in zip(robot.drives, active, strict=True)
    ]
    return tuple(
        JointCompensation(b if b >= NEGLIGIBLE else 0.0, latched=joint.latched)
        for b, joint in zip(backlash, active, strict=True)
    )


def round_backlash(
    compensation: Sequence[JointCompensation], active: Sequence[JointCompensation]
) -> tuple[JointCompensation, ...]:
    """Round each changed BACKLASH to the printed decimals.

    Args:
        compensation: Compensation to enter.
        active: Compensation during the measurement.
    """
    return tuple(
        joint
        if joint.table is not None or joint.backlash == old.backlash
        else replace(joint, backlash=round(joint.backlash, ENTERED_DECIMALS))
        for joint, old in zip(compensation, active, strict=True)
    )


def tabulate(
    calibration: Calibration,
    compensation: Sequence[JointCompensation],
    active: Sequence[JointCompensation],
    offsets: Array,
) -> tuple[JointCompensation, ...]:
    """Tables of backlash and periodic errors, for joints with significant periodic errors.

    Args:
        calibration: The calibration.
        compensation: Compensation of backlash.
        active: Compensation during the measurement; unchanged tables are kept.
        offsets: Offsets in the controller with these tables, shape (n_drives,), [m, rad].

    Raises:
        ExportError: If a drive with a periodic error has no limits of travel.
    """
    robot = calibration.robot
    screws = find_screws(calibration)
    values = {name: v for e in screws for name, v in e.values.items()}
    periodic = find_periodic_errors(robot, values)
    if periodic is None:
        return tuple(compensation)
    changed = {e.drive for e in screws if e.change.any()}
    changed |= {e.drive for e in find_backlash(calibration) if e.change}
    tabulated = []
    for i, (d, joint, old) in enumerate(zip(robot.drives, compensation, active, strict=True)):
        if old.table is not None and d.name not in changed:
            tabulated.append(old)
            continue
        if not (periodic.sine[i] or periodic.cosine[i]):
            tabulated.append(joint)
            continue
        if not np.isfinite([d.lower, d.upper]).all():
            raise ExportError(
                f"{d.name} has no limits of travel, which a table of its periodic error needs; "
                "state them in the URDF"
            )
        travel = d.to_joint(np.array([d.lower, d.upper]) + offsets[i])
        trims = _Trims(d, offsets[i], 0.5 * joint.backlash, periodic.of_drive(i))
        tabulated.append(_tabulate_joint(joint, trims, np.sort(travel)))
    return tuple(tabulated)


def compensate_with_offsets(
    calibration: Calibration, latched: Sequence[int] | None = None
) -> tuple[JointCompensation, ...]:
    """Compensation to enter together with the offsets: BACKLASH, or a table that contains it.

    Tables that are kept move with the display of their joints, so that the trim at each position of
    the slide remains.

    Args:
        calibration: The calibration.
        latched: Sign of HOME_LATCH_VEL of each joint; 0 or None if unknown, which counts as 1.

    Raises:
        ParameterError: If the numbers of directions and drives differ.
        ExportError: If tables were active, and the model has only one of both effects; or a drive
            with a periodic error has no limits of travel.
    """
    active = find_active_compensation(calibration, latched)
    compensation = find_compensation(calibration, latched)
    offsets = offsets_to_enter(calibration)
    compensation = tabulate(calibration, compensation, active, offsets)
    shifts = offsets - calibration.active_offsets
    moved = []
    for d, joint, old, shift in zip(
        calibration.robot.drives, compensation, active, shifts.tolist(), strict=True
    ):
        if joint.table is not None and joint.table is old.table and shift:
            positions = np.array([d.direction * shift, 0.0, 0.0])
            joint = replace(joint, table=read_only(joint.table + positions))
        moved.append(joint)
    return round_backlash(moved, active)


def compensate_with_module(
    calibration: Calibration,
    compensation: Sequence[JointCompensation],
    active: Sequence[JointCompensation],
) -> tuple[JointCompensation, ...]:
    """Compensation of backlash for use with a kinematics module that corrects periodic errors.

    If a joint had a table during the measurement, a new table replaces it. It contains the
    difference of the two sides: the backlash, and the difference of the periodic error between
    both sides. If the model has neither effect, the table is kept.

    Args:
        calibration: The calibration.
        compensation: Compensation of backlash.
        active: Compensation during the measurement.
    """
    robot, offsets = calibration.robot, calibration.active_offsets
    periodic = find_periodic_errors(robot, calibration.errors)
    compensated = []
    for i, (joint, old) in enumerate(zip(compensation, active, strict=True)):
        half = 0.5 * joint.backlash
        if joint.table is None and old.table is not None:
            of_drive = periodic and periodic.of_drive(i)
            trims = _Trims(robot.drives[i], offsets[i], half, of_drive, with_module=True)
            table = _tabulate_joint(joint, trims, old.table[[0, -1], 0])
            compensated.append(replace(table, with_module=True))
        elif joint.table is None and periodic is not None:
            slope = 2.0 * np.pi / periodic.lead * np.hypot(periodic.sine[i], periodic.cosine[i])
            compensated.append(replace(joint, error=float(slope) * half))
        else:
            compensated.append(joint)
    return tuple(compensated)


@dataclass(frozen=True, slots=True, eq=False)
class _Trims:
    """Exact trims of a joint as a function of its position."""

    drive: Drive
    offset: float
    """Offset in the controller, [m, rad]."""
    half: float
    """Half of the backlash, [m, rad]."""
    periodic: PeriodicErrors | None
    with_module: bool = False
    """True if a kinematics module already corrects the mean of both sides."""

    def __call__(self, joints: Array) -> Array:
        """Trims of both sides at positions (n,) of the joint, shape (n, 2), [m, rad]."""
        direction, periodic = self.drive.direction, self.periodic
        commanded = self.drive.from_joint(joints) - self.offset
        target = commanded
        if self.with_module and periodic is not None:
            target = commanded + periodic(commanded)
        columns = []
        for side in (1.0, -1.0):
            trimmed = target + direction * side * self.half
            trimmed = trimmed if periodic is None else periodic.invert(trimmed)
            columns.append(direction * (trimmed - commanded))
        return np.stack(columns, axis=1)


def _tabulate_joint(joint: JointCompensation, trims: _Trims, travel: Array) -> JointCompensation:
    """Joint with a table of its trims over a range of positions, shape (2,), [m, rad]."""
    low, high = travel.tolist()
    positions = np.linspace(low, high, MAX_COMP_FILE_ENTRIES)
    checks = np.linspace(low, high, CHECKS_PER_INTERVAL * (MAX_COMP_FILE_ENTRIES - 1) + 1)
    table = np.column_stack([positions, trims(positions)])
    exact = trims(checks)
    linear = np.stack([np.interp(checks, positions, table[:, k]) for k in (1, 2)], axis=1)
    return replace(joint, table=read_only(table), error=float(np.abs(linear - exact).max()))
