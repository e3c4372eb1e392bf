"""Search within a time, against enumeration."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations_with_replacement

import numpy as np
import pytest
from test_setup_search import STATE, draw_candidates, every_setup, information

from orthocal.errors import ParameterError
from orthocal.planning.owned_sensors import Duration
from orthocal.planning.selection import SetupSearch
from orthocal.planning.timed_search import TimedSearch

DURATIONS = {"slow": Duration(10.0, 0.5), "quick": Duration(4.0, 1.0)}
MINUTES = 26.0


def draw_timed(seed, hands):
    """Three kinds of setup of two gauges."""
    rng = np.random.default_rng(seed)
    candidates, unknowns = draw_candidates(rng, hands=hands)
    gauges = ("slow", "slow", "quick")
    kinds = zip(candidates.setups, gauges, strict=True)
    candidates = replace(candidates, setups=tuple(replace(k, gauge=g) for k, g in kinds))
    root = rng.normal(size=(STATE, 2))
    search = SetupSearch.of(candidates, np.eye(STATE), lambda _: root)
    return candidates, unknowns, root, TimedSearch(search, DURATIONS)


def test_setups_within_a_time_are_nearly_the_best_of_all():
    """A time of three setups at most is the hardest case: nothing else fits into what is over."""
    ratios = [_ratio(seed, hands) for seed in range(10) for hands in (0, 1)]
    assert np.min(ratios) > 1.0 - 1e-6
    assert np.median(ratios) < 1.001
    assert np.quantile(ratios, 0.75) < 1.01
    assert np.max(ratios) < 1.25


def _ratio(seed, hands):
    """Error of the chosen setups over that of the best of all."""
    candidates, unknowns, root, timed = draw_timed(seed, hands)
    plan = timed.choose(MINUTES)
    assert timed.minutes(plan.setups) <= MINUTES + 1e-9
    assert plan.error == pytest.approx(timed.search.error_of(plan.information), rel=1e-9)
    every = [s for count in (2, 3, 4) for s in every_setup(candidates, count)]
    told = np.array([information(candidates, unknowns, s) for s in every])
    cost = np.array([timed.minutes([s]) for s in every])
    best = np.inf
    for size in (1, 2, 3):  # four setups take 28 minutes at least
        sets = np.array(list(combinations_with_replacement(range(len(every)), size)))
        able = sets[cost[sets].sum(axis=1) <= MINUTES]
        if able.size:
            covariance = np.linalg.inv(np.eye(STATE) + told[able].sum(axis=1))
            squares = np.trace(root.T @ covariance @ root, axis1=1, axis2=2)
            best = min(best, float(np.sqrt(squares.min())))
    return plan.error / best


def test_more_time_is_never_worse_and_too_little_is_refused():
    *_, timed = draw_timed(3, 0)
    errors = [timed.choose(minutes).error for minutes in (8.0, 12.0, 20.0, 40.0)]
    assert errors == sorted(errors, reverse=True)
    with pytest.raises(ParameterError) as caught:
        timed.choose(5.0)
    assert caught.value.where == "plan"


def test_the_times_of_a_gauge():
    duration = Duration(10.0, 0.5)
    assert duration.of(3) == 12.0
    assert [duration.max_readings(m, 48) for m in (9.0, 10.0, 11.5, 12.0, 1e6)] == [0, 0, 2, 3, 48]
    assert Duration(10.0, 0.0).max_readings(10.0, 48) == 48
