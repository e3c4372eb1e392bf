"""Rows of a recording, their changes, and the lines of its journal.

An approach is planned, or the operator types it with the reading. The CSV has one column for both.
The changes state which approaches were typed: they are corrected and deleted with their readings.
Each change is a line of the journal with the digests of the CSV before and after it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field

from orthocal.errors import OrthocalError, SessionError
from orthocal.io.documents import Keys, Number, validate
from orthocal.io.journal import Journal
from orthocal.measurement.files.session_keys import ReadingLimit
from orthocal.sensors.points import Coordinate
from orthocal.session.points import base_name
from orthocal.session.session import Conditions, Reading, ReadingKey, Session, known_approach
from orthocal.units import MM


class Change(Keys):
    """Change of the rows of a recording."""

    done: Literal["read", "emptied", "added", "dropped"]
    """Kind of change: `read` gives a row its value; `emptied` removes the values of all rows of its
    setup; `added` appends another row after it; `dropped` deletes it. The three rows of a point
    change together."""
    rows: Annotated[list[ReadingKey], Field(min_length=1, max_length=6)]
    """Keys of the row, or of the three rows of a point, then of as many added rows."""
    reading_mm: ReadingLimit | None = None
    point_mm: Annotated[list[Coordinate], Field(min_length=3, max_length=3)] | None = None
    """Readings of the three rows of a point."""
    conditions: Conditions | None = None
    """Conditions stated with the value; those that are None do not change, except that an approach
    is planned unless it is stated."""
    line: int | None = None
    """Line of a deleted row, by which it can be added again."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordedReading(Reading):
    """Row of a recording.

    Args:
        has_typed_approach: Whether the approach was typed with the reading, and not planned.
    """

    has_typed_approach: bool = False

    @property
    def setup_in_file(self) -> str:
        """Name of the setup in the files; the three setups of a point have one name there."""
        return base_name(self.setup)

    @property
    def planned_approach(self) -> str | None:
        """Approach that the plan states; None if it states none."""
        return None if self.has_typed_approach else self.approach

    @property
    def emptied(self) -> RecordedReading:
        """Row without its reading and all that was typed with it; only the approach is planned."""
        planned = None if self.conditions is None else self.conditions.approach
        conditions = Conditions(planned) if planned and not self.has_typed_approach else None
        return replace(self, value=math.nan, conditions=conditions, has_typed_approach=False)

    def with_reading(self, value: float, stated: Conditions | None) -> RecordedReading:
        """Row with a reading, [m], and the conditions that are stated with it."""
        old, new = self.conditions or Conditions(), stated or Conditions()
        conditions = Conditions(
            new.approach or old.approach,
            old.temperature if new.temperature is None else new.temperature,
            new.time or old.time,
        )
        return replace(
            self,
            value=value,
            conditions=None if conditions == Conditions() else conditions,
            has_typed_approach=new.approach is not None,
        )


def change_rows(rows: Sequence[RecordedReading], change: Change) -> tuple[RecordedReading, ...]:
    """Rows after a change.

    Raises:
        SessionError: If a row to change does not exist, or a changed row equals another one.
    """
    indices = {row.key: i for i, row in enumerate(rows)}
    changed = list(rows)
    count = len(change.rows) // 2 if change.done == "added" else len(change.rows)
    keys, added = change.rows[:count], change.rows[count:]
    for key in keys:
        if key not in indices:
            raise SessionError(f"there is no row {' '.join(str(k) for k in key if k)}")
    selected = [indices[key] for key in keys]
    if change.done == "read":
        values = change.point_mm or [v for v in (change.reading_mm,) if v is not None]
        if len(values) != len(selected):
            raise SessionError("the reading is missing")
        for index, value in zip(selected, values, strict=True):
            changed[index] = rows[index].with_reading(value * MM, change.conditions)
    elif change.done == "emptied":
        setup = base_name(keys[0][0])
        changed = [r.emptied if r.setup_in_file == setup else r for r in changed]
    elif change.done == "dropped":
        changed = [row for i, row in enumerate(changed) if i not in selected]
    else:
        if len(added) != len(keys):
            raise SessionError("the added row is not named")
        line = 1 + max(r.line or 0 for r in rows)
        for setup, posture, minus, cycle, *approach in added:
            conditions = Conditions(approach[0]) if approach else None
            new = RecordedReading(setup, posture, minus, cycle, math.nan, conditions=conditions)
            changed.append(replace(new, line=line))
    number = Counter(row.key for row in changed)
    for row in changed:
        if number[row.key] > 1:
            raise SessionError(f"{row.label_with_cycle} exists already")
    return tuple(changed)


