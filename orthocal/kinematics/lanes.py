"""Functions of CasADi run over many points at once, where numba is installed.

A function of scalar expressions is a list of instructions, which CasADi's virtual machine works
through for one point after another. Here one small interpreter, compiled by numba, takes each
instruction for a lane of points: the same operations in the same order, hence the same numbers, in
a quarter of the time. Importing numba takes about a second, so it is done once as much has been
spent in CasADi's machine (`Way.AUTO`).
"""

from __future__ import annotations

import enum
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocal import cache

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

LANE = 32
"""Points that an instruction is taken for at once."""

FEWEST = 8
"""Points below which a lane is not worth filling."""

PATIENCE = 400e6
"""Instructions, each for a point, that take CasADi's machine as long as numba takes to import."""

_OPERATIONS = (
    *("CONST", "INPUT", "OUTPUT", "ASSIGN", "ADD", "SUB", "MUL", "DIV", "NEG", "SQ", "TWICE"),
    *("INV", "SQRT", "SIN", "COS", "TAN", "ASIN", "ACOS", "ATAN", "ATAN2", "FABS", "LT", "LE"),
    *("EQ", "NE", "NOT", "AND", "OR", "IF_ELSE_ZERO", "SIGN"),
)
_CODE = {getattr(ca, f"OP_{name}"): code for code, name in enumerate(_OPERATIONS)}
_SOURCES = (_CODE[ca.OP_CONST], _CODE[ca.OP_INPUT])
_OUTPUT = _CODE[ca.OP_OUTPUT]


class Way(enum.Enum):
    """How functions are run."""

    AUTO = "auto"
    """By numba where it is installed and pays."""
    CASADI = "casadi"
    NUMBA = "numba"
    """By numba from the first point on; an error where it is not installed."""


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


def pays(instructions: int, points: int) -> bool:
    """Whether a function should be run by numba; keeps count of what CasADi's machine does."""
    global _spent
    if _chosen is not Way.AUTO:
        return _chosen is Way.NUMBA
    if points < FEWEST or not is_installed():
        return False
    _spent += float(instructions) * points
    return _spent > PATIENCE


Compiled = Any
"""Arrays as numba compiles for them."""


@lru_cache(maxsize=1)
def is_installed() -> bool:
    """Whether there is numba."""
    return find_spec("numba") is not None


@dataclass(frozen=True, slots=True, eq=False)
class Listing:
    """The instructions of a function."""

    table: NDArray[np.int32]
    """Code, result, first and second operand, shape (n_instructions, 4)."""
    constants: Array
    """Shape (n_instructions,): 0 where an instruction is no constant."""
    n_work: int
    first_in: Indices
    """Where each input begins among all, shape (n_in + 1,)."""
    first_out: Indices
    """Where each output begins among all, shape (n_out + 1,)."""


def list_instructions(function: ca.Function) -> Listing | None:
    """The instructions of a function; None where one of them is not known here."""
    count = function.n_instructions()
    first_in = np.cumsum([0, *(function.nnz_in(i) for i in range(function.n_in()))])
    first_out = np.cumsum([0, *(function.nnz_out(i) for i in range(function.n_out()))])
    table, constants = np.zeros((count, 4), dtype=np.int32), np.zeros(count)
    for k in range(count):
        operation = function.instruction_id(k)
        if operation not in _CODE:
            return None
        taken, given = function.instruction_input(k), function.instruction_output(k)
        table[k, 0] = _CODE[operation]
        if operation == ca.OP_CONST:
            constants[k] = function.instruction_constant(k)
            table[k, 1] = given[0]
        elif operation == ca.OP_INPUT:
            table[k, 1:3] = given[0], first_in[taken[0]] + taken[1]
        elif operation == ca.OP_OUTPUT:
            table[k, 1:3] = first_out[given[0]] + given[1], taken[0]
        else:
            table[k, 1:4] = given[0], taken[0], taken[-1]
    return Listing(table, constants, _keep_apart(table), first_in, first_out)


