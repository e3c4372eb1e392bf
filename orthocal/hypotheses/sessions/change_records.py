"""Changes of a machine between sessions as data: what was tested, what was found."""

from __future__ import annotations

import math
from dataclasses import dataclass

from orthocal.hypotheses.sessions.candidates import Part
from orthocal.io.documents import Number, PositiveInSI
from orthocal.io.fields import CLOSED, Many, NumberOrNaN, Size, SizeOrInf, SizeOrNaN
from orthocal.statistics.chance import confidence_factor
from orthocal.statistics.distributions import normal_quantile
from orthocal.units import InUnit, Unit

FALSE_ALARM = 0.005
"""Probability that any drive or leg of a machine that stayed as it was is said to have changed."""

SEEN = 0.95
"""Probability with which a change that is said to be seen is."""


@dataclass(frozen=True, slots=True, eq=False)
class TestedChange(InUnit):
    """One parameter that may have changed from one session on, tested by itself."""

    __pydantic_config__ = CLOSED

    name: str
    """Of the parameter."""
    unit: Unit
    since: str
    """The first session that it would be different in."""
    size: NumberOrNaN
    """Estimate of the change, to first order, all else unchanged, [unit]; NaN if not told."""
    std: SizeOrNaN
    """Its standard deviation, [unit]; NaN if the readings do not tell it."""


@dataclass(frozen=True, slots=True, eq=False)
class Change(InUnit):
    """A parameter that has changed between two sessions."""

    __pydantic_config__ = CLOSED

    name: str
    """Of the parameter."""
    unit: Unit
    part: Part
    """Whether it is of a drive or of a leg."""
    of: str
    """Which."""
    since: str
    """The first session that was read after it."""
    size: Number
    """What it is more than before, fitted with all else, [unit]."""
    std: Size
    """One standard deviation from all that is not known, [unit]."""
    perhaps: Many[str]
    """Other parameters that may as well be the one."""
    perhaps_since: Many[str]
    """Other sessions since which it may be so."""


@dataclass(frozen=True, slots=True, eq=False)
class OtherChange:
    """Sessions that are not of one machine, where no drive or leg explains that by itself."""

    __pydantic_config__ = CLOSED

    since: str
    """From which session on they differ most."""
    chance: Size
    """Probability that sessions of one machine differ as much."""
    parts: Many[str]
    """Drives, legs or parts of which a single error would explain it; empty where none does."""


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """Whether a machine has changed between sessions that were calibrated together."""

    __pydantic_config__ = CLOSED

    sessions: Many[str]
    """By name, as they were given."""
    dof: SizeOrInf
    """Degrees of freedom of the noise that changes were held against; 0 where nothing tells it."""
    times_tolerances: PositiveInSI
    """How many times their tolerances the machine's other errors were taken to be."""
    tested: Many[TestedChange]
    found: Many[Change]
    """Drives and legs that have changed, the clearest first."""
    other: OtherChange | None
    """That something else has, where it has."""

    @property
    def none_found(self) -> bool:
        """Whether nothing is known to have changed."""
        return not self.found and self.other is None

    @property
    def threshold(self) -> float:
        """Standard deviations from which on a change counts."""
        return change_threshold(len(self.tested), self.dof)

    def seen_from(self, tested: TestedChange) -> float:
        """Size from which on a change would have been seen with 95 %, [unit]; NaN if never."""
        found = (self.threshold + normal_quantile(SEEN)) * tested.std
        return found if math.isfinite(found) else math.nan


def change_threshold(count: int, dof: float) -> float:
    """Standard deviations that none of so many changes exceeds by chance; infinite for never."""
    if not count or dof <= 0.0:
        return math.inf
    return confidence_factor(dof, 1.0 - FALSE_ALARM / count)
