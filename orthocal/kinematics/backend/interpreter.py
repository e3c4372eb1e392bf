"""An interpreter of lists of instructions, as machine code: each is taken for a lane of points.

LLVM (llvmlite) makes it for the processor that it runs on, in some hundredths of a second. It does
what CasADi's machine does, in the same order: operations that are correctly rounded, and functions
of the C library, so that the numbers are the same. Work is in rows of a lane, a row
a place.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from importlib.util import find_spec

SHORT, LONG = 8, 32
"""Lanes that there are: points that an instruction is taken for at once."""

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
    "SQRT": "{y} = call {row} @llvm.sqrt.v{lane}f64({row} {a})",
    "FABS": "{y} = call {row} @llvm.fabs.v{lane}f64({row} {a})",
    "IF_ELSE_ZERO": "{p} = fcmp une {row} {a}, {zero}\n{y} = select {flags} {p}, {row} {b}, "
    "{row} {zero}",
    "SIGN": "{p} = fcmp olt {row} {a}, {zero}\n{q} = fcmp ogt {row} {a}, {zero}\n"
    "{r} = select {flags} {q}, {row} {one}, {row} {a}\n"
    "{y} = select {flags} {p}, {row} {minus}, {row} {r}",
}
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
"""Functions of the C library, and how many numbers they take."""

OPERATIONS = ("CONST", "INPUT", "OUTPUT", *_COMPUTED, *_COMPARED, *_CALLED)
"""CasADi's names of operations; an instruction holds their place here."""

Interpreter = Callable[..., None]

_ENGINES: list[object] = []


@lru_cache(maxsize=1)
def is_installed() -> bool:
    """Whether there is LLVM."""
    return find_spec("llvmlite") is not None


@lru_cache(maxsize=2)
def interpreter(lane: int) -> Interpreter | None:
    """The interpreter for a lane of so many points; None where it cannot be made.

    Its arguments are addresses of arrays, and numbers:

        table      int32, shape (n, 4): operation, result, first and second operand; of an input
                   its index and its column in place of operands, of an output its column in place
                   of the result
        n          of instructions
        constants  shape (n,)
        inputs     addresses of the inputs, shape (n_in,)
        strides    numbers from a row of each to the next, int64
        shares     points that a row of each stands for, int64
        n_in
        points     how many
        outputs    shape (points, n_out)
        n_out
        work       shape (n_work, lane)
    """
    from llvmlite import binding as llvm

    try:
        library = ctypes.CDLL(None)  # what this process has, the C library among it
        for name in map(str.lower, _CALLED):
            function = ctypes.cast(getattr(library, name), ctypes.c_void_p)
            llvm.add_symbol(name, function.value)
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        target = llvm.Target.from_default_triple().create_target_machine(
            cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=2
        )
        module = llvm.parse_assembly(_Source(lane).text())
        module.verify()
        engine = llvm.create_mcjit_compiler(module, target)
        engine.finalize_object()
        address = engine.get_function_address("run")
    except (RuntimeError, AttributeError, TypeError, OSError):
        return None
    number, place = ctypes.c_int64, ctypes.c_void_p
    kinds = (place, number, place, place, place, place, number, number, place, number, place)
    run = ctypes.CFUNCTYPE(None, *kinds)(address)
    _ENGINES.append(engine)  # or its code would go with it
    return run


