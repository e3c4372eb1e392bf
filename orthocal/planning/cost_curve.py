"""Expected tool error over measuring time, and the time beyond which more readings gain little."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from orthocal.errors import ParameterError
from orthocal.planning.expected_error import Criterion, Expected
from orthocal.planning.timed_search import TimedSearch

ENOUGH = 0.05
"""Relative reduction of the error by another hour below which a plan has enough readings."""

HOUR = 60.0

LONGER = 2.0
"""Factor by which the curve goes beyond the duration of the plan."""

MOST_SETUPS = 40


@dataclass(frozen=True, slots=True)
class Stage:
    """Expected error after a number of setups."""

    setups: int
    readings: int
    minutes: float
    error: float
    """Value of the criterion, [m] or prior std."""


def compute_curve(search: TimedSearch, each: int | None, planned: int) -> tuple[Stage, ...]:
    """Expected error after each setup that is added, or enlarged.

    It depends on the number of setups of the plan in its length alone.

    Args:
        search: Candidates and prior information.
        each: Readings of each setup; None for those with the largest gain per minute.
        planned: Setups of the plan.
    """
    stages = [Stage(0, 0, 0.0, search.search.empty.error)]
    fewest = min(math.ceil(LONGER * planned), MOST_SETUPS)
    grown = search.grow() if each is None else search.search.grow([each] * MOST_SETUPS)
    try:
        for n, plan in enumerate(islice(grown, MOST_SETUPS), 1):
            readings = sum(len(s.chosen) for s in plan.setups)
            setups = len(plan.setups)
            stages.append(Stage(setups, readings, search.minutes(plan.setups), plan.error))
            if n >= fewest and find_enough(stages) is not None:
                break
    except ParameterError:  # a setup of that many readings is not possible
        pass
    return tuple(stages)


def scale_curve(curve: Sequence[Stage], factor: float, rest: float) -> tuple[Stage, ...]:
    """Curve with the error of what is not identified, times a factor.

    Args:
        curve: Errors to first order about the nominal machine.
        factor: Expected error of machines within their tolerances over that of the nominal one.
        rest: Error of what is not identified, [m].
    """
    return tuple(replace(s, error=factor * math.hypot(s.error, rest)) for s in curve)


def find_scale(
    searched: float, expected: Expected, nominal: Expected, criterion: Criterion
) -> tuple[float, float]:
    """Factor and additional error with which the search's error becomes the expected one.

    Gauges on machines within their tolerances are less sensitive than on the nominal one, errors
    that are not identified remain, and the search omits the readings that close a setup.

    Args:
        searched: Error after the same readings in the search.
        expected: Expected error of machines within their tolerances.
        nominal: The same about the nominal machine.
        criterion: Criterion of the search.
    """
    rms = nominal.rms_by(criterion)
    if math.isnan(rms):
        return 1.0, 0.0
    remainder = math.sqrt(max(rms**2 - searched**2, 0.0))
    return expected.rms_by(criterion) / math.hypot(searched, remainder), remainder


def find_enough(curve: Sequence[Stage]) -> Stage | None:
    """First stage after which another hour gains less than ENOUGH; None if there is none."""
    minutes, errors = [s.minutes for s in curve], [s.error for s in curve]
    for stage in curve[1:]:
        if stage.minutes + HOUR > minutes[-1]:
            return None
        later = float(np.interp(stage.minutes + HOUR, minutes, errors))
        if later > (1.0 - ENOUGH) * stage.error:
            return stage
    return None
