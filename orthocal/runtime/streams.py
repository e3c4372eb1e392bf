"""Standard streams: closed, on a full disk, without a reader, or without output for long."""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast

from orthocal.errors import OutputError
from orthocal.text import printable

STDERR = 2
"""File descriptor of the standard error."""

PATIENCE = 3.0
"""Time without output after which the line is printed, [s]."""


class ReaderGoneError(Exception):
    """Signal that the reader of the standard output has closed it, as `head` does; no error."""


class _Guarded:
    """Standard stream that raises orthocal's errors.

    Args:
        stream: The stream, or None if it was closed when the process started.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._is_open = stream is not None
        self._stream = open(os.devnull, "w", encoding="utf-8") if stream is None else stream
        self._failure: Exception | None = None
        """First failure; it is raised again if a library swallowed it."""

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - any attribute of a stream
        if name == "buffer":  # bytes would bypass this object
            raise AttributeError(name)
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text.

        Raises:
            ReaderGoneError: If the reader has closed the stream.
            OutputError: If the text cannot be written.
        """
        if text and not self._is_open:
            self._failure = _unwritable("it is closed")
        self._try(lambda stream: stream.write(text))
        return len(text)

    def flush(self) -> None:
        """Write buffered text.

        Raises:
            ReaderGoneError: If the reader has closed the stream.
            OutputError: If the text cannot be written.
        """
        self._try(lambda stream: stream.flush())

    def _try(self, act: Callable[[TextIO], object]) -> None:
        """Act on the stream; raise its first failure now and at all later calls."""
        try:
            if self._failure is None:
                act(self._stream)
        except BrokenPipeError:
            self._failure = ReaderGoneError()
        except OSError as e:
            self._failure = _unwritable(str(e.strerror))
        if self._failure is not None:
            self._abandon()
            raise self._failure

    def _abandon(self) -> None:
        """Discard buffered text, which Python would write at its exit."""
        with suppress(OSError, ValueError, io.UnsupportedOperation):
            null_device = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null_device, self._stream.fileno())
            os.close(null_device)


class _Silent(_Guarded):
    """Standard error. Failures are ignored, because they cannot be reported anywhere.

    Control characters are escaped, also in messages of libraries.
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

    Otherwise the next opened file would get the descriptor of a closed stream, and the output of
    C++ code.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free descriptor
    original = sys.stdout, sys.stderr
    for stream in original:  # a terminal without ± prints a question mark
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    sys.stdout = cast("TextIO", _Guarded(original[0]))
    sys.stderr = cast("TextIO", _Silent(original[1]))
    try:
        yield
    finally:
        sys.stdout, sys.stderr = original


@contextmanager
def announced_if_slow(text: str) -> Iterator[None]:
    """Print a line on the terminal of stderr if the block lasts longer than a few seconds.

    Nothing is printed into files and pipes. The timer of the process is used instead of a thread,
    because the block may fork.

    Args:
        text: The line.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not (hasattr(signal, "setitimer") and in_main_thread and os.isatty(STDERR)):
        yield
        return

    def announce(*_: object) -> None:
        with suppress(OSError):
            os.write(STDERR, f"{text}\n".encode(errors="replace"))

    previous = signal.signal(signal.SIGALRM, announce)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, previous)
