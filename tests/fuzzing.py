"""Mutated files of all kinds, and what must hold of each: orthocal's errors, or none.

Case i of a seed is always the same. Workers run cases in processes of their own, so that a crash or
a blow-up of memory is seen, too. By hand:

    python tests/fuzzing.py --count 50000
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import faulthandler
import functools
import io
import json
import os
import random
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
import unicodedata
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import openpyxl
import yaml
from lxml import etree

from orthocal import (
    calibrate,
    draw_scene,
    load_calibration,
    load_plan,
    load_robot,
    load_session,
    make_robot,
    simulate_session,
    summarize,
    write_session,
)
from orthocal.assessment.controller_entries import entered_offsets, find_entries
from orthocal.assessment.tool_tables import (
    accuracy_rows,
    forward_blocks,
    inverse_blocks,
)
from orthocal.builder.build import remake_robot
from orthocal.builder.machine_file import read_machine
from orthocal.builder.orthoglide import Orthoglide
from orthocal.calibration.file import calibration_document, write_calibration
from orthocal.cli.correct import _lines
from orthocal.errors import OrthocalError
from orthocal.export.correction_field import CorrectionField
from orthocal.gcode.interpreter import Interpreter
from orthocal.gcode.program import ProgramCorrector
from orthocal.kinematics.loop_closure import nominal_closure
from orthocal.measurement.files.coordinate_tables import read_points, stream_joints
from orthocal.measurement.importing.import_readings import TableOptions, import_readings
from orthocal.measurement.recording import open_recording
from orthocal.observation.simulate import load_errors, truth_document
from orthocal.output.text.accuracy import format_points
from orthocal.output.text.import_report import format_import, format_import_json
from orthocal.planning.equipment import Equipment, load_dial
from orthocal.study.runner import open_results

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
if os.environ.get("ORTHOCAL_FUZZ_WORKER"):
    warnings.simplefilter("error", RuntimeWarning)  # a user would see it

ROOT = Path(__file__).parents[1]

LONGEST = float(os.environ.get("ORTHOCAL_FUZZ_LONGEST", "5.0"))
"""Processor time of a case, [s]."""

LARGEST = 500
"""Memory of a worker, [MiB]; the libraries alone take 200."""

HANGS = 240.0
"""Time without a sign of life after which a worker is killed, [s]."""

SESSION = """
robot: machine
title: A small machine
gauge: {sigma_mm: 0.01, resolution_mm: 0.01, range_mm: [-60, 60]}
postures:
  zero: {tcp_mm: [0, 0]}
  x_max: {tcp_mm: [40, 0]}
  x_min: {tcp_mm: [-40, 0]}
  y_max: {tcp_mm: [0, 40]}
  y_min: {joints_mm: [200, 160]}
controller: {offsets_mm: [0, 0.1]}
setups:
  xy: {leg: x, direction: y, section: {fraction: 0.5}}
  yx: {leg: y, direction: -x, section: {from_root_mm: 100}}
