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
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from orthocal.errors import ParameterError
from orthocal.planning.candidates import FEWEST, Candidates, Kind
from orthocal.units import MM

Array = NDArray[np.float64]

WORTH = 1e-3
"""Part of the r.m.s. error by which a round of exchanges must better it for another one."""

MOST_ROUNDS = 8

MOST_REFINED = 4
"""Kinds of setup whose readings are exchanged for better ones, to find the best of them."""

MOST_COMPLETED = 40
"""Kinds of setup of which more than the best pair of readings is looked at."""

MOST_PAIRS = 3
"""Pairs of readings that a setup is begun with, to find the best of them."""

MOST_PASSES = 4
"""Through the readings of a setup, exchanging them."""

FEWEST_STARTS, MOST_STARTS = 3, 30

CANDIDATES_A_START = 20_000
"""A small choice is begun more often: candidates times starts are no fewer, up to MOST_STARTS."""

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
        report: Told after each start: how many there were, and the least error left.
    """
    rng = np.random.default_rng(seed)
    if starts is None:
        size = sum(len(k.rows) for k in candidates.kinds)
        starts = int(np.clip(CANDIDATES_A_START // size, FEWEST_STARTS, MOST_STARTS))
    best: Chosen | None = None
    for start in range(starts):
        order = rng.permutation(len(counts)) if start else np.arange(len(counts))
        own = [counts[i] for i in order]
        found = _open_all(candidates, own, prior, weigh, rng if start else None)
        found = _exchange(candidates, found, weigh)
        if best is None or found.left < best.left:
            best = found
        if report is not None:
            report(start + 1, best.left)
    if best is None:
        raise ValueError("expected at least one start")
    return best


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


def _open_all(
    candidates: Candidates,
    counts: Sequence[int],
    prior: Array,
    weigh: Weigh,
    rng: np.random.Generator | None,
) -> Chosen:
    """Setups opened one after the other; with random numbers the first half anywhere."""
    information, setups = np.array(prior), []
    for k, count in enumerate(counts):
        opened = None
        if rng is not None and k < (len(counts) + 1) // 2:
            opened = _open_anywhere(candidates, count, rng)
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
    for opened in (old, *(s for r in ranked for s in beside.begun_otherwise(r))):
        new = beside.better_readings(opened)
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
    """C, shape (n_state, n_state)."""
    root: Array
    """R, shape (n_state, p)."""

    @staticmethod
    def of(candidates: Candidates, information: Array, weigh: Weigh) -> _Beside:
        covariance = _inverse(information)
        return _Beside(candidates, covariance, weigh(covariance))

    def taking(self, which: int) -> _Taking:
        """The candidates of a kind, none of which is taken."""
        kind = self.candidates.kinds[which]
        known = kind.slopes @ self.covariance
        spread = known @ kind.slopes.T + kind.own
        noise = self.candidates.sigma**2
        return _Taking(spread, known @ self.root, spread.diagonal().copy(), noise)

    def rank(self, count: int) -> list[Opened]:
        """Setups with so many readings, one of a kind, greedily; those first that take most.

        Of many kinds only those are looked at whose best pair of readings takes most.
        """
        begun = []
        for which, kind in enumerate(self.candidates.kinds):
            taking = self.taking(which)
            for gain, pair in taking.pairs(_able(kind, count), 1):
                begun.append((gain, which, pair, taking))
        begun.sort(key=lambda f: -f[0])
        found = []
        for _, which, pair, taking in begun[:MOST_COMPLETED]:
            chosen = _complete(self.candidates.kinds[which], taking, pair, count)
            found.append((taking.gain, Opened(which, chosen)))
        return [opened for _, opened in sorted(found, key=lambda f: -f[0])]

    def begun_otherwise(self, opened: Opened) -> list[Opened]:
        """The same setup, its readings greedily from each of the best pairs."""
        which, count = opened.kind, len(opened.chosen)
        kind = self.candidates.kinds[which]
        whole = self.taking(which)
        return [
            Opened(which, _complete(kind, whole.again(), pair, count))
            for _, pair in whole.pairs(_able(kind, count), MOST_PAIRS)
        ]

    def better_readings(self, opened: Opened) -> Opened:
        """The same setup with each reading in turn exchanged for the best beside its others."""
        kind, chosen = self.candidates.kinds[opened.kind], list(opened.chosen)
        whole = self.taking(opened.kind)
        for _ in range(MOST_PASSES):
            before = list(chosen)
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


@dataclass(slots=True, eq=False)
class _Taking:
    """Candidates of a kind beside what others say, and readings as they are taken."""

    spread: Array
    """V, shape (m, m), [m²]."""
    effect: Array
    """A C R less what readings that were taken say of it, shape (m, p)."""
    variance: Array
    """V's diagonal, likewise, shape (m,)."""
    noise: float
    """σ²."""
    steps: tuple[Array, ...] = ()
    """Columns of V's Cholesky factor, of the readings that were taken."""
    gain: float = 0.0

    def again(self) -> _Taking:
        """The same with no reading taken, where none was."""
        return _Taking(self.spread, self.effect, self.variance, self.noise)

    def take(self, row: int) -> None:
        """Take a reading."""
        column = self.spread[row]
        if self.steps:
            taken = np.array(self.steps)
            column = column - taken[:, row] @ taken
        size = math.sqrt(column[row] + self.noise)
        step, share = column / size, self.effect[row] / size
        self.gain += float(share @ share)
        self.effect = self.effect - np.outer(step, share)
        self.variance = self.variance - step**2
        self.steps = (*self.steps, step)

    @property
    def gains(self) -> Array:
        """What one more reading would take, shape (m,)."""
        return self._gains(self.effect, self.variance)

    def gains_beside(self, rows: list[int]) -> Array:
        """What one more reading would take where these are taken, and no others, shape (m,)."""
        rest = self.spread[rows]
        own = rest[:, rows]
        own[np.diag_indices(len(rows))] += self.noise
        solved = np.linalg.solve(own, rest)
        effect = self.effect - solved.T @ self.effect[rows]
        return self._gains(effect, self.variance - (rest * solved).sum(axis=0))

    def _gains(self, effect: Array, variance: Array) -> Array:
        return np.asarray(np.vecdot(effect, effect) / (np.maximum(variance, 0.0) + self.noise))

    def pairs(self, together: NDArray[np.bool_], most: int) -> list[tuple[float, tuple[int, int]]]:
        """What two readings take that take most together, and which; the gauge is set in the first.

        And the next best, each of which shares no reading with those before it.
        """
        product = self.effect @ self.effect.T
        q, v = product.diagonal(), self.variance
        # beside a zero of which nothing is known two readings are worth their difference
        square = q[:, None] + q[None] - 2.0 * product
        gains = square / (v[:, None] + (v + 2.0 * self.noise) - 2.0 * self.spread)
        gains[~together] = -1.0
        np.fill_diagonal(gains, -1.0)
        found: list[tuple[float, tuple[int, int]]] = []
        while len(found) < most:
            first, second = divmod(int(gains.argmax()), len(v))
            gain = float(gains[first, second])
            if gain < 0.0:
                break
            found.append((gain, (first, second)))
            gains[[first, second]] = -1.0
            gains[:, [first, second]] = -1.0
        return found


