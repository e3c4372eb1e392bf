"""What is in the controller instead of what was to be entered, as new readings tell it.

The calibration said which offsets E to enter where A were active and I were identified. If others
C are in the controller, the machine shows J (E − C) more than it should. What people do: leave A,
leave nothing (0), turn the sign (−E, or A less the change), enter twice or on top (2E, A + E, E and
the change), take the column beside it (I), or take another drive's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import special

from orthocal.statistics.chance import BY_CHANCE
from orthocal.statistics.whitening import whiten

Array = NDArray[np.float64]
Mistake = Literal[
    "not entered", "wrong sign", "entered twice", "identified", "interchanged", "one differs"
]

EXPLAINED = 0.2
"""Part of what offsets can explain that a mistake may leave of it at most, r.m.s., to be taken for
the reason; or what chance leaves, if that is more."""

KNOWN_LEAVES = 2.0
"""Times what is expected of deviations that a known mistake may leave at most, to be the reason;
readings answer in proportion to small changes only."""

AS_GOOD = 1.05
"""Times what the best of the mistakes leaves up to which the simpler one is held to be it: what
hardly shows is not said of a drive."""

MOST_DRIVES = 6
"""Drives up to which all choices among them are tried."""


@dataclass(frozen=True, slots=True, eq=False)
class EnteringMistake:
    """A mistake in entering offsets that explains what a new session shows."""

    kind: Mistake
    """`one differs`: no known mistake, but the offset of one drive alone explains the readings: a
    slip of the pen, or its zero has moved."""
    drives: tuple[str, ...]
    """Of which drives."""
    all_drives: bool
    """Whether these are all drives whose offsets were to change."""
    active: Array
    """Offsets that are in the controller then, shape (n_drives,), [m, rad]."""
    by: tuple[float, ...]
    """What is in the controller less what was to be entered, for each of the drives, [m, rad]."""
    rms: float
    """What it leaves of the deviations, and neither machine nor gauges explain, [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class _Guess:
    kind: Mistake
    drives: tuple[int, ...]
    active: Array
    left: float
    """What it leaves of what offsets can explain, r.m.s., [σ]."""


def find_mistake(
    deviations: Array,
    slopes: Array,
    *,
    spread: Array,
    sigma: float,
    model_sigma: float,
    model_dof: float,
    dof: float,
    before: Array,
    identified: Array,
    entered: Array,
    names: tuple[str, ...],
    rounding: Array,
) -> EnteringMistake | None:
    """The mistake that explains deviations best, if one does.

    All are held against what deviations are where there is no mistake: noise, and what was not
    known of machine and gauges.

    Args:
        deviations: New readings less those of the calibrated machine, zeros eliminated, (n,), [m].
        slopes: How the readings answer to the offsets of the drives, zeros eliminated, shape
            (n, n_drives), [m per m or rad].
        spread: Root of the covariance that deviations have of what is not known, shape (n, m), [m].
        sigma: Standard deviation of what is each reading's own, and new, [m].
        model_sigma: The same with error of the model, which repeats, [m].
        model_dof: Degrees of freedom of that.
        dof: Degrees of freedom of the deviations.
        before: Offsets that were active while the calibration was measured, A, [m, rad].
        identified: Offsets of the identified machine, I, shape (n_drives,), [m, rad].
        entered: Offsets that are taken to be active, E, shape (n_drives,), [m, rad].
        names: Of the drives.
        rounding: Differences that are none, shape (n_drives,), [m, rad].
    """
    weighed = whiten(np.column_stack([deviations, slopes]), spread, sigma=sigma)
    own, answers = weighed[:, 0], weighed[:, 1:]
    # what offsets have no part in is error of the model, and stays whatever is entered
    solution, _, rank, _ = np.linalg.lstsq(answers, own, rcond=None)
    shown = answers @ solution
    chance = math.sqrt(float(special.chdtri(max(rank, 1), BY_CHANCE)) / own.size)
    allowed = max(EXPLAINED * _rms(shown), chance)
    guesses = [
        _Guess(kind, drives, active, _rms(shown - answers @ (entered - active)))
        for kind, drives, active in _guesses(before, identified, entered, rounding)
    ]
    known = [g for g in guesses if g.left <= allowed]
    if not known:
        known = [g for g in _single(shown, answers, entered, rounding) if g.left <= allowed]
    if not known:
        return None
    least = max(min(g.left for g in known) * AS_GOOD, chance)
    best = min((g for g in known if g.left <= least), key=lambda g: (len(g.drives), g.left))
    missing = entered - best.active
    left = whiten(deviations - slopes @ missing, spread, sigma=model_sigma)
    excess = float(left @ left) / dof
    if best.kind == "one differs":  # any offset of one drive: it must explain all but chance
        if special.fdtrc(dof, model_dof, excess) < BY_CHANCE:
            return None
    elif excess > KNOWN_LEAVES**2:
        return None
    moved = int((np.abs(entered - before) > rounding).sum())
    return EnteringMistake(
        kind=best.kind,
        drives=tuple(names[i] for i in best.drives),
        all_drives=best.kind != "one differs" and len(best.drives) >= max(moved, 1),
        active=best.active,
        by=tuple((best.active - entered)[list(best.drives)].tolist()),
        # of what is left what neither machine nor gauges explain: σ² V⁻¹ times it
        rms=model_sigma**2 * _rms(whiten(left, spread, sigma=model_sigma)),
    )


def _guesses(
    before: Array, identified: Array, entered: Array, rounding: Array
) -> Iterator[tuple[Mistake, tuple[int, ...], Array]]:
    """Known mistakes: their kind, the drives and what is in the controller then."""
    change = entered - before
    kinds: tuple[tuple[Mistake, Array], ...] = (
        ("not entered", before),
        ("not entered", np.zeros_like(entered)),
        ("wrong sign", -entered),
        ("wrong sign", before - change),
        ("entered twice", 2.0 * entered),
        ("entered twice", before + entered),
        ("entered twice", entered + change),
        ("identified", identified),
    )
    for kind, values in kinds:
        other = [i for i in range(entered.size) if abs(values[i] - entered[i]) > rounding[i]]
        sizes = range(1, len(other) + 1) if len(other) <= MOST_DRIVES else [len(other)]
        for count in sizes:
            for drives in combinations(other, count):
                active = np.array(entered)
                active[list(drives)] = values[list(drives)]
                yield kind, drives, active
    if entered.size > MOST_DRIVES:
        return
    for order in permutations(range(entered.size)):
        active = entered[list(order)]
        drives = tuple(i for i in range(entered.size) if order[i] != i)
        if any(abs(active[i] - entered[i]) > rounding[i] for i in drives):
            yield "interchanged", drives, active


def _single(shown: Array, slopes: Array, entered: Array, rounding: Array) -> Iterator[_Guess]:
    """For each drive the offset that explains most by itself."""
    for i in range(entered.size):
        square = float(slopes[:, i] @ slopes[:, i])
        missing = float(slopes[:, i] @ shown) / square if square > 0.0 else 0.0
        if abs(missing) > rounding[i]:
            active = np.array(entered)
            active[i] -= missing
            yield _Guess("one differs", (i,), active, _rms(shown - slopes[:, i] * missing))


def _rms(values: Array) -> float:
    return math.sqrt(float(values @ values) / max(values.size, 1))