def _keep_apart(table: NDArray[np.int32]) -> int:
    """Give each result a place that none of its operands has, for vector instructions.

    Returns:
        Number of places.
    """
    count, codes = len(table), table[:, 0]
    makes = codes != _OUTPUT
    takes = [[] if c in _SOURCES else [2] if c == _OUTPUT else [2, 3] for c in codes.tolist()]
    holder: dict[int, int] = {}
    values = np.full((count, 4), -1)
    last = np.full(count, -1)
    for k in range(count):
        for column in takes[k]:
            values[k, column] = holder[int(table[k, column])]
            last[values[k, column]] = k
        if makes[k]:
            holder[int(table[k, 1])] = k
    place, n_places = np.full(count, -1), 0
    free: list[int] = []
    for k in range(count):
        operands = {int(values[k, column]) for column in takes[k]}
        for column in takes[k]:
            table[k, column] = place[values[k, column]]
        if makes[k]:
            if not free:
                free.append(n_places)
                n_places += 1
            place[k] = table[k, 1] = free.pop()
            if last[k] < 0:
                free.append(int(place[k]))
        free.extend(int(place[v]) for v in operands if last[v] == k)
    return n_places


class LaneFunction:
    """A function run by numba.

    Args:
        listing: Its instructions.
        shared: Inputs that are the same at every point, by their index.
    """

    def __init__(self, listing: Listing, shared: Sequence[int]) -> None:
        self._listing = listing
        n = int(listing.first_in[-1])
        self._is_shared = np.zeros(n, dtype=np.bool_)
        for i in shared:
            self._is_shared[listing.first_in[i] : listing.first_in[i + 1]] = True
        self._place = np.zeros(n, dtype=np.int64)
        self._place[self._is_shared] = np.arange(int(self._is_shared.sum()))
        self._place[~self._is_shared] = np.arange(int((~self._is_shared).sum()))

    def __call__(self, inputs: Sequence[Array], shared: Sequence[int], count: int) -> list[Array]:
        """Evaluate at points.

        Args:
            inputs: Shape (count, n) each, or (n,) for the shared ones.
            shared: Their indices.
            count: Number of points.

        Returns:
            Nonzeros of each output, shape (count, nnz).
        """
        listing = self._listing
        own = [a.reshape(count, -1) for i, a in enumerate(inputs) if i not in shared]
        common = [inputs[i].reshape(-1) for i in shared]
        x = np.concatenate(own, axis=1) if own else np.zeros((count, 0))
        p = np.concatenate(common) if common else np.zeros(0)
        result = np.empty((count, int(listing.first_out[-1])))
        _interpreter()(
            listing.table,
            listing.constants,
            listing.n_work,
            LANE,
            self._is_shared,
            self._place,
            x,
            p,
            result,
        )
        return [
            result[:, a:b] for a, b in zip(listing.first_out, listing.first_out[1:], strict=False)
        ]


@lru_cache(maxsize=1)
def _interpreter() -> Callable[..., None]:
    """The interpreter, compiled; kept in a folder of the user's own where there is one."""
    import numba

    folder = cache.private_folder("numba")
    if folder is not None and "NUMBA_CACHE_DIR" not in os.environ:
        numba.config.CACHE_DIR = str(folder)
    keep = folder is not None
    run: Callable[..., None] = numba.njit(cache=keep, nogil=True, error_model="numpy")(_run)
    return run


