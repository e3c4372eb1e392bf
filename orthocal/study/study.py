"""Protocol of a study: numbered tasks that produce the rows of one table."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from numbers import Integral
from operator import attrgetter
from typing import Any, ClassVar, cast

import numpy as np

from orthocal import __version__
from orthocal.arrays import Array
from orthocal.errors import ParameterError
from orthocal.estimation.problem import CalibrationProblem
from orthocal.measurement.files.point_rows import is_of_row
from orthocal.measurement.files.write_session import session_document, session_tables
from orthocal.runtime.threads import one_thread
from orthocal.sensors.points import Points
from orthocal.session.session import Session

Cell = float | int | str | bool | None
Columns = Mapping[str, Sequence[Cell]]
"""Part of a table: column name to cells, the same number in each column."""

DIGITS = 9
"""Significant digits of numbers in a table. Further digits depend on the processor."""


@dataclass(frozen=True, eq=False)
class Study(ABC):
    """Study; its fields are its arguments.

    A study is determined by its document: equal documents yield identical tables.
    """

    kind: ClassVar[str]
    counted: ClassVar[str]
    """Plural noun for the cases of the study, such as machines."""
    cases_per_task: ClassVar[int] = 250

    session: Session
    """Session of a nominal robot."""

    @property
    @abstractmethod
    def count(self) -> int:
        """Number of cases."""

    @abstractmethod
    def prepare(self) -> Any:  # noqa: ANN401 - the argument of `run`
        """Prepare the data shared by all tasks, once per worker."""

    @abstractmethod
    def run(self, prepared: Any, task: int) -> Columns:  # noqa: ANN401 - as above
        """Rows of one task. They depend on the study and the number of the task alone."""

    @property
    def task_sizes(self) -> tuple[int, ...]:
        """Number of cases of each task."""
        full, remainder = divmod(self.count, self.cases_per_task)
        return (self.cases_per_task,) * full + ((remainder,) if remainder else ())

    def case_numbers(self, task: int) -> range:
        """Numbers of the cases of one task."""
        first = task * self.cases_per_task
        return range(first, min(first + self.cases_per_task, self.count))

    @cached_property
    def document(self) -> dict[str, Any]:
        """Plain data of everything that determines the table: session, fields and version."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        del fields["session"]
        document = {"kind": self.kind, "orthocal": __version__}
        document |= {**_session_record(self.session), **fields}
        document_as_json: dict[str, Any] = json.loads(
            json.dumps(document, default=attrgetter("document"))
        )
        return document_as_json

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the document."""
        # in its order: that of setups and gauges decides on random numbers and units
        text = json.dumps(self.document, allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Study) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)


def _session_record(session: Session) -> dict[str, Any]:
    """Plain data of a session, without the paths of its files."""
    covariances = {
        n: cast(Points, s.sensor).covariance for n, s in session.setups.items() if is_of_row(n)
    }
    rows = "\n".join(
        f"{r.setup},{r.posture},{r.minus or ''},{r.cycle},{r.value!r}"
        + (f",{r.conditions}" if r.conditions else "")
        + (f",{covariances[r.setup]}" if r.setup in covariances else "")
        for r in session.readings
    )
    tables = session_tables(session)
    return {
        "robot": {"name": session.robot.name, "sha256": session.robot.sha256},
        "session": {**session_document(session), "robot": session.robot.name},
        "readings": hashlib.sha256(rows.encode()).hexdigest(),
        **{name: hashlib.sha256(text.encode()).hexdigest() for name, text in tables.items()},
    }


def run_task(study: Study, task: int) -> dict[str, list[Cell]]:
    """Compute the rows of one task as they are stored, on one thread and with rounded numbers."""
    with one_thread():
        columns = study.run(prepare_once(study), task)
    return {name: _round_column(cells) for name, cells in columns.items()}


def require_counts(**counts: int) -> None:
    """Refuse numbers of cases that are not whole numbers of at least 1.

    Raises:
        ParameterError: Naming the argument.
    """
    for name, count in counts.items():
        if isinstance(count, bool) or not isinstance(count, Integral) or count < 1:
            raise ParameterError(
                f"found {count!r}; expected a whole number of at least 1", where=name
            )


@lru_cache(maxsize=1)
def prepare_once(study: Study) -> Any:  # noqa: ANN401 - as `prepare`
    """Data shared by all tasks of a study, prepared once in this process."""
    return study.prepare()


def columns_in_edge_units(
    prefix: str, problem: CalibrationProblem, values: Array
) -> dict[str, Sequence[float]]:
    """Columns of parameters in the units that users read, which are a suffix of the names.

    Args:
        prefix: Start of each column's name.
        problem: The problem.
        values: Values, shape (n_sets, n_machine), [SI].
    """
    return {
        f"{prefix}{p.name}_{p.edge_unit}": list(values[:, i] * p.edge_factor)
        for i, p in enumerate(problem.machine_selection.parameters)
    }


def _round_column(cells: Sequence[Cell]) -> list[Cell]:
    """Cells as they are stored; see `round_cell`."""
    values = np.asarray(cells) if len(cells) and type(cells[0]) is np.float64 else None
    if values is None or values.dtype != np.float64:
        return [round_cell(v) for v in cells]
    # one format operation needs half the time of a loop
    text = f"%.{DIGITS - 1}e " * len(values) % tuple(values.tolist())
    return [None if number == "nan" else float(number) + 0.0 for number in text.split()]


def round_cell(value: object) -> Cell:
    """Cell as it is stored: numbers with `DIGITS` significant digits, None for NaN."""
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    number = float(value)  # type: ignore[arg-type] # the other kinds are numbers
    return None if number != number else float(f"{number:.{DIGITS - 1}e}") + 0.0
