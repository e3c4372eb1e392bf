"""Lines in the journal of a recording.

Each change is a line with the digests of the CSV before and after it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import ConfigDict, Field

from orthocal.errors import OrthocalError
from orthocal.io.documents import Keys, Number, validate
from orthocal.io.journal import Journal
from orthocal.measurement.recorded_rows import Change

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


@dataclass(frozen=True, slots=True, eq=False)
class Past:
    """Content of a journal."""

    closed: list[JournalLine]
    """Changes of the recordings that ended regularly."""
    lines: list[tuple[str, JournalLine]]
    """Later changes with their places."""
    following: NextConditions
    """Conditions that were typed last."""


def read_lines(journal: Journal) -> Past:
    """Content of a journal; a new one gets its header."""
    following = NextConditions()
    closed: list[JournalLine] = []
    lines: list[tuple[str, JournalLine]] = []
    has_header = False
    for where, data in journal.entries():
        if not has_header and (data is None or data.get("format") != FORMAT):
            raise OrthocalError(
                "is not the journal of a recording; move it away, and the readings count as they "
                "are",
                where=str(journal.path),
            )
        if data == CLOSED:
            closed += [line for _, line in lines]
            lines.clear()
        elif has_header:
            try:
                if data and "done" not in data:
                    noted = validate(NextConditions, data, where=where, error=OrthocalError)
                    following = NextConditions(**following.stated | noted.stated)
                    continue
                line = validate(JournalLine, data, where=where, error=OrthocalError)
            except OrthocalError:
                raise OrthocalError(
                    "is not a line of a recording: the journal is damaged; move it away, and the "
                    "readings count as they are",
                    where=where,
                ) from None
            lines.append((where, line))
        has_header = True
    if not has_header:
        journal.append({"format": FORMAT})
    return Past(closed, lines, following)


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
