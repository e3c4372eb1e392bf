"""Ratios of processor seconds of works that run in turn on one machine."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np

ROUNDS = 6
"""At most. Beside other processes a work takes up to 1.7 times as long in one round as in another.
"""


def seconds_of(do: Callable[[], object]) -> float:
    """Processor seconds of one run."""
    began = time.process_time()
    do()
    return time.process_time() - began


def settle(
    measure: Callable[[], Sequence[float]],
    compare: Callable[[Sequence[float]], float],
    *,
    above: float = 0.0,
    below: float = np.inf,
) -> float:
    """Compare seconds, each the fewest of some rounds.

    Rounds are added until the result is within its bounds: other processes slow a work down in some
    rounds, and what is slower than its bound allows stays so in all of them.

    Args:
        measure: Returns the seconds of each work.
        compare: Computes the result from them.
        above: Lower bound of the result.
        below: Upper bound.

    Returns:
        The result after the last round, within its bounds or not.
    """
    best: Sequence[float] = measure()
    for _ in range(ROUNDS - 1):
        if above < compare(best) < below:
            break
        best = [min(pair) for pair in zip(best, measure(), strict=True)]
    return compare(best)


def ratio_of(
    over: Callable[[], float],
    under: Callable[[], float],
    *,
    above: float = 0.0,
    below: float = np.inf,
) -> float:
    """Seconds of one work over those of another (see `settle`).

    Args:
        over: Runs the work, and returns its seconds.
        under: Likewise.
        above: Lower bound of the ratio.
        below: Upper bound.
    """
    return settle(lambda: (over(), under()), lambda s: s[0] / s[1], above=above, below=below)
