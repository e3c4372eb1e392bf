"""What readings take beside what others say, a kind of setup at a time.

Beside covariance C of the state, readings S of a setup take

    tr[(V_SS + σ² I)⁻¹ Q_SS],  V = A C Aᵀ + D,  Q = A C T C Aᵀ

off tr(T C), T being what the errors do at the tool (`choosing`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from orthocal.planning.candidates import Kind

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Pairs of a kind's readings that a setup can begin with; the gauge is set in the first."""

    first: Indices
    """Shape (n_pairs,)."""
    second: Indices
    flat: Indices
    """Where a pair is in a matrix of all readings by all, in rows."""


@dataclass(frozen=True, slots=True, eq=False)
class _Set:
    """Something that a hand sets where a setup begins, beside what others say.

    S is how it answers to the state in each posture that a setup could begin in.
    """

    answers: Array
    """How readings answer to it, shape (m,)."""
    slopes: Array
    """S, shape (m, n_state)."""
    known: Array
    """S C, shape (m, n_state)."""
    spread: Array
    """S C Aᵀ, shape (m, m)."""
    effect: Array
    """S C R, shape (m, p)."""

    def beside(self, other: _Set) -> Array:
        """S C S'ᵀ of it and another one where setups begin, shape (m,)."""
        return np.asarray(np.vecdot(self.known, other.slopes))


