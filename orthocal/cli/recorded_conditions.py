"""Conditions of typed readings: temperature, side of approach, time."""

from __future__ import annotations

import sys
from datetime import datetime

from orthocal.io.tables.numerals import plain_minus
from orthocal.measurement.files.readings_checks import parse_temperature, require_approach
from orthocal.measurement.recording import Recording
from orthocal.observation.conditions import needed_conditions
from orthocal.session.session import Conditions, Reading


class RecordedConditions:
    """Conditions of the following readings.

    If an effect needs the temperature, it is asked for in each setup. The side of approach is asked
    for once if an effect needs it and the plan does not state it. The time is that of the clock,
    unless readings come from a file or from paper.

    Args:
        recording: The recording.
        programmed: Approach of the programs, for a plan that states none.
    """

    def __init__(self, recording: Recording, programmed: str) -> None:
        self.temperature: float | None = None
        self.approach: str | None = None
        self.clock = sys.stdin is not None and sys.stdin.isatty()
        self.programmed = programmed
        self._recording = recording
        self._needed = needed_conditions(recording.session.robot)
        self._asked: set[str] = set()
        """Setups whose temperature was asked for."""

    def question(self, row: Reading) -> str | None:
        """Condition to ask for before a row is read; None if all are known."""
        if row.minus is not None:
            return None
        if "approach" in self._needed and row.approach is None and self.approach is None:
            return "approach"
        if "temperature" in self._needed and row.setup not in self._asked:
            return "temperature"
        return None

    def answer(self, question: str, text: str, row: Reading) -> None:
        """Store the answer to a question; an empty one accepts the proposed value.

        Raises:
            SessionError: If the answer is invalid.
        """
        if question == "approach":
            self.set_approach(text or self.programmed)
            return
        if text:
            self.set_temperature(text)
        self._asked.add(row.setup)

    def set_temperature(self, text: str) -> None:
        """Set the temperature of the following readings, [°C].

        Raises:
            SessionError: If the temperature is not that of a workshop.
        """
        number = plain_minus(text).replace(",", ".")
        self.temperature = parse_temperature(number, "the temperature")

    def set_approach(self, text: str) -> None:
        """Set the approach of the following readings: one letter for each drive, or for all.

        Raises:
            SessionError: If the letters are wrong.
        """
        robot = self._recording.session.robot
        letters = text * len(robot.drives) if len(text) == 1 else text
        require_approach(letters, robot, "the side")
        self.approach = letters

    def of(self, row: Reading) -> Conditions | None:
        """Conditions of a reading that is typed now; None if nothing is stated."""
        if row.minus is not None:
            return None
        stated = Conditions(
            self.approach if row.approach is None else None, self.temperature, self._time(row)
        )
        return None if stated == Conditions() else stated

    def _time(self, row: Reading) -> datetime | None:
        """Time of the clock, with a time zone unless other readings have times without one.

        None if another reading of the setup has no time; then the order of the rows is assumed.
        """
        read = [r for r in self._recording.rows if r.is_read and r is not row and not r.minus]
        times = [r.conditions.time if r.conditions else None for r in read]
        if not self.clock or any(
            t is None for r, t in zip(read, times, strict=True) if r.setup == row.setup
        ):
            return None
        now = datetime.now().astimezone().replace(microsecond=0)
        zoned = all(t is None or t.tzinfo is not None for t in times)
        return now if zoned else now.replace(tzinfo=None)
