"""Rows of readings against their session: names, numbers, the gauge's range, repetitions."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from orthocal.errors import SessionError
from orthocal.io.documents import parse_number
from orthocal.kinematics.conditions import find_approach_problem
from orthocal.measurement.files.point_rows import PointRows
from orthocal.measurement.files.readings_file import CONDITIONS, COORDINATES, RawReading
from orthocal.measurement.files.schema import MOST_READINGS
from orthocal.robot.description import HIGHEST_C, LOWEST_C
from orthocal.robot.model import Robot
from orthocal.sensors.protocol import (
    LARGEST_READING,
    is_difference,
    largest_reading,
    reads_pairs,
)
from orthocal.session.session import Conditions, Gauge, Reading, ReadingKey, Session
from orthocal.text import shorten, spans
from orthocal.units import MM

IN_UM = "; for readings in µm use `orthocal import --unit um`"
"""Remedy for readings in another unit."""

FAR = 5.0
"""Ratio of a reading to the range of the gauge above which its unit may be another."""


def check_readings(
    rows: Iterable[RawReading], plan: Session, *, file: Path
) -> tuple[tuple[Reading, ...], PointRows]:
    """Readings of a table, checked against their session and each other; NaN for empty cells.

    Rows of points may have covariances of their own, and with them setups beside the planned ones.

    Args:
        rows: The rows.
        plan: The session, for its setups, postures and gauges.
        file: File of the rows, for messages.

    Raises:
        SessionError: Naming file and line.
    """
    checked, points = _CheckedReadings(file), PointRows(plan)
    for row in rows:
        for reading in parse_row(row, plan, points):
            setup = points.setups[reading.setup]
            checked.add(row, reading, of_pair=reads_pairs(setup.sensor))
    if not checked.readings:
        raise SessionError("holds no readings", where=str(file))
    return tuple(checked.readings), points


def require_read(session: Session, *, partial: bool = False) -> None:
    """Refuse a session with readings that are missing; with `partial`, one without any reading.

    Raises:
        SessionError: Naming file, number and lines.
    """
    missing = [r for r in session.readings if not r.is_read]
    if len(missing) == len(session.readings):
        raise SessionError(
            "nothing was read yet; `orthocal record` takes the readings",
            where=str(session.readings_path),
        )
    if missing and not partial:
        raise SessionError(
            f"{describe_missing(session)}; `orthocal record` takes them or drops their lines, and "
            "`orthocal check` looks at the others",
            where=str(session.readings_path),
        )


def describe_missing(session: Session) -> str:
    """Number and lines of missing readings: 9 of 24 readings are missing (lines 14, 17 to 24)."""
    missing = [r for r in session.readings if not r.is_read]
    lines = sorted({r.line for r in missing if r.line is not None})
    where = f" ({spans(lines, 'line')})" if lines else ""
    verb = "is" if len(missing) == 1 else "are"
    return f"{len(missing)} of {len(session.readings)} readings {verb} missing{where}"


def parse_row(row: RawReading, plan: Session, points: PointRows) -> list[Reading]:
    """Reading of a row, or the three of a point, checked against its session; NaN if empty.

    Raises:
        SessionError: Naming file and line.
    """
    _check_names(row, plan, points)
    columns = COORDINATES if points.is_point(row) else ("reading_mm",)
    values = [_parse_value(row, column) * MM for column in columns]
    missing = [c for c, v in zip(columns, values, strict=True) if math.isnan(v)]
    if missing and len(missing) < len(values):
        raise SessionError(f"{missing[0]} is empty; expected all of a point", where=row.where)
    cycle, conditions = parse_cycle(row.cycle, row.where), read_conditions(row, plan.robot)
    of_setups = points.split(row, values) if points.is_point(row) else {row.setup: values[0]}
    readings = []
    for name, value in of_setups.items():
        setup = points.setups[name]
        largest = largest_reading(setup.sensor)
        difference = is_difference(row.minus or None, setup.sensor)
        check_range(value / MM, points.gauges[setup.gauge], difference, row.where, largest)
        reading = Reading(name, row.posture, row.minus or None, cycle, value, row.line)
        readings.append(replace(reading, conditions=conditions))
    return readings


def _parse_value(row: RawReading, column: str) -> float:
    text = getattr(row, column)
    if not text:
        return math.nan
    return parse_number(text, where=row.where, name=column, error=SessionError)


class _CheckedReadings:
    """Readings of a session that neither repeat nor contradict each other.

    Args:
        file: File of the rows, for messages.
    """

    def __init__(self, file: Path) -> None:
        self.readings: list[Reading] = []
        self._file = file
        self._first_lines: dict[ReadingKey, int] = {}
        self._zone_lines: dict[bool, int] = {}
        self._absolute: set[tuple[str, int]] = set()
        self._differences: dict[tuple[str, int], dict[str, str]] = {}

    def add(self, row: RawReading, reading: Reading, *, of_pair: bool) -> None:
        """Add a reading, if it agrees with those before it.

        Args:
            row: The row.
            reading: Its reading.
            of_pair: Whether it belongs to a pair of postures: such readings are independent.

        Raises:
            SessionError: Naming file and line.
        """
        if reading.key in self._first_lines:
            raise SessionError(
                f"repeats {reading.label} of cycle {reading.cycle}, first in line "
                f"{self._first_lines[reading.key]}; number repeated measurements in the column "
                "'cycle'",
                where=row.where,
            )
        self._first_lines[reading.key] = row.line
        self._check_zone(row, reading.conditions)
        if len(self.readings) >= MOST_READINGS:
            raise SessionError(f"holds more than {MOST_READINGS} readings", where=str(self._file))
        if not of_pair:
            self._check_form(reading, row.where)
        self.readings.append(reading)

    def _check_zone(self, row: RawReading, conditions: Conditions | None) -> None:
        """Refuse times with and without time zone in one session."""
        if conditions is None or conditions.time is None:
            return
        zoned = conditions.time.tzinfo is not None
        self._zone_lines.setdefault(zoned, row.line)
        if len(self._zone_lines) > 1:
            raise SessionError(
                f"time is '{row.time}'; expected all times of a session with a time zone, or all "
                f"without one, as in line {self._zone_lines[not zoned]}",
                where=row.where,
            )

    def _check_form(self, reading: Reading, where: str) -> None:
        """Refuse readings that determine each other within one cycle of one setup."""
        group = (reading.setup, reading.cycle)
        if reading.minus is None:
            self._absolute.add(group)
        else:
            leaders = self._differences.setdefault(group, {})
            first, second = (_find_leader(leaders, n) for n in (reading.posture, reading.minus))
            if first == second:
                raise SessionError(
                    f"{reading.label} follows from the other differences of setup "
                    f"{reading.setup} in cycle {reading.cycle}; leave it out, or give it its own "
                    "cycle if it was measured apart",
                    where=where,
                )
            leaders[first] = second
        if group in self._absolute and group in self._differences:
            raise SessionError(
                f"setup {reading.setup} has both readings and differences in cycle "
                f"{reading.cycle}; give the readings only",
                where=where,
            )


def _find_leader(leaders: dict[str, str], name: str) -> str:
    """Representative of the postures that differences connect with a posture."""
    while (above := leaders.get(name, name)) != name:
        leaders[name] = leaders.get(above, above)  # halves the path
        name = above
    return name


def require_name(name: str, names: Collection[str], noun: str, *, where: str) -> None:
    """Refuse a name that is not among those of a session.

    Raises:
        SessionError: With the names of the session.
    """
    if name not in names:
        raise SessionError(f"'{name}' is not a {noun}; {noun}s: {', '.join(names)}", where=where)


def _check_names(row: RawReading, plan: Session, points: PointRows) -> None:
    """Refuse a setup or postures that the session does not have."""
    require_name(row.setup, points.names, "setup", where=row.where)
    points.check_columns(row)
    for name in (row.posture, row.minus) if row.minus else (row.posture,):
        require_name(name, plan.postures, "posture", where=row.where)
    if row.minus == row.posture:
        raise SessionError(f"takes posture '{row.posture}' off itself", where=row.where)
    setup = plan.setups.get(row.setup)
    if setup is not None and reads_pairs(setup.sensor) and not row.minus:
        raise SessionError(
            f"minus is empty; expected the second posture of the pair: setup {row.setup} has a "
            f"{setup.sensor.describe()}",
            where=row.where,
        )


def read_conditions(row: RawReading, robot: Robot) -> Conditions | None:
    """Conditions of a row; None if it states none.

    Raises:
        SessionError: Naming file, line and column.
    """
    stated = {column: text for column in CONDITIONS if (text := getattr(row, column))}
    if not stated:
        return None
    if row.minus:
        column, text = next(iter(stated.items()))
        raise SessionError(
            f"{column} is '{shorten(text)}'; expected an empty cell: the row is a difference, and "
            "conditions belong to single readings",
            where=row.where,
        )
    return Conditions(
        parse_approach(row.approach, robot, row.where) if row.approach else None,
        parse_temperature(row.temperature_C, row.where) if row.temperature_C else None,
        parse_time(row.time, row.where) if row.time else None,
    )


def check_conditions(conditions: Conditions, robot: Robot, difference: bool, where: str) -> None:
    """Refuse conditions that a reading cannot have.

    Raises:
        SessionError: At `where`.
    """
    if difference:
        raise SessionError(
            "is a difference of two postures; conditions belong to single readings", where=where
        )
    if conditions.approach is not None:
        parse_approach(conditions.approach, robot, where)
    if conditions.temperature is not None:
        parse_temperature(str(conditions.temperature), where)


def parse_approach(text: str, robot: Robot, where: str) -> str:
    """Directions of the drives' last motions.

    Raises:
        SessionError: If it is not a letter for each drive.
    """
    problem = find_approach_problem(text, robot)
    if problem:
        raise SessionError(f"approach is {problem}", where=where)
    return text


def parse_temperature(text: str, where: str) -> float:
    """A temperature, [°C].

    Raises:
        SessionError: If it is not one of a workshop.
    """
    value = parse_number(text, where=where, name="temperature_C", error=SessionError)
    if not LOWEST_C <= value <= HIGHEST_C:
        raise SessionError(
            f"temperature_C is {value:g}; expected degrees Celsius from {LOWEST_C:g} to "
            f"{HIGHEST_C:g}",
            where=where,
        )
    return value


def parse_time(text: str, where: str) -> datetime:
    """Date and time of day.

    Raises:
        SessionError: If it is not in the form of ISO 8601.
    """
    try:
        if len(text) <= len("2025-03-14"):
            raise ValueError
        return datetime.fromisoformat(text)
    except ValueError:
        raise SessionError(
            f"time is '{shorten(text)}'; expected date and time of ISO 8601, such as "
            "2025-03-14T09:26:53 or 2025-03-14T09:26:53+01:00",
            where=where,
        ) from None


def parse_cycle(text: str, where: str) -> int:
    """The cycle of a row; 1 where none is given.

    Raises:
        SessionError: If it is no number from 1 on.
    """
    if not text:
        return 1
    if not (text.isascii() and text.isdigit() and len(text) < 10 and int(text) >= 1):
        raise SessionError(f"cycle is '{shorten(text)}'; expected 1, 2, 3 ...", where=where)
    return int(text)


def check_range(
    value_mm: float,
    gauge: Gauge,
    difference: bool,
    where: str,
    largest: float = LARGEST_READING,
) -> None:
    """Refuse a reading that no indicator shows, or not this one; accept NaN.

    Raises:
        SessionError: At `where`.
    """
    if abs(value_mm) > largest / MM:
        raise SessionError(
            f"reading_mm is {value_mm:g}; expected a number within ±{largest / MM:g}: no "
            f"indicator reaches further{IN_UM}",
            where=where,
        )
    if gauge.range is None:
        return
    lowest, highest = (v / MM for v in gauge.range)
    if difference:
        lowest, highest = lowest - highest, highest - lowest
    if value_mm < lowest - 1e-9 or value_mm > highest + 1e-9:
        kind = "a difference" if difference else "a reading"
        hint = IN_UM if abs(value_mm) > FAR * max(-lowest, highest) else ""
        raise SessionError(
            f"reading_mm is {value_mm:g}; the gauge's range allows {kind} from "
            f"{lowest:g} to {highest:g}{hint}",
            where=where,
        )
