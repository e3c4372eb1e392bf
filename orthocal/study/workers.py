"""A study's tasks on the cores of this machine, in processes that end with the one that asked.

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
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cache
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkProcess
from typing import Any

from orthocal.errors import OrthocalError
from orthocal.study.study import Cell, Study, prepare_once, run_task

WATCHING = 0.5
"""How often a worker looks whether it is still wanted, [s]."""

Done = tuple[int, dict[str, list[Cell]]]


def run_on_cores(study: Study, todo: Sequence[int], workers: int) -> Iterator[Done]:
    """The rows of tasks as they are found, in whichever order.

    Args:
        study: The study.
        todo: Numbers of the tasks.
        workers: How many processes.

    Raises:
        OrthocalError: If a worker is killed.
    """
    return (_forked if _can_fork() else _spawned)(study, todo, workers)


def _can_fork() -> bool:
    """Whether this process may be doubled: what another thread holds would stay held for ever."""
    if sys.platform != "linux" or threading.active_count() > 1:
        return False
    try:
        return len(os.listdir("/proc/self/task")) == 1
    except OSError:
        return False


def _forked(study: Study, todo: Sequence[int], workers: int) -> Iterator[Done]:
    prepare_once(study)
    context, rest = multiprocessing.get_context("fork"), list(reversed(todo))
    running: dict[Connection[Any, Any], ForkProcess] = {}
    try:
        for _ in range(workers):
            ours, theirs = context.Pipe()
            asked = (study, theirs, os.getpid())
            process = context.Process(target=_serve, args=asked, daemon=True)
            process.start()
            theirs.close()
            running[ours] = process
            ours.send(rest.pop())
        while running:
            ready = wait(list(running))
            for ours in [c for c in running if c in ready]:
                yield _answer(ours)
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


def _answer(ours: Connection[Any, Any]) -> Done:
    try:
        done: Done | BaseException = ours.recv()
    except (EOFError, ConnectionError):
        raise OrthocalError(
            "a process of the study was killed; with --out the same command goes on where it was"
        ) from None
    if isinstance(done, BaseException):
        raise done
    return done


def _serve(study: Study, theirs: Connection[Any, Any], parent: int) -> None:
    """Do what is asked for until there is no more of it."""
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
            theirs.send((task, run_task(study, task)))
        except Exception as e:  # whatever it is, it is raised where it was asked for
            theirs.send(_sendable(e))


def _sendable(error: Exception) -> Exception:
    """An error as it is, or what it says where it cannot be sent."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # pickling runs the error's own code
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def _spawned(study: Study, todo: Sequence[int], workers: int) -> Iterator[Done]:
    from joblib import Parallel, delayed, parallel_config

    with parallel_config(backend="loky", inner_max_num_threads=1):
        parallel = Parallel(n_jobs=workers, return_as="generator_unordered", batch_size=1)
        yield from parallel(delayed(_in_worker)(study, task, os.getpid()) for task in todo)


def _in_worker(study: Study, task: int, parent: int) -> Done:
    _end_with(parent)
    return task, run_task(study, task)


@cache
def _end_with(parent: int) -> None:
    """End this process when the one that asked for its work is gone: killed, it cannot say so."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCHING)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
