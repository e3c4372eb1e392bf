"""Execution of a study on this machine or on a Dask cluster; it can be stopped and resumed.

Results are written to a journal, results.jsonl in the directory of the study. Its first line
identifies the study. Each other line contains one task, which is finished once it is on disk.
"""

from __future__ import annotations

import io
import json
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from orthocal.errors import OrthocalError
from orthocal.io.journal import Journal, open_journal_file
from orthocal.runtime.worker_pool import can_fork, run_in_parallel, worker_budget
from orthocal.study.study import Cell, Study, prepare_once, run_task

JOURNAL = "results.jsonl"
"""File name of the results in a study's directory."""

FORMAT = "orthocal/study/1"

DASK_TIMEOUT = 10.0
"""Time in which a Dask scheduler must answer, [s]."""

DASK_RETRIES = 3
"""Number of times a task is restarted after its worker was lost."""

KILLED = "a process of the study was killed; with --out the same command resumes the study"

TaskResult = tuple[int, dict[str, list[Cell]]]
Results = dict[int, dict[str, list[Cell]]]
"""Number of a task to its columns."""


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a study."""

    done: int
    """Number of finished cases."""
    total: int
    """Number of all cases."""
    resumed: int
    """Number of cases that earlier runs finished."""
    seconds_left: float | None
    """Expected remaining time, [s]; None before the first task of this run has finished."""


@dataclass(frozen=True, slots=True, eq=False)
class StudyTable:
    """Result of a study."""

    study: Study
    columns: dict[str, list[Cell]]
    """Column name to cells, in the order of the tasks."""

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), []))


def run_study(
    study: Study,
    *,
    directory: Path | str | None = None,
    workers: int = 1,
    dask: str | None = None,
    discard: bool = False,
    report: Callable[[Progress], None] | None = None,
) -> StudyTable:
    """Run the unfinished tasks of a study.

    Args:
        study: The study.
        directory: Directory of the results, in which a stopped study is resumed.
        workers: Number of processes on this machine.
        dask: Address of a Dask scheduler whose workers are used in place of local processes.
        discard: Whether to discard the results in the directory.
        report: Function that is called with the progress before the first and after each task.

    Raises:
        OrthocalError: If the directory belongs to another study, or the scheduler does not answer.
    """
    path = None if directory is None else Path(directory) / JOURNAL
    sizes = study.task_sizes
    total = sum(sizes)
    with open_results(path, study, discard=discard) as (results, store):
        pending = [task for task in range(len(sizes)) if task not in results]
        completed = sum(sizes[task] for task in results)
        start, done = time.monotonic(), 0
        if report is not None:
            report(Progress(completed, total, completed, None))
        for task, columns in _run_tasks(study, pending, workers, dask):
            store(task, columns)
            done += sizes[task]
            if report is not None:
                seconds_left = (time.monotonic() - start) * (total - completed - done) / done
                report(Progress(completed + done, total, completed, seconds_left))
        return StudyTable(study, _join_columns(results))


def to_parquet(table: StudyTable) -> bytes:
    """Content of a Parquet file with a table, and the document of the study in its metadata."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    arrow = pa.table({name: pa.array(cells) for name, cells in table.columns.items()})
    document = json.dumps(table.study.document, sort_keys=True)
    arrow = arrow.replace_schema_metadata({"orthocal_study": document})
    stream = io.BytesIO()
    pq.write_table(arrow, stream, compression="zstd")
    return stream.getvalue()


@contextmanager
def open_results(
    path: Path | None, study: Study, *, discard: bool = False
) -> Iterator[tuple[Results, Callable[[int, dict[str, list[Cell]]], None]]]:
    """Open the results of a study, with a function that stores those of another task.

    Args:
        path: Path to the journal; None to store nothing on disk.
        study: The study.
        discard: Whether to discard the content of the journal.

    Raises:
        OrthocalError: If the journal belongs to another study, is damaged, or is in use.
        OutputError: If it cannot be written.
    """
    if path is None:
        results: Results = {}
        yield results, results.__setitem__
        return
    busy = "is in use by another process; wait for it, or choose another directory"
    with open_journal_file(path, busy=busy, discard=discard) as journal:
        results = _read_results(journal, study)

        def store(task: int, columns: dict[str, list[Cell]]) -> None:
            journal.append({"task": task, "columns": columns})
            results[task] = columns

        yield results, store


