"""LLVM backend, which executes CasADi functions for several points at once.

A CasADi function of scalar expressions is a list of instructions. An interpreter in machine code,
compiled by llvmlite for the present processor, executes each instruction for several points at
once. Its operations are those of CasADi's virtual machine in the same order. They are correctly
rounded or come from the C library. The numbers are therefore identical, in about a tenth of the
time.
"""

from __future__ import annotations

import ctypes
import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from orthocal.arrays import Array, Indices
from orthocal.runtime import disk_cache

LANES = (8, 16, 32)
"""Numbers of points for which an interpreter executes one instruction at once. An instruction takes
as long to read as to execute for about 16 points."""

MIN_CACHED = 1000
"""Smallest number of instructions of a function whose program is cached on disk."""

# y: result; a, b: operands; p, q, r: intermediate values; row: type of a vector of doubles
_COMPUTED = {
    "ASSIGN": "{y} = select i1 true, {row} {a}, {row} {a}",
    "ADD": "{y} = fadd {row} {a}, {b}",
    "SUB": "{y} = fsub {row} {a}, {b}",
    "MUL": "{y} = fmul {row} {a}, {b}",
    "DIV": "{y} = fdiv {row} {a}, {b}",
    "NEG": "{y} = fneg {row} {a}",
    "SQ": "{y} = fmul {row} {a}, {a}",
    "TWICE": "{y} = fadd {row} {a}, {a}",
    "INV": "{y} = fdiv {row} {one}, {a}",
    "SQRT": "{y} = call {row} @llvm.sqrt.v{lanes}f64({row} {a})",
    "FABS": "{y} = call {row} @llvm.fabs.v{lanes}f64({row} {a})",
    "IF_ELSE_ZERO": "{p} = fcmp une {row} {a}, {zero}\n{y} = select {flags} {p}, {row} {b}, "
    "{row} {zero}",
    "SIGN": "{p} = fcmp olt {row} {a}, {zero}\n{q} = fcmp ogt {row} {a}, {zero}\n"
    "{r} = select {flags} {q}, {row} {one}, {row} {a}\n"
    "{y} = select {flags} {p}, {row} {minus}, {row} {r}",
}
# p is the result as flags
_COMPARED = {
    "LT": "{p} = fcmp olt {row} {a}, {b}",
    "LE": "{p} = fcmp ole {row} {a}, {b}",
    "EQ": "{p} = fcmp oeq {row} {a}, {b}",
    "NE": "{p} = fcmp une {row} {a}, {b}",
    "NOT": "{p} = fcmp oeq {row} {a}, {zero}",
    "AND": "{q} = fcmp une {row} {a}, {zero}\n{r} = fcmp une {row} {b}, {zero}\n"
    "{p} = and {flags} {q}, {r}",
    "OR": "{q} = fcmp une {row} {a}, {zero}\n{r} = fcmp une {row} {b}, {zero}\n"
    "{p} = or {flags} {q}, {r}",
}
_CALLED = {"SIN": 1, "COS": 1, "TAN": 1, "ASIN": 1, "ACOS": 1, "ATAN": 1, "ATAN2": 2}
"""Functions of the C library and their number of arguments."""

OPERATIONS = ("CONST", "INPUT", "OUTPUT", *_COMPUTED, *_COMPARED, *_CALLED)
"""CasADi's names of the operations; an instruction holds an index into this tuple."""

_CODES = {getattr(ca, f"OP_{name}"): code for code, name in enumerate(OPERATIONS)}


@dataclass(frozen=True, slots=True, eq=False)
class Program:
    """Instructions of a function."""

    table: NDArray[np.int32]
    """Operation, result and two operands of each instruction, shape (n, 4)."""
    constants: Array
    """Values of constant instructions, 0 elsewhere, shape (n,)."""
    n_work: int
    """Number of work variables."""
    output_starts: Indices
    """First nonzero of each output among those of all outputs, shape (n_out + 1,)."""


@lru_cache(maxsize=1)
def is_installed() -> bool:
    """True if llvmlite is installed (extra `fast`)."""
    return find_spec("llvmlite") is not None


