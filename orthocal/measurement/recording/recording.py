"""Readings as they are taken: rows in the order of measuring, each change on disk before it counts.

A change is appended to a journal beside the readings.csv first, and synced; then the CSV is written
anew, whole. Each line of the journal has the digests of the CSV before and after it. So whenever
the process is killed, or the power fails, the CSV is that of some change, and what the journal has
after it is done again. A recording that ends in order closes its journal: what is in the CSV then,
or is written into it by hand later, counts as it is.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from orthocal.errors import OrthocalError, OutputError, SessionError
from orthocal.io.documents import Number, read_yaml, validate
from orthocal.io.files import exists, read_file, sync_folder, write_file
from orthocal.io.journal import Journal, open_journal_file
from orthocal.measurement.files.readings_checks import check_range
from orthocal.measurement.files.schema import LARGEST_READING_MM, MOST_READINGS
from orthocal.measurement.files.session_file import load_rows
from orthocal.measurement.files.write_session import readings_table
from orthocal.runtime.interrupts import postponed_interrupt
from orthocal.session.session import Reading, Session
from orthocal.units import MM, to_mm

FORMAT = "orthocal/recording/1"

SUFFIX = ".journal"
"""Comes after the name of the CSV."""

LONGEST_LINE = 2**16
"""Of a journal, [bytes]: it names two rows at most."""

CLOSED: dict[str, Any] = {"closed": True}
"""Line of a recording that ended in order."""

DECIMALS = 9
"""Of a reading in mm: more than anybody types."""

BUSY = "these readings are being recorded by somebody else; one at a time"


@dataclass(frozen=True, slots=True)
class Row:
    """A reading to be taken, or taken."""

    setup: str
    posture: str
    minus: str | None
    cycle: int
    value: float | None
    """[m]; None while it is not there."""

    @property
    def key(self) -> tuple[str, str, str | None, int]:
        """What distinguishes it from all others."""
        return self.setup, self.posture, self.minus, self.cycle

    @property
    def place(self) -> tuple[str, str, str | None]:
        """What all cycles of it share."""
        return self.key[:3]

    @property
    def label(self) -> str:
        """Setup and postures in words, and the cycle where it is not the first."""
        minus = f" − {self.minus}" if self.minus else ""
        cycle = f", cycle {self.cycle}" if self.cycle != 1 else ""
        return f"{self.setup} {self.posture}{minus}{cycle}"


Key = tuple[str, str, str | None, Annotated[int, Field(ge=1, lt=10**9)]]


class Change(BaseModel):
    """Something that was done to the rows, as the journal keeps it."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    done: Literal["read", "emptied", "added", "dropped"]
    """A value was read for a row; all rows of its setup were emptied; one was put in after it; it
    was taken out."""
    rows: Annotated[list[Key], Field(min_length=1, max_length=2)]
    """Which; and the one that was added."""
    reading_mm: Annotated[Number, Field(ge=-LARGEST_READING_MM, le=LARGEST_READING_MM)] | None = (
        None
    )


class _Line(Change):
    at: str
    before: str
    after: str


def change_rows(rows: Sequence[Row], change: Change) -> tuple[Row, ...]:
    """Rows after a change.

    Raises:
        SessionError: If there is no such row, or there would be two of one.
    """
    places = {row.key: i for i, row in enumerate(rows)}
    found = list(rows)
    first, *others = change.rows
    if first not in places:
        raise SessionError(f"there is no row {' '.join(str(k) for k in first if k)}")
    at = places[first]
    if change.done == "read":
        if change.reading_mm is None:
            raise SessionError("no reading is given")
        found[at] = replace(found[at], value=change.reading_mm * MM)
    elif change.done == "emptied":
        found = [replace(r, value=None) if r.setup == first[0] else r for r in found]
    elif change.done == "dropped":
        del found[at]
    else:
        if len(others) != 1 or others[0] in places:
            raise SessionError("the row that is to be added is there already, or none")
        found.insert(at + 1, Row(*others[0], None))
    return tuple(found)


