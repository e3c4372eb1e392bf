"""What is odd about a reading, of those before it and of its gauge alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from orthocal.measurement.recording.recording import Row
from orthocal.session.session import Gauge, Session

OddityKind = Literal["resolution", "cycles", "drift", "unexpected", "turned"]
"""Finer than the gauge shows; away from what its other cycles showed; the same in the setup's first
posture, to which it came back; away from what the readings before let expect; and all of a setup
with the wrong sign."""

Slip = Literal["", "sign", "too large", "too small"]
"""What would explain it: the other sign, or a decimal point one place off."""

FAR = 5.0
"""Standard deviations beyond which chance is no explanation: less than one in a million."""

FEWEST_REPEATED = 5
"""Readings beyond the first of their cycles from which a gauge's scatter is taken, where nothing
is stated of it."""


@dataclass(frozen=True, slots=True)
class Oddity:
    """Something odd about a reading. It may be right all the same."""

    kind: OddityKind
    setup: str
    expected: float = math.nan
    """[m]."""
    spread: float = math.nan
    """How far it may be from there, one standard deviation, [m]; of `resolution` that itself."""
    slip: Slip = ""

    def off(self, value: float) -> float:
        """How far a reading is from what was expected, [m]."""
        return value - self.expected


def find_oddities(session: Session, rows: Sequence[Row], index: int) -> tuple[Oddity, ...]:
    """What is odd about a reading, without any model of the machine.

    Args:
        session: With its gauges.
        rows: In the order of measuring.
        index: Of the row that was just read.
    """
    row = rows[index]
    if row.value is None:
        return ()
    gauge = session.gauges[session.setups[row.setup].gauge]
    found = []
    if gauge.resolution is not None:
        steps = row.value / gauge.resolution
        if abs(steps - round(steps)) > 1e-4 * max(1.0, abs(steps) * 1e-6):
            found.append(Oddity("resolution", row.setup, spread=gauge.resolution))
    again = _away_from_cycles(session, gauge, rows, index)
    return (*found, *again)


def noise_of_row(gauge: Gauge, row: Row) -> float | None:
    """Standard deviation of a row as its gauge and rounding have it, [m]; None if not stated."""
    if gauge.sigma is None and gauge.resolution is None:
        return None
    single = math.hypot(gauge.sigma or 0.0, (gauge.resolution or 0.0) / math.sqrt(12.0))
    return single * (math.sqrt(2.0) if row.minus else 1.0)


def name_slip(value: float, expected: float, spread: float) -> Slip:
    """What would bring a reading to where it was expected; nothing where more than one would.

    Args:
        value: As read, [m].
        expected: [m].
        spread: One standard deviation, [m].
    """
    tries: dict[Slip, float] = {
        "sign": -value,
        "too large": value / 10.0,
        "too small": value * 10.0,
    }
    fitting = [
        slip
        for slip, other in tries.items()
        if abs(other - expected) < 3.0 * spread and abs(value - other) > 2.0 * FAR * spread
    ]
    return fitting[0] if len(fitting) == 1 else ""


def _away_from_cycles(
    session: Session, gauge: Gauge, rows: Sequence[Row], index: int
) -> tuple[Oddity, ...]:
    row = rows[index]
    value = row.value
    others = [
        r.value
        for i, r in enumerate(rows)
        if i != index and r.place == row.place and r.value is not None
    ]
    sigma = noise_of_row(gauge, row) or _noise_of_cycles(session, rows, index)
    if value is None or not others or sigma is None:
        return ()
    own = [r for r in rows if r.setup == row.setup]
    if row.place == own[0].place and own[0].value is not None and row is not own[0]:
        first, spread = own[0].value, math.sqrt(2.0) * sigma
        if abs(value - first) > FAR * spread:
            slip = name_slip(value, first, spread)
            return (Oddity("drift", row.setup, first, spread, slip),)
    mean, spread = float(np.mean(others)), sigma * math.sqrt(1.0 + 1.0 / len(others))
    if abs(value - mean) > FAR * spread:
        return (Oddity("cycles", row.setup, mean, spread, name_slip(value, mean, spread)),)
    return ()


def _noise_of_cycles(session: Session, rows: Sequence[Row], index: int) -> float | None:
    """Scatter of a gauge's repeated readings before a row, [m]; None where they are few."""
    gauge, minus = session.setups[rows[index].setup].gauge, rows[index].minus is not None
    cycles: dict[object, list[float]] = {}
    for i, r in enumerate(rows):
        alike = session.setups[r.setup].gauge == gauge and (r.minus is not None) == minus
        if i != index and r.value is not None and alike and r.place != rows[index].place:
            cycles.setdefault(r.place, []).append(r.value)
    dof = sum(len(values) - 1 for values in cycles.values())
    if dof < FEWEST_REPEATED:
        return None
    square = sum(float(np.var(values)) * len(values) for values in cycles.values())
    # few degrees of freedom: their scatter may be half of what it really is
    found = math.sqrt(square / dof) * (1.0 + 2.0 / math.sqrt(dof))
    return found if found > 0.0 else None
