"""Ctrl-C while worker processes are started."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap

import pytest
from processes import is_running, until

START = """
    import os, signal, time
    from pathlib import Path
    from orthocal.runtime import worker_pool
    from orthocal.runtime.interrupts import INTERRUPTED

    def interrupt():
        os.kill(os.getpid(), signal.SIGINT)

    def work(task):
        Path({folder!r}, str(os.getpid())).touch()
        time.sleep(60)

    os.register_at_fork({moment}=interrupt)
    try:
        for _ in worker_pool.run_in_parallel(work, range(4), 2, killed="killed"):
            pass
    except KeyboardInterrupt:
        os._exit(INTERRUPTED)
"""


def start(moment, folder):
    """A process that forks two workers; a SIGINT arrives during each fork."""
    code = textwrap.dedent(START.format(moment=moment, folder=str(folder)))
    return subprocess.Popen(
        [sys.executable, "-c", code],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )


@pytest.mark.parametrize("moment", ["before", "after_in_parent"])
def test_interrupt_during_fork_reaches_the_parent(moment, tmp_path):
    process = start(moment, tmp_path)
    _, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (130, "")


def test_interrupt_during_fork_prints_no_traceback_of_a_worker(tmp_path):
    process = start("after_in_child", tmp_path)
    until(lambda: len(list(tmp_path.iterdir())) == 2)  # both workers are at work all the same
    workers = [int(file.name) for file in tmp_path.iterdir()]
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (130, "")
    assert not any(is_running(worker) for worker in workers)