class Recording:
    """A session that is being measured; nobody else records it meanwhile.

    Args:
        session: The session, as it was when the recording began.
        rows: Its readings, in the order of measuring.
        journal: Where changes go first.
        digest: Of the CSV as it is on disk.
        redone: How many changes the CSV did not have yet, because a recording was killed.
        edited: Whether the CSV is none of those that the killed recording wrote.
    """

    def __init__(
        self,
        session: Session,
        rows: Sequence[Row],
        journal: Journal,
        *,
        digest: str,
        redone: int = 0,
        edited: bool = False,
    ) -> None:
        self.session = session
        self.rows = tuple(rows)
        self.redone = redone
        self.edited = edited
        self._journal = journal
        self._digest = digest

    @property
    def path(self) -> Path:
        """The readings.csv."""
        return _csv_of(self.session)

    @property
    def missing(self) -> tuple[int, ...]:
        """Rows without a reading."""
        return tuple(i for i, row in enumerate(self.rows) if row.value is None)

    def next_empty(self, skipped: frozenset[tuple[Any, ...]] = frozenset()) -> int | None:
        """The first row without a reading, but for those that are left out for now, by key."""
        return next((i for i in self.missing if self.rows[i].key not in skipped), None)

    def read(self, index: int, value: float) -> None:
        """Take a reading, or another one instead of it; on disk when this returns.

        Args:
            index: Of the row.
            value: [m].

        Raises:
            SessionError: If the gauge cannot show that.
            OutputError: If it cannot be written.
        """
        row = self.rows[index]
        gauge = self.session.gauges[self.session.setups[row.setup].gauge]
        check_range(to_mm(value), gauge, row.minus is not None, row.label)
        self._do(Change(done="read", rows=[row.key], reading_mm=round(to_mm(value), DECIMALS)))

    def repeat(self, index: int) -> int:
        """Put in another cycle of a row, right after it; its index.

        Raises:
            SessionError: If there are too many rows.
            OutputError: If it cannot be written.
        """
        row = self.rows[index]
        if len(self.rows) >= MOST_READINGS:
            raise SessionError(f"there are {MOST_READINGS} rows; no more are taken")
        # of differences none may follow from others of the same cycle: it gets one of its own
        others = [
            r.cycle
            for r in self.rows
            if r.place == row.place or (r.setup == row.setup and row.minus is not None)
        ]
        new = (*row.place, max(others) + 1)
        mixed = [r for r in self.rows if r.setup == row.setup and r.cycle == new[3]]
        if any((r.minus is None) != (row.minus is None) for r in mixed):
            new = (*row.place, max(r.cycle for r in self.rows if r.setup == row.setup) + 1)
        self._do(Change(done="added", rows=[row.key, new]))
        return index + 1

    def drop(self, index: int) -> None:
        """Take a row out.

        Raises:
            SessionError: If it is the only one.
            OutputError: If it cannot be written.
        """
        if len(self.rows) == 1:
            raise SessionError("it is the only row; a session has at least one")
        self._do(Change(done="dropped", rows=[self.rows[index].key]))

    def empty(self, index: int) -> None:
        """Throw away all readings of a row's setup, to be taken anew; the journal keeps them.

        Raises:
            OutputError: If it cannot be written.
        """
        self._do(Change(done="emptied", rows=[self.rows[index].key]))

    def close(self) -> None:
        """Say in the journal that the recording ended in order: the CSV counts from now on."""
        with suppress(OutputError):
            self._journal.append(CLOSED)

    def _do(self, change: Change) -> None:
        rows = change_rows(self.rows, change)
        content = _table(rows).encode()
        with postponed_interrupt():
            line = change.model_dump(mode="json", exclude_none=True) | {
                "rows": [list(key) for key in change.rows],
                "at": datetime.now(UTC).isoformat(timespec="seconds"),
                "before": self._digest,
                "after": _digest(content),
            }
            self._journal.append(line)
            _write(self.path, content)
            self.rows, self._digest = rows, _digest(content)


@contextmanager
def open_recording(path: str | Path) -> Iterator[Recording]:
    """A session to be measured, from where it was left; a plan without readings gets its rows.

    Args:
        path: The session.yaml, or the folder that holds it.

    Raises:
        SessionError: If it does not load.
        OrthocalError: If somebody else records it, or its journal is damaged.
        OutputError: If its folder cannot be written to.
    """
    session, unread = load_rows(path)
    csv = _csv_of(session)
    _find_names(session, unread)  # refused before anything is written
    with open_journal_file(
        csv.with_name(csv.name + SUFFIX), busy=BUSY, longest=LONGEST_LINE
    ) as journal:
        lines = _read_lines(journal)
        if _changed(session):  # before nobody else could any more
            session, unread = load_rows(path)
        for file, text in _find_names(session, unread).items():
            write_file(file, text)
        if session.readings_path is None:
            session, unread = load_rows(path)
        rows = _rows(session.readings, unread)
        content = read_file(csv, error=SessionError)
        done, edited = _done_since(lines, _digest(content))
        for where, change in done:
            try:
                rows = change_rows(rows, change)
            except SessionError as e:
                raise OrthocalError(f"does not fit {csv.name}: {e.problem}", where=where) from None
        if done:
            content = _table(rows).encode()
            _write(csv, content)
            session, _ = load_rows(path)
        found = Recording(
            session, rows, journal, digest=_digest(content), redone=len(done), edited=edited
        )
        try:
            yield found
        finally:
            found.close()


