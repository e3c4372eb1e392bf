"""Ctrl-C where Python alone would not see it through: inside C++, and between two renames."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

Handler = Callable[[int, FrameType | None], Any]


@contextmanager
def noticed_interrupt() -> Iterator[None]:
    """Raise the KeyboardInterrupt of a Ctrl-C within, though the code there has swallowed it.

    CasADi stops its solver at one, then returns as if that had not converged, or goes on.

    Raises:
        KeyboardInterrupt: At the end, if there was one and nothing else was raised for it.
    """
    with _watched(pass_on=True) as seen:
        yield
        if seen:
            raise KeyboardInterrupt


@contextmanager
def postponed_interrupt() -> Iterator[None]:
    """Let a Ctrl-C within count at the end only: for a few calls that belong together."""
    with _watched(pass_on=False) as seen:
        yield
    if seen:
        raise KeyboardInterrupt


@contextmanager
def _watched(*, pass_on: bool) -> Iterator[list[int]]:
    """Note every SIGINT in a list.

    Only the main thread can, and only where the handler is one of Python's: else nothing is noted.
    """
    previous = signal.getsignal(signal.SIGINT)
    seen: list[int] = []
    if threading.current_thread() is not threading.main_thread() or not callable(previous):
        yield seen
        return
    handler: Handler = previous

    def note(number: int, frame: FrameType | None) -> None:
        seen.append(number)
        if pass_on:
            handler(number, frame)

    signal.signal(signal.SIGINT, note)
    try:
        yield seen
    finally:
        signal.signal(signal.SIGINT, previous)