@dataclass(frozen=True, slots=True, eq=False)
class Taking:
    """Candidates of a kind beside what others say, none of which is taken."""

    kind: Kind
    spread: Array
    """V, shape (m, m), [m²]."""
    effect: Array
    """A C R, shape (m, p)."""
    variance: Array
    """V's diagonal, shape (m,)."""
    noise: float
    """σ²."""
    by_hand: tuple[_Set, ...] = ()

    @staticmethod
    def beside(kind: Kind, covariance: Array, worth: Array, sigma: float) -> Taking:
        """Candidates beside others that leave such a covariance of the state.

        Args:
            kind: The setup that could stand.
            covariance: C, shape (n_state, n_state).
            worth: C R with T = R Rᵀ, shape (n_state, p).
            sigma: Standard deviation of a reading, [m].
        """
        known = kind.slopes @ covariance
        spread = known @ kind.slopes.T
        spread += kind.own
        by_hand = []
        for hand in kind.by_hand:
            moved = hand.slopes @ covariance
            across, does = moved @ kind.slopes.T, hand.slopes @ worth
            by_hand.append(_Set(hand.answers, hand.slopes, moved, across, does))
        variance = spread.diagonal().copy()
        return Taking(kind, spread, kind.slopes @ worth, variance, sigma**2, tuple(by_hand))

    def begun(self, first: int) -> Taking:
        """The same with the gauge set in the posture of one of them."""
        if not self.by_hand:
            return self
        spread, effect = self.spread.copy(), self.effect.copy()
        for hand in self.by_hand:
            across = np.outer(hand.answers, hand.spread[first])
            spread += across + across.T
            effect += np.outer(hand.answers, hand.effect[first])
            for other in self.by_hand:
                both = hand.known[first] @ other.slopes[first]
                spread += both * np.outer(hand.answers, other.answers)
        return Taking(self.kind, spread, effect, spread.diagonal().copy(), self.noise)

    def gain(self, rows: list[int]) -> float:
        """What readings take together."""
        effect = self.effect[rows]
        return float(
            np.vdot(effect, np.linalg.solve(self._between(self.spread[rows], rows), effect))
        )

    def gains(self, sets: Indices) -> Array:
        """What sets of readings take, the gauge set in the first of each, shape (n_sets,).

        Args:
            sets: Readings of each, shape (n_sets, k).
        """
        first, effect = sets[:, 0], self.effect[sets]
        spread = self.spread[sets[:, :, None], sets[:, None, :]]
        spread += self.noise * np.eye(sets.shape[1])
        for hand in self.by_hand:
            own = hand.answers[sets]
            effect += own[:, :, None] * hand.effect[first][:, None, :]
            across = own[:, :, None] * hand.spread[first[:, None], sets][:, None, :]
            spread += across + np.swapaxes(across, 1, 2)
            for other in self.by_hand:
                both = hand.beside(other)[first]
                outer = own[:, :, None] * other.answers[sets][:, None, :]
                spread += both[:, None, None] * outer
        return np.asarray((effect * np.linalg.solve(spread, effect)).sum(axis=(1, 2)))

    def gains_beside(self, rows: list[int]) -> Array:
        """What one more reading would take where these are taken, shape (m,)."""
        rest = self.spread[rows]
        solved = np.linalg.solve(self._between(rest, rows), rest)
        effect = solved.T @ self.effect[rows]
        np.subtract(self.effect, effect, out=effect)
        rest *= solved
        return self._gains(effect, self.variance - rest.sum(axis=0))

    def pairs(self, count: int, most: int) -> list[tuple[float, tuple[int, int]]]:
        """What two readings take that take most together, and which; the gauge is set in the first.

        And the next best, each of which shares no reading with those before it, or begins
        elsewhere where a hand sets the gauge by the machine.

        Args:
            count: Readings that the setup is to take.
            most: How many pairs.
        """
        pairs = beginnings(self.kind, count)
        i, j, flat = pairs.first, pairs.second, pairs.flat
        if not flat.size:
            return []
        gains = self._differences()[i, j] if self.by_hand else self._differences_at(pairs)
        found: list[tuple[float, tuple[int, int]]] = []
        while True:
            best = int(gains.argmax())
            gain, pair = float(gains[best]), (int(i[best]), int(j[best]))
            if gain < 0.0:
                return found
            found.append((gain, pair))
            if len(found) == most:
                return found
            if self.by_hand:  # where it begins is what makes the difference
                gains[i == pair[0]] = -1.0
                continue
            for row in pair:
                gains[(i == row) | (j == row)] = -1.0

    def _differences_at(self, pairs: Pairs) -> Array:
        """What two readings take, shape (n_pairs,).

        Beside a zero of which nothing is known they are worth their difference.
        """
        i, j, flat = pairs.first, pairs.second, pairs.flat
        product = self.effect @ self.effect.T
        q, v = product.diagonal(), self.variance
        gains = q[i] + q[j] - 2.0 * product.reshape(-1)[flat]
        gains /= v[i] + (v + 2.0 * self.noise)[j] - 2.0 * self.spread.reshape(-1)[flat]
        return np.asarray(gains)

    def _differences(self) -> Array:
        """The same of all, the gauge set in the first (row), shape (m, m)."""
        taken, spread = self.effect @ self.effect.T, self.spread
        gains, spreads = (
            np.add.outer(s.diagonal(), s.diagonal()) - 2.0 * s for s in (taken, spread)
        )
        spreads += 2.0 * self.noise
        for hand in self.by_hand:
            change = hand.answers - hand.answers[:, None]
            for total, own in ((gains, hand.effect @ self.effect.T), (spreads, hand.spread)):
                total += 2.0 * change * (own - own.diagonal()[:, None])
            for other in self.by_hand:
                both = change * (other.answers - other.answers[:, None])
                gains += both * np.vecdot(hand.effect, other.effect)[:, None]
                spreads += both * hand.beside(other)[:, None]
        return np.asarray(gains / spreads)

    def complete(self, pair: tuple[int, int], count: int) -> tuple[float, tuple[int, ...]]:
        """Readings greedily on top of two, and what all of them take.

        A reading that is taken leaves the others what it does not say of them: a column of V's
        Cholesky factor after the other.
        """
        spread, effect, variance = self.spread, self.effect, self.variance
        steps, taken = np.empty((count, len(variance))), np.empty_like(effect)
        chosen, gain = list(pair), 0.0
        refused = ~self.kind.together[pair[0]]
        for k in range(count):
            if k >= len(chosen):
                refused[chosen] = True
                gains = self._gains(effect, variance)
                np.putmask(gains, refused, -1.0)
                chosen.append(int(gains.argmax()))
            row, column = chosen[k], spread[chosen[k]]
            if k:
                column = column - steps[:k, row] @ steps[:k]
            size = math.sqrt(column[row] + self.noise)
            step, share = np.divide(column, size, out=steps[k]), effect[row] / size
            gain += float(share @ share)
            np.multiply(step[:, None], share, out=taken)
            effect = np.subtract(effect, taken, out=effect if k else None)
            variance = variance - step**2
        return gain, tuple(chosen)

    def _between(self, rest: Array, rows: list[int]) -> Array:
        """V_SS + σ² I of readings, of their rows of V."""
        own = rest[:, rows]
        own[np.diag_indices(len(rows))] += self.noise
        return own

    def _gains(self, effect: Array, variance: Array) -> Array:
        scale = np.maximum(variance, 0.0)
        scale += self.noise
        return np.asarray(np.vecdot(effect, effect) / scale)


@lru_cache(maxsize=8192)
def beginnings(kind: Kind, count: int) -> Pairs:
    """Pairs the first of which is one from which the gauge reaches so many readings."""
    able = kind.together & (kind.together.sum(axis=1) >= count)[:, None]
    np.fill_diagonal(able, False)
    flat = np.flatnonzero(able)
    first, second = np.divmod(flat, len(able))
    return Pairs(first, second, flat)