def load_program(key: str, n_instructions: int, n_outputs: int) -> Program | None:
    """Load the instructions of a function from disk; None if they are absent or do not fit.

    Args:
        key: Key of the function.
        n_instructions: Number of its instructions.
        n_outputs: Number of its outputs.
    """
    content, n = disk_cache.load(_disk_key(key)), n_instructions
    if content is None or len(content) != 24 * n + 8 * (n_outputs + 2):
        return None
    table, constants, numbers = np.split(np.frombuffer(content, np.uint8), [16 * n, 24 * n])
    n_work, *starts = numbers.view(np.int64)
    return Program(
        table.view(np.int32).reshape(n, 4),
        constants.view(np.float64),
        int(n_work),
        np.array(starts, dtype=np.int64),
    )


def store_program(key: str, program: Program) -> None:
    """Store the instructions of a function on disk."""
    arrays = program.table, program.constants, np.array(program.n_work), program.output_starts
    disk_cache.store(_disk_key(key), b"".join(a.tobytes() for a in arrays))


def _disk_key(key: str) -> str:
    """Key of the instructions on disk, which contains the codes of the operations."""
    return f"instructions {_CODES}\n{key}"


def list_instructions(function: ca.Function) -> Program | None:
    """List the instructions of a function; None if one is unknown."""
    count = function.n_instructions()
    output_starts = np.cumsum([0, *(function.nnz_out(i) for i in range(function.n_out()))])
    starts = output_starts.tolist()
    rows, constants = [], np.zeros(count)
    for k in range(count):
        operation = function.instruction_id(k)
        code = _CODES.get(operation)
        if code is None:
            return None
        results = function.instruction_output(k)
        if operation == ca.OP_CONST:
            constants[k] = function.instruction_constant(k)
            rows.append((code, results[0], 0, 0))
            continue
        operands = function.instruction_input(k)
        if operation == ca.OP_OUTPUT:
            rows.append((code, starts[results[0]] + results[1], operands[0], 0))
        else:
            rows.append((code, results[0], operands[0], operands[-1]))
    table = np.array(rows, dtype=np.int32).reshape(-1, 4)
    return Program(table, constants, int(function.sz_w()) + 1, output_starts)