"""
PLAN = "cycles: 2\n"
ERRORS = "errors: {x_slide.offset_mm: 0.5, y_slide.offset_mm: -0.3}\nzeros_mm: {xy: 0.1}\n"
JOINTS = "x_slide_mm,y_slide_mm\n200,200\n210,190\n190,205.5\n"
POINTS = "x_mm,y_mm\n0,0\n20,-10\n-15.5,7\n"

TABLE = (
    "Messprotokoll;;;;\nAufstellung;Stellung;Zyklus 1 [mm];Zyklus 2 [mm];Notiz\n"
    "xy;zero;0,00;0,01;\nxy;x_max;−0,43;-0,44;gut\nyx;zero;1,5;;\nEnde;;;;\n"
)

PROGRAM = """%
(a part) G21 G90 G17 G64 P0.01
N10 G0 X0 Y0
F100.5 S1000 M3
G1 X10 Y-5
X12.5 Y-4.25
N50 G2 X2.5 Y-4.25 I-5 J0 (half)
G3 X12.5 R5 F80
G91
G1 X-1 Y.5
X-1
G90 G20
G54 G1 X0.25 Y0.1 F4 ; inches
G21 F100
G3 X20 Y0 I6.825 J-1.27 P1
G1 X0 Y0 M9
M2
behind the end
%
"""

DIAL = """
sigma_mm: 0.005
resolution_mm: 0.01
range_mm: [-5, 5]
scale_tolerance: 0.004
tip: {ball: {radius_mm: 1.5}}
direction_tolerance_mrad: 20
section_tolerance_mm: 1
"""

STUDY = SimpleNamespace(document={"kind": "none", "draws": 4}, digest="0" * 64, task_sizes=[2] * 4)
"""What a journal says of its study, and how many tasks there are."""

STEERING = ("Cc", "Cf", "Cs", "Co", "Zl", "Zp")
"""Categories of characters that no message may hold."""

KINDS = {
    "session": "session.yaml",
    "plan": "plan.yaml",
    "readings": "readings.csv",
    "robot": "machine/machine.yaml",
    "urdf": "machine/machine.urdf",
    "calibration": "calibration.json",
    "errors": "errors.yaml",
    "joints": "joints.csv",
    "points": "points.csv",
    "table": "table.csv",
    "workbook": "table.xlsx",
    "program": "part.ngc",
    "machine": "made/machine.yaml",
    "dial": "dial.yaml",
    "journal": "recorded/readings.csv.journal",
    "study": "study.jsonl",
}


def lay_out(folder: Path) -> None:
    """Good files of every kind."""
    shutil.copytree(ROOT / "tests/robots/biglide", folder / "machine")
    for suffix in ("yaml", "urdf"):
        (folder / f"machine/biglide.{suffix}").rename(folder / f"machine/machine.{suffix}")
    for name, text in (("plan.yaml", SESSION + PLAN), ("errors.yaml", ERRORS)):
        (folder / name).write_text(text, encoding="utf-8")
    (folder / "joints.csv").write_text(JOINTS, encoding="utf-8")
    (folder / "points.csv").write_text(POINTS, encoding="utf-8")
    (folder / "table.csv").write_text(TABLE, encoding="utf-8")
    book = openpyxl.Workbook()
    for line in TABLE.splitlines():
        cells = (cell.replace("−", "-").replace(",", ".") for cell in line.split(";"))
        book.active.append([float(c) if c[-1:].isdigit() and c[-2:-1] != " " else c for c in cells])
    book.active.merge_cells("A3:A4")
    book.active["E4"] = "=C4-0.01"
    book.save(folder / "table.xlsx")
    simulated = simulate_session(load_plan(folder / "plan.yaml"), {"x_slide.offset": 5e-4})
    write_session(simulated.session, folder)
    write_calibration(calibrate(load_session(folder), "full"), folder / "calibration.json")
    (folder / "part.ngc").write_text(PROGRAM, encoding="utf-8")
    (folder / "dial.yaml").write_text(DIAL, encoding="utf-8")
    make_robot(Orthoglide(), folder / "made")
    lay_out_journals(folder)


def lay_out_journals(folder: Path) -> None:
    """A recording and a study that were killed, the recording before its CSV was written."""
    recorded = folder / "recorded"
    recorded.mkdir()
    text = SESSION.replace("robot: machine", "robot: ../machine")
    (recorded / "session.yaml").write_text(text + PLAN, encoding="utf-8")
    with open_recording(recorded) as recording:
        recording.read(0, 1e-4)
        csv = (recorded / "readings.csv").read_bytes()
        recording.read(1, -2e-4)
        recording.repeat(0)
        recording.read(2, 3.5e-4)
        journal = (folder / KINDS["journal"]).read_bytes()
    (recorded / "readings.csv").write_bytes(csv)
    (folder / KINDS["journal"]).write_bytes(journal)
    with open_results(folder / "study.jsonl", STUDY) as (_, store):
        for task in (2, 0):
            store(task, {"draw": [task, task + 1], "error": [0.5, None]})


# ---- mutation

NUMBERS: list[Any] = [
    *(0, -1, 1, 2, 7, 1e9, -1e9, 1e308, -1e308, 1e-308, 1e-12, 1e-9, 0.5, 1e3, 1e6, 300.0),
    *(float("nan"), float("inf"), -float("inf"), 10**30, -(10**30), 10**400, True, False),
]
TEXTS = [
    *("", " ", "0", "-", ".", "~", "null", "yes", "*", "!*", "[", "]", "a/b", "../x", "/dev/zero"),
    *("constructor", "__proto__", "x_slide", "x", "machine", "zero", "<b>&", "%s{}", "$\\frac$"),
    *("\x1b[31m", "\x00", "\x85", "\u202e", "\u2028", "e\u0301", "𝒳", "\ufeff", "\ud800", "\uffff"),
    *("x" * 300, "9" * 4300, "y" * 100_000, "!!set {a}", "!!binary aGk=", "&a [*a]", "1:2:3"),
]


NUMERALS = ("1e3", "-5000", "0.0001", "299", "1e-300", "0x10", "1_0", "١")

WORDS = (
    *"G0 G1 G2 G3 G20 G21 G90 G91 G90.1 G91.1 G18 G80 G54 G55 G59.3 G61 M0 M2 M30 % N1".split(),
    *"F0 F1e3 F0.0001 X0 Y0 X-40 Y40 X1000 Y-1e3 I0 J0 I-5 R0 R-5 P2 P10000 Z1 A1 G38.2".split(),
    *"G92 #1=2 / ( ) G-0 M3.0 G1.0 X+.5".split(),
    *("G4 P1", "M6 T1", "o1 sub", "\t", "\r", " " * 1200, "X" + "0" * 300, "Y0." + "1" * 300),
    *("(" + "c" * 260 + ")", ";" + "\xe9" * 400),
)
"""What stands in programs, or nearly."""


def odd(rng: random.Random) -> Any:
    """A value that nobody expects."""
    kind = rng.random()
    if kind < 0.4:
        return rng.choice(NUMBERS)
    if kind < 0.75:
        return rng.choice(TEXTS)
    if kind < 0.8:
        return None
    if kind < 0.85:
        return [odd(rng) for _ in range(rng.randrange(4))]
    if kind < 0.9:
        return {str(rng.choice(TEXTS)): odd(rng) for _ in range(rng.randrange(3))}
    if kind < 0.95:
        return [1] * rng.choice((12, 100, 30_000))
    nested: Any = 1
    for _ in range(rng.choice((5, 25, 150))):
        nested = [nested]
    return nested


def places(document: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Where there is a value."""
    inner = document.items() if isinstance(document, dict) else enumerate(document)
    found: list[tuple[Any, ...]] = []
    for key, value in inner:
        found.append((*path, key))
        if isinstance(value, dict | list):
            found += places(value, (*path, key))
    return found


