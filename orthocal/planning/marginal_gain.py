"""What setups are worth one after the other, and when enough is enough."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthocal.planning.candidates import Candidates
from orthocal.planning.equipment import Means
from orthocal.planning.expected_error import Criterion, Expected
from orthocal.planning.selection import (
    Chosen,
    Opened,
    Weigh,
    error_left,
    information_of,
    open_setups,
)

Array = NDArray[np.float64]

ENOUGH = 0.05
"""Part of the error that another hour must take off to be worth it."""

HOUR = 60.0

ON_TOP = 2.0
"""How many times the plan's own time the curve goes on for."""


@dataclass(frozen=True, slots=True)
class Stage:
    """What is left when so many setups were read."""

    setups: int
    readings: int
    minutes: float
    error: float
    """What the criterion makes small, [m] or tolerances."""


def order_by_worth(
    candidates: Candidates, found: Chosen, prior: Array, weigh: Weigh
) -> tuple[Opened, ...]:
    """Setups that were chosen, the one first that alone leaves least, and so on."""
    rest, order, information = list(found.setups), [], np.array(prior)
    while rest:
        left = []
        for opened in rest:
            left.append(error_left(information + information_of(candidates, [opened]), weigh))
        best = rest.pop(int(np.argmin(left)))
        information = information + information_of(candidates, [best])
        order.append(best)
    return tuple(order)


def find_curve(
    candidates: Candidates,
    found: Chosen,
    counts: Sequence[int],
    means: Means,
    prior: Array,
    weigh: Weigh,
) -> tuple[Stage, ...]:
    """What is left after each setup, the most telling first, and after others on top."""
    stages = [Stage(0, 0, 0.0, error_left(prior, weigh))]
    information, n, total = np.array(prior), 0, 0

    def add(count: int, error: float) -> None:
        nonlocal n, total
        n, total = n + 1, total + count
        stages.append(Stage(n, total, means.minutes(n, total + n), error))

    for opened in found.setups:
        information = information + information_of(candidates, [opened])
        add(len(opened.chosen), error_left(information, weigh))
    each = round(sum(counts) / len(counts))
    more = max(math.ceil(ON_TOP * len(counts)), math.ceil(HOUR / means.minutes(1, each + 1)) + 1)
    for opened, error in open_setups(candidates, [each] * more, prior=information, weigh=weigh):
        add(len(opened.chosen), error)
    return tuple(stages)


def add_rest(
    curve: Sequence[Stage], planned: int, expected: Expected, here: Expected, criterion: Criterion
) -> tuple[Stage, ...]:
    """With what errors that are not identified leave, as much of them at every stage.

    And in the proportion in which a machine that is off tells less than the nominal one.
    """

    def rms(found: Expected) -> float:
        sizes = found.sizes
        size = {"aligned": sizes.headline, "relative": sizes.relative, "absolute": sizes.absolute}
        return size[criterion].rms

    if criterion not in ("aligned", "relative", "absolute"):
        return tuple(curve)
    rest = math.sqrt(max(rms(here) ** 2 - curve[planned].error ** 2, 0.0))
    more = rms(expected) / rms(here)
    return tuple(replace(s, error=more * math.hypot(s.error, rest)) for s in curve)


def find_enough(curve: Sequence[Stage]) -> Stage | None:
    """The first stage from which an hour takes less than a twentieth off."""
    minutes, errors = [s.minutes for s in curve], [s.error for s in curve]
    for stage in curve[1:]:
        if stage.minutes + HOUR > minutes[-1]:
            return None
        later = float(np.interp(stage.minutes + HOUR, minutes, errors))
        if later > (1.0 - ENOUGH) * stage.error:
            return stage
    return None
