"""Sparse matrices of expressions, summed from contributions at given positions."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]


class SparseSum:
    """Sums of contributions into the nonzeros of one sparse matrix or vector."""

    def __init__(self, n_rows: int, n_columns: int) -> None:
        self._shape = (n_rows, n_columns)
        self._rows: list[Indices] = []
        self._columns: list[Indices] = []
        self._values: list[ca.MX] = []

    def add(self, rows: Indices, columns: Indices, values: ca.MX) -> None:
        """Add values (a column vector) at positions."""
        self._rows.append(np.asarray(rows, dtype=np.int64).reshape(-1))
        self._columns.append(np.asarray(columns, dtype=np.int64).reshape(-1))
        self._values.append(values)

    def build(self) -> ca.MX:
        """The sparse matrix."""
        rows, columns = np.concatenate(self._rows), np.concatenate(self._columns)
        values = ca.vertcat(*self._values)
        keys = columns * self._shape[0] + rows  # order of compressed columns
        unique, position = np.unique(keys, return_inverse=True)
        sparsity = ca.Sparsity(
            *self._shape,
            _column_starts(unique // self._shape[0], self._shape[1]),
            (unique % self._shape[0]).tolist(),
        )
        if unique.size == keys.size:
            order = np.empty(keys.size, dtype=np.int64)
            order[position] = np.arange(keys.size)
            nonzeros = values[order.tolist()]
        else:
            summing = ca.Sparsity(
                unique.size, keys.size, list(range(keys.size + 1)), position.tolist()
            )
            nonzeros = ca.mtimes(ca.MX(ca.DM.ones(summing)), values)
        return ca.MX(sparsity, ca.densify(nonzeros))


def _column_starts(columns: Indices, count: int) -> list[int]:
    starts = np.zeros(count + 1, dtype=np.int64)
    np.cumsum(np.bincount(columns, minlength=count), out=starts[1:])
    return [int(v) for v in starts]
