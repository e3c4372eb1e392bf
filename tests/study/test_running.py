"""Studies that are stopped, killed or distributed produce the same table, byte by byte."""

from __future__ import annotations

import fcntl
import json
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from functools import partial

import numpy as np
import pandas as pd
import polars as pl
import pytest
from gauges import exact
from processes import children_of, is_running, until

from orthocal import load_session
from orthocal.builder.build import make_robot
from orthocal.builder.orthoglide import Orthoglide
from orthocal.effects import loading
from orthocal.errors import OrthocalError
from orthocal.output.text.study import report_study, study_json
from orthocal.robot import loading as robot_loading
from orthocal.runtime import worker_pool as cores
from orthocal.study import runner as running
from orthocal.study.bootstrap import build_bootstrap_study
from orthocal.study.linearisation import build_linearisation_study
from orthocal.study.runner import JOURNAL, open_results, run_study, to_parquet
from orthocal.study.study import prepare_once, round_cell, run_task

KILLS = 3
DRAWS = 15
"""Draws of each task."""
FORK = multiprocessing.get_context("fork")


def session_of(root):
    return exact(load_session(root / "examples/table1/experiment-2"))


def results(table):
    return to_parquet(table), study_json(table, report_study(table))


@pytest.fixture(scope="module")
def study(root):
    """Twelve tasks of some hundredths of a second."""
    return small_tasks(build_bootstrap_study(session_of(root), draws=12 * DRAWS))


def small_tasks(found):
    """The study with few draws in each task; its copies in other processes have as few."""
    object.__setattr__(found, "cases_per_task", DRAWS)
    run_task(found, 0)  # what is prepared is there in every fork
    return found


@pytest.fixture(scope="module")
def undisturbed(study):
    return run_study(study)


def test_killed_and_resumed_several_times(study, undisturbed, tmp_path):
    rng = np.random.default_rng(0)
    began = time.monotonic()
    run_task(study, 1)
    a_task = time.monotonic() - began
    kept, journal = set(), tmp_path / JOURNAL
    for _ in range(KILLS):
        child = FORK.Process(target=run_study, args=(study,), kwargs={"directory": tmp_path})
        child.start()
        written = 1 + len(kept)  # lines: the first one describes the study
        while child.is_alive() and not (
            journal.exists() and journal.read_bytes().count(b"\n") > written
        ):
            time.sleep(0.1 * a_task)
        time.sleep(float(rng.uniform(0.0, a_task)))
        os.kill(child.pid, signal.SIGKILL)
        child.join()
        with open_results(journal, study) as (stored, _):
            assert kept <= set(stored)
            kept = set(stored)
        assert kept
    again = run_study(study, directory=tmp_path)
    assert results(again) == results(undisturbed)


def test_only_an_incomplete_line_is_computed_again(study, undisturbed, tmp_path, monkeypatch):
    run_study(study, directory=tmp_path)
    told = []
    with monkeypatch.context() as patched:  # finished tasks are not computed again
        patched.setattr(running, "run_task", None)
        run_study(study, directory=tmp_path, report=told.append)
    assert [(p.done, p.resumed) for p in told] == [(12 * DRAWS, 12 * DRAWS)]
    file = tmp_path / JOURNAL
    whole = file.read_bytes()
    for cut in (1, 100, len(whole.splitlines(keepends=True)[-1])):
        file.write_bytes(whole[:-cut])
        assert results(run_study(study, directory=tmp_path)) == results(undisturbed)
        assert file.read_bytes() == whole


@pytest.mark.parametrize(("workers", "forked"), [(2, False), (3, True)])
def test_results_do_not_depend_on_the_number_of_workers(
    study, undisturbed, workers, forked, monkeypatch
):
    monkeypatch.setattr(cores, "can_fork", lambda: forked)
    assert results(run_study(study, workers=workers)) == results(undisturbed)


def test_a_process_with_threads_is_not_forked():
    code = (
        "import threading, time\nfrom orthocal.runtime.worker_pool import can_fork\n"
        "assert can_fork()\n"
        "threading.Thread(target=time.sleep, args=(60,), daemon=True).start()\n"
        "assert not can_fork()\n"
    )
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment)