def _find_names(session: Session, unread: frozenset[int]) -> dict[Path, str | bytes]:
    """Files that make a plan a session: its rows, then the YAML that names them."""
    if session.readings_path is not None or session.path is None:
        return {}
    csv, rows = _csv_of(session), _table(_rows(session.readings, unread))
    return {csv: rows, session.path: _yaml_with_readings(session.path, csv, rows)}


def _yaml_with_readings(file: Path, csv: Path, text: str) -> bytes:
    """Content of a session.yaml with the key `readings` added; everything else stays as it is.

    Args:
        file: The session.yaml, which has no readings yet.
        csv: Path of the new readings.csv beside it.
        text: Content of the readings.csv.

    Raises:
        SessionError: If the readings.csv exists with other rows, or the key cannot be appended.
    """
    if exists(csv) and read_file(csv, error=SessionError) != text.encode():
        raise SessionError(
            f"holds other rows than {file.name} plans and would be overwritten; move it away, or "
            f"add `readings: {csv.name}` to {file.name}",
            where=str(csv),
        )
    content = read_file(file, error=SessionError)
    extended = content.rstrip() + f"\nreadings: {csv.name}\n".encode()
    expected = read_yaml(file, error=SessionError, content=content) | {"readings": csv.name}
    try:
        document = read_yaml(file, error=SessionError, content=extended)
    except SessionError:
        document = None
    if document != expected:
        raise SessionError(
            f"is missing; add `readings: {csv.name}` to it", where=f"{file}: readings"
        )
    return extended


def _changed(session: Session) -> bool:
    """Whether the files of a session are others than those that were loaded."""
    if session.path is None or session.readings_path is None:
        return True
    parts = (read_file(f, error=SessionError) for f in (session.path, session.readings_path))
    return _digest(b"\0".join(parts)) != session.sha256


def _write(csv: Path, content: bytes) -> None:
    write_file(csv, content)
    sync_folder(csv.parent)


def _csv_of(session: Session) -> Path:
    if session.readings_path is not None:
        return session.readings_path
    return (session.path or Path("session.yaml")).parent / "readings.csv"


def _rows(readings: Sequence[Reading], unread: frozenset[int]) -> tuple[Row, ...]:
    return tuple(
        Row(r.setup, r.posture, r.minus, r.cycle, None if i in unread else r.value)
        for i, r in enumerate(readings)
    )


def _table(rows: Sequence[Row]) -> str:
    plain = [Reading(r.setup, r.posture, r.minus, r.cycle, 0.0, None) for r in rows]
    return readings_table(plain, [r.value for r in rows], decimals=DECIMALS)


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


Done = tuple[str, Change]


def _read_lines(journal: Journal) -> list[tuple[str, _Line]]:
    """What was done since a recording ended in order; a new journal gets its beginning."""
    found: list[tuple[str, _Line]] = []
    head = False
    for where, data in journal.entries():
        if not head and (data is None or data.get("format") != FORMAT):
            raise OrthocalError(
                "is no recording's journal; move it away, and the readings count as they are",
                where=str(journal.path),
            )
        if data == CLOSED:
            found.clear()
        elif head:
            try:
                line = validate(_Line, data, where=where, error=OrthocalError)
            except OrthocalError:
                raise OrthocalError(
                    "is no line of a recording: it is damaged; move the file away, and the "
                    "readings count as they are",
                    where=where,
                ) from None
            found.append((where, line))
        head = True
    if not head:
        journal.append({"format": FORMAT})
    return found


def _done_since(lines: Sequence[tuple[str, _Line]], digest: str) -> tuple[list[Done], bool]:
    """What was done after the CSV was written, and whether that was edited by hand since.

    Args:
        lines: Of the journal.
        digest: Of the CSV.
    """
    if not lines or lines[-1][1].after == digest:
        return [], False
    for i in range(len(lines) - 1, -1, -1):
        if lines[i][1].before == digest:
            return [(where, line) for where, line in lines[i:]], False
    return [], True
