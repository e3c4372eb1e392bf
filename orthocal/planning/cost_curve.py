"""Expected tool error over measuring time, and the time beyond which gains are small."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from orthocal.errors import ParameterError
from orthocal.planning.expected_error import Criterion, Expected
from orthocal.planning.timed_search import MAX_SETUPS, TimedSearch

HOURLY_GAIN = 0.05
"""Smallest relative reduction of the error that justifies another hour."""

HOUR = 60.0

CURVE_LENGTH = 2.0
"""Number of setups of the curve, relative to the plan."""


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

    Args:
        search: Candidates and prior information.
        each: Readings of each setup; None for the number with the largest gain per minute.
        planned: Number of setups of the plan, which determines the length of the curve only.
    """
    stages = [Stage(0, 0, 0.0, search.search.empty.error)]
    min_setups = min(math.ceil(CURVE_LENGTH * planned), MAX_SETUPS)
    plans = search.grow() if each is None else search.search.grow([each] * MAX_SETUPS)
    try:
        for n, plan in enumerate(islice(plans, MAX_SETUPS), 1):
            readings = sum(len(s.chosen) for s in plan.setups)
            setups = len(plan.setups)
            stages.append(Stage(setups, readings, search.minutes(plan.setups), plan.error))
            if n >= min_setups and find_enough(stages) is not None:
                break
    except ParameterError:  # no setup can have `each` readings
        pass
    return tuple(stages)


def scale_curve(curve: Sequence[Stage], factor: float, constant: float) -> tuple[Stage, ...]:
    """Curve of expected errors from a curve of the search.

    Args:
        curve: Errors to first order about the nominal machine.
        factor: Ratio of the expected error of machines within their tolerances to that of the
            nominal one.
        constant: Additional error that readings do not reduce, [m].
    """
    return tuple(replace(s, error=factor * math.hypot(s.error, constant)) for s in curve)


def find_scale(
    searched: float, expected: Expected, nominal: Expected, criterion: Criterion
) -> tuple[float, float]:
    """Factor and additional error by which `scale_curve` makes the search's error the expected one.

    They differ for three reasons. Gauges are less sensitive on machines within their tolerances
    than on the nominal one. Some errors are not identified. The search omits the readings that
    close a setup.

    Args:
        searched: Error after the same readings in the search, [m].
        expected: Expected error of machines within their tolerances.
        nominal: Expected error to first order about the nominal machine.
        criterion: Criterion of the search.
    """
    rms = nominal.rms_by(criterion)
    if math.isnan(rms):
        return 1.0, 0.0
    constant = math.sqrt(max(rms**2 - searched**2, 0.0))
    return expected.rms_by(criterion) / math.hypot(searched, constant), constant


def find_enough(curve: Sequence[Stage]) -> Stage | None:
    """First stage after which another hour gains less than HOURLY_GAIN; None without one."""
    minutes, errors = [s.minutes for s in curve], [s.error for s in curve]
    for stage in curve[1:]:
        if stage.minutes + HOUR > minutes[-1]:
            return None
        later = float(np.interp(stage.minutes + HOUR, minutes, errors))
        if later > (1.0 - HOURLY_GAIN) * stage.error:
            return stage
    return None
