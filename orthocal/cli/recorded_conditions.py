"""Conditions that `record` stores with readings: side of approach, temperature and time."""

from __future__ import annotations

import sys
from datetime import datetime
from typing import TypeGuard

from orthocal.errors import SessionError, errors_at
from orthocal.io.tables.numerals import plain_minus
from orthocal.kinematics.conditions import APPROACH, find_approach_problem
from orthocal.measurement.files.readings_checks import parse_temperature
from orthocal.measurement.recorded_rows import NextConditions, RecordedReading
from orthocal.measurement.recording import Recording
from orthocal.observation.conditions import needed_conditions
from orthocal.session.session import Conditions

USUAL_C = 5.0, 45.0
"""Usual temperatures of a machine in a workshop, [°C]."""

USUAL_CHANGE = 10.0
"""Largest usual change of the temperature between two setups, [K]."""


class RecordedConditions:
    """Conditions of the reading that is asked for and of the following readings.

    A condition that is typed while an existing reading is corrected applies to that reading only.
    If an effect needs the temperature, it is asked for in each setup. The side of approach is asked
    for once if an effect needs it and the plan does not state it. The time is that of the clock,
    unless readings come from a file or from paper. A recording that continues proposes the
    conditions that were typed last.

    Args:
        recording: The recording.
        programmed: Approach of the programs, for a plan that states none.
    """

    def __init__(self, recording: Recording, programmed: str) -> None:
        before = recording.following
        self._needed = needed_conditions(recording.session.robot)
        self.temperature = before.temperature
        self.is_unusual = False
        """True if the temperature that was typed last may be a mistake."""
        typed = before.approach
        if typed is not None and find_approach_problem(typed, recording.session.robot):
            typed = None  # the robot has other drives now
        self.proposed = typed or programmed
        """Approach that Enter accepts where it is asked for."""
        self.approach = None if "approach" in self._needed else typed
        at_terminal = sys.stdin is not None and sys.stdin.isatty()
        self.clock = at_terminal and before.clock is not False
        self._recording = recording
        self._asked: set[str] = set()
        """Setups whose temperature was asked for."""
        self._following: tuple[str | None, float | None] | None = None
        """Approach and temperature of the following readings while a reading is corrected."""

    def question(self, row: RecordedReading) -> str | None:
        """Condition to ask for before a row is read; None if all are known."""
        if row.minus is not None:
            return None
        if "approach" in self._needed and row.approach is None and self.approach is None:
            return "approach"
        if "temperature" in self._needed and row.setup_in_file not in self._asked:
            self._continue(row.setup_in_file)
            return "temperature"
        return None

    def _continue(self, setup: str) -> None:
        """Propose the last temperature of a setup that was read in part."""
        stated = [
            r.conditions for r in self._recording.rows if r.setup_in_file == setup and r.is_read
        ]
        temperatures = [c.temperature for c in stated if c and c.temperature is not None]
        if self.temperature is None and temperatures:
            self.temperature = temperatures[-1]

    def set_condition(self, condition: str, text: str, row: RecordedReading | None) -> None:
        """Set a condition of an existing reading, or of a new one and the following ones.

        Args:
            condition: "approach" or "temperature".
            text: The condition as typed; "" accepts the proposed value.
            row: Row that is asked for; its setup needs no question about the temperature then.

        Raises:
            SessionError: If the text is invalid.
        """
        if row is not None and row.is_read and self._following is None:
            self._following = self.approach, self.temperature
        if condition == "approach":
            self.approach = self._read_approach(text or self.proposed)
            self._keep(NextConditions(approach=self.approach))
            return
        if text:
            self.temperature = self._read_temperature(text)
            self._keep(NextConditions(temperature=self.temperature))
        if row is not None:
            self._asked.add(row.setup_in_file)

    def switch_clock(self) -> None:
        """Begin or stop to note times, also in the next recording."""
        self.clock = not self.clock
        self._recording.note(NextConditions(clock=self.clock))

    def _keep(self, condition: NextConditions) -> None:
        """Keep a condition for the next recording, unless it is that of a corrected reading."""
        if self._following is None:
            self._recording.note(condition)

    def end_correction(self) -> None:
        """Restore the conditions of the following readings after an existing one."""
        if self._following is not None:
            (self.approach, self.temperature), self._following = self._following, None

    def _read_temperature(self, text: str) -> float:
        """Typed temperature, [°C]; refuse one that no workshop has."""
        number, before = plain_minus(text).replace(",", "."), self.temperature
        with errors_at("the temperature"):
            temperature = parse_temperature(number)
        change = abs(temperature - before) if _is_usual(before) else 0.0
        self.is_unusual = not _is_usual(temperature) or change > USUAL_CHANGE
        return temperature

    def _read_approach(self, text: str) -> str:
        """Approach as typed: one letter for each drive, or for all."""
        robot = self._recording.session.robot
        letters = text * len(robot.drives) if text in APPROACH else text
        if problem := find_approach_problem(letters, robot):
            raise SessionError(f"the side is {problem}; or one of these letters for all drives")
        return letters

    def of(self, row: RecordedReading) -> Conditions:
        """Conditions of a reading that is typed now, without a planned approach."""
        if row.minus is not None:
            return Conditions()
        approach = self.approach if row.planned_approach is None else None
        return Conditions(approach, self.temperature, self._time(row))

    def _time(self, row: RecordedReading) -> datetime | None:
        """Time of the clock, with a time zone unless other readings have times without one.

        None if another reading of the setup has no time; then the order of the rows is assumed.
        """
        read = [r for r in self._recording.rows if r.is_read and r is not row and not r.minus]
        times = [r.conditions.time if r.conditions else None for r in read]
        if not self.clock or any(
            t is None
            for r, t in zip(read, times, strict=True)
            if r.setup_in_file == row.setup_in_file
        ):
            return None
        now = datetime.now().astimezone().replace(microsecond=0)
        zoned = all(t is None or t.tzinfo is not None for t in times)
        return now if zoned else now.replace(tzinfo=None)


def _is_usual(temperature: float | None) -> TypeGuard[float]:
    """True for a usual temperature of a machine in a workshop, [°C]."""
    return temperature is not None and USUAL_C[0] <= temperature <= USUAL_C[1]
