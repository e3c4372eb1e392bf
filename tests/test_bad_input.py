"""Broken inputs: each has its message, exit code 2, no traceback, and leaves no file behind.

The cases are the rows of `bad_input.txt`, each of which spoils one good input in one way.
"""

from __future__ import annotations

import ast
import json
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
from calibrated import UNJUDGED
from commands import run_orthocal
from folders import files_of

from orthocal import calibrate, load_session
from orthocal.calibration.file import calibration_json

ROOT = Path(__file__).parents[1]
DIFFERENCES = ROOT / "examples/table1/experiment-2"
CYCLES = ROOT / "examples/raw-cycles"

pytestmark = pytest.mark.usefixtures("short_reports")

PROGRAM = "G21 G0 X0 Y0 Z0\nG1 X1 F100\n"
REPEATABLE = {"--error"}
"""Options in the beginnings of commands that may be stated several times."""
ESCAPES = {r"\n": "\n", r"\t": "\t", r"\s": " "}


@dataclass(frozen=True)
class Case:
    """One broken input."""

    name: str
    edits: tuple[tuple[str, str], ...]
    """Each a file and what is done to it."""
    error: str
    """Pattern of stderr without its beginning, 'orthocal: '."""
    command: str
    base: str


def read_cases(text):
    """Cases of a table, with the paths, repetitions and escapes of its cells resolved."""
    cases, file, base, command = [], "", "", ""
    text = "\n".join(line for line in text.splitlines() if not line.startswith("#"))
    for row in re.sub(r"\n {4}", " ", text).split("\n"):
        cells = re.sub(r"\{(.|\\s)\*(\d+)\}", lambda m: unescape(m[1]) * int(m[2]), row)
        if cells.startswith("["):
            file, base, command = cells[1:-1].split(" | ")
        elif cells:
            name, edits, error, *options = cells.split(" | ")
            begin = command.removesuffix("-")
            for option in set(re.findall(r"--[\w-]+", " ".join(options))) - REPEATABLE:
                begin = re.sub(rf" {option} \S+", "", begin)
            found = (re.fullmatch(r"(?:\[(\S+)\] )?(.+)", e) for e in edits.split(" && "))
            cases.append(
                Case(
                    name,
                    tuple((e[1] or file, e[2]) for e in found if e[2] != "-"),
                    f"{{tmp}}/{file}{error}" if error.startswith(":") else error,
                    " ".join([begin, *options]),
                    base,
                )
            )
    return cases


def unescape(text):
    """Text with the line ends, tabs and outer blanks that a cell cannot hold."""
    return re.sub(r"\\[nts]", lambda m: ESCAPES[m[0]], text)


def spoil(path, edit):
    """Change, write, remove or make a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    old, arrow, new = edit.partition(" ->")
    keys, sets, value = edit.partition(" := ")
    if edit == "remove":
        path.unlink()
    elif edit == "mkdir":
        path.mkdir()
    elif edit.startswith("= b"):
        path.write_bytes(ast.literal_eval(edit[2:]))
    elif edit.startswith("="):
        path.write_text(unescape(edit[2:]), encoding="utf-8")
    elif sets:
        set_value(path, keys, json.loads(value))
    else:
        assert arrow, edit
        text, old = path.read_text(encoding="utf-8"), unescape(old)
        assert old in text, f"{path.name} does not hold {old!r}"
        path.write_text(text.replace(old, unescape(new[1:])), encoding="utf-8")


def set_value(path, keys, value):
    """Set the value of a JSON file under keys such as parameters.0.name."""
    inner = document = json.loads(path.read_text(encoding="utf-8"))
    *among, last = (int(k) if k.isdigit() else k for k in keys.split("."))
    for key in among:
        inner = inner[key]
    assert isinstance(last, int) or last in inner, f"{path.name} has no {keys}"
    inner[last] = value
    path.write_text(json.dumps(document, indent=1), encoding="utf-8")


CASES = read_cases((ROOT / "tests/bad_input.txt").read_text(encoding="utf-8"))
BY_NAME = {case.name: case for case in CASES}

CALIBRATE, FORWARD, INVERSE, CORRECT, SIMULATE = (
    BY_NAME[name].command
    for name in (
        *("session-key-unknown", "calibration-missing", "points-in-metres", "program-empty"),
        "simulate-plan-missing",
    )
)


@pytest.fixture(scope="module")
def bases(tmp_path_factory):
    """Good input of every kind: sessions, a plan, a robot's folder, a calibration of it."""
    folder = tmp_path_factory.mktemp("bases")
    for base, example in (("differences", DIFFERENCES), ("cycles", CYCLES)):
        (folder / base).mkdir()
        for file in (example / "session.yaml", example / "readings.csv", CYCLES / "plan.yaml"):
            shutil.copy(file, folder / base)
        shutil.copytree(ROOT / "robots/orthoglide", folder / base / "machine")
    shutil.copytree(folder / "differences", folder / "machine")
    spoil(folder / "machine/session.yaml", "robot: orthoglide -> robot: machine")
    (folder / "planned").mkdir()
    shutil.copy(CYCLES / "plan.yaml", folder / "planned/session.yaml")
    # the folder that the calibration names is no longer there
    made = shutil.copytree(folder / "machine", folder / "made")
    text = calibration_json(calibrate(load_session(made), **UNJUDGED))
    shutil.rmtree(made)
    calibrated = shutil.copytree(folder / "machine", folder / "calibrated")
    (calibrated / "calibration.json").write_text(text, encoding="utf-8")
    (calibrated / "joints.csv").write_text("x_slide_mm,y_slide_mm,z_slide_mm\n310,310,310\n")
    (calibrated / "points.csv").write_text("x_mm,y_mm,z_mm\n0,0,0\n")
    (calibrated / "part.ngc").write_text(PROGRAM)
    return folder


