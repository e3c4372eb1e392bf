"""Work on the cores of this machine, in processes that end with the one that asked.

Where a process has but one thread it is doubled (fork): each worker then has all that was loaded
and prepared before, and begins at once. Elsewhere workers begin from nothing (joblib).
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkProcess
from typing import Any, TypeVar

from orthocal.errors import OrthocalError

WATCHING = 0.5
"""How often a worker looks whether it is still wanted, [s]."""

_LENT: ContextVar[int] = ContextVar("cores that may be used", default=1)

T = TypeVar("T")

Work = Callable[[int], T]
"""What is done of a task, by its number. Where no process can be doubled it is pickled."""


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_on_cores(
    work: Work[T], todo: Sequence[int], workers: int, *, killed: str
) -> Iterator[tuple[int, T]]:
    """What comes out of tasks as they end, in whichever order.

    Args:
        work: What is done of each.
        todo: Numbers of the tasks.
        workers: How many processes; with one, or one task, this one does all, in order.
        killed: What is said if one of them is killed.

    Raises:
        OrthocalError: If a worker is killed.
    """
    count = min(workers, len(todo))
    if count <= 1:
        return ((task, work(task)) for task in todo)
    if can_fork():
        return _forked(work, todo, count, killed)
    return _spawned(work, todo, count)


@contextmanager
def lent(count: int) -> Iterator[None]:
    """Let what is computed within the block use so many cores, where it can."""
    before = _LENT.set(count)
    try:
        yield
    finally:
        _LENT.reset(before)


def lent_cores() -> int:
    """How many cores may be used here: one, unless somebody lends more."""
    return _LENT.get()


def call_on_cores(
    calls: Sequence[Callable[[], Any]], *, killed: str = "a process was killed"
) -> tuple[Any, ...]:
    """What functions return, called side by side on the cores that are lent.

    Where processes cannot be doubled they are called one after the other.

    Args:
        calls: The functions, those first that take longest; what they return is pickled.
        killed: What is said if one of the processes is killed.

    Raises:
        OrthocalError: If a worker is killed.
    """
    count = min(lent_cores(), len(calls))
    if count <= 1 or not can_fork():
        return tuple(call() for call in calls)
    found = dict(_forked(lambda k: calls[k](), range(len(calls)), count, killed))
    return tuple(found[k] for k in range(len(calls)))


def can_fork() -> bool:
    """Whether this process may be doubled: what another thread holds would stay held for ever."""
    if sys.platform != "linux" or threading.active_count() > 1:
        return False
    try:
        return len(os.listdir("/proc/self/task")) == 1
    except OSError:
        return False


def _forked(
    work: Work[T], todo: Sequence[int], workers: int, killed: str
) -> Iterator[tuple[int, T]]:
    context, rest = multiprocessing.get_context("fork"), list(reversed(todo))
    running: dict[Connection[Any, Any], ForkProcess] = {}
    try:
        for _ in range(workers):
            ours, theirs = context.Pipe()
            asked = (work, theirs, os.getpid())
            process = context.Process(target=_serve, args=asked, daemon=True)
            process.start()
            theirs.close()
            running[ours] = process
            ours.send(rest.pop())
        while running:
            ready = wait(list(running))
            for ours in [c for c in running if c in ready]:
                yield _answer(ours, killed)
                if rest:
                    ours.send(rest.pop())
                else:
                    ours.close()
                    running.pop(ours).join()
    finally:
        for ours, process in running.items():
            process.kill()
            process.join()
            ours.close()


def _answer(ours: Connection[Any, Any], killed: str) -> Any:  # noqa: ANN401 - what work makes
    try:
        done = ours.recv()
    except (EOFError, ConnectionError):
        raise OrthocalError(killed) from None
    if isinstance(done, BaseException):
        raise done
    return done


def _serve(work: Work[Any], theirs: Connection[Any, Any], parent: int) -> None:
    """Do what is asked for until there is no more of it."""
    _LENT.set(1)  # the others are busy
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    for descriptor in map(int, os.listdir("/proc/self/fd")):
        if descriptor > 2 and descriptor != theirs.fileno():
            with suppress(OSError):  # what the other one holds, its lock among it, is its own
                os.close(descriptor)
    _end_with(parent)
    while True:
        try:
            task = theirs.recv()
        except EOFError:
            os._exit(0)
        try:
            theirs.send((task, work(task)))
        except Exception as e:  # whatever it is, it is raised where it was asked for
            theirs.send(_sendable(e))


def _sendable(error: Exception) -> Exception:
    """An error as it is, or what it says where it cannot be sent."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # pickling runs the error's own code
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def _spawned(work: Work[T], todo: Sequence[int], workers: int) -> Iterator[tuple[int, T]]:
    from joblib import Parallel, delayed, parallel_config

    with parallel_config(backend="loky", inner_max_num_threads=1):
        parallel = Parallel(n_jobs=workers, return_as="generator_unordered", batch_size=1)
        yield from parallel(delayed(_in_worker)(work, task, os.getpid()) for task in todo)


def _in_worker(work: Work[T], task: int, parent: int) -> tuple[int, T]:
    _end_with(parent)
    return task, work(task)


@cache
def _end_with(parent: int) -> None:
    """End this process when the one that asked for its work is gone: killed, it cannot say so."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCHING)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
