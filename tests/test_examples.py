"""Examples run headless and stay short; the README's commands and Python run as they stand."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from functools import cache

import numpy as np
import pytest
from conftest import ROOT

from orthocal import calibrate, draw_scene, load_session
from orthocal.errors import NotIdentifiableError

SCRIPTS = sorted((ROOT / "examples").glob("[0-9]*.py"))


@cache
def run(*words):
    """A script, or orthocal with arguments; once, for all that look at what it prints."""
    script = words[0].endswith(".py")
    command = [sys.executable, *(() if script else ("-m", "orthocal.cli")), *words]
    with tempfile.TemporaryDirectory() as elsewhere:
        return subprocess.run(
            command, cwd=elsewhere if script else ROOT, capture_output=True, text=True
        )


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.name)
def test_an_example_runs_from_anywhere(script):
    done = run(str(script))
    assert done.returncode == 0
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
        # a comparison that finds error of the model says so by its exit code
        expected = 3 if "compare examples/table1" in command else 0
        assert done.returncode == expected, f"{command}: {done.stderr}"


@pytest.mark.parametrize(
    ("title", "command"),
    [
        ("Calibration of orthoglide", "calibrate examples/table1/experiment-2"),
        ("What was identified\n", "calibrate examples/table1/experiment-2 --details"),
        ("At the tool\n", "calibrate examples/table1/experiment-2 --details"),
        ("Verdict", "compare examples/table1/experiment-2"),
        ("The paper's six equations miss", "study linearisation orthoglide"),
    ],
)
def test_the_readmes_printed_results_are_the_real_ones(title, command):
    shown = next(b for b in blocks("text") if title in b)
    done = run(*command.split())
    printed = [line.rstrip() for line in done.stdout.splitlines()]
    for line in shown.splitlines():
        assert line.rstrip() in printed
    if title.startswith("Calibration"):  # the whole of it
        assert [line.rstrip() for line in shown.splitlines()] == printed


def test_what_the_readme_says_of_the_papers_readings_is_what_the_example_prints():
    text = " ".join((ROOT / "README.md").read_text().split())
    script = ROOT / "examples/02_what_readings_are_worth.py"
    done = run(str(script))
    rows = {}
    for line in done.stdout.split("\n\n")[0].splitlines()[1:]:
        rows[line[:36].strip()] = [float(v) / 1e3 for v in line[36:].split()]
    kept = {label: sizes[1] for label, sizes in rows.items()}
    assert (
        f"leave about {kept['first round, offsets']:.2f} mm with offsets alone and "
        f"{kept['first round, full']:.2f} mm with all errors"
    ) in text
    assert (
        f"once more {kept['offsets entered, offsets']:.2f} and "
        f"{kept['offsets entered, full']:.3f} mm"
    ) in text
    promised, left = rows["as of a line, exactly"]
    assert f"the first 18 leave {left:.2f} mm and promise half of that" in text
    assert promised == pytest.approx(0.5 * left, rel=0.1)
    for label in ("first round, full", "offsets entered, full"):
        promised, left = rows[label]
        assert left < 1.15 * promised  # as promised


def test_what_the_readme_says_of_its_picture_and_of_what_remains_is_so(root):
    text = " ".join((ROOT / "README.md").read_text().split())
    calibration = calibrate(root / "examples/table1/experiment-2")
    assert "drawn twelve times its size" in text
    assert draw_scene(calibration).exaggeration == 12.0
    assert "what remains is ten times what the gauge itself would leave" in text
    noise, gauge = calibration.noise, calibration.session.gauge_sigma
    assert noise.residual_sigma / gauge == pytest.approx(10.0, abs=0.5)


def test_the_session_that_the_readme_shows_can_be_read(tmp_path):
    (session,), (readings,) = blocks("yaml"), blocks("csv")
    (tmp_path / "session.yaml").write_text(session)
    (tmp_path / "readings.csv").write_text(readings)
    loaded = load_session(tmp_path)
    np.testing.assert_allclose(loaded.values, [0.0, 0.21e-3, -0.18e-3], rtol=1e-12)
    with pytest.raises(NotIdentifiableError, match=r"do not determine z_slide\.offset"):
        calibrate(loaded)  # "If readings leave an offset open, orthocal says so."
