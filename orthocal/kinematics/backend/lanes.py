"""Functions of CasADi run over many points at once, where LLVM is installed.

A function of scalar expressions is a list of instructions, which CasADi's virtual machine works
through for one point after another. Here an interpreter takes each instruction for a lane of points
(`interpreter`): the same operations in the same order, hence the same numbers, in a tenth of the
time. Making it takes a tenth of a second, and so does listing the instructions, so each is done
once as much has been spent in CasADi's machine (`Way.AUTO`), or once somebody expects many points.
"""

from __future__ import annotations

import enum
import hashlib
import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocal.kinematics.backend.interpreter import (
    LONG,
    OPERATIONS,
    SHORT,
    interpreter,
    is_installed,
)
from orthocal.kinematics.function_cache import known_as
from orthocal.runtime import disk_cache as cache

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

FEWEST = 3
"""Points below which a lane is not worth filling."""

PATIENCE = 60e6
"""Instructions, each for a point, that CasADi's machine does first, where no more are expected."""

POINTS = 500
"""Of one function that was never listed, which take CasADi's machine as long as to list it."""

FEWEST_KEPT = 1000
"""Instructions of a function for which they are kept on disk: fewer are listed as soon."""

_CODE = {getattr(ca, f"OP_{name}"): code for code, name in enumerate(OPERATIONS)}


class Way(enum.Enum):
    """How functions are run."""

    AUTO = "auto"
    """By LLVM where it is installed and pays."""
    CASADI = "casadi"
    LLVM = "llvm"
    """By LLVM from the first point on; an error where it is not installed."""


_chosen = Way.AUTO
_spent = 0.0


@contextmanager
def running(way: Way) -> Iterator[None]:
    """Run functions one way within the block."""
    global _chosen
    before, _chosen = _chosen, way
    try:
        yield
    finally:
        _chosen = before


def expect_many() -> None:
    """Have the interpreter ready: many points are to come."""
    global _spent
    if _chosen is Way.AUTO and is_installed() and interpreter(LONG) is not None:
        _spent = max(_spent, PATIENCE)


def pays(
    instructions: int, points: int, before: int, is_listed: Callable[[], bool] = lambda: False
) -> bool:
    """Whether a function should be run in lanes; keeps count of what CasADi's machine does.

    Args:
        instructions: Of the function.
        points: How many it is to be evaluated at.
        before: At how many it was before.
        is_listed: Whether its instructions were listed before.
    """
    global _spent
    if _chosen is not Way.AUTO:
        return _chosen is Way.LLVM
    if points < FEWEST or not is_installed():
        return False
    _spent += float(instructions) * points
    return _spent > PATIENCE and (before + points > POINTS or is_listed())


@dataclass(frozen=True, eq=False)
class Listing:
    """The instructions of a function."""

    table: NDArray[np.int32]
    """Operation, result and two operands, as the interpreter has them, shape (n, 4)."""
    constants: Array
    """Shape (n,): 0 where an instruction is no constant."""
    n_work: int
    first_out: Indices
    """Where each output begins among all, shape (n_out + 1,)."""

    @cached_property
    def addresses(self) -> tuple[int, int]:
        """Of table and constants."""
        return self.table.ctypes.data, self.constants.ctypes.data

    @cached_property
    def ends(self) -> list[int]:
        """As `first_out`."""
        return list(self.first_out.tolist())


def find_listing(function: ca.Function) -> Listing | None:
    """The instructions of a function: as kept on disk, or listed and kept.

    None where one of them is not known here.
    """
    key = _key_of(function)
    found = None if key is None else _read(cache.load(key), function)
    if found is None and (found := list_instructions(function)) is not None and key is not None:
        arrays = found.table, found.constants, np.array(found.n_work), found.first_out
        cache.store(key, b"".join(a.tobytes() for a in arrays))
    return found


def recall_listing(function: ca.Function) -> Listing | None:
    """The instructions of a function as kept on disk; None where they are not."""
    key = _key_of(function)
    return None if key is None else _read(cache.load(key), function)


def _key_of(function: ca.Function) -> str | None:
    """By what its instructions are kept; None for what is not."""
    if function.n_instructions() < FEWEST_KEPT:
        return None
    name = known_as(function)
    if name is None:
        try:
            name = hashlib.sha256(function.serialize().encode()).hexdigest()
        except RuntimeError:  # some cannot be written
            return None
    return f"listing {name}\n{_CODE}"


def _read(content: bytes | None, function: ca.Function) -> Listing | None:
    """What was kept of a function's instructions."""
    n, outputs = function.n_instructions(), function.n_out()
    if content is None or len(content) != 24 * n + 8 * (outputs + 2):
        return None
    table, constants, rest = np.split(np.frombuffer(content, np.uint8), [16 * n, 24 * n])
    n_work, *first_out = rest.view(np.int64)
    return Listing(
        table.view(np.int32).reshape(n, 4),
        constants.view(np.float64),
        int(n_work),
        np.array(first_out, dtype=np.int64),
    )


def list_instructions(function: ca.Function) -> Listing | None:
    """The instructions of a function; None where one of them is not known here."""
    count = function.n_instructions()
    first_out = np.cumsum([0, *(function.nnz_out(i) for i in range(function.n_out()))])
    starts = first_out.tolist()
    rows, constants = [], np.zeros(count)
    for k in range(count):
        operation = function.instruction_id(k)
        code = _CODE.get(operation)
        if code is None:
            return None
        given = function.instruction_output(k)
        if operation == ca.OP_CONST:
            constants[k] = function.instruction_constant(k)
            rows.append((code, given[0], 0, 0))
        elif operation == ca.OP_OUTPUT:
            taken = function.instruction_input(k)
            rows.append((code, starts[given[0]] + given[1], taken[0], 0))
        else:
            taken = function.instruction_input(k)
            rows.append((code, given[0], taken[0], taken[-1]))
    table = np.array(rows, dtype=np.int32).reshape(-1, 4)
    return Listing(table, constants, int(function.sz_w()) + 1, first_out)


def run_in_lanes(
    listing: Listing, inputs: Sequence[Array], shared: Sequence[int], count: int
) -> list[Array] | None:
    """Evaluate a function at points.

    Args:
        listing: Its instructions.
        inputs: Shape (n_rows, n) each, whose rows stand for as many points in turn, or (n,) for
            the shared ones.
        shared: Their indices.
        count: Number of points.

    Returns:
        Nonzeros of each output, shape (count, nnz); None where there is no interpreter.
    """
    lane = SHORT if count <= SHORT else LONG
    run = interpreter(lane)
    if run is None:
        return None
    arrays = [np.ascontiguousarray(a) for a in inputs]
    rows = [(0, 1) if i in shared else (a.shape[1], len(a)) for i, a in enumerate(arrays)]
    points = max(count, 1)
    # where each input is, how far it is from row to row, and how many points share one
    told = [a.ctypes.data for a in arrays]
    told += [stride for stride, _ in rows] + [points // max(size, 1) for _, size in rows]
    given, size = np.array(told, dtype=np.int64), 8 * len(arrays)
    ends = listing.ends
    result, work = np.empty((count, ends[-1])), np.empty((listing.n_work, lane))
    if count:
        table, constants = listing.addresses
        where = given.ctypes.data
        of_inputs = (where, where + size, where + 2 * size, len(arrays))
        own = (result.ctypes.data, ends[-1], work.ctypes.data)
        run(table, len(listing.table), constants, *of_inputs, count, *own)
    return [result[:, a:b] for a, b in itertools.pairwise(ends)]