class _Source:
    """Its source, in LLVM's language."""

    def __init__(self, lane: int) -> None:
        self._lane, self._row = lane, f"<{lane} x double>"
        self._lines: list[str] = []
        self._names = 0

    def text(self) -> str:
        """All of it."""
        row, size = self._row, self._lane
        declared = [
            f"declare {row} @llvm.{name}.v{size}f64({row})\n" for name in ("sqrt", "fabs")
        ] + [
            f"declare double @{name.lower()}({', '.join(['double'] * count)})\n"
            for name, count in _CALLED.items()
        ]
        self._put("define void @run(ptr %table, i64 %n, ptr %constants, ptr %inputs, ptr %strides,")
        self._put("ptr %shares, i64 %n_in, i64 %points, ptr %outputs, i64 %n_out, ptr %work) {")
        self._put("entry:")
        begins = self._new(f"alloca ptr, i64 {self._new(f'mul i64 %n_in, {size}')}")
        ends = self._new(f"alloca ptr, i64 {size}")
        last = self._new("sub i64 %points, 1")
        blocks = self._new(f"udiv i64 {self._new(f'add i64 %points, {size - 1}')}, {size}")
        with self._loop(blocks) as block:
            first = self._new(f"mul i64 {block}, {size}")
            with self._loop(str(size)) as lane:
                self._find_point(first, lane, last, begins, ends)
            with self._loop("%n") as k:
                self._take(k, begins, ends)
        self._put("ret void\n}")
        return "".join(declared) + "\n".join(self._lines) + "\n"

    def _find_point(self, first: str, lane: str, last: str, begins: str, ends: str) -> None:
        """Where a lane's point is read and written; what is beyond the last is the last again."""
        there = self._new(f"add i64 {first}, {lane}")
        within = self._new(f"icmp slt i64 {there}, {last}")
        point = self._new(f"select i1 {within}, i64 {there}, i64 {last}")
        end = self._at("%outputs", self._new(f"mul i64 {point}, %n_out"), "double")
        self._store("ptr", end, self._at(ends, lane, "ptr"))
        with self._loop("%n_in") as i:
            share, stride = (
                self._load("i64", self._at(of, i, "i64")) for of in ("%shares", "%strides")
            )
            row = self._new(f"udiv i64 {point}, {share}")
            array = self._load("ptr", self._at("%inputs", i, "ptr"))
            begin = self._at(array, self._new(f"mul i64 {row}, {stride}"), "double")
            place = self._new(f"add i64 {self._new(f'mul i64 {i}, {self._lane}')}, {lane}")
            self._store("ptr", begin, self._at(begins, place, "ptr"))

    def _take(self, k: str, begins: str, ends: str) -> None:
        """One instruction, for a lane of points."""
        entry = self._new(f"mul i64 {k}, 4")
        code, *places = (
            self._load("i32", self._at("%table", self._new(f"add i64 {entry}, {j}"), "i32"))
            for j in range(4)
        )
        to, a, b = (self._new(f"sext i32 {v} to i64") for v in places)
        to_row, a_row, b_row = (
            self._at("%work", self._new(f"mul i64 {v}, {self._lane}"), "double") for v in (to, a, b)
        )
        done, labels = self._label(), [self._label() for _ in OPERATIONS]
        cases = " ".join(f"i32 {i}, label %{label}" for i, label in enumerate(labels))
        self._put(f"switch i32 {code}, label %{done} [ {cases} ]")
        for name, label in zip(OPERATIONS, labels, strict=True):
            self._put(f"{label}:")
            if name == "INPUT":
                first = self._new(f"mul i64 {a}, {self._lane}")
                for lane in range(self._lane):
                    place = self._at(begins, self._new(f"add i64 {first}, {lane}"), "ptr")
                    value = self._load("double", self._at(self._load("ptr", place), b, "double"))
                    self._store("double", value, self._at(to_row, str(lane), "double"))
            elif name == "OUTPUT":
                for lane in range(self._lane):
                    value = self._load("double", self._at(a_row, str(lane), "double"))
                    end = self._load("ptr", self._at(ends, str(lane), "ptr"))
                    self._store("double", value, self._at(end, to, "double"))
            elif name == "CONST":
                value = self._load("double", self._at("%constants", k, "double"))
                one = self._new(f"insertelement {self._row} poison, double {value}, i32 0")
                same = f"<{self._lane} x i32> zeroinitializer"
                row = self._new(f"shufflevector {self._row} {one}, {self._row} poison, {same}")
                self._store(self._row, row, to_row)
            elif name in _CALLED:
                rows = [a_row, b_row][: _CALLED[name]]
                self._call(name.lower(), to_row, rows)
            else:
                self._compute(name, to_row, a_row, b_row)
            self._put(f"br label %{done}")
        self._put(f"{done}:")

    def _compute(self, name: str, to_row: str, a_row: str, b_row: str) -> None:
        form = _COMPUTED.get(name) or _COMPARED[name]
        given = {"a": self._load(self._row, a_row)}
        if "{b}" in form:
            given["b"] = self._load(self._row, b_row)
        names = {v: self._name() for v in "ypqr"}
        same = {
            v: f"<{', '.join([f'double {number}'] * self._lane)}>"
            for v, number in (("zero", "0.0"), ("one", "1.0"), ("minus", "-1.0"))
        }
        fixed = {"row": self._row, "flags": f"<{self._lane} x i1>", "lane": self._lane}
        self._put(form.format(**names, **given, **same, **fixed))
        if name in _COMPARED:
            self._put(f"{names['y']} = uitofp <{self._lane} x i1> {names['p']} to {self._row}")
        self._store(self._row, names["y"], to_row)

    def _call(self, function: str, to_row: str, rows: Sequence[str]) -> None:
        with self._loop(str(self._lane)) as lane:
            values = [self._load("double", self._at(row, lane, "double")) for row in rows]
            told = ", ".join(f"double {v}" for v in values)
            found = self._new(f"call double @{function}({told})")
            self._store("double", found, self._at(to_row, lane, "double"))

    @contextmanager
    def _loop(self, count: str) -> Iterator[str]:
        """What is put within is done for 0, 1, ... count − 1."""
        before, head, body, end = (self._label() for _ in range(4))
        index, following, on = (self._name() for _ in range(3))
        last = self._label()
        self._put(f"br label %{before}\n{before}:\nbr label %{head}\n{head}:")
        self._put(f"{index} = phi i64 [ 0, %{before} ], [ {following}, %{last} ]")
        self._put(f"{on} = icmp ult i64 {index}, {count}")
        self._put(f"br i1 {on}, label %{body}, label %{end}\n{body}:")
        yield index
        self._put(f"br label %{last}\n{last}:\n{following} = add i64 {index}, 1")
        self._put(f"br label %{head}\n{end}:")

    def _at(self, array: str, index: str, kind: str) -> str:
        return self._new(f"getelementptr {kind}, ptr {array}, i64 {index}")

    def _load(self, kind: str, place: str) -> str:
        align = ", align 8" if kind == self._row else ""
        return self._new(f"load {kind}, ptr {place}{align}")

    def _store(self, kind: str, value: str, place: str) -> None:
        align = ", align 8" if kind == self._row else ""
        self._put(f"store {kind} {value}, ptr {place}{align}")

    def _new(self, what: str) -> str:
        name = self._name()
        self._put(f"{name} = {what}")
        return name

    def _name(self) -> str:
        self._names += 1
        return f"%v{self._names}"

    def _label(self) -> str:
        self._names += 1
        return f"b{self._names}"

    def _put(self, line: str) -> None:
        self._lines.append(line)
