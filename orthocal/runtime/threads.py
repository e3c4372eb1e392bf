"""Threads of linear algebra.

More than one thread delays the small matrices of a calibration, on a busy machine by a factor of
ten, and may round sums differently.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

NUMBERS_OF_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
"""Environment variables of the libraries that NumPy may use."""


def state_one_thread() -> None:
    """State one thread, unless the user states another number; before NumPy is imported."""
    for name in NUMBERS_OF_THREADS:
        os.environ.setdefault(name, "1")


@contextmanager
def one_thread() -> Iterator[None]:
    """Context, and decorator, in which linear algebra uses one thread."""
    if all(os.environ.get(name) == "1" for name in NUMBERS_OF_THREADS):
        yield
        return
    from threadpoolctl import threadpool_limits  # 20 ms

    with threadpool_limits(limits=1):
        yield
