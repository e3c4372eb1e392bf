"""One command of each group, as a user runs it: exit code 0 and no warning.

`.ci/smoke.py` runs this file on other Pythons and with the lowest versions that pyproject.toml
allows. In the main job, a process of its own, a warning of a library is printed on stderr.
"""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from commands import run_orthocal

pytestmark = [
    pytest.mark.smoke,
    pytest.mark.usefixtures("quick_plans", "module_without_sensor_gains"),
]


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    return tmp_path_factory.mktemp("smoke")


def run(*words, cwd):
    done = run_orthocal(cwd, *words)
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    return done.stdout


def test_main_job(root, workplace):
    words = ["calibrate", root / "examples/table1/experiment-2", "--out", "main"]
    command = [sys.executable, "-m", "orthocal", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=workplace, check=False)
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    for offset in ("-0.527", "+0.592", "-1.761"):  # exact offsets of Experiment 2
        assert offset in done.stdout
    assert (workplace / "main/report.html").is_file()


def test_prepare_measure_calibrate_and_use(root, workplace):
    words = ["--leg-mm", 250, "--travel-mm", "100:325", "--attachment-mm", 30]
    words += ["--rods-apart-mm", 60, "--rod-radius-mm", 4, "--counts", "up,up,up"]
    words += ["--at-zero-mm", 0, "--tolerance", "*.offset_mm=4", "--hours", 0.3]
    run("new", "mill", *words, cwd=workplace)
    assert (workplace / "mill/first/sheet.html").is_file()
    run("view", "mill", "--html", "mill.html", cwd=workplace)
    draw = ["--draw", "*", "--seed", 3]
    run("simulate", "mill/first", *draw, "--out", "readings", cwd=workplace)
    run("check", "readings", cwd=workplace)
    text = run("calibrate", "readings", "--json", cwd=workplace)  # the main job draws the report
    assert json.loads(text)["schema"]
    calibrated = workplace / "calibrated.json"
    calibrated.write_text(text, encoding="utf-8")
    run("compare", root / "examples/raw-cycles", cwd=workplace)
    run("accuracy", calibrated, cwd=workplace)
    latched = ["--latched", "+,+,+"]
    run("export", calibrated, "--to", "linuxcnc", *latched, "--out", "linuxcnc", cwd=workplace)
    (workplace / "part.ngc").write_text("G21 G90\nG0 X0 Y0 Z0\nG1 X10 Y-10 F600\nM2\n")
    run("correct", calibrated, "part.ngc", "--out", "corrected.ngc", cwd=workplace)
    assert (workplace / "corrected.ngc").is_file()


def test_study(root, workplace):
    words = ["study", "bootstrap", root / "examples/workshop", "--model", "offsets"]
    words += ["--draws", 20, "--seed", 1, "--workers", 2]
    run(*words, "--out", "study", cwd=workplace)
