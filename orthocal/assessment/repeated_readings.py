"""Repeated readings of a posture: their scatter and closing readings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from orthocal.arrays import Indices
from orthocal.assessment.wording import signed
from orthocal.assessment.words import plausibility as words
from orthocal.assessment.words.anomalies import MAX_PLACES, place_of
from orthocal.assessment.words.remedies import command_to_restart
from orthocal.calibration.assessment_record import Finding
from orthocal.hypotheses.hypothesis import Rows, group_rows
from orthocal.hypotheses.linear_model import linear_model
from orthocal.measurement.joining import split_sessions
from orthocal.measurement.motion.approach import label_reading
from orthocal.observation.gauge_noise import ROUNDING_ERROR, stated_sigma, usual_difference
from orthocal.session.session import Session
from orthocal.statistics.chance import BY_CHANCE, chance_of_excess
from orthocal.units import MM

MISTAKE_PROBABILITY = 1e-6
"""Probability by chance below which differences of repeated readings are a mistake."""


@dataclass(frozen=True, slots=True, eq=False)
class _Repeats:
    """Readings of one place in one setup, at least two; see `Observations.place`."""

    rows: Indices
    """Rows of the session, in the order of measuring, shape (n,)."""
    square: float
    """Sum of squared deviations from their mean, relative to the variance of a reading."""
    difference: float
    """The last reading minus the first, [m]."""
    is_closing: bool
    """Whether the first reading of the setup is repeated after other postures."""

    @property
    def dof(self) -> int:
        """Degrees of freedom."""
        return len(self.rows) - 1


def find_scattered(session: Session) -> tuple[Finding, ...]:
    """Findings about repeated readings that differ by far more than the noise of their gauge.

    If single setups alone differ from their first readings at their end, something moved there.
    Otherwise the readings do not repeat, without an evident mistake.
    """
    findings = []
    for part in split_sessions(session):
        for gauge in part.gauges:
            repeats = _list_repeats(part, gauge)
            if moved := _find_moved(repeats, usual_difference(part.gauges[gauge])):
                findings.append(_describe_closings(session, part, gauge, moved))
            elif _is_scattered(repeats):
                findings.append(_describe_scatter(part, gauge, repeats))
    return tuple(findings)


def _list_repeats(session: Session, gauge: str) -> list[_Repeats]:
    """Repeated readings of a gauge; none if its noise is not stated."""
    if session.gauges[gauge].sigma is None:
        return []
    variance, values, rows = stated_sigma(session.gauges[gauge]) ** 2, session.values, Rows(session)
    by_hand = rows.written & ~rows.paired
    repeats = []
    for repeated in group_rows(linear_model(session).problem.observations.row_places).values():
        setup = session.readings[repeated[0]].setup
        if len(repeated) < 2 or session.setups[setup].gauge != gauge:
            continue
        read = values[repeated]
        entries = 1.0 + session.is_difference(session.readings[repeated[0]])
        of_setup = rows.setups[setup]
        between = int(np.searchsorted(of_setup, repeated[-1])) - len(repeated) + 1
        repeats.append(
            _Repeats(
                repeated,
                float(((read - read.mean()) ** 2).sum()) / entries / variance,
                float(read[-1] - read[0]),
                is_closing=bool(
                    repeated[0] == of_setup[0] and between > 0 and by_hand[repeated[0]]
                ),
            )
        )
    return repeats


def _find_moved(repeats: Sequence[_Repeats], usual: float) -> list[_Repeats]:
    """Closing readings that show that something moved, if all other readings repeat.

    Args:
        repeats: Repeated readings of a gauge.
        usual: Largest usual difference of two readings, [m].
    """
    moved = [
        r
        for r in repeats
        if r.is_closing
        and abs(r.difference) > usual + ROUNDING_ERROR
        and chance_of_excess(r.square, r.dof) * len(repeats) <= BY_CHANCE
    ]
    if len(moved) > max(1, len(repeats) // 2):
        return []
    return [] if _is_scattered([r for r in repeats if r not in moved]) else moved


def _is_scattered(repeats: Iterable[_Repeats]) -> bool:
    """True if repeated readings differ by more than the noise."""
    square, dof = sum(r.square for r in repeats), sum(r.dof for r in repeats)
    return bool(dof) and chance_of_excess(square, dof) <= MISTAKE_PROBABILITY


def _describe_scatter(session: Session, gauge: str, repeats: Sequence[_Repeats]) -> Finding:
    """Finding about readings of a gauge that do not repeat."""
    sigma, values = stated_sigma(session.gauges[gauge]), session.values
    square, dof = sum(r.square for r in repeats), sum(r.dof for r in repeats)
    worst = max(repeats, key=lambda r: r.square).rows
    shown = ", ".join(
        f"{signed(values[i] / MM)} mm" + (f" in line {line}" if line is not None else "")
        for i, line in ((i, session.readings[i].line) for i in worst[:4])
    )
    return words.scattered_repeats(
        sigma * math.sqrt(square / dof),
        sigma,
        label_reading(session.robot, session.readings[worst[0]]),
        shown,
        [place_of(session, i) for i in worst[:MAX_PLACES]],
        session.distinguish_gauge(gauge),
    )


def _describe_closings(
    session: Session,
    part: Session,
    gauge: str,
    closings: Sequence[_Repeats],
) -> Finding:
    """Finding about closing readings that differ from the first ones.

    Args:
        session: All sessions.
        part: The session of the closing readings.
        gauge: Name of their gauge.
        closings: Repeated first readings of setups that end with a closing reading.
    """
    last = [int(r.rows[-1]) for r in closings]
    setups = [
        (part.readings[i].setup, r.difference, [part.readings[j].line for j in r.rows[[0, -1]]])
        for i, r in zip(last, closings, strict=True)
    ]
    return words.differing_closings(
        setups,
        usual_difference(part.gauges[gauge]),
        command_to_restart(session, part.readings[last[0]]),
        [place_of(part, i) for i in last],
    )
