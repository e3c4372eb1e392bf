"""Recording of readings: rows in the order of the sheet, each change on disk before it counts.

A row keeps its line in the CSV: added rows come last, and a blank line remains where a row was
deleted.

A change is appended to a journal beside the readings.csv and synced; then the CSV is replaced. Each
line of the journal holds the digests of the CSV before and after its change. If the process is
killed or the power fails, the CSV contains the changes up to some line of the journal. The later
changes are applied again. A recording that ends regularly closes its journal: from then on the CSV
counts, edited or not.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from orthocal.arrays import Array
from orthocal.errors import OrthocalError, OutputError, SessionError, errors_at
from orthocal.io.files import exists, read_file, sync_folder, write_file
from orthocal.io.journal import Journal, open_journal_file
from orthocal.measurement.files.point_rows import find_point, locate_stations, point_of
from orthocal.measurement.files.readings_checks import check_conditions, check_range
from orthocal.measurement.files.readings_file import FIRST_LINE
from orthocal.measurement.files.session_file import load_plan, session_digest
from orthocal.measurement.files.session_keys import MOST_READINGS
from orthocal.measurement.files.write_session import add_alignment, add_readings, readings_table
from orthocal.measurement.motion.motion import state_possible_path_approaches
from orthocal.measurement.recorded_rows import (
    CLOSED,
    Change,
    NextConditions,
    RecordedReading,
    change_rows,
    find_dropped,
    find_pending,
    find_unknown,
    read_lines,
    recorded_rows,
)
from orthocal.runtime.interrupts import postponed_interrupt
from orthocal.sensors.protocol import largest_reading
from orthocal.session.order import order_of_measurement
from orthocal.session.points import base_name, gather_points
from orthocal.session.session import Conditions, Reading, ReadingKey, Session
from orthocal.units import MM, to_mm

SUFFIX = ".journal"
"""Suffix of the journal, after the name of the CSV."""

LONGEST_LINE = 2**16
"""Largest length of a line of the journal, [bytes]: a line names six rows at most."""

DECIMALS = 9
"""Decimals of a recorded reading in mm."""

BUSY = "these readings are being recorded by another process; one at a time"


@dataclass(slots=True, eq=False)
class Recording:
    """Session that is being measured, locked against other recordings."""

    session: Session
    """The session; its readings are those at the start of the recording."""
    rows: tuple[RecordedReading, ...]
    """Rows in the order of measurement; NaN before they are read."""
    journal: Journal
    """Journal of the changes."""
    digest: str
    """Digest of the CSV on disk."""
    dropped: dict[int, list[ReadingKey]]
    """Keys of the rows that earlier recordings deleted, by their line."""
    following: NextConditions
    """Conditions of the next readings that were typed last, also in earlier recordings."""
    restored: int
    """Number of changes that a killed recording had not written to the CSV."""
    edited: bool
    """Whether the CSV differs from all versions that the killed recording wrote."""
    wrong: Sequence[SessionError]
    """Errors of readings out of range in the CSV, which count as missing."""

    @property
    def path(self) -> Path:
        """Path of the readings.csv."""
        return _csv_of(self.session)

    @property
    def missing(self) -> tuple[int, ...]:
        """Indices of the rows without a reading."""
        return tuple(i for i, row in enumerate(self.rows) if not row.is_read)

    @property
    def count(self) -> int:
        """Number of lines, each with a reading or a point."""
        return len({row.line for row in self.rows})

    @property
    def missing_count(self) -> int:
        """Number of lines without a reading."""
        return len({self.rows[i].line for i in self.missing})

    def measured(self, *, without: Collection[int] = ()) -> Session:
        """Session with the rows that were read; alignment postures remain the planned ones.

        Points without excluded rows locate their station. If they do not determine it, all do.

        Args:
            without: Indices of rows to exclude.
        """
        session = replace(self.session, readings=self.rows, sha256="")
        session = locate_stations(session, partial=True)
        read = [row for i, row in enumerate(self.rows) if row.is_read and i not in without]
        if len(read) < len(self.rows):
            session = session.select(read)
        return locate_stations(session, partial=True) if without else session

    def measured_coordinate(
        self, index: int, *, without: Collection[int] = ()
    ) -> tuple[Session, int]:
        """Session as by `measured` in which a row is the only one of its point.

        The other points locate the station, if they determine it.

        Args:
            index: Index of the row.
            without: Indices of rows to exclude.

        Returns:
            The session, and the index of the row in it.
        """
        session = self.measured(without=without)
        point = self.point(index)
        if len(point) > 1:
            excluded = {*without, *point} - {index}
            read = [r for i, r in enumerate(self.rows) if r.is_read and i not in excluded]
            session = locate_stations(session.select(read), partial=True)
        return session, session.readings.index(self.rows[index])

    @property
    def is_located(self) -> bool:
        """True if the points read up to now determine their stations."""
        read = [row for row in self.rows if row.is_read]
        try:
            locate_stations(replace(self.session, readings=tuple(read)))
        except SessionError:
            return False
        return True

    def point(self, index: int) -> list[int]:
        """Indices of the rows that are read together with a row: the three of a point, or one."""
        return find_point(self.rows, index)

    def next_empty(self, skipped: frozenset[ReadingKey] = frozenset()) -> int | None:
        """Index of the next row without a reading, except those that are skipped.

        Added rows are read with their setup, before its closing reading.
        """
        empty = {i for i in self.missing if self.rows[i].key not in skipped}
        order = order_of_measurement([row.emptied for row in self.rows])
        return next((i for i in order if i in empty), None)

    def value(self, index: int) -> float | Array:
        """Reading of a row, [m], or coordinates of its point in its station, shape (3,), [m]."""
        rows = [self.rows[i] for i in self.point(index)]
        return rows[0].value if len(rows) == 1 else point_of(rows, self.session.setups)

    def largest_reading(self, index: int) -> float:
        """Size that no reading of a row exceeds, [m]: twice the range of the gauge if stated."""
        setup = self.session.setups[self.rows[index].setup]
        range_ = self.session.gauges[setup.gauge].range
        largest = largest_reading(setup.sensor)
        return largest if range_ is None else min(largest, 2.0 * max(map(abs, range_)))

    def read(self, index: int, value: float | Array, conditions: Conditions | None = None) -> None:
        """Record a reading or a point; it is on disk when this returns.

        Args:
            index: Index of the row.
            value: Reading, [m], or coordinates of a point in its station, shape (3,), [m].
            conditions: Conditions of the reading; those that are None do not change.

        Raises:
            SessionError: If the reading is NaN or beyond the range of the gauge, if the row cannot
                have the conditions, or if the plan states another approach.
            OutputError: If the files cannot be written.
        """
        rows = [self.rows[i] for i in self.point(index)]
        if np.isnan(value).any():
            where = rows[0].label_with_cycle
            raise SessionError("reading_mm is nan; expected a number", where=where)
        conditions = conditions or Conditions()
        readings_mm = []
        for row in rows:
            setup = self.session.setups[row.setup]
            along = getattr(setup.sensor, "along", None)
            reading = to_mm(float(value if along is None else np.dot(along, value)))
            of_setup_mm = [r.value / MM for r in self.rows if r.setup == row.setup and r.is_read]
            with errors_at(row.label_with_cycle):
                gauge = self.session.gauges[setup.gauge]
                check_range(reading, setup, gauge, minus=row.minus, of_setup_mm=of_setup_mm)
                two_postures = row.minus is not None
                check_conditions(conditions, self.session.robot, two_postures=two_postures)
            readings_mm.append(round(reading, DECIMALS))
        stated = _conditions_to_state(rows[0], conditions)
        keys: list[ReadingKey] = [row.key for row in rows]
        values = {"point_mm": readings_mm} if len(rows) > 1 else {"reading_mm": readings_mm[0]}
        self._apply(Change(done="read", rows=keys, conditions=stated, **values))

    def repeat(self, index: int) -> int:
        """Append a row that repeats a row in another cycle, and return its index.

        A repeated difference must not follow from other differences of its cycle. A cycle must not
        contain both readings and differences. In both cases the row gets a new cycle.

        Raises:
            SessionError: If there are too many rows.
            OutputError: If the files cannot be written.
        """
        row = self.rows[index]
        if len(self.rows) >= MOST_READINGS:
            raise SessionError(f"there are {MOST_READINGS} rows already, the largest number")
        same_setup = [r for r in self.rows if r.setup_in_file == row.setup_in_file]
        difference = self.session.is_difference(row)
        cycle = 1 + max(r.cycle for r in same_setup if difference or _has_same_cycles(row, r))
        in_cycle = [r for r in same_setup if r.cycle == cycle]
        if any(self.session.is_difference(r) != difference for r in in_cycle):
            cycle = 1 + max(r.cycle for r in same_setup)
        rows = [self.rows[i] for i in self.point(index)]
        added = [replace(r.emptied, cycle=cycle).key for r in rows]
        self._apply(Change(done="added", rows=[*(r.key for r in rows), *added]))
        return len(self.rows) - len(added)

    def drop(self, index: int) -> dict[str, str]:
        """Delete a row, or the three rows of a point; alignment postures do not change.

        Returns:
            Alignment postures by setup that the session.yaml states from now on, because the
            remaining rows imply others.

        Raises:
            SessionError: If no other row remains, or a posture cannot be stated.
            OutputError: If the files cannot be written.
        """
        rows = self.point(index)
        if len(self.rows) == len(rows):
            raise SessionError("it is the only row; a session has at least one")
        line, keys = self.rows[index].line, [self.rows[i].key for i in rows]
        emptied = [self.rows[i].emptied.key for i in rows]
        change = Change(done="dropped", rows=keys, line=line)
        stated = self._state_alignment(change_rows(self.rows, change))
        self._apply(change)
        if line is not None:
            self.dropped[line] = emptied
        return stated

    def is_deleted(self, line: int) -> bool:
        """True for the line of a row that was deleted and not added again."""
        return line in self.dropped and self.present_line(line) is None

    def present_line(self, line: int) -> int | None:
        """Line of a deleted row since it was added again; None for other rows."""
        keys = self.dropped.get(line, [])
        return next((r.line for r in self.rows if r.emptied.key in keys), None)

    def _state_alignment(self, remaining: Sequence[Reading]) -> dict[str, str]:
        """State the alignment postures in the session.yaml that the remaining rows would change."""
        session = self.session
        implied = replace(session, readings=tuple(remaining)).alignment_postures
        changed = {n: p for n, p in session.alignment_postures.items() if p != implied[n]}
        stated = {base_name(name): posture for name, posture in changed.items()}
        if stated and session.path is not None:
            write_file(session.path, add_alignment(session.path, stated))
        aligned = {n: replace(session.setups[n], aligned_at=p) for n, p in changed.items()}
        self.session = replace(session, setups={**session.setups, **aligned})
        return stated

    def restore(self, line: int) -> int:
        """Append a deleted row, or the three rows of a point, without readings.

        Args:
            line: Line of the row before it was deleted; see `is_deleted`.

        Returns:
            Index of the first appended row.

        Raises:
            OutputError: If the files cannot be written.
        """
        dropped = self.dropped[line]
        existing = [self.rows[0].key] * len(dropped)  # fewer rows may remain than a point has
        self._apply(Change(done="added", rows=[*existing, *dropped]))
        return len(self.rows) - len(dropped)

    def note(self, conditions: NextConditions) -> None:
        """Keep stated conditions of the next readings, also for the next recording.

        Raises:
            OutputError: If the journal cannot be written.
        """
        self.journal.append(conditions.stated)
        self.following = NextConditions(**self.following.stated | conditions.stated)

    def empty(self, index: int) -> None:
        """Delete all readings of a row's setup, with all that was typed; the journal has them.

        Raises:
            OutputError: If the files cannot be written.
        """
        self._apply(Change(done="emptied", rows=[self.rows[index].key]))

    def close(self) -> None:
        """Close the journal: from now on the CSV counts."""
        with suppress(OutputError):
            self.journal.append(CLOSED)

    def _apply(self, change: Change) -> None:
        """Change the rows: first in the journal, then in the CSV, then in memory."""
        rows = change_rows(self.rows, change)
        content = _table(rows, self.session)
        digest = _digest(content)
        with postponed_interrupt():
            line = change.model_dump(mode="json", exclude_none=True, by_alias=True) | {
                "rows": [list(key) for key in change.rows],
                "at": datetime.now(UTC).isoformat(timespec="seconds"),
                "before": self.digest,
                "after": digest,
            }
            self.journal.append(line)
            _write(self.path, content)
            self.rows, self.digest = rows, digest


def _conditions_to_state(row: RecordedReading, conditions: Conditions) -> Conditions | None:
    """Conditions to state with a reading: an approach always unless it is planned.

    Args:
        row: Row of the reading, or the first row of a point.
        conditions: Conditions of the reading; those that are None do not change.

    Raises:
        SessionError: If the plan states another approach.
    """
    approach = None
    if row.planned_approach is None:
        typed = row.conditions.approach if row.conditions and row.has_typed_approach else None
        approach = conditions.approach or typed
    elif conditions.approach not in (None, row.planned_approach):
        raise SessionError(
            f"the plan states the approach {row.planned_approach}; expected no other one",
            where=row.label_with_cycle,
        )
    stated = replace(conditions, approach=approach)
    return None if stated == Conditions() else stated


def _has_same_cycles(row: RecordedReading, other: RecordedReading) -> bool:
    """True if the cycles of another row and of repetitions of a row are counted together.

    Both belong to the same postures. The approach of the repetitions may be typed later.
    """
    same_side = row.planned_approach in (None, other.approach)
    return (row.posture, row.minus) == (other.posture, other.minus) and same_side


@contextmanager
def open_recording(path: str | Path) -> Iterator[Recording]:
    """Open a session for recording; a plan without a readings.csv gets one.

    Readings out of range count as missing, so that they can be read again.

    Args:
        path: The session.yaml, or its directory.

    Raises:
        SessionError: If the session does not load.
        OrthocalError: If another process records the session, or its journal is damaged.
        OutputError: If its directory is not writable.
    """
    wrong: list[SessionError] = []
    session = load_plan(path, wrong=wrong)
    csv = _csv_of(session)
    _files_to_add(session)  # refused before anything is written
    with open_journal_file(
        csv.with_name(csv.name + SUFFIX), busy=BUSY, longest=LONGEST_LINE
    ) as journal:
        closed, lines, following = read_lines(journal)
        if _is_outdated(session):  # another process may have written before the lock
            session = load_plan(path, wrong=wrong)
        for file, content in _files_to_add(session).items():
            write_file(file, content)
        if session.readings_path is None:
            session = load_plan(path, wrong=wrong)
        table = read_file(csv, error=SessionError)
        pending, edited = find_pending(lines, _digest(table))
        present = [change for _, change in lines[: len(lines) - len(pending)]]
        rows = recorded_rows(session.readings, [*closed, *present])
        for where, change in pending:
            try:
                rows = change_rows(rows, change)
            except SessionError as e:
                raise OrthocalError(f"does not fit {csv.name}: {e.problem}", where=where) from None
            if unknown := find_unknown(session, change.rows):
                raise OrthocalError(f"does not fit the session: it has no {unknown}", where=where)
        if pending:
            table = _table(rows, session)
            _write(csv, table)
            session = load_plan(path, wrong=wrong)
        recording = Recording(
            session,
            rows,
            journal,
            _digest(table),
            find_dropped(session, [*closed, *(change for _, change in lines)]),
            following,
            len(pending),
            edited,
            wrong,
        )
        try:
            yield recording
        finally:
            recording.close()


def _files_to_add(session: Session) -> dict[Path, bytes]:
    """Files that turn a plan into a session: readings.csv, then session.yaml, which names it.

    Raises:
        SessionError: If the readings.csv has other rows, or the session.yaml cannot name it.
    """
    if session.readings_path is not None or session.path is None:
        return {}
    file, csv = session.path, _csv_of(session)
    # as programs approach them: not asked for
    table = _table(state_possible_path_approaches(session).readings, session)
    if exists(csv) and read_file(csv, error=SessionError) != table:
        raise SessionError(
            f"holds other rows than {file.name} plans and would be overwritten; move it away, or "
            f"add `readings: {csv.name}` to {file.name}",
            where=str(csv),
        )
    return {csv: table, file: add_readings(file, csv.name)}


def _is_outdated(session: Session) -> bool:
    """True if the files of a session changed since they were loaded."""
    if session.path is None or session.readings_path is None:
        return True
    keys, table = (read_file(f, error=SessionError) for f in (session.path, session.readings_path))
    return session_digest(keys, table, session.compensation) != session.sha256


def _write(csv: Path, content: bytes) -> None:
    write_file(csv, content)
    sync_folder(csv.parent)


def _csv_of(session: Session) -> Path:
    if session.readings_path is not None:
        return session.readings_path
    return (session.path or Path("session.yaml")).parent / "readings.csv"


def _table(rows: Sequence[Reading], session: Session) -> bytes:
    """Content of the readings.csv; blank lines keep every row in its line.

    Rows of a new plan have no line yet and follow each other.
    """
    table = readings_table(rows, session.setups, decimals=DECIMALS)
    header, *texts = table.splitlines(keepends=True)
    lines = [header]
    first_rows = [group[0] for group in gather_points(rows, session.setups)]
    for row, text in zip(first_rows, texts, strict=True):
        lines += ["\n"] * ((row.line or 0) - FIRST_LINE + 1 - len(lines))
        lines.append(text)
    return "".join(lines).encode()


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