def run(program: Program, inputs: Sequence[Array], count: int) -> list[Array] | None:
    """Execute a program at points.

    Args:
        program: The program.
        inputs: Shape (n_rows, n) each; each row applies to count/n_rows successive points.
        count: Number of points.

    Returns:
        Nonzeros of each output, shape (count, nnz); None if the interpreter cannot be compiled.
    """
    lanes = next((n for n in LANES if count <= n), LANES[-1])
    compiled = compile_interpreter(lanes)
    if compiled is None:
        return None
    interpreter, _ = compiled
    arrays = [np.ascontiguousarray(a) for a in inputs]
    # per input: address, numbers per row, points per row
    layout = np.array(
        [
            [a.ctypes.data for a in arrays],
            [a.shape[1] for a in arrays],
            [max(count // max(len(a), 1), 1) for a in arrays],
        ],
        dtype=np.int64,
    )
    n_out = int(program.output_starts[-1])
    result, work = np.empty((count, n_out)), np.empty((program.n_work, lanes))
    if count:
        interpreter(
            program.table.ctypes.data,
            len(program.table),
            program.constants.ctypes.data,
            *(row.ctypes.data for row in layout),
            len(arrays),
            count,
            result.ctypes.data,
            n_out,
            work.ctypes.data,
        )
    return [result[:, a:b] for a, b in itertools.pairwise(program.output_starts.tolist())]


@lru_cache(maxsize=len(LANES))
def compile_interpreter(lanes: int) -> tuple[Callable[..., None], object] | None:
    """Interpreter and the engine that holds its machine code; None if it cannot be compiled here.

    Its arguments are addresses of arrays, and numbers:

        table      int32, shape (n, 4): operation, result, first and second operand. INPUT has the
                   index and the column of the input as operands, OUTPUT the nonzero as result.
        n          number of instructions
        constants  shape (n,)
        inputs     addresses of the inputs, shape (n_in,)
        strides    numbers per row of each input, int64
        shares     successive points to which a row of each input applies, int64
        n_in
        points     number of points
        outputs    shape (points, n_out)
        n_out
        work       shape (n_work, lanes)

    Args:
        lanes: Points for which one instruction is executed at once.
    """
    from llvmlite import binding

    number, pointer = ctypes.c_int64, ctypes.c_void_p
    kinds = (pointer, number, *(pointer,) * 4, number, number, pointer, number, pointer)
    try:
        library = ctypes.CDLL(None)  # symbols of this process, the C library among them
        for name in map(str.lower, _CALLED):
            function = ctypes.cast(getattr(library, name), ctypes.c_void_p)
            binding.add_symbol(name, function.value)
        binding.initialize_native_target()
        binding.initialize_native_asmprinter()
        features = binding.get_host_cpu_features().flatten()
        target = binding.Target.from_default_triple().create_target_machine(
            cpu=binding.get_host_cpu_name(), features=features, opt=2
        )
        module = binding.parse_assembly(_Source(lanes).text())
        module.verify()
        engine = binding.create_mcjit_compiler(module, target)
        engine.finalize_object()
        return ctypes.CFUNCTYPE(None, *kinds)(engine.get_function_address("run")), engine
    except (RuntimeError, AttributeError, TypeError, OSError):
        return None


class _Source:
    """Source of the interpreter in the intermediate representation of LLVM.

    Args:
        lanes: Points for which one instruction is executed at once.
    """

    def __init__(self, lanes: int) -> None:
        self._lanes, self._row = lanes, f"<{lanes} x double>"
        self._lines: list[str] = []
        self._names = 0

    def text(self) -> str:
        """Complete source."""
        row, lanes = self._row, self._lanes
        declared = [
            f"declare {row} @llvm.{name}.v{lanes}f64({row})\n" for name in ("sqrt", "fabs")
        ] + [
            f"declare double @{name.lower()}({', '.join(['double'] * count)})\n"
            for name, count in _CALLED.items()
        ]
        self._put("define void @run(ptr %table, i64 %n, ptr %constants, ptr %inputs, ptr %strides,")
        self._put("ptr %shares, i64 %n_in, i64 %points, ptr %outputs, i64 %n_out, ptr %work) {")
        self._put("entry:")
        begins = self._new(f"alloca ptr, i64 {self._new(f'mul i64 %n_in, {lanes}')}")
        ends = self._new(f"alloca ptr, i64 {lanes}")
        last = self._new("sub i64 %points, 1")
        blocks = self._new(f"udiv i64 {self._new(f'add i64 %points, {lanes - 1}')}, {lanes}")
        with self._loop(blocks) as block:
            first = self._new(f"mul i64 {block}, {lanes}")
            with self._loop(str(lanes)) as lane:
                self._find_point(first, lane, last, begins, ends)
            with self._loop("%n") as k:
                self._execute(k, begins, ends)
        self._put("ret void\n}")
        return "".join(declared) + "\n".join(self._lines) + "\n"

    def _find_point(self, first: str, lane: str, last: str, begins: str, ends: str) -> None:
        """Store the addresses of a lane; lanes beyond the last point repeat the last point."""
        index = self._new(f"add i64 {first}, {lane}")
        within = self._new(f"icmp slt i64 {index}, {last}")
        point = self._new(f"select i1 {within}, i64 {index}, i64 {last}")
        end = self._at("%outputs", self._new(f"mul i64 {point}, %n_out"), "double")
        self._store("ptr", end, self._at(ends, lane, "ptr"))
        with self._loop("%n_in") as i:
            share, stride = (
                self._load("i64", self._at(of, i, "i64")) for of in ("%shares", "%strides")
            )
            row = self._new(f"udiv i64 {point}, {share}")
            array = self._load("ptr", self._at("%inputs", i, "ptr"))
            begin = self._at(array, self._new(f"mul i64 {row}, {stride}"), "double")
            place = self._new(f"add i64 {self._new(f'mul i64 {i}, {self._lanes}')}, {lane}")
            self._store("ptr", begin, self._at(begins, place, "ptr"))

    def _execute(self, k: str, begins: str, ends: str) -> None:
        """Execute one instruction for all lanes."""
        entry = self._new(f"mul i64 {k}, 4")
        code, *places = (
            self._load("i32", self._at("%table", self._new(f"add i64 {entry}, {j}"), "i32"))
            for j in range(4)
        )
        to, a, b = (self._new(f"sext i32 {v} to i64") for v in places)
        to_row, a_row, b_row = (
            self._at("%work", self._new(f"mul i64 {v}, {self._lanes}"), "double")
            for v in (to, a, b)
        )
        done, labels = self._label(), [self._label() for _ in OPERATIONS]
        cases = " ".join(f"i32 {i}, label %{label}" for i, label in enumerate(labels))
        self._put(f"switch i32 {code}, label %{done} [ {cases} ]")
        for name, label in zip(OPERATIONS, labels, strict=True):
            self._put(f"{label}:")
            if name == "INPUT":
                first = self._new(f"mul i64 {a}, {self._lanes}")
                for lane in range(self._lanes):
                    place = self._at(begins, self._new(f"add i64 {first}, {lane}"), "ptr")
                    value = self._load("double", self._at(self._load("ptr", place), b, "double"))
                    self._store("double", value, self._at(to_row, str(lane), "double"))
            elif name == "OUTPUT":
                for lane in range(self._lanes):
                    value = self._load("double", self._at(a_row, str(lane), "double"))
                    end = self._load("ptr", self._at(ends, str(lane), "ptr"))
                    self._store("double", value, self._at(end, to, "double"))
            elif name == "CONST":
                value = self._load("double", self._at("%constants", k, "double"))
                first = self._new(f"insertelement {self._row} poison, double {value}, i32 0")
                zeros = f"<{self._lanes} x i32> zeroinitializer"  # all lanes copy lane 0
                row = self._new(f"shufflevector {self._row} {first}, {self._row} poison, {zeros}")
                self._store(self._row, row, to_row)
            elif name in _CALLED:
                rows = [a_row, b_row][: _CALLED[name]]
                self._call(name.lower(), to_row, rows)
            else:
                self._compute(name, to_row, a_row, b_row)
            self._put(f"br label %{done}")
        self._put(f"{done}:")

    def _compute(self, name: str, to_row: str, a_row: str, b_row: str) -> None:
        """Execute an operation of vectors."""
        form = _COMPUTED.get(name) or _COMPARED[name]
        operands = {"a": self._load(self._row, a_row)}
        if "{b}" in form:
            operands["b"] = self._load(self._row, b_row)
        names = {v: self._name() for v in "ypqr"}
        numbers = {
            v: f"<{', '.join([f'double {number}'] * self._lanes)}>"
            for v, number in (("zero", "0.0"), ("one", "1.0"), ("minus", "-1.0"))
        }
        types = {"row": self._row, "flags": f"<{self._lanes} x i1>", "lanes": self._lanes}
        self._put(form.format(**names, **operands, **numbers, **types))
        if name in _COMPARED:
            self._put(f"{names['y']} = uitofp <{self._lanes} x i1> {names['p']} to {self._row}")
        self._store(self._row, names["y"], to_row)

    def _call(self, function: str, to_row: str, rows: Sequence[str]) -> None:
        """Call a function of the C library for each lane."""
        with self._loop(str(self._lanes)) as lane:
            values = [self._load("double", self._at(row, lane, "double")) for row in rows]
            arguments = ", ".join(f"double {v}" for v in values)
            result = self._new(f"call double @{function}({arguments})")
            self._store("double", result, self._at(to_row, lane, "double"))

    @contextmanager
    def _loop(self, count: str) -> Iterator[str]:
        """Repeat the enclosed code for 0, 1, ... count − 1."""
        before, head, body, end = (self._label() for _ in range(4))
        index, following, within = (self._name() for _ in range(3))
        last = self._label()
        self._put(f"br label %{before}\n{before}:\nbr label %{head}\n{head}:")
        self._put(f"{index} = phi i64 [ 0, %{before} ], [ {following}, %{last} ]")
        self._put(f"{within} = icmp ult i64 {index}, {count}")
        self._put(f"br i1 {within}, label %{body}, label %{end}\n{body}:")
        yield index
        self._put(f"br label %{last}\n{last}:\n{following} = add i64 {index}, 1")
        self._put(f"br label %{head}\n{end}:")

    def _at(self, array: str, index: str, kind: str) -> str:
        """Address of an element of an array."""
        return self._new(f"getelementptr {kind}, ptr {array}, i64 {index}")

    def _load(self, kind: str, place: str) -> str:
        """Value at an address; vectors are aligned like doubles, as NumPy allocates them."""
        align = ", align 8" if kind == self._row else ""
        return self._new(f"load {kind}, ptr {place}{align}")

    def _store(self, kind: str, value: str, place: str) -> None:
        """Store a value at an address."""
        align = ", align 8" if kind == self._row else ""
        self._put(f"store {kind} {value}, ptr {place}{align}")

    def _new(self, instruction: str) -> str:
        """Name of the result of a new instruction."""
        name = self._name()
        self._put(f"{name} = {instruction}")
        return name

    def _name(self) -> str:
        """New name of a variable."""
        self._names += 1
        return f"%v{self._names}"

    def _label(self) -> str:
        """New label of a block."""
        self._names += 1
        return f"b{self._names}"

    def _put(self, line: str) -> None:
        """Add a line to the source."""
        self._lines.append(line)
