"""Evaluation of one CasADi function at many points, on NumPy arrays."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from orthocal.arrays import Array, Indices
from orthocal.kinematics.backend import llvm
from orthocal.runtime import disk_cache

Backend = Literal["casadi", "llvm"]

LARGE_BLOCK, SMALL_BLOCK = 32, 8
"""Numbers of points of one call of a mapped CasADi function."""

CALL_COST = 2500
"""Overhead of a call, as the number of instructions that take as long."""

MIN_POINTS, MIN_OPERATIONS = 3, 2e3
"""Number of points, and points times instructions, from which a call uses the LLVM backend. Its
duration for 8 points is that of CasADi for two, and for 32 points that of CasADi for three. Each of
its interpreters starts in 0.02 s."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Outputs and size of a function, which suffice to run its instructions from disk."""

    n_instructions: int
    """Number of instructions of the function."""
    widths: Sequence[int]
    """Length of each input, which is a column vector."""
    names: Sequence[str]
    """Names of the outputs."""
    shapes: Sequence[tuple[int, int]]
    """Rows and columns of each output; the number of nonzeros and 1 for a sparse one."""
    patterns: Mapping[str, tuple[Sequence[int], Sequence[int]]]
    """Rows and columns of the nonzeros of each sparse output."""


class BatchFunction:
    """CasADi function of column vectors that is evaluated at many points.

    Both backends execute the same instructions in the same order and give identical numbers. The
    choice depends only on the function, the number of points and whether llvmlite is installed.

    Args:
        function: Function whose inputs are column vectors, or one that loads it. With a key a
            large function is loaded only if CasADi evaluates it, because loading it takes much
            longer than loading its instructions.
        matrices: Names of the outputs that are matrices even if they have one column.
        sparse: Names of the outputs whose nonzeros are returned, in the order of `patterns`. Other
            outputs are dense.
        key: Key of the function's layout and instructions on disk; not cached by default.
    """

    def __init__(
        self,
        function: ca.Function | Callable[[], ca.Function],
        *,
        matrices: Sequence[str] = (),
        sparse: Sequence[str] = (),
        key: str | None = None,
    ) -> None:
        self._source, self._key = function, key
        self._matrices, self._sparse = frozenset(matrices), tuple(sparse)
        self._local = threading.local()

    @cached_property
    def function(self) -> ca.Function:
        """The function, with dense outputs except the sparse ones."""
        source = self._source
        function = source if isinstance(source, ca.Function) else source()
        return _densified(function, sparse=self._sparse)

    @cached_property
    def layout(self) -> Layout:
        """Outputs of the function, from disk if the function is large."""
        key = f"layout {[f.name for f in fields(Layout)]} {self._sparse}\n{self._key}"
        content = None if self._key is None else disk_cache.load(key)
        if content is not None:
            return Layout(**json.loads(content))
        layout = _lay_out(self.function, sparse=self._sparse)
        if self._key is not None and layout.n_instructions >= llvm.MIN_CACHED:
            disk_cache.store(key, json.dumps(asdict(layout)).encode())
        return layout

    @cached_property
    def patterns(self) -> dict[str, tuple[Indices, Indices]]:
        """Rows and columns of the nonzeros of each sparse output, shape (nnz,) each, by name."""
        return {
            name: (np.array(rows, dtype=np.int64), np.array(columns, dtype=np.int64))
            for name, (rows, columns) in self.layout.patterns.items()
        }

    def __call__(self, *inputs: ArrayLike, backend: Backend | None = None) -> tuple[Array, ...]:
        """Evaluate the function at K points.

        Args:
            inputs: Shape (K, n) each; (K/m, n) if each row applies to m successive points, such as
                the postures of one machine; (n,) if one row applies to all.
            backend: The faster one by default. CasADi evaluates functions with an instruction that
                the LLVM backend lacks.

        Returns:
            Each output with shape (K, rows, columns). Column vectors that are not `matrices` have
            shape (K, rows), sparse outputs (K, nnz).

        Raises:
            ValueError: If the inputs do not have these shapes.
        """
        arrays = [np.atleast_2d(np.asarray(a, dtype=np.float64)) for a in inputs]
        count = self._count(arrays)
        if backend is None:
            large = count >= MIN_POINTS and self.layout.n_instructions * count >= MIN_OPERATIONS
            backend = "llvm" if large and llvm.is_installed() else "casadi"
        self._require_shapes(arrays, count)
        nonzeros = None
        if backend == "llvm" and self._program is not None:
            nonzeros = llvm.run(self._program, arrays, count)
        if nonzeros is None:
            nonzeros = self._run_casadi(arrays, count)
        results = []
        outputs = zip(nonzeros, self.layout.names, self.layout.shapes, strict=True)
        for values, name, (rows, columns) in outputs:
            matrix = values.reshape(count, columns, rows)
            column = columns == 1 and name not in self._matrices
            results.append(np.asarray(matrix[:, 0] if column else matrix.transpose(0, 2, 1)))
        return tuple(results)

    @staticmethod
    def _count(arrays: Sequence[Array]) -> int:
        """Number of points of inputs with two dimensions."""
        counts = [len(a) for a in arrays]
        return 0 if 0 in counts else max(counts, default=1)

    def _require_shapes(self, arrays: Sequence[Array], count: int) -> None:
        """Refuse inputs of other shapes, for which the LLVM backend would read beyond their memory.

        Raises:
            ValueError: If an input has another shape.
        """
        widths = self.layout.widths
        fit = [a.shape[1:] for a in arrays] == [(n,) for n in widths]
        if not fit or (count and any(count % len(a) for a in arrays)):
            shapes = ", ".join(str(a.shape) for a in arrays)
            raise ValueError(
                f"found inputs of the shapes {shapes}; expected {', '.join(map(str, widths))} "
                "columns, and numbers of rows that divide the largest one"
            )

    @cached_property
    def _program(self) -> llvm.Program | None:
        """Instructions of the function; None if the LLVM backend lacks one of them."""
        key = self._key if self.layout.n_instructions >= llvm.MIN_CACHED else None
        sizes = self.layout.n_instructions, len(self.layout.names)
        program = None if key is None else llvm.load_program(key, *sizes)
        if program is None:
            program = llvm.list_instructions(self.function)
            if program is not None and key is not None:
                llvm.store_program(key, program)
        return program

    def _run_casadi(self, arrays: Sequence[Array], count: int) -> list[Array]:
        """Nonzeros of each output, shape (count, nnz)."""
        results = [np.empty((count, rows * columns)) for rows, columns in self.layout.shapes]
        first = 0
        while first < count:
            size = self._block_size(count - first)
            block, end = self._block(size), min(first + size, count)
            points = np.minimum(np.arange(first, first + size), count - 1)
            for buffer, a in zip(block.inputs, arrays, strict=True):
                buffer[...] = a if len(a) == 1 else a[points // (count // len(a))]
            block.evaluate()
            for values, result in zip(block.outputs, results, strict=True):
                result[first:end] = values[: end - first]
            first = end
        return results

    def _block_size(self, count: int) -> int:
        """Number of points of the next call; more than the remaining ones if that saves calls."""
        if count >= LARGE_BLOCK:
            return LARGE_BLOCK
        surplus = (SMALL_BLOCK - count) * self.layout.n_instructions
        return SMALL_BLOCK if surplus <= (count - 1) * CALL_COST else 1

    def _block(self, size: int) -> _MappedBlock:
        """Function mapped over a number of points, with memory of this thread."""
        if not hasattr(self._local, "blocks"):
            self._local.blocks = {}
        blocks: dict[int, _MappedBlock] = self._local.blocks
        if size not in blocks:
            blocks[size] = _MappedBlock(self.function, size)
        return blocks[size]


class _MappedBlock:
    """Function mapped over a number of points, with its input and output memory.

    A usual call of CasADi converts results through Python lists. Buffers avoid this conversion.
    """

    def __init__(self, function: ca.Function, size: int) -> None:
        mapped = function if size == 1 else function.map(size)
        self._buffer, self.evaluate = mapped.buffer()
        self.inputs = [np.zeros((size, function.nnz_in(i))) for i in range(function.n_in())]
        self.outputs = [np.zeros((size, function.nnz_out(i))) for i in range(function.n_out())]
        # ignored: CasADi's type information describes the C++ call, with a pointer and a size
        for i, a in enumerate(self.inputs):
            self._buffer.set_arg(i, memoryview(a.reshape(-1)))  # type: ignore[call-arg,arg-type]
        for i, a in enumerate(self.outputs):
            self._buffer.set_res(i, memoryview(a.reshape(-1)))  # type: ignore[call-arg,arg-type]


def _lay_out(function: ca.Function, *, sparse: Sequence[str]) -> Layout:
    """Layout of a function with sparse outputs."""
    names = function.name_out()
    patterns = {name: function.sparsity_out(name).get_triplet() for name in sparse}
    return Layout(
        n_instructions=int(function.n_instructions()),
        widths=[function.nnz_in(i) for i in range(function.n_in())],
        names=names,
        shapes=[
            (function.nnz_out(name), 1) if name in sparse else function.size_out(name)
            for name in names
        ],
        patterns=patterns,
    )


def _densified(function: ca.Function, *, sparse: Sequence[str]) -> ca.Function:
    """Function with dense outputs, except the sparse ones."""
    names = function.name_out()
    if all(n in sparse or function.sparsity_out(i).is_dense() for i, n in enumerate(names)):
        return function
    symbols = [function.sx_in(i) for i in range(function.n_in())]
    values = function.call(symbols)
    outputs = [y if n in sparse else ca.densify(y) for n, y in zip(names, values, strict=True)]
    return ca.Function(function.name(), symbols, outputs, function.name_in(), names)
