"""Limit of processor time, for tests of input that once took minutes or never ended."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator

SECONDS = 20.0
"""Far above what any such test takes, [s of processor time]."""


@contextlib.contextmanager
def cpu_limit(seconds: float = SECONDS) -> Iterator[None]:
    """Fail with TimeoutError when the block uses more processor time."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"more than {seconds:g} s of processor time")

    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)
