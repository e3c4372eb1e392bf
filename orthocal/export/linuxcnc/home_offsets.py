"""HOME_OFFSET and soft limits of the controller's joints, before and after a calibration.

Homing assigns HOME_OFFSET to the joint at its switch. An offset o is the difference between the
drive coordinate and the displayed coordinate of the joint. With the direction s of the joint and
the change ΔT of the trim at the home switch (`drive_compensation.py`),

    HOME_OFFSET_new = HOME_OFFSET_old + s (o_new − o_active) − ΔT.

Soft limits are positions of the slide. They change by s (o_new − o_active). If the switch is at a
limit, HOME_OFFSET would be outside by ΔT, and the limit is widened.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.assessment.controller_entries import find_entries, offsets_to_enter
from orthocal.assessment.wording import counted
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ParameterError
from orthocal.export.linuxcnc.drive_compensation import JointCompensation
from orthocal.robot.model import Drive
from orthocal.units import format_fixed

SAME_POSITION = 1e-9
"""Largest difference between equal positions of a joint, [m, rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class JointHome:
    """HOME_OFFSET and soft limits of a joint."""

    drive: Drive
    change: float
    """Change of HOME_OFFSET, [unit]."""
    limit_change: float
    """Change of MIN_LIMIT and MAX_LIMIT, [unit]."""
    old: float | None
    """HOME_OFFSET during the measurement, [unit]; None if unknown."""
    opposite: float
    """Change of HOME_OFFSET if homing latches the switch in the other direction, [unit]."""
    compensation: JointCompensation
    was: JointCompensation
    """Compensation during the measurement."""
    limits: tuple[float, float] | None
    """Soft limits during the measurement, [unit]; infinite without a limit. None if the session
    does not state the active offsets."""

    @property
    def new(self) -> float | None:
        """HOME_OFFSET to enter, [unit]; None if the old one is unknown."""
        return None if self.old is None else self.old + self.change

    @property
    def new_limits(self) -> tuple[float, float] | None:
        """Soft limits to enter, [unit].

        They contain HOME_OFFSET if it was within the limits during the measurement.
        """
        if self.limits is None:
            return None
        low, high = (limit + self.limit_change for limit in self.limits)
        if self.old is not None and self.new is not None:
            # the trim at the switch displaces HOME_OFFSET, but not the limits
            if self.old > self.limits[0] - SAME_POSITION:
                low = min(low, self.new)
            if self.old < self.limits[1] + SAME_POSITION:
                high = max(high, self.new)
        return low, high

    @property
    def compensation_changes(self) -> bool:
        """True if the compensation at a position of the slide differs from the measurement's."""
        new, old = self.compensation, self.was
        if new.table is None or old.table is None:
            return new.table is not old.table or abs(new.backlash - old.backlash) > SAME_POSITION
        return not np.array_equal(new.table[:, 1:], old.table[:, 1:])

    @property
    def counting(self) -> str:
        """Direction in which the joint counts: up or down."""
        return "up" if self.drive.direction > 0 else "down"

    def show(self, value: float, *, sign: bool = False) -> str:
        """Value in the joint's unit, to 0.1 µm or 1e-6 degrees, without a last zero."""
        decimals = 4 if self.drive.unit == "m" else 6
        text = format_fixed(value / self.drive.joint_size, decimals, sign=sign)
        return text.removesuffix("0")


def find_homes(
    calibration: Calibration,
    compensation: Sequence[JointCompensation],
    before: Sequence[JointCompensation],
    old: Sequence[float] | None = None,
    stated_limits: Sequence[tuple[float, float]] | None = None,
) -> tuple[JointHome, ...]:
    """HOME_OFFSET and limits of each drive's joint, in the order of the drives.

    Args:
        calibration: The calibration.
        compensation: New compensation of each joint by the controller.
        before: Compensation during the measurement.
        old: HOME_OFFSET of each joint during the measurement, [m, rad].
        stated_limits: Soft limits of each joint during the measurement, [m, rad]. The narrower ones
            of these and of the robot's travel count, except for a stated limit at HOME_OFFSET.

    Raises:
        ParameterError: If the numbers of old values or limits and of drives differ, or stated
            limits and travel exclude each other.
    """
    drives = calibration.robot.drives
    _require_one_each(drives, old, "value", "--home-offset")
    _require_one_each(drives, stated_limits, "range", "--ini")
    entered = {e.drive for e in find_entries(calibration)}
    changes = offsets_to_enter(calibration) - calibration.active_offsets
    active = calibration.session.controller_offsets
    homes = []
    for i, d in enumerate(drives):
        home, joint = None if old is None else old[i], compensation[i]
        limits = None if stated_limits is None else stated_limits[i]
        if active is not None:
            travel = np.array(d.joint_limits) + d.direction * active[i]
            limits = _intersect(f"JOINT_{i}", d, travel.tolist(), limits, home)
        change = d.direction * float(changes[i]) if d.name in entered else 0.0
        home_changes = [0.0, 0.0]
        for k, opposite in enumerate((False, True)):
            trim = old_trim = before[i].trim_at_home(home, opposite=opposite)
            for _ in range(2):  # converges because a table is nearly constant over such a change
                new_home = None if home is None else home + change + old_trim - trim
                trim = joint.trim_at_home(new_home, opposite=opposite)
            home_changes[k] = change + old_trim - trim
        homes.append(
            JointHome(
                drive=d,
                change=home_changes[0],
                limit_change=change,
                old=home,
                opposite=home_changes[1],
                compensation=joint,
                was=before[i],
                limits=limits,
            )
        )
    return tuple(homes)


def _require_one_each(
    drives: Sequence[Drive], values: Sequence[object] | None, noun: str, option: str
) -> None:
    """Refuse another number of values than of drives.

    Raises:
        ParameterError: If the numbers differ.
    """
    if values is not None and len(values) != len(drives):
        names = ", ".join(d.name for d in drives)
        raise ParameterError(
            f"found {counted(len(values), noun)}; expected {len(drives)}, one for each of {names}",
            where=option,
        )


def _intersect(
    joint: str,
    drive: Drive,
    travel: Sequence[float],
    stated: tuple[float, float] | None,
    home: float | None,
) -> tuple[float, float]:
    """Limits that a joint's travel and its stated limits have in common, [unit].

    A stated limit at HOME_OFFSET counts beyond the travel: an earlier export has widened it.

    Raises:
        ParameterError: If stated limits and travel exclude each other.
    """
    low, high = stated or (-np.inf, np.inf)
    at_low, at_high = (
        home is not None and abs(home - limit) < SAME_POSITION for limit in (low, high)
    )
    lowest = low if at_low else max(travel[0], low)
    highest = high if at_high else min(travel[1], high)
    if stated is not None and lowest >= highest:
        limits, possible = (f"{drive.show(a)} to {drive.show(b)}" for a, b in (stated, travel))
        raise ParameterError(
            f"{joint} ({drive.name}) has soft limits {limits}; the travel of the drive is "
            f"{possible}: expected limits within the travel",
            where="--ini",
        )
    return lowest, highest