def test_a_killed_worker(study, tmp_path, monkeypatch):
    monkeypatch.setattr(cores, "can_fork", lambda: True)
    here = os.getpid()
    run = running.run_task

    def kill_itself(study, task):
        if task == 5:
            assert os.getpid() != here
            os.kill(os.getpid(), signal.SIGKILL)
        return run(study, task)

    monkeypatch.setattr(running, "run_task", kill_itself)
    with pytest.raises(OrthocalError, match="a process of the study was killed"):
        run_study(study, workers=2, directory=tmp_path)
    assert not forked_workers()
    with open_results(tmp_path / JOURNAL, study) as (stored, _):
        assert stored
        assert 5 not in stored


@pytest.mark.parametrize("sendable", [True, False])
def test_an_error_of_a_worker_is_raised(study, monkeypatch, sendable):
    class OwnError(Exception):
        """Of no module: it cannot be sent."""

    monkeypatch.setattr(cores, "can_fork", lambda: True)
    error = ValueError("found nothing") if sendable else OwnError("found nothing")

    def fail(study, task):
        raise error

    monkeypatch.setattr(running, "run_task", fail)
    with pytest.raises(ValueError if sendable else RuntimeError, match="found nothing"):
        run_study(study, workers=2)


def test_workers_hold_no_lock(study, tmp_path, monkeypatch):
    """Whoever goes on after a kill need not wait until the last worker has noticed it."""
    monkeypatch.setattr(cores, "can_fork", lambda: True)
    locked = tmp_path / "held"
    descriptor = os.open(locked, os.O_RDWR | os.O_CREAT)
    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    tasks = cores.run_in_parallel(partial(run_task, study), range(6), 2, killed="")
    next(tasks)
    os.close(descriptor)
    other = os.open(locked, os.O_RDWR)
    until(lambda: is_free(other))  # while both are still there
    assert len(forked_workers()) == 2
    os.close(other)
    tasks.close()
    assert not forked_workers()


def is_free(descriptor):
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def forked_workers():
    return [p for p in multiprocessing.active_children() if isinstance(p, FORK.Process)]


def test_progress(study):
    told = []
    run_study(study, report=told.append)
    assert [p.done for p in told] == [DRAWS * i for i in range(13)]
    assert told[0].seconds_left is None
    assert told[1].seconds_left > 0.0
    assert told[-1].seconds_left == 0.0


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda lines: [b"nothing\n", *lines], r"results\.jsonl:1: is not a line of a study"),
        (lambda lines: [lines[0], b"[1]\n", *lines[1:]], r"jsonl:2: is not a line of a study"),
        (lambda lines: [lines[0], b'{"task": 99, "columns": {"a": [1]}}\n'], "jsonl:2: is damaged"),
        (lambda lines: [lines[0], b'{"task": 0, "columns": {"a": [1], "b": []}}\n'], "is damaged"),
        (lambda lines: [b"{}\n", *lines[1:]], "jsonl: is not a study's file; --force overwrites"),
        (lambda lines: [b"[" * 100_000 + b"\n"], "is not a line of a study"),
    ],
)
def test_a_damaged_journal(study, tmp_path, spoil, message):
    with open_results(tmp_path / JOURNAL, study) as (_, store):
        store(0, {"draw": [0]})
    file = tmp_path / JOURNAL
    spoilt = b"".join(spoil(file.read_bytes().splitlines(keepends=True)))
    file.write_bytes(spoilt)
    with pytest.raises(OrthocalError, match=message):
        run_study(study, directory=tmp_path)
    assert file.read_bytes() == spoilt


def test_two_processes_do_not_write_one_journal(study, tmp_path):
    with (
        open_results(tmp_path / JOURNAL, study),
        pytest.raises(OrthocalError, match="is in use by another process"),
    ):
        run_study(study, directory=tmp_path)


