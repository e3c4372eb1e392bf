"""Rows of readings against their session: names, numbers, the gauge's range, repetitions."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from orthocal.errors import SessionError
from orthocal.io.documents import parse_number
from orthocal.measurement.files.schema import LARGEST_READING_MM, MOST_READINGS
from orthocal.session.session import Gauge, Reading, Session
from orthocal.text import shorten
from orthocal.units import MM


@dataclass(frozen=True, slots=True)
class RawReading:
    """A row of a table of readings, as text."""

    where: str
    """File and line, for messages."""
    line: int
    setup: str
    posture: str
    minus: str
    cycle: str
    reading: str
    """In mm, with a decimal point."""


def check_readings(
    rows: Iterable[RawReading],
    plan: Session,
    *,
    file: Path,
    unread: set[int] | None = None,
) -> tuple[Reading, ...]:
    """Readings of a table, each with the row it is from.

    Args:
        rows: The rows.
        plan: The session, for its setups, postures and gauges.
        file: Where the rows are from, for messages.
        unread: Where it is given cells may be empty, their readings are 0, and it is told which.

    Raises:
        SessionError: Naming file and line.
    """
    rows = iter(rows)
    readings: list[Reading] = []
    seen: dict[tuple[Any, ...], int] = {}
    raw: dict[tuple[str, int], int] = {}
    joined: dict[tuple[str, int], dict[str, str]] = {}
    for row in rows:
        where = row.where
        setup, posture, minus = row.setup, row.posture, row.minus
        if setup not in plan.setups:
            raise SessionError(
                f"'{setup}' is not a setup; setups: {', '.join(plan.setups)}", where=where
            )
        for name in (posture, minus):
            if name not in plan.postures and (name or name is posture):
                raise SessionError(
                    f"'{name}' is not a posture; postures: {', '.join(plan.postures)}",
                    where=where,
                )
        if minus == posture:
            raise SessionError(f"takes posture '{posture}' off itself", where=where)
        cycle = parse_cycle(row.cycle, where)
        if not row.reading:
            if unread is None:
                if not readings and not any(r.reading for r in rows):
                    raise SessionError(
                        "nothing was read yet; `orthocal record` takes the readings",
                        where=str(file),
                    )
                raise SessionError(
                    "reading_mm is empty; expected what the gauge showed, or no row where nothing "
                    "was read (`orthocal record` takes it, or drops the row)",
                    where=where,
                )
            unread.add(len(readings))
        text = row.reading or "0"
        value = parse_number(text, where=where, name="reading_mm", error=SessionError)
        reading = Reading(setup, posture, minus or None, cycle, value * MM, row.line)
        key = (setup, posture, minus, cycle)
        if key in seen:
            raise SessionError(
                f"repeats {reading.label} of cycle {cycle}, first in line {seen[key]}; "
                "number repeated measurements in the column 'cycle'",
                where=where,
            )
        seen[key] = row.line
        if len(readings) >= MOST_READINGS:
            raise SessionError(f"holds more than {MOST_READINGS} readings", where=str(file))
        check_range(value, plan.gauges[plan.setups[setup].gauge], bool(minus), where)
        _check_form(reading, raw, joined, where)
        readings.append(reading)
    if not readings:
        raise SessionError("holds no readings", where=str(file))
    return tuple(readings)


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


def check_range(value_mm: float, gauge: Gauge, difference: bool, where: str) -> None:
    """Refuse a reading that no indicator shows, or not this one.

    Raises:
        SessionError: At `where`.
    """
    if abs(value_mm) > LARGEST_READING_MM:
        raise SessionError(
            f"reading_mm is {value_mm:g}; expected a number within ±{LARGEST_READING_MM:g}: no "
            "indicator reaches further",
            where=where,
        )
    if gauge.range is None:
        return
    lowest, highest = (v / MM for v in gauge.range)
    if difference:
        lowest, highest = lowest - highest, highest - lowest
    if not lowest - 1e-9 <= value_mm <= highest + 1e-9:
        kind = "a difference" if difference else "a reading"
        raise SessionError(
            f"reading_mm is {value_mm:g}; the gauge's range allows {kind} from "
            f"{lowest:g} to {highest:g}",
            where=where,
        )


def _check_form(
    reading: Reading,
    raw: dict[tuple[str, int], int],
    joined: dict[tuple[str, int], dict[str, str]],
    where: str,
) -> None:
    """Refuse readings that say the same thing twice within one cycle of one setup."""
    group = (reading.setup, reading.cycle)
    if reading.minus is None:
        raw.setdefault(group, reading.line or 0)
    else:
        leader = joined.setdefault(group, {})

        def find(name: str) -> str:
            while (above := leader.get(name, name)) != name:
                leader[name] = leader.get(above, above)  # half the way next time
                name = above
            return name

        first, second = find(reading.posture), find(reading.minus)
        if first == second:
            raise SessionError(
                f"{reading.label} follows from the other differences of setup "
                f"{reading.setup} in cycle {reading.cycle}; leave it out, or give it its own "
                "cycle if it was measured apart",
                where=where,
            )
        leader[first] = second
    if group in raw and group in joined:
        raise SessionError(
            f"setup {reading.setup} has both readings and differences in cycle {reading.cycle}; "
            "give the readings only",
            where=where,
        )
