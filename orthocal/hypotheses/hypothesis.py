"""Families of hypotheses about rows of a session: corrections, effects and machine shifts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias, TypeVar

import numpy as np

from orthocal.arrays import Array, Indices, Mask
from orthocal.hypotheses.anomaly import Explanation, Scope
from orthocal.observation.gauge_noise import assumed_sigma
from orthocal.robot.parameters import Parameter
from orthocal.sensors.protocol import reads_pairs, states_readings
from orthocal.session.session import Gauge, Session

Key = TypeVar("Key")
Sparse: TypeAlias = Any
"""A scipy.sparse.csr_array, which has no type stubs; an ordinary array for few columns."""

MAX_DENSE_COLUMNS = 64
"""Most columns of a matrix that is stored as an ordinary array, without importing SciPy."""


@dataclass(frozen=True, slots=True, eq=False)
class Tails:
    """Patterns that equal a base vector from some row of a segment on, and are 0 before.

    Products with all patterns follow from cumulative sums, in memory linear in the rows.
    """

    segments: Sequence[tuple[Indices, Array]]
    """Rows of each segment in the order of measuring, and the base vector on them, [m]."""
    segment: Indices
    """Segment of each pattern, ascending, shape (h,)."""
    start: Indices
    """Place in the segment from which on each pattern differs from 0, shape (h,)."""

    def select(self, chosen: slice) -> Tails:
        """Some of the patterns."""
        return Tails(self.segments, self.segment[chosen], self.start[chosen])

    def product(self, matrix: Array, *, power: int = 1) -> Array:
        """Matrix product of the element-wise powers of the patterns, shape (h, m).

        Args:
            matrix: Matrix over the rows, shape (n_rows, m).
            power: Exponent of the elements of the patterns.
        """
        result = np.empty((self.segment.size, matrix.shape[1]))
        for s in np.unique(self.segment):
            members = slice(*np.searchsorted(self.segment, (s, s + 1)))
            rows, base = self.segments[s]
            products = base[::-1, None] ** power * matrix[rows[::-1]]
            result[members] = np.cumsum(products, axis=0)[::-1][self.start[members]]
        return result

    def smallest(self, values: Array) -> Array:
        """Smallest of the values (n_rows,) of the rows that each pattern changes, shape (h,)."""
        result = np.empty(self.segment.size)
        for s in np.unique(self.segment):
            members = self.segment == s
            rows, base = self.segments[s]
            changed = np.where(base != 0.0, values[rows], np.inf)
            result[members] = np.minimum.accumulate(changed[::-1])[::-1][self.start[members]]
        return result

    def to_sparse(self, count: int) -> Sparse:
        """Patterns as a sparse matrix, shape (h, count)."""
        rows = [self.segments[s][0][k:] for s, k in zip(self.segment, self.start, strict=True)]
        base = [self.segments[s][1][k:] for s, k in zip(self.segment, self.start, strict=True)]
        return sparse_rows(rows, base, count)


@dataclass(frozen=True, slots=True, eq=False)
class Patterns:
    """Vectors over the rows of a session, one per hypothesis: sum of a sparse part and tails.

    No row of a pattern is nonzero in both parts.
    """

    rows: Sparse
    """Sparse part, shape (h, n_rows), [m]."""
    tails: Tails | None = None

    def select(self, chosen: slice) -> Patterns:
        """Some of the patterns."""
        tails = None if self.tails is None else self.tails.select(chosen)
        return Patterns(self.rows[chosen], tails)

    def product(self, matrix: Array) -> Array:
        """Matrix product of the patterns with a matrix (n_rows, m), shape (h, m)."""
        product = np.asarray(self.rows @ matrix)
        return product if self.tails is None else product + self.tails.product(matrix)

    def smallest(self, values: Array) -> Array:
        """Smallest of positive values of the rows that each pattern changes, shape (h,).

        Args:
            values: Values of the rows, shape (n_rows,).
        """
        if isinstance(self.rows, np.ndarray):
            smallest = np.where(self.rows != 0.0, values, np.inf).min(axis=1, initial=np.inf)
        else:
            inverse = (self.rows != 0.0).multiply(1.0 / values).max(axis=1)
            with np.errstate(divide="ignore"):
                smallest = 1.0 / np.asarray(inverse.toarray(), dtype=np.float64).ravel()
        if self.tails is not None:
            smallest = np.minimum(smallest, self.tails.smallest(values))
        return np.asarray(smallest)

    def to_sparse(self) -> Sparse:
        """All patterns as one sparse matrix, shape (h, n_rows)."""
        if self.tails is None:
            return self.rows
        return self.rows + self.tails.to_sparse(self.rows.shape[1])

    def one(self, index: int) -> Array:
        """One pattern, dense, shape (n_rows,), [m]."""
        dense: Array = to_dense(self.select(slice(index, index + 1)).to_sparse())[0]
        return dense


@dataclass(frozen=True, slots=True, eq=False)
class MachineShift:
    """Difference of the machine's errors in some of the readings."""

    entries: Mask
    """Mask of entries that the differing machine shows, shape (n_entries,)."""
    direction: Array
    """Difference of the free parameters, shape (n_free,), [prior std]; per unit of an unknown
    amount."""
    unit: float = 1.0
    """Unit of the amount, [SI]."""