def test_pandas_and_polars_open_the_table(undisturbed, tmp_path):
    file = tmp_path / "results.parquet"
    file.write_bytes(to_parquet(undisturbed))
    for frame in (pd.read_parquet(file), pl.read_parquet(file)):
        assert list(frame.columns) == list(undisturbed.columns)
        for name, cells in undisturbed.columns.items():
            assert list(frame[name]) == cells


def test_cells_are_rounded():
    assert round_cell(np.float64(1 / 3)) == 0.333333333
    assert round_cell(np.nan) is None
    assert round_cell(-1e-300 * 1e-300) == 0.0
    assert (round_cell(np.int64(3)), round_cell(np.bool_(1)), round_cell("a")) == (3, True, "a")


@pytest.fixture
def cluster():
    """A real scheduler and two workers, each a process of its own, on this machine alone."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    common = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "env": environment}
    words = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    scheduler = subprocess.Popen(
        [*words, "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-jupyter"],
        text=True,
        **common,
    )
    address = None
    for line in scheduler.stderr:
        if "tcp://" in line:
            address = "tcp://" + line.split("tcp://")[1].strip()
            break
    assert address is not None
    words = [sys.executable, "-m", "distributed.cli.dask_worker", address]
    workers = [
        subprocess.Popen(
            [*words, "--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1"],
            **{**common, "stderr": subprocess.DEVNULL},
        )
        for _ in range(2)
    ]
    yield address, workers
    for process in (*workers, scheduler):
        process.kill()
        process.wait()
    scheduler.stderr.close()


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_a_cluster_with_a_killed_worker(cluster, study, undisturbed):
    address, workers = cluster
    killed = []

    def kill_one(progress):
        if progress.done > DRAWS and not killed:
            workers[0].send_signal(signal.SIGKILL)
            killed.append(progress.done)

    found = run_study(study, dask=address, report=kill_one)
    assert killed
    assert workers[0].wait() == -signal.SIGKILL
    assert results(found) == results(undisturbed)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "tcp://["])
def test_a_cluster_that_does_not_answer(study, address):
    """No client begins: its threads could block those of a later one."""
    before = threading.active_count()
    with pytest.raises(OrthocalError, match="--dask: no Dask scheduler answers at"):
        run_study(study, dask=address)
    assert threading.active_count() == before


def test_workers_end_with_their_parent(root, tmp_path):
    words = ["study", "bootstrap", str(root / "examples/raw-cycles"), "--draws", "100000"]
    words += ["--workers", "2", "--out", str(tmp_path)]
    run = subprocess.Popen(
        [sys.executable, "-m", "orthocal", *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    journal = tmp_path / JOURNAL
    until(lambda: journal.exists() and journal.read_bytes().count(b"\n") > 1)
    children = [int(p) for p in children_of(run.pid)]
    assert children
    run.kill()
    run.wait()
    until(lambda: not any(is_running(p) for p in children))


def sent(study):
    """The study in the process of a worker, which has loaded no robot."""
    data = pickle.dumps(study)
    robot_loading._build_robot.cache_clear()
    loading._add_loaded_parameters.cache_clear()
    prepare_once.cache_clear()
    return pickle.loads(data)


def test_a_robot_whose_directory_is_gone(orthoglide, tmp_path):
    """As on another machine, or where its files were changed meanwhile."""
    robot = make_robot(Orthoglide(leg=0.25, travel=(0.1, 0.32)), tmp_path / "mine")
    study = build_linearisation_study(robot, sizes=[1.0], along=[1, -0.6, 0.3])
    expected = run_study(study).columns
    for file in (tmp_path / "mine").iterdir():
        file.write_text("something else")
    assert run_study(sent(study)).columns == expected
    for file in (tmp_path / "mine").iterdir():
        file.unlink()
    (tmp_path / "mine").rmdir()
    assert run_study(sent(study)).columns == expected
    own = build_linearisation_study(orthoglide, sizes=[1.0], along=[1, -0.6, 0.3])
    assert run_study(own).columns["six"] != expected["six"]
    assert json.dumps(study.document) != json.dumps(own.document)
