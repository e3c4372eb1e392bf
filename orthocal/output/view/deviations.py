"""What a scene has to show of a session: what every gauge saw where, and where the machine went."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import ParameterError
from orthocal.identification.calibration import Calibration
from orthocal.identification.uncertainty import project_out_zeros
from orthocal.measurement.gauge import build_observations, predict_entries
from orthocal.measurement.session import Section, Session, Setup
from orthocal.robot.model import Robot

Array = NDArray[np.float64]

MOST_STOPS = 150
"""Postures that an animation goes through; more are thinned out."""


@dataclass(frozen=True, slots=True, eq=False)
class Deviation:
    """What a gauge saw in a posture, or in one less in another; the mean of its cycles."""

    setup: str
    posture: str
    minus: str | None
    before: float
    """Measured less nominal, [m]."""
    after: float | None
    """Measured less calibrated, [m]; None without a calibration."""

    @property
    def where(self) -> str:
        """Posture, or postures, in words."""
        return f"{self.posture} − {self.minus}" if self.minus else self.posture


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """Postures, setups and deviations of a session."""

    robot: Robot
    setups: Mapping[str, Setup]
    drives: Mapping[str, Array]
    """Posture to commanded drive coordinates, [m, rad]."""
    offsets: Array
    """Active in the controller, shape (n_drives,), [m, rad]."""
    rows: tuple[Deviation, ...]
    planned: bool
    """Whether it has not been made yet: all readings are 0."""


@dataclass(frozen=True, slots=True, eq=False)
class Stop:
    """A posture that the animation stops at."""

    name: str
    drives: Array
    rows: tuple[Deviation, ...]
    """What the gauges show there: at most one a setup."""


def measure_deviations(session: Session) -> tuple[Deviation, ...]:
    """Readings less what the machine would show as the controller knows it, best gauge zeros taken.

    A plan, all of whose readings are 0, has none.

    Raises:
        ClosureError: If the machine cannot reach a posture.
    """
    if not session.values.any():
        rows = [Deviation(r.setup, r.posture, r.minus, 0.0, None) for r in session.readings]
        return _average(rows)
    observations = build_observations(session)
    known = {
        f"{drive.name}.offset": float(value)
        for drive, value in zip(session.robot.drives, session.active_offsets, strict=True)
        if value != 0.0
    }
    predicted = predict_entries(session, observations, known)
    left = project_out_zeros(observations.values(session.values) - predicted, observations)
    return _average(
        [
            Deviation(r.setup, r.posture, r.minus, float(v), None)
            for r, v in zip(session.readings, observations.rows(left), strict=True)
        ]
    )


def _average(rows: Sequence[Deviation]) -> tuple[Deviation, ...]:
    """One deviation for all cycles."""
    groups: dict[tuple[str, str, str | None], list[Deviation]] = {}
    for row in rows:
        groups.setdefault((row.setup, row.posture, row.minus), []).append(row)
    return tuple(
        Deviation(
            *key,
            float(np.mean([r.before for r in group])),
            None
            if group[0].after is None
            else float(np.mean([r.after for r in group if r.after is not None])),
        )
        for key, group in groups.items()
    )


def measurement_of_session(session: Session) -> Measurement:
    """What the gauges saw of the machine, before any calibration."""
    return Measurement(
        robot=session.robot,
        setups=session.setups,
        drives={name: p.drives for name, p in session.postures.items()},
        offsets=np.asarray(session.active_offsets),
        rows=measure_deviations(session),
        planned=not session.values.any(),
    )


def measurement_of_calibration(calibration: Calibration) -> Measurement:
    """What the gauges saw, before and after."""
    robot, offsets = calibration.robot, calibration.session.controller_offsets
    return Measurement(
        robot=robot,
        setups={
            s.name: Setup(s.name, s.leg, s.direction, Section(s.section_form, s.section_value))  # type: ignore[arg-type]
            for s in calibration.setups
        },
        drives={p.name: np.array(p.drives) for p in calibration.postures},
        offsets=np.zeros(len(robot.drives)) if offsets is None else np.array(offsets),
        rows=_average(
            [
                Deviation(r.setup, r.posture, r.minus, r.deviation, r.residual)
                for r in calibration.residuals
            ]
        ),
        planned=False,
    )


def worst_of_setups(rows: Sequence[Deviation]) -> tuple[Deviation, ...]:
    """The row of every setup with the largest deviation."""
    worst: dict[str, Deviation] = {}
    for row in rows:
        if row.setup not in worst or abs(row.before) > abs(worst[row.setup].before):
            worst[row.setup] = row
    return tuple(worst.values())


def plan_stops(measured: Measurement, posture: str | None) -> tuple[list[Stop], int]:
    """Where the machine goes: an overview at the zero, then every leg through its postures.

    Args:
        measured: The measurement.
        posture: The only stop, instead.

    Returns:
        The stops, and how many of too many were left out.

    Raises:
        ParameterError: If there is no such posture.
    """
    robot = measured.robot
    zero = robot.drive_zero - measured.offsets
    if posture is not None:
        if posture not in measured.drives:
            raise ParameterError(
                f"'{posture}' is not a posture; postures: {', '.join(measured.drives)}",
                where="posture",
            )
        rows = worst_of_setups([r for r in measured.rows if r.posture == posture])
        return [Stop(posture, measured.drives[posture], rows)], 0
    overview = Stop("overview", zero, worst_of_setups(measured.rows))
    path: list[Stop] = []
    for leg in dict.fromkeys(measured.setups[r.setup].leg for r in measured.rows):
        by_posture: dict[str, list[Deviation]] = {}
        for row in measured.rows:
            if measured.setups[row.setup].leg == leg:
                by_posture.setdefault(row.posture, []).append(row)
                if row.minus is not None:
                    by_posture.setdefault(row.minus, [])
        stops = [
            Stop(n, measured.drives[n], worst_of_setups(rows)) for n, rows in by_posture.items()
        ]
        if not np.allclose(stops[0].drives, zero, rtol=0.0, atol=1e-9):
            path.append(Stop("zero", zero, ()))
        path += stops
    chosen = np.unique(np.linspace(0, len(path) - 1, min(MOST_STOPS, len(path))).round())
    return [overview, *(path[int(i)] for i in chosen), overview], len(path) - len(chosen)
