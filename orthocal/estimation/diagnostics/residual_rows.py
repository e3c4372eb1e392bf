"""Rows of a session beside what the machine would show: nominal, linearised, calibrated."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from orthocal.io.documents import Count, Number
from orthocal.io.fields import CLOSED, NumberOrNaN
from orthocal.session.session import Conditions, describe_postures, known_approach


@dataclass(frozen=True, slots=True, eq=False)
class ResidualRow:
    """One row of the session's readings; measured = nominal + deviation = predicted + residual."""

    __pydantic_config__ = CLOSED

    setup: str
    posture: str
    minus: Annotated[str, Field(min_length=1)] | None
    cycle: Count
    measured: Number
    """[m]."""
    nominal: Number
    """What the machine would show as the controller knows it, with the best gauge zero, [m]."""
    linear: NumberOrNaN
    """The same for the linearised estimate, [m]."""
    predicted: Number
    """The same for the calibrated machine, [m]."""
    line: Count | None
    """Line in the CSV."""
    file: str | None
    """The CSV, where it is not that of the session."""
    studentised: NumberOrNaN
    """Error of the row as all others see it, in its standard deviations; NaN if they do not."""
    influence: Number
    """Largest change of a parameter without this row, in its standard deviations."""
    influenced: str
    """Which parameter that is."""
    unseen: NumberOrNaN
    """Error of predicting it from all other setups, [m]; NaN if they do not determine the model."""
    conditions: Conditions | None = None
    """Conditions of the reading, where stated."""

    @property
    def deviation(self) -> float:
        """Measured less nominal, [m]: the residual before calibration."""
        return self.measured - self.nominal

    @property
    def residual(self) -> float:
        """Measured less predicted, [m]: the residual after calibration."""
        return self.measured - self.predicted

    @property
    def postures(self) -> str:
        """Posture with its approach, or one less another, in words."""
        return describe_postures(self.posture, self.minus, known_approach(self.conditions))

    @property
    def label(self) -> str:
        """Setup and postures in words."""
        return f"{self.setup} {self.postures}"


def rows_by_setup(rows: Iterable[ResidualRow]) -> dict[str, list[ResidualRow]]:
    """Rows of every setup, in their order."""
    groups: dict[str, list[ResidualRow]] = {}
    for row in rows:
        groups.setdefault(row.setup, []).append(row)
    return groups


def root_mean_square(values: Iterable[float]) -> float:
    """Of what is known; NaN if nothing is."""
    known = [v for v in values if math.isfinite(v)]
    return math.sqrt(sum(v * v for v in known) / len(known)) if known else math.nan
