"""What a scene has to show of a session: what every gauge saw where, and where the machine went."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches

import numpy as np
from numpy.typing import NDArray

from orthocal.calibration.calibration import Calibration
from orthocal.errors import ParameterError
from orthocal.observation.model import predict_readings
from orthocal.observation.observations import build_observations
from orthocal.robot.model import Robot
from orthocal.session.session import Session, Setup
from orthocal.statistics.zeros import project_out_zeros

Array = NDArray[np.float64]

Place = tuple[str, str]
"""What of the machine a sensor stands at, as kind and name."""

FEW_NAMES = 12
"""Postures up to which a message names all."""

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
    cycles: int = 1
    """Readings of which it is the mean."""

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
    count: int
    """Readings, every cycle counted."""
    largest_after: float | None
    """Largest residual of any single reading, [m]; None without a calibration."""
    planned: bool
    """Whether it has not been made yet: all readings are 0."""

    def place(self, row: Deviation) -> Place:
        """What of the machine a row is of."""
        return self.setups[row.setup].sensor.place


@dataclass(frozen=True, slots=True, eq=False)
class Stop:
    """A posture that the animation stops at."""

    name: str
    drives: Array
    rows: tuple[Deviation, ...]
    """What the gauges show there: at most one a setup."""
    place: Place | None = None
    """What is being measured, such as leg x; None where it is all of them."""
    taken_off: tuple[str, ...] = ()
    """Postures from whose readings those of this one are taken off."""


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
    predicted = predict_readings(session, known, observations=observations)
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
            len(group),
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
        count=len(session.readings),
        largest_after=None,
        planned=not session.values.any(),
    )


def measurement_of_calibration(calibration: Calibration) -> Measurement:
    """What the gauges saw, before and after."""
    robot, offsets = calibration.robot, calibration.session.controller_offsets
    return Measurement(
        robot=robot,
        setups={s.name: Setup(s.name, s.sensor) for s in calibration.setups},
        drives={p.name: np.array(p.drives) for p in calibration.postures},
        offsets=np.zeros(len(robot.drives)) if offsets is None else np.array(offsets),
        rows=_average(
            [
                Deviation(r.setup, r.posture, r.minus, r.deviation, r.residual)
                for r in calibration.residuals
            ]
        ),
        count=len(calibration.residuals),
        largest_after=calibration.largest_after,
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
    """Where the machine goes: an overview at the zero, then all that is measured on each leg.

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
                f"'{posture}' is not a posture; {_name_some(posture, measured.drives)}",
                where="posture",
            )
        return [_stop_at(measured, posture, measured.rows, None)], 0
    overview = Stop("overview", zero, worst_of_setups(measured.rows))
    path: list[Stop] = []
    for place in dict.fromkeys(measured.place(r) for r in measured.rows):
        rows = [r for r in measured.rows if measured.place(r) == place]
        names = dict.fromkeys(n for r in rows for n in (r.posture, r.minus) if n is not None)
        stops = [_stop_at(measured, name, rows, place) for name in names]
        if not np.allclose(stops[0].drives, zero, rtol=0.0, atol=1e-9):
            path.append(Stop("zero", zero, (), place))
        path += stops
    chosen = np.unique(np.linspace(0, len(path) - 1, min(MOST_STOPS, len(path))).round())
    return [overview, *(path[int(i)] for i in chosen), overview], len(path) - len(chosen)


def _stop_at(
    measured: Measurement, name: str, rows: Sequence[Deviation], place: Place | None
) -> Stop:
    here = worst_of_setups([r for r in rows if r.posture == name])
    taken_off = dict.fromkeys(r.posture for r in rows if r.minus == name)
    return Stop(name, measured.drives[name], here, place, tuple(taken_off))


def _name_some(name: str, known: Iterable[str]) -> str:
    """Names that may have been meant: the nearest of many, or all of a few."""
    names = list(known)
    if len(names) <= FEW_NAMES:
        return f"postures: {', '.join(names)}"
    near = get_close_matches(name, names, n=3, cutoff=0.4)
    meant = f"; did you mean {', '.join(near)}?" if near else ""
    return f"there are {len(names)} in the session{meant}"