def change(rng: random.Random, document: Any) -> None:
    """Spoil one value, key or item, in place."""
    among = places(document)
    if not among:
        return
    *path, last = rng.choice(among)
    inner = document
    for key in path:
        inner = inner[key]
    how = rng.randrange(10)
    if how == 0:
        del inner[last]
    elif how == 1 and isinstance(inner, dict):
        inner[rng.choice(TEXTS) if rng.random() < 0.7 else rng.choice(NUMBERS)] = inner.pop(last)
    elif how == 2 and isinstance(inner, list):
        inner.append(inner[last])
    elif how in (3, 7, 8, 9) and isinstance(inner[last], int | float):
        inner[last] *= rng.choice((-1, 0.0, 1e-3, 1e3, 1e6, 1e12, 1.0001, 0.9, 1.5, 10))
    elif how == 4:
        *other, end = rng.choice(among)
        source = document
        try:
            for key in other:
                source = source[key]
            inner[last] = json.loads(json.dumps(source[end]))
        except (KeyError, IndexError, TypeError, ValueError):
            inner[last] = None
    else:
        inner[last] = odd(rng)


def change_bytes(rng: random.Random, data: bytes) -> bytes:
    """Spoil bytes."""
    how, at = rng.randrange(7), rng.randrange(len(data) + 1)
    to = min(len(data), at + rng.choice((1, 2, 5, 40, 400)))
    if how == 0:
        return data[:at]
    if how == 1:
        return data[:at] + data[to:]
    if how == 2:
        return data[:to] + data[at:]
    if how == 3:
        return data[:at] + bytes(rng.randrange(256) for _ in range(rng.choice((1, 3)))) + data[at:]
    if how == 4 and data:
        return data[: at - 1] + bytes([data[at - 1] ^ (1 << rng.randrange(8))]) + data[at:]
    if how == 5:
        new = str(rng.choice(NUMBERS + TEXTS) if rng.random() < 0.8 else "")
        return data[:at] + new.encode(errors="surrogatepass") + data[to:]
    other = rng.randrange(len(data) + 1)
    return data[:at] + data[other : other + rng.choice((5, 50))] + data[at:]


