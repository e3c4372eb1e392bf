"""A line on a terminal while a command works for a long time."""

from __future__ import annotations

import os
import pty
import signal
import time

import pytest

from orthocal.runtime.streams import announced_if_slow


@pytest.fixture
def terminal():
    ours, theirs = pty.openpty()
    yield ours, theirs
    os.close(ours)
    os.close(theirs)


def test_a_slow_command_is_announced_once_on_a_terminal(terminal):
    ours, theirs = terminal
    before = signal.getsignal(signal.SIGALRM)
    with announced_if_slow("working", after=0.05, descriptor=theirs):
        time.sleep(0.2)
    assert os.read(ours, 100) == b"working\r\n"
    os.set_blocking(ours, False)
    with announced_if_slow("working", after=5.0, descriptor=theirs):
        pass
    with pytest.raises(BlockingIOError):
        os.read(ours, 100)
    assert signal.getsignal(signal.SIGALRM) == before
    assert signal.getitimer(signal.ITIMER_REAL)[0] == 0.0


def test_a_file_or_a_pipe_receives_nothing(tmp_path):
    with (tmp_path / "stderr").open("wb") as file:
        with announced_if_slow("working", after=0.01, descriptor=file.fileno()):
            time.sleep(0.05)
    assert (tmp_path / "stderr").read_bytes() == b""
