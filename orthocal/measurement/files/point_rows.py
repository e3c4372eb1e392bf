"""Rows of points: three coordinates in a line, which a session reads as three sensors.

A setup `track` becomes `track[x]`, `track[y]` and `track[z]`. With a covariance that correlates the
coordinates they are `track[1]` to `track[3]`, along its principal axes. A row with a covariance of
its own has setups of its own: `track[x2]`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import SessionError
from orthocal.io.documents import parse_number
from orthocal.measurement.files.readings_file import COORDINATES, COVARIANCES, RawReading
from orthocal.observation.contacts import locate_contacts
from orthocal.sensors.points import ABOUT_FIT, Points, fit_station, read_covariance
from orthocal.session.points import base_name, gather_points, split_setup
from orthocal.session.session import Gauge, Reading, Session, Setup
from orthocal.units import MM, UM, tidy


def split_points(session: Session) -> Session:
    """Session whose setups of points are split into three."""
    setups, gauges = {}, dict(session.gauges)
    for setup in session.setups.values():
        if not isinstance(setup.sensor, Points) or setup.sensor.along is not None:
            setups[setup.name] = setup
            continue
        if "[" in setup.name or "]" in setup.name:
            raise SessionError(
                "has brackets; expected a name without them for a setup of points",
                where=f"{session.path or 'session'}: setups.{setup.name}",
            )
        parts, further = split_setup(setup, session.gauges[setup.gauge])
        setups |= parts
        gauges |= further
    used = dict.fromkeys(s.gauge for s in setups.values())
    return replace(session, setups=setups, gauges={n: gauges[n] for n in [*used, *gauges]})


@dataclass
class PointRows:
    """Readings of rows with three coordinates."""

    plan: Session
    setups: dict[str, Setup] = field(default_factory=dict)
    """All setups, with those for the covariances of rows."""
    gauges: dict[str, Gauge] = field(default_factory=dict)
    _parts: dict[str, list[str]] = field(default_factory=dict)
    """Base name to its setups."""
    _numbers: dict[tuple[str, str], tuple[str, ...]] = field(default_factory=dict)
    """Base name and covariance as text to the setups of its rows."""

    def __post_init__(self) -> None:
        self.setups, self.gauges = dict(self.plan.setups), dict(self.plan.gauges)
        for name, setup in self.setups.items():
            if isinstance(setup.sensor, Points):
                self._parts.setdefault(base_name(name), []).append(name)

    @property
    def names(self) -> list[str]:
        """Names of all setups as in the files."""
        return list(dict.fromkeys(map(base_name, self.plan.setups)))

    @property
    def any(self) -> bool:
        """True if the session has a setup of points."""
        return bool(self._parts)

    def is_point(self, row: RawReading) -> bool:
        """True for a row of a setup of points."""
        return row.setup in self._parts

    def check_columns(self, row: RawReading) -> None:
        """Refuse a row with numbers in columns of other sensors.

        Raises:
            SessionError: Naming file, line and column.
        """
        point = self.is_point(row)
        wrong = ("reading_mm",) if point else (*COORDINATES, *COVARIANCES)
        for column in wrong:
            if text := getattr(row, column):
                kind = "points: x_mm, y_mm and z_mm" if point else "a reading: reading_mm"
                raise SessionError(
                    f"{column} is '{text}'; expected an empty cell: setup {row.setup} has {kind}",
                    where=row.where,
                )
        if point and row.minus:
            raise SessionError(
                f"minus is '{row.minus}'; expected an empty cell in a row of a point",
                where=row.where,
            )

    def split(self, row: RawReading, values: Sequence[float]) -> dict[str, float]:
        """Setups of a row and their readings, [m].

        Args:
            row: The row.
            values: Coordinates, shape (3,), [m].
        """
        names = self._parts[row.setup][:3]
        if any(getattr(row, c) for c in COVARIANCES):
            names = list(self._with_covariance(row))
        return {
            name: float(np.dot(np.array(cast(Points, self.setups[name].sensor).along), values))
            for name in names
        }

    def _with_covariance(self, row: RawReading) -> tuple[str, ...]:
        texts = [getattr(row, c) for c in COVARIANCES]
        key = row.setup, " ".join(texts)
        if key not in self._numbers:
            numbers = [
                parse_number(text, where=row.where, name=c, error=SessionError)
                for c, text in zip(COVARIANCES, texts, strict=True)
            ]
            xx, yy, zz, xy, xz, yz = numbers
            try:
                covariance = read_covariance([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            except SessionError as e:
                raise SessionError(f"the covariance {e.problem}", where=row.where) from None
            first = self.setups[self._parts[row.setup][0]]
            sensor = replace(cast(Points, first.sensor).in_file, covariance=covariance)
            base = replace(first, name=row.setup, sensor=sensor)
            number = 1 + sum(name == row.setup for name, _ in self._numbers)
            gauge = self.plan.gauges[first.gauge]
            setups, gauges = split_setup(base, gauge, number)
            self.setups |= setups
            self.gauges |= gauges
            self._numbers[key] = tuple(setups)
        return self._numbers[key]


def find_point(rows: Sequence[Reading], index: int) -> list[int]:
    """Indices of the rows of one line: the three of a point, or one; in their order."""
    row = rows[index]
    place = base_name(row.setup), row.place[1:], row.cycle, row.line

    def is_same(i: int) -> bool:
        other = rows[i]
        return (base_name(other.setup), other.place[1:], other.cycle, other.line) == place

    first, last = index, index
    while "[" in row.setup and first > 0 and is_same(first - 1):
        first -= 1
    while "[" in row.setup and last + 1 < len(rows) and is_same(last + 1):
        last += 1
    return list(range(first, last + 1))


def point_of(part: Sequence[Reading], setups: Mapping[str, Setup]) -> Array:
    """Coordinates of a point in its station, from its three readings, shape (3,), [m]."""
    axes = np.array([cast(Points, setups[r.setup].sensor).along for r in part])
    return np.asarray(axes.T @ [r.value for r in part])


def point_cells(
    part: Sequence[Reading], setups: Mapping[str, Setup], decimals: int
) -> dict[str, str]:
    """Cells of the coordinates of a point, and of the covariance of its row."""
    values = point_of(part, setups)
    cells = {
        c: "" if np.isnan(v) else f"{tidy(round(v / MM, decimals)):.12g}"
        for c, v in zip(COORDINATES, values.tolist(), strict=True)
    }
    covariance = cast(Points, setups[part[0].setup].sensor).covariance
    if covariance is not None and is_of_row(part[0].setup):
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = covariance
        numbers = (xx, yy, zz, xy, xz, yz)
        cells |= {c: f"{tidy(v / UM**2):.12g}" for c, v in zip(COVARIANCES, numbers, strict=True)}
    return cells


def is_of_row(name: str) -> bool:
    """True for a setup that exists for the covariance of rows."""
    return len(name.partition("[")[2]) > len("x]")


def locate_stations(session: Session, *, partial: bool = False) -> Session:
    """Session whose stations of unknown frame begin at the best fit to the nominal machine.

    Args:
        session: The session; empty rows do not take part.
        partial: Whether points may be missing: a station that they do not determine stays.

    Raises:
        SessionError: If the points of a station do not determine it.
    """
    seen: dict[str, tuple[list[Array], list[Array], str]] = {}
    unknown = {
        name: s.sensor
        for name, s in session.setups.items()
        if isinstance(s.sensor, Points) and s.sensor.frame_std == ABOUT_FIT
    }
    if not unknown:
        return session
    contacts = locate_contacts(session)
    for part in gather_points(session.readings, session.setups):
        sensor = unknown.get(part[0].setup)
        if sensor is None or any(np.isnan(r.value) for r in part):
            continue
        postures, contact = contacts[part[0].setup]
        points, targets, _ = seen.setdefault(
            sensor.station or "", ([], [], base_name(part[0].setup))
        )
        points.append(point_of(part, session.setups))
        targets.append(contact.points[postures.index(part[0].posture)])
    setups = dict(session.setups)
    for station, (points, targets, base) in seen.items():
        try:
            position, rotation = fit_station(np.array(points), np.array(targets))
        except SessionError as e:
            if partial:
                continue
            raise SessionError(
                e.problem, where=f"{session.path or 'session'}: setups.{base}.{e.where}"
            ) from None
        for name, sensor in unknown.items():
            if (sensor.station or "") == station:
                placed = replace(sensor, position=position, rotation=rotation)
                setups[name] = replace(setups[name], sensor=placed)
    return replace(session, setups=setups)