def change_rows(
    rng: random.Random, text: str, separator: str = ",", words: tuple[str, ...] = NUMERALS
) -> str:
    """Spoil the cells and rows of a CSV, or the words and lines of a program."""
    rows = [line.split(separator) for line in text.split("\n")]
    row = rng.choice(rows)
    how, at = rng.randrange(9), rng.randrange(len(row))
    if how == 0:
        row[at] = str(odd(rng))
    elif how == 1:
        rows.insert(rng.randrange(len(rows)), list(row))
    elif how == 2:
        rows.remove(row)
    elif how == 3:
        row.insert(rng.randrange(len(row) + 1), str(odd(rng)))
    elif how == 4:
        row[at] = rng.choice([r[at] for r in rows if len(r) > at])
    elif how == 5:
        row.insert(rng.randrange(len(row) + 1), rng.choice(words))
    elif how == 6:
        row[at] = row[at][:1] + str(rng.choice(NUMBERS))
    else:
        row[-1 if how == 7 else at] = rng.choice(words)
    return rng.choice(("\n", "\n", "\n", "\r\n", "\r")).join(separator.join(r) for r in rows)


def change_xml(rng: random.Random, data: bytes) -> bytes:
    """Spoil the elements and attributes of a URDF."""
    root = etree.fromstring(data)
    elements = list(root.iter(etree.Element))
    element = rng.choice(elements)
    parent = element.getparent()
    how = rng.randrange(7)
    with contextlib.suppress(ValueError, TypeError):
        if how == 0 and parent is not None:
            parent.remove(element)
        elif how == 1 and parent is not None:
            parent.append(etree.fromstring(etree.tostring(element)))
        elif how == 2 and element.attrib:
            del element.attrib[rng.choice(list(element.attrib))]
        elif how == 3:
            element.tag = rng.choice(("link", "joint", "box", "mimic", "origin", "sphere", "mesh"))
        elif how == 4:
            size = rng.choice(("1e308 0 0", "1 2", "nan 0 0", "0 0 0", "1e-300 1 1", "1e5 0 0"))
            kind = rng.choice(("origin", "axis", "limit", "visual", "geometry", "inertial"))
            etree.SubElement(element, kind, xyz=size, rpy=size, lower=size, upper="0")
        elif element.attrib:
            key = rng.choice(list(element.attrib))
            values = [e.attrib[k] for e in elements for k in e.attrib]
            given = rng.choice(values) if rng.random() < 0.5 else str(odd(rng))
            element.attrib[key] = given
    return bytes(etree.tostring(root))


def change_journal(rng: random.Random, text: str) -> str:
    """Spoil the lines of JSON of a journal."""
    lines = text.splitlines()
    at = rng.randrange(len(lines))
    how = rng.randrange(8)
    if how == 0:
        del lines[at]
    elif how == 1:
        lines.insert(rng.randrange(len(lines) + 1), lines[at])
    elif how == 2:
        lines[at] = json.dumps(odd(rng))
    else:
        document = json.loads(lines[at])
        change(rng, document)
        lines[at] = json.dumps(document)
    return "\n".join(lines) + rng.choice(("\n", "\n", "\n", ""))


ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-32", "cp1252", "latin-1")


