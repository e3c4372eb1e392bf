"""Ctrl-C where an exception alone would not do: inside C++, and between two renames.

Of the libraries in C++ some swallow a KeyboardInterrupt, some take it for a failed import or a
wrong argument, and one aborts the process. So the command line does not raise any: it ends.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""

Handler = Callable[[int, FrameType | None], Any]


def _end(number: int, frame: FrameType | None) -> None:
    os._exit(INTERRUPTED)


@contextmanager
def ending_at_interrupt() -> Iterator[None]:
    """End the process at Ctrl-C, wherever it is: nothing is written, and nothing can swallow it."""
    previous = signal.getsignal(signal.SIGINT)
    if previous is not signal.default_int_handler or not _in_main_thread():
        yield
        return
    signal.signal(signal.SIGINT, _end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


@contextmanager
def raised_interrupt() -> Iterator[None]:
    """Raise a KeyboardInterrupt at Ctrl-C within, though the process would end elsewhere.

    For what has something to clear away: files that are written only in part, another process.
    """
    if signal.getsignal(signal.SIGINT) is not _end:
        yield
        return
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, _end)


@contextmanager
def noticed_interrupt() -> Iterator[None]:
    """Raise the KeyboardInterrupt of a Ctrl-C within, even if the code there swallowed it.

    CasADi stops its solver at one. It then returns as if the solver had not converged, goes on, or
    (Python 3.13) raises a SystemError because the interrupt is still pending.

    Raises:
        KeyboardInterrupt: At the end, if there was a Ctrl-C.
    """
    with _watched(pass_on=True) as seen:
        try:
            yield
        except Exception:
            if seen:
                raise KeyboardInterrupt from None
            raise
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
    if not callable(previous) or not _in_main_thread():
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


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
