"""Deviations of the readings of a session or calibration, and stops of their animation."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from operator import attrgetter

import numpy as np

from orthocal.arrays import Array
from orthocal.calibration.calibration import Calibration
from orthocal.errors import ParameterError
from orthocal.observation.model import predict_readings
from orthocal.observation.observations import build_observations
from orthocal.robot.model import Robot
from orthocal.session.points import count_readings
from orthocal.session.session import Session, Setup, known_approach
from orthocal.statistics.zeros import project_out_zeros

Place = tuple[str, str]
"""Kind and name of the part of the machine that a sensor measures, such as ("leg", "x")."""

MAX_LISTED = 24
"""Largest number of postures that a message lists."""

MAX_STOPS = 150
"""Largest number of stops of an animation; with more postures, a selection is shown."""


@dataclass(frozen=True, slots=True, eq=False)
class Deviation:
    """Deviation of a reading or of a difference of readings, averaged over its cycles."""

    setup: str
    posture: str
    minus: str | None
    """Posture whose reading was subtracted; None for a single reading."""
    before: float
    """Measured minus nominal reading, [m]."""
    after: float | None
    """Measured minus calibrated reading, [m]; None without a calibration."""
    approach: str | None = None
    """Approach of the drives, if the posture was read with several; they are not averaged."""
    cycles: int = 1
    """Number of cycles."""

    @property
    def where(self) -> str:
        """Name of the posture, or of the difference of postures, and the approach."""
        name = f"{self.posture} − {self.minus}" if self.minus else self.posture
        return f"{name}, approach {self.approach}" if self.approach else name


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """Postures, setups and deviations of a session or calibration."""

    robot: Robot
    setups: Mapping[str, Setup]
    drives: Mapping[str, Array]
    """Posture to commanded drive coordinates, shape (n_drives,), [m, rad]."""
    offsets: Array
    """Offsets active in the controller at the end, shape (n_drives,), [m, rad]."""
    active: Mapping[str, Array]
    """Posture to the offsets active in its session, shape (n_drives,), [m, rad]."""
    rows: tuple[Deviation, ...]
    """Deviations, averaged over the cycles."""
    count: int
    """Number of readings in all cycles."""
    largest_after: float | None
    """Largest residual of a single reading, [m]; None without a calibration."""
    planned: bool
    """Whether this is a plan, in which all readings are 0."""

    def place(self, row: Deviation) -> Place:
        """Part of the machine that a row measures."""
        return self.setups[row.setup].sensor.place


@dataclass(frozen=True, slots=True, eq=False)
class Stop:
    """Posture at which the animation stops."""

    name: str
    drives: Array
    """Commanded drive coordinates, shape (n_drives,), [m, rad]."""
    offsets: Array
    """Offsets active in the controller, shape (n_drives,), [m, rad]."""
    rows: tuple[Deviation, ...] = ()
    """Deviations of the gauges at this stop, at most one per setup."""
    place: Place | None = None
    """Measured part of the machine; None for all parts."""
    read: frozenset[str] | None = None
    """Setups that read this posture; None for all setups of the measured part."""
    subtracted_from: tuple[str, ...] = ()
    """Postures from whose readings the readings of this stop are subtracted."""

    def has(self, setup: Setup) -> bool:
        """True if the gauge of a setup is at this stop; without a reading it may not touch."""
        if self.read is None:
            return self.place in (None, setup.sensor.place)
        return setup.name in self.read


def measure_deviations(session: Session) -> tuple[Deviation, ...]:
    """Readings minus predictions of the nominal machine with the active offsets of each setup.

    Gauge zeros are fitted. Deviations of readings without a value are zero.

    Raises:
        ClosureError: If the machine cannot reach a posture.
    """
    deviations = np.zeros(len(session.readings))
    rows = np.flatnonzero(np.isfinite(session.values))
    if rows.size:
        read = session.select([session.readings[i] for i in rows])
        observations = build_observations(read)
        active = [tuple(read.active_during(name).tolist()) for name in read.setups]
        predicted = np.zeros(observations.size)
        for offsets in set(active):
            errors = {
                f"{drive.name}.offset": value
                for drive, value in zip(session.robot.drives, offsets, strict=True)
                if value != 0.0
            }
            same = np.array([a == offsets for a in active])[observations.setup]
            predicted[same] = predict_readings(read, errors, observations=observations)[same]
        entries = observations.values(read.values) - predicted
        deviations[rows] = observations.rows(project_out_zeros(entries, observations))
    return _average(
        Deviation(r.setup, r.posture, r.minus, float(v), None, r.approach)
        for r, v in zip(session.readings, deviations, strict=True)
    )


def _average(rows: Iterable[Deviation]) -> tuple[Deviation, ...]:
    """Average deviations over the cycles of each setup, posture and approach."""
    groups: dict[tuple[str, str, str | None], dict[str | None, list[Deviation]]] = {}
    for row in rows:
        place = groups.setdefault((row.setup, row.posture, row.minus), {})
        place.setdefault(row.approach, []).append(row)
    means = []
    for key, approaches in groups.items():
        for approach, group in approaches.items():
            after = [r.after for r in group if r.after is not None]
            means.append(
                Deviation(
                    *key,
                    before=float(np.mean([r.before for r in group])),
                    after=float(np.mean(after)) if after else None,
                    approach=approach if len(approaches) > 1 else None,
                    cycles=len(group),
                )
            )
    return tuple(means)


def measurement_of_session(session: Session) -> Measurement:
    """Postures, setups and deviations of a session without a calibration."""
    return Measurement(
        robot=session.robot,
        setups=session.setups,
        drives={name: p.drives for name, p in session.postures.items()},
        offsets=np.asarray(session.active_offsets),
        active={
            name: session.active_during(r.setup)
            for r in session.readings
            for name in (r.posture, r.minus)
            if name is not None
        },
        rows=measure_deviations(session),
        count=count_readings(session),
        largest_after=None,
        planned=not np.isfinite(session.values).any(),
    )


def measurement_of_calibration(calibration: Calibration) -> Measurement:
    """Postures, setups and deviations of a calibration, before and after."""
    robot = calibration.robot
    of_setup = {s.name: s.active for s in calibration.setups if s.active is not None}
    return Measurement(
        robot=robot,
        setups={s.name: Setup(s.name, s.sensor, payload=s.payload) for s in calibration.setups},
        drives={p.name: np.array(p.drives) for p in calibration.postures},
        offsets=calibration.active_offsets,
        active={
            name: np.array(of_setup[r.setup])
            for r in calibration.residuals
            if r.setup in of_setup
            for name in (r.posture, r.minus)
            if name is not None
        },
        rows=_average(
            Deviation(
                r.setup, r.posture, r.minus, r.deviation, r.residual, known_approach(r.conditions)
            )
            for r in calibration.residuals
        ),
        count=len(calibration.residuals),
        largest_after=calibration.largest_after,
        planned=False,
    )


def find_worst(
    rows: Iterable[Deviation], key: Callable[[Deviation], object] = attrgetter("setup")
) -> tuple[Deviation, ...]:
    """Row with the largest deviation of every setup, or of every value of another key."""
    worst: dict[object, Deviation] = {}
    for row in rows:
        if abs(row.before) > abs(worst.setdefault(key(row), row).before):
            worst[key(row)] = row
    return tuple(worst.values())


def plan_stops(measured: Measurement, posture: str | None) -> tuple[list[Stop], int]:
    """Stops of the animation: an overview at the mechanical zero, then leg after leg.

    Args:
        measured: The measurement.
        posture: Name of a posture that replaces all stops.

    Returns:
        The stops, and the number of omitted stops.

    Raises:
        ParameterError: If the posture does not exist.
    """
    robot = measured.robot
    zero = robot.drive_zero - measured.offsets
    if posture is not None:
        if posture not in measured.drives:
            raise ParameterError(
                f"'{posture}' is not a posture; {_suggest(posture, list(measured.drives))}",
                where="posture",
            )
        return [_stop_at(measured, posture, measured.rows, None)], 0
    overview = Stop("overview", zero, measured.offsets, find_worst(measured.rows))
    path: list[Stop] = []
    for place in dict.fromkeys(measured.place(r) for r in measured.rows):
        rows = [r for r in measured.rows if measured.place(r) == place]
        names = dict.fromkeys(n for r in rows for n in (r.posture, r.minus) if n is not None)
        stops = [_stop_at(measured, name, rows, place) for name in names]
        if not np.allclose(stops[0].drives, zero, rtol=0.0, atol=1e-9):
            path.append(Stop("zero", zero, measured.offsets, place=place))
        path += stops
    chosen = np.unique(np.linspace(0, len(path) - 1, min(MAX_STOPS, len(path))).round())
    return [overview, *(path[int(i)] for i in chosen), overview], len(path) - len(chosen)


def _stop_at(
    measured: Measurement, name: str, rows: Sequence[Deviation], place: Place | None
) -> Stop:
    """Stop at a posture with the deviations of some rows."""
    deviations = find_worst(r for r in rows if r.posture == name)
    minuends = dict.fromkeys(r.posture for r in rows if r.minus == name)
    offsets = measured.active.get(name, measured.offsets)
    read = frozenset(r.setup for r in rows if name in (r.posture, r.minus))
    return Stop(name, measured.drives[name], offsets, deviations, place, read, tuple(minuends))


def _suggest(name: str, postures: Sequence[str]) -> str:
    """Message with all postures if they are few, otherwise with similar names."""
    if len(postures) <= MAX_LISTED:
        return f"postures: {', '.join(postures)}"
    similar = get_close_matches(name, postures, n=3, cutoff=0.4)
    suggestion = f"; did you mean {', '.join(similar)}?" if similar else ""
    return f"there are {len(postures)} in the session{suggestion}"