def _read_results(journal: Journal, study: Study) -> Results:
    """Results in a journal. The first line is written if the journal is empty."""
    results: Results = {}
    first = True
    for where, data in journal.entries():
        if data is None:
            raise OrthocalError(
                "is not a line of a study: the file is damaged, or another kind of file. "
                "--force overwrites it",
                where=where,
            )
        if first:
            _require_same_study(data, study, journal.path)
            first = False
        else:
            task, columns = _read_entry(data, study, where)
            results[task] = columns
    if first:
        journal.append({"format": FORMAT, "study": study.document, "digest": study.digest})
    return results


def _require_same_study(data: dict[str, Any], study: Study, path: Path) -> None:
    """Refuse the journal of another study."""
    if data.get("digest") == study.digest and data.get("format") == FORMAT:
        return
    stored = data.get("study")
    if not isinstance(stored, dict) or "kind" not in stored:
        raise OrthocalError("is not a study's file; --force overwrites it", where=str(path))
    document = study.document
    keys = sorted(k for k in {*stored, *document} if stored.get(k) != document.get(k))
    raise OrthocalError(
        f"belongs to another study (different: {', '.join(keys) or 'format'}). Choose another "
        "directory, or start again with --force",
        where=str(path),
    )


def _read_entry(data: dict[str, Any], study: Study, where: str) -> TaskResult:
    """Number and columns of a task from a line of the journal."""
    task, columns = data.get("task"), data.get("columns")
    if isinstance(task, int) and 0 <= task < len(study.task_sizes) and isinstance(columns, dict):
        cells = list(columns.values())
        if cells and all(isinstance(c, list) and len(c) == len(cells[0]) for c in cells):
            return task, columns
    raise OrthocalError("is damaged; --force starts the study again", where=where)


def _run_tasks(
    study: Study, tasks: Sequence[int], workers: int, dask: str | None
) -> Iterable[TaskResult]:
    """Run tasks in processes of this machine or on Dask."""
    if not tasks:
        return ()
    if dask is not None:
        return _run_on_dask(study, tasks, dask)
    if can_fork():
        with worker_budget(workers):
            prepare_once(study)  # forked workers share it
    return run_in_parallel(partial(run_task, study), tasks, workers, killed=KILLED)


def _run_on_dask(study: Study, tasks: Sequence[int], address: str) -> Iterator[TaskResult]:
    """Run tasks on the workers of a Dask scheduler."""
    try:
        from distributed import Client, as_completed
        from distributed.comm import get_address_host_port
    except ImportError:
        raise OrthocalError(
            "needs the extra `cluster`: pip install 'orthocal[cluster]'", where="--dask"
        ) from None
    try:
        # a client that does not connect can block the next one while it is collected as garbage
        socket.create_connection(get_address_host_port(address, strict=True), DASK_TIMEOUT).close()
        client = Client(address, timeout=DASK_TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TypeError) as e:
        raise OrthocalError(
            f"no Dask scheduler answers at '{address}' ({type(e).__name__}); expected an address "
            "such as tcp://127.0.0.1:8786",
            where="--dask",
        ) from None
    with client:
        # shared as a result, which the scheduler computes again if its worker is lost
        shared = client.submit(_return_study, study, pure=False, retries=DASK_RETRIES)
        numbered = [shared] * len(tasks), list(tasks)
        futures = client.map(
            _run_numbered, *numbered, pure=False, retries=DASK_RETRIES, batch_size=1000
        )
        for future in as_completed(futures, loop=client.loop):
            yield future.result()


def _return_study(study: Study) -> Study:
    return study


def _run_numbered(study: Study, task: int) -> TaskResult:
    return task, run_task(study, task)


def _join_columns(results: Results) -> dict[str, list[Cell]]:
    """Columns of all tasks, in the order of the tasks; missing cells are None."""
    columns: dict[str, list[Cell]] = {}
    count = 0
    for task in sorted(results):
        task_columns = results[task]
        size = len(next(iter(task_columns.values()), []))
        for name in task_columns:
            columns.setdefault(name, [None] * count)
        for name, cells in columns.items():
            cells.extend(task_columns.get(name, [None] * size))
        count += size
    return columns
