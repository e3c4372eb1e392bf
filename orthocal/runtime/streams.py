"""The standard streams of a process: closed, full, or with nobody who reads them any more."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

from orthocal.errors import OutputError
from orthocal.text import printable


class ReaderGoneError(Exception):
    """Whoever read the standard output has had enough, as `head` has: no error of anybody."""


class _Guarded(io.TextIOBase):
    """A standard stream whose failures are told in words of this program.

    Args:
        stream: The stream, or None for one that was closed when the process began.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream
        self._failure: Exception | None = None
        """What went wrong first: it stays so, though somebody on the way may have swallowed it."""

    @property
    def encoding(self) -> str:  # type: ignore[override] # a property there, too, but in C
        """Of the stream."""
        return "utf-8" if self._stream is None else self._stream.encoding

    @property
    def errors(self) -> str:  # type: ignore[override] # likewise
        """What it does with characters that it does not have."""
        return "strict" if self._stream is None else self._stream.errors or "strict"

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
        if text and self._stream is None:
            self._failure = _unwritable("it is closed")
        self._try(lambda stream: stream.write(text))
        return len(text)

    def flush(self) -> None:
        """Write what was kept so far; raises as `write` does."""
        self._try(lambda stream: stream.flush())

    def _try(self, act: Callable[[TextIO], object]) -> None:
        try:
            if self._failure is None and self._stream is not None:
                act(self._stream)
        except BrokenPipeError:
            self._failure = ReaderGoneError()
        except OSError as e:
            self._failure = _unwritable(str(e.strerror))
        if self._failure is not None:
            self._abandon()
            raise self._failure

    def _abandon(self) -> None:
        """Let what is still kept go nowhere: Python writes it when it ends."""
        with suppress(OSError, ValueError, io.UnsupportedOperation):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.fileno())
            os.close(nowhere)


class _Silent(_Guarded):
    """The same for the stream of errors: where that cannot be written nothing else can be told.

    Whatever is written to it, by whichever library, steers no terminal.
    """

    def write(self, text: str) -> int:
        """Write a text, its control characters as escapes."""
        super().write(printable(text, keep="\n\t"))
        return len(text)

    def _try(self, act: Callable[[TextIO], object]) -> None:
        with suppress(ReaderGoneError, OutputError):
            super()._try(act)


def _unwritable(reason: str) -> OutputError:
    return OutputError(f"cannot be written: {reason}", where="standard output")


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
