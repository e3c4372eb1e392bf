"""What a study has found so far, on disk: a line a task, each written before it counts.

The first line says which study it is.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from orthocal.errors import OrthocalError
from orthocal.io.journal import Journal, open_journal_file
from orthocal.study.study import Cell, Study

FORMAT = "orthocal/study/1"

Found = dict[int, dict[str, list[Cell]]]


class StudyJournal:
    """Results of a study's tasks, by their numbers."""

    def __init__(self, found: Found, journal: Journal | None = None) -> None:
        self.found = found
        self._journal = journal

    def add(self, task: int, columns: dict[str, list[Cell]]) -> None:
        """Keep the rows of a task; on disk when this returns.

        Raises:
            OutputError: If they cannot be written.
        """
        if self._journal is not None:
            self._journal.append({"task": task, "columns": columns})
        self.found[task] = columns


@contextmanager
def open_journal(path: Path | None, study: Study, *, anew: bool = False) -> Iterator[StudyJournal]:
    """The journal of a study: what is there of it, and room for more.

    Args:
        path: The file; None for one that is not kept.
        study: The study.
        anew: Whether to throw away what is there.

    Raises:
        OrthocalError: If the file is of another study, or is damaged, or another process has it.
        OutputError: If it cannot be written.
    """
    if path is None:
        yield StudyJournal({})
        return
    busy = "is being written by another process; wait for it, or name another folder"
    with open_journal_file(path, busy=busy, anew=anew) as journal:
        yield StudyJournal(_resume(journal, study), journal)


def _resume(journal: Journal, study: Study) -> Found:
    """What is there; the beginning of the file where nothing is."""
    found: Found = {}
    head = False
    for where, data in journal.entries():
        if data is None:
            raise OrthocalError(
                "is no line of a study: it is damaged, or another file; --force begins anew",
                where=where,
            )
        if not head:
            _require_same(data, study, journal.path)
            head = True
        else:
            task, columns = _entry(data, study, where)
            found[task] = columns
    if not head:
        journal.append({"format": FORMAT, "study": study.document, "digest": study.digest})
    return found


def _require_same(data: dict[str, Any], study: Study, path: Path) -> None:
    if data.get("digest") == study.digest and data.get("format") == FORMAT:
        return
    there = data.get("study")
    if not isinstance(there, dict) or "kind" not in there:
        raise OrthocalError("is no study's; --force writes over it", where=str(path))
    own = study.document
    other = sorted(k for k in {*there, *own} if there.get(k) != own.get(k))
    raise OrthocalError(
        f"is of another study, which differs in {', '.join(other) or 'its format'}; name another "
        "folder, or --force begins anew",
        where=str(path),
    )


def _entry(data: dict[str, Any], study: Study, where: str) -> tuple[int, dict[str, list[Cell]]]:
    task, columns = data.get("task"), data.get("columns")
    if isinstance(task, int) and 0 <= task < len(study.task_sizes) and isinstance(columns, dict):
        cells = list(columns.values())
        if cells and all(isinstance(c, list) and len(c) == len(cells[0]) for c in cells):
            return task, columns
    raise OrthocalError("is damaged; --force begins anew", where=where)
