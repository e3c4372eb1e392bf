"""One thread of linear algebra."""

from __future__ import annotations

from calibrated import EXPERIMENT_2, UNJUDGED, session_of
from threadpoolctl import threadpool_info, threadpool_limits

import orthocal
from orthocal.assessment import assess
from orthocal.runtime.threads import NUMBERS_OF_THREADS


def blas_threads():
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_a_calibration_uses_one_thread_and_restores_the_others(monkeypatch):
    """Users of Python load NumPy before orthocal could state a number of threads."""
    during = []
    identify = assess.identify

    def noted(*args, **options):
        during.append(blas_threads())
        return identify(*args, **options)

    monkeypatch.setattr(assess, "identify", noted)
    for name in NUMBERS_OF_THREADS:
        monkeypatch.delenv(name, raising=False)
    with threadpool_limits(2):
        orthocal.calibrate(session_of(EXPERIMENT_2), **UNJUDGED)
        assert blas_threads() == {2}
    assert during == [{1}]
