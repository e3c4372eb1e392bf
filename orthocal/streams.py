"""The standard streams of a process: closed, full, or with nobody who reads them any more."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

from orthocal.errors import OutputError


class ReaderGoneError(Exception):
    """Whoever read the standard output has had enough, as `head` has: no error of anybody."""


class _Guarded(io.TextIOBase):
    """A standard stream whose failures are told in words of this program.

    Args:
        stream: The stream, or None for one that was closed when the process began.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream

    @property
    def encoding(self) -> str:  # type: ignore[override] # a property there, too, but in C
        """Of the stream."""
        return "utf-8" if self._stream is None else self._stream.encoding

    def isatty(self) -> bool:
        """Whether it is a terminal."""
        return self._stream is not None and self._stream.isatty()

    def fileno(self) -> int:
        """Its descriptor."""
        if self._stream is None:
            raise io.UnsupportedOperation("fileno")
        return self._stream.fileno()

    def writable(self) -> bool:
        """It is written to."""
        return True

    def write(self, text: str) -> int:
        """Write a text.

        Raises:
            ReaderGoneError: If nobody reads it any more.
            OutputError: If it cannot be written.
        """
        if self._stream is None:
            return self._fail("it is closed", len(text))
        try:
            return self._stream.write(text)
        except BrokenPipeError:
            raise self._gone() from None
        except OSError as e:
            return self._fail(str(e.strerror), len(text))

    def flush(self) -> None:
        """Write what was kept so far; raises as `write` does."""
        if self._stream is None:
            return
        try:
            self._stream.flush()
        except BrokenPipeError:
            raise self._gone() from None
        except OSError as e:
            self._fail(str(e.strerror), 0)

    def _gone(self) -> ReaderGoneError:
        self._abandon()
        return ReaderGoneError()

    def _fail(self, reason: str, count: int) -> int:
        self._abandon()
        raise OutputError(f"cannot be written: {reason}", where="standard output")

    def _abandon(self) -> None:
        """Let what is still kept go nowhere: Python writes it when it ends."""
        with suppress(OSError, ValueError, io.UnsupportedOperation):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.fileno())
            os.close(nowhere)


class _Silent(_Guarded):
    """The same for the stream of errors: where that cannot be written nothing else can be told."""

    def _gone(self) -> ReaderGoneError:
        return ReaderGoneError()

    def _fail(self, reason: str, count: int) -> int:
        return count

    def write(self, text: str) -> int:
        """Write a text, if that can be."""
        try:
            return super().write(text)
        except ReaderGoneError:
            return len(text)

    def flush(self) -> None:
        """Write what was kept so far, if that can be."""
        with suppress(ReaderGoneError):
            super().flush()


@contextmanager
def guarded_streams() -> Iterator[None]:
    """Guard the standard streams of this process, and take a closed one's place.

    Else the next file that is opened would get its number, and whatever C++ code has to say.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
    before = sys.stdout, sys.stderr
    for stream in before:  # a terminal without ± prints a question mark
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    sys.stdout, sys.stderr = _Guarded(before[0]), _Silent(before[1])
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
