"""Examples run headless and stay short; the README's commands and Python run as they stand."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest
from conftest import ROOT

SCRIPTS = sorted((ROOT / "examples").glob("[0-9]*.py"))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.name)
def test_an_example_runs_from_anywhere(script, tmp_path):
    done = subprocess.run(
        [sys.executable, script], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
    assert done.stdout
    assert len(script.read_text().splitlines()) <= 80


def blocks(language):
    text = (ROOT / "README.md").read_text()
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


def test_the_readmes_python_runs(root):
    for code in blocks("python"):
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True
        )
        assert done.stderr == ""


def test_the_readmes_commands_run(root, tmp_path):
    """Those of orthocal itself, in a copy of the examples; `make` is what runs these tests."""
    (tmp_path / "examples").symlink_to(root / "examples")
    commands = [
        line
        for block in blocks("sh")
        for line in block.splitlines()
        if line.startswith(("orthocal ", "printf "))
    ]
    assert len(commands) >= 5
    for command in commands:
        words = command.replace("orthocal ", f"{sys.executable} -m orthocal.cli ", 1)
        done = subprocess.run(words, shell=True, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, f"{command}: {done.stderr}"


def test_the_readmes_printed_result_is_the_real_one(root):
    shown = next(b for b in blocks("text") if "What was identified" in b)
    done = subprocess.run(
        [sys.executable, "-m", "orthocal.cli", "calibrate", "examples/table1/experiment-2"],
        cwd=root,
        capture_output=True,
        text=True,
        check=True,
    )
    timeless = [re.sub(r"\d+\.\d+ s$", "", line) for line in done.stdout.splitlines()]
    for line in shown.splitlines():
        assert re.sub(r"\d+\.\d+ s$", "", line.rstrip()) in timeless
