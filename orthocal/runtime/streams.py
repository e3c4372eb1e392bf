"""Standard streams that are closed, on a full disk, or without a reader."""

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
    """The reader of the standard output has closed it, as `head` does; this is not an error."""


class _Guarded(io.TextIOBase):
    """A standard stream that raises orthocal's errors.

    Args:
        stream: The stream, or None if it was closed when the process started.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream
        self._failure: Exception | None = None
        """First failure; it is raised again if a library swallowed it."""

    @property
    def encoding(self) -> str:  # type: ignore[override] # a property there, too, but in C
        """Encoding of the stream."""
        return "utf-8" if self._stream is None else self._stream.encoding

    @property
    def errors(self) -> str:  # type: ignore[override] # likewise
        """Error handler of the encoding."""
        return "strict" if self._stream is None else self._stream.errors or "strict"

    def isatty(self) -> bool:
        """True for a terminal."""
        return self._stream is not None and self._stream.isatty()

    def fileno(self) -> int:
        """Descriptor of the stream."""
        if self._stream is None:
            raise io.UnsupportedOperation("fileno")
        return self._stream.fileno()

    def writable(self) -> bool:
        """True."""
        return True

    def write(self, text: str) -> int:
        """Write a text.

        Raises:
            ReaderGoneError: If the reader has closed the stream.
            OutputError: If the text cannot be written.
        """
        if text and self._stream is None:
            self._failure = _unwritable("it is closed")
        self._try(lambda stream: stream.write(text))
        return len(text)

    def flush(self) -> None:
        """Write buffered text; raises as `write` does."""
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
        """Discard buffered text, which Python would write when it ends."""
        with suppress(OSError, ValueError, io.UnsupportedOperation):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.fileno())
            os.close(nowhere)


class _Silent(_Guarded):
    """Standard error: failures are ignored, because they cannot be reported anywhere.

    Control characters are escaped, whichever library writes them.
    """

    def write(self, text: str) -> int:
        """Write a text with escaped control characters."""
        super().write(printable(text, keep="\n\t"))
        return len(text)

    def _try(self, act: Callable[[TextIO], object]) -> None:
        with suppress(ReaderGoneError, OutputError):
            super()._try(act)


def _unwritable(reason: str) -> OutputError:
    return OutputError(f"cannot be written: {reason}", where="standard output")


@contextmanager
def guarded_streams() -> Iterator[None]:
    """Guard the standard streams of this process, and open the closed ones on the null device.

    Otherwise the next opened file would receive their descriptors, and the output of C++ code.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free descriptor
    original = sys.stdout, sys.stderr
    for stream in original:  # a terminal without ± prints a question mark
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    sys.stdout, sys.stderr = _Guarded(original[0]), _Silent(original[1])
    try:
        yield
    finally:
        sys.stdout, sys.stderr = original
