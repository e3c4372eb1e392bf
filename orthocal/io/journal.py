"""Append-only journals of JSON lines for one process at a time.

A line is synced to disk before `append` returns. If a process is killed, at most one line is
incomplete, and the next process removes it.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from orthocal.errors import OrthocalError, OutputError
from orthocal.io.files import require_writable_file, sync_folder

LONGEST_LINE = 2**26
"""Largest length of a line, [bytes]."""


class Journal:
    """Journal in an open and locked file.

    Args:
        path: The file.
        descriptor: Its descriptor, open for reading and appending.
        longest: Largest length of a line, [bytes].
    """

    def __init__(self, path: Path, descriptor: int, *, longest: int = LONGEST_LINE) -> None:
        self.path = path
        self._descriptor = descriptor
        self._longest = longest

    def entries(self) -> Iterator[tuple[str, dict[str, Any] | None]]:
        """Place and object of each line; None for a line that is not an object.

        Read all entries before the first `append`: reading to the end removes an incomplete line.

        Raises:
            OutputError: If an incomplete line cannot be removed.
        """
        end, number = 0, 0
        with os.fdopen(os.dup(self._descriptor), "rb") as stream:
            stream.seek(0)
            while line := stream.readline(self._longest):
                number += 1
                if not line.endswith(b"\n"):
                    if len(line) >= self._longest:
                        yield f"{self.path}:{number}", None
                    break
                yield f"{self.path}:{number}", _parse(line)
                end = stream.tell()
        try:
            os.ftruncate(self._descriptor, end)
        except OSError as e:
            raise OutputError(f"cannot be written: {e.strerror}", where=str(self.path)) from None

    def append(self, entry: Mapping[str, Any]) -> None:
        """Append a line and sync it to disk; nothing is appended if it cannot be written.

        Raises:
            OutputError: If the line cannot be written.
        """
        data = (json.dumps(entry, allow_nan=False) + "\n").encode()
        end = os.fstat(self._descriptor).st_size
        try:
            while data:
                data = data[os.write(self._descriptor, data) :]
            os.fsync(self._descriptor)
        except OSError as e:
            with suppress(OSError):  # the next line would continue an incomplete one
                os.ftruncate(self._descriptor, end)
            raise OutputError(f"cannot be written: {e.strerror}", where=str(self.path)) from None


@contextmanager
def open_journal_file(
    path: Path, *, busy: str, discard: bool = False, longest: int = LONGEST_LINE
) -> Iterator[Journal]:
    """Open and lock a journal; the file is created if necessary.

    Args:
        path: The file.
        busy: Message if another process has locked the file.
        discard: Whether to discard the content of the file.
        longest: Largest length of a line, [bytes].

    Raises:
        OrthocalError: If another process has locked the file, or the path is invalid.
        OutputError: If the file cannot be written.
    """
    require_writable_file(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        created = not path.exists()
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
    except OSError as e:
        raise OutputError(f"cannot be written: {e.strerror}", where=str(path)) from None
    try:
        _lock(descriptor, path, busy)
        if discard:
            os.ftruncate(descriptor, 0)
        if created:
            sync_folder(path.parent)
        yield Journal(path, descriptor, longest=longest)
    finally:
        os.close(descriptor)


def _lock(descriptor: int, path: Path, busy: str) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        raise OrthocalError(busy, where=str(path)) from None


def _parse(line: bytes) -> dict[str, Any] | None:
    try:
        data = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return data if isinstance(data, dict) else None
