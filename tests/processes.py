"""Other processes: those that one has begun, and whether they are still there."""

from __future__ import annotations

import time


def children_of(pid):
    """Processes that a process has begun and not yet seen end."""
    with open(f"/proc/{pid}/task/{pid}/children") as stream:
        return stream.read().split()


def is_running(pid):
    """Whether there is such a process, and it has not ended."""
    try:
        with open(f"/proc/{pid}/stat") as stream:
            return stream.read().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def until(condition, seconds=60.0):
    """Wait for something to come true."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not come to that"
        time.sleep(0.05)
