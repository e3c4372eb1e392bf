"""What a study has found so far, on disk: a line a task, each written before it counts.

The first line says which study it is. A process that is killed leaves at most a line without an
end, which the next one takes away; what was found before stays.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from orthocal.errors import OrthocalError, OutputError
from orthocal.files import require_writable_file
from orthocal.study.study import Cell, Study

FORMAT = "orthocal/study/1"

LONGEST_LINE = 2**26
"""[bytes]"""

Found = dict[int, dict[str, list[Cell]]]


class Journal:
    """Results of a study's tasks, by their numbers."""

    def __init__(self, found: Found, descriptor: int | None = None) -> None:
        self.found = found
        self._descriptor = descriptor

    def add(self, task: int, columns: dict[str, list[Cell]]) -> None:
        """Keep the rows of a task; on disk when this returns.

        Raises:
            OutputError: If they cannot be written.
        """
        if self._descriptor is not None:
            line = json.dumps({"task": task, "columns": columns}, allow_nan=False) + "\n"
            _append(self._descriptor, line.encode())
        self.found[task] = columns


@contextmanager
def open_journal(path: Path | None, study: Study, *, anew: bool = False) -> Iterator[Journal]:
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
        yield Journal({})
        return
    require_writable_file(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_CLOEXEC", 0)
        descriptor = os.open(path, flags, 0o666)
    except OSError as e:
        raise OutputError(f"cannot be written: {e.strerror}", where=str(path)) from None
    try:
        _lock(descriptor, path)
        if anew:
            os.ftruncate(descriptor, 0)
        yield Journal(_resume(descriptor, path, study), descriptor)
    finally:
        os.close(descriptor)


def _lock(descriptor: int, path: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        raise OrthocalError(
            "is being written by another process; wait for it, or name another folder",
            where=str(path),
        ) from None


def _resume(descriptor: int, path: Path, study: Study) -> Found:
    """What is there; the beginning of the file where nothing is, its torn end taken away."""
    found: Found = {}
    head, end = False, 0
    with os.fdopen(os.dup(descriptor), "rb") as stream:
        stream.seek(0)
        number = 0
        while line := stream.readline(LONGEST_LINE):
            number += 1
            if not line.endswith(b"\n"):
                break
            data = _parse(line, f"{path}:{number}")
            if not head:
                _require_same(data, study, path)
                head = True
            else:
                task, columns = _entry(data, study, f"{path}:{number}")
                found[task] = columns
            end = stream.tell()
    try:
        os.ftruncate(descriptor, end)
    except OSError as e:
        raise OutputError(f"cannot be written: {e.strerror}", where=str(path)) from None
    if not head:
        first = {"format": FORMAT, "study": study.document, "digest": study.digest}
        _append(descriptor, (json.dumps(first, allow_nan=False) + "\n").encode())
    return found


def _parse(line: bytes, where: str) -> dict[str, Any]:
    try:
        data = json.loads(line)
    except (ValueError, RecursionError):
        data = None
    if not isinstance(data, dict):
        raise OrthocalError(
            "is no line of a study: it is damaged, or another file; --force begins anew",
            where=where,
        )
    return data


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


def _append(descriptor: int, data: bytes) -> None:
    try:
        while data:
            data = data[os.write(descriptor, data) :]
        os.fsync(descriptor)
    except OSError as e:
        raise OutputError(f"cannot be written: {e.strerror}", where="the study's journal") from None
