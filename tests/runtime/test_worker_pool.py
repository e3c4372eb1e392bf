"""Worker pool: results, order, budget and killed workers."""

from __future__ import annotations

import os

import pytest

from orthocal.errors import ParameterError
from orthocal.runtime import worker_pool as cores


@pytest.fixture
def forking(monkeypatch):
    monkeypatch.setattr(cores, "can_fork", lambda: True)


def test_results_are_in_order_and_from_other_processes(forking):
    calls = [lambda k=k: (k, os.getpid()) for k in range(5)]
    with cores.worker_budget(2):
        found = cores.call_in_parallel(calls)
    assert [k for k, _ in found] == list(range(5))
    assert os.getpid() not in {process for _, process in found}
    assert len({process for _, process in found}) == 2
    # without a budget the calls run in this process
    assert {process for _, process in cores.call_in_parallel(calls)} == {os.getpid()}


def test_a_worker_has_a_budget_of_one(forking):
    def inner():
        return cores.current_worker_budget(), cores.call_in_parallel([os.getpid, os.getpid])

    with cores.worker_budget(2):
        first, second = cores.call_in_parallel([inner, inner])
    for budget, processes in (first, second):
        assert budget == 1
        assert len(set(processes)) == 1


def test_the_budget_is_restored_after_an_error(forking):
    with pytest.raises(ParameterError, match="setups: found 0"), cores.worker_budget(3):
        cores.call_in_parallel([_refuse, os.getpid])
    assert cores.current_worker_budget() == 1


def _refuse():
    raise ParameterError("found 0", where="--setups")


def test_without_fork_calls_run_in_this_process(monkeypatch):
    monkeypatch.setattr(cores, "can_fork", lambda: False)
    with cores.worker_budget(2):
        assert set(cores.call_in_parallel([os.getpid] * 3)) == {os.getpid()}


def test_a_killed_worker_is_reported(forking):
    def die():
        os.kill(os.getpid(), 9)

    with cores.worker_budget(2), pytest.raises(cores.OrthocalError, match="it was killed"):
        cores.call_in_parallel([die, os.getpid], killed="it was killed")
