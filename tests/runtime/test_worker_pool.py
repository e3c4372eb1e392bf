"""Work on several cores: what one process would find, in its order."""

from __future__ import annotations

import os

import pytest

from orthocal.errors import ParameterError
from orthocal.runtime import worker_pool as cores


@pytest.fixture
def forking(monkeypatch):
    monkeypatch.setattr(cores, "can_fork", lambda: True)


def test_calls_return_in_their_order_from_other_processes(forking):
    calls = [lambda k=k: (k, os.getpid()) for k in range(5)]
    with cores.worker_budget(2):
        found = cores.call_in_parallel(calls)
    assert [k for k, _ in found] == list(range(5))
    assert os.getpid() not in {process for _, process in found}
    assert len({process for _, process in found}) == 2
    # nobody lends any more
    assert {process for _, process in cores.call_in_parallel(calls)} == {os.getpid()}


def test_a_worker_is_lent_no_more_cores(forking):
    def inner():
        return cores.current_worker_budget(), cores.call_in_parallel([os.getpid, os.getpid])

    with cores.worker_budget(2):
        first, second = cores.call_in_parallel([inner, inner])
    for budget, processes in (first, second):
        assert budget == 1
        assert len(set(processes)) == 1


def test_what_is_lent_is_given_back(forking):
    with pytest.raises(ParameterError, match="--setups: found 0"), cores.worker_budget(3):
        cores.call_in_parallel([_refuse, os.getpid])
    assert cores.current_worker_budget() == 1


def _refuse():
    raise ParameterError("found 0", where="--setups")


def test_where_processes_cannot_be_doubled_calls_are_made_here(monkeypatch):
    monkeypatch.setattr(cores, "can_fork", lambda: False)
    with cores.worker_budget(2):
        assert set(cores.call_in_parallel([os.getpid] * 3)) == {os.getpid()}


def test_a_process_that_is_killed_is_told(forking):
    def die():
        os.kill(os.getpid(), 9)

    with cores.worker_budget(2), pytest.raises(cores.OrthocalError, match="it was killed"):
        cores.call_in_parallel([die, os.getpid], killed="it was killed")
