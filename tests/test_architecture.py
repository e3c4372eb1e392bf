"""Imports go one way, functions are short, and start-up stays lazy; Ruff finds what prints."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter

import pytest
from conftest import ROOT

import orthocal

BASE = "arrays text arguments errors units runtime io"
MACHINE = f"{BASE} printers robot effects kinematics sensors session observation measurement"
ESTIMATE = f"{MACHINE} statistics estimation"

ALLOWED = {
    "arrays": "",
    "text": "",
    "units": "",
    "arguments": "",
    "errors": "text",
    "runtime": "text errors",
    "io": "arrays text arguments errors units runtime",
    "gcode": BASE,
    "printers": BASE,
    "robot": BASE,
    "effects": f"{BASE} robot",
    "builder": f"{BASE} robot effects",
    "kinematics": f"{BASE} robot effects",
    "sensors": f"{BASE} robot effects kinematics",
    "session": f"{BASE} printers robot effects kinematics sensors",
    "observation": f"{BASE} printers robot effects kinematics sensors session",
    "measurement": f"{BASE} printers builder robot effects kinematics sensors session observation",
    "statistics": f"{BASE} robot observation",
    "estimation": f"{MACHINE} statistics",
    "hypotheses": ESTIMATE,
    "calibration": f"{ESTIMATE} hypotheses",
    "assessment": f"{ESTIMATE} hypotheses calibration",
    "planning": f"{ESTIMATE} hypotheses assessment",
    "study": f"{ESTIMATE} hypotheses assessment planning",
    "export": f"{BASE} printers robot effects kinematics calibration assessment",
    "viewer": f"{BASE} robot",
    "output": f"{ESTIMATE} hypotheses calibration assessment planning study viewer",
    "cli": f"{ESTIMATE} builder hypotheses calibration assessment planning study export gcode "
    "viewer output",
    "__main__": "cli runtime",
}
"""Packages that each package may import besides itself."""

MODULES = sorted((ROOT / "orthocal").rglob("*.py"))


def stage(path):
    return path.relative_to(ROOT / "orthocal").with_suffix("").parts[0]


@cache
def kept_nodes(path):
    """Imports and functions in a module, wherever in it."""
    kinds = ast.ImportFrom | ast.Import | ast.FunctionDef | ast.AsyncFunctionDef
    nodes = [ast.parse(path.read_text(encoding="utf-8"))]
    for node in nodes:
        inner = ast.iter_child_nodes(node)
        nodes += (n for n in inner if isinstance(n, ast.stmt | ast.ExceptHandler | ast.match_case))
    return [node for node in nodes if isinstance(node, kinds)]


def imported(path):
    """Names of the modules of this package that a module imports, wherever in it."""
    for node in kept_nodes(path):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("orthocal"):
            yield node.module
        elif isinstance(node, ast.Import):
            yield from (a.name for a in node.names if a.name.startswith("orthocal"))


def test_a_package_imports_what_it_may():
    refused = [
        f"{path.relative_to(ROOT)} imports {module}"
        for path in MODULES
        if path != ROOT / "orthocal/__init__.py"
        for module in imported(path)
        if module != "orthocal"
        and module.split(".")[1] not in (stage(path), *ALLOWED[stage(path)].split())
    ]
    assert refused == []


def test_rooms_are_in_an_order():
    """No room may import another that may import it, however far around."""
    TopologicalSorter({room: allowed.split() for room, allowed in ALLOWED.items()}).prepare()
    assert {stage(p) for p in MODULES if p.parent != ROOT / "orthocal"} <= set(ALLOWED)


def test_modules_within_a_stage_do_not_import_in_circles():
    graph = {
        ".".join(p.relative_to(ROOT).with_suffix("").parts): set(imported(p))
        for p in MODULES
        if p.name != "__init__.py"
    }
    TopologicalSorter(graph).prepare()


def test_contributing_names_what_exists():
    """Python files, and names followed by a file, such as `NAME` (`file.py`)."""
    text = " ".join((ROOT / "CONTRIBUTING.md").read_text().split())
    paths = [p for folder in ("orthocal", "tests", "docs") for p in (ROOT / folder).rglob("*.py")]
    code = {p.as_posix(): p.read_text() for p in paths}

    def find(file):
        return [text for path, text in code.items() if path.endswith(f"/{file}")]

    files = re.findall(r"`([\w/]+\.py)`", text)
    assert [file for file in files if not find(file)] == []
    name = r"`[\w.]*\w(?<!\.py)`"
    names_and_file = rf"({name}(?:(?:, |,? and |,? or ){name})*)(?: \(| in | of )`([\w/]+\.py)`"
    mentions = re.findall(names_and_file, text)
    assert len(mentions) > 20
    missing = [
        f"{name} in {file}"
        for names, file in mentions
        for name in re.findall(r"(\w+)`", names)
        if not any(re.search(rf"\b{name}\b", found) for found in find(file))
    ]
    assert missing == []
    constants_and_classes = set(re.findall(r"`([A-Z]\w+)`", text))
    assert constants_and_classes <= set(re.findall(r"\b[A-Z]\w+", "".join(code.values())))


def test_functions_have_at_most_60_lines():
    longer = {
        f"{path.relative_to(ROOT)}:{node.lineno} {node.name}"
        for path in MODULES
        for node in kept_nodes(path)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and node.end_lineno - node.lineno >= 60
    }
    assert not longer


def test_type_checkers_know_the_public_names():
    stub = ast.parse((ROOT / "orthocal/__init__.pyi").read_text())
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    assert {a.name: n.module for n in imports for a in n.names} == orthocal._MODULES
    assert all(a.name == a.asname for n in imports for a in n.names)  # names of the package


def test_everything_exported_is_there():
    for name in orthocal.__all__:
        assert getattr(orthocal, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        orthocal.nonsense  # noqa: B018


def modules_after(*arguments):
    """Names of the modules that a command has imported when it ends."""
    code = (
        f"import sys; sys.argv = ['orthocal', *{arguments!r}]\n"
        "from orthocal.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "print('LOADED', *sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.rpartition("LOADED ")[2].split())


HEAVY = {
    *("numpy", "casadi", "pinocchio", "scipy", "yourdfpy", "pydantic", "meshcat"),
    *("matplotlib", "tornado", "coal"),
}


def test_help_imports_nothing_heavy():
    assert not HEAVY & modules_after("--help")


UNNEEDED = {
    *("assessment.printer_settings", "builder", "export", "output.report", "planning"),
    *("printers.firmwares", "printers.log", "study", "viewer"),
    *("io.tables.table", "io.tables.workbook", "measurement.importing", "runtime.worker_pool"),
    *("sensors.ball_bar", "sensors.distance", "sensors.probe", "sensors.tool_indicator"),
}
"""Modules of orthocal that are not needed to calibrate with readings of leg indicators."""

UNNEEDED_LIBRARIES = {
    *("matplotlib", "meshcat", "multiprocessing", "threadpoolctl", "tornado", "yourdfpy"),
    *("scipy.interpolate", "scipy.optimize", "scipy.sparse", "scipy.spatial"),
    "scipy.stats",
}


def test_calibrate_imports_what_it_needs():
    command = "calibrate", str(ROOT / "examples/table1/experiment-2")
    unneeded = UNNEEDED_LIBRARIES | {f"orthocal.{name}" for name in UNNEEDED}
    loaded = modules_after(*command)
    if unneeded & loaded:  # to compile functions that the cache does not hold
        loaded = modules_after(*command)
    assert "orthocal.estimation.fit" in loaded
    assert not unneeded & loaded