@pytest.fixture
def lay_out(bases, tmp_path):
    def copy(base, edits=()):
        shutil.copytree(bases / base, tmp_path, dirs_exist_ok=True)
        for file, edit in edits:
            spoil(tmp_path / file, edit)
        return tmp_path

    return copy


def arguments(command, folder):
    return [part.replace("{tmp}", str(folder)) for part in command.split()]


def check_refused(case, done, folder):
    assert "Traceback" not in done.stderr
    found = done.stderr.replace(str(folder), "{tmp}")
    pattern = ".*".join(map(re.escape, f"orthocal: {case.error}\n".split("…")))
    assert re.fullmatch(pattern, found), found
    assert done.returncode == 2
    assert done.stdout == ""


def test_cases_have_names_of_their_own():
    assert len(BY_NAME) == len(CASES)


@pytest.mark.parametrize("base", ["differences", "cycles", "machine"])
def test_what_the_cases_spoil_is_good(base, lay_out, tmp_path):
    done = run_orthocal(lay_out(base), *arguments(f"{CALIBRATE} --solver linearised", tmp_path))
    assert done.returncode == 0
    out = f"{tmp_path}/out"
    assert done.stderr == f"Wrote {out}/calibration.json and {out}/report.html\n"


@pytest.mark.parametrize("command", [FORWARD, INVERSE, CORRECT, SIMULATE, "validate"])
def test_what_other_commands_spoil_is_good(command, lay_out, tmp_path):
    folder, expected = lay_out("calibrated"), 0
    if command == "validate":
        # the readings are those before the offsets were entered, which is not confirmed
        spoil(folder / "session.yaml", r"controller: {offsets_mm: [0, 0, 0]}\n ->")
        spoil(folder / "readings.csv", "-0.37 -> -0.36")  # no copy
        command, expected = "validate {tmp}/calibration.json {tmp}", 3
    done = run_orthocal(folder, *arguments(command, tmp_path))
    assert done.returncode == expected
    assert "orthocal:" not in done.stderr


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_bad_input_is_refused(case, lay_out, tmp_path):
    lay_out(case.base, case.edits)
    before = files_of(tmp_path)
    done = run_orthocal(tmp_path, *arguments(case.command, tmp_path))
    check_refused(case, done, tmp_path)
    assert files_of(tmp_path) == before


def test_bad_input_is_refused_in_a_process_of_its_own(lay_out, tmp_path):
    case = BY_NAME["urdf-mimic"]
    lay_out(case.base, case.edits)
    before = files_of(tmp_path)
    command = [sys.executable, "-m", "orthocal", *arguments(case.command, tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, encoding="utf-8", check=False)
    check_refused(case, done, tmp_path)
    assert files_of(tmp_path) == before


@pytest.mark.parametrize(
    "command",
    [
        "",
        "calibrat {tmp}",
        "calibrate",
        "calibrate {tmp} {tmp}",
        "calibrate {tmp} --modell full",
        "calibrate {tmp} --model",
        "forward {tmp}",
        "validate {tmp}",
        "simulate {tmp}/plan.yaml --error x_slide.offset_mm=1.2",
        f"{SIMULATE} --seed -1",
        f"{SIMULATE} --seed lucky",
        f"{CORRECT} --within 0",
        f"{CORRECT} --within nan",
    ],
)
def test_wrong_usage_is_refused(command, lay_out, tmp_path):
    lay_out("differences")
    before = files_of(tmp_path)
    done = run_orthocal(tmp_path, *arguments(command, tmp_path))
    assert done.returncode == 2
    assert "Traceback" not in done.stdout + done.stderr
    assert files_of(tmp_path) == before
