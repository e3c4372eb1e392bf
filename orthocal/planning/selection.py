"""The choice among candidates: setups and readings that leave least unknown at the tool.

What the readings of one setup say of the state θ̂ is Aᵀ (D + σ² I)⁻¹ A, with D the covariance that
the setup's own unknowns give them. Beside what all others say, with covariance C of θ̂, readings S
of a setup take

    tr[(V_SS + σ² I)⁻¹ Q_SS],  V = A C Aᵀ + D,  Q = A C T C Aᵀ

off tr(T C), T being what the errors do at the tool. Setups are opened one after the other, each
with the readings that take most, then exchanged one by one for better ones until there are none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import cast

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from orthocal.errors import ParameterError
from orthocal.planning.candidates import FEWEST, Candidates, HandSet, Kind
from orthocal.planning.information_gain import Taking, beginnings
from orthocal.runtime.worker_pool import run_in_parallel
from orthocal.units import MM

Array = NDArray[np.float64]

WORTH = 1e-3
"""Part of the r.m.s. error by which a round of exchanges must better it for another one."""

MOST_ROUNDS = 8

MOST_REFINED = 4
"""Kinds of setup whose readings are exchanged for better ones, to find the best of them."""

MOST_COMPLETED = 12
"""Kinds of setup of which more than the best pair of readings is looked at."""

MOST_PAIRS = 3
"""Pairs of readings that a setup is begun with, to find the best of them."""

MOST_PASSES = 4
"""Through the readings of a setup, exchanging them."""

FEWEST_STARTS, MOST_STARTS = 3, 30

CANDIDATES_A_START = 20_000
"""A small choice is begun more often: candidates times starts are no fewer, up to MOST_STARTS."""

KILLED = "a process that chose readings was killed"

ROUGH = 1e-6
"""Part of the error by which it may be off where it is found without an inverse."""

FEW = 2_000
"""Candidates up to which kinds are ranked with their gauges set where each pair begins."""

UNTOLD = 1e-12
"""How much of the state a direction tells that tells nothing, beside the one that tells most."""

Weigh = Callable[[Array], Array]
"""R with T = R Rᵀ for a covariance of the state, shape (n_state, p): constant for mean squares."""


@dataclass(frozen=True, slots=True)
class Opened:
    """A setup that was chosen."""

    kind: int
    """Among the candidates'."""
    chosen: tuple[int, ...]
    """Readings among its candidates; the first is where the gauge is set."""


@dataclass(frozen=True, slots=True, eq=False)
class Chosen:
    """Setups that were chosen together."""

    setups: tuple[Opened, ...]
    information: Array
    """What they and the prior say of the state, shape (n_state, n_state)."""
    left: float
    """The criterion, as large as an error: √tr(T C)."""


def choose_setups(
    candidates: Candidates,
    counts: Sequence[int],
    *,
    prior: Array,
    weigh: Weigh,
    seed: int = 0,
    starts: int | None = None,
    workers: int = 1,
    report: Callable[[int, float], None] | None = None,
) -> Chosen:
    """Setups with so many readings each that leave the least.

    Args:
        candidates: What there is to choose from.
        counts: Readings of each setup, at least 2, shape (n_setups,).
        prior: What is known of the state beforehand: an inverse covariance.
        weigh: What the state does where it matters.
        seed: Of the setups that starts but the first begin with.
        starts: How often to begin anew; the best is taken. By default 3 times, and more often where
            there is little to choose from.
        workers: Processes; they choose the same, however many there are.
        report: Told after each start: how many there were, and the least error left.
    """
    if starts is None:
        wanted = CANDIDATES_A_START // candidates.count
        starts = int(np.clip(wanted, FEWEST_STARTS, MOST_STARTS))
    if starts < 1:
        raise ValueError("expected at least one start")
    search = _Search(candidates.bare, prior, weigh, _draw_starts(candidates, counts, seed, starts))
    found: dict[int, Chosen] = {}
    told, best = 0, None
    for start, chosen in run_in_parallel(search, range(starts), workers, killed=KILLED):
        found[start] = chosen
        while told in found:
            if best is None or found[told].left < best.left:
                best = found[told]
            told += 1
            if report is not None:
                report(told, best.left)
    return cast(Chosen, best)


