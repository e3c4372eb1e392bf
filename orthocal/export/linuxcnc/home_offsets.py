"""HOME_OFFSET and soft limits of the controller's joints, before and after a calibration.

Homing assigns HOME_OFFSET to the joint at its switch. An offset o is the difference between the
drive's coordinate and the one that the joint displays. With the direction s of the joint,

    HOME_OFFSET_new = HOME_OFFSET_old + s (o_new − o_active),

less the change of the trim with which the controller compensates backlash and periodic errors in
the direction in which it latches the home switch (`drive_compensation.py`). Soft limits belong to
positions of the slide and change by s (o_new − o_active).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.assessment.controller_entries import find_entries, offsets_to_enter
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ParameterError
from orthocal.export.linuxcnc.drive_compensation import JointCompensation
from orthocal.units import DRIVE_UNITS, Unit, format_fixed


@dataclass(frozen=True, slots=True, eq=False)
class JointHome:
    """HOME_OFFSET and soft limits of a joint."""

    drive: str
    unit: Unit
    direction: int
    """1 if the joint grows with the drive's coordinate, -1 if it falls."""
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
        """Soft limits to enter, [unit]."""
        if self.limits is None:
            return None
        return self.limits[0] + self.limit_change, self.limits[1] + self.limit_change

    @property
    def joint_unit(self) -> str:
        """Unit of the joint in LinuxCNC: mm or deg."""
        return DRIVE_UNITS[self.unit][0]

    @property
    def counting(self) -> str:
        """Direction in which the joint counts: up or down."""
        return "up" if self.direction > 0 else "down"

    def show(self, value: float, *, sign: bool = False) -> str:
        """Value in the joint's unit: to 1 µm, to 0.1 µm where it has more, or to 1e-6 degrees."""
        unit, size = DRIVE_UNITS[self.unit]
        text = format_fixed(value / size, 4 if unit == "mm" else 6, sign=sign)
        return text.removesuffix("0")


def find_homes(
    calibration: Calibration,
    compensation: Sequence[JointCompensation],
    before: Sequence[JointCompensation],
    *,
    old: Sequence[float] | None = None,
) -> tuple[JointHome, ...]:
    """HOME_OFFSET and limits of each drive's joint, in the order of the drives.

    Args:
        calibration: The calibration.
        compensation: Compensation of each joint by the controller.
        before: Compensation during the measurement.
        old: HOME_OFFSET of each joint during the measurement, [m, rad].

    Raises:
        ParameterError: If the number of old values is not that of the drives.
    """
    drives = calibration.robot.drives
    if old is not None and len(old) != len(drives):
        names = ", ".join(d.name for d in drives)
        raise ParameterError(
            f"found {len(old)} values; expected {len(drives)}, of {names}", where="--home-offset"
        )
    entered = {e.drive for e in find_entries(calibration)}
    changes = offsets_to_enter(calibration) - calibration.active_offsets
    active = calibration.session.controller_offsets
    homes = []
    for i, d in enumerate(drives):
        limits = None
        if active is not None:
            lowest, highest = np.array(d.joint_limits) + d.direction * active[i]
            limits = float(lowest), float(highest)
        change = d.direction * float(changes[i]) if d.name in entered else 0.0
        home, joint = None if old is None else old[i], compensation[i]
        by_trim = [0.0, 0.0]
        for k, opposite in enumerate((False, True)):
            trim = was = before[i].trim_at_home(home, opposite=opposite)
            for _ in range(2):  # a table is nearly constant over a trim
                place = None if home is None else home + change + was - trim
                trim = joint.trim_at_home(place, opposite=opposite)
            by_trim[k] = change + was - trim
        homes.append(
            JointHome(
                drive=d.name,
                unit=d.unit,
                direction=d.direction,
                change=by_trim[0],
                limit_change=change,
                old=home,
                opposite=by_trim[1],
                compensation=joint,
                was=before[i],
                limits=limits,
            )
        )
    return tuple(homes)
