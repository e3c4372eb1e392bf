"""Evaluation of one CasADi function at many points, straight from and into NumPy arrays."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthocal.kinematics.backend.lanes import (
    Listing,
    find_listing,
    pays,
    recall_listing,
    run_in_lanes,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SIZES = (32, 8, 1)
"""Points evaluated in one call, the largest first: few maps are built, and what they read and write
stays near."""


class BatchFunction:
    """A CasADi function of column vectors, mapped over points.

    CasADi's own conversion of results goes through Python lists; its buffers do not.

    Args:
        function: Inputs are column vectors; outputs are taken dense.
        shared: Names of the inputs that are the same at every point.
        matrices: Names of the outputs that are matrices, though they may have one column.
        sparse: Names of the outputs of which the nonzeros are taken, in the order of `pattern`.
    """

    def __init__(
        self,
        function: ca.Function,
        *,
        shared: Sequence[str] = (),
        matrices: Sequence[str] = (),
        sparse: Sequence[str] = (),
    ) -> None:
        self._function = dense(function, sparse=sparse)
        self._shared = [function.index_in(name) for name in shared]
        self._sparse = frozenset(sparse)
        self._shapes = [
            (function.nnz_out(i), 1) if name in self._sparse else function.size_out(i)
            for i, name in enumerate(function.name_out())
        ]
        self._sizes = [rows * columns for rows, columns in self._shapes]
        self._matrices = [function.index_out(name) for name in matrices]
        self._local = threading.local()
        self._points = 0
        self._same: BatchFunction | None = None

    @cached_property
    def unshared(self) -> BatchFunction:
        """The same with inputs of their own at every point.

        Their shape is (K, n), or (K / m, n) for a row that stands for m points in turn.
        """
        names = [self._function.name_out(i) for i in self._matrices]
        found = BatchFunction(self._function, matrices=names, sparse=tuple(self._sparse))
        found._same = self
        return found

    @cached_property
    def _instructions(self) -> int:
        return int(self._function.n_instructions())

    def pattern(self, name: str) -> tuple[Indices, Indices]:
        """Rows and columns of the nonzeros of a sparse output, shape (nnz,) each."""
        sparsity = self._function.sparsity_out(self._function.index_out(name))
        rows, columns = (np.array(v, dtype=np.int64) for v in sparsity.get_triplet())
        return rows, columns

    def __call__(self, *inputs: ArrayLike) -> tuple[Array, ...]:
        """Evaluate at K points.

        Args:
            inputs: Shape (K, n) each, or (n,) for the shared ones.

        Returns:
            Each output with shape (K, rows, columns), or (K, rows) for a column vector; `matrices`
            keep their one column; sparse ones have shape (K, nnz).
        """
        arrays = [np.asarray(a, dtype=np.float64) for a in inputs]
        count = max(len(a) for i, a in enumerate(arrays) if i not in self._shared)
        flat = None
        if pays(self._instructions, count, self._points, lambda: self._kept is not None):
            listing = self._listing
            flat = None if listing is None else run_in_lanes(listing, arrays, self._shared, count)
        self._points += count
        if flat is None:
            flat = self._by_casadi(arrays, count)
        results = [y.reshape(count, c, r) for y, (r, c) in zip(flat, self._shapes, strict=True)]
        return tuple(
            np.asarray(
                y[:, 0, :] if shape[1] == 1 and i not in self._matrices else y.transpose(0, 2, 1)
            )
            for i, (y, shape) in enumerate(zip(results, self._shapes, strict=True))
        )

    @cached_property
    def _kept(self) -> Listing | None:
        """Its instructions, where they are kept on disk."""
        return recall_listing(self._function) if self._same is None else self._same._kept

    @cached_property
    def _listing(self) -> Listing | None:
        """Its instructions; None where one of them is not known."""
        if self._same is not None:
            return self._same._listing
        return self._kept or find_listing(self._function)

    def _by_casadi(self, arrays: list[Array], count: int) -> list[Array]:
        """Nonzeros of each output, shape (count, nnz)."""
        flat = [np.empty((count, size)) for size in self._sizes]
        first = 0
        for size in SIZES:
            if count - first < size:
                continue
            lanes = self._lanes(size)
            lanes.share({i: arrays[i] for i in self._shared})
            own = [
                (i, a if len(a) == count else np.repeat(a, count // len(a), axis=0))
                for i, a in enumerate(arrays)
                if i not in self._shared
            ]
            while count - first >= size:
                part = slice(first, first + size)
                for i, a in own:
                    lanes.inputs[i][...] = a[part]
                lanes.trigger()
                for found, y in zip(lanes.outputs, flat, strict=True):
                    y[part] = found
                first += size
        return flat

    def _lanes(self, size: int) -> _Lanes:
        """So many points at once; memory of their own for each thread."""
        if not hasattr(self._local, "lanes"):
            self._local.lanes = {}
        lanes: dict[int, _Lanes] = self._local.lanes
        if size not in lanes:
            lanes[size] = _Lanes(self._function, size, self._shared)
        return lanes[size]


class _Lanes:
    """A function mapped over a number of points, with memory that it reads from and writes to."""

    def __init__(self, function: ca.Function, size: int, shared: list[int]) -> None:
        name = f"{function.name()}_{size}"
        mapped = function if size == 1 else function.map(name, "serial", size, shared, [])
        self._shared = shared
        self._buffer, self.trigger = mapped.buffer()
        self.inputs = [
            np.zeros((1 if i in shared else size, function.nnz_in(i)))
            for i in range(function.n_in())
        ]
        self.outputs = [np.zeros((size, function.nnz_out(i))) for i in range(function.n_out())]
        # casadi's type information describes the C++ call, with a pointer and a size
        for i, a in enumerate(self.inputs):
            self._buffer.set_arg(i, memoryview(a.reshape(-1)))  # type: ignore[call-arg,arg-type]
        for i, a in enumerate(self.outputs):
            self._buffer.set_res(i, memoryview(a.reshape(-1)))  # type: ignore[call-arg,arg-type]

    def share(self, values: dict[int, Array]) -> None:
        """Set the inputs that are the same at every point."""
        for i, value in values.items():
            self.inputs[i][0] = value


def dense(function: ca.Function, *, sparse: Sequence[str] = ()) -> ca.Function:
    """The same function with dense outputs, but for some."""
    names = function.name_out()
    if all(n in sparse or function.sparsity_out(i).is_dense() for i, n in enumerate(names)):
        return function
    symbols = [function.sx_in(i) for i in range(function.n_in())]
    found = function.call(symbols)
    outputs = [y if name in sparse else ca.densify(y) for name, y in zip(names, found, strict=True)]
    return ca.Function(function.name(), symbols, outputs, function.name_in(), names)
