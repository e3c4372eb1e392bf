"""Sizes of a machine of the Orthoglide's kind, how its joints count, and which make no machine."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from orthocal.errors import RobotError
from orthocal.units import MM

SHORTEST_LEG, LONGEST_LEG = 0.02, 5.0
"""[m]"""

STEEPEST = 0.9
"""Sine of the largest angle that legs turn by at the ends of a drive's travel."""

LARGEST_SHOWN = 100.0
"""No joint of such a machine shows more in its zero, [m]."""


@dataclass(frozen=True, slots=True)
class Sizes:
    """Of a machine of the Orthoglide's kind, [m]."""

    leg: float = 0.31025
    """Length of a leg, from hinge to hinge of a rod."""
    lower: float = 0.12
    """Least coordinate of a drive: distance of a leg's root from where the axes meet, plus the
    offset; the leg's own length in the mechanical zero."""
    upper: float = 0.39
    attachment: float = 0.04
    """From slider to hinge, and as much from hinge to tool: cancels out of where the tool is."""
    rods_apart: float = 0.08
    """Distance of the two rods of a leg."""
    rod_radius: float = 0.0055

    def find_problem(self) -> tuple[str, str] | None:
        """Which size makes no machine of these, by the name of its field, and why, in mm."""
        leg = self.leg
        if not SHORTEST_LEG <= leg <= LONGEST_LEG:
            return "leg", (
                f"legs of {in_mm(leg)} mm; expected {in_mm(SHORTEST_LEG)} to "
                f"{in_mm(LONGEST_LEG)} mm"
            )
        travel = f"travel from {in_mm(self.lower)} to {in_mm(self.upper)} mm"
        if not self.lower < leg < self.upper:
            return "travel", (
                f"{travel}; expected the mechanical zero in it, which is at the leg's length, "
                f"{in_mm(leg)} mm"
            )
        if max(leg - self.lower, self.upper - leg) > STEEPEST * leg:
            return "travel", (
                f"{travel}; legs of {in_mm(leg)} mm reach {in_mm((1.0 - STEEPEST) * leg)} to "
                f"{in_mm((1.0 + STEEPEST) * leg)} mm"
            )
        if not 0.0 <= self.attachment <= leg:
            return "attachment", (
                f"an attachment offset of {in_mm(self.attachment)} mm; expected 0 to the leg's "
                f"length, {in_mm(leg)} mm"
            )
        if not self.rod_radius > 0.0 or not 2.0 * self.rod_radius < self.rods_apart <= leg:
            thick = self.rod_radius > 0.0 and self.rods_apart > 2.0 * self.rod_radius
            return "rods_apart" if thick else "rod_radius", (
                f"rods of radius {in_mm(self.rod_radius)} mm, {in_mm(self.rods_apart)} mm apart; "
                f"expected them to clear each other, within {in_mm(leg)} mm"
            )
        return None

    def require_machine(self, where: str) -> None:
        """Refuse sizes that make no machine.

        Raises:
            RobotError: Naming the size, in mm.
        """
        found = self.find_problem()
        if found:
            raise RobotError(found[1], where=where)

    @property
    def words(self) -> str:
        """All of them, in mm."""
        return (
            f"legs of {in_mm(self.leg)} mm, travel {in_mm(self.lower)} to {in_mm(self.upper)} mm, "
            f"attachment offset {in_mm(self.attachment)} mm, rods of radius "
            f"{in_mm(self.rod_radius)} mm, {in_mm(self.rods_apart)} mm apart"
        )


@dataclass(frozen=True, slots=True)
class Counting:
    """How a controller's joint counts."""

    up: bool = True
    """Whether it grows as the slider moves away from where the axes meet."""
    at_zero: float | None = None
    """What it shows in the mechanical zero, [m]; None: the leg's length, as orthocal counts."""


AS_DRIVE = Counting()
"""As orthocal counts."""


def find_counting_problem(counting: Sequence[Counting], count: int = 3) -> str | None:
    """Why joints cannot count so, in words; None where they can."""
    if len(counting) != count:
        return f"has {len(counting)} joints; expected {count}"
    for joint in counting:
        at = joint.at_zero
        if at is not None and not (math.isfinite(at) and abs(at) <= LARGEST_SHOWN):
            return f"{in_mm(at)} mm in the mechanical zero; expected within ±{LARGEST_SHOWN:g} m"
    return None


def in_mm(value: float) -> str:
    """A length in mm, without the rounding that the factor brings."""
    return f"{round(value / MM, 9):.9g}"
