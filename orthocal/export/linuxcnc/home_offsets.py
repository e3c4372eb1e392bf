"""What a controller's joints begin to count with: HOME_OFFSET and soft limits, old and new.

Homing leaves a joint at a place, that of its switch, and calls what it shows there HOME_OFFSET.
Where the drive really is there is not what it shows: offsets are what is missing. So, with the
direction s in which the joint counts, of what is to be entered less what is active already,

    HOME_OFFSET_new = HOME_OFFSET_old + s (o_new − o_active),

and soft limits, which belong to places of the slide, move along.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.assessment.controller_entries import find_entries
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ParameterError
from orthocal.units import DRIVE_UNITS, Unit

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class JointHome:
    """Where a joint of the controller begins to count, in its own direction."""

    drive: str
    unit: Unit
    direction: int
    """1 where the joint grows with the drive's coordinate, -1 where it falls."""
    change: float
    """What to add to HOME_OFFSET, MIN_LIMIT and MAX_LIMIT, [unit]."""
    old: float | None
    """HOME_OFFSET while measuring, [unit]; None where it was not said."""
    limits: tuple[float, float] | None
    """Least and largest that the joint could show while measuring, [unit]; infinite where nothing
    limits it. None where the session does not say which offset was active."""

    @property
    def new(self) -> float | None:
        """HOME_OFFSET to enter, [unit]; None where the old one was not said."""
        return None if self.old is None else self.old + self.change

    @property
    def new_limits(self) -> tuple[float, float] | None:
        """Limits to enter, [unit]."""
        if self.limits is None:
            return None
        return self.limits[0] + self.change, self.limits[1] + self.change

    @property
    def joint_unit(self) -> str:
        """Unit in which LinuxCNC has the joint: mm or deg."""
        return DRIVE_UNITS[self.unit][0]

    def show(self, value: float, *, sign: bool = False) -> str:
        """A value in that unit, to 0.1 µm or to a millionth of a degree."""
        unit, size = DRIVE_UNITS[self.unit]
        decimals = 4 if unit == "mm" else 6
        shown = round(value / size, decimals) + 0.0
        return f"{shown:{'+' if sign else ''}.{decimals}f}"


def find_homes(
    calibration: Calibration, *, old: Sequence[float] | None = None
) -> tuple[JointHome, ...]:
    """HOME_OFFSET and limits of each drive's joint, in the order of the drives.

    Args:
        calibration: The calibration.
        old: HOME_OFFSET while measuring of each joint, [m, rad].

    Raises:
        ParameterError: If there are not as many old values as drives.
    """
    drives = calibration.robot.drives
    if old is not None and len(old) != len(drives):
        names = ", ".join(d.name for d in drives)
        raise ParameterError(
            f"found {len(old)} values; expected {len(drives)}, of {names}", where="--home-offset"
        )
    changes = {e.drive: e.change for e in find_entries(calibration)}
    active = calibration.session.controller_offsets
    return tuple(
        JointHome(
            drive=d.name,
            unit=d.unit,
            direction=d.direction,
            change=d.direction * changes.get(d.name, 0.0),
            old=None if old is None else old[i],
            limits=None
            if active is None
            else (
                d.joint_limits[0] + d.direction * active[i],
                d.joint_limits[1] + d.direction * active[i],
            ),
        )
        for i, d in enumerate(drives)
    )
