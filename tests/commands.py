"""Commands as a shell has them, run in this process; without `--workers` they begin no others."""

from __future__ import annotations

import io
import re
import runpy
import shlex
import subprocess
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from typing import NamedTuple
from unittest.mock import patch

from orthocal.cli import main
from orthocal.runtime import worker_pool


class Done(NamedTuple):
    """What a command has printed, and how it ended."""

    returncode: int
    stdout: str
    stderr: str


class Terminal(io.TextIOWrapper):
    """Input that is typed at a terminal."""

    def isatty(self):
        return True


def run_here(folder, act, *, argv=("orthocal",), typed="", terminal=False):
    """Do something as a program does: in a folder, with streams and arguments of its own."""
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8") for _ in range(2))
    kind = Terminal if terminal else io.TextIOWrapper
    lines = typed.encode() if isinstance(typed, str) else typed
    stdin = kind(io.BytesIO(lines), encoding="utf-8")
    code = 0
    with chdir(folder), redirect_stdout(out), redirect_stderr(err):
        with (
            patch.object(sys, "argv", list(argv)),
            patch.object(sys, "stdin", stdin),
            patch.object(worker_pool, "available_cores", lambda: 1),
        ):
            try:
                act()
            except SystemExit as e:
                code = e.code or 0
            for stream in (out, err):
                stream.flush()
    printed = [stream.buffer.getvalue().decode() for stream in (out, err)]
    assert not any("Traceback" in text for text in printed)
    return Done(code, *printed)


def run_orthocal(folder, *words, typed="", terminal=False):
    """`orthocal` with arguments, in a folder; what is typed comes from a pipe or a terminal."""
    return run_here(
        folder, main, argv=("orthocal", *map(str, words)), typed=typed, terminal=terminal
    )


def run_script(folder, path):
    """A script, in a folder."""
    return run_here(folder, lambda: runpy.run_path(str(path), run_name="__main__"), argv=[path])


def run_line(folder, line):
    """A line of a shell; orthocal's alone, and what they write to a file, without a shell."""
    command, target = re.fullmatch(r"(.*?)(?: > (\S+))?\s*", line).groups()
    words = shlex.split(command)
    if words[0] != "orthocal" or re.search(r"[|&;<>$`]", re.sub(r"'[^']*'", "", command)):
        done = subprocess.run(line, shell=True, cwd=folder, capture_output=True, text=True)
        return Done(done.returncode, done.stdout, done.stderr)
    done = run_orthocal(folder, *words[1:])
    if target is None:
        return done
    (folder / target).write_text(done.stdout)
    return Done(done.returncode, "", done.stderr)


def orthocal(*words, **typed):
    """`orthocal` with arguments, where the tests run."""
    return run_orthocal(".", *words, **typed)