def _replay(
    changes: Iterable[Change],
) -> tuple[set[ReadingKey], dict[int, list[ReadingKey]]]:
    """Keys of the rows whose approach was typed, and keys without readings of deleted rows by line.

    Args:
        changes: All changes, the first one first.
    """
    typed: set[ReadingKey] = set()
    dropped: dict[int, list[ReadingKey]] = {}
    for change in changes:
        if change.done == "dropped" and change.line is not None:
            dropped[change.line] = [key[:4] if key in typed else key for key in change.rows]
        if change.done in ("read", "dropped"):
            typed.difference_update(change.rows)
        if change.done == "read" and change.conditions and change.conditions.approach:
            known = known_approach(change.conditions)
            places = [key[:4] for key in change.rows]
            typed.update(place if known is None else (*place, known) for place in places)
    return typed, dropped


def recorded_rows(
    readings: Sequence[Reading], changes: Iterable[Change]
) -> tuple[RecordedReading, ...]:
    """Rows of a session that is recorded.

    Args:
        readings: The readings as in the CSV.
        changes: All changes that the journal contains and the CSV has.
    """
    typed, _ = _replay(changes)
    return tuple(
        RecordedReading(
            *(r.setup, r.posture, r.minus, r.cycle, r.value, r.line, r.file, r.conditions),
            has_typed_approach=r.is_read and r.key in typed,
        )
        for r in readings
    )


def find_dropped(session: Session, changes: Iterable[Change]) -> dict[int, list[ReadingKey]]:
    """Keys of the deleted rows by line, unless their setup or posture was deleted since.

    Args:
        session: The session.
        changes: All changes that the journal contains.
    """
    _, dropped = _replay(changes)
    return {line: keys for line, keys in dropped.items() if not find_unknown(session, keys)}


def find_unknown(session: Session, keys: Iterable[ReadingKey]) -> str:
    """First setup or posture of rows that the session does not have; "" without any."""
    for setup, posture, minus, *_ in keys:
        if setup not in session.setups:
            return f"setup '{setup}'"
        for name in (posture, minus):
            if name is not None and name not in session.postures:
                return f"posture '{name}'"
    return ""


FORMAT = "orthocal/recording/1"

CLOSED: dict[str, Any] = {"closed": True}
"""Last line of a recording that ended regularly."""


class JournalLine(Change):
    """Line of a change."""

    at: str
    """Time of the change."""
    before: str
    """Digest of the CSV before the change."""
    after: str
    """Digest of the CSV after it."""


class NextConditions(Keys):
    """Line of the journal: conditions that were typed for the next readings."""

    model_config = ConfigDict(populate_by_name=True)

    temperature: Annotated[Number | None, Field(alias="temperature_C")] = None
    """Temperature, [°C]."""
    approach: str | None = None
    """Approach; see `Conditions`."""
    clock: bool | None = None
    """Whether the time of each reading is noted."""

    @property
    def stated(self) -> dict[str, Any]:
        """The stated conditions by their keys in the journal."""
        return self.model_dump(exclude_none=True, by_alias=True)


def read_lines(
    journal: Journal,
) -> tuple[list[JournalLine], list[tuple[str, JournalLine]], NextConditions]:
    """Content of a journal; a new one gets its header.

    Returns:
        Changes of the recordings that ended regularly, later changes with their places, and the
        conditions that were typed last.
    """
    following = NextConditions()
    closed: list[JournalLine] = []
    lines: list[tuple[str, JournalLine]] = []
    entries = journal.entries()
    first = next(entries, None)
    if first is None:
        journal.append({"format": FORMAT})
    elif (first[1] or {}).get("format") != FORMAT:
        raise OrthocalError(
            "is not the journal of a recording; move it away, and the readings count as they are",
            where=str(journal.path),
        )
    for where, data in entries:
        if data == CLOSED:
            closed += [line for _, line in lines]
            lines.clear()
            continue
        try:
            if data and "done" not in data:
                noted = validate(NextConditions, data, where=where, error=OrthocalError)
                following = NextConditions(**following.stated | noted.stated)
            else:
                line = validate(JournalLine, data, where=where, error=OrthocalError)
                lines.append((where, line))
        except OrthocalError:
            raise OrthocalError(
                "is not a line of a recording: the journal is damaged; move it away, and the "
                "readings count as they are",
                where=where,
            ) from None
    return closed, lines, following


def find_pending(
    lines: Sequence[tuple[str, JournalLine]], digest: str
) -> tuple[Sequence[tuple[str, JournalLine]], bool]:
    """Changes that the CSV does not contain yet, and whether the CSV was edited since.

    Args:
        lines: Places and lines of the journal.
        digest: Digest of the CSV.
    """
    if not lines or lines[-1][1].after == digest:
        return [], False
    for i in range(len(lines) - 1, -1, -1):
        if lines[i][1].before == digest:
            return lines[i:], False
    return [], True