def _run(
    table: Compiled,
    constants: Compiled,
    n_work: int,
    width: int,
    is_shared: Compiled,
    place: Compiled,
    x: Compiled,
    p: Compiled,
    result: Compiled,
) -> None:
    """Take each instruction for a lane of points; the codes are those of _OPERATIONS."""
    work, shown = np.zeros((n_work, width)), np.zeros((result.shape[1], width))
    count = x.shape[0]
    for first in range(0, count, width):
        size = min(width, count - first)
        for k in range(table.shape[0]):
            code, to, i, j = table[k, 0], table[k, 1], table[k, 2], table[k, 3]
            if code == 2:
                for lane in range(width):
                    shown[to, lane] = work[i, lane]
                continue
            if code == 1:
                if is_shared[i]:
                    value = p[place[i]]
                    for lane in range(width):
                        work[to, lane] = value
                else:
                    column = place[i]
                    for lane in range(size):
                        work[to, lane] = x[first + lane, column]
                continue
            if code == 0:
                value = constants[k]
                for lane in range(width):
                    work[to, lane] = value
                continue
            if code == 6:
                for lane in range(width):
                    work[to, lane] = work[i, lane] * work[j, lane]
            elif code == 4:
                for lane in range(width):
                    work[to, lane] = work[i, lane] + work[j, lane]
            elif code == 5:
                for lane in range(width):
                    work[to, lane] = work[i, lane] - work[j, lane]
            elif code == 8:
                for lane in range(width):
                    work[to, lane] = -work[i, lane]
            elif code == 28:
                for lane in range(width):
                    work[to, lane] = work[j, lane] if work[i, lane] != 0.0 else 0.0
            elif code == 9:
                for lane in range(width):
                    work[to, lane] = work[i, lane] * work[i, lane]
            elif code == 7:
                for lane in range(width):
                    work[to, lane] = work[i, lane] / work[j, lane]
            elif code == 10:
                for lane in range(width):
                    work[to, lane] = 2.0 * work[i, lane]
            elif code == 11:
                for lane in range(width):
                    work[to, lane] = 1.0 / work[i, lane]
            elif code == 3:
                for lane in range(width):
                    work[to, lane] = work[i, lane]
            elif code == 12:
                for lane in range(width):
                    work[to, lane] = np.sqrt(work[i, lane])
            elif code == 13:
                for lane in range(width):
                    work[to, lane] = np.sin(work[i, lane])
            elif code == 14:
                for lane in range(width):
                    work[to, lane] = np.cos(work[i, lane])
            elif code == 15:
                for lane in range(width):
                    work[to, lane] = np.tan(work[i, lane])
            elif code == 16:
                for lane in range(width):
                    work[to, lane] = np.arcsin(work[i, lane])
            elif code == 17:
                for lane in range(width):
                    work[to, lane] = np.arccos(work[i, lane])
            elif code == 18:
                for lane in range(width):
                    work[to, lane] = np.arctan(work[i, lane])
            elif code == 19:
                for lane in range(width):
                    work[to, lane] = np.arctan2(work[i, lane], work[j, lane])
            elif code == 20:
                for lane in range(width):
                    work[to, lane] = abs(work[i, lane])
            elif code == 21:
                for lane in range(width):
                    work[to, lane] = 1.0 if work[i, lane] < work[j, lane] else 0.0
            elif code == 22:
                for lane in range(width):
                    work[to, lane] = 1.0 if work[i, lane] <= work[j, lane] else 0.0
            elif code == 23:
                for lane in range(width):
                    work[to, lane] = 1.0 if work[i, lane] == work[j, lane] else 0.0
            elif code == 24:
                for lane in range(width):
                    work[to, lane] = 1.0 if work[i, lane] != work[j, lane] else 0.0
            elif code == 25:
                for lane in range(width):
                    work[to, lane] = 1.0 if work[i, lane] == 0.0 else 0.0
            elif code == 26:
                for lane in range(width):
                    work[to, lane] = 1.0 if work[i, lane] != 0.0 and work[j, lane] != 0.0 else 0.0
            elif code == 27:
                for lane in range(width):
                    work[to, lane] = 1.0 if work[i, lane] != 0.0 or work[j, lane] != 0.0 else 0.0
            elif code == 29:
                for lane in range(width):
                    value = work[i, lane]
                    work[to, lane] = -1.0 if value < 0.0 else 1.0 if value > 0.0 else value
        for lane in range(size):
            for to in range(result.shape[1]):
                result[first + lane, to] = shown[to, lane]
