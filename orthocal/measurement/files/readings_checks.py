"""Validation of reading rows against their session: names, numbers, range, repetitions."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from orthocal.errors import SessionError, errors_at
from orthocal.io.documents import parse_number
from orthocal.kinematics.conditions import find_approach_problem
from orthocal.measurement.files.point_rows import PointRows, value_name
from orthocal.measurement.files.readings_file import CONDITIONS, COORDINATES, RawReading
from orthocal.measurement.files.session_keys import MOST_READINGS
from orthocal.observation.conditions import needed_conditions
from orthocal.robot.description import HIGHEST_C, LOWEST_C
from orthocal.robot.model import Robot
from orthocal.sensors.protocol import is_difference, largest_reading, reads_pairs
from orthocal.session.completeness import require_name
from orthocal.session.differences import IndependentReadings
from orthocal.session.points import count_readings
from orthocal.session.session import Conditions, Gauge, Reading, ReadingKey, Session, Setup
from orthocal.text import shorten, spans
from orthocal.units import MM

UNIT_HINT = (
    "; for readings in µm or in hundredths of a mm use `orthocal import` with `--unit um` or "
    "`--unit hundredths`"
)
"""Action in case of a wrong unit."""

UNIT_HINT_RATIO = 5.0
"""Ratio of a reading to the range of the gauge above which a wrong unit is suspected."""

POINT_HINT_RATIO = 1.5
"""Ratio of a reading to the range of the gauge above which its decimal point is suspected."""

ROUNDING_MM = 1e-9
"""Excess over the range of a gauge that may be a rounding error, [mm]."""


def check_readings(
    rows: Iterable[RawReading],
    session: Session,
    *,
    file: Path,
    wrong: list[SessionError] | None = None,
) -> tuple[tuple[Reading, ...], PointRows]:
    """Readings of a table, checked against their session and each other; NaN for empty cells.

    Measured points may state a covariance per row, which creates additional setups.

    Args:
        rows: The rows.
        session: The session with its setups, postures and gauges.
        file: File of the rows, for messages.
        wrong: List that is set to the errors of readings out of range; these readings become NaN.
            By default, and if most readings are out of range, the first error is raised.

    Returns:
        The readings, and all setups of the session with the additional ones.

    Raises:
        SessionError: If a row is wrong; names file and line.
    """
    needs_approach = "approach" in needed_conditions(session.robot)
    accepted, points = _AcceptedReadings(file, needs_approach=needs_approach), PointRows(session)
    for row in rows:
        with errors_at(row.where):
            for reading in parse_row(row, session, points):
                setup = points.setups[reading.setup]
                accepted.add(row, reading, of_pair=reads_pairs(setup.sensor))
    if not accepted.readings:
        raise SessionError("holds no readings", where=str(file))
    out_of_range = _find_out_of_range(accepted, points)
    n_read = sum(reading.is_read for reading in accepted.readings)
    if out_of_range and (wrong is None or 2 * len(out_of_range) > n_read):
        raise next(iter(out_of_range.values()))
    if wrong is not None:
        wrong[:] = out_of_range.values()
    readings = tuple(
        replace(reading, value=math.nan) if place in out_of_range else reading
        for reading, place in zip(accepted.readings, accepted.places, strict=True)
    )
    return readings, points


def _find_out_of_range(accepted: _AcceptedReadings, points: PointRows) -> dict[str, SessionError]:
    """Errors of readings beyond the range of their gauge or sensor, by file and line."""
    errors: dict[str, SessionError] = {}
    values_mm: dict[str, list[float]] = {}
    for reading in accepted.readings:
        if reading.is_read:
            values_mm.setdefault(reading.setup, []).append(reading.value / MM)
    of_setup_mm = {setup: np.array(values) for setup, values in values_mm.items()}
    for reading, place in zip(accepted.readings, accepted.places, strict=True):
        setup = points.setups[reading.setup]
        try:
            check_range(
                reading.value / MM,
                setup,
                points.gauges[setup.gauge],
                minus=reading.minus,
                of_setup_mm=of_setup_mm.get(reading.setup, ()),
            )
        except SessionError as e:
            errors.setdefault(place, SessionError(e.problem, where=place))
    return errors


def require_read(session: Session, *, partial: bool = False) -> None:
    """Refuse a session with missing readings.

    Args:
        session: The session.
        partial: Whether some of the readings may be missing, but not all.

    Raises:
        SessionError: If readings are missing; names file, number and lines.
    """
    missing = [r for r in session.readings if not r.is_read]
    if len(missing) == len(session.readings):
        raise SessionError(
            "no reading is entered yet; run `orthocal record`",
            where=str(session.readings_path),
        )
    if missing and not partial:
        raise SessionError(
            f"{describe_missing(session)}; complete or delete them with `orthocal record`, or "
            "check the others with `orthocal check`",
            where=str(session.readings_path),
        )


def describe_missing(session: Session) -> str:
    """Number and lines of missing readings.

    For example "9 of 24 readings are missing (lines 14, 17 to 24)". Lines of joined sessions follow
    the name of their file.
    """
    missing = [r for r in session.readings if not r.is_read]
    lines: dict[Path | None, set[int]] = {}
    for r in missing:
        if r.line is not None:
            lines.setdefault(r.file, set()).add(r.line)
    places = "; ".join(
        f"{'' if file is None else f'{file}: '}{spans(sorted(numbers), 'line')}"
        for file, numbers in lines.items()
    )
    count = count_readings(session, missing)
    return (
        f"{count} of {count_readings(session)} readings {'is' if count == 1 else 'are'} missing"
        + (f" ({places})" if places else "")
    )


def parse_row(row: RawReading, session: Session, points: PointRows) -> list[Reading]:
    """Readings of a row: one, or three for a measured point; NaN if its cells are empty.

    Raises:
        SessionError: If the row contradicts the session; names file and line.
    """
    with errors_at(row.where):
        _check_names(row, session, points)
        columns = COORDINATES if points.is_point(row) else ("reading_mm",)
        values = [_parse_value(getattr(row, column), column) * MM for column in columns]
        missing = [c for c, v in zip(columns, values, strict=True) if math.isnan(v)]
        if missing and len(missing) < len(values):
            raise SessionError(
                f"{missing[0]} is empty; expected all three coordinates of the point"
            )
        cycle, conditions = parse_cycle(row.cycle), parse_conditions(row, session.robot)
        by_setup = points.split(row, values) if points.is_point(row) else {row.setup: values[0]}
    return [
        Reading(name, row.posture, row.minus or None, cycle, value, row.line, conditions=conditions)
        for name, value in by_setup.items()
    ]


def _parse_value(text: str, column: str) -> float:
    return parse_number(text, name=column, error=SessionError) if text else math.nan


class _AcceptedReadings:
    """Readings of a session that neither repeat nor contradict each other.

    Args:
        file: File of the rows, for messages.
        needs_approach: Whether an effect of the machine depends on the approach.
    """

    def __init__(self, file: Path, *, needs_approach: bool) -> None:
        self.readings: list[Reading] = []
        self.places: list[str] = []
        """File and line of each reading."""
        self._file = file
        self._needs_approach = needs_approach
        self._first_lines: dict[ReadingKey, int] = {}
        self._first_line_by_zoned: dict[bool, int] = {}
        self._independent = IndependentReadings()

    def add(self, row: RawReading, reading: Reading, *, of_pair: bool) -> None:
        """Add a reading that agrees with the previous ones.

        Args:
            row: The row.
            reading: Its reading.
            of_pair: Whether the sensor reads pairs of postures; these readings are independent.

        Raises:
            SessionError: If the reading disagrees with the previous ones.
        """
        if reading.key in self._first_lines:
            raise SessionError(self._describe_repetition(reading))
        self._first_lines[reading.key] = row.line
        self._require_consistent_time_zone(row, reading.conditions)
        if len(self.readings) >= MOST_READINGS:
            raise SessionError(f"holds more than {MOST_READINGS} readings", where=str(self._file))
        if not of_pair:
            self._independent.add(reading)
        self.readings.append(reading)
        self.places.append(row.where)

    def _describe_repetition(self, reading: Reading) -> str:
        """Problem of a reading whose row exists already."""
        repeats = (
            f"repeats {reading.label} of cycle {reading.cycle}, first in line "
            f"{self._first_lines[reading.key]}"
        )
        if self._needs_approach and all(r.approach is None for r in self.readings):
            return (
                f"{repeats}; the column 'approach' is missing or empty. Copy it from the plan: it "
                "states the side from which each posture was approached. Number repetitions from "
                "one side in the column 'cycle'"
            )
        sides = ", and different sides of approach in 'approach'" * (reading.approach is None)
        return f"{repeats}; number repeated measurements in the column 'cycle'{sides}"

    def _require_consistent_time_zone(self, row: RawReading, conditions: Conditions | None) -> None:
        """Refuse times with and without time zone in one session."""
        if conditions is None or conditions.time is None:
            return
        zoned = conditions.time.tzinfo is not None
        self._first_line_by_zoned.setdefault(zoned, row.line)
        if len(self._first_line_by_zoned) > 1:
            raise SessionError(
                f"time is '{row.time}'; expected all times of a session with a time zone, or all "
                f"without one, as in line {self._first_line_by_zoned[not zoned]}"
            )


def _check_names(row: RawReading, session: Session, points: PointRows) -> None:
    """Refuse a setup or postures that the session does not have, and cells of other sensors."""
    require_name(row.setup, points.names, "setup")
    points.check_columns(row)
    for name in (row.posture, row.minus) if row.minus else (row.posture,):
        require_name(name, session.postures, "posture")
    if row.minus == row.posture:
        raise SessionError(f"posture and minus are both '{row.posture}'; expected two postures")
    setup = session.setups.get(row.setup)
    if setup is not None and reads_pairs(setup.sensor) and not row.minus:
        raise SessionError(
            f"minus is empty; expected the second posture of the pair: setup {row.setup} has a "
            f"{setup.sensor.describe()}"
        )


def parse_conditions(row: RawReading, robot: Robot) -> Conditions | None:
    """Conditions of a row; None if it states none.

    Raises:
        SessionError: If a condition is wrong; names the column.
    """
    stated = {column: text for column in CONDITIONS if (text := getattr(row, column))}
    if not stated:
        return None
    if row.minus:
        column, text = next(iter(stated.items()))
        raise SessionError(
            f"{column} is '{shorten(text)}'; expected an empty cell: the row has two postures, and "
            "conditions belong to readings in one posture"
        )
    conditions = Conditions(
        row.approach or None,
        parse_temperature(row.temperature_C) if row.temperature_C else None,
        parse_time(row.time) if row.time else None,
    )
    check_conditions(conditions, robot, two_postures=False)
    return conditions


def check_conditions(conditions: Conditions, robot: Robot, *, two_postures: bool) -> None:
    """Refuse conditions that a reading cannot have.

    Args:
        conditions: The conditions.
        robot: The robot.
        two_postures: Whether the reading belongs to two postures.

    Raises:
        SessionError: If the reading cannot have the conditions.
    """
    if two_postures and conditions != Conditions():
        raise SessionError("has two postures; conditions belong to readings in one posture")
    approach = conditions.approach
    if approach is not None and (problem := find_approach_problem(approach, robot)):
        raise SessionError(f"approach is {problem}")
    if conditions.temperature is not None:
        _require_temperature(conditions.temperature)


def parse_temperature(text: str) -> float:
    """Temperature, [°C].

    Raises:
        SessionError: If the text is not a number from LOWEST_C to HIGHEST_C.
    """
    value = parse_number(text, name="temperature_C", error=SessionError)
    _require_temperature(value)
    return value


def _require_temperature(value: float) -> None:
    """Refuse a temperature, [°C], that no workshop has."""
    if not LOWEST_C <= value <= HIGHEST_C:
        raise SessionError(
            f"temperature_C is {value:g}; expected degrees Celsius from {LOWEST_C:g} to "
            f"{HIGHEST_C:g}"
        )


def parse_time(text: str) -> datetime:
    """Date and time of day.

    Raises:
        SessionError: If the text is not in the form of ISO 8601.
    """
    try:
        if len(text) <= len("2025-03-14"):  # a date alone is not enough
            raise ValueError
        return datetime.fromisoformat(text)
    except ValueError:
        raise SessionError(
            f"time is '{shorten(text)}'; expected date and time of ISO 8601, such as "
            "2025-03-14T09:26:53 or 2025-03-14T09:26:53+01:00"
        ) from None


def parse_cycle(text: str) -> int:
    """Cycle of a row; 1 if its cell is empty.

    Raises:
        SessionError: If the text is not a positive integer.
    """
    if not text:
        return 1
    if not (text.isascii() and text.isdigit() and len(text) < 10 and int(text) >= 1):
        raise SessionError(f"cycle is '{shorten(text)}'; expected 1, 2, 3 ...")
    return int(text)


def check_range(
    value_mm: float, setup: Setup, gauge: Gauge, *, minus: str | None, of_setup_mm: ArrayLike
) -> None:
    """Refuse a reading beyond the range of the gauge or of its kind of sensor. NaN passes.

    Args:
        value_mm: Reading, [mm].
        setup: Its setup.
        gauge: The gauge of the setup.
        minus: Posture whose reading is subtracted; None for a single reading.
        of_setup_mm: Readings of the setup, [mm]. If most are in range, a larger reading may have a
            misplaced decimal point.

    Raises:
        SessionError: If the reading is out of range.
    """
    difference, largest_mm = is_difference(minus, setup.sensor), largest_reading(setup.sensor) / MM
    range_mm = (-largest_mm, largest_mm) if gauge.range is None else [v / MM for v in gauge.range]
    lowest, highest = range_mm
    if difference and gauge.range is not None:
        lowest, highest = lowest - highest, highest - lowest
    limits = f"{lowest:g} to {highest:g}"
    lowest, highest = lowest - ROUNDING_MM, highest + ROUNDING_MM
    beyond_sensor = abs(value_mm) > largest_mm
    if not beyond_sensor and not (value_mm < lowest or value_mm > highest):
        return
    ratio = abs(value_mm) / max(-lowest, highest)
    of_setup = np.asarray(of_setup_mm)
    n_in_range = np.count_nonzero((lowest <= of_setup) & (of_setup <= highest))
    whole_numbers = all(np.round(v) == v for v in (value_mm, *of_setup[np.isfinite(of_setup)]))
    hint = "; if the dial is at the end of its range, omit this reading"
    if beyond_sensor or whole_numbers or ratio > UNIT_HINT_RATIO:
        hint = UNIT_HINT
    if ratio > POINT_HINT_RATIO and 2 * n_in_range > of_setup.size:
        hint = "; its decimal point may be misplaced"
    if beyond_sensor:
        expected = f"expected a number within ±{largest_mm:g}, the limit of this kind of sensor"
    else:
        kind = "a difference" if difference else "a reading"
        expected = f"the gauge's range allows {kind} from {limits}"
    raise SessionError(f"{value_name(setup.name)} is {value_mm:g}; {expected}{hint}")