def change_workbook(rng: random.Random, data: bytes) -> bytes:
    """Spoil one part of a workbook: its XML, its bytes, its name, or that it is there."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    cells = [n for n in parts if n.startswith("xl/worksheets/") or n == "xl/sharedStrings.xml"]
    name = rng.choice(cells if rng.random() < 0.6 else list(parts))
    how = rng.randrange(8)
    if how < 4:
        part = parts[name].decode()
        found = [m.span(1) for m in re.finditer(r'(?:="|>)([^"<>]+)(?:"|<)', part)]
        at, to = rng.choice(found)
        new = str(odd(rng)) if rng.random() < 0.6 else rng.choice(CELLS)
        parts[name] = (part[:at] + new + part[to:]).encode(errors="surrogatepass")
    elif how == 4:
        parts[name] = change_xml(rng, parts[name])
    elif how == 5:
        parts[name] = change_bytes(rng, parts[name])
    elif how == 6:
        del parts[name]
    else:
        parts[rng.choice(list(parts))] = parts.pop(name)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, part in parts.items():
            archive.writestr(zipfile.ZipInfo(name), part, zipfile.ZIP_DEFLATED)  # of no date
    return stream.getvalue()


CELLS = (
    "A1 XFD1 A1048576 ZZZ9999999 A1:XFD1048576 A0 s n d b e str inlineStr 2026-05-01 1e309 -0 "
    "sheet1.xml hidden 0.0% 14 9999"
).split()
"""What stands in the XML of workbooks."""


NO_ARCHIVE = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError)
NO_DOCUMENT = (yaml.YAMLError, etree.XMLSyntaxError, *NO_ARCHIVE)
"""What says that a file is spoilt so far that it has no structure left."""


def mutate(rng: random.Random, kind: str, data: bytes) -> bytes:
    """One file, spoilt in one to three ways."""
    for _ in range(rng.choice((1, 1, 1, 1, 2, 3))):
        if rng.random() < 0.2:
            data = change_bytes(rng, data)
            continue
        try:
            data = mutate_structure(rng, kind, data)
        except (ValueError, TypeError, LookupError, ArithmeticError, RecursionError, *NO_DOCUMENT):
            data = change_bytes(rng, data)
    return data


def mutate_structure(rng: random.Random, kind: str, data: bytes) -> bytes:
    if kind == "workbook":
        return change_workbook(rng, data)
    if kind == "table":
        text = change_rows(rng, data.decode(), rng.choice((";", ";", ";", ",")))
        if rng.random() < 0.2:
            text = text.replace(";", rng.choice(("\t", ",", "|", " ")))
        encoding = rng.choice(ENCODINGS) if rng.random() < 0.5 else "utf-8"
        return text.encode(encoding, errors="surrogatepass" if "utf" in encoding else "replace")
    if kind in ("joints", "points", "readings"):
        return change_rows(rng, data.decode()).encode(errors="surrogatepass")
    if kind == "urdf":
        return change_xml(rng, data)
    if kind == "program":
        return change_rows(rng, data.decode(), " ", WORDS).encode(errors="surrogatepass")
    if kind in ("journal", "study"):
        return change_journal(rng, data.decode()).encode(errors="surrogatepass")
    document = json.loads(data) if kind == "calibration" else copy.deepcopy(_load_yaml(data))
    if not isinstance(document, dict):
        return change_bytes(rng, data)
    change(rng, document)
    if kind == "calibration":
        return json.dumps(document).encode()
    return dump(document, allow_unicode=rng.random() < 0.5).encode(errors="surrogatepass")


@functools.lru_cache(maxsize=32)
def _load_yaml(data: bytes) -> Any:
    """Most files are spoilt once: what is loaded is a good one."""
    same = data.isascii() and b"\\" not in data  # by libyaml
    return yaml.load(
        data, getattr(yaml, "CSafeLoader", yaml.SafeLoader) if same else yaml.SafeLoader
    )


def dump(document: Any, *, allow_unicode: bool) -> str:
    """A document as PyYAML's own dumper writes it; where libyaml's writes the same, by that."""
    shown = repr(document)
    same = shown.isascii() and "\\" not in shown and "'': " not in shown
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper) if same else yaml.SafeDumper
    return str(yaml.dump(document, Dumper=dumper, sort_keys=False, allow_unicode=allow_unicode))


def make_case(seed: int, index: int, good: dict[str, bytes]) -> tuple[str, bytes, random.Random]:
    """Kind and content of a case, and the numbers that decide what is done with it."""
    rng = random.Random(f"{seed}:{index}")
    kind = rng.choice(list(KINDS))
    return kind, mutate(rng, kind, good[kind]), rng


# ---- what is done with a file; slow things where `deep`


def use_session(folder: Path, rng: random.Random, deep: bool) -> None:
    session = load_session(folder)
    if deep:
        calibration = calibrate(session, rng.choice((None, "full")))
        found = load_calibration(write_calibration(calibration, folder / "out.json"))
        assert calibration_document(found) == calibration_document(calibration)
        summarize(found, details=True)
        if rng.random() < 0.05:
            draw_scene(found).to_html()


def use_plan(folder: Path, rng: random.Random, deep: bool) -> None:
    plan = load_plan(folder / "plan.yaml")
    if deep:
        simulated = simulate_session(plan, {"x_slide.offset": 3e-4})
        truth = {"truth.yaml": truth_document(simulated)}
        load_session(write_session(simulated.session, folder / "out", extra=truth))
        load_errors(folder / "out/truth.yaml", plan.robot)


def use_robot(folder: Path, rng: random.Random, deep: bool) -> None:
    robot = load_robot(folder / "machine")
    if deep:
        nominal_closure(robot).close(robot.drive_zero)
        draw_scene(robot).to_html()


def use_table(folder: Path, rng: random.Random, deep: bool, *, kind: str = "table") -> None:
    options = TableOptions(unit=rng.choice((None, "mm")), fill=rng.random() < 0.2)
    found = import_readings(folder / KINDS[kind], folder, options, overwrite=True)
    format_import(found)
    json.loads(format_import_json(found, written=False))
    (folder / "readings.csv").write_text(found.text, encoding="utf-8")
    load_plan(folder)


class Shifted:
    """A correction that is cheap, and refuses what is far."""

    bound = 0.0

    def __call__(self, points: Any) -> tuple[Any, dict[int, str]]:
        far = abs(points).max(axis=1) > 0.2
        return points + 1e-4, {int(i): "is too far" for i in far.nonzero()[0]}


@functools.cache
def correction_of(file: Path) -> Any:
    calibration = load_calibration(file)
    return CorrectionField(calibration, entered_offsets(calibration), within=1e-5)


def use_program(folder: Path, rng: random.Random, deep: bool) -> None:
    """Correct a program; what comes out has lines that are read, and is a program of G0 and G1."""

    def correct(lines: Any, by: Any) -> str:
        interpreter = Interpreter(axes=(0, 1), offsets={"G54": (0.0, 0.0, 0.0)})
        return "".join(ProgramCorrector(interpreter, by, file="p.ngc", within=1e-4).run(lines))

    by = correction_of(folder / "calibration.json") if deep else Shifted()
    text = correct(_lines(folder / "part.ngc", "part.ngc"), by)
    assert max(map(len, text.encode("utf-8", "surrogateescape").split(b"\n"))) <= 252
    again = [f"{line}\n" for line in text.removesuffix("\n").split("\n")]
    assert correct(again, Shifted()).count("\n") >= text.count("\n")


def use_machine(folder: Path, rng: random.Random, deep: bool) -> None:
    """Make a machine again from its sizes."""
    read_machine(folder / "made/machine.yaml")
    if deep:
        with restored(folder / "made"):
            remake_robot(folder / "made")


def use_journal(folder: Path, rng: random.Random, deep: bool) -> None:
    with restored(folder / "recorded"), open_recording(folder / "recorded") as recording:
        assert recording.rows


def use_study(folder: Path, rng: random.Random, deep: bool) -> None:
    with open_results(folder / "study.jsonl", STUDY) as (stored, _):
        assert set(stored) <= set(range(4))


def use_calibration(folder: Path, rng: random.Random, deep: bool) -> None:
    calibration = load_calibration(folder)
    find_entries(calibration)
    if deep:
        again = load_calibration(write_calibration(calibration, folder / "out.json"))
        assert calibration_document(again) == calibration_document(calibration)
        summarize(calibration, details=True)
        list(forward_blocks(calibration, [(["row 1"], np.array([[0.2, 0.2]]))]))
        list(inverse_blocks(calibration, [(["row 1"], np.array([[0.0, 0.0]]))]))
        for chunk in accuracy_rows(calibration, [[0.0, 0.0]]):
            format_points(chunk.values)
        if rng.random() < 0.1:
            draw_scene(calibration).to_html()


def use_errors(folder: Path, rng: random.Random, deep: bool) -> None:
    errors = load_errors(folder / "errors.yaml", load_calibration(folder).robot)
    if deep:
        simulate_session(load_plan(folder / "plan.yaml"), errors)


def use_joints(folder: Path, rng: random.Random, deep: bool) -> None:
    calibration, path = load_calibration(folder), folder / "joints.csv"
    blocks = list(stream_joints(path, calibration.robot, name=str(path)))
    if deep:
        list(forward_blocks(calibration, blocks))


def use_points(folder: Path, rng: random.Random, deep: bool) -> None:
    calibration = load_calibration(folder)
    names, rows = read_points(folder / "points.csv", calibration.robot)
    if deep:
        list(inverse_blocks(calibration, [(names, rows)]))
        list(accuracy_rows(calibration, rows, names=names))


USES: dict[str, Callable[[Path, random.Random, bool], object]] = {
    "session": use_session,
    "plan": use_plan,
    "readings": use_session,
    "robot": use_robot,
    "urdf": use_robot,
    "calibration": use_calibration,
    "errors": use_errors,
    "joints": use_joints,
    "points": use_points,
    "table": use_table,
    "workbook": functools.partial(use_table, kind="workbook"),
    "program": use_program,
    "machine": use_machine,
    "dial": lambda folder, rng, deep: load_dial(folder / "dial.yaml", Equipment()),
    "journal": use_journal,
    "study": use_study,
}
"""What the command line does with a file of each kind."""


def use(kind: str, folder: Path, rng: random.Random, *, thorough: float) -> None:
    """Do with a file what the command line does; slow things with a probability of `thorough`."""
    USES[kind](folder, rng, rng.random() < thorough)


@contextlib.contextmanager
def restored(folder: Path) -> Iterator[None]:
    """A folder whose files are put back as they were."""
    before = {path: path.read_bytes() for path in folder.iterdir()}
    try:
        yield
    finally:
        for path in set(folder.iterdir()) - set(before):
            path.unlink()
        for path, content in before.items():
            path.write_bytes(content)


# ---- workers


def largest_memory() -> float:
    """The most memory that this process ever had, [MiB].

    Not getrusage's: that begins with what the parent had when it started this one.
    """
    status = Path("/proc/self/status").read_text(encoding="ascii")
    line = next(line for line in status.splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) / 1024


def find_outcome(kind: str, folder: Path, rng: random.Random, *, thorough: float) -> str:
    """What became of a case: 'loads', 'refused', or what must not be."""
    before, outcome = time.process_time(), "loads"
    try:
        use(kind, folder, rng, thorough=thorough)
    except OrthocalError as e:
        steers = any(unicodedata.category(c) in STEERING for c in str(e))
        outcome = "unprintable" if steers else "refused"
    except BaseException as e:
        *_, (frame, line) = traceback.walk_tb(e.__traceback__)
        at = f"{frame.f_code.co_filename}:{line}"
        outcome = f"{type(e).__name__} {at} {e}"[:300].replace("\n", " ")
    took, memory = time.process_time() - before, largest_memory()
    if took > LONGEST:
        outcome = f"slow: {took:.1f} s, {outcome}"
    if memory > LARGEST:
        outcome = f"large: {memory:.0f} MiB, {outcome}"
    return outcome


def work(good_folder: Path, seed: int, first: int, last: int, *, thorough: float) -> None:
    """Run cases, with a line on stdout for each; what hangs ends this process."""
    resource.setrlimit(resource.RLIMIT_AS, (6 * 2**30, 6 * 2**30))
    good = {kind: (good_folder / file).read_bytes() for kind, file in KINDS.items()}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copytree(good_folder, folder, dirs_exist_ok=True)
        if thorough:
            for kind in ("calibration", "urdf", "workbook"):  # the first imports take their time
                use(kind, folder, random.Random(0), thorough=1.0)
        for index in range(first, last):
            faulthandler.dump_traceback_later(HANGS, exit=True)
            kind, data, rng = make_case(seed, index, good)
            (folder / KINDS[kind]).write_bytes(data)
            outcome = find_outcome(kind, folder, rng, thorough=thorough)
            (folder / KINDS[kind]).write_bytes(good[kind])
            (folder / KINDS["readings"]).write_bytes(good["readings"])
            tell(f"{index} {kind} {outcome}".encode("ascii", "replace").decode())
            if largest_memory() > LARGEST:
                return  # what follows would be blamed for it


def tell(line: str) -> None:
    """Print a line at once: whoever watches wants to know where this ended."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


