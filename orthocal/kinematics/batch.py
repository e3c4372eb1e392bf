"""Evaluation of one CasADi function at many points, straight from and into NumPy arrays."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

CHUNK = 256
"""Points evaluated in one call; bounds the memory and the number of maps that are built."""


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
        self._matrices = [function.index_out(name) for name in matrices]
        self._maps: dict[int, ca.Function] = {}

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
        arrays = [np.ascontiguousarray(a, dtype=np.float64) for a in inputs]
        count = next(len(a) for i, a in enumerate(arrays) if i not in self._shared)
        results = [np.empty((count, c, r)) for r, c in self._shapes]
        for first in range(0, count, CHUNK):
            size = min(CHUNK, count - first)
            part = slice(first, first + size)
            buffer, trigger = self._map(size).buffer()
            held = [
                a if i in self._shared else np.ascontiguousarray(a[part])
                for i, a in enumerate(arrays)
            ]
            # casadi's type information describes the C++ call, with a pointer and a size
            for i, a in enumerate(held):
                buffer.set_arg(i, memoryview(a.reshape(-1)))  # type: ignore[call-arg,arg-type]
            for i, result in enumerate(results):
                buffer.set_res(i, memoryview(result[part].reshape(-1)))  # type: ignore[call-arg,arg-type]
            trigger()
        return tuple(
            np.asarray(
                y[:, 0, :] if shape[1] == 1 and i not in self._matrices else y.transpose(0, 2, 1)
            )
            for i, (y, shape) in enumerate(zip(results, self._shapes, strict=True))
        )

    def _map(self, size: int) -> ca.Function:
        if size == 1:
            return self._function
        if size not in self._maps:
            self._maps[size] = self._function.map(
                f"{self._function.name()}_{size}", "serial", size, self._shared, []
            )
        return self._maps[size]


def dense(function: ca.Function, *, sparse: Sequence[str] = ()) -> ca.Function:
    """The same function with dense outputs, but for some."""
    names = function.name_out()
    if all(n in sparse or function.sparsity_out(i).is_dense() for i, n in enumerate(names)):
        return function
    symbols = [function.sx_in(i) for i in range(function.n_in())]
    found = function.call(symbols)
    outputs = [
        y if name in sparse else ca.densify(y) for name, y in zip(names, found, strict=True)
    ]
    return ca.Function(function.name(), symbols, outputs, function.name_in(), names)
