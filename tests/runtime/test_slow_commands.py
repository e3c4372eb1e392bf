"""A line on a terminal while a command works for a long time."""

from __future__ import annotations

import os
import pty
import signal
import time

import pytest

from orthocal.runtime import streams
from orthocal.runtime.streams import announced_if_slow


@pytest.fixture
def terminal(monkeypatch):
    ours, theirs = pty.openpty()
    monkeypatch.setattr(streams, "STDERR", theirs)
    yield ours
    os.close(ours)
    os.close(theirs)


def test_a_slow_command_is_announced_once_on_a_terminal(terminal, monkeypatch):
    monkeypatch.setattr(streams, "PATIENCE", 0.05)
    before = signal.getsignal(signal.SIGALRM)
    with announced_if_slow("working"):
        time.sleep(0.2)
    assert os.read(terminal, 100) == b"working\r\n"
    os.set_blocking(terminal, False)
    monkeypatch.setattr(streams, "PATIENCE", 5.0)
    with announced_if_slow("working"):
        pass
    with pytest.raises(BlockingIOError):
        os.read(terminal, 100)
    assert signal.getsignal(signal.SIGALRM) == before
    assert signal.getitimer(signal.ITIMER_REAL)[0] == 0.0


def test_a_file_or_a_pipe_receives_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(streams, "PATIENCE", 0.01)
    with (tmp_path / "stderr").open("wb") as file:
        monkeypatch.setattr(streams, "STDERR", file.fileno())
        with announced_if_slow("working"):
            time.sleep(0.05)
    assert (tmp_path / "stderr").read_bytes() == b""
