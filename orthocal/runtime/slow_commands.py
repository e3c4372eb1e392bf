"""Line on a terminal if a command works for a long time without output."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

STDERR = 2
"""File descriptor of the standard error."""

PATIENCE = 3.0
"""Time without output after which the line is printed, [s]."""


@contextmanager
def announced_if_slow(
    text: str, *, after: float = PATIENCE, descriptor: int = STDERR
) -> Iterator[None]:
    """Print a line on the terminal of stderr if the block lasts longer than a few seconds.

    Nothing is printed into files and pipes. The timer of the process is used instead of a thread,
    because the block may fork.

    Args:
        text: The line.
        after: Time after which the line is printed, [s].
        descriptor: File descriptor of the terminal.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not (hasattr(signal, "setitimer") and in_main_thread and os.isatty(descriptor)):
        yield
        return

    def announce(*_: object) -> None:
        with suppress(OSError):
            os.write(descriptor, f"{text}\n".encode(errors="replace"))

    previous = signal.signal(signal.SIGALRM, announce)
    signal.setitimer(signal.ITIMER_REAL, after)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, previous)
