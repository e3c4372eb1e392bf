"""What is in the controller instead of what was to be entered, as new readings tell it.

The calibration said which offsets E to enter where A were active and I were identified. If others
C are in the controller, the machine shows J (E − C) more than it should. What people do: leave A,
leave nothing (0), turn the sign (−E, or A less the change), enter twice or on top (2E, A + E, E and
the change), take the column beside it (I), or take another drive's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations, permutations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from orthocal.statistics.chance import BY_CHANCE
from orthocal.statistics.distributions import chi_square_quantile, f_tail
from orthocal.statistics.whitening import whiten

Array = NDArray[np.float64]
Mistake = Literal[
    "not entered", "wrong sign", "entered twice", "identified", "interchanged", "one differs"
]

EXPLAINED = 0.2
"""Part of what offsets can explain that a mistake may leave of it at most, r.m.s., to be taken for
the reason; or what chance leaves, if that is more."""

KNOWN_LEAVES = 2.0
"""Times what is expected of deviations that a known mistake may leave at most, to be the reason."""

MOST_TRIED = 12
"""Guesses whose readings are computed."""

STEPS = 2
"""Towards the offset of one drive that explains most."""

NOTHING = 1e-9
"""Part of the largest singular value below which one is nothing."""

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
    left: float = math.nan
    """What it leaves of what offsets can explain, r.m.s., [σ]."""


def find_mistake(
    deviate: Callable[[Array], Array],
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
        deviate: New readings less those of the calibrated machine with some offsets in the
            controller, shape (n_drives,), [m, rad]; zeros eliminated, shape (n,), [m].
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
    seen = _Seen.of(deviate, whiten(slopes, spread, sigma=sigma), spread, sigma)
    shown = seen.shown(entered)
    chance = math.sqrt(chi_square_quantile(max(seen.rank, 1), BY_CHANCE) / len(shown))
    if _rms(shown) <= chance:  # other offsets would not help
        return None
    allowed = max(EXPLAINED * _rms(shown), chance)
    # readings answer in proportion to small changes only: those that come near are looked at
    likely = sorted(
        _guesses(before, identified, entered, rounding),
        key=lambda g: _rms(shown - seen.answers @ (entered - g.active)),
    )[:MOST_TRIED]
    known = [g for g in map(seen.judge, likely) if g.left <= allowed]
    if not known:
        single = map(seen.judge, _single(seen, entered, rounding))
        known = [g for g in single if g.left <= allowed]
    if not known:
        return None
    least = max(min(g.left for g in known) * AS_GOOD, chance)
    best = min((g for g in known if g.left <= least), key=lambda g: (len(g.drives), g.left))
    left = whiten(deviate(best.active), spread, sigma=model_sigma)
    excess = float(left @ left) / dof
    if best.kind == "one differs":  # any offset of one drive: it must explain all but chance
        if f_tail(dof, model_dof, excess) < BY_CHANCE:
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


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Deviations by their likelihood, [σ]."""

    deviate: Callable[[Array], Array]
    answers: Array
    """To the offsets, shape (n, n_drives), [per m or rad]."""
    directions: Array
    """An orthonormal basis of what offsets can explain, shape (n, rank)."""
    spread: Array
    sigma: float

    @staticmethod
    def of(deviate: Callable[[Array], Array], answers: Array, spread: Array, sigma: float) -> _Seen:
        left, sizes, _ = np.linalg.svd(answers, full_matrices=False)
        kept = sizes > NOTHING * sizes.max(initial=0.0)
        return _Seen(deviate, answers, left[:, kept], spread, sigma)

    @property
    def rank(self) -> int:
        """How many sums of offsets the readings tell."""
        return int(self.directions.shape[1])

    def shown(self, active: Array) -> Array:
        """What offsets can explain of the deviations with some active, shape (n,), [σ].

        What they have no part in is error of the model, and stays whatever is entered.
        """
        own = whiten(self.deviate(active), self.spread, sigma=self.sigma)
        return np.asarray(self.directions @ (self.directions.T @ own))

    def judge(self, guess: _Guess) -> _Guess:
        """A guess with what it leaves."""
        return replace(guess, left=_rms(self.shown(guess.active)))


def _guesses(before: Array, identified: Array, entered: Array, rounding: Array) -> Iterator[_Guess]:
    """Known mistakes, not yet judged."""
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
                yield _Guess(kind, drives, active)
    if entered.size > MOST_DRIVES:
        return
    for order in permutations(range(entered.size)):
        active = entered[list(order)]
        drives = tuple(i for i in range(entered.size) if order[i] != i)
        if any(abs(active[i] - entered[i]) > rounding[i] for i in drives):
            yield _Guess("interchanged", drives, active)


def _single(seen: _Seen, entered: Array, rounding: Array) -> Iterator[_Guess]:
    """For each drive the offset that explains most by itself."""
    for i in range(entered.size):
        answer = seen.answers[:, i]
        square = float(answer @ answer)
        if square == 0.0:
            continue
        active = np.array(entered)
        for _ in range(STEPS):
            active[i] -= float(answer @ seen.shown(active)) / square
        if abs(active[i] - entered[i]) > rounding[i]:
            yield _Guess("one differs", (i,), active)


def _rms(values: Array) -> float:
    return math.sqrt(float(values @ values) / max(values.size, 1))