@dataclass(frozen=True, slots=True, eq=False)
class SystematicEffect:
    """Effect of the machine or its gauges that the model lacks, to first order."""

    name: str
    parameters: tuple[Parameter, ...]
    """Parameters of the effect, shape (k,)."""
    change: Array
    """Change of the rows by the nominal effect (all parameters 0), shape (n_rows,), [m]."""
    columns: Array
    """Change of the rows by one prior std of each parameter, shape (k, n_rows), [m]."""

    @property
    def prior_stds(self) -> Array:
        """Prior standard deviation of each parameter, shape (k,), [SI]."""
        return np.array([p.prior_std for p in self.parameters])

    @property
    def positive(self) -> Mask:
        """Mask of parameters that are never negative, shape (k,)."""
        return np.array([p.positive for p in self.parameters], dtype=bool)

    def select(self, chosen: Mask) -> SystematicEffect:
        """Effect with some of its parameters."""
        parameters = tuple(p for p, c in zip(self.parameters, chosen, strict=True) if c)
        return SystematicEffect(self.name, parameters, self.change, self.columns[chosen])


@dataclass(frozen=True, slots=True, eq=False)
class Family:
    """Hypotheses of one kind, which share a prior probability equally; there may be none.

    Each hypothesis is one of these:

    - a change of rows by known amounts (`edits`), an effect of unknown amount (`effects`), or both;
    - several effects with independent amounts (`groups`), or those of a machine (`systematic`);
    - rows without information (`silent`);
    - a change of the machine between readings (`shifts`), by a known or an unknown amount.
    """

    explain: Callable[[int], Explanation]
    """Explanation of hypothesis number h, without its amount."""
    count: int
    size: float
    """Number of possible mistakes of this kind, tested or not."""
    edits: Patterns | None = None
    """Corrections of the rows, [m]."""
    effects: Patterns | None = None
    """Effects on the rows per unit of an unknown amount."""
    log_volume: Array | None = None
    """Logarithm of the factor by which an edit scales a volume of readings, or of the probability
    density of the values in silent rows, shape (h,)."""
    groups: Sequence[Sequence[Indices] | Array] = ()
    """Several effects per hypothesis: rows that each effect changes equally, or changes of the rows
    per unit, shape (k, n_rows)."""
    systematic: Sequence[SystematicEffect] = ()
    """Effects that the machine may have."""
    silent: Sequence[Indices] = ()
    """Rows without information, per hypothesis."""
    shifts: Sequence[MachineShift] = ()
    known: bool = True
    """Whether the amounts of `shifts` are known."""

    @classmethod
    def of(cls, explanations: Sequence[Explanation], **fields: Any) -> Family:  # noqa: ANN401 - own
        """Family of listed explanations; its size is their number by default."""
        count = len(explanations)
        return cls(explanations.__getitem__, count, **{"size": count} | fields)

    @classmethod
    def edited(
        cls,
        rows: Rows,
        explanations: Sequence[Explanation],
        changes: Sequence[Array],
        *,
        size: int | None = None,
        log_volume: Array | None = None,
    ) -> Family:
        """Family of explanations that correct their rows by known changes, [m]."""
        edits = Patterns(sparse_rows([e.rows for e in explanations], changes, rows.count))
        size = len(explanations) if size is None else size
        return cls.of(explanations, size=size, edits=edits, log_volume=log_volume)

    @classmethod
    def with_effects(
        cls, rows: Rows, explanations: Sequence[Explanation], shapes: Sequence[Array] | None = None
    ) -> Family:
        """Family of explanations whose rows are wrong by an unknown amount times a shape."""
        shapes = [np.ones(len(e.rows)) for e in explanations] if shapes is None else shapes
        effects = Patterns(sparse_rows([e.rows for e in explanations], shapes, rows.count))
        return cls.of(explanations, effects=effects)


