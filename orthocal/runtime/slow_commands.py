"""One line on a terminal while a command works for a long time without output."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

STDERR = 2
"""File descriptor."""

AFTER = 3.0
"""Time without output after which a line is printed, [s]."""


@contextmanager
def announced_if_slow(
    text: str, *, after: float = AFTER, descriptor: int = STDERR
) -> Iterator[None]:
    """Print a line on the terminal of stderr if the work takes longer than a few seconds.

    Files and pipes receive nothing. A timer of the process serves, not a thread: work may fork.

    Args:
        text: The line.
        after: Time after which it is printed, [s].
        descriptor: File descriptor of the terminal.
    """
    in_main = threading.current_thread() is threading.main_thread()
    if not (hasattr(signal, "setitimer") and in_main and os.isatty(descriptor)):
        yield
        return

    def announce(*_: object) -> None:
        with suppress(OSError):
            os.write(descriptor, f"{text}\n".encode(errors="replace"))

    before = signal.signal(signal.SIGALRM, announce)
    signal.setitimer(signal.ITIMER_REAL, after)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
