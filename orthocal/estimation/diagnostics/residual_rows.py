"""Rows of a session with nominal, linearised and calibrated predictions."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from orthocal.io.documents import Count, Number
from orthocal.io.fields import FileRecord, NumberOrNaN
from orthocal.session.session import Conditions, describe_postures, known_approach


@dataclass(frozen=True, slots=True, eq=False)
class ResidualRow(FileRecord):
    """Row of a session's readings: measured = nominal + deviation = predicted + residual."""

    setup: str
    """Name of the setup."""
    posture: str
    """Name of the posture."""
    minus: Annotated[str, Field(min_length=1)] | None
    """Name of the second posture of a difference, otherwise None."""
    cycle: Count
    """Number of the reading among those of its posture."""
    measured: Number
    """Measured reading, [m]."""
    nominal: Number
    """Prediction of the nominal machine with the active offsets and the best gauge zero, [m]."""
    linear: NumberOrNaN
    """Prediction of the linearised estimate, [m]."""
    predicted: Number
    """Prediction of the calibrated machine, [m]."""
    line: Count | None
    """Line of the CSV file, None if the readings are not from a file."""
    file: str | None
    """Path of the CSV file, if it is not that of the session."""
    studentised: NumberOrNaN
    """Studentised deleted residual; NaN if the other rows do not predict it."""
    influence: Number
    """Largest change of a parameter if this row is deleted, in standard deviations of the
    parameter."""
    influenced: str
    """Name of the parameter with the largest change."""
    prediction_error: NumberOrNaN
    """Measured minus predicted from all other setups, [m]; NaN if these do not determine it."""
    conditions: Conditions | None = None
    """Conditions of the reading, if stated."""

    @property
    def deviation(self) -> float:
        """Measured minus nominal, [m]: the residual before calibration."""
        return self.measured - self.nominal

    @property
    def residual(self) -> float:
        """Measured minus predicted, [m]: the residual after calibration."""
        return self.measured - self.predicted

    @property
    def postures(self) -> str:
        """Description of the posture with its approach, or of the difference of two postures."""
        return describe_postures(self.posture, self.minus, known_approach(self.conditions))

    @property
    def label(self) -> str:
        """Setup and postures, for messages."""
        return f"{self.setup} {self.postures}"


def rows_by_setup(rows: Iterable[ResidualRow]) -> dict[str, list[ResidualRow]]:
    """Rows of every setup, in their order."""
    groups: dict[str, list[ResidualRow]] = {}
    for row in rows:
        groups.setdefault(row.setup, []).append(row)
    return groups


def largest_first(rows: Iterable[ResidualRow]) -> list[ResidualRow]:
    """Rows by descending magnitude of the residual."""
    return sorted(rows, key=lambda row: -abs(row.residual))


def root_mean_square(values: Iterable[float]) -> float:
    """RMS of the finite values; NaN if there are none."""
    finite = [v for v in values if math.isfinite(v)]
    return math.sqrt(sum(v * v for v in finite) / len(finite)) if finite else math.nan