class Rows:
    """Rows of a session by setup, cycle and posture.

    Args:
        session: The session.
        values: Readings, shape (n_rows,), [m]; those of the session by default.
    """

    def __init__(self, session: Session, values: Array | None = None) -> None:
        self.session = session
        self.values = session.values if values is None else values
        self.count = len(session.readings)
        self.single = np.array([not session.is_difference(r) for r in session.readings], dtype=bool)
        """Mask of rows that are single readings, not differences, shape (n_rows,)."""
        sensors = {name: setup.sensor for name, setup in session.setups.items()}
        self.paired = np.array([reads_pairs(sensors[r.setup]) for r in session.readings], bool)
        """Mask of rows that are distances between two postures, not read on a dial, (n_rows,)."""
        prescribed = [states_readings(sensors[r.setup]) for r in session.readings]
        self.written = ~np.array(prescribed, bool)
        """Mask of rows whose number somebody read and wrote, unlike triggers, (n_rows,)."""

    @cached_property
    def setups(self) -> dict[str, Indices]:
        """Rows of each setup, in the order of the file."""
        return group_rows(r.setup for r in self.session.readings)

    @cached_property
    def cycles(self) -> dict[tuple[str, int], Indices]:
        """Rows of each setup and cycle, in the order of the file."""
        return group_rows((r.setup, r.cycle) for r in self.session.readings)

    @cached_property
    def repeated(self) -> dict[tuple[str, str, str | None, str | None], Indices]:
        """Rows of each setup, posture (or difference) and approach, in all cycles."""
        return group_rows(r.place for r in self.session.readings)

    @cached_property
    def groups(self) -> dict[tuple[Scope, str], tuple[str, ...]]:
        """Setups of each leg and of each gauge with several but not all setups."""
        members: dict[tuple[Scope, str], list[str]] = {}
        for name in self.setups:
            setup = self.session.setups[name]
            leg = getattr(setup.sensor, "leg", None)
            if isinstance(leg, str):
                members.setdefault(("leg", leg), []).append(name)
            if len(self.session.gauges) > 1:
                members.setdefault(("gauge", setup.gauge), []).append(name)
        return {k: tuple(v) for k, v in members.items() if 1 < len(v) < len(self.setups)}

    def of_setups(self, setups: Sequence[str]) -> Indices:
        """Rows of some setups."""
        return np.concatenate([self.setups[name] for name in setups])

    def gauge(self, row: int) -> Gauge:
        """Gauge of a row."""
        return self.session.gauges[self.session.setups[self.session.readings[row].setup].gauge]

    def sigma(self, row: int) -> float:
        """Standard deviation of a reading of a row's gauge, as stated or assumed, [m]."""
        return assumed_sigma(self.gauge(row))

    def posture(self, row: int) -> str:
        """Name of the posture of a row, or of the difference of two postures."""
        return self.session.readings[row].postures


def group_rows(keys: Iterable[Key]) -> dict[Key, Indices]:
    """Indices of the rows of each key, ascending, from the keys of all rows."""
    by_key: dict[Key, list[int]] = {}
    for i, key in enumerate(keys):
        by_key.setdefault(key, []).append(i)
    return {key: np.array(rows) for key, rows in by_key.items()}


def sparse_rows(
    rows: Sequence[Indices | Sequence[int]], values: Sequence[Array], count: int
) -> Sparse:
    """Sparse matrix from the columns and values of each row, shape (len(rows), count)."""
    sizes = np.array([len(r) for r in rows], dtype=np.int64)
    columns = np.concatenate([*rows, np.empty(0, dtype=np.int64)]).astype(np.int64)
    data = np.concatenate([*values, np.empty(0)]).astype(np.float64)
    if count <= MAX_DENSE_COLUMNS:
        dense = np.zeros((len(rows), count))
        np.add.at(dense, (np.repeat(np.arange(len(rows)), sizes), columns), data)
        return dense
    from scipy.sparse import csr_array

    return csr_array((data, columns, np.concatenate([[0], np.cumsum(sizes)])), (len(rows), count))


def to_dense(matrix: Sparse) -> Array:
    """Ordinary array of a matrix."""
    return np.asarray(matrix if isinstance(matrix, np.ndarray) else matrix.toarray())


def row_products(one: Sparse, other: Sparse) -> Array:
    """Row-wise inner products of two matrices that are both dense or both sparse."""
    if isinstance(one, np.ndarray):
        return np.asarray(np.vecdot(one, other))
    return np.asarray(one.multiply(other).sum(axis=1)).ravel()
