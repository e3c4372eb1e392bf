"""Rows of measured points: three coordinates in a line, which a session reads as three sensors.

A setup `track` becomes `track[x]`, `track[y]` and `track[z]`. If its covariance correlates the
coordinates, the setups are `track[1]` to `track[3]`, along the principal axes. A row that states
another covariance has additional setups: `track[x2]`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
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
    """Session whose setups of points are split into three.

    Raises:
        SessionError: If a name has brackets, which `base_name` removes.
    """
    setups, gauges = {}, dict(session.gauges)
    for setup in session.setups.values():
        sensor = setup.sensor
        is_split = isinstance(sensor, Points) and sensor.along is not None
        for key, name in (("setups", setup.name), ("gauges", setup.gauge)):
            if not is_split and ("[" in name or "]" in name):
                raise SessionError(
                    "has brackets; expected a name without them, because they name the coordinates "
                    "of points",
                    where=f"{session.path or 'session'}: {key}.{name}",
                )
        if is_split or not isinstance(sensor, Points):
            setups[setup.name] = setup
            continue
        axis_setups, axis_gauges = split_setup(setup, session.gauges[setup.gauge])
        setups |= axis_setups
        gauges |= axis_gauges
    used = dict.fromkeys(s.gauge for s in setups.values())
    return replace(session, setups=setups, gauges={n: gauges[n] for n in [*used, *gauges]})


class PointRows:
    """Setups of the rows of a table, with additional ones for the covariances of rows.

    Args:
        session: The session as its files state it, with split setups of points.
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self.names = list(dict.fromkeys(map(base_name, session.setups)))
        """Names of all setups as in the files."""
        self.setups: dict[str, Setup] = dict(session.setups)
        """All setups by name, additional ones included."""
        self.gauges: dict[str, Gauge] = dict(session.gauges)
        """Their gauges by name."""
        self._setups_by_base: dict[str, list[str]] = {}
        """Setups of points by base name."""
        self._setups_by_covariance: dict[tuple[str, str], tuple[str, ...]] = {}
        """Additional setups by base name and text of the covariance."""
        for name, setup in self.setups.items():
            if isinstance(setup.sensor, Points):
                self._setups_by_base.setdefault(base_name(name), []).append(name)

    @property
    def has_points(self) -> bool:
        """True if the session has a setup of points."""
        return bool(self._setups_by_base)

    def is_point(self, row: RawReading) -> bool:
        """True for a row of a setup of points."""
        return row.setup in self._setups_by_base

    def check_columns(self, row: RawReading) -> None:
        """Refuse a row with numbers in columns of other sensors.

        Raises:
            SessionError: If there is such a number; names the column.
        """
        point = self.is_point(row)
        wrong = ("reading_mm",) if point else (*COORDINATES, *COVARIANCES)
        for column in wrong:
            if text := getattr(row, column):
                kind = "points: x_mm, y_mm and z_mm" if point else "a reading: reading_mm"
                raise SessionError(
                    f"{column} is '{text}'; expected an empty cell: setup {row.setup} has {kind}"
                )
        if point and row.minus:
            raise SessionError(
                f"minus is '{row.minus}'; expected an empty cell in a row of a point"
            )

    def split(self, row: RawReading, values: Sequence[float]) -> dict[str, float]:
        """Readings of a row, [m], by setup.

        Args:
            row: The row.
            values: Coordinates of the point, shape (3,), [m].
        """
        names = self._setups_by_base[row.setup][:3]
        if any(getattr(row, c) for c in COVARIANCES):
            names = list(self._with_covariance(row))
        return {
            name: float(np.dot(np.array(cast(Points, self.setups[name].sensor).along), values))
            for name in names
        }

    def _with_covariance(self, row: RawReading) -> tuple[str, ...]:
        """Setups for the covariance of a row, added if the covariance is new."""
        texts = [getattr(row, c) for c in COVARIANCES]
        key = row.setup, " ".join(texts)
        if key not in self._setups_by_covariance:
            numbers = [
                parse_number(text, name=c, error=SessionError)
                for c, text in zip(COVARIANCES, texts, strict=True)
            ]
            xx, yy, zz, xy, xz, yz = numbers
            try:
                covariance = read_covariance([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            except SessionError as e:
                raise SessionError(f"the covariance {e.problem}") from None
            first = self.setups[self._setups_by_base[row.setup][0]]
            sensor = replace(cast(Points, first.sensor).in_file, covariance=covariance)
            base = replace(first, name=row.setup, sensor=sensor)
            number = 1 + sum(name == row.setup for name, _ in self._setups_by_covariance)
            gauge = self.session.gauges[first.gauge]
            setups, gauges = split_setup(base, gauge, number)
            self.setups |= setups
            self.gauges |= gauges
            self._setups_by_covariance[key] = tuple(setups)
        return self._setups_by_covariance[key]


def find_point(rows: Sequence[Reading], index: int) -> list[int]:
    """Indices of the rows of one line, in their order: three for a point, or one."""

    def line_key(i: int) -> object:
        row = rows[i]
        return base_name(row.setup), row.place[1:], row.cycle, row.line

    first, last = index, index
    if "[" in rows[index].setup:
        while first > 0 and line_key(first - 1) == line_key(index):
            first -= 1
        while last + 1 < len(rows) and line_key(last + 1) == line_key(index):
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


def value_name(setup: str) -> str:
    """Column of the readings of a setup, or principal axis of the covariance of its points."""
    axis = setup.partition("[")[2][:1]
    if axis.isdigit():
        return f"the coordinate along principal axis {axis}"
    return f"{axis or 'reading'}_mm"


def is_of_row(name: str) -> bool:
    """True for a setup that exists for the covariance of rows."""
    return len(name.partition("[")[2]) > len("x]")


def locate_stations(session: Session, *, partial: bool = False) -> Session:
    """Session whose stations of unknown frame start at the best fit to the nominal machine.

    Args:
        session: The session; empty rows and points without all coordinates are ignored.
        partial: Whether points may be missing; a station that they do not determine is not changed.

    Raises:
        SessionError: If the points of a station do not determine it.
    """
    by_station: dict[str, tuple[list[Array], list[Array], str]] = {}
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
        if sensor is None or len(part) < len(COORDINATES) or any(np.isnan(r.value) for r in part):
            continue
        postures, contact = contacts[part[0].setup]
        points, targets, _ = by_station.setdefault(
            sensor.station or "", ([], [], base_name(part[0].setup))
        )
        points.append(point_of(part, session.setups))
        targets.append(contact.points[postures.index(part[0].posture)])
    setups = dict(session.setups)
    for station, (points, targets, base) in by_station.items():
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
