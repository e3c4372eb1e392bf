"""Pool of worker processes on this machine, which end with their parent process.

On Linux a process with one thread is forked. The workers share all data that the parent has loaded
or computed, and start at once. Otherwise joblib starts new processes and sends them pickled work.
Workers ignore Ctrl-C, because their parent ends them.
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
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkProcess
from typing import Any, TypeVar

from orthocal.errors import OrthocalError
from orthocal.runtime.interrupts import blocked_interrupt

PARENT_CHECK_INTERVAL = 0.5
"""Interval at which a worker checks that its parent is alive, [s]."""

_BUDGET: ContextVar[int] = ContextVar("worker budget", default=1)

T = TypeVar("T")

Work = Callable[[int], T]
"""Function from the number of a task to its result; pickled if processes cannot be forked."""


def available_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def worker_budget(count: int) -> Iterator[None]:
    """Allow the code inside the block up to `count` processes."""
    token = _BUDGET.set(count)
    try:
        yield
    finally:
        _BUDGET.reset(token)


def current_worker_budget() -> int:
    """Allowed number of processes: 1 unless a caller allows more."""
    return _BUDGET.get()


def run_in_parallel(
    work: Work[T], tasks: Sequence[int], workers: int, *, killed: str
) -> Iterator[tuple[int, T]]:
    """Numbers and results of tasks in the order of their completion.

    Args:
        work: Function from the number of a task to its result.
        tasks: Numbers of the tasks.
        workers: Number of processes. With one worker or one task, this process runs all in order.
        killed: Message if a worker is killed.

    Raises:
        OrthocalError: If a worker is killed.
    """
    count = min(workers, len(tasks))
    if count <= 1:
        return ((task, work(task)) for task in tasks)
    if can_fork():
        return _run_forked(work, tasks, count, killed)
    return _run_spawned(work, tasks, count, killed)


def call_in_parallel(
    calls: Sequence[Callable[[], Any]], *, killed: str = "a worker process was killed"
) -> tuple[Any, ...]:
    """Results of functions, called in parallel within the worker budget.

    They are called in sequence if processes cannot be forked.

    Args:
        calls: The functions, the slowest first. Their results are pickled.
        killed: Message if a worker is killed.

    Raises:
        OrthocalError: If a worker is killed.
    """
    count = min(current_worker_budget(), len(calls)) if can_fork() else 1
    results = dict(run_in_parallel(lambda k: calls[k](), range(len(calls)), count, killed=killed))
    return tuple(results[k] for k in range(len(calls)))


def can_fork() -> bool:
    """True if a fork is safe: on Linux in a process with one thread.

    With several threads a lock could stay locked in the child.
    """
    if sys.platform != "linux" or threading.active_count() > 1:
        return False
    try:
        return len(os.listdir("/proc/self/task")) == 1
    except OSError:
        return False


def _run_forked(
    work: Work[T], tasks: Sequence[int], workers: int, killed: str
) -> Iterator[tuple[int, T]]:
    """Numbers and results of tasks from forked workers."""
    context, waiting = multiprocessing.get_context("fork"), list(reversed(tasks))
    running: dict[Connection[Any, Any], ForkProcess] = {}
    try:
        for _ in range(workers):
            connection, remote = context.Pipe()
            arguments = (work, remote, os.getpid())
            process = context.Process(target=_serve, args=arguments, daemon=True)
            with blocked_interrupt():  # a fork may swallow a Ctrl-C, or print it in the worker
                process.start()
                running[connection] = process
            remote.close()
            connection.send(waiting.pop())
        while running:
            ready = wait(list(running))
            for connection in [c for c in running if c in ready]:
                yield _receive(connection, killed)
                if waiting:
                    connection.send(waiting.pop())
                else:
                    connection.close()
                    running.pop(connection).join()
    finally:
        for connection, process in running.items():
            process.kill()
            process.join()
            connection.close()


def _receive(connection: Connection[Any, Any], killed: str) -> Any:  # noqa: ANN401 - a result
    """Number and result of a task; raises its error."""
    try:
        answer = pickle.loads(connection.recv_bytes())
    except (EOFError, ConnectionError):
        raise OrthocalError(killed) from None
    if isinstance(answer, BaseException):
        raise answer
    return answer


def _serve(work: Work[Any], connection: Connection[Any, Any], parent: int) -> None:
    """Answer the requests of the parent until it closes the connection or ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _BUDGET.set(1)  # the other cores are busy
    try:
        for descriptor in map(int, os.listdir("/proc/self/fd")):
            if descriptor > 2 and descriptor != connection.fileno():
                with suppress(OSError):  # an inherited file would keep the parent's lock on it
                    os.close(descriptor)
        _end_with(parent)
        while True:
            connection.send_bytes(_answer(work, connection.recv()))
    except (EOFError, OSError):
        pass
    finally:  # without the parent's cleanup, and without a traceback
        os._exit(0)


def _answer(work: Work[Any], task: int) -> bytes:
    """Pickled number and result of a task, or the pickled error, which the parent raises."""
    try:
        return pickle.dumps((task, work(task)))
    except Exception as e:
        return pickle.dumps(_picklable(e))


def _picklable(error: Exception) -> Exception:
    """The error itself, or a RuntimeError with its text if it cannot be pickled."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # pickling runs the error's own code
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def _run_spawned(
    work: Work[T], tasks: Sequence[int], workers: int, killed: str
) -> Iterator[tuple[int, T]]:
    """Numbers and results of tasks from new processes of joblib."""
    from joblib import Parallel, delayed, parallel_config

    parent = os.getpid()
    try:
        with parallel_config(backend="loky", inner_max_num_threads=1), blocked_interrupt():
            parallel = Parallel(n_jobs=workers, return_as="generator_unordered", batch_size=1)
            results = parallel(delayed(_work_and_watch)(work, task, parent) for task in tasks)
        yield from results
    except BrokenProcessPool:
        raise OrthocalError(killed) from None


def _work_and_watch(work: Work[T], task: int, parent: int) -> tuple[int, T]:
    _end_with(parent)
    return task, work(task)


@cache
def _end_with(parent: int) -> None:
    """End this process when its parent has ended; a killed parent cannot end its workers."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_CHECK_INTERVAL)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