def open_setups(
    candidates: Candidates, counts: Sequence[int], *, prior: Array, weigh: Weigh
) -> Iterator[tuple[Opened, float]]:
    """Setups one after the other, each the best beside those before it, and what each leaves."""
    information = np.array(prior)
    for count in counts:
        opened = _open_best(candidates, information, count, weigh)
        information = information + _says(candidates, opened)
        yield opened, error_left(information, weigh)


def information_of(candidates: Candidates, setups: Sequence[Opened]) -> Array:
    """What readings say of the state, shape (n_state, n_state)."""
    return np.asarray(np.sum([_says(candidates, s) for s in setups], axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """What a start begins with."""

    counts: tuple[int, ...]
    """Readings of each setup."""
    begun: tuple[Opened | None, ...]
    """The first setups, drawn at random; None where the best is taken, as for all others."""


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """A search from each of some starts, none of which depends on another."""

    candidates: Candidates
    prior: Array
    weigh: Weigh
    starts: tuple[_Start, ...]

    def __call__(self, start: int) -> Chosen:
        """Setups opened one after the other, then exchanged."""
        with threadpool_limits(1):  # on several threads sums may come out otherwise
            own = self.starts[start]
            found = _open_all(self.candidates, own, self.prior, self.weigh)
            return _exchange(self.candidates, found, self.weigh)


def _draw_starts(
    candidates: Candidates, counts: Sequence[int], seed: int, starts: int
) -> tuple[_Start, ...]:
    """The first start without random numbers; of all others the first half of setups anywhere."""
    rng, found = np.random.default_rng(seed), [_Start(tuple(counts), ())]
    for _ in range(1, starts):
        own = tuple(counts[i] for i in rng.permutation(len(counts)))
        half = own[: (len(own) + 1) // 2]
        found.append(_Start(own, tuple(_open_anywhere(candidates, n, rng) for n in half)))
    return tuple(found)


def _open_all(candidates: Candidates, start: _Start, prior: Array, weigh: Weigh) -> Chosen:
    """Setups opened one after the other."""
    information, setups = np.array(prior), []
    for k, count in enumerate(start.counts):
        opened = start.begun[k] if k < len(start.begun) else None
        if opened is None:
            opened = _open_best(candidates, information, count, weigh)
        setups.append(opened)
        information = information + _says(candidates, opened)
    return Chosen(tuple(setups), information, error_left(information, weigh))


def _exchange(candidates: Candidates, chosen: Chosen, weigh: Weigh) -> Chosen:
    """Each setup in turn for a better one, and each of its readings, until little is gained."""
    for _ in range(MOST_ROUNDS):
        before = chosen.left
        for k in range(len(chosen.setups)):
            chosen = _exchange_one(candidates, chosen, k, weigh)
        if chosen.left > before * (1.0 - WORTH):
            break
    return chosen


def _exchange_one(candidates: Candidates, chosen: Chosen, k: int, weigh: Weigh) -> Chosen:
    old, best = chosen.setups[k], chosen
    others = chosen.information - _says(candidates, old)
    beside = _Beside.of(candidates, others, weigh)
    ranked = beside.rank(len(old.chosen))[:MOST_REFINED]
    others_begun = (s for r in ranked for s in beside.begun_otherwise(r))
    for new in dict.fromkeys(beside.better_readings(s) for s in (old, *others_begun)):
        new = beside.begun_best(new)
        if beside.left_roughly(new) > best.left * (1.0 + ROUGH):
            continue
        information = others + _says(candidates, new)
        left = error_left(information, weigh)
        if left < best.left:
            setups = (*chosen.setups[:k], new, *chosen.setups[k + 1 :])
            best = Chosen(setups, information, left)
    return best


def _open_anywhere(candidates: Candidates, count: int, rng: np.random.Generator) -> Opened | None:
    """Any setup with so many readings; None where the one that was drawn cannot take them."""
    which = int(rng.integers(len(candidates.kinds)))
    together = candidates.kinds[which].together
    able = np.flatnonzero(together.sum(axis=1) >= count)
    if not able.size:
        return None
    first = int(rng.choice(able))
    others = np.flatnonzero(together[first])
    rest = rng.choice(others[others != first], size=count - 1, replace=False)
    return Opened(which, (first, *(int(i) for i in rest)))


def _open_best(candidates: Candidates, information: Array, count: int, weigh: Weigh) -> Opened:
    """The setup, with so many readings, that takes most off what others leave."""
    ranked = _Beside.of(candidates, information, weigh).rank(count)
    if not ranked:
        raise ParameterError(
            f"no setup can take {count} readings within the gauge's range, of which machines "
            f"within their tolerances may take {candidates.taken_range / MM:.2g} mm to either "
            "side; expected fewer readings a setup, a larger range, smaller tolerances such as "
            "--tolerance '*.offset_mm=1', or more postures",
            where="plan",
        )
    return ranked[0]


@dataclass(frozen=True, slots=True, eq=False)
class _Beside:
    """What candidates are worth beside all that others say."""

    candidates: Candidates
    covariance: Array
    """B C Bᵀ, B being what candidates tell of the state, shape (n_told, n_told)."""
    worth: Array
    """B C R, shape (n_told, p)."""
    whole: float | None
    """tr(T C); None where T depends on C."""
    many: bool
    """Whether there are too many to rank each pair with its gauge set where it begins."""
    seen: dict[tuple[int, int | None], Taking] = field(default_factory=dict)
    """What was looked at, by kind and where it is begun."""
    on_mean: dict[int, Taking] = field(default_factory=dict)
    """The same with gauges that are set on the mean of all postures."""

    @staticmethod
    def of(candidates: Candidates, information: Array, weigh: Weigh) -> _Beside:
        covariance = _inverse(information)
        root = weigh(covariance)
        steady = weigh(covariance) is root
        whole = float(np.vdot(root, covariance @ root)) if steady else None
        told, _, _ = _narrow(candidates)
        known = told @ covariance
        many = candidates.count > FEW
        return _Beside(candidates, known @ told.T, known @ root, whole, many)

    def taking(self, which: int, first: int | None = None) -> Taking:
        """The candidates of a kind, begun with one of them, or on the mean of them."""
        kind = self.candidates.kinds[which]
        key = which, first if kind.by_hand else None
        if key not in self.seen and key[1] is not None:
            self.seen[key] = self.taking(which).begun(key[1])
        elif key not in self.seen:
            own, sigma = _narrow(self.candidates)[1][which], self.candidates.sigma
            self.seen[key] = Taking.beside(own, self.covariance, self.worth, sigma)
        return self.seen[key]

    def taking_on_mean(self, which: int) -> Taking:
        """The candidates of a kind, its gauge set on the mean of all postures: half the work.

        Where there are few, as they are.
        """
        if not self.many:
            return self.taking(which)
        if which not in self.on_mean:
            own = _narrow(self.candidates)[2][which]
            found = Taking.beside(own, self.covariance, self.worth, self.candidates.sigma)
            self.on_mean[which] = found
        return self.on_mean[which]

    def left_roughly(self, opened: Opened) -> float:
        """What a setup leaves, but for rounding; 0 where that cannot be said at once."""
        if self.whole is None:
            return 0.0
        gain = self.taking(opened.kind, opened.chosen[0]).gain(list(opened.chosen))
        return math.sqrt(max(self.whole - gain, 0.0))

    def begun_best(self, opened: Opened) -> Opened:
        """The same setup begun with another reading, of its own or not, if that takes more."""
        kind, chosen = self.candidates.kinds[opened.kind], opened.chosen
        if not kind.by_hand:
            return opened
        own = [(first, *(i for i in chosen if i != first)) for first in chosen]
        first = np.setdiff1d(np.arange(len(kind.rows)), chosen)
        rest = np.broadcast_to(chosen[1:], (len(first), len(chosen) - 1))
        sets = np.vstack([own, np.column_stack([first, rest])])
        able = sets[kind.together[sets[:, :1], sets].all(axis=1)]
        best = int(self.taking(opened.kind).gains(able).argmax())
        return Opened(opened.kind, tuple(able[best].tolist()))

    def rank(self, count: int) -> list[Opened]:
        """Setups with so many readings, one of a kind, greedily; those first that take most.

        Of many kinds only those are looked at whose best pair of readings takes most.
        """
        begun = [
            (gain, which, pair)
            for which, kind in enumerate(self.candidates.kinds)
            if beginnings(kind, count).flat.size
            for gain, pair in self.taking_on_mean(which).pairs(count, 1)
        ]
        begun.sort(key=lambda f: -f[0])
        found = []
        for _, which, pair in begun[:MOST_COMPLETED]:
            gain, chosen = self.taking(which, pair[0]).complete(pair, count)
            found.append((gain, Opened(which, chosen)))
        return [opened for _, opened in sorted(found, key=lambda f: -f[0])]

    def begun_otherwise(self, opened: Opened) -> list[Opened]:
        """The same setup, its readings greedily from each of the best pairs."""
        which, count = opened.kind, len(opened.chosen)
        return [
            Opened(which, self.taking(which, pair[0]).complete(pair, count)[1])
            for _, pair in self.taking(which).pairs(count, MOST_PAIRS)
        ]

    def better_readings(self, opened: Opened) -> Opened:
        """The same setup with each reading in turn exchanged for the best beside its others."""
        kind, chosen = self.candidates.kinds[opened.kind], list(opened.chosen)
        for _ in range(MOST_PASSES):
            before = list(chosen)
            whole = self.taking(opened.kind, chosen[0])
            for place in range(len(chosen)):
                others = chosen[:place] + chosen[place + 1 :]
                # another first reading must be one from which the gauge reaches all others
                reached = (
                    kind.together[chosen[0]] if place else kind.together[:, others].all(axis=1)
                )
                allowed = np.array(reached)
                allowed[others] = False
                gains = whole.gains_beside(others)
                chosen[place] = int(np.where(allowed, gains, -1.0).argmax())
            if chosen == before:
                break
        return Opened(opened.kind, tuple(chosen))


@lru_cache(maxsize=4)
def _narrow(candidates: Candidates) -> tuple[Array, tuple[Kind, ...], tuple[Kind, ...]]:
    """What candidates tell of the state at all, and how they answer to that.

    The state has directions that none of them tells of, often as many as the others.

    Returns:
        B, directions that are square to each other, shape (n_told, n_state); the kinds with slopes
        by these, A Bᵀ; and the same with gauges that are set on the mean of all postures.
    """
    slopes = [s for k in candidates.kinds for s in (k.slopes, *(h.slopes for h in k.by_hand))]
    _, sizes, directions = np.linalg.svd(np.vstack(slopes), full_matrices=False)
    told = directions[sizes > UNTOLD * sizes.max(initial=0.0)]
    kinds = tuple(
        replace(
            k,
            slopes=k.slopes @ told.T,
            by_hand=tuple(HandSet(h.answers, h.slopes @ told.T) for h in k.by_hand),
        )
        for k in candidates.kinds
    )
    return told, kinds, tuple(replace(k, by_hand=()) if k.by_hand else k for k in kinds)


def _says(candidates: Candidates, opened: Opened) -> Array:
    """What the readings of a setup say of the state."""
    if len(opened.chosen) < FEWEST:
        raise ValueError(f"found {len(opened.chosen)} readings; expected at least {FEWEST}")
    kind = candidates.kinds[opened.kind].only(opened.chosen).begun(0)
    spread = kind.own + candidates.sigma**2 * np.eye(len(kind.rows))
    return np.asarray(kind.slopes.T @ np.linalg.solve(spread, kind.slopes))


def error_left(information: Array, weigh: Weigh) -> float:
    """What the criterion makes small, as large as an error, where so much is said of the state."""
    covariance = _inverse(information)
    root = weigh(covariance)
    return float(np.sqrt(np.vdot(root, covariance @ root)))


def _inverse(information: Array) -> Array:
    inverse = np.linalg.inv(information)
    return np.asarray(0.5 * (inverse + inverse.T), dtype=np.float64)
