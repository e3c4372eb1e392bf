"""What a study is: numbered tasks that make the rows of one table, on whichever worker."""

from __future__ import annotations

import hashlib
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Any, ClassVar

import numpy as np
from threadpoolctl import threadpool_limits

from orthocal import __version__

Cell = float | int | str | bool | None
Columns = Mapping[str, Sequence[Cell]]
"""Part of a table: name of each column to its cells, as many in each."""

DIGITS = 9
"""Of a number in a table. The last ones of a sum depend on how a processor adds up."""


class Study(ABC):
    """A study. Two that say the same of themselves make the same table, byte by byte."""

    kind: ClassVar[str]
    counted: ClassVar[str]
    """What its rows are, such as machines."""

    @property
    @abstractmethod
    def record(self) -> dict[str, Any]:
        """All that the table depends on, as plain data."""

    @property
    @abstractmethod
    def task_sizes(self) -> tuple[int, ...]:
        """How much of what is counted each task is; as many as there are tasks."""

    @abstractmethod
    def prepare(self) -> Any:  # noqa: ANN401 - whatever its own `run` needs
        """What all tasks share, made once a worker."""

    @abstractmethod
    def run(self, prepared: Any, task: int) -> Columns:  # noqa: ANN401 - as above
        """The rows of one task: they depend on nothing but the study and the task's number."""

    @cached_property
    def document(self) -> dict[str, Any]:
        """The record, with the version that makes the table."""
        return {"kind": self.kind, "orthocal": __version__, **self.record}

    @cached_property
    def digest(self) -> str:
        """Of the document."""
        text = json.dumps(self.document, sort_keys=True, allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Study) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)


def run_task(study: Study, task: int) -> dict[str, list[Cell]]:
    """The rows of one task as they are kept: on one thread, numbers of so many digits."""
    with threadpool_limits(1):
        found = study.run(prepare_once(study), task)
    return {name: _tidy(cells) for name, cells in found.items()}


@lru_cache(maxsize=1)
def prepare_once(study: Study) -> Any:  # noqa: ANN401 - as `prepare`
    """What all tasks of a study share, made once in this process."""
    return study.prepare()


def _tidy(cells: Sequence[Cell]) -> list[Cell]:
    values = np.asarray(cells) if len(cells) and type(cells[0]) is np.float64 else None
    if values is None or values.dtype != np.float64:
        return [tidy_cell(v) for v in cells]
    # all at once: one by one they take twice as long
    told = f"%.{DIGITS - 1}e " * len(values) % tuple(values.tolist())
    return [None if text == "nan" else float(text) + 0.0 for text in told.split()]


def tidy_cell(value: object) -> Cell:
    """A cell as it is kept: NaN is None, numbers have so many digits."""
    if type(value) is float:
        return None if value != value else float(f"{value:.{DIGITS - 1}e}") + 0.0
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, np.bool_ | np.integer):
        return bool(value) if isinstance(value, np.bool_) else int(value)
    number = float(value)  # type: ignore[arg-type] # what is left is a number
    return None if math.isnan(number) else float(f"{number:.{DIGITS - 1}e}") + 0.0
