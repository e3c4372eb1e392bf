"""Search within a time, compared with enumeration."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations_with_replacement

import numpy as np
import pytest
from test_setup_search import STATE, draw_candidates, information, list_setups, search_among

from orthocal.errors import ParameterError
from orthocal.planning.owned_sensors import Duration
from orthocal.planning.timed_search import MAX_SETUPS, TimedSearch

DURATIONS = {"slow": Duration(10.0, 0.5), "quick": Duration(4.0, 1.0)}
MINUTES = 26.0


def draw_timed(seed, aligned):
    """Search among three candidate setups of two gauges."""
    rng = np.random.default_rng(seed)
    candidates, sensitivities = draw_candidates(rng, aligned=aligned)
    gauges = ("slow", "slow", "quick")
    setups = zip(candidates.setups, gauges, strict=True)
    candidates = replace(candidates, setups=tuple(replace(s, gauge=g) for s, g in setups))
    root = rng.normal(size=(STATE, 2))
    return candidates, sensitivities, root, TimedSearch(search_among(candidates, root), DURATIONS)


def test_setups_within_a_time_are_nearly_the_best_of_all():
    """A time of three setups at most is the hardest case: no other setup fits into the rest."""
    ratios = [_ratio(seed, aligned) for seed in range(5) for aligned in (0, 1)]
    assert np.min(ratios) > 1.0 - 1e-6
    assert np.median(ratios) < 1.001
    assert np.quantile(ratios, 0.75) < 1.01
    assert np.max(ratios) < 1.25


def _ratio(seed, aligned):
    """Ratio of the error of the chosen setups to that of the best ones."""
    candidates, sensitivities, root, timed = draw_timed(seed, aligned)
    plan = timed.choose(MINUTES)
    assert timed.minutes(plan.setups) <= MINUTES + 1e-9
    assert plan.error == pytest.approx(timed.search.error_of(plan.information), rel=1e-9)
    listed = [s for count in (2, 3, 4) for s in list_setups(candidates, count)]
    gained = np.array([information(candidates, sensitivities, s) for s in listed])
    minutes = np.array([timed.minutes([s]) for s in listed])
    best = np.inf
    for size in (1, 2, 3):  # four setups take 28 minutes at least
        sets = np.array(list(combinations_with_replacement(range(len(listed)), size)))
        possible = sets[minutes[sets].sum(axis=1) <= MINUTES]
        if possible.size:
            covariance = np.linalg.inv(np.eye(STATE) + gained[possible].sum(axis=1))
            squares = np.trace(root.T @ covariance @ root, axis1=1, axis2=2)
            best = min(best, float(np.sqrt(squares.min())))
    return plan.error / best


def test_more_time_is_never_worse_and_too_short_a_time_is_refused():
    *_, timed = draw_timed(3, 0)
    errors = [timed.choose(minutes).error for minutes in (8.0, 12.0, 20.0, 40.0)]
    assert errors == sorted(errors, reverse=True)
    with pytest.raises(ParameterError) as caught:
        timed.choose(5.0)
    assert caught.value.where == "plan"


def test_durations_of_a_gauge():
    duration = Duration(10.0, 0.5)
    assert duration.of(3) == 12.0
    assert [duration.max_readings(m, 48) for m in (9.0, 10.0, 11.5, 12.0, 1e6)] == [0, 0, 2, 3, 48]
    assert [Duration(10.0, 0.0).max_readings(m, 48) for m in (9.0, 10.0)] == [0, 48]


def test_setups_that_take_no_time_are_limited():
    *_, timed = draw_timed(0, 0)
    instant = replace(timed, durations=dict.fromkeys(DURATIONS, Duration(0.0, 0.0)))
    assert len(instant.fill(instant.search.empty, 1.0).setups) == MAX_SETUPS
