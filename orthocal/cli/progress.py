"""How far a study is, on stderr."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from orthocal.cli.printing import put_note

if TYPE_CHECKING:
    from orthocal.study.runner import Progress
    from orthocal.study.study import Study

STEP = 0.1
"""Part of a study between two lines of progress where there is no terminal."""


@contextmanager
def told(study: Study) -> Iterator[Callable[[Progress], None]]:
    """Tells how far a study is: a bar on a terminal, else a line now and then."""
    if len(study.task_sizes) < 2:
        yield lambda progress: None
        return
    if sys.stderr.isatty():
        with _bar(study) as report:
            yield report
        return
    last = -STEP

    def say(progress: Progress) -> None:
        nonlocal last
        share = progress.done / progress.total
        if progress.seconds_left is None:
            if progress.kept:
                put_note(f"orthocal: {progress.kept} of {progress.total} {study.counted} are there")
            return
        if share < last + STEP and share < 1.0:
            return
        last = share
        left = "" if share >= 1.0 else f", about {_duration(progress.seconds_left)} left"
        put_note(f"orthocal: {progress.done} of {progress.total} {study.counted}{left}")

    yield say


@contextmanager
def _bar(study: Study) -> Iterator[Callable[[Progress], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[left]}"),
    )
    # it draws when told to, and needs no thread: a process with one alone can be doubled
    console = Console(stderr=True)
    with Bar(*columns, console=console, auto_refresh=False, transient=True) as bar:
        task = bar.add_task(study.counted, total=sum(study.task_sizes), left="")

        def show(progress: Progress) -> None:
            left = "" if progress.seconds_left is None else _duration(progress.seconds_left)
            bar.update(task, completed=progress.done, left=f"{left} left" if left else "")
            bar.refresh()

        yield show


def _duration(seconds: float) -> str:
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 5400.0 else f"{seconds / 3600.0:.1f} h"
