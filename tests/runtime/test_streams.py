"""Processes with full, closed or unread standard streams, and Ctrl-C."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest
from calibrated import EXPERIMENT_2, UNJUDGED, calibrated
from commands import run_orthocal
from conftest import load_afresh

from orthocal import load_robot
from orthocal.calibration.file import write_calibration
from orthocal.errors import OrthocalError

COMMAND = [sys.executable, "-m", "orthocal"]
TIMEOUT = 120.0
"""Longest time of a process, [s]."""


@pytest.fixture(scope="module")
def folder(root, tmp_path_factory):
    """Directory of a session, its calibration and a table of joint coordinates."""
    folder = tmp_path_factory.mktemp("calibrated")
    for name in ("session.yaml", "readings.csv"):
        shutil.copy(root / "examples/table1/experiment-2" / name, folder)
    write_calibration(calibrated(EXPERIMENT_2, **UNJUDGED), folder / "calibration.json")
    rows = "310,310,310\n" * 3000
    (folder / "joints.csv").write_text(f"x_slide_mm,y_slide_mm,z_slide_mm\n{rows}")
    return folder


def run(words, redirection="", **kwargs):
    """Run a command in a shell with a redirection; returns exit code, stdout and stderr."""
    command = " ".join([*COMMAND, *(f"'{w}'" for w in map(str, words)), redirection])
    done = subprocess.run(
        ["sh", "-c", command], capture_output=True, timeout=TIMEOUT, check=False, **kwargs
    )
    err = done.stderr.decode(errors="replace")
    assert "Traceback" not in err
    assert "Exception ignored" not in err
    return done.returncode, done.stdout.decode(errors="replace"), err


@pytest.mark.parametrize(
    ("words", "redirection", "problem"),
    [
        ("--version", ">&-", "it is closed"),
        ("calibrate . --json --out out", "> /dev/full", "No space left on device"),
    ],
)
def test_unwritable_output_ends_with_1(words, redirection, problem, folder):
    code, _, err = run(words.split(), redirection, cwd=folder)
    assert code == 1
    assert err == f"orthocal: standard output: cannot be written: {problem}\n"
    assert not (folder / "out").exists()


def test_closed_pipe_is_not_an_error(folder):
    with subprocess.Popen(
        [*COMMAND, "forward", "calibration.json", "joints.csv"],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        line = process.stdout.readline()
        process.stdout.close()
        err = process.stderr.read()
    assert line
    assert process.returncode == 0
    assert err == ""


def test_unwritable_error_stream_is_ignored(folder):
    assert run(["calibrate", "nothing"], "2> /dev/full", cwd=folder)[0] == 2
    words = ["export", "calibration.json", "--to", "yaml", "--anyway", "--out", "silent"]
    assert run(words, "2>&-", cwd=folder)[0] == 0
    # no written file has the descriptor of the closed stream
    assert (folder / "silent/errors.yaml").read_text().startswith("# ")


def test_no_temporary_directory_is_needed(monkeypatch):
    """Messages of Pinocchio are captured in a temporary file if possible."""
    calls = []

    def fail():
        calls.append(1)
        raise FileNotFoundError(2, "No usable temporary directory")

    monkeypatch.setattr(tempfile, "TemporaryFile", fail)
    assert load_afresh("orthoglide").name == "orthoglide"
    assert calls


@pytest.mark.parametrize("name", [b"caf\xe9", b"a\x1b[31mb", b"a\nb"])
def test_directory_name_that_documents_cannot_contain_is_refused(name, folder, tmp_path):
    odd = tmp_path / os.fsdecode(name)
    odd.mkdir()
    for file in ("session.yaml", "readings.csv"):
        shutil.copy(folder / file, odd / file)
    done = run_orthocal(tmp_path, "calibrate", odd, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert "which documents cannot contain; rename the file or directory" in done.stderr
    assert done.stderr.isascii()
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_robot_directory_name_that_documents_cannot_contain_is_refused(root, tmp_path):
    odd = tmp_path / "a\x1b[31mb"
    shutil.copytree(root / "tests/robots/biglide", odd / "biglide")
    with pytest.raises(OrthocalError, match=r"contains '\\x1b', which documents cannot contain"):
        load_robot(odd / "biglide")


def test_control_characters_of_arguments_are_escaped(folder):
    odd = "a\x1b[31m\u202e"
    for words in (["calibrate", odd], [odd], ["calibrate", ".", "--model", odd]):
        done = run_orthocal(folder, *words)
        assert done.returncode == 2
        assert r"a\x1b[31m\u202e" in done.stderr
        assert "\x1b" not in done.stderr


# ---- Ctrl-C


def interrupt(words, delay, cwd):
    """Start a command and send SIGINT.

    Returns:
        Exit code, None if the command had ended before; time until the end, [s]; stderr.
    """
    process = subprocess.Popen(
        [*COMMAND, *map(str, words)], cwd=cwd, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    maps = Path(f"/proc/{process.pid}/maps")
    while process.poll() is None and maps.exists() and "numpy" not in maps.read_text():
        time.sleep(0.02)  # the duration of the start differs among computers
    time.sleep(delay)
    done = process.poll() is not None
    began = time.monotonic()
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=TIMEOUT)
    return None if done else process.returncode, time.monotonic() - began, err.decode()


def test_ctrl_c_ends_the_process_at_once(root, tmp_path):
    """While libraries are loaded, and while functions are built or the solver iterates."""
    options = ["--model", "full", "--profile", "*.offset", "--out", tmp_path / "out"]
    words = ["calibrate", root / "examples/raw-cycles", *options]
    for delay in (0.0, 0.8):
        code, seconds, err = interrupt(words, delay, tmp_path)
        assert code == 130
        assert seconds < 1.0
        assert err == ""
        assert list(tmp_path.iterdir()) == []


RAISED = """
import os, signal, sys
from pathlib import Path
from orthocal import calibrate, load_session
import orthocal.estimation.solvers.ipopt as nlp
session = load_session(sys.argv[1])
original = nlp.NonlinearProgram._pack
def pack(self, *args):
    signal.setitimer(signal.ITIMER_REAL, 0.001)  # once Ipopt runs
    return original(self, *args)
nlp.NonlinearProgram._pack = pack
signal.signal(signal.SIGALRM, lambda *_: os.kill(os.getpid(), signal.SIGINT))
try:
    calibrate(session, "full")
except KeyboardInterrupt:
    print("raised")
"""


def test_ctrl_c_within_ipopt_raises_in_scripts(root):
    """CasADi alone would report a failed solve or continue."""
    done = subprocess.run(
        [sys.executable, "-c", RAISED, str(root / "examples/raw-cycles")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "raised\n", done.stderr


def test_ctrl_c_while_files_are_staged_leaves_no_file(tmp_path):
    code = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "import orthocal.io.files as files\n"
        "from orthocal.runtime.interrupts import ending_at_interrupt\n"
        "def fsync(_): os.kill(os.getpid(), signal.SIGINT)\n"
        "os.fsync = fsync\n"
        "with ending_at_interrupt():\n"
        "    files.write_files(Path(sys.argv[1]), {'a': 'x', 'b': 'y'})\n"
    )
    folder = tmp_path / "new/folder"
    subprocess.run([sys.executable, "-c", code, str(folder)], capture_output=True, check=False)
    assert list(tmp_path.iterdir()) == []