@dataclass
class Findings:
    """How cases ended."""

    outcomes: Counter[tuple[str, str]]
    bad: list[tuple[int, str, str]]
    """Index, kind, what happened."""


def run(
    good_folder: Path,
    *,
    seed: int,
    count: int,
    jobs: int = 2,
    thorough: float = 1.0,
    report: Callable[[str], object] = lambda _: None,
) -> Findings:
    """Run cases 0 to count in workers, which are begun anew where one dies."""
    findings = Findings(Counter(), [])

    def watch(first: int, last: int) -> None:
        for index, kind, outcome in run_cases(good_folder, seed, first, last, thorough):
            good = outcome in ("loads", "refused")
            findings.outcomes[kind, outcome if good else "BAD"] += 1
            if not good:
                findings.bad.append((index, kind, outcome))
                report(f"{index} {kind} {outcome}")

    edges = [count * i // jobs for i in range(jobs + 1)]
    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(watch, edges[:-1], edges[1:]))
    return findings


def run_cases(
    good_folder: Path, seed: int, first: int, last: int, thorough: float
) -> Iterator[tuple[int, str, str]]:
    """Index, kind and outcome of cases, one worker after the other."""
    good = {kind: (good_folder / file).read_bytes() for kind, file in KINDS.items()}
    path = os.pathsep.join([os.environ.get("ORTHOCAL_FUZZ_PATH", ""), str(ROOT)])
    environment = {**os.environ, "PYTHONPATH": path, "ORTHOCAL_FUZZ_WORKER": "1"}
    while first < last:
        command = [sys.executable, __file__, "--worker", good_folder, "--seed", seed]
        command += ["--first", first, "--count", last, "--thorough", thorough]
        with subprocess.Popen(
            list(map(str, command)),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
            text=True,
        ) as process:
            for line in process.stdout or ():
                index, kind, outcome = line.rstrip("\n").split(" ", 2)
                yield int(index), kind, outcome
                first = int(index) + 1
        if first < last and process.returncode != 0:
            yield first, make_case(seed, first, good)[0], f"ended with {process.returncode}"
            first += 1


def main() -> None:
    """By hand."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worker", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--thorough", type=float, default=1.0)
    given = parser.parse_args()
    thorough, seed, count = given.thorough, given.seed, given.count
    if given.worker:
        work(given.worker, seed, given.first, count, thorough=thorough)
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        lay_out(folder)
        found = run(folder, seed=seed, count=count, jobs=given.jobs, thorough=thorough, report=tell)
    for key, number in sorted(found.outcomes.items()):
        tell(f"{' '.join(key)} {number}")
    tell(f"{sum(found.outcomes.values())} cases, {len(found.bad)} bad")


if __name__ == "__main__":
    main()