@lru_cache(maxsize=512)
def _able(kind: Kind, count: int) -> NDArray[np.bool_]:
    """Which readings a gauge reaches from one (row) from which it reaches enough of them."""
    return np.asarray(kind.together & (kind.together.sum(axis=1) >= count)[:, None])


def _complete(kind: Kind, taking: _Taking, pair: tuple[int, int], count: int) -> tuple[int, ...]:
    """Readings greedily on top of two."""
    chosen = list(pair)
    for row in chosen:
        taking.take(row)
    allowed = np.array(kind.together[pair[0]])
    while len(chosen) < count:
        allowed[chosen] = False
        row = int(np.where(allowed, taking.gains, -1.0).argmax())
        taking.take(row)
        chosen.append(row)
    return tuple(chosen)


def _says(candidates: Candidates, opened: Opened) -> Array:
    """What the readings of a setup say of the state."""
    kind, rows = candidates.kinds[opened.kind], list(opened.chosen)
    if len(rows) < FEWEST:
        raise ValueError(f"found {len(rows)} readings; expected at least {FEWEST}")
    spread = kind.own[np.ix_(rows, rows)] + candidates.sigma**2 * np.eye(len(rows))
    slopes = kind.slopes[rows]
    return np.asarray(slopes.T @ np.linalg.solve(spread, slopes))


def error_left(information: Array, weigh: Weigh) -> float:
    """What the criterion makes small, as large as an error, where so much is said of the state."""
    covariance = _inverse(information)
    root = weigh(covariance)
    return float(np.sqrt(np.vdot(root, covariance @ root)))


def _inverse(information: Array) -> Array:
    inverse = np.linalg.inv(information)
    return np.asarray(0.5 * (inverse + inverse.T), dtype=np.float64)
