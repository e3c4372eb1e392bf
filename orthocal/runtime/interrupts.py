"""Handling of Ctrl-C inside C++ code, during a fork and between two renames.

Some C++ libraries swallow a KeyboardInterrupt, some report it as a failed import or a wrong
argument, and one aborts the process. Python itself swallows one that is raised in a destructor or
in a hook of `os.fork`. So Ctrl-C ends the process of the command line without an exception.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from types import FrameType
from typing import Any

INTERRUPTED = 130
"""Exit code after Ctrl-C, as in shells."""

Handler = Callable[[int, FrameType | None], Any]


_MESSAGE: ContextVar[str] = ContextVar("message at an interrupt", default="")


def _end(number: int, frame: FrameType | None) -> None:
    """End the process at once, after printing the message."""
    if message := _MESSAGE.get():
        with suppress(OSError):
            os.write(2, f"{message}\n".encode())
    os._exit(INTERRUPTED)


@contextmanager
def _handled(handler: Handler) -> Iterator[None]:
    """Call a function at Ctrl-C inside the block."""
    previous = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


@contextmanager
def message_at_interrupt(message: str) -> Iterator[None]:
    """Print a message if Ctrl-C ends the process inside the block."""
    token = _MESSAGE.set(message)
    try:
        yield
    finally:
        _MESSAGE.reset(token)


@contextmanager
def ending_at_interrupt() -> Iterator[None]:
    """End the process at once at Ctrl-C inside the block; no library can swallow it."""
    handler = signal.getsignal(signal.SIGINT)
    if handler is not signal.default_int_handler or not _in_main_thread():
        yield
        return
    with _handled(_end):
        yield


@contextmanager
def raised_interrupt() -> Iterator[None]:
    """Raise a KeyboardInterrupt at Ctrl-C inside a block within `ending_at_interrupt`.

    For code that must clean up partly written files or another process.
    """
    if signal.getsignal(signal.SIGINT) is not _end:
        yield
        return
    with _handled(signal.default_int_handler):
        yield


@contextmanager
def noticed_interrupt() -> Iterator[None]:
    """Raise the KeyboardInterrupt of a Ctrl-C inside the block, even if code there swallowed it.

    CasADi stops its solver at a Ctrl-C. Then it returns as if the solver had not converged, or
    continues. In Python 3.13 it may raise a SystemError because the interrupt is still pending.

    Raises:
        KeyboardInterrupt: At the end of the block, if there was a Ctrl-C.
    """
    with _recorded_interrupts(pass_on=True) as received:
        try:
            yield
        except Exception:
            if received:
                raise KeyboardInterrupt from None
            raise
        if received:
            raise KeyboardInterrupt


@contextmanager
def postponed_interrupt() -> Iterator[None]:
    """Postpone a Ctrl-C to the end of the block, for a few calls that belong together.

    Raises:
        KeyboardInterrupt: At the end of the block, if there was a Ctrl-C.
    """
    with _recorded_interrupts(pass_on=False) as received:
        yield
    if received:
        raise KeyboardInterrupt


@contextmanager
def blocked_interrupt() -> Iterator[None]:
    """Let the operating system delay a Ctrl-C to the end of the block.

    Processes that are started inside the block inherit the blocked signal. So no Ctrl-C reaches
    them before they have set their handler, and none is lost in the parent.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)


@contextmanager
def _recorded_interrupts(*, pass_on: bool) -> Iterator[list[int]]:
    """Record every SIGINT in a list.

    The list stays empty in other threads than the main one, and if the handler is not a Python
    function.
    """
    previous = signal.getsignal(signal.SIGINT)
    received: list[int] = []
    if not callable(previous) or not _in_main_thread():
        yield received
        return
    handler: Handler = previous

    def record(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if pass_on:
            handler(number, frame)

    with _handled(record):
        yield received


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
