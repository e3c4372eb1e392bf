"""Running a study: on the cores of this machine, or on a Dask cluster; stopped and continued."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from orthocal.errors import OrthocalError
from orthocal.runtime.worker_pool import can_fork, run_in_parallel, worker_budget
from orthocal.study.journal import Found, open_journal
from orthocal.study.study import Cell, Study, prepare_once, run_task

JOURNAL = "results.jsonl"
"""In a study's folder."""

CONNECTING = 10.0
"""How long a cluster may take to answer, [s]."""

KILLED = "a process of the study was killed; with --out the same command goes on where it was"

Done = tuple[int, dict[str, list[Cell]]]

RETRIES = 3
"""How often a task is begun anew whose worker is gone."""


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a study is."""

    done: int
    """Of what it counts."""
    total: int
    kept: int
    """Of those done: that were there before."""
    seconds_left: float | None
    """None before the first task of this run has ended."""


@dataclass(frozen=True, slots=True, eq=False)
class StudyTable:
    """What a study has found."""

    study: Study
    columns: dict[str, list[Cell]]
    """Name to cells, in the order of the tasks."""

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), []))


def run_study(
    study: Study,
    *,
    folder: Path | None = None,
    workers: int = 1,
    dask: str | None = None,
    anew: bool = False,
    report: Callable[[Progress], None] | None = None,
) -> StudyTable:
    """Run what is left of a study.

    Args:
        study: The study.
        folder: Where its results are kept, each before it counts; there it goes on where it was
            stopped.
        workers: Processes of this machine.
        dask: Address of a Dask scheduler, whose workers are taken instead.
        anew: Whether to throw away what is there.
        report: Told of each task that has ended.

    Raises:
        OrthocalError: If the folder is another study's, or the cluster does not answer.
    """
    path = None if folder is None else folder / JOURNAL
    sizes = study.task_sizes
    with open_journal(path, study, anew=anew) as journal:
        todo = [task for task in range(len(sizes)) if task not in journal.found]
        kept = sum(sizes[task] for task in journal.found)
        began, done = time.monotonic(), 0
        if report is not None:
            report(Progress(kept, sum(sizes), kept, None))
        for task, columns in _run(study, todo, workers, dask):
            journal.add(task, columns)
            done += sizes[task]
            if report is not None:
                rest = sum(sizes) - kept - done
                left = (time.monotonic() - began) * rest / done
                report(Progress(kept + done, sum(sizes), kept, left))
        return StudyTable(study, _table(journal.found))


def _run(study: Study, todo: Sequence[int], workers: int, dask: str | None) -> Iterable[Done]:
    if not todo:
        return ()
    if dask is not None:
        return _on_cluster(study, todo, dask)
    if can_fork():
        with worker_budget(workers):
            prepare_once(study)  # every worker has it when it begins
    return run_in_parallel(partial(run_task, study), todo, workers, killed=KILLED)


def _one(study: Study, task: int) -> Done:
    return task, run_task(study, task)


def _on_cluster(study: Study, todo: Sequence[int], address: str) -> Iterator[Done]:
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise OrthocalError(
            "needs the extra `cluster`: pip install 'orthocal[cluster]'", where="--dask"
        ) from None
    try:
        client = Client(address, timeout=CONNECTING, set_as_default=False)
    except (OSError, ValueError, TypeError) as e:
        raise OrthocalError(
            f"no Dask scheduler answers at '{address}' ({type(e).__name__}); expected an address "
            "such as tcp://127.0.0.1:8786",
            where="--dask",
        ) from None
    with client:
        shared = client.scatter(study, broadcast=False, hash=False)
        futures = client.map(
            _one, [shared] * len(todo), list(todo), pure=False, retries=RETRIES, batch_size=1000
        )
        for future in as_completed(futures, loop=client.loop):
            yield future.result()


def _table(found: Found) -> dict[str, list[Cell]]:
    """Columns of all tasks, in their order."""
    columns: dict[str, list[Cell]] = {}
    count = 0
    for task in sorted(found):
        part = found[task]
        size = len(next(iter(part.values()), []))
        for name in part:
            columns.setdefault(name, [None] * count)
        for name, cells in columns.items():
            cells.extend(part.get(name, [None] * size))
        count += size
    return columns
